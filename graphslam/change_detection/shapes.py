"""Things as one visit saw them: pieces of surface that hang together, and how they moved."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from graphslam.change_detection.beam_evidence import Evidence, half_beam_spacing
from graphslam.change_detection.grid import row_sums
from graphslam.change_detection.regions import connected_components
from graphslam.change_detection.surface_map import Surface
from graphslam.change_detection.visit import Ints, Visit
from graphslam.core.geometry import Array, rotation

#: pieces of surface with a score below this are where they were, in sigmas
_UNCONFIRMED = 2.0
#: a shape ends this far from what is known to have changed; gaps in it are shorter than _GAP_M: the
#: old and the new place cross where neither is known to have changed
_REACH_M, _GAP_M = 1.0, 0.3
#: beams along a surface are as far apart as if they met it at this cosine
_LEAST_COSINE = 0.2
#: how many pieces share one window; least variance of a piece's offset, m2, that is believed
PIECES_PER_WINDOW, _LEAST_VAR = 5.0, 1e-8
#: normals that differ by less than this are those of a straight stretch
_STRAIGHT = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Displacement:
    """Rigid motion (3,) of the world that takes a thing from where it was, with cov (3, 3)."""

    motion: Array
    cov: Array


@dataclass(frozen=True, slots=True)
class MotionSettings:
    """What the estimates of displacements share.

    ``bias_m``: how much too far a material may be measured; ``repeatability_m``: see
    `graphslam.change_detection.beam_evidence.repeatability`; ``cell_m``: size of a piece;
    ``max_displacement_m``: things that moved farther are not recognised.
    """

    bias_m: float
    repeatability_m: float
    cell_m: float
    max_displacement_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """What one visit saw of a thing that is not where it was, or not where it had been.

    ``points`` (k, 2) m and ``normals`` (k, 2) of pieces, pointing at who saw them; ``white`` (k,)
    m² the variance of their offsets that windows average out; ``common`` (k,) m² that of the
    poses, which one side shares; ``incidence`` (k,) mean cosine of the beams; ``spacing_m`` (k,)
    how far apart neighbouring beams of a scan met it.
    """

    points: Array
    normals: Array
    white: Array
    common: Array
    incidence: Array
    spacing_m: Array


def extract_shape(
    surface: Surface, visit: Visit, evidence: Evidence, spread: float, core: Array
) -> Shape | None:
    """The surface that hangs together with a place and that the other visit does not confirm.

    What vanished often hid a part of itself from the later visit, or what appeared hides it: a
    thing that moved by less than its size is never seen to be gone as a whole. Pieces that were
    not tested therefore belong to the shape; pieces that were found as before do not.

    Args:
        surface: of the visit that saw the shape.
        visit: that visit.
        evidence: the other visit's beams on that surface.
        spread: see `graphslam.change_detection.beam_evidence.null_sigma`.
        core: (c, 2) m, the place.

    Returns:
        None if nothing is there.
    """
    open_ = surface.good & (~evidence.tested | (evidence.scores(spread) > _UNCONFIRMED))
    rows = np.nonzero(open_)[0]
    tree = cKDTree(core)
    away = tree.query(surface.points[rows], distance_upper_bound=_REACH_M)[0]
    rows, away = rows[np.isfinite(away)], away[np.isfinite(away)]
    grid = surface.nearest.grid
    label = connected_components(grid, surface.cells[rows], int(np.ceil(_GAP_M / grid.cell_m)))
    here = away < 2 * grid.cell_m
    rows = rows[np.isin(label, label[here])]
    return shape_of_rows(surface, visit, rows) if len(rows) else None


def shape_of_rows(surface: Surface, visit: Visit, rows: Ints) -> Shape:
    """The shape that some pieces ``rows`` (k,) of a visit's surface are."""
    place = np.full(len(surface.cells), -1, dtype=np.int64)
    place[rows] = np.arange(len(rows))
    beams = np.nonzero(surface.beams >= 0)[0]
    beams = beams[place[surface.beams[beams]] >= 0]
    d, row = visit.directions[beams], place[surface.beams[beams]]
    n = surface.normals[rows]
    seen = np.column_stack([row_sums(row, d[:, k], len(rows)) for k in (0, 1)])
    n = np.where((np.einsum("ni,ni->n", n, seen) > 0)[:, None], -n, n)
    cosine = np.maximum(np.abs(np.einsum("ni,ni->n", d, n[row])), _LEAST_COSINE)
    spacing = row_sums(row, 2 * half_beam_spacing(visit) * visit.range_m[beams] / cosine, len(rows))
    white = np.maximum(surface.offset_cov[rows], _LEAST_VAR)
    return Shape(
        surface.points[rows], n, white, surface.pose_var[rows],
        surface.incidence[rows], spacing / np.maximum(np.bincount(row, minlength=len(rows)), 1),
    )  # fmt: skip


def is_straight(shape: Shape) -> bool:
    """Whether its normals all point the same way, as those of a wall do."""
    n = shape.normals
    return float(np.linalg.eigvalsh(n.T @ n / len(n))[0]) < _STRAIGHT


def moved_points(points: Array, by: Displacement) -> Array:
    """Points (n, 2) m after the motion."""
    return np.asarray(points @ rotation(by.motion[2]).T + by.motion[:2])


def near_segment(points: Array, ends: Array, within_m: float) -> Ints:
    """Which points (n, 2) m lie within a distance of the stretch between ``ends`` (2, 2) m."""
    along = ends[1] - ends[0]
    t = np.clip((points - ends[0]) @ along / float(along @ along), 0.0, 1.0)
    away = np.hypot(*(points - ends[0] - t[:, None] * along).T)
    return np.asarray(np.nonzero(away < within_m)[0])
