"""Motions of robots without odometry, by their scans aligned at once."""

import numpy as np
import pytest
from walls import L_ROOM, cloud

from graphslam.core.config import ScanMatchingConfig
from graphslam.core.geometry import between, compose
from graphslam.core.records import Estimate, KeyframeScan, Motion, Step, Trajectory
from graphslam.scan_smoothing.scan_refinement import refine_motions

SECOND = 10**9
STATED = np.diag([0.02, 0.02, 0.006]) ** 2
N = 12
TRUTH = np.array([compose([-2.0, -1.5, 0.4], [0.1 * k, 0.03 * k, 0.05 * k]) for k in range(N)])


def drive(cov=STATED):
    """Steps, estimate and scans of robots r and s, off by 1 cm, which see the same."""
    rng = np.random.default_rng(2)
    poses = TRUTH + rng.normal(size=TRUTH.shape) * [0.01, 0.01, 0.004]
    stamps = np.arange(N) * SECOND
    steps = []
    for k in range(N - 1):
        start, end = stamps[k : k + 2].tolist()
        motion = Motion(start, end, between(poses[k], poses[k + 1]), cov, np.ones((3, 2)), 0.1)
        steps.append(Step(end, {}, {"r": motion, "s": motion}))
    path = Trajectory(stamps, poses, np.zeros((N, 3, 3)))
    scans = [
        KeyframeScan(robot, k * SECOND, cloud(TRUTH[k], L_ROOM, rng).astype(np.float32))
        for robot in "rs"
        for k in range(N)
    ]
    return tuple(steps), Estimate({"r": path, "s": path}, {}, 0.0, 0), scans


def test_motions_are_those_between_aligned_scans():
    """Nearer to the truth, as sure as the scans are, no longer a matter of calibration. Robots that
    have odometry keep it. Breaks if motions and the estimate do not belong together."""
    steps, estimate, scans = drive()
    made, near = refine_motions(steps, estimate, scans, ("r",), ScanMatchingConfig())
    true = between(TRUTH[:-1], TRUTH[1:])
    before, after = (np.array([s.motions["r"].delta for s in one]) - true for one in (steps, made))
    assert np.abs(after).mean() < 0.5 * np.abs(before).mean()
    poses = near.states["r"].poses
    assert poses[0] == pytest.approx(estimate.states["r"].poses[0], abs=1e-6)
    for k, step in enumerate(made):
        motion = step.motions["r"]
        assert motion.delta == pytest.approx(between(poses[k], poses[k + 1]), abs=1e-12)
        assert motion.from_scans and not motion.d_delta_d_calibration.any()
        assert np.all(np.linalg.eigvalsh(STATED - motion.cov) > 0.0)
        assert step.motions["s"] is steps[k].motions["s"]
    assert near.states["s"] is estimate.states["s"]


def test_a_robot_that_stands_has_a_motion_without_noise():
    """A covariance of zero cannot be inverted."""
    made, near = refine_motions(*drive(np.zeros((3, 3))), ("r",), ScanMatchingConfig())
    assert np.isfinite(near.states["r"].poses).all()
    assert all(np.isfinite(step.motions["r"].cov).all() for step in made)


def test_without_scans_motions_stay():
    steps, estimate, _ = drive()
    scans = [KeyframeScan("s", 0, np.zeros((0, 2), dtype=np.float32))]
    for robots in ((), ("r",), ("s",)):
        made, near = refine_motions(steps, estimate, scans, robots, ScanMatchingConfig())
        assert made == steps and near.states == estimate.states
