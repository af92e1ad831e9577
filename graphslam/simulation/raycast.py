"""Ray casting: exact ranges from beams to straight faces and circles, for many scans at once.

A surface is intersected only with the beams inside the angle that it subtends: in a world of 200
walls these are a few per cent of all pairs, and the cost does not grow with beams x walls. Each
pair is intersected in closed form, without approximation.
"""

from dataclasses import dataclass

import numpy as np

from graphslam.core.geometry import Array, unit_vectors
from graphslam.simulation.world import Shapes

Ints = np.ndarray[tuple[int, ...], np.dtype[np.int64]]

NO_SURFACE = -1  # surface number of a beam that met nothing
# scans x surfaces per chunk, so that its arrays fit into the processor's cache
_CHUNK = 20_000
# Faces are extended by this share of their length, so that no beam passes between adjacent ones.
_SEAM = 1e-9


@dataclass(frozen=True, slots=True)
class BeamFan:
    """Beams at ``start_rad + i step_rad``, i < count, in the laser's frame; at most one turn."""

    start_rad: float
    step_rad: float
    count: int

    @property
    def angles(self) -> Array:
        """Directions (count,), rad."""
        return np.asarray(self.start_rad + self.step_rad * np.arange(self.count), dtype=float)


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """``ranges`` (scans, beams) m, inf without a hit; ``surfaces`` (scans, beams) numbers or -1."""

    ranges: Array
    surfaces: Ints


