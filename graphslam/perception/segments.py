"""Line segments by split and merge, thesis 4.7.5-4.7.8.

A scan is cut into chains at range discontinuities, chains into pieces where they bend (split), and
pieces are joined again where one line fits both (merge): the split cuts noisy walls too often, and
drop-outs or a pole in front of a wall interrupt the chain. The remaining pieces are fitted by least
squares and checked for validity.
"""

import math
from dataclasses import dataclass

import numpy as np

from graphslam.core.config import FrontEndConfig
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array
from graphslam.core.records import Observation
from graphslam.perception.beam_noise import largest_deviation, range_variance
from graphslam.perception.breaks import Returns, moved_breaks, without_breaks
from graphslam.perception.line_fit import LineFits, fit_lines, observations
from graphslam.perception.line_moments import fitted_lines, mean_square, mean_square_range
from graphslam.perception.ordered_scan import Indices, Mask, Sweep
from graphslam.perception.segment_ends import fully_visible
from graphslam.perception.variance_split import first_and_last, split_by_variance

MISSING_BEAMS = 3
"""Missing returns that a chain may bridge; the distance of the returns is another test."""

STEP_GROWTH = 4.0
"""Largest growth of the distance from one return to the next on a wall at grazing incidence."""

BENDS = 3.0
"""Returns so many times split_m off a line may be of a wall that bends."""

