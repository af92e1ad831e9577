"""What moves between two scans: things where an earlier scan looked through.

Unknown things that move (people, robots without an outline) must not become landmarks. A thing that
stands free and lies where an earlier beam passed well behind it was not there then. Simple and
cautious: what an earlier scan did not see through stays.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from graphslam.core.geometry import Array, transform
from graphslam.perception.ordered_scan import Sweep
from graphslam.perception.robot_outlines import clusters

#: m: wider things are part of the building
WIDEST_M = 1.5
#: m: an earlier beam must have gone so much farther
BEHIND_M = 0.4
#: m: an earlier beam that ended so near to a thing met the same
SAME_M = 0.1
#: of its returns, and returns at least
SHARE, FEWEST = 0.8, 3


def was_there(points: Array, earlier: Sweep, earlier_from_here: Array) -> bool:
    """Whether an earlier scan saw a thing where it is now, so that it has not moved.

    Args:
        points: (n, 2) returns of the thing, laser frame.
        earlier: the earlier scan.
        earlier_from_here: (3,) pose of the laser in the frame of the earlier one's.
    """
    return bool(np.mean(stood_there(points, earlier, earlier_from_here)) >= SHARE)


def stood_there(points: Array, earlier: Sweep, earlier_from_here: Array) -> NDArray[np.bool_]:
    """Which points (n, 2), laser frame, an earlier scan met as well; poses as in `was_there`."""
    r, before = _ranges_there(points, earlier, earlier_from_here)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.any(np.abs(before - r[:, None]) < SAME_M, axis=1))


def _ranges_there(points: Array, earlier: Sweep, earlier_from_here: Array) -> tuple[Array, Array]:
    """Ranges (n,) of points in the earlier frame; what its three beams nearest to each saw (n, 3).

    NaN beside the earlier scan's field.
    """
    there = transform(earlier_from_here, points)
    a = np.arctan2(there[:, 1], there[:, 0])
    turn = np.mod(a - earlier.angles[0] + earlier.step_rad / 2, 2 * np.pi)
    beam = np.floor(turn / earlier.step_rad).astype(np.int64)[:, None] + np.array([-1, 0, 1])
    n = len(earlier.ranges)
    seen = np.where((beam >= 0) & (beam < n), earlier.ranges[np.clip(beam, 0, n - 1)], np.nan)
    return np.hypot(*there.T), seen


def moving(sweep: Sweep, views: Sequence[tuple[Sweep, Array]]) -> NDArray[np.bool_]:
    """Which returns (k,) of a scan belong to things that an earlier one looked through.

    Args:
        sweep: the scan.
        views: earlier ones of the same laser, each with the pose (3,) of the scan's laser in the
            frame of its own.
    """
    gone = np.zeros(len(sweep.beam), dtype=np.bool_)
    found = clusters(sweep, WIDEST_M)
    count = found.last - found.first + 1
    for earlier, earlier_from_here in views:
        if not len(found) or not len(earlier.ranges):
            continue
        r, before = _ranges_there(sweep.points, earlier, earlier_from_here)
        # both neighbours must have gone behind as well: the laser may have turned a little less
        through = np.min(before, axis=1) > r + BEHIND_M  # a missing return, NaN, compares False
        sums = np.concatenate([[0], np.cumsum(through)])
        share = (sums[found.last + 1] - sums[found.first]) / count
        for k in np.flatnonzero((count >= FEWEST) & (share >= SHARE)):
            gone[found.first[k] : found.last[k] + 1] = True
    return gone
