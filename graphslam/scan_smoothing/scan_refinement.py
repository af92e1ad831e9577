"""Motions of robots without odometry, by all their scans aligned at once.

What scan matching finds while a log is read (`odometry.laser_odometry`) is a scan against those
before it. Once loops are closed, all scans of all visits can be aligned with each other.
"""

from collections.abc import Collection, Sequence

import numpy as np

from graphslam.core.config import ScanMatchingConfig
from graphslam.core.geometry import Array, between, rotate_cov
from graphslam.core.record import replace
from graphslam.core.records import Estimate, KeyframeScan, Step, Trajectory
from graphslam.perception.scan_bundle import NOTHING, Bundle, align_all

#: m, rad: least sigma of a motion
MIN_SIGMA = 1e-4


def refine_motions(
    steps: Sequence[Step],
    estimate: Estimate,
    scans: Sequence[KeyframeScan],
    robots: Collection[str],
    config: ScanMatchingConfig,
) -> tuple[tuple[Step, ...], Estimate]:
    """Steps whose motions are those between aligned scans, and the estimate at these.

    Args:
        steps: with motions by scan matching.
        estimate: of all their states, near the truth.
        scans: seen from the states.
        robots: those without odometry.
        config: noise of points.
    """
    made = list(steps)
    states = dict(estimate.states)
    for robot in robots:
        own = [n for n, step in enumerate(steps) if robot in step.motions]
        if not own or not any(len(scan.points) for scan in scans if scan.robot == robot):
            continue
        bundle = _aligned(robot, [steps[n] for n in own], states[robot], scans, config)
        states[robot] = replace(states[robot], poses=bundle.poses)
        noise = np.linalg.inv(bundle.information + NOTHING * np.eye(3))
        for n in own:
            motion = steps[n].motions[robot]
            i, j = states[robot].index([motion.start_ns, motion.end_ns])
            seen = rotate_cov(noise[i] + noise[j], -float(bundle.poses[i, 2]))
            cov = np.linalg.inv(_information(seen) + _information(motion.cov))
            moved = replace(
                motion,
                delta=between(bundle.poses[i], bundle.poses[j]),
                cov=cov,
                d_delta_d_calibration=np.zeros_like(motion.d_delta_d_calibration),
                from_scans=True,
            )
            made[n] = replace(steps[n], motions={**steps[n].motions, robot: moved})
    return tuple(made), replace(estimate, states=states)


def _aligned(
    robot: str,
    steps: Sequence[Step],
    states: Trajectory,
    scans: Sequence[KeyframeScan],
    config: ScanMatchingConfig,
) -> Bundle:
    """The scans of a robot aligned, from its states."""
    information = np.zeros((len(states) - 1, 3, 3))
    for step in steps:
        motion = step.motions[robot]
        i = int(states.index(motion.start_ns))
        information[i] = _information(rotate_cov(motion.cov, float(states.poses[i, 2])))
    own = [scan for scan in scans if scan.robot == robot]
    count = [len(scan.points) for scan in own]
    points = np.concatenate([scan.points for scan in own]).astype(float)
    lasers = np.repeat([scan.sensor[:2] for scan in own], count, axis=0)
    scan = np.repeat(states.index([scan.time_ns for scan in own]), count)
    return align_all(points, lasers, scan, states.poses, information, config)


def _information(cov: Array) -> Array:
    """The inverse of a covariance (3, 3), which may be singular: of a robot that stands."""
    return np.asarray(np.linalg.inv(cov + MIN_SIGMA**2 * np.eye(3)))