MERGE_GATE = chi2_quantile(0.999, 2)
"""Two degrees of freedom: pieces of one wall differ by no more."""


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
    each begins in it. ``whole`` (m,): both ends of the wall are visible. ``valid`` (m,): long and
    straight enough.
    """

    rows: Indices
    starts: Indices
    fits: LineFits
    whole: Mask
    valid: Mask


def segments(sweep: Sweep, config: FrontEndConfig) -> tuple[Observation, ...]:
    """Line segments of one scan, thesis 4.7.5-4.7.8, laser frame, in the order of the beams.

    Of kind ``segment`` where both ends of the wall were seen, else ``line``.
    """
    found = find_segments(sweep, config)
    return observations(found.fits[found.valid], found.whole[found.valid], config)


def find_segments(sweep: Sweep, config: FrontEndConfig) -> Segments:
    """The segments of one scan with their returns."""
    returns = _returns(sweep.moments, config)
    split = _split_scans if config.split_rule == "variance" else _split
    pieces = split(sweep, returns, config)
    # Twice: an object in front of a wall keeps the parts of the wall from being neighbours, and can
    # be distinguished from small pieces of the wall only after those have been merged.
    pieces = _merge(pieces, sweep, config)
    pieces = pieces[pieces.moments[0] >= fewest_points(config)]
    pieces = _merge(pieces, sweep, config)
    rows, counts, unbroken = _members(pieces, sweep, config)
    starts = np.cumsum(counts) - counts
    fits = fit_lines(sweep.points[rows], starts, config)
    last = starts + counts - 1
    whole = fully_visible(sweep, sweep.beam[rows[starts]], sweep.beam[rows[last]], fits, config)
    whole &= unbroken
    valid = valid_lines(fits, config)
    if config.hidden_ends == "reject":
        valid &= whole
    return Segments(rows, starts, fits, whole, valid)


def valid_lines(fits: LineFits, config: FrontEndConfig) -> Mask:
    """(m,) True where a line is long enough and its points scatter no more than allowed."""
    # points that are spread evenly
    square_range = (fits.z[:, :2] ** 2).sum(axis=1) + fits.length**2 / 12
    straight = fits.rms <= allowed_rms(config, square_range)
    return np.asarray((fits.length >= config.min_length_m) & straight)


def fewest_points(config: FrontEndConfig) -> int:
    """Fewest returns of a line: two for a direction and two end points, which may be dropped."""
    return max(config.min_points, 4)


def allowed_rms(config: FrontEndConfig, square_ranges: Array) -> Array | float:
    """Largest root mean square deviations (p,) from lines, m: half of the largest deviations.

    ``square_ranges`` (p,), m²: the means of the returns of each.
    """
    # a divisor; and rounding errors must pass
    return np.asarray(np.maximum(largest_deviation(config, square_ranges), 1e-4) / 2)


def _returns(moments: Array, config: FrontEndConfig) -> Returns:
    return Returns(moments, range_variance(config, mean_square_range(moments)))


def _misfit(pieces: Array, unions: Array, config: FrontEndConfig) -> Array:
    """Misfit of one line to two neighbouring pieces (p - 1,); 1 is the limit.

    The union may deviate as much as a segment, with an allowance for small samples. That alone
    would let a step of 2 split_m pass as one tilted line. So the excess of each piece's mean square
    deviation over that from its own line is limited too: n times it is chi-square with two degrees
    of freedom if there is one wall, plus an allowance for walls that are not flat.

    ``pieces`` (6, p) and ``unions`` of neighbours (6, p - 1) are given by their moments.
    """
    p = pieces.shape[1]
    everything = np.concatenate((pieces, unions), axis=1)
    lines = fitted_lines(everything)
    own = mean_square(lines, everything)
    line = lines[:, p:]
    rms_sq = allowed_rms(config, mean_square_range(unions)) ** 2
    misfit = own[p:] / (rms_sq * (1 + 2 * np.sqrt(2 / unions[0])))
    allowed = MERGE_GATE * range_variance(config, mean_square_range(pieces)) / pieces[0]
    for side in (slice(None, -1), slice(1, None)):
        excess = mean_square(line, pieces[:, side]) - own[:p][side]
        misfit = np.maximum(misfit, excess / (rms_sq / 4 + allowed[side]))
    return np.asarray(misfit)


def _chain_starts(sweep: Sweep, config: FrontEndConfig) -> Indices:
    """Rows of the returns that begin a chain: thesis 4.7.5, range discontinuities.

    At grazing incidence the returns of one wall are as far apart as different objects are. A step
    that is collinear with the one before or after it is therefore no discontinuity.
    """
    x, y = sweep.points.T
    dx, dy = x[1:] - x[:-1], y[1:] - y[:-1]
    length = np.sqrt(dx * dx + dy * dy)
    r = sweep.ranges[sweep.beam]
    cut = length > config.gap_m + config.gap_ratio * np.minimum(r[1:], r[:-1])
    aside = np.abs(dx[:-1] * dy[1:] - dy[:-1] * dx[1:])  # deviation from collinear, times the base
    ahead = dx[:-1] * dx[1:] + dy[:-1] * dy[1:] > 0
    into, out_of = length[:-1], length[1:]
    off = largest_deviation(config, x[1:-1] ** 2 + y[1:-1] ** 2)
    cut[1:] &= ~(ahead & (aside < off * into) & (out_of < STEP_GROWTH * into))
    cut[:-1] &= ~(ahead & (aside < off * out_of) & (into < STEP_GROWTH * out_of))
    cut |= sweep.beam[1:] - sweep.beam[:-1] > MISSING_BEAMS + 1
    cut |= sweep.scan[1:] != sweep.scan[:-1]
    return np.concatenate(([0], np.flatnonzero(cut) + 1))


def _pieces(returns: Returns, first: Indices, last: Indices) -> Pieces:
    return Pieces(first, last, returns.of(first, last))


def _split(sweep: Sweep, returns: Returns, config: FrontEndConfig) -> Pieces:
    """Pieces within split_m of the chord between their ends: thesis 4.7.6, steps 0 to 3.

    The thesis splits by the recursion of Douglas and Peucker. So does OpenCV, which then drops
    vertices that their neighbours make redundant; the merge step would join those pieces anyway.
    """
    import cv2  # noqa: PLC0415  (16 MB, which only scans need)

    starts = _chain_starts(sweep, config)
    stops = np.append(starts[1:], len(sweep.beam))
    points = sweep.points.astype(np.float32)
    sums = np.concatenate(([0.0], np.cumsum(sweep.moments[3] + sweep.moments[5])))
    squares = (sums[stops] - sums[starts]) / np.maximum(stops - starts, 1)
    off = np.broadcast_to(largest_deviation(config, squares), len(starts))
    # OpenCV 5.0.0 returns (n, 1, 2), other 5.x builds (n, 2)
    chains = [
        cv2.approxPolyDP(points[i:j], most, False).reshape(-1, 2)
        for i, j, most in zip(starts.tolist(), stops.tolist(), off.tolist(), strict=True)
        if j - i >= 3
    ]
    if not chains:
        none = np.zeros(0, dtype=np.intp)
        return Pieces(none, none, np.zeros((6, 0)))
    chain = np.repeat(np.arange(len(chains)), [len(c) for c in chains])
    # Vertices are bitwise copies of points: x and y read as one integer identify the point, the
    # first of its chain, as scans of a robot that stands are alike.
    own = np.flatnonzero(stops - starts >= 3)
    key, vertex_key = points.view(np.int64)[:, 0], np.concatenate(chains).view(np.int64)[:, 0]
    order = np.lexsort((np.arange(len(key)), key))
    values, rank = np.unique(key, return_inverse=True)
    place = rank[order] * len(key) + order
    wanted = np.searchsorted(values, vertex_key) * len(key) + starts[own][chain]
    vertex = order[np.searchsorted(place, wanted)]
    same = chain[1:] == chain[:-1]
    return _pieces(returns, *moved_breaks(returns, vertex[:-1][same], vertex[1:][same]))


def _split_scans(sweep: Sweep, returns: Returns, config: FrontEndConfig) -> Pieces:
    """Pieces by the variance of the deviations, beginning with whole scans: 4.7.6 as printed."""
    starts = np.flatnonzero(np.diff(sweep.scan, prepend=-1))
    ends = np.append(starts[1:], len(sweep.scan)) - 1
    most_rms = max(config.split_m, 1e-4) / 2  # whatever the noise is
    runs = [
        run
        for i, j in zip(starts.tolist(), ends.tolist(), strict=True)
        for run in split_by_variance(sweep.points, i, j, most_rms**2, fewest_points(config))
    ]
    return _pieces(returns, *first_and_last(runs))


def _merge(pieces: Pieces, sweep: Sweep, config: FrontEndConfig) -> Pieces:
    """Neighbours joined while the line through both fits each of them: thesis 4.7.6.

    Of two unions that share a piece the better one is made first, so the result does not depend on
    the direction of the scan.
    """
    while len(pieces.first) > 1:
        a, b = pieces[:-1], pieces[1:]
        shared = a.last == b.first
        union = a.moments + b.moments - shared * sweep.moments[:, b.first]
        cost = _misfit(pieces.moments, union, config)
        cost[cost > 1] = np.inf
        cost[sweep.scan[a.last] != sweep.scan[b.first]] = np.inf
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
    """Whether pieces i and i + 1, on one line, are one wall despite a gap between them.

    Not if the gap is longer than the shorter piece, or if a beam went through it (a door).
    """
    rows = pieces.first[i], pieces.last[i], pieces.first[i + 1], pieces.last[i + 1]
    a0, a1, b0, b1 = sweep.points[rows, :].tolist()
    if math.dist(a1, b0) > max(config.gap_m, min(math.dist(a0, a1), math.dist(b0, b1))):
        return False
    between = slice(sweep.beam[rows[1]] + 1, sweep.beam[rows[2]])
    # counter-clockwise, the sensor is on the left of a wall, and what lies behind on its right
    r, angle = sweep.ranges[between], sweep.angles[between]
    wall = math.atan2(b1[1] - a0[1], b1[0] - a0[0])
    left = r * np.sin(angle - wall) - (a0[1] * math.cos(wall) - a0[0] * math.sin(wall))
    # missing returns, NaN, compare False
    return not np.any(left < -2 * largest_deviation(config, r * r))


def _members(pieces: Pieces, sweep: Sweep, config: FrontEndConfig) -> tuple[Indices, Indices, Mask]:
    """Rows of the returns of each segment, one after the other, and how many each has (m,).

    Also which segments (m,) end where their pieces do.

    A piece that bends within split_m is several segments. Returns farther than split_m from the
    segment's line are left out: a pole in front of the wall, mixed pixels. The line is fitted
    without the end points, which are the doubtful ones; a return that two pieces share goes to the
    closer line. Segments with too few returns are dropped.
    """
    moments = sweep.moments
    counts = pieces.last - pieces.first + 1
    rows = np.arange(counts.sum()) + np.repeat(pieces.first + counts - np.cumsum(counts), counts)
    own = pieces.moments - moments[:, pieces.first] - moments[:, pieces.last]
    # what lies in front of a wall or behind it breaks no line; what bends it is not left out yet
    rows, counts = _near(rows, counts, own, BENDS, moments, config)
    returns = _returns(moments[:, rows], config)
    last = np.cumsum(counts) - 1
    begin, end = last - counts + 1, last
    first = begin
    if config.split_rule != "variance":  # that one is used as the thesis prints it
        first, last = without_breaks(returns, begin, end, config.floor_normal_m)
    unbroken = np.isin(first, begin) & np.isin(last, end)
    size = last - first + 1
    enough = size >= fewest_points(config)
    rows, counts = rows[np.repeat(enough, size)], size[enough]
    first, last, unbroken = first[enough], last[enough], unbroken[enough]
    fitted = returns.of(first + 1, last - 1)
    rows, counts = _near(rows, counts, fitted, 1.0, moments, config)
    enough = counts >= fewest_points(config)
    return rows[np.repeat(enough, counts)], counts[enough], unbroken[enough]


def _near(
    rows: Indices,
    counts: Indices,
    fitted: Array,
    deviations: float,
    moments: Array,
    config: FrontEndConfig,
) -> tuple[Indices, Indices]:
    """Of runs of ``rows``, ``counts`` (m,) each, those near the lines that ``fitted`` (6, m) have.

    ``deviations``: how near, in largest deviations of a return of a line. A row in two neighbouring
    runs stays in that with the closer line.
    """
    owner = np.repeat(np.arange(len(counts)), counts)
    each = moments[:, rows]
    square = (fitted_lines(fitted)[:, owner] * each).sum(axis=0)
    near = square <= (deviations * largest_deviation(config, mean_square_range(each))) ** 2
    shared = np.flatnonzero(rows[1:] == rows[:-1])
    near[np.where(square[shared] <= square[shared + 1], shared + 1, shared)] = False
    return rows[near], np.bincount(owner[near], minlength=len(counts))
