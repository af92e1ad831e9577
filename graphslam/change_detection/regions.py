"""Connected regions of flagged pieces that are large and significant enough, with outlines."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.stats import norm

from graphslam.change_detection.beam_evidence import DOUBTFUL_SIGMA, BeamEvidence
from graphslam.change_detection.grid import Grid
from graphslam.change_detection.surface_map import WINDOW, Surface
from graphslam.change_detection.visit import Bools, Ints
from graphslam.core.config import ChangesConfig
from graphslam.core.geometry import Array

#: pieces closer than this many cells belong to one region
_JOIN_CELLS = 5


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """A connected region of changed surface.

    ``rows`` (k,) of the pieces and their ``points`` (k, 2) m; ``outline`` (c, 2) m, a
    counter-clockwise polygon; ``probability`` that it is a change; ``beams``: number of later beams
    that observed it, ``first_ns`` the first one's stamp.
    """

    rows: Ints
    points: Array
    outline: Array
    probability: float
    beams: int
    first_ns: int


def flag_pieces(evidence: BeamEvidence, sigma: float, rate: float) -> Bools:
    """Which pieces (n,) a one-sided test of false-alarm ``rate`` rejects as unchanged.

    ``sigma``: see `graphslam.change_detection.beam_evidence.null_sigma`.
    """
    return np.asarray(evidence.scores(sigma) > norm.isf(rate))


def find_regions(
    surface: Surface,
    evidence: BeamEvidence,
    beams: Ints,
    beam_rows: Ints,
    first_ns: Ints,
    sigma: float,
    config: ChangesConfig,
) -> list[Region]:
    """The regions of one visit's surfaces that changed.

    A region needs `min_length_m` of pieces whose scores a run without changes shows anywhere with a
    probability of at most `run_false_alarm_rate`: the tests of a run are many (Bonferroni).
    ``beams`` (p,) are the later beams that observed pieces, ``beam_rows`` (p,) those pieces, and
    ``first_ns`` (n,) the stamps at which the later visit first observed each piece. ``sigma``: see
    `graphslam.change_detection.beam_evidence.null_sigma`.
    """
    # not less than the stated sigmas: what is reported must be certain
    grid, scores = surface.nearest.grid, evidence.scores(max(sigma, 1.0))
    # windows overlap, so neighbours are not independent tests
    tests = max(int(evidence.tested.sum()) / (2 * WINDOW + 1), 1.0)
    significant = norm.isf(0.5 * config.run_false_alarm_rate / tests)
    enough = max(int(np.ceil(config.min_length_m / grid.cell_m)), 1)
    rows = np.nonzero(flag_pieces(evidence, sigma, config.false_alarm_rate / 2))[0]
    label = connected_components(grid, surface.cells[rows])
    found = []
    for number in range(1, int(label.max(initial=0)) + 1):
        members = rows[label == number]
        strongest = np.sort(scores[members])[::-1]
        if len(members) < enough or strongest[enough - 1] < significant:
            continue
        count = len(np.unique(beams[np.isin(beam_rows, members)]))
        if count < config.min_beams:
            continue
        expected = _expected_by_chance(
            float(strongest[enough - 1]), tests, int(evidence.tested.sum()) * grid.cell_m, sigma
        )
        found.append(
            Region(
                members, surface.points[members], outline(grid, surface.cells[members]),
                float(1 / (1 + expected)), count, int(first_ns[members].min()),
            )
        )  # fmt: skip
    return found


def _expected_by_chance(score: float, tests: float, length_m: float, sigma: float) -> float:
    """How many regions with such a score a run without changes shows.

    Of ``tests`` independent ones, on ``length_m`` of surface. Where visits disagree for a reason
    that nobody stated, scores have an unknown distribution, and a whole thing or stretch of wall,
    taken as a metre, is off alike: then that is Cantelli's bound, whatever the distribution.
    """
    if sigma < DOUBTFUL_SIGMA:
        return tests * float(norm.sf(min(score, 30.0)))
    return max(length_m, 1.0) / (1 + score**2)


def connected_components(grid: Grid, cells: Ints, join_cells: int = _JOIN_CELLS) -> Ints:
    """Labels (k,) from 1 of the clusters of cells (k,); gaps up to ``join_cells`` are bridged."""
    if not len(cells):
        return np.zeros(0, dtype=np.int64)
    mask = np.zeros(grid.shape, dtype=np.uint8)
    mask.reshape(-1)[cells] = 1
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (join_cells, join_cells))
    _, label = cv2.connectedComponents(cv2.dilate(mask, disk), connectivity=8)
    return np.asarray(label.reshape(-1)[cells], dtype=np.int64)


def outline(grid: Grid, cells: Ints) -> Array:
    """Counter-clockwise polygon (c, 2) m around cells (k,), with the gaps between them closed."""
    ij = np.column_stack(np.divmod(cells, grid.shape[1]))
    pad = _JOIN_CELLS + 2
    low = ij.min(axis=0) - pad
    mask = np.zeros(ij.max(axis=0) - low + pad + 1, dtype=np.uint8)
    mask[tuple((ij - low).T)] = 1
    scale = 2  # half cells: the outline may follow the edges of cells
    mask = mask.repeat(scale, axis=0).repeat(scale, axis=1)
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (4 * _JOIN_CELLS - 1,) * 2)
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, disk)
    # half a cell larger: the returns of a piece lie on both sides of it
    mask = cv2.dilate(mask, np.ones((3, 3), dtype=np.uint8))
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    largest = max(contours, key=cv2.contourArea)
    corners = cv2.approxPolyDP(largest, 1.0, closed=True).reshape(-1, 2)[:, ::-1]
    points = np.array(grid.origin_m) + (low + (corners + 0.5) / scale) * grid.cell_m
    return counter_clockwise(points)


def counter_clockwise(polygon: Array) -> Array:
    """The polygon (c, 2) m, reversed if it is clockwise."""
    x, y = polygon.T
    doubled = float(x @ np.roll(y, -1) - y @ np.roll(x, -1))
    return np.asarray(polygon if doubled > 0 else polygon[::-1])
