"""A wall whose observations are of two things becomes two; a bent or noisy one stays one."""

import numpy as np
import pytest

from graphslam.core.geometry import between, compose
from graphslam.core.record import replace
from graphslam.core.records import Association, Estimate, Step, Trajectory
from graphslam.mapping.composite_walls import split_composites
from graphslam.mapping.landmark_map import Entry, LandmarkMap

SIGMAS = np.array([0.3, 0.01, 0.005])
#: of a door, 10 cm behind the wall beside it: along, across, direction, and half of its length
DOOR = np.array([-0.45, 0.1, 0.0]), 0.4
#: of the wall, in parts
WALL = [(np.array([along, 0.0, 0.0]), 0.5) for along in np.linspace(0.6, 3.4, 20)]


def seen(things, rng, mean=(5.0, 3.0, 2.0), noise=1.0, flipped=False):
    """Steps in which a robot sees ``things`` as landmark 7, and their estimate and map.

    ``things``: (pose (3,) in the frame of the wall at ``mean``, half of its length) for each step.
    """
    mean = np.array(mean)
    n = len(things)
    states = compose(
        np.broadcast_to(mean, (n, 3)),
        np.column_stack([np.linspace(-2, 4, n), np.full(n, -2.0), rng.uniform(-1, 1, n)]),
    )
    steps = []
    for k, (pose, half) in enumerate(things):
        own = compose(pose, noise * SIGMAS * rng.normal(size=3) * (0, 1, 1))
        if flipped and k % 2:
            own = compose(own, np.array([0.0, 0.0, np.pi]))
        z = between(states[k], compose(mean, own))
        c, s = np.cos(z[2]), np.sin(z[2])
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        cov = turn @ np.diag(SIGMAS**2) @ turn.T
        a = Association("r", k, 7, "line", z, cov, extent=np.array([-half, half]))
        steps.append(Step(k, {}, {}, (a,)))
    landmarks = LandmarkMap()
    landmarks.entries[7] = Entry(
        7, "line", mean.copy(), np.eye(3), np.array([-1.0, 4.0]), 0, n, None, n, in_graph=True
    )
    landmarks.begin_at(8)
    track = Trajectory(np.arange(n, dtype=np.int64), states, np.zeros((n, 3, 3)))
    return tuple(steps), Estimate({"r": track}, {7: (mean, np.eye(3))}, 0.0, 1), landmarks


def targets(steps):
    return [a.target for step in steps for a in step.associations]


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_a_door_and_the_wall_beside_it_are_two(seed, flipped):
    """Whichever way round they are seen; each is where its own observations are, to 3 sigmas."""
    rng = np.random.default_rng(seed)
    steps, estimate, landmarks = seen(WALL + [DOOR] * 12, rng, flipped=flipped)
    made, found = split_composites(steps, estimate, landmarks)
    assert targets(made) == [7] * 20 + [8] * 12
    assert set(landmarks.entries) == set(found.landmarks) == {7, 8}
    mean = estimate.landmarks[7][0]
    for number, (pose, _), n in ((7, WALL[10], 20), (8, DOOR, 12)):
        off = between(compose(mean, pose), found.landmarks[number][0])
        assert (np.abs(off[1:]) < 3 * SIGMAS[1:] / np.sqrt(n)).all()


def test_a_wall_between_two_doors_is_three_things():
    """Breaks if only one step of a wall is looked for."""
    other = (np.array([4.5, 0.1, 0.0]), 0.4)
    things = [DOOR] * 8 + WALL + [other] * 9
    made, *_ = split_composites(*seen(things, np.random.default_rng(1)))
    assert [set(targets(made)[k]) for k in (slice(8), slice(8, 28), slice(28, 37))] == [
        {9}, {7}, {8}
    ]  # fmt: skip


@pytest.mark.parametrize("seed", range(5))
def test_a_door_with_the_wall_on_both_sides_is_told_from_it(seed):
    """Breaks if only a step is looked for: both sides of one show much of the wall."""
    sides = [(np.array([along, 0.0, 0.0]), 0.5) for along in np.linspace(-8, -1.5, 30)]
    things = sides + [DOOR] * 12 + WALL * 2
    made, *_ = split_composites(*seen(things, np.random.default_rng(seed)))
    assert targets(made) == [7] * 30 + [8] * 12 + [7] * 40


@pytest.mark.parametrize(
    "things",
    [
        WALL + WALL,
        # a path that bends takes the wall with it: by 10 cm within what is in view at once
        [(np.array([s, 0.1 * (s > 1.5), 0.0]), 1.5) for s in np.linspace(0, 3, 30)],
        # a step of 1 cm: by a surface that looks nearer than the one beside it
        [(p * (1, 0.1, 1), half) for p, half in WALL + [DOOR] * 20],
    ],
)
def test_one_wall_stays_one(things):
    """For all of 20 draws of its noise."""
    for seed in range(20):
        steps, estimate, landmarks = seen(things, np.random.default_rng(seed))
        made, found = split_composites(steps, estimate, landmarks)
        assert made is steps
        assert found is estimate
        assert set(landmarks.entries) == {7}


def test_a_wall_of_an_earlier_map_stays_what_it_was():
    """Its number has a prior."""
    steps, estimate, landmarks = seen(WALL + [DOOR] * 12, np.random.default_rng(0))
    landmarks.add_known(dict(landmarks.entries))
    assert split_composites(steps, estimate, landmarks)[0] is steps


def test_the_other_part_gets_a_number_that_nothing_has():
    """Tracking numbers its landmarks itself; the map once gave the door the number of landmark 0,
    and both were one."""
    steps, estimate, _ = seen(WALL + [DOOR] * 12, np.random.default_rng(0))
    landmarks = LandmarkMap()
    entry = Entry(7, "line", np.zeros(3), np.eye(3), np.zeros(2), 0, 1, None)
    landmarks.add_all({0: replace(entry, id=0), 7: entry, 30: replace(entry, id=30)})
    made, _ = split_composites(steps, estimate, landmarks)
    assert set(targets(made)) == {7, 31}


@pytest.mark.parametrize(("step_m", "parts"), [(0.03, 1), (0.1, 2)])
def test_a_wall_of_which_two_visits_saw_a_part_each_has_a_step_by_their_biases(step_m, parts):
    """Of 3 cm: a surface looks 1 cm nearer on one day. A door is told from its wall even so."""
    door = (np.array([-0.45, step_m, 0.0]), 0.4)
    steps, estimate, landmarks = seen(WALL + [door] * 12, np.random.default_rng(0))
    landmarks.bias_m = 0.01
    both = tuple(
        replace(step, associations=tuple(replace(a, robot="s") for a in step.associations))
        if k >= 20 else step
        for k, step in enumerate(steps)
    )  # fmt: skip
    estimate = replace(estimate, states={"r": estimate.states["r"], "s": estimate.states["r"]})
    made, _ = split_composites(both, estimate, landmarks)
    assert len(set(targets(made))) == parts
