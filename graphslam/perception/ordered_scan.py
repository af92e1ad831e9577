"""A scan in a standard order: beams counter-clockwise, usable returns as points."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from graphslam.core.geometry import Array, polar_points, transform
from graphslam.core.record import replace
from graphslam.core.records import Scan
from graphslam.perception.line_moments import point_moments

Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Sweep:
    """Scans with their beams counter-clockwise, so that every wall has the sensor on its left.

    Mostly one; several of them one after the other are worked on at once (`join_sweeps`).

    ``ranges`` (n,) m, NaN for a missing return, and ``angles`` (n,) rad are of all beams.
    ``points`` (k, 2) m, laser frame, are the returns that lines may be fitted to, and ``beam``
    (k,) their beams. ``step_rad`` > 0 is the angle between beams; ``starts`` (s,) are the first
    beams of the scans.
    """

    ranges: Array
    angles: Array
    beam: Indices
    points: Array
    step_rad: float
    starts: Indices = field(default_factory=lambda: np.zeros(1, dtype=np.intp))

    @cached_property
    def moments(self) -> Array:
        """(6, k): `point_moments` of ``points``."""
        return point_moments(self.points)

    @cached_property
    def scan_of_beam(self) -> Indices:
        """(n,): which of the scans each beam belongs to."""
        return _repeated(self.starts, len(self.ranges))

    @cached_property
    def scan(self) -> Indices:
        """(k,): which of the scans each point belongs to."""
        return self.scan_of_beam[self.beam]


def _repeated(starts: Indices, total: int) -> Indices:
    """0, 1, ... (total,), each from its place in ``starts`` up to the next."""
    return np.repeat(np.arange(len(starts)), np.diff(starts, append=total))


def join_sweeps(sweeps: Sequence[Sweep]) -> Sweep:
    """Scans of one laser, all with the same angle between beams, as one; at least one scan."""
    starts = np.cumsum([0, *(len(s.ranges) for s in sweeps[:-1])])
    return Sweep(
        np.concatenate([s.ranges for s in sweeps]),
        np.concatenate([s.angles for s in sweeps]),
        np.concatenate([s.beam + start for s, start in zip(sweeps, starts, strict=True)]),
        np.concatenate([s.points for s in sweeps]),
        sweeps[0].step_rad,
        starts,
    )


def make_sweep(scan: Scan, max_range_m: float) -> Sweep:
    """The scan's beams in counter-clockwise order and its returns nearer than ``max_range_m``."""
    ranges, angles = scan.ranges, scan.angles
    if scan.angle_step_rad < 0:
        ranges, angles = ranges[::-1], angles[::-1]
    step = abs(scan.angle_step_rad)
    if len(ranges) * step > 2 * np.pi - 0.5 * step:
        ranges, angles = _open_circle(ranges, angles)
    with np.errstate(invalid="ignore"):
        ranges = np.where((ranges > 0) & np.isfinite(ranges), ranges, np.nan)
        beam = np.flatnonzero(ranges < max_range_m)  # at the maximum a laser saturates
    return Sweep(ranges, angles, beam, polar_points(ranges[beam], angles[beam]), step)


def _open_circle(ranges: Array, angles: Array) -> tuple[Array, Array]:
    """A full circle cut at its largest jump in range: its own seam may cut a wall in two."""
    known = np.nan_to_num(ranges, nan=0.0, posinf=0.0, neginf=0.0)
    start = int(np.argmax(np.abs(known - np.roll(known, 1))))
    return np.roll(ranges, -start), np.roll(angles, -start)


def beam_step(scan: Scan, most: int) -> int:
    """Every how many beams one is left of a scan if at most so many are."""
    return max(-(-len(scan.ranges) // most), 1)


def thinned(scan: Scan, most: int) -> Scan:
    """A scan of which only each second, third, ... beam is left, at most so many."""
    every = beam_step(scan, most)
    if every == 1:
        return scan
    # the beam that was measured at the time of the scan stays
    first = (len(scan.ranges) - 1) % every if scan.beam_period_s < 0 else 0
    return replace(
        scan,
        ranges=scan.ranges[first::every],
        angle_min_rad=scan.angle_min_rad + first * scan.angle_step_rad,
        angle_step_rad=every * scan.angle_step_rad,
        beam_period_s=every * scan.beam_period_s,
        bearings=None if scan.bearings is None else scan.bearings[first::every],
    )


def scan_points(scan: Scan, max_range_m: float) -> Array:
    """Returns nearer than ``max_range_m``: (n, 2), m, robot's base frame, in the scan's order."""
    with np.errstate(invalid="ignore"):
        kept = (scan.ranges > 0) & (scan.ranges < max_range_m)
    return transform(scan.mount, polar_points(scan.ranges[kept], scan.angles[kept]))
