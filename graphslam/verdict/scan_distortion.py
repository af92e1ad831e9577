"""Whether the walls of a scan are turned against each other, and as by what.

Beams that are measured one after the other while a robot turns, but are taken as if at once, show
walls that are seen late in the sweep turned against those that are seen early: by the turning rate
times the time in between. Beams that are farther apart than is stated turn them by the angle
between them times the error of the spacing, whether the robot turns or not. Nothing else does
either: an error of the pose turns all walls alike.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, inverse, transform, wrap
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, Estimate, KeyframeScan
from graphslam.odometry.preintegration import Track

#: scans that are looked at, at most: those in which the robot turns fastest
MOST_SCANS = 500
#: ns: the turning rate is the mean from so long before a scan to so long after it
AROUND_NS = 50_000_000
#: rad: the model of walls is no better than this
LEAST_SIGMA = 0.01
#: pieces of walls that are enough to tell
ENOUGH = 100


class Distortion(NamedTuple):
    """How walls are turned within scans by one cause.

    ``value`` is that of the cause; it comes out too small where the map is bent with the scans.
    ``sigmas``: how many of its sigmas that is; ``share`` of the squared residuals of directions
    within scans that it explains; ``rms_rad``: how far it turns walls.
    """

    value: float = 0.0
    sigmas: float = 0.0
    share: float = 0.0
    rms_rad: float = 0.0


class ScanDistortion(NamedTuple):
    """How walls are turned within scans, by each of the causes alone.

    The value of ``sweep`` is the time in s in which the beams of a scan are measured, negative
    against their order; that of ``spacing`` by how much beams are farther apart than is stated,
    relative to that.
    """

    sweep: Distortion = Distortion()
    spacing: Distortion = Distortion()


UNDISTORTED = ScanDistortion()


def scan_distortion(
    seen: Sequence[Association],
    scans: Iterable[KeyframeScan],
    estimate: Estimate,
    track: Track,
) -> ScanDistortion:
    """How the walls that one robot saw are turned within its scans.

    Args:
        seen: what it saw, in any order.
        scans: its scans, with points in the order of the beams.
        estimate: its states and the walls.
        track: its odometry, which tells how fast it turned.
    """
    of: dict[int, list[Association]] = {}
    for a in seen:
        if a.model == "line" and a.extent is not None and a.target in estimate.landmarks:
            of.setdefault(a.time_ns, []).append(a)
    clouds = {s.time_ns: s for s in scans if len(of.get(s.time_ns, ())) > 1}
    times = np.array(sorted(clouds), dtype=np.int64)
    if sum(len(of[time]) for time in clouds) < ENOUGH:
        return UNDISTORTED
    rates = _turning_rates(times, track)
    fastest = np.sort(np.argsort(-np.abs(rates), kind="stable")[:MOST_SCANS])
    times, rates = times[fastest], rates[fastest]
    own = [of[time] for time in times.tolist()]
    found = [_where(walls, clouds[time]) for walls, time in zip(own, times.tolist(), strict=True)]
    part, angle = np.concatenate(found, axis=1)
    walls = [a for some in own for a in some]
    which = np.repeat(np.arange(len(own)), [len(some) for some in own])
    weight = 1 / (np.array([a.cov[2, 2] for a in walls]) + LEAST_SIGMA**2)
    off = _within(_direction_residuals(walls, estimate), which, weight)
    sweep, spacing = (
        _fit(_within(cause, which, weight), off, weight) for cause in (rates[which] * part, angle)
    )
    return ScanDistortion(sweep, spacing)


def by_robot(scans: Iterable[KeyframeScan]) -> Mapping[str, list[KeyframeScan]]:
    """The scans of each robot."""
    found: dict[str, list[KeyframeScan]] = {}
    for scan in scans:
        found.setdefault(scan.robot, []).append(scan)
    return found


def _turning_rates(times_ns: IntArray, track: Track) -> Array:
    """At times (n,), by odometry: (n,) rad/s."""
    begin = np.maximum(times_ns - AROUND_NS, track.times[0])
    end = np.minimum(times_ns + AROUND_NS, track.times[-1])
    turned = wrap(track.pose(end)[:, 2] - track.pose(begin)[:, 2])
    return np.asarray(turned / np.maximum(1e-9 * (end - begin), 1e-9))


def _where(walls: Sequence[Association], scan: KeyframeScan) -> Array:
    """Where in a scan the middles of its walls (k) are: (2, k) parts from 0 to 1, and rad.

    Angles are those of beams in the frame of the laser, which go on beyond a whole turn.
    """
    z = np.array([a.z for a in walls])
    along = np.array([a.extent for a in walls]).mean(axis=1)
    middle = z[:, :2] + along[:, None] * np.column_stack([np.cos(z[:, 2]), np.sin(z[:, 2])])
    apart = np.hypot(*(middle[:, None] - scan.points[None]).transpose(2, 0, 1))
    nearest = apart.argmin(axis=1)
    local = transform(inverse(scan.sensor), scan.points)
    angles = np.unwrap(np.arctan2(local[:, 1], local[:, 0]))
    return np.stack([nearest / len(scan.points), angles[nearest]])


def _direction_residuals(walls: Sequence[Association], estimate: Estimate) -> Array:
    """Expected minus measured directions of walls (n) that one robot saw: (n,) rad."""
    times = np.array([a.time_ns for a in walls], dtype=np.int64)
    there = np.array([estimate.landmarks[int(a.target)][0] for a in walls])
    poses = estimate.states[walls[0].robot].at(times)
    z = np.array([a.z for a in walls])
    return np.asarray(MODELS["line"].residual(z, poses, there)[:, 1])


def _within(values: Array, which: IntArray, weight: Array) -> Array:
    """Values (n,) less the weighted mean of those of the same scan."""
    mean = np.bincount(which, weight * values) / np.bincount(which, weight)
    return np.asarray(values - mean[which])


def _fit(turned: Array, off: Array, weight: Array) -> Distortion:
    """The value by which ``turned`` (n,) has to be multiplied to be ``off`` (n,) rad."""
    information = float(weight @ turned**2)
    before = float(weight @ off**2)
    if not information * before > 0:
        return Distortion()
    value = float(weight @ (turned * off)) / information
    after = float(weight @ (off - value * turned) ** 2)
    sigma = np.sqrt(max(after, 1e-12 * before) / len(off) / information)
    rms_rad = abs(value) * float(np.sqrt(np.mean(turned**2)))
    return Distortion(value, abs(value) / float(sigma), 1 - after / before, rms_rad)
