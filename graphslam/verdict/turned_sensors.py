"""Doubts about the direction in which a sensor of sightings looks: its mount is turned.

Where all bearings are off by one angle the map is turned about each robot's heading, and nothing in
the sightings contradicts that. But then the robot drives, as they have it, by that angle to the
side of where its odometry says. (Lasers of scans have a mount that is calibrated.)
"""

from collections.abc import Iterator

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, between, path_length
from graphslam.verdict.doubts import Reason
from graphslam.verdict.evidence import Evidence, RobotEvidence

#: m: pieces of the path whose directions are compared; ns: what takes longer is left out
PIECE_M, LONGEST_NS = 0.3, 3_000_000_000
#: the directions are averaged over so many parts of the log, from so many pieces on
PARTS, LEAST = 20, 40
#: rad, sigmas: an angle that is told; that of healthy logs is below 0.02°
TOLD_RAD, TOLD_SIGMAS = np.radians(1.0), 4.0


def turned_sensor_doubts(evidence: Evidence) -> Iterator[Reason]:
    """Robots without scans whose sightings are turned against the direction in which they drive."""
    for robot in evidence.robots:
        if len(robot.scans_ns) or robot.name in evidence.without_odometry:
            continue
        found = _driven_aside(robot)
        if found is None:
            continue
        angle, sigma = found
        if abs(angle) > max(TOLD_RAD, TOLD_SIGMAS * sigma):
            side = "left" if angle > 0 else "right"
            text = (
                f"{robot.name}: its bearings are {np.degrees(abs(angle)):.1f}° ± "
                f"{np.degrees(sigma):.1f}° too far to the {side}, by the direction in which its "
                "odometry drives: is the mount of its sensor right?"
            )
            yield Reason("doubtful", "sightings", robot.name, text)


def _driven_aside(robot: RobotEvidence) -> tuple[float, float] | None:
    """`driven_aside` between sightings of a robot; None of too little."""
    seen = robot.seen
    times, first = np.unique(seen.times_ns, return_index=True)
    return driven_aside(times, seen.odometry[first], seen.poses[first])


def driven_aside(times_ns: IntArray, odometry: Array, poses: Array) -> tuple[float, float] | None:
    """By how much, rad, a path goes to the left of its odometry, and the sigma of that.

    Both are in the robot's own frame: where its heading is off it makes no difference.

    Args:
        times_ns: (n,) ascending.
        odometry: (n, 3) poses by odometry.
        poses: (n, 3) the same as estimated.

    Returns:
        None if fewer than `LEAST` pieces of `PIECE_M` were driven.
    """
    if len(times_ns) < LEAST:
        return None
    driven = path_length(odometry)
    ends = np.unique(np.searchsorted(driven, np.arange(0.0, driven[-1], PIECE_M)))
    begin, end = ends[:-1], ends[1:]
    short = times_ns[end] - times_ns[begin] < LONGEST_NS
    begin, end = begin[short], end[short]
    if len(begin) < LEAST:
        return None
    told, own = (_directions(between(at[begin], at[end])) for at in (odometry, poses))
    turned = own * np.conj(told)
    part = np.arange(len(turned)) * PARTS // len(turned)
    without = turned.sum() - np.array([turned[part == k].sum() for k in range(PARTS)])
    left_out = np.angle(without)  # the jackknife
    variance = (PARTS - 1) / PARTS * np.sum((left_out - left_out.mean()) ** 2)
    return float(np.angle(turned.sum())), float(np.sqrt(variance))


def _directions(moved: Array) -> Array:
    """Displacements of motions (n, 3) as complex numbers (n,), from the middle of their turn."""
    return np.asarray((moved[:, 0] + 1j * moved[:, 1]) * np.exp(-0.5j * moved[:, 2]))
