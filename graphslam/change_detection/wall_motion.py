"""Displacement of straight objects: walls, doors, boards.

The pieces of a segment determine its motion across itself and its rotation. Its motion along itself
is determined by its ends only, and only if beams passed beyond them.
"""

from dataclasses import dataclass

import numpy as np

from graphslam.change_detection.beam_evidence import MIN_COSINE, BeamEvidence
from graphslam.change_detection.rigid_registration import Registration
from graphslam.change_detection.shapes import (
    PIECES_PER_WINDOW,
    UNCHANGED_SIGMAS,
    Displacement,
    MotionSettings,
    Shape,
    is_straight,
    near_segment,
    shape_of_rows,
)
from graphslam.change_detection.surface_map import Surface
from graphslam.change_detection.visit import Visit
from graphslam.core.geometry import (
    Array,
    compose,
    compose_jacobians,
    inverse,
    rotate_cov,
    transform,
    wrap,
)

#: segments may be the same one if their lengths differ by less than this, m; segments shorter than
#: _MIN_LENGTH_M are too ambiguous
_LENGTH_TOLERANCE_M, _MIN_LENGTH_M = 0.12, 0.48
#: pieces within this distance of a landmark, m, with normals within this cosine of its own, belong
#: to it; they may extend beyond its ends by _EXTENSION_M
_NEAR_M, _PARALLEL_COSINE, _EXTENSION_M = 0.08, 0.95, 0.15
#: an end is observed if at least so many beams pass it within this distance, m
_BEYOND_M, _MIN_BEAMS = 0.25, 3
#: largest share of unchanged pieces of a segment that moved
_MAX_UNCHANGED = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class WallSegment:
    """A straight shape: pose (3,) of its middle, x along it, y towards the laser; length, m.

    ``cov`` (3, 3) of the pose in its own axes, without the effect of the material's range bias:
    ``bias`` (3,) is the derivative of the pose by that.
    """

    pose: Array
    length: float
    cov: Array
    bias: Array

    @property
    def ends(self) -> Array:
        """World points (2, 2) m."""
        half = np.array([[-self.length / 2, 0.0], [self.length / 2, 0.0]])
        return transform(self.pose, half)


def fit_wall_segment(shape: Shape, cell_m: float) -> WallSegment:
    """The segment through a straight shape's pieces, of size ``cell_m``, fitted by least squares.

    Returns at an end are not used, as they may be mixed pixels. The true end lies beyond the last
    piece by up to a beam's spacing and a cell, uniformly distributed.
    """
    middle, n = shape.points.mean(axis=0), shape.normals.mean(axis=0)
    along = np.linalg.eigh(np.cov(shape.points.T))[1][:, 1]
    if along[0] * n[1] - along[1] * n[0] < 0:
        along = -along
    across = np.array([-along[1], along[0]])
    d = shape.points - middle
    t, e = d @ along, d @ across
    first, last = int(t.argmin()), int(t.argmax())
    half = (t[first] + t[last]) / 2
    # least squares of offset and direction about the middle
    H = np.column_stack([np.ones_like(t), t - half])
    W = 1 / (PIECES_PER_WINDOW * shape.white)
    P = np.linalg.inv(H.T @ (W[:, None] * H))
    gain = P @ (H * W[:, None]).T
    offset, turn = gain @ e
    common = gain @ np.sqrt(shape.common)
    cov = np.zeros((3, 3))
    cov[1:, 1:] = P + np.outer(common, common)
    unknown = shape.spacing_m[[first, last]] + cell_m
    cov[0, 0] = float(unknown @ unknown) / 12 / 4
    at = middle + half * along + offset * across
    heading = float(np.arctan2(along[1], along[0]) + turn)
    # a bias of the ranges moves the segment back, times the cosine of incidence
    return WallSegment(
        np.array([*at, wrap(heading)]), float(t[last] - t[first]), cov,
        np.array([0.0, *-(gain @ shape.incidence)]),
    )  # fmt: skip


def motion_between_segments(
    a: WallSegment, b: WallSegment, settings: MotionSettings
) -> Displacement:
    """The motion that takes a to b; of the bias only the difference between the visits counts."""
    bias = settings.bias_m * (b.bias - a.bias)
    cov = a.cov + b.cov + np.outer(bias, bias)
    cov[1, 1] += settings.repeatability_m**2
    back = inverse(a.pose)
    F, _ = compose_jacobians(b.pose, back)
    return Displacement(compose(b.pose, back), F @ rotate_cov(cov, b.pose[2]) @ F.T)


