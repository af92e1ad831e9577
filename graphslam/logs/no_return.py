"""The range that a laser reports when it saw nothing, found in the data.

ROS asks for inf, but most recorded logs have a number that nothing in the message explains: 81.83 m
in Freiburg's SICK logs, 50 m in ACES. Taken for walls these beams ruin a map.
"""

from collections import Counter
from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

_BEAMS = 3  # in one scan; noise makes three equal farthest ranges of real walls rare
_SHARE_OF_SCANS = 0.1
_SHARE_ABOVE = 1e-3  # of all returns: farther ones are other error codes
# A far wall gives neighbouring ranges too, by noise and by incidence; a code stands alone.
_BAND_M, _BAND_FACTOR = 0.2, 5


def find_no_return(scans: Iterable[ArrayLike]) -> float | None:
    """The smallest range, m, that means no return; None when the data show none.

    It is the exact value that is the farthest one of many of the ``scans`` (each (n,) m), in
    several beams at once, with next to nothing beyond it and little just before it.
    """
    candidates: Counter[float] = Counter()
    values, scans_seen = [], 0
    for scan in scans:
        ranges = np.asarray(scan)
        ranges = ranges[np.isfinite(ranges)]
        if not len(ranges):
            continue
        scans_seen += 1
        maximum = ranges.max()
        if np.count_nonzero(ranges == maximum) >= _BEAMS:
            candidates[float(maximum)] += 1
        values.append(ranges)
    if not candidates:
        return None
    value, count = candidates.most_common(1)[0]
    ranges = np.concatenate(values)
    above = np.count_nonzero(ranges > value)
    just_below = np.count_nonzero((ranges < value) & (ranges > value - _BAND_M))
    frequent = count >= max(3, _SHARE_OF_SCANS * scans_seen)
    farthest = above <= _SHARE_ABOVE * len(ranges)
    alone = np.count_nonzero(ranges == value) > _BAND_FACTOR * just_below
    return value if frequent and farthest and alone else None
