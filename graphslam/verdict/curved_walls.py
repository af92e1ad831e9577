"""How much of what a robot saw of walls is curved: the pieces of a curve are no walls.

A round wall is seen as a chain of short straight pieces. Where they begin and end depends on where
the robot is, so they move along with it: matched to those that were seen before, they hold it back,
or turn it, by the same little each time. The estimate takes them for walls and is very sure.
"""

from collections.abc import Sequence

import numpy as np

from graphslam.core.geometry import wrap
from graphslam.core.records import Association

#: rad: pieces of a curve turn by so much from one to the next, and by so many sigmas of it
LEAST_TURN, MOST_TURN, TURN_SIGMAS = np.radians(2.0), np.radians(25.0), 2.0
#: m: ends of neighbouring pieces are no farther apart
NEAR_M = 0.3
#: pieces that are enough to tell
ENOUGH = 50


def curved_share(seen: Sequence[Association]) -> float:
    """Share of the pieces of walls that one robot saw which are of three in a row that turn alike.

    0 where there are hardly any.
    """
    walls = [a for a in seen if len(a.z) == 3 and a.extent is not None]
    if len(walls) < ENOUGH:
        return 0.0
    times = np.array([a.time_ns for a in walls], dtype=np.int64)
    z = np.array([a.z for a in walls])
    order = np.lexsort((np.arctan2(z[:, 1], z[:, 0]), times))
    times, z = times[order], z[order]
    extent = np.array([a.extent for a in walls])[order]
    variance = np.array([a.cov[2, 2] for a in walls])[order]
    along = np.column_stack([np.cos(z[:, 2]), np.sin(z[:, 2])])
    first, last = (z[:, :2] + extent[:, k, None] * along for k in (0, 1))
    turn = wrap(z[1:, 2] - z[:-1, 2])
    least = np.maximum(LEAST_TURN, TURN_SIGMAS * np.sqrt(variance[1:] + variance[:-1]))
    chained = (times[1:] == times[:-1]) & (np.hypot(*(first[1:] - last[:-1]).T) < NEAR_M)
    chained &= (np.abs(turn) > least) & (np.abs(turn) < MOST_TURN)
    sign = np.sign(turn) * chained
    bent = np.zeros(len(z) + 2, dtype=bool)  # with one on each side that is none
    middle = np.flatnonzero((sign[1:] == sign[:-1]) & (sign[1:] != 0)) + 2
    for k in (-1, 0, 1):
        bent[middle + k] = True
    return float(bent.sum() / len(z))
