"""Line segments by split and merge, thesis 4.7.5-4.7.8.

A scan is cut into chains where the range jumps, chains into pieces where they bend (split), and
pieces are joined again where one line explains both (merge): the split cuts noisy walls too
often, and drop-outs or a pole in front of a wall interrupt the chain. What is left is fitted by
least squares and checked for validity.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from graphslam.core.config import FrontEndConfig
from graphslam.core.geometry import Array
from graphslam.core.records import Observation
from graphslam.perception.line_fit import LineFits, fit_lines, observations
from graphslam.perception.line_moments import fitted_lines, mean_square, point_moments
from graphslam.perception.ordered_scan import Indices, Mask, Sweep
from graphslam.perception.segment_ends import fully_visible

MISSING_BEAMS = 3
"""A chain bridges so many missing returns; how far apart the returns are is another test."""

STEP_GROWTH = 4.0
"""A wall at grazing incidence: from one return to the next the distance grows by less than this."""

MERGE_GATE = 13.82
"""Chi-square, two degrees of freedom, 99.9 %: pieces of one wall differ by no more."""


@dataclass(frozen=True, slots=True, eq=False)
class Pieces:
    """Runs of returns: ``first`` and ``last`` (p,) row of `Sweep.points`, both included.

    Neighbours in one chain share a return. ``moments`` (6, p): sums of 1, x, y, x², xy, y².
    """

    first: Indices
    last: Indices
    moments: Array

    def __getitem__(self, rows: slice | Indices | Mask) -> "Pieces":
        return Pieces(self.first[rows], self.last[rows], self.moments[:, rows])


@dataclass(frozen=True, slots=True, eq=False)
class Segments:
    """Segments (m) of one scan in the order of the beams, counter-clockwise.

    ``rows``: the rows of `Sweep.points` of all of them, one after the other; ``starts`` (m,) where
    each begins in it. ``whole`` (m,): both ends are real. ``valid`` (m,): long and straight enough.
    """

    rows: Indices
    starts: Indices
    fits: LineFits
    whole: Mask
    valid: Mask


def segments(sweep: Sweep, config: FrontEndConfig) -> tuple[Observation, ...]:
    """Line segments of one scan, thesis 4.7.5-4.7.8.

    Args:
        sweep: one scan, in order.
        config: thresholds and noise.

    Returns:
        Observations in the order of the beams, counter-clockwise, laser frame: ``segment`` where
        both ends of the wall were seen, else ``line``.
    """
    found = find_segments(sweep, config)
    if found is None:
        return ()
    return observations(found.fits[found.valid], found.whole[found.valid], config)


def find_segments(sweep: Sweep, config: FrontEndConfig) -> Segments | None:
    """What `segments` observes, with the returns it is made of; None where there is nothing."""
    moments = point_moments(sweep.points)
    pieces = _split(sweep, moments, config)
    # Twice: what does not belong to a wall but stands before it keeps the wall's parts from being
    # neighbours, and can be told from small pieces of a wall only when those have been joined.
    pieces = _merge(pieces, sweep, moments, config)
    pieces = pieces[pieces.moments[0] >= fewest_points(config)]
    pieces = _merge(pieces, sweep, moments, config)
    if not len(pieces.first):
        return None
    rows, starts = _members(pieces, sweep, moments, config)
    if not len(starts):
        return None
    fits = fit_lines(sweep.points[rows], starts, config)
    stops = np.append(starts[1:], len(rows)) - 1
    whole = fully_visible(sweep, sweep.beam[rows[starts]], sweep.beam[rows[stops]], fits, config)
    return Segments(rows, starts, fits, whole, valid_lines(fits, config))


def valid_lines(fits: LineFits, config: FrontEndConfig) -> Mask:
    """(m,) True where a line is long enough and its points scatter no more than allowed."""
    return (fits.length >= config.min_length_m) & (fits.rms <= allowed_rms(config))


def fewest_points(config: FrontEndConfig) -> int:
    """At least two, for a direction, beside the two end points that `_members` doubts."""
    return max(config.min_points, 4)


def allowed_rms(config: FrontEndConfig) -> float:
    """Root mean square deviation from one line, m, that goes with a largest one of split_m."""
    return max(config.split_m, 1e-4) / 2  # it is divided by, and rounding must pass


def _misfit(pieces: Array, unions: Array, config: FrontEndConfig) -> Array:
    """How badly one line explains two neighbouring pieces (p - 1,); 1 is the limit.

    The union may scatter as a segment may, with leave for the scatter of a small sample. That
    alone would let a step of 2 split_m pass as one tilted line; so for each piece the part of its
    deviation that its own line does not have is limited too: n times it is chi-square with two
    degrees of freedom where the walls are one, plus what a wall that is not flat brings.

    Args:
        pieces: (6, p), moments.
        unions: (6, p - 1), moments of each two neighbours together.
        config: ``split_m`` and ``range_sigma_m``.
    """
    p = pieces.shape[1]
    everything = np.concatenate((pieces, unions), axis=1)
    lines = fitted_lines(everything)
    own = mean_square(lines, everything)
    line = lines[:, p:]
    rms_sq = allowed_rms(config) ** 2
    misfit = own[p:] / (rms_sq * (1 + 2 * np.sqrt(2 / unions[0])))
    allowed = rms_sq / 4 + MERGE_GATE * config.range_sigma_m**2 / pieces[0]
    for side in (slice(None, -1), slice(1, None)):
        excess = mean_square(line, pieces[:, side]) - own[:p][side]
        misfit = np.maximum(misfit, excess / allowed[side])
    return np.asarray(misfit)


def _chain_starts(sweep: Sweep, config: FrontEndConfig) -> Indices:
    """Rows of the returns that begin a chain: thesis 4.7.5, range discontinuities.

    At grazing incidence the returns of one wall are as far apart as different things are. A step
    that goes straight on from the one before it, or into the one after it, is therefore no
    discontinuity.
    """
    x, y = sweep.points.T
    dx, dy = x[1:] - x[:-1], y[1:] - y[:-1]
    length = np.sqrt(dx * dx + dy * dy)
    r = sweep.ranges[sweep.beam]
    cut = length > config.gap_m + config.gap_ratio * np.minimum(r[1:], r[:-1])
    aside = np.abs(dx[:-1] * dy[1:] - dy[:-1] * dx[1:])  # how far off straight, times the base
    ahead = dx[:-1] * dx[1:] + dy[:-1] * dy[1:] > 0
    into, out_of = length[:-1], length[1:]
    cut[1:] &= ~(ahead & (aside < config.split_m * into) & (out_of < STEP_GROWTH * into))
    cut[:-1] &= ~(ahead & (aside < config.split_m * out_of) & (into < STEP_GROWTH * out_of))
    cut |= sweep.beam[1:] - sweep.beam[:-1] > MISSING_BEAMS + 1
    return np.concatenate(([0], np.flatnonzero(cut) + 1))


def _split(sweep: Sweep, moments: Array, config: FrontEndConfig) -> Pieces:
    """Pieces within split_m of the chord between their ends: thesis 4.7.6, steps 0 to 3.

    Douglas and Peucker's recursion is the thesis' split; OpenCV has it.
    """
    starts = _chain_starts(sweep, config)
    stops = np.append(starts[1:], len(sweep.beam))
    points = sweep.points.astype(np.float32)
    # OpenCV 5.0.0 returns (n, 1, 2), other 5.x builds (n, 2)
    chains = [
        cv2.approxPolyDP(points[i:j], config.split_m, False).reshape(-1, 2)
        for i, j in zip(starts.tolist(), stops.tolist(), strict=True)
        if j - i >= 3
    ]
    if not chains:
        none = np.zeros(0, dtype=np.intp)
        return Pieces(none, none, np.zeros((6, 0)))
    # Vertices are copies of points, to the bit: x and y read as one integer tell which.
    key, vertex_key = points.view(np.int64)[:, 0], np.concatenate(chains).view(np.int64)[:, 0]
    order = np.argsort(key)
    vertex = order[np.searchsorted(key, vertex_key, sorter=order)]
    chain = np.repeat(np.arange(len(chains)), [len(c) for c in chains])
    same = chain[1:] == chain[:-1]
    first, last = vertex[:-1][same], vertex[1:][same]
    sums = np.cumsum(moments, axis=1)
    return Pieces(first, last, sums[:, last] - sums[:, first] + moments[:, first])


def _merge(pieces: Pieces, sweep: Sweep, moments: Array, config: FrontEndConfig) -> Pieces:
    """Neighbours joined while their union's line fits each of the two: thesis 4.7.6.

    Of two unions that share a piece the better one comes first, so the result does not depend on
    the direction of the scan.
    """
    while len(pieces.first) > 1:
        a, b = pieces[:-1], pieces[1:]
        shared = a.last == b.first
        union = a.moments + b.moments - shared * moments[:, b.first]
        cost = _misfit(pieces.moments, union, config)
        cost[cost > 1] = np.inf
        for i in np.flatnonzero(np.isfinite(cost) & ~shared).tolist():
            if not _bridged(pieces, i, sweep, config):
                cost[i] = np.inf
        padded = np.concatenate(([np.inf], cost, [np.inf]))
        join = np.flatnonzero((cost < padded[:-2]) & (cost <= padded[2:]))
        if not len(join):
            break
        last, total = pieces.last.copy(), pieces.moments.copy()
        last[join], total[:, join] = b.last[join], union[:, join]
        keep = np.ones(len(last), dtype=np.bool_)
        keep[join + 1] = False
        pieces = Pieces(pieces.first, last, total)[keep]
    return pieces


def _bridged(pieces: Pieces, i: int, sweep: Sweep, config: FrontEndConfig) -> bool:
    """Whether pieces i and i + 1, on one line, are one wall though a stretch between is not seen.

    Not if the stretch is longer than the shorter part, or if a beam went through it (a door).
    """
    rows = pieces.first[i], pieces.last[i], pieces.first[i + 1], pieces.last[i + 1]
    a0, a1, b0, b1 = sweep.points[rows, :].tolist()
    if math.dist(a1, b0) > max(config.gap_m, min(math.dist(a0, a1), math.dist(b0, b1))):
        return False
    between = slice(sweep.beam[rows[1]] + 1, sweep.beam[rows[2]])
    # seen counter-clockwise a wall has the sensor on its left, and what lies behind on its right
    r, angle = sweep.ranges[between], sweep.angles[between]
    wall = math.atan2(b1[1] - a0[1], b1[0] - a0[0])
    left = r * np.sin(angle - wall) - (a0[1] * math.cos(wall) - a0[0] * math.sin(wall))
    return not np.any(left < -2 * config.split_m)  # missing returns, NaN, compare False


def _members(
    pieces: Pieces, sweep: Sweep, moments: Array, config: FrontEndConfig
) -> tuple[Indices, Indices]:
    """Rows of the returns of each segment, one after the other, and where each begins.

    Returns farther than split_m from the segment's line are left out: a pole before the wall, and
    mixed pixels. The line is taken without the end points, which are the doubtful ones; one that
    two pieces share goes to the line that it is closer to. Segments with too few are dropped.
    """
    inner = pieces.moments - moments[:, pieces.first] - moments[:, pieces.last]
    line = fitted_lines(inner)
    counts = pieces.last - pieces.first + 1
    owner = np.repeat(np.arange(len(counts)), counts)
    rows = np.arange(len(owner)) + (pieces.first + counts - np.cumsum(counts))[owner]
    square = (line[:, owner] * moments[:, rows]).sum(axis=0)
    near = square <= config.split_m**2
    shared = np.flatnonzero(rows[1:] == rows[:-1])
    near[np.where(square[shared] <= square[shared + 1], shared + 1, shared)] = False
    size = np.bincount(owner[near], minlength=len(counts))
    near &= (size >= fewest_points(config))[owner]
    rows, owner = rows[near], owner[near]
    starts = np.flatnonzero(owner[1:] != owner[:-1]) + 1
    return rows, np.concatenate(([0], starts)) if len(rows) else starts
