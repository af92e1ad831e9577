"""Things that are pushed alike between two visits are told from the building around them."""

import numpy as np
import pytest

from graphslam.core.geometry import between, compose, rotation3
from graphslam.core.known_landmarks import KnownLandmarks, SparseRoot
from graphslam.core.record import replace
from graphslam.core.records import Association, Estimate, Step, Trajectory
from graphslam.mapping.building import of_building
from graphslam.mapping.landmark_map import Entry, LandmarkMap
from graphslam.mapping.pushed_things import part_pushed

SIGMAS = np.array([0.3, 0.01, 0.005])
#: middle and direction of each wall, and half of its length, m: four of the room, then things
WALLS = [((5, 0, 0), 4.0), ((10, 4, 1.57), 3.5), ((5, 8, 3.14), 4.0), ((0, 4, -1.57), 3.5)]
THINGS = [
    ((1, 2, -1.57), 0.8), ((1.1, 6, -1.57), 0.7), ((9, 2, 1.57), 0.8), ((8.9, 6, 1.57), 0.9),
    ((4, 4, 1.57), 0.5), ((6, 4, -1.57), 0.5), ((3, 1, 0), 0.8), ((7, 7, 3.14), 0.8),
]  # fmt: skip
#: numbers of the things that face along x
ACROSS = set(range(4, 10))
PER_VISIT = 12


def room(pushed_m, dragged, things=ACROSS | {10, 11}, seed=0):
    """Two visits of a room; before the second, ``things`` were pushed along x. Its path is off by
    ``dragged`` of that, and every landmark is in the middle of where both see it."""
    rng = np.random.default_rng(seed)
    states, steps = {}, []
    off = dragged * pushed_m
    for name, first in (("a", 0), ("b", 1000)):
        stamps = first + np.arange(PER_VISIT, dtype=np.int64)
        angle = np.linspace(0, 2 * np.pi, PER_VISIT)
        true = np.column_stack([5 + np.cos(angle), 4 + np.sin(angle), angle])
        there = true - [off, 0, 0] if name == "b" else true
        states[name] = Trajectory(stamps, there, np.zeros((PER_VISIT, 3, 3)))
        for stamp, pose in zip(stamps.tolist(), true, strict=True):
            seen = []
            for number, (wall, half) in enumerate(WALLS + THINGS):
                at = np.array(wall, float)
                at[0] += pushed_m * (name == "b" and number in things)
                own = compose(
                    at, np.array([rng.uniform(-0.2, 0.2), *(SIGMAS * rng.normal(size=3))[1:]])
                )
                z = between(pose, own)
                turn = rotation3(np.array([z[2]]))[0]
                cov = turn @ np.diag(SIGMAS**2) @ turn.T
                extent = np.array([-half, half])
                seen.append(Association(name, stamp, number, "line", z, cov, extent=extent))
            steps.append(Step(stamp, {}, {}, tuple(seen)))
    landmarks, marks = LandmarkMap(bias_m=0.01), {}
    for number, (wall, half) in enumerate(WALLS + THINGS):
        mean = np.array(wall, float)
        mean[0] += (pushed_m * (number in things) - off) / 2
        extent = np.array([-half, half])
        entry = Entry(number, "line", mean.copy(), np.eye(3), extent, 0, 9, None, 9)
        landmarks.add_all({number: entry})
        marks[number] = mean, np.eye(3)
    return tuple(steps), Estimate(states, marks, 0.0, 1), landmarks


@pytest.mark.parametrize("pushed_m", [0.05, 0.1])
@pytest.mark.parametrize("dragged", [0.0, 0.5, 1.0])
def test_what_was_pushed_is_told_however_far_it_drags(pushed_m, dragged):
    """Dragged by all of it the walls seem to have moved: they have not. Things that face across the
    push are where they were. All observations are 1 cm off, of twelve 3 mm."""
    steps, estimate, landmarks = room(pushed_m, dragged)
    made, found, moved = part_pushed(steps, estimate, landmarks)
    assert set(moved.values()) == ACROSS
    targets = {(a.robot, a.target) for step in made for a in step.associations}
    assert all(("a", old) in targets and ("b", old) not in targets for old in ACROSS)
    assert all(("b", new) in targets and new in found.landmarks for new in moved)


@pytest.mark.parametrize("seed", range(5))
def test_what_stays_is_left_as_it_is(seed):
    """A false one would be a tie less."""
    steps, estimate, landmarks = room(0.0, 0.0, seed=seed)
    assert part_pushed(steps, estimate, landmarks)[0] is steps


def test_one_thing_alone_drags_nothing():
    """It is for `moved_walls`; a gate passed by a few of many surfaces is no evidence."""
    assert not part_pushed(*room(0.05, 0.0, things={4, 5}))[2]


def test_of_one_visit_nothing_is_compared():
    steps, estimate, landmarks = room(0.05, 0.5)
    alone = replace(estimate, states={"a": estimate.states["a"]})
    assert part_pushed(steps[:PER_VISIT], alone, landmarks)[0] == steps[:PER_VISIT]


@pytest.mark.parametrize("pushed_m", [0.05, 0.0])
def test_what_an_earlier_map_says_is_a_visit(pushed_m):
    """The walls of the map keep their numbers, and stand where the map has them."""
    steps, estimate, landmarks = room(pushed_m, 0.5)
    names = range(len(WALLS + THINGS))
    means = {n: np.array(wall, float) for n, (wall, _) in enumerate(WALLS + THINGS)}
    rows = tuple(np.diag(1.0 / np.array([1.0, 0.01, 0.003])) for _ in names)
    known = KnownLandmarks(means, tuple(names), SparseRoot(tuple(() for _ in names), rows, 1.0))
    landmarks.add_known({n: landmarks.entries[n].copied(n) for n in names})
    day = replace(estimate, states={"b": estimate.states["b"]})
    _, found, moved = part_pushed(steps[PER_VISIT:], day, landmarks, known)
    assert set(moved.values()) == (ACROSS if pushed_m else set())
    for number in moved.values():
        assert np.allclose(between(means[number], found.landmarks[number][0])[1], 0, atol=1e-9)


def entries(*walls):
    return [
        Entry(n, "line", np.array(mean, float), np.eye(3), np.array([-half, half]), 0, 9, None)
        for n, (mean, half) in enumerate(walls)
    ]


def test_pieces_of_one_plane_are_of_the_building():
    """A wall behind cupboards is seen in the gaps between these, each of them shorter than one."""
    gaps = [((x, 0, 0), 0.3) for x in (0, 2.5, 5)]
    cupboards = [((1.2, 0.4, 0), 0.8), ((3.7, 0.45, 0), 0.8)]
    opposite = [((2.5, 0.01, np.pi), 0.3)]
    assert of_building(entries(*gaps, *cupboards, *opposite)).tolist() == [True] * 3 + [False] * 3
    assert of_building(entries(((0, 0, 0), 1.3), ((9, 9, 0), 1.2))).tolist() == [True, False]
    assert not len(of_building([]))
