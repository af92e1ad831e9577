"""Doubts about the direction in which a sensor of sightings looks: its mount is turned.

Where all bearings are off by one angle, so are the headings that they tell, and nothing in the
sightings contradicts that. But then the estimated robot drives by that angle to the side of where
its odometry says. What is left here the calibration could not take up. (The mounts of lasers are
calibrated.) What it has taken up is doubted only if no sensor is so far off.
"""

from collections.abc import Iterator

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import OdometryConfig
from graphslam.core.geometry import Array, between, path_length
from graphslam.verdict.doubts import Reason
from graphslam.verdict.evidence import Evidence

#: m: pieces of the path whose directions are compared; ns: what takes longer is left out
PIECE_M, LONGEST_NS = 0.3, 3_000_000_000
#: parts of the log, whose scatter tells the sigma, and pieces that are needed: two for each part
PARTS, LEAST = 20, 40
#: rad, sigmas: an angle that is told; that of healthy simulated logs is 0.03° at most
TOLD_RAD, TOLD_SIGMAS = np.radians(1.0), 4.0
#: errors that are corrected, rad and relative, but larger than sensors have: three of the sigmas
#: that they are expected with by default
LARGE = {
    "sighting_yaw_rad": 3 * OdometryConfig.sighting_sigma_rad,
    "sighting_range_scale": 3 * OdometryConfig.sighting_scale_sigma,
}


def turned_sensor_doubts(evidence: Evidence) -> Iterator[Reason]:
    """Robots without scans whose sightings are turned against the direction in which they drive."""
    for robot in evidence.without_scans:
        found = driven_aside(*robot.seen.at_images())
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


def large_error_doubts(evidence: Evidence) -> Iterator[Reason]:
    """Sensors of sightings whose errors are corrected, but larger than they should be."""
    for name, found in evidence.summary.get("calibration", {}).items():
        sensor, _, error = name.rpartition(".")
        if abs(found["value"]) > LARGE.get(error, np.inf):
            text = (
                f"{sensor}: its sightings fit its odometry only with {error} {found['value']:.3f}: "
                "are the mount of its sensor and its units right?"
            )
            yield Reason("doubtful", "sightings", sensor, text)


def driven_aside(times_ns: IntArray, odometry: Array, poses: Array) -> tuple[float, float] | None:
    """By how much, rad, a path goes to the left of its odometry, and the sigma of that.

    Displacements are compared in the robot's own frame, so drift of the heading makes no
    difference. The sigma is that of the jackknife (B. Efron, Bootstrap methods: another look at the
    jackknife, Annals of Statistics 7, 1979, DOI 10.1214/aos/1176344552).

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
    left_out = np.angle(without)
    variance = (PARTS - 1) / PARTS * np.sum((left_out - left_out.mean()) ** 2)
    return float(np.angle(turned.sum())), float(np.sqrt(variance))


def _directions(moved: Array) -> Array:
    """Displacements of motions (n, 3) as complex numbers (n,), from the middle of their turn."""
    return np.asarray((moved[:, 0] + 1j * moved[:, 1]) * np.exp(-0.5j * moved[:, 2]))
