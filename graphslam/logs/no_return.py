"""Detection of the range value that a laser reports for "no return".

ROS asks for inf, but most recorded logs use a number that the message does not declare: 81.83 m in
Freiburg's SICK logs, 50 m in ACES. Treated as walls, these beams ruin a map.
"""

from collections import Counter
from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

# Beams of one scan with exactly this range; noise makes three equal maxima from real walls rare.
_MIN_BEAMS = 3
_MIN_SHARE_OF_SCANS = 0.1
_MAX_SHARE_ABOVE = 1e-3  # of all returns; larger values are other error codes
# A far wall also gives many ranges just below its largest, by noise and by incidence; a code does
# not. 0.2 m is many times the noise of any planar laser.
_BAND_M, _BAND_FACTOR = 0.2, 5


def find_no_return(scans: Iterable[ArrayLike]) -> float | None:
    """The smallest range, m, that means no return; None if the data show none.

    It is the value that is the exact maximum of many ``scans`` (each (n,) m), in several beams at
    once, with almost no ranges above it and few just below it.
    """
    candidates: Counter[float] = Counter()
    values = []  # of scans with a return
    for scan in scans:
        ranges = np.asarray(scan)
        ranges = ranges[np.isfinite(ranges)]
        if not len(ranges):
            continue
        maximum = ranges.max()
        if np.count_nonzero(ranges == maximum) >= _MIN_BEAMS:
            candidates[float(maximum)] += 1
        values.append(ranges)
    if not candidates:
        return None
    value, count = candidates.most_common(1)[0]
    ranges = np.concatenate(values)
    above = np.count_nonzero(ranges > value)
    just_below = np.count_nonzero((ranges < value) & (ranges > value - _BAND_M))
    frequent = count >= max(3, _MIN_SHARE_OF_SCANS * len(values))
    farthest = above <= _MAX_SHARE_ABOVE * len(ranges)
    alone = np.count_nonzero(ranges == value) > _BAND_FACTOR * just_below
    return value if frequent and farthest and alone else None
