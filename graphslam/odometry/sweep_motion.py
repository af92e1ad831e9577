"""Scans as if all beams had been measured at once: the motion of the robot meanwhile taken out.

A mirror turns ten times a second or so, and a robot that turns at 1.5 rad/s bends a scan by 9°
meanwhile. Within a sweep the laser is taken to move at constant velocity, so beam i is measured at
the pose exp(t_i v) in the frame of the laser at the time of the scan, t_i after it.
"""

from collections.abc import Sequence

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import (
    Array,
    between,
    compose,
    exp,
    inverse,
    log,
    transform_each,
    wrap,
)
from graphslam.core.record import replace
from graphslam.core.records import Scan
from graphslam.odometry.calibration_jacobian import CalibratedSource
from graphslam.odometry.preintegration import Track


def sweep_end_ns(scan: Scan) -> int:
    """Time of the last beam that was measured."""
    last = max(len(scan.ranges) - 1, 0)
    return scan.time_ns + round(1e9 * abs(scan.beam_period_s) * last)


def undistorted_by_track(scans: Sequence[Scan], track: Track) -> list[Scan]:
    """Scans of one laser without the robot's motion during each, by its odometry."""
    found = list(scans)
    swept = [n for n, scan in enumerate(scans) if scan.beam_period_s]
    if not swept:
        return found
    begin = np.array([scans[n].time_ns for n in swept], dtype=np.int64)
    end = np.array([sweep_end_ns(scans[n]) for n in swept], dtype=np.int64)
    mounts = np.array([scans[n].mount for n in swept])
    twists = _twists(track, begin, end, mounts, scans[0].sensor)
    velocities = twists / (1e-9 * np.maximum(end - begin, 1))[:, None]
    for n, velocity in zip(swept, velocities, strict=True):
        found[n] = undistorted(scans[n], velocity)
    return found


def _twists(
    track: Track, begin_ns: IntArray, end_ns: IntArray, mounts: Array, sensor: str
) -> Array:
    """Twists (n, 3) of a laser with these mounts (n, 3), by odometry as it is calibrated now."""
    error, late_ns = track.laser(sensor)
    lasers = compose(error, mounts)
    moved = between(track.pose(begin_ns - late_ns), track.pose(end_ns - late_ns))
    if p := track.increment_parameters:
        d_cal = CalibratedSource.of(track).derivative(log(moved))
        moved = moved + d_cal @ track.calibration.mean[:p]
    return log(compose(inverse(lasers), compose(moved, lasers)))


def undistorted(scan: Scan, velocity: Array) -> Scan:
    """A scan without the motion of its laser, whose twist per second is ``velocity`` (3,)."""
    if not scan.beam_period_s:
        return scan
    n, period = len(scan.ranges), scan.beam_period_s
    seconds = period * (np.arange(n) if period > 0 else np.arange(1 - n, 1))
    angles, known = scan.angles, np.isfinite(scan.ranges)
    rays = np.column_stack([np.cos(angles), np.sin(angles)])
    points = np.where(known, scan.ranges, 0.0)[:, None] * rays
    points = transform_each(exp(seconds[:, None] * velocity), points)
    turned = angles + seconds * velocity[2]
    seen = np.arctan2(points[:, 1], points[:, 0])
    return replace(
        scan,
        ranges=np.where(known, np.hypot(*points.T), scan.ranges),
        angle_min_rad=float(turned[0]),
        angle_step_rad=scan.angle_step_rad + period * float(velocity[2]),
        beam_period_s=0.0,
        bearings=np.where(known, turned + wrap(seen - turned), turned),
    )
