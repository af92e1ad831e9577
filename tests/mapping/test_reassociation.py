"""Observations that went to the wrong wall go to the right one, and what fits none goes."""

from dataclasses import replace

import numpy as np

from graphslam.core.geometry import between
from graphslam.core.records import Association, Estimate, Step, Trajectory
from graphslam.mapping.landmark_map import Entry
from graphslam.mapping.reassociation import reassociate

#: one wall above the robot's path (y = 2, sensor on its left: heading pi), one 0.2 m behind it
WALLS = {0: np.array([0.0, 2.0, np.pi]), 1: np.array([0.0, 2.2, np.pi])}


def entry(number, kind="line"):
    extent = np.array([-5.0, 5.0])
    return Entry(number, kind, WALLS[number].copy(), np.eye(3), extent, 0, 0, None, 5, True)


def world(targets, at):
    """A step per state on the x axis, each with one sighting of ``at``'s wall booked as another."""
    n = len(targets)
    poses = np.column_stack([np.linspace(-2, 2, n), np.zeros(n), np.zeros(n)])
    stamps = np.arange(n, dtype=np.int64)
    cov = np.diag([1.0, 0.01, 0.005]) ** 2
    steps = tuple(
        Step(k, {}, {}, (Association("r", k, t, "line", between(pose, line(pose, wall)), cov),))
        for k, (t, wall, pose) in enumerate(zip(targets, at, poses, strict=True))
    )
    landmarks = {i: (mean, np.eye(3)) for i, mean in WALLS.items()}
    states = {"r": Trajectory(stamps, poses, np.zeros((n, 3, 3)))}
    return steps, Estimate(states, landmarks, 0.0, 1)


def line(pose, wall):
    """What is seen of a wall, opposite the robot; of ``wall`` None, something 1 m before it."""
    mean = WALLS[0] - [0.0, 1.0, 0.0] if wall is None else WALLS[wall]
    return np.array([pose[0], mean[1], mean[2]])


def targets_of(steps):
    return [a.target for step in steps for a in step.associations]


def test_each_goes_to_the_wall_that_it_fits():
    """Breaks with a comparison in the wrong frame, or one that keeps what was."""
    steps, estimate = world([0, 0, 1, 1], at=[0, 1, 1, 0])
    done = reassociate(steps, estimate, {0: entry(0), 1: entry(1)}, 0.3, 0.15, 0.3)
    assert targets_of(done.steps) == [0, 1, 1, 0]
    assert (done.moved, done.dropped) == (2, 0)


def test_what_fits_no_wall_goes():
    """Breaks if an observation a metre off every wall goes on bending the map."""
    steps, estimate = world([0, 0, 1], at=[0, None, 1])
    done = reassociate(steps, estimate, {0: entry(0), 1: entry(1)}, 0.3, 0.15, 0.3)
    assert targets_of(done.steps) == [0, 1]
    assert (done.moved, done.dropped) == (0, 1)


def test_one_image_shows_a_wall_once():
    """Breaks if two observations of one image, side by side, become one wall."""
    steps, estimate = world([0], at=[0])
    (a,) = steps[0].associations
    near = replace(a, target=1, z=a.z + np.array([0.5, 0.0, 0.0]))  # booked for 1, fits 0
    steps = (replace(steps[0], associations=(a, near)),)
    done = reassociate(steps, estimate, {0: entry(0), 1: entry(1)}, 0.3, 0.15, 0.3)
    assert targets_of(done.steps) == [0, 1]


def test_beyond_the_end_of_a_wall_it_is_another():
    """Breaks without the test of extents: all walls in line would be one."""
    steps, estimate = world([0, 0], at=[0, 0])
    short = replace(entry(0), extent=np.array([1.5, 5.0]))  # world x from -5 to -1.5
    done = reassociate(steps, estimate, {0: short, 1: entry(1)}, 0.1, 0.15, 0.3)
    assert targets_of(done.steps) == [0]
    assert done.dropped == 1


def test_an_observation_stays_with_the_walls_of_its_visit_where_that_is_asked_for():
    """A wall of another visit, 4 cm nearer, takes the observation only without `within_m`."""
    path = np.column_stack([np.arange(0.0, 40.0, 1.0), np.zeros((40, 2))])
    stamps = np.arange(40, dtype=np.int64)
    states = {"a": Trajectory(stamps, path, np.zeros((40, 3, 3)))}
    # wall 0 is seen from the first states only, wall 1 from the last ones; both lie along the path
    means = {0: np.array([0.0, 2.0, 0.0]), 1: np.array([0.0, 2.1, 0.0])}
    steps = tuple(
        Step(int(t), associations=(
            Association("a", int(t), 0 if t < 10 else 1, "line", np.array([0.0, 2.0, 0.0]),
                        np.eye(3), extent=np.array([-1.0, 1.0])),
        ))
        for t in (*range(5), *range(35, 40))
    )  # fmt: skip
    estimate = Estimate(states, {n: (m, np.eye(3)) for n, m in means.items()}, 0.0, 0)
    entries = {
        n: Entry(n, "line", m, np.eye(3), np.array([-5.0, 45.0]), 0, 39, None, in_graph=True)
        for n, m in means.items()
    }
    free = reassociate(steps, estimate, entries, 0.3, 0.15, 0.3)
    assert free.moved == 5
    bound = reassociate(steps, estimate, entries, 0.3, 0.15, 0.3, within_m=15.0)
    assert bound.moved == bound.dropped == 0
    wide = reassociate(steps, estimate, entries, 0.3, 0.15, 0.3, within_m=40.0)
    assert wide.moved == 5
