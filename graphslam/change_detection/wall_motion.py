"""How a straight thing moved: a wall, a door, a board.

Its pieces tell how far it went across itself and how it turned; how far along itself, only its
ends tell, and only if beams were seen to pass beyond them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.change_detection.beam_evidence import Evidence
from graphslam.change_detection.rigid_registration import Registration
from graphslam.change_detection.shapes import (
    PIECES_PER_WINDOW,
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
    rotation,
    transform,
    wrap,
)
from graphslam.core.records import Landmark

#: stretches whose lengths differ by less are alike, m; shorter ones than _LEAST_M are too many
_LENGTH_M, _LEAST_M = 0.12, 0.48
#: pieces this near to a landmark, m, and facing as it does, are of it; they may be longer than it
_AT_M, _FACING, _LONGER_M = 0.08, 0.95, 0.15
#: an end is seen if so many beams pass this far beyond it at most
_BEYOND_M, _FEWEST_BEAMS, _LEAST_COSINE = 0.25, 3, 0.2
#: a piece is as it was below this many sigmas; of what moved no more than this share is
_AS_BEFORE, _MOST_AS_BEFORE = 2.0, 0.5


@dataclass(frozen=True, slots=True, eq=False)
class WallSegment:
    """A straight shape: pose (3,) of its middle, x along it, y at who saw it; its length, m.

    ``cov`` (3, 3) of the pose in its own axes, without what the material's bias does: ``bias`` (3,)
    is the pose's change per metre of it.
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
    """The straight line through a shape's pieces, from end to end.

    Returns at an end are not used, as they may be mixed pixels: how far it lies beyond the last
    piece differs by a beam's spacing and a cell, over which it is taken to be uniform.

    Args:
        shape: straight.
        cell_m: size of a piece.
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
    pulled = gain @ np.sqrt(shape.common)
    cov = np.zeros((3, 3))
    cov[1:, 1:] = P + np.outer(pulled, pulled)
    open_ = shape.spacing_m[[first, last]] + cell_m
    cov[0, 0] = float(open_ @ open_) / 12 / 4
    at = middle + half * along + offset * across
    heading = float(np.arctan2(along[1], along[0]) + turn)
    # what is measured too far lies behind, by as much as the beams met it squarely
    return WallSegment(
        np.array([*at, wrap(heading)]), float(t[last] - t[first]), cov,
        np.array([0.0, *-(gain @ shape.incidence)]),
    )  # fmt: skip


def motion_between_segments(a: WallSegment, b: WallSegment, known: MotionSettings) -> Displacement:
    """The motion that takes a to b; the bias counts as far as it differs between the visits."""
    differs = known.bias_m * (b.bias - a.bias)
    cov = a.cov + b.cov + np.outer(differs, differs)
    cov[1, 1] += known.repeatability_m**2
    R = np.eye(3)
    R[:2, :2] = rotation(b.pose[2])
    back = inverse(a.pose)
    F, _ = compose_jacobians(b.pose, back)
    return Displacement(compose(b.pose, back), F @ R @ cov @ R.T @ F.T)


def straight_motion(a: Shape, b: Shape, known: MotionSettings) -> tuple[float, Displacement] | None:
    """Of two straight shapes of the same length: how alike they are, and the motion."""
    one, other = fit_wall_segment(a, known.cell_m), fit_wall_segment(b, known.cell_m)
    if not _alike(one, other):
        return None
    share = min(one.length, other.length) / max(one.length, other.length)
    return share, motion_between_segments(one, other, known)


def _alike(a: WallSegment, b: WallSegment) -> bool:
    return abs(a.length - b.length) < _LENGTH_M and min(a.length, b.length) > _LEAST_M


def segment_motions(
    landmarks: tuple[Sequence[Landmark], Sequence[Landmark]],
    registration: Registration,
    surfaces: tuple[Surface, Surface],
    visits: tuple[Visit, Visit],
    evidence: tuple[Evidence, Evidence],
    known: MotionSettings,
    spread: float,
) -> list[tuple[Array, Array, Displacement]]:
    """Lines of the maps that are in both runs with the same length, but not in the same place.

    What moved by less than its size hides its old place, which then is nowhere seen to be gone:
    this way it is found to have moved nevertheless.

    Args:
        landmarks: of the reference and of the later map, each in its own frame.
        registration: of the two.
        surfaces: of both visits in the reference's frame.
        visits: both, in the reference's frame.
        evidence: the other visit's beams on those surfaces.
        known: how well a piece is known.
        spread: see `graphslam.change_detection.beam_evidence.null_sigma`.

    Returns:
        Per moved stretch its ends (2, 2) m before and after, and its displacement.
    """
    frames = (np.zeros(3), registration.pose)
    sides: list[list[WallSegment]] = []
    for k in (0, 1):
        matched = set(registration.matched[:, k].tolist())
        lines = [m for i, m in enumerate(landmarks[k]) if m.line is not None and i not in matched]
        found = [
            _at(transform(frames[k], m.extent), surfaces[k], visits[k], evidence[k], spread)
            for m in lines
        ]
        sides.append([s for s in found if s is not None])
    pairs = []
    for i, a in enumerate(sides[0]):
        for j, b in enumerate(sides[1]):
            way = float(np.hypot(*(b.pose[:2] - a.pose[:2])))
            if _alike(a, b) and way < known.max_displacement_m:
                pairs.append((abs(a.length - b.length) + 0.1 * way, i, j))
    moved, taken = [], (set[int](), set[int]())
    for _, i, j in sorted(pairs):
        if i not in taken[0] and j not in taken[1]:
            taken[0].add(i)
            taken[1].add(j)
            a, b = sides[0][i], sides[1][j]
            moved.append((a.ends, b.ends, motion_between_segments(a, b, known)))
    return moved


def _at(
    ends: Array, surface: Surface, visit: Visit, evidence: Evidence, spread: float
) -> WallSegment | None:
    """The stretch of a visit's surface at a line of its map; None if its ends were not seen."""
    along = (ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0]))
    longer = ends + _LONGER_M * np.array([-along, along])
    facing = np.abs(surface.normals @ np.array([-along[1], along[0]])) > _FACING
    near = near_segment(surface.points, longer, _AT_M)
    rows = near[(surface.good & facing)[near]]
    if len(rows) * surface.nearest.grid.cell_m < _LEAST_M:
        return None
    shape = shape_of_rows(surface, visit, rows)
    as_before = evidence.tested[rows] & (evidence.scores(spread)[rows] < _AS_BEFORE)
    if as_before.mean() > _MOST_AS_BEFORE or not is_straight(shape):
        return None
    found = fit_wall_segment(shape, surface.nearest.grid.cell_m)
    return found if ends_seen(found, visit) else None


def ends_seen(stretch: WallSegment, visit: Visit) -> bool:
    """Whether beams of a visit pass a little beyond both ends of a stretch."""
    beams = np.nonzero(visit.surface)[0]
    heading = visit.poses[visit.scan[beams], 2] + visit.angle[beams] - stretch.pose[2]
    away = transform(inverse(stretch.pose), visit.poses[visit.scan[beams], :2])
    sine = np.sin(heading)
    steep = np.abs(sine) > _LEAST_COSINE
    reach = -away[:, 1] / np.where(steep, sine, 1.0)
    at = away[:, 0] + reach * np.cos(heading)
    through = steep & (reach > 0) & (visit.range_m[beams] > reach + _BEYOND_M)
    beyond = np.abs(at) - stretch.length / 2
    through &= (beyond > 0) & (beyond < _BEYOND_M)
    return min(int((through & (at < 0)).sum()), int((through & (at > 0)).sum())) >= _FEWEST_BEAMS
