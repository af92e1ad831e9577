"""Noise of motions whose covariances are a guess: what a log shows of them."""

import numpy as np
import pytest

from graphslam.core.geometry import compose
from graphslam.core.records import Estimate, Motion, Step, Trajectory
from graphslam.slam.log_noise import MOTION, LogNoise
from graphslam.slam.motion_noise import USUAL_D2, with_shown_noise

SECOND = 10**9
STATED = np.diag([0.1, 0.1, 0.05]) ** 2
#: the log shows a fifth of these sigmas along, a half across and in heading
FACTORS = np.array([0.04, 0.25, 0.25])
SHOWN = np.diag(np.diag(STATED) * FACTORS)


def drive(off):
    """Steps and the estimate of robots r and s, whose motions are ``off`` by (n, 3)."""
    poses = [np.zeros(3)]
    for _ in off:
        poses.append(compose(poses[-1], np.array([0.5, 0.0, 0.1])))
    stamps = np.arange(len(poses)) * SECOND
    made = []
    for k, error in enumerate(off):
        delta = np.array([0.5, 0.0, 0.1]) + error
        start, end = stamps[k : k + 2].tolist()
        motion = Motion(start, end, delta, STATED, np.zeros((3, 0)), 0.5)
        made.append(Step(end, {}, {"r": motion, "s": motion}))
    path = Trajectory(stamps, np.array(poses), np.zeros((len(poses), 3, 3)))
    return tuple(made), Estimate({"r": path, "s": path}, {}, 0.0, 0)


def test_motions_get_the_variance_that_the_log_shows_and_outliers_more():
    """Breaks if a few motions far off count as sure as the rest, or make all of them unsure."""
    off = np.zeros((5, 3))
    off[2, 0] = 1.0  # fifty of the shown sigmas
    found = with_shown_noise(*drive(off), {"r": FACTORS})
    covs = np.array([step.motions["r"].cov for step in found])
    usual = np.delete(covs, 2, axis=0)
    # rounding of a square root
    assert usual == pytest.approx(np.broadcast_to(SHOWN, usual.shape), rel=1e-12)
    # the residual's squared distance, by its own covariance, is the largest usual one
    assert off[2] @ np.linalg.solve(covs[2], off[2]) == pytest.approx(USUAL_D2, rel=1e-9)
    # robots whose odometry states its noise keep it
    assert all(np.array_equal(step.motions["s"].cov, STATED) for step in found)


def test_factors_are_those_of_motions_of_the_robots_asked_for():
    """Breaks if noise that robots state is taken for measured, or that of sightings for motions."""
    noise = LogNoise(measured={(r, MOTION): FACTORS for r in "rs"} | {("t", "point"): FACTORS[:2]})
    found = noise.motion_factors(("r", "t", "u"))
    assert list(found) == ["r"]
    assert found["r"] is FACTORS
