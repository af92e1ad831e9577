"""Doubts about laser scans: repeated, too far apart, or against what odometry says."""

from collections.abc import Iterator

import numpy as np

from graphslam.core.geometry import between
from graphslam.slam.doubts import Reason, seconds
from graphslam.slam.evidence import Evidence, RobotEvidence

#: times that one scan is repeated while odometry moves: not just sent twice
REPEATED = 5
#: m, rad: scans that are farther apart have little in common
HOP_M, HOP_RAD = 1.2, 1.0
#: share of the path in such hops
HOPS = 0.3
#: share of motions in which scans contradict odometry, and how many of so many in a row
CONTRADICTED, IN_A_ROW, ROW = 0.12, 8, 12


def scan_doubts(evidence: Evidence) -> Iterator[Reason]:
    """What is wrong with the scans of each robot."""
    for robot in evidence.robots:
        if len(robot.scans_ns) > 2:
            yield from _repeated(robot)
            yield from _sparse(robot)
            yield from _contradictions(robot, evidence)


def _repeated(robot: RobotEvidence) -> Iterator[Reason]:
    first_ns, times = np.unique(robot.repeated_ns[:, 1], return_counts=True)
    frozen = times >= REPEATED
    if frozen.any():
        since = seconds(first_ns[frozen][0], int(robot.scans_ns[0]))
        text = (
            f"{robot.name}: its laser repeats one scan from {since} on while odometry moves: the "
            f"laser is frozen; {len(robot.repeated_ns)} scans were left out, and odometry alone "
            "tells how the robot moved"
        )
        yield Reason("doubtful", "scans", robot.name, text)


def _sparse(robot: RobotEvidence) -> Iterator[Reason]:
    near = np.searchsorted(robot.stamps_ns, robot.scans_ns)
    near = np.unique(np.clip(near, 0, len(robot.stamps_ns) - 1))
    if len(robot.scans_ns) > len(robot.stamps_ns):
        return  # more scans than poses that are compared: they are not sparse
    hops = np.abs(between(robot.by_odometry[near[:-1]], robot.by_odometry[near[1:]]))
    far = np.hypot(hops[:, 0], hops[:, 1])
    wide = (far > HOP_M) | (hops[:, 2] > HOP_RAD)
    if len(far) and far[wide].sum() > HOPS * far.sum():
        apart = float(np.median(np.diff(robot.scans_ns))) * 1e-9
        text = (
            f"{robot.name}: its scans are {apart:.1f} s and up to {far.max():.1f} m apart: they "
            "have too little in common to be matched"
        )
        yield Reason("doubtful", "scans", robot.name, text)


def _contradictions(robot: RobotEvidence, evidence: Evidence) -> Iterator[Reason]:
    motions, contradicted = len(robot.contradicted), int(robot.contradicted.sum())
    if robot.name in evidence.without_odometry or not motions:
        return
    most = int(np.convolve(robot.contradicted.astype(int), np.ones(ROW, dtype=int)).max())
    if contradicted > max(5, CONTRADICTED * motions) or most >= IN_A_ROW:
        text = (
            f"{robot.name}: its scans contradict its odometry in {contradicted} of {motions} "
            "motions; one of the two is wrong"
        )
        yield Reason("doubtful", "scans", robot.name, text)