def straight_motion(
    a: Shape, b: Shape, settings: MotionSettings
) -> tuple[float, Displacement] | None:
    """Similarity 0..1 of two straight shapes and the motion.

    None if their lengths differ, or different faces of a thing were seen.
    """
    one, other = fit_wall_segment(a, settings.cell_m), fit_wall_segment(b, settings.cell_m)
    motion = motion_between_segments(one, other, settings)
    if not _same_length(one, other) or not motion.is_plausible:
        return None
    return min(one.length, other.length) / max(one.length, other.length), motion


def _same_length(a: WallSegment, b: WallSegment) -> bool:
    return (
        abs(a.length - b.length) < _LENGTH_TOLERANCE_M and min(a.length, b.length) > _MIN_LENGTH_M
    )


def segment_motions(
    registration: Registration,
    surfaces: tuple[Surface, Surface],
    visits: tuple[Visit, Visit],
    evidence: tuple[BeamEvidence, BeamEvidence],
    settings: MotionSettings,
    sigma: float,
) -> list[tuple[Array, Array, Displacement]]:
    """Line landmarks that both maps have with the same length, but at different poses.

    Those that face another way are other faces, of that object or of another. An object that moved
    by less than its size occludes its old place, so no beam shows that it has left: this way its
    motion is found nevertheless. ``surfaces``, ``visits`` and ``evidence`` are
    those of `AlignedVisits`; landmarks are in each map's own frame. ``sigma``: see
    `graphslam.change_detection.beam_evidence.null_sigma`.

    Returns:
        Per moved segment its ends (2, 2) m before and after, and its displacement.
    """
    sides: list[list[WallSegment]] = []
    for k, frame in enumerate((np.zeros(3), registration.pose)):
        matched = set(registration.matched[:, k].tolist())
        found = [
            _segment_at(transform(frame, m.extent), surfaces[k], visits[k], evidence[k], sigma)
            for i, m in enumerate(visits[k].landmarks)
            if m.line is not None and i not in matched
        ]
        sides.append([s for s in found if s is not None])
    pairs = []
    for i, a in enumerate(sides[0]):
        for j, b in enumerate(sides[1]):
            distance = float(np.hypot(*(b.pose[:2] - a.pose[:2])))
            motion = motion_between_segments(a, b, settings)
            alike = _same_length(a, b) and motion.is_plausible
            if alike and distance < settings.max_displacement_m:
                pairs.append((abs(a.length - b.length) + 0.1 * distance, i, j, motion))
    moved, taken = [], (set[int](), set[int]())
    for _, i, j, motion in sorted(pairs, key=lambda pair: pair[:3]):
        if i not in taken[0] and j not in taken[1]:
            taken[0].add(i)
            taken[1].add(j)
            moved.append((sides[0][i].ends, sides[1][j].ends, motion))
    return moved


def _segment_at(
    ends: Array, surface: Surface, visit: Visit, evidence: BeamEvidence, sigma: float
) -> WallSegment | None:
    """The segment of a visit's surface at a line of its map, if it moved and its ends were seen."""
    along = (ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0]))
    extended = ends + _EXTENSION_M * np.array([-along, along])
    parallel = np.abs(surface.normals @ np.array([-along[1], along[0]])) > _PARALLEL_COSINE
    near = near_segment(surface.points, extended, _NEAR_M)
    rows = near[(surface.good & parallel)[near]]
    if len(rows) * surface.nearest.grid.cell_m < _MIN_LENGTH_M:
        return None
    shape = shape_of_rows(surface, visit, rows)
    unchanged = evidence.tested[rows] & (evidence.scores(sigma)[rows] < UNCHANGED_SIGMAS)
    if unchanged.mean() > _MAX_UNCHANGED or not is_straight(shape):
        return None
    segment = fit_wall_segment(shape, surface.nearest.grid.cell_m)
    return segment if ends_observed(segment, visit) else None


def ends_observed(segment: WallSegment, visit: Visit) -> bool:
    """Whether beams of a visit pass closely beyond both ends of a segment."""
    beams = np.nonzero(visit.surface)[0]
    heading = visit.headings(beams) - segment.pose[2]
    away = transform(inverse(segment.pose), visit.poses[visit.scan[beams], :2])
    sine = np.sin(heading)
    steep = np.abs(sine) > MIN_COSINE
    reach = -away[:, 1] / np.where(steep, sine, 1.0)
    at = away[:, 0] + reach * np.cos(heading)
    through = steep & (reach > 0) & (visit.range_m[beams] > reach + _BEYOND_M)
    beyond = np.abs(at) - segment.length / 2
    through &= (beyond > 0) & (beyond < _BEYOND_M)
    return min(int((through & (at < 0)).sum()), int((through & (at > 0)).sum())) >= _MIN_BEAMS
