"""Tracking against the landmarks of the last metres: what it associates, begins and forgets."""

import itertools

import numpy as np

from graphslam.core.config import AssociationConfig
from graphslam.core.geometry import between, compose
from graphslam.core.observation_arrays import ObservationArrays
from graphslam.core.records import Motion, Observation
from graphslam.mapping.local_tracking import LocalTracker

S = 1_000_000_000
COV = np.diag([0.02, 0.01, 0.005]) ** 2
Q = np.diag([0.01, 0.01, 0.005]) ** 2
#: walls around a robot that drives along x, as poses on them; one 0.5 m from another
WALLS = np.array([[1.0, 1.5, 0.0], [1.0, -1.5, np.pi], [4.0, 0.0, -np.pi / 2]])


def lines(pose, walls, rng=None):
    """Walls (k, 3) as seen from a pose, 2 m of each."""
    seen = []
    for wall in walls:
        z = between(pose, wall)
        if rng is not None:
            z = z + rng.multivariate_normal(np.zeros(3), COV)
        seen.append(Observation("line", z, COV, np.array([-1.0, 1.0])))
    return ObservationArrays.of(seen)


def motion(delta, k, length_m=None):
    length = float(np.hypot(*delta[:2])) if length_m is None else length_m
    return Motion((k - 1) * S, k * S, np.asarray(delta), Q, np.zeros((3, 0)), length)


def tracker(start=None):
    start = np.zeros(3) if start is None else start
    return LocalTracker("a", AssociationConfig(), start, itertools.count())


def test_walls_are_recognised_and_the_path_is_theirs():
    """Odometry is 10 % too long, 18 cm in all, two of its sigmas in every step. Walls of 1 to 2 cm
    leave half of that at most along the path, and 3 cm across; without them all of it remains."""
    rng, found, pose = np.random.default_rng(0), tracker(), np.zeros(3)
    targets = []
    associations, _, _ = found.track(0, lines(pose, WALLS, rng))
    for k in range(1, 10):
        true = np.array([0.2, 0.0, 0.02])
        pose = compose(pose, true)
        found.move(motion(true * [1.1, 1.0, 1.0], k))
        associations, _, _ = found.track(k * S, lines(pose, WALLS, rng))
        targets.append({a.target for a in associations})
    off = between(pose, found.pose)
    assert abs(off[0]) < 0.09 and abs(off[1]) < 0.03 and abs(off[2]) < 0.02
    assert targets[-1] == {0, 1, 2}
    found.retire_all()
    assert sorted(found.entries) == [0, 1, 2] and found.deleted == 0
    for number, entry in found.entries.items():
        off = between(WALLS[number], entry.mean)
        assert abs(off[1]) < 0.05 and entry.sightings == 10


def test_walls_that_are_not_straight_do_not_move_the_robot_by_many_sigmas():
    """Directions of walls are 0.6° off, twice the sigma, as where stretches of a bulging wall are
    seen. The robot stands; over 40 draws its turn is 1.4 of its own sigmas off (rms), and 2.2
    without noise for such walls; 1.8 is in the middle."""
    squared = []
    for seed in range(40):
        rng, found = np.random.default_rng(seed), tracker()
        for k in range(8):
            if k:
                found.move(motion([0.0, 0.0, 0.0], k))
            bulging = WALLS + np.column_stack([np.zeros((3, 2)), rng.normal(0, 0.01, 3)])
            found.track(k * S, lines(np.zeros(3), bulging, rng))
        pose, cov = found.anchor()
        squared.append(pose[2] ** 2 / cov[2, 2])
    assert np.sqrt(np.mean(squared)) < 1.8


def test_evidence_enters_at_promotion_and_is_marked_late():
    """Nothing before the third sighting, then all three; two of them late."""
    found = tracker()
    counts = []
    for k in range(4):
        if k:
            found.move(motion([0.01, 0.0, 0.0], k))
        associations, _, _ = found.track(k * S, lines(np.array([0.01 * k, 0, 0]), WALLS[:1]))
        counts.append([a.late for a in associations])
    assert counts == [[], [], [True, True, False], [False]]


def test_another_visit_begins_landmarks_of_its_own():
    """After more than `reacquire_m` of path without it, the same wall is a new landmark, although
    the robot is where it was; before that it is the same."""
    for away_m, same in ((5.0, True), (30.0, False)):
        found = tracker()
        for k in range(4):
            if k:
                found.move(motion([0.0, 0.0, 0.0], k, 0.0))
            found.track(k * S, lines(np.zeros(3), WALLS))
        found.move(motion([0.0, 0.0, 0.0], 4, away_m))
        found.track(4 * S, ObservationArrays.of([]))
        for k in range(5, 9):
            found.move(motion([0.0, 0.0, 0.0], k, 0.0))
            associations, _, _ = found.track(k * S, lines(np.zeros(3), WALLS))
        assert ({a.target for a in associations} == {0, 1, 2}) is same
        found.retire_all()
        assert len(found.entries) == (3 if same else 6)


def test_a_wall_left_behind_stays_where_it_was_seen():
    """Without noise the entries of retired walls are those walls. They are retired between a motion
    and its image: seen from the pose before, they would be off by that motion, 0.5 m and 0.1 rad.
    1e-9: rounding over 60 motions."""
    found, pose, step = tracker(), np.zeros(3), np.array([0.5, 0.0, 0.1])
    for k in range(60):
        if k:
            found.move(motion(step, k))
            pose = compose(pose, step)
        found.track(k * S, lines(pose, WALLS) if k < 4 else ObservationArrays.of([]))
    assert sorted(found.entries) == [0, 1, 2] and not len(found._filter)
    for number, entry in found.entries.items():
        np.testing.assert_allclose(between(WALLS[number], entry.mean), 0.0, atol=1e-9)


def test_the_cost_of_an_image_does_not_grow_with_the_path():
    """The filter holds what was seen in the last metres, however many walls the path has."""
    found, pose = tracker(), np.zeros(3)
    sizes = []
    for k in range(200):
        if k:
            found.move(motion([0.5, 0.0, 0.0], k))
            pose = compose(pose, np.array([0.5, 0.0, 0.0]))
        walls = np.array([[2.0 * np.floor(pose[0] / 2), 1.5, 0.0], [pose[0], -1.5, np.pi]])
        found.track(k * S, lines(pose, walls))
        sizes.append(len(found._filter))
    assert max(sizes[100:]) <= max(sizes[:100])
    found.retire_all()


def test_two_walls_of_one_image_are_two_landmarks_although_one_is_near_the_other():
    found = tracker()
    near = np.array([[1.0, 1.5, 0.0], [1.0, 1.62, 0.0]])
    for k in range(4):
        if k:
            found.move(motion([0.0, 0.0, 0.0], k, 0.0))
        associations, _, _ = found.track(k * S, lines(np.zeros(3), near))
    assert len({a.target for a in associations}) == len(associations) == 2


def test_what_is_neither_a_match_nor_new_is_rejected_and_counted():
    found = tracker()
    for k in range(4):
        if k:
            found.move(motion([0.0, 0.0, 0.0], k, 0.0))
        found.track(k * S, lines(np.zeros(3), WALLS[:1]))
    found.move(motion([0.0, 0.0, 0.0], 4, 0.0))
    # between the quantiles of 0.99 and 0.9999, with the floor of 3 cm
    associations, _, _ = found.track(
        4 * S, lines(np.zeros(3), WALLS[:1] + np.array([0.0, 0.12, 0.0]))
    )
    assert associations == ()
    assert found.rejected["between the thresholds: neither a match nor new"] == 1
