"""Lines by the range-weighted Hough transform, thesis 4.7.1-4.7.4.

Every return votes for the lines that it may lie on; the line with most votes is extracted, its
returns stop voting, and so on. A wall seen in pieces, behind objects or on both sides of a door, is
ONE line: its pieces vote together.

The grid is coarse, so a peak is only the seed of a line: returns close to the line fitted so far
are added until nothing changes, so the line grows along the wall. Returns are added in runs, and
each run must fit the line: the front of a cupboard does not become a part of the wall beside it.
"""

import math

import numpy as np

from graphslam.core.config import FrontEndConfig
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array
from graphslam.core.records import Observation
from graphslam.perception.beam_noise import largest_deviation, range_variance
from graphslam.perception.hough_votes import HOUGH_VOTES, SEED_POINTS
from graphslam.perception.line_fit import fit_lines, observations
from graphslam.perception.line_moments import (
    fitted_line,
    fitted_lines,
    mean_square,
    mean_square_range,
)
from graphslam.perception.ordered_scan import Indices, Mask, Sweep
from graphslam.perception.segments import MISSING_BEAMS, allowed_rms, fewest_points, valid_lines

RUN_POINTS = 3
"""Fewest returns of a run: one or two are where another wall crosses the line."""

BLOCK_POINTS = 16
"""Runs are tested in blocks of at most so many returns: a bent run fits even its own line badly,
but each of its blocks shows how far it is off the common line."""

RUN_GATE = chi2_quantile(0.9999, 2)
"""Two degrees of freedom. A line has many blocks, and one that is rejected wrongly may come back as
a second line of the same wall."""

FLATNESS = 1 / 8
"""Largest excess of a run's mean square deviation from the line over that from its own line, as a
share of what a segment may have, besides noise: walls of several materials, doors in frames."""

ROUNDS = 8
"""Largest number of fits while a line grows; three are usual."""


def hough_lines(sweep: Sweep, config: FrontEndConfig) -> tuple[Observation, ...]:
    """Hough lines of one scan, laser frame, all of kind ``line``, the one with most votes first.

    ``extent`` reaches from the first to the last return.
    """
    free = np.ones(len(sweep.beam), dtype=np.bool_)
    return line_observations(sweep, *find_lines(sweep, free, config), config)[0]


def line_observations(
    sweep: Sweep, rows: Indices, starts: Indices, config: FrontEndConfig
) -> tuple[tuple[Observation, ...], Indices]:
    """Observations of kind ``line`` of the valid lines, and the rows of their returns.

    The returns of the lines are given as by `find_lines`.
    """
    fits = fit_lines(sweep.points[rows], starts, config)
    valid = valid_lines(fits, config)
    seen = observations(fits[valid], np.zeros(np.count_nonzero(valid), dtype=np.bool_), config)
    return seen, rows[np.repeat(valid, np.diff(starts, append=len(rows)))]


def find_lines(sweep: Sweep, free: Mask, config: FrontEndConfig) -> tuple[Indices, Indices]:
    """The returns of each line, of those that are ``free`` (k,): no return belongs to two.

    Returns:
        Rows of `Sweep.points`, one line after the other, those of a line in the order of the
        beams; and where each line begins.
    """
    free = free.copy()
    lines: list[Indices] = []
    if np.count_nonzero(free) >= fewest_points(config):
        g = sweep.ranges[sweep.beam] * sweep.step_rad
        votes = HOUGH_VOTES[config.hough_votes](sweep.points, g, free, config)
        while len(seed := votes.peak()):
            rows = _grow(seed, sweep, free, config)
            # the returns of a rejected peak stop voting too, but may be added to another line
            votes.remove(np.union1d(seed, rows))
            if len(rows) >= fewest_points(config):
                lines.append(rows)
                free[rows] = False
    sizes = np.array([len(rows) for rows in lines], dtype=np.intp)
    return np.concatenate((np.zeros(0, dtype=np.intp), *lines)), np.cumsum(sizes) - sizes


