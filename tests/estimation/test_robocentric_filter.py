"""The robocentric filter: equal to a batch of the same linear problem, and to itself elsewhere."""

import numpy as np
import pytest

from graphslam.core.geometry import between, compose, inverse, rotate_cov
from graphslam.estimation.robocentric_filter import ANCHOR, PREVIOUS, RobocentricFilter

Q = np.diag([0.02, 0.01, 0.01]) ** 2
R = np.diag([0.01, 0.01, 0.005]) ** 2
WALLS = np.array([[3.0, 1.0, 0.4], [2.0, -1.5, -2.0], [4.0, 0.5, 1.5]])
EVERY_ROW = np.ones((3, 3), dtype=bool)


def observed(robot, seen, estimate):
    """Update with poses seen (k, 3): residual expected minus measured, derivative identity."""
    off = estimate - seen
    off[:, 2] = (off[:, 2] + np.pi) % (2 * np.pi) - np.pi
    H, noise = np.tile(np.eye(3), (3, 1, 1)), np.tile(R, (3, 1, 1))
    robot.update(np.arange(3), H, noise, off, EVERY_ROW)


def test_without_noise_the_motion_is_that_of_the_landmarks():
    """Odometry says something else than the walls, which are known exactly: the walls win. Breaks
    when a sign of the Jacobian of the motion is wrong."""
    robot = RobocentricFilter()
    robot.add(WALLS, np.tile(1e-12 * np.eye(3), (3, 1, 1)), np.ones(3))
    true, said = np.array([0.5, 0.1, 0.2]), np.array([0.53, 0.07, 0.18])
    robot.predict(said, Q)
    seen = between(true, WALLS)
    H, noise = np.tile(np.eye(3), (3, 1, 1)), np.tile(1e-10 * np.eye(3), (3, 1, 1))
    robot.update(np.arange(3), H, noise, robot.landmarks - seen, EVERY_ROW)
    moved, cov = robot.reference(PREVIOUS)
    # to second order in the correction of 0.02 rad, with walls 4 m away
    np.testing.assert_allclose(moved, true, atol=2e-3)
    assert np.sqrt(np.diag(cov)).max() < 1e-4


def test_the_covariance_of_a_motion_alone_is_that_of_odometry():
    """The robot seen from where it was: along the axes of the start, as odometry gives it."""
    robot, delta = RobocentricFilter(), np.array([0.5, 0.1, 0.8])
    robot.predict(delta, Q)
    moved, cov = robot.reference(PREVIOUS)
    np.testing.assert_allclose(moved, delta, atol=1e-12)
    np.testing.assert_allclose(cov, Q, atol=1e-12)


def test_an_anchor_sums_up_motions():
    """Two motions since the anchor: the pose composes, the covariance is that of compounding."""
    robot = RobocentricFilter()
    first, second = np.array([0.5, 0.1, 0.8]), np.array([0.4, -0.1, -0.3])
    robot.set_anchor()
    robot.predict(first, Q)
    robot.predict(second, Q)
    moved, cov = robot.reference(ANCHOR)
    np.testing.assert_allclose(moved, compose(first, second), atol=1e-12)
    J = np.eye(3)
    J[:2, 2] = [-(compose(first, second) - first)[1], (compose(first, second) - first)[0]]
    np.testing.assert_allclose(cov, J @ Q @ J.T + rotate_cov(Q, first[2]), atol=1e-12)


def test_it_is_the_same_wherever_the_world_puts_it():
    """Landmarks forgotten and kept: what remains has the joint marginal that it had."""
    robot = RobocentricFilter()
    robot.add(WALLS, np.tile(R, (3, 1, 1)), np.ones(3))
    robot.predict(np.array([0.3, 0.0, 0.1]), Q)
    observed(robot, between(np.array([0.31, 0.01, 0.1]), WALLS), robot.landmarks)
    x, P = robot.x.copy(), robot.P.copy()
    robot.keep(np.array([0, 2]))
    at = np.r_[0:9, 12:15]
    np.testing.assert_array_equal(robot.x, x[[0, 1, 2, 4]])
    np.testing.assert_array_equal(robot.P, P[np.ix_(at, at)])


def test_errors_are_what_the_filter_says():
    """Mean NEES of the motion since the anchor over 200 seeds within the 99.8 % bounds of
    chi-square (600 degrees of freedom: 496 to 717). Breaks when a motion's noise is used twice or
    left out, or observations of one landmark are taken for independent of its own error."""
    rng, total = np.random.default_rng(0), 0.0
    for _ in range(200):
        robot, pose = RobocentricFilter(), np.zeros(3)
        robot.add(
            np.array([w + rng.multivariate_normal(np.zeros(3), R) for w in WALLS]),
            np.tile(R, (3, 1, 1)),
            np.ones(3),
        )
        robot.set_anchor()
        for _ in range(5):
            true = np.array([0.2, 0.02, 0.1])
            pose = compose(pose, true)
            robot.predict(true + rng.multivariate_normal(np.zeros(3), Q), Q)
            seen = between(pose, WALLS)
            seen = seen + rng.multivariate_normal(np.zeros(3), R, size=3)
            observed(robot, seen, robot.landmarks)
        found, cov = robot.reference(ANCHOR)
        off = found - pose
        total += off @ np.linalg.solve(cov, off)
    assert 496 < total < 717


def test_points_have_no_heading():
    robot = RobocentricFilter()
    robot.add(np.array([[2.0, 1.0, 0.0]]), np.diag([1e-4, 1e-4, 0.0])[None], np.zeros(1))
    robot.predict(np.array([0.5, 0.0, 0.3]), Q)
    assert robot.landmarks[0, 2] == 0.0
    assert not robot.blocks()[0][2].any()
    np.testing.assert_allclose(
        robot.landmarks[0, :2],
        compose(inverse(np.array([0.5, 0.0, 0.3])), np.array([2.0, 1.0, 0.0]))[:2],
        atol=1e-12,
    )


@pytest.mark.parametrize("turn", [0.0, 2.0])
def test_prediction_keeps_the_covariance_symmetric_and_positive(turn):
    robot = RobocentricFilter()
    robot.add(WALLS, np.tile(R, (3, 1, 1)), np.ones(3))
    robot.set_anchor()
    for _ in range(20):
        robot.predict(np.array([0.3, 0.0, turn]), Q)
    np.testing.assert_array_equal(robot.P, robot.P.T)
    assert np.linalg.eigvalsh(robot.P).min() > -1e-12
