"""From flagged pieces of surface to changes: connected, long enough, certain enough, outlined."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.stats import norm

from graphslam.change_detection.beam_evidence import Evidence
from graphslam.change_detection.grid import Grid
from graphslam.change_detection.surface_map import WINDOW, Surface
from graphslam.change_detection.visit import Bools, Ints
from graphslam.core.config import ChangesConfig
from graphslam.core.geometry import Array

#: pieces closer than this many cells belong to one change
_JOIN_CELLS = 5


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """A connected stretch of changed surface.

    ``rows`` (k,) of the pieces, ``points`` (k, 2) m and ``normals`` (k, 2) of them, ``offset_m``
    by how much the other visit's beams went past it (cut off at the gate), ``outline`` (c, 2) m
    counter-clockwise.
    """

    rows: Ints
    points: Array
    normals: Array
    offset_m: float
    outline: Array
    probability: float
    beams: int
    first_ns: int


def flag_pieces(evidence: Evidence, spread: float, rate: float) -> Bools:
    """Pieces (n,) that beams go past: one-sided, ``rate`` of those that did not change."""
    return np.asarray(evidence.scores(spread) > norm.isf(rate))


def find_regions(
    surface: Surface,
    evidence: Evidence,
    told_by: Ints,
    told_rows: Ints,
    first_ns: Ints,
    spread: float,
    config: ChangesConfig,
) -> list[Region]:
    """The changes among the pieces of one visit's surfaces.

    A region needs `min_length_m` of pieces that no run without a change would show more often
    than `run_false_alarm_rate`: there are many places in a run to be wrong about.

    Args:
        surface: pieces.
        evidence: what the other visit's beams say about them.
        told_by: (p,) later beams that tell, with ``told_rows`` (p,) their pieces.
        told_rows: see above.
        first_ns: (n,) when a piece was first told of by the later visit.
        spread: see `graphslam.change_detection.beam_evidence.null_sigma`.
        config: settings.
    """
    # stated sigmas are a bound here: what is reported must be sure
    grid, scores = surface.nearest.grid, evidence.scores(max(spread, 1.0))
    # windows overlap, so neighbours repeat each other
    places = max(int(evidence.tested.sum()) / (2 * WINDOW + 1), 1.0)
    sure = norm.isf(0.5 * config.run_false_alarm_rate / places)
    enough = max(int(np.ceil(config.min_length_m / grid.cell_m)), 1)
    rows = np.nonzero(flag_pieces(evidence, spread, config.false_alarm_rate / 2))[0]
    label = connected_components(grid, surface.cells[rows])
    found = []
    for number in range(1, int(label.max(initial=0)) + 1):
        members = rows[label == number]
        strongest = np.sort(scores[members])[::-1]
        if len(members) < enough or strongest[enough - 1] < sure:
            continue
        beams = len(np.unique(told_by[np.isin(told_rows, members)]))
        if beams < config.min_beams:
            continue
        expected = places * norm.sf(min(float(strongest[enough - 1]), 30.0))
        found.append(
            Region(
                members,
                surface.points[members],
                surface.normals[members],
                float(np.average(evidence.offset[members])),
                outline(grid, surface.cells[members]),
                float(1 / (1 + expected)),
                beams,
                int(first_ns[members].min()),
            )
        )
    return found


def connected_components(grid: Grid, cells: Ints, join_cells: int = _JOIN_CELLS) -> Ints:
    """Label (k,) from 1 of the cluster of each cell (k,); gaps up to ``join_cells`` are closed."""
    if not len(cells):
        return np.zeros(0, dtype=np.int64)
    mask = np.zeros(grid.shape, dtype=np.uint8)
    mask.reshape(-1)[cells] = 1
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (join_cells, join_cells))
    _, label = cv2.connectedComponents(cv2.dilate(mask, disk), connectivity=8)
    return np.asarray(label.reshape(-1)[cells], dtype=np.int64)


def outline(grid: Grid, cells: Ints) -> Array:
    """Counter-clockwise polygon (c, 2) m around cells (k,), closed over gaps between them."""
    ij = np.column_stack(np.divmod(cells, grid.shape[1]))
    pad = _JOIN_CELLS + 2
    low = ij.min(axis=0) - pad
    scale = 2  # half cells: the outline may run along edges of cells
    size = (ij.max(axis=0) - low + pad + 1) * scale
    mask = np.zeros(size, dtype=np.uint8)
    at = (ij - low) * scale
    for di in range(scale):
        for dj in range(scale):
            mask[at[:, 0] + di, at[:, 1] + dj] = 1
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (4 * _JOIN_CELLS - 1,) * 2)
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, disk)
    # half a cell wider: the returns of a piece lie on both sides of it
    mask = cv2.dilate(mask, np.ones((3, 3), dtype=np.uint8))
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    largest = max(contours, key=cv2.contourArea)
    corners = cv2.approxPolyDP(largest, 1.0, closed=True).reshape(-1, 2)[:, ::-1]
    points = np.array(grid.origin_m) + (low + (corners + 0.5) / scale) * grid.cell_m
    return counter_clockwise(points)


def counter_clockwise(polygon: Array) -> Array:
    """A polygon (c, 2) m with its area on the left."""
    x, y = polygon.T
    doubled = float(x @ np.roll(y, -1) - y @ np.roll(x, -1))
    return np.asarray(polygon if doubled > 0 else polygon[::-1])
