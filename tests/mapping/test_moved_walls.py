"""What is pushed a little between two visits becomes two landmarks; what stays is one."""

import numpy as np
import pytest

from graphslam.core.geometry import between, compose
from graphslam.core.known_landmarks import KnownLandmarks, SparseRoot
from graphslam.core.record import replace
from graphslam.core.records import Association, Estimate, Step, Trajectory
from graphslam.mapping.landmark_map import Entry, LandmarkMap
from graphslam.mapping.moved_walls import part_moved

SIGMAS = np.array([0.3, 0.01, 0.005])
MEAN = np.array([5.0, 3.0, 2.0])


def visits(pushed_m, seed=0, half_m=0.4, per_visit=8):
    """Steps in which robots a, b, … see one wall of the map, pushed across by so much for each."""
    rng = np.random.default_rng(seed)
    steps, states = [], {}
    for name, shift in zip("abcdef", pushed_m, strict=False):
        stamps = np.arange(per_visit, dtype=np.int64) + 100 * ord(name)
        poses = compose(
            np.broadcast_to(MEAN, (per_visit, 3)),
            np.column_stack(
                [
                    np.linspace(-2, 2, per_visit),
                    np.full(per_visit, -2.0),
                    rng.uniform(-1, 1, per_visit),
                ]
            ),
        )
        states[name] = Trajectory(stamps, poses, np.zeros((per_visit, 3, 3)))
        for stamp, pose in zip(stamps.tolist(), poses, strict=True):
            own = np.array([0.0, shift, 0.0]) + SIGMAS * (0, 1, 1) * rng.normal(size=3)
            z = between(pose, compose(MEAN, own))
            c, s = np.cos(z[2]), np.sin(z[2])
            turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
            cov = turn @ np.diag(SIGMAS**2) @ turn.T
            extent = np.array([-half_m, half_m])
            steps.append(
                Step(stamp, {}, {}, (Association(name, stamp, 7, "line", z, cov, extent=extent),))
            )
    landmarks = LandmarkMap(bias_m=0.01)
    entry = Entry(7, "line", MEAN.copy(), np.eye(3), np.array([-1.0, 1.0]), 0, 9, None, 9)
    landmarks.add_all({7: entry})
    return tuple(steps), Estimate(states, {7: (MEAN, np.eye(3))}, 0.0, 1), landmarks


def targets(steps):
    """Robot -> the landmarks that it saw."""
    found = {}
    for step in steps:
        for a in step.associations:
            found.setdefault(a.robot, set()).add(a.target)
    return found


@pytest.mark.parametrize("seed", range(5))
def test_what_was_pushed_is_a_landmark_of_its_own(seed):
    """By 7 cm, where 1 cm of the surface and 5 mm of each path are allowed: it was at one place for
    the first visits, and at another for the last two."""
    made, found, moved = part_moved(*visits([0.0, 0.0, 0.07, 0.07], seed))
    assert moved == {8: 7}
    assert targets(made) == {"a": {7}, "b": {7}, "c": {8}, "d": {8}}
    off = between(MEAN, found.landmarks[8][0])
    assert abs(off[1] - 0.07) < 3 * SIGMAS[1] / np.sqrt(16)
    # and the first one is back where it stood
    assert abs(between(MEAN, found.landmarks[7][0])[1]) < 3 * SIGMAS[1] / np.sqrt(16)


def test_what_stays_is_one():
    """Its surface looks 1 cm nearer from elsewhere; of 50 draws one in a hundred may be wrong."""
    wrong = sum(len(part_moved(*visits([0.0, 0.01, -0.01], seed))[2]) for seed in range(50))
    assert wrong <= 2


def test_a_long_wall_is_the_building():
    """That two visits see it is most of what is known of their directions."""
    assert not part_moved(*visits([0.0, 0.07], half_m=2.0))[2]


def test_one_visit_has_nothing_to_compare():
    steps, estimate, landmarks = visits([0.0])
    assert part_moved(steps, estimate, landmarks)[0] is steps


def test_each_has_the_times_and_the_number_of_its_own_sightings():
    """Both had those of all visits."""
    steps, estimate, landmarks = visits([0.0, 0.07])
    part_moved(steps, estimate, landmarks)
    first, later = landmarks.entries[7], landmarks.entries[8]
    assert (first.sightings, later.sightings) == (8, 8)
    assert first.last_ns < later.first_ns
    assert later.last_ns == steps[-1].time_ns


def in_a_map(pushed_m, extent=(-1.0, 1.0)):
    """One visit of a wall of an earlier map, that map, and an estimate between the two."""
    steps, estimate, landmarks = visits([pushed_m])
    entry = replace(landmarks.entries[7], extent=np.array(extent), first_ns=-9, last_ns=-5)
    landmarks.add_known({7: entry})
    root = SparseRoot(((),), (np.diag(1.0 / np.array([1.0, 0.01, 0.003])),), 1.0)
    known = KnownLandmarks({7: MEAN}, (7,), root)
    between_both = compose(MEAN, np.array([0.0, pushed_m / 2, 0.0]))
    estimate = Estimate(estimate.states, {7: (between_both, np.eye(3))}, 0.0, 1)
    return steps, estimate, landmarks, known


@pytest.mark.parametrize(("pushed_m", "number"), [(0.07, 8), (0.01, 7)])
def test_what_a_known_map_says_is_a_visit(pushed_m, number):
    """The map's number stays with the map: what was pushed is new."""
    steps, estimate, landmarks, known = in_a_map(pushed_m)
    made, found, _ = part_moved(steps, estimate, landmarks, known)
    assert targets(made) == {"a": {number}}
    if number == 8:
        assert landmarks.entries[7].last_ns == -5  # not seen today
        assert abs(between(MEAN, found.landmarks[7][0])[1]) < 1e-9


def test_a_part_of_a_long_wall_of_the_map_is_no_thing():
    """Of 20 m the log saw 0.8: that it lies aside there says nothing about the wall."""
    steps, estimate, landmarks, known = in_a_map(0.07, extent=(-10.0, 10.0))
    assert part_moved(steps, estimate, landmarks, known)[0] is steps
