"""What moves between two scans: things where an earlier scan looked through.

Unknown things that move (people, robots without an outline) must not become landmarks. A thing that
stands free and lies where an earlier beam passed well behind it was not there then. Simple and
cautious: what an earlier scan did not see through stays.
"""

import numpy as np
from numpy.typing import NDArray

from graphslam.frontend.robots import clusters
from graphslam.frontend.sweep import Sweep
from graphslam.geometry import Array, transform

#: m: wider things are part of the building
WIDEST_M = 1.5
#: m: an earlier beam must have gone so much farther
BEHIND_M = 0.4
#: of its returns, and returns at least
SHARE, FEWEST = 0.8, 3


def moving(sweep: Sweep, earlier: Sweep, earlier_from_here: Array) -> NDArray[np.bool_]:
    """Which returns (k,) of a scan belong to things that an earlier one looked through.

    Args:
        sweep: the scan.
        earlier: one of the same laser, some motion ago.
        earlier_from_here: (3,) pose of the scan's laser in the frame of the earlier one's.
    """
    gone = np.zeros(len(sweep.beam), dtype=np.bool_)
    found = clusters(sweep, WIDEST_M)
    if not len(found) or not len(earlier.ranges):
        return gone
    points = transform(earlier_from_here, sweep.points)
    r, a = np.hypot(*points.T), np.arctan2(points[:, 1], points[:, 0])
    turn = np.mod(a - earlier.angles[0] + earlier.step_rad / 2, 2 * np.pi)
    beam = np.floor(turn / earlier.step_rad).astype(np.int64)
    inside = beam < len(earlier.ranges)
    beam = np.clip(beam, 1, max(len(earlier.ranges) - 2, 1))
    # both neighbours must have gone behind as well: the laser may have turned a little less
    beyond = np.min(earlier.ranges[beam[:, None] + np.array([-1, 0, 1])], axis=1)
    through = inside & (beyond > r + BEHIND_M)  # a missing return, NaN, compares False
    sums = np.concatenate([[0], np.cumsum(through)])
    count = found.last - found.first + 1
    share = (sums[found.last + 1] - sums[found.first]) / count
    for k in np.flatnonzero((count >= FEWEST) & (share >= SHARE)):
        gone[found.first[k] : found.last[k] + 1] = True
    return gone
