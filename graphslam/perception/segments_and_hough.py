"""Segments and Hough lines together: one wall gives one observation, no return counts twice.

Segments know where a wall ends; Hough lines connect the parts of a wall that furniture or a door
separates. So segments with both ends visible come first and keep their returns; Hough lines are
extracted from the others; an occluded segment stays where no Hough line took its returns.
"""

import numpy as np

from graphslam.core.config import FrontEndConfig
from graphslam.core.records import Observation
from graphslam.perception.hough import find_lines, line_observations
from graphslam.perception.line_fit import observations
from graphslam.perception.ordered_scan import Indices, Mask, Sweep
from graphslam.perception.segments import Segments, fewest_points, find_segments

#: an occluded segment that lost a larger share of its returns to Hough lines is dropped
SHARED = 0.5


def segments_and_hough(sweep: Sweep, config: FrontEndConfig) -> tuple[Observation, ...]:
    """Whole segments, Hough lines of the other returns, and segments that no Hough line covers.

    Observations are in the laser frame: whole segments in the order of the beams, then Hough lines,
    then the rest of the occluded segments, of kind ``line``. Arguments are those of `segments`.
    """
    found = find_segments(sweep, config)
    free = np.ones(len(sweep.beam), dtype=np.bool_)
    take = found.whole & found.valid
    free[found.rows[np.repeat(take, np.diff(found.starts, append=len(found.rows)))]] = False
    whole = observations(found.fits[take], found.whole[take], config)
    hough, used = line_observations(sweep, *find_lines(sweep, free, config), config)
    free[used] = False
    left, _ = line_observations(sweep, *_remaining_segments(found, free, config), config)
    return (*whole, *hough, *left)


def _remaining_segments(
    found: Segments, free: Mask, config: FrontEndConfig
) -> tuple[Indices, Indices]:
    """Rows and starts of the ``free`` returns of occluded segments that mostly consist of such."""
    is_free = free[found.rows]
    count = np.diff(found.starts, append=len(found.rows))
    left = np.add.reduceat(is_free, found.starts, dtype=np.intp)
    stays = found.valid & ~found.whole & (left >= fewest_points(config))
    stays &= left >= (1 - SHARED) * count
    rows, left = found.rows[is_free & np.repeat(stays, count)], left[stays]
    return rows, np.cumsum(left) - left
