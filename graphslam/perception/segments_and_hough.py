"""Segments and Hough lines together: one wall gives one observation, no return counts twice.

Segments know where a wall ends; Hough lines connect the parts of a wall that furniture or a door
separates. So segments with both ends visible come first and keep their returns; Hough lines are
extracted from the others; an occluded segment stays where no Hough line took its returns.
"""

import numpy as np

from graphslam.core.config import FrontEndConfig
from graphslam.core.records import Observation
from graphslam.perception.hough import find_lines
from graphslam.perception.line_fit import fit_lines, observations
from graphslam.perception.ordered_scan import Indices, Mask, Sweep
from graphslam.perception.segments import (
    Segments,
    fewest_points,
    find_segments,
    valid_lines,
)

#: an occluded segment that lost a larger share of its returns to Hough lines is dropped
SHARED = 0.5


def both(sweep: Sweep, config: FrontEndConfig) -> tuple[Observation, ...]:
    """Whole segments, Hough lines of the other returns, and segments that no Hough line covers.

    Observations are in the laser frame: whole segments in the order of the beams, then Hough lines,
    then the rest of the occluded segments, of kind ``line``. Arguments are those of `segments`.
    """
    found = find_segments(sweep, config)
    free = np.ones(len(sweep.beam), dtype=np.bool_)
    whole: tuple[Observation, ...] = ()
    if found is not None:
        take = found.whole & found.valid
        free[found.rows[take[_owner(found.rows, found.starts)]]] = False
        whole = observations(found.fits[take], found.whole[take], config)
    rows, starts = find_lines(sweep, free, config)
    hough, used = _line_observations(sweep, rows, starts, config)
    free[used] = False
    if found is None:
        return hough
    left, _ = _line_observations(sweep, *_remaining_segments(found, free, config), config)
    return (*whole, *hough, *left)


def _owner(rows: Indices, starts: Indices) -> Indices:
    """Number of the line that each of ``rows`` belongs to."""
    return np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(rows))))


def _line_observations(
    sweep: Sweep, rows: Indices, starts: Indices, config: FrontEndConfig
) -> tuple[tuple[Observation, ...], Indices]:
    """Observations of kind ``line`` of the valid lines, and the rows of their returns."""
    if not len(starts):
        return (), rows
    fits = fit_lines(sweep.points[rows], starts, config)
    valid = valid_lines(fits, config)
    seen = observations(fits[valid], np.zeros(np.count_nonzero(valid), dtype=np.bool_), config)
    return seen, rows[valid[_owner(rows, starts)]]


def _remaining_segments(
    found: Segments, free: Mask, config: FrontEndConfig
) -> tuple[Indices, Indices]:
    """Rows and starts of the ``free`` returns of occluded segments that mostly consist of such."""
    owner = _owner(found.rows, found.starts)
    is_free = free[found.rows]
    count = np.bincount(owner, minlength=len(found.starts))
    left = np.bincount(owner[is_free], minlength=len(found.starts))
    stays = found.valid & ~found.whole & (left >= fewest_points(config))
    stays &= left >= (1 - SHARED) * count
    kept = is_free & stays[owner]
    rows, owner = found.rows[kept], owner[kept]
    begins = np.flatnonzero(owner[1:] != owner[:-1]) + 1
    return rows, np.concatenate(([0], begins)) if len(rows) else begins