def cast_beams(poses: Array, fan: BeamFan, shapes: Shapes, reach_m: float) -> Hits:
    """The first surface on each beam, for lasers at ``poses`` (n, 3) in the frame of ``shapes``.

    Surfaces beyond ``reach_m`` may be left out. Shapes with a leading axis of n move: those of
    scan i are ``segments[i]``, ``circles[i]``. A circle around the laser is not seen.
    """
    n, shape = len(poses), (len(poses), fan.count)
    hits = Hits(np.full(shape, np.inf), np.full(shape, NO_SURFACE, dtype=np.int64))
    size = max(1, _CHUNK // max(shapes.count, 1))
    for first in range(0, n, size):
        part = slice(first, first + size)
        segments = shapes.segments[part] if shapes.segments.ndim == 4 else shapes.segments
        circles = shapes.circles[part] if shapes.circles.ndim == 3 else shapes.circles
        here = Hits(hits.ranges[part], hits.surfaces[part])
        _cast(poses[part], fan, Shapes(segments, circles), reach_m, here)
    return hits


def nearest_hits(first: Hits, second: Hits, offset: int) -> Hits:
    """The nearer of two hits per beam; ``offset`` is added to the second's surface numbers."""
    nearer = second.ranges < first.ranges
    return Hits(
        np.where(nearer, second.ranges, first.ranges),
        np.where(nearer, second.surfaces + offset, first.surfaces),
    )


def _cast(poses: Array, fan: BeamFan, shapes: Shapes, reach_m: float, hits: Hits) -> None:
    """Write the first surface on each beam to ``hits``, which are empty."""
    ranges, surfaces = hits.ranges.reshape(-1), hits.surfaces.reshape(-1)  # views, not copies
    beams = unit_vectors(fan.angles)
    straight = shapes.segments.shape[-3]
    for place, surface, r in (
        _segments(poses, fan, beams, shapes.segments, reach_m),
        _circles(poses, fan, beams, shapes.circles, reach_m, straight),
    ):
        np.minimum.at(ranges, place, r)
        first = r == ranges[place]
        surfaces[place[first]] = surface[first]


def points_in_frames(poses: Array, points: Array) -> Array:
    """World points (..., k, 2) in the frames of ``poses`` (n, 3): (n, k, 2)."""
    c, s = np.cos(poses[:, 2])[:, None], np.sin(poses[:, 2])[:, None]
    dx, dy = points[..., 0] - poses[:, 0, None], points[..., 1] - poses[:, 1, None]
    return np.stack([c * dx + s * dy, -s * dx + c * dy], axis=-1)


def _segments(
    poses: Array, fan: BeamFan, beams: Array, segments: Array, reach_m: float
) -> tuple[Ints, Ints, Array]:
    """(beam index, surface, range) of each hit on a face; the index is into all scans, flat."""
    a = points_in_frames(poses, segments[..., 0, :])
    b = points_in_frames(poses, segments[..., 1, :])
    e = b - a
    middle, half = (a + b) / 2, np.hypot(e[..., 0], e[..., 1]) / 2
    near = np.hypot(middle[..., 0], middle[..., 1]) - half < reach_m
    scan, surface = np.nonzero(near)
    a, b, e = a[near], b[near], e[near]
    turn = np.arctan2(b[:, 1], b[:, 0]) - np.arctan2(a[:, 1], a[:, 0])
    turn -= 2 * np.pi * np.round(turn / (2 * np.pi))  # a face subtends less than half a turn
    begin = np.arctan2(a[:, 1], a[:, 0]) + np.minimum(turn, 0.0)
    pair, beam = _beams_between(fan, begin, np.abs(turn))
    d, a, e = beams[beam], a[pair], e[pair]
    # a + u e = r d
    cross_de = d[:, 0] * e[:, 1] - d[:, 1] * e[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):  # a beam along the face
        u = (a[:, 0] * d[:, 1] - a[:, 1] * d[:, 0]) / cross_de
        r = (a[:, 0] * e[:, 1] - a[:, 1] * e[:, 0]) / cross_de
        met = (u >= -_SEAM) & (u <= 1 + _SEAM) & (r > 0)
    return (scan[pair] * fan.count + beam)[met], surface[pair][met], r[met]


def _circles(
    poses: Array, fan: BeamFan, beams: Array, circles: Array, reach_m: float, offset: int
) -> tuple[Ints, Ints, Array]:
    """The same for circles (..., m, 3), whose surfaces are numbered from ``offset``."""
    c = points_in_frames(poses, circles[..., :2])
    radius = np.broadcast_to(circles[..., 2], c.shape[:2])
    distance = np.hypot(c[..., 0], c[..., 1])
    near = (distance - radius < reach_m) & (distance > radius)
    scan, surface = np.nonzero(near)
    c, radius, distance = c[near], radius[near], distance[near]
    half = np.arcsin(radius / distance)
    pair, beam = _beams_between(fan, np.arctan2(c[:, 1], c[:, 0]) - half, 2 * half)
    d, c = beams[beam], c[pair]
    along = c[:, 0] * d[:, 0] + c[:, 1] * d[:, 1]
    across = c[:, 0] * d[:, 1] - c[:, 1] * d[:, 0]
    inside = radius[pair] ** 2 - across**2
    met = (inside >= 0) & (along > 0)
    r = along[met] - np.sqrt(inside[met])
    return (scan[pair] * fan.count + beam)[met], surface[pair][met] + offset, r


def _beams_between(fan: BeamFan, begin_rad: Array, width_rad: Array) -> tuple[Ints, Ints]:
    """Pairs (sector, beam) of the beams in sectors (n,), each widened by up to one beam.

    The margin covers rounding; the exact intersection follows.
    """
    begin = np.mod(begin_rad - fan.start_rad, 2 * np.pi)
    sector = np.tile(np.arange(len(begin)), 2)
    begin = np.concatenate([begin, begin - 2 * np.pi])  # a sector may reach across the first beam
    first = np.maximum(np.floor(begin / fan.step_rad).astype(np.int64), 0)
    end = (begin + np.tile(width_rad, 2)) / fan.step_rad
    last = np.minimum(np.ceil(end).astype(np.int64), fan.count - 1)
    count = np.maximum(last - first + 1, 0)
    pairs = np.repeat(np.arange(len(count)), count)
    start = np.cumsum(count) - count
    beam = np.arange(len(pairs)) - start[pairs] + first[pairs]
    return sector[pairs], beam
