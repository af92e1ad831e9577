"""Shapes: connected pieces of surface of an object that moved, as one visit observed it."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from graphslam.change_detection.beam_evidence import MIN_COSINE, BeamEvidence, half_beam_spacing
from graphslam.change_detection.grid import row_sums
from graphslam.change_detection.regions import connected_components
from graphslam.change_detection.surface_map import Surface
from graphslam.change_detection.visit import Ints, Visit
from graphslam.core.geometry import Array, wrap

#: pieces of surface with a score below this, in sigmas, did not change
UNCHANGED_SIGMAS = 2.0
#: a shape extends up to this far from its changed region, across gaps of up to _GAP_M: where the
#: old and the new pose of an object overlap, no change can be observed
_REACH_M, _GAP_M = 1.0, 0.3
#: pieces that one window spans (their offsets are correlated)
PIECES_PER_WINDOW = 5.0
#: lower bound of the variance of a piece's offset, m²
_MIN_VAR = 1e-8
#: variance of the normals below which a shape is straight
_STRAIGHT = 0.05
#: a thing that was seen from another side looks like one that was turned by more than this
_LARGEST_TURN_RAD = np.radians(60.0)


@dataclass(frozen=True, slots=True, eq=False)
class Displacement:
    """Rigid motion (3,) of the world, cov (3, 3), that takes an object to its new pose."""

    motion: Array
    cov: Array

    @property
    def is_plausible(self) -> bool:
        """Whether it turns the object by so little that both visits saw the same side of it.

        By more, most likely the object did not turn and another side of it was seen, whose place
        says nothing of the motion.
        """
        return bool(abs(wrap(self.motion[2])) < _LARGEST_TURN_RAD)


@dataclass(frozen=True, slots=True)
class MotionSettings:
    """What all estimates of displacements need.

    ``bias_m``: range bias of a material; ``repeatability_m``: see
    `graphslam.change_detection.beam_evidence.repeatability`; ``cell_m``: size of a piece;
    ``max_displacement_m``: objects that moved farther are not recognised.
    """

    bias_m: float
    repeatability_m: float
    cell_m: float
    max_displacement_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """What one visit observed of an object that moved, vanished or appeared.

    ``points`` (k, 2) m and ``normals`` (k, 2) of pieces, pointing towards the laser; ``white`` (k,)
    m², variance of their offsets due to white noise; ``common`` (k,) m², the same due to the poses,
    common to all pieces of a side; ``incidence`` (k,) mean cosine of the beams; ``spacing_m`` (k,)
    distance along the surface between neighbouring beams of a scan.
    """

    points: Array
    normals: Array
    white: Array
    common: Array
    incidence: Array
    spacing_m: Array


def extract_shape(
    surface: Surface, visit: Visit, evidence: BeamEvidence, sigma: float, core: Array
) -> Shape | None:
    """The visit's surface connected to a changed region that the other visit does not confirm.

    An object that moved by less than its size occludes a part of its old place, so no beam passes
    through that. Pieces that were not tested therefore belong to the shape; pieces that were found
    unchanged do not. None if there is no such surface.

    ``core`` (c, 2) m: points of the changed region; ``evidence``: of the other visit's beams;
    ``sigma``: see `graphslam.change_detection.beam_evidence.null_sigma`.
    """
    unconfirmed = surface.good & (~evidence.tested | (evidence.scores(sigma) > UNCHANGED_SIGMAS))
    rows = np.nonzero(unconfirmed)[0]
    away = cKDTree(core).query(surface.points[rows], distance_upper_bound=_REACH_M)[0]
    rows, away = rows[np.isfinite(away)], away[np.isfinite(away)]
    grid = surface.nearest.grid
    label = connected_components(grid, surface.cells[rows], int(np.ceil(_GAP_M / grid.cell_m)))
    here = away < 2 * grid.cell_m
    rows = rows[np.isin(label, label[here])]
    return shape_of_rows(surface, visit, rows) if len(rows) else None


def shape_of_rows(surface: Surface, visit: Visit, rows: Ints) -> Shape:
    """The shape made of some pieces, ``rows`` (k,), of a visit's surface."""
    index = np.full(len(surface.cells), -1, dtype=np.int64)
    index[rows] = np.arange(len(rows))
    beams = np.nonzero(surface.beams >= 0)[0]
    beams = beams[index[surface.beams[beams]] >= 0]
    d, row = visit.directions[beams], index[surface.beams[beams]]
    n = surface.normals[rows]
    beam_sum = np.column_stack([row_sums(row, d[:, k], len(rows)) for k in (0, 1)])
    n = np.where((np.einsum("ni,ni->n", n, beam_sum) > 0)[:, None], -n, n)
    cosine = np.maximum(np.abs(np.einsum("ni,ni->n", d, n[row])), MIN_COSINE)
    spacing = row_sums(row, 2 * half_beam_spacing(visit) * visit.range_m[beams] / cosine, len(rows))
    white = np.maximum(surface.offset_cov[rows], _MIN_VAR)
    return Shape(
        surface.points[rows], n, white, surface.pose_var[rows],
        surface.incidence[rows], spacing / np.maximum(np.bincount(row, minlength=len(rows)), 1),
    )  # fmt: skip


def is_straight(shape: Shape) -> bool:
    """Whether all normals of a shape are parallel, as those of a wall are."""
    n = shape.normals
    return float(np.linalg.eigvalsh(n.T @ n / len(n))[0]) < _STRAIGHT


def near_segment(points: Array, ends: Array, within_m: float) -> Ints:
    """Indices (k,) of the points (n, 2) m within a distance of the segment ``ends`` (2, 2) m."""
    along = ends[1] - ends[0]
    t = np.clip((points - ends[0]) @ along / float(along @ along), 0.0, 1.0)
    away = np.hypot(*(points - ends[0] - t[:, None] * along).T)
    return np.asarray(np.nonzero(away < within_m)[0])