def _grow(seed: Indices, sweep: Sweep, free: Mask, config: FrontEndConfig) -> Indices:
    """Rows of the returns of the line that grows from a seed, in the order of the beams."""
    rows = seed
    reach_sq = largest_deviation(config, mean_square_range(sweep.moments)) ** 2
    for _ in range(ROUNDS):
        before = rows
        line, direction = fitted_line(sweep.moments[:, before].sum(axis=1))
        rows = np.flatnonzero((line @ sweep.moments <= reach_sq) & free)
        rows = _fitting_runs(rows, line, direction, sweep, config)
        if len(rows) < SEED_POINTS or np.array_equal(rows, before):
            break
    return rows


def _fitting_runs(
    rows: Indices, line: Array, direction: float, sweep: Sweep, config: FrontEndConfig
) -> Indices:
    """Of the returns near a line, those in runs that fit it.

    A run ends where the next return on the line is farther away than in a chain, with other returns
    between. First its blocks are tested, so that of a run of two objects the one off the line is
    removed; then the rest of each run as a whole, which shows smaller deviations.
    """
    if len(rows) < SEED_POINTS:
        return rows
    borders = _borders(rows, direction, sweep, config)
    blocks = _blocks(borders)
    fits = _fit(rows, np.concatenate((blocks, borders[:-1])), line, sweep, config)
    if fits.all():
        return rows
    rows = rows[np.repeat(fits[: len(blocks)], np.diff(blocks, append=len(rows)))]
    if len(rows) < SEED_POINTS:
        return rows
    borders = _borders(rows, direction, sweep, config)
    fits = _fit(rows, borders[:-1], line, sweep, config)
    return rows[np.repeat(fits, np.diff(borders))]


def _fit(rows: Indices, starts: Indices, line: Array, sweep: Sweep, config: FrontEndConfig) -> Mask:
    """Which parts of ``rows`` lie on the line; ``starts`` may hold several divisions."""
    r = sweep.ranges[sweep.beam[rows]]
    # along the normal; line[0] is the squared offset, so the factor is cos² of the incidence
    var = range_variance(config, r * r) * line[0] / (r * r)
    sums = np.cumsum(np.concatenate((sweep.moments[:, rows], var[None])), axis=1)
    stops = np.append(starts[1:], 0)
    stops[stops == 0] = len(rows)  # the last part of each division
    M = sums[:, stops - 1]
    M[:, starts > 0] -= sums[:, starts[starts > 0] - 1]
    M, noise = M[:-1], M[-1] / M[0]
    excess = mean_square(line[:, None], M) - mean_square(fitted_lines(M), M)
    flat = FLATNESS * allowed_rms(config, mean_square_range(M)) ** 2
    good = excess <= flat + RUN_GATE * noise / M[0]
    return np.asarray(good & (M[0] >= RUN_POINTS))


def _borders(rows: Indices, direction: float, sweep: Sweep, config: FrontEndConfig) -> Indices:
    """Where runs of ``rows`` begin, and the end of the last one."""
    along = sweep.points[rows] @ np.array((math.cos(direction), math.sin(direction)))
    beam = sweep.beam[rows]
    r = sweep.ranges[beam]
    gap = config.gap_m + config.gap_ratio * np.minimum(r[1:], r[:-1])
    between = (rows[1:] - rows[:-1] > 1) | (beam[1:] - beam[:-1] > MISSING_BEAMS + 1)
    ends = np.flatnonzero((np.abs(along[1:] - along[:-1]) > gap) & between) + 1
    return np.concatenate(([0], ends, [len(rows)]))


def _blocks(borders: Indices) -> Indices:
    """Where blocks of at most BLOCK_POINTS begin that divide the runs between borders evenly."""
    size = borders[1:] - borders[:-1]
    parts = -(-size // BLOCK_POINTS)
    run = np.repeat(np.arange(len(size)), parts)
    number = np.arange(len(run)) - np.repeat(np.cumsum(parts) - parts, parts)
    return np.asarray(borders[run] + number * size[run] // parts[run])
