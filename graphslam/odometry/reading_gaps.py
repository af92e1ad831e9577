"""Where a robot was while its odometry was silent.

Poses and wheel angles say how far it came meanwhile, not on which way. Increments do not even say
how far, see `missing_increments`.
"""

import numpy as np

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.geometry import Array
from graphslam.odometry.missing_increments import TURN_GROWTH, VELOCITY_GROWTH
from graphslam.odometry.readings import Readings

#: s without odometry that are a gap
GAP_S = 1.0
#: m of `Readings.effort`: a robot that moved less stood. Some publish nothing while they stand
STOOD_M = 0.05


def moved_in_gaps(odometry: Readings, longest_ns: int) -> BoolArray:
    """Of each reading but the last (n - 1,), whether a gap in which the robot moved follows.

    ``longest_ns``: readings that are further apart have a gap between them.
    """
    times = odometry.times
    return np.asarray((np.diff(times) > longest_ns) & (np.diff(odometry.effort(times)) > STOOD_M))


def covs_in_gaps(odometry: Readings, times_ns: IntArray) -> Array:
    """Covariances (n, 3, 3) of poses at ``times_ns`` (n,), given those at the readings around them.

    They are along the robot's axes, and 0 outside gaps and where odometry knows it already. The
    velocity is a random walk. Its integral, tied at both ends as the velocity is, has the variance
    q T³ s³ (1 - s)³ / 3 at a share s of the gap's duration T.
    """
    covs = np.zeros((len(times_ns), 3, 3))
    gaps = moved_in_gaps(odometry, round(1e9 * GAP_S))
    if odometry.source == "given" or not gaps.any():
        return covs
    readings = odometry.times
    before = readings.searchsorted(times_ns, side="right") - 1
    inside = np.flatnonzero((before >= 0) & (before < len(gaps)))
    inside = inside[gaps[before[inside]]]
    begin, end = readings[before[inside]], readings[before[inside] + 1]
    share = (times_ns[inside] - begin) / (end - begin)
    growth = (1e-9 * (end - begin) * share * (1 - share)) ** 3 / 3.0
    covs[inside] = growth[:, None, None] * np.diag([VELOCITY_GROWTH, VELOCITY_GROWTH, TURN_GROWTH])
    return covs
