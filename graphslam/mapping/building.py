"""Which walls are of the building: what is longer than furniture, in one piece or in one plane.

Of a wall in front of which furniture stands, each gap shows a piece. They lie in one plane.
"""

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from graphslam.core.arrays import BoolArray
from graphslam.core.geometry import between
from graphslam.mapping.duplicate_landmarks import near_pairs
from graphslam.mapping.landmark_map import Entry

#: m: what is longer belongs to the building
LONGEST_M = 2.5
#: m, rad, m: pieces of one plane are off each other by less, and nearer to each other
PLANE_M, PLANE_RAD, GAP_M = 0.02, 0.05, 5.0


def of_building(walls: Sequence[Entry]) -> BoolArray:
    """Which walls (n,) are in planes that extend over more than furniture does."""
    if not walls:
        return np.zeros(0, dtype=np.bool_)
    x, extents = np.array([w.mean for w in walls]), np.array([w.extent for w in walls])
    i, j = near_pairs(x, extents, np.zeros(len(x), dtype=np.bool_), GAP_M)
    longer = np.ptp(extents[i], axis=1) >= np.ptp(extents[j], axis=1)
    i, j = np.where(longer, i, j), np.where(longer, j, i)
    there = between(x[i], x[j])  # the direction of a short piece tells little of where others are
    off = there[:, 1] + extents[j].mean(axis=1) * np.sin(there[:, 2])
    one = (np.abs(off) < PLANE_M) & (np.abs(there[:, 2]) < PLANE_RAD)
    n = len(x)
    pairs = coo_matrix((np.ones(one.sum()), (i[one], j[one])), shape=(n, n))
    _, plane = connected_components(pairs, directed=False)
    _, first = np.unique(plane, return_index=True)
    ends = between(x[first[plane]], x)[:, :1] + extents  # along the first one of each plane
    low, high = np.full(len(first), np.inf), np.full(len(first), -np.inf)
    np.minimum.at(low, plane, ends[:, 0])
    np.maximum.at(high, plane, ends[:, 1])
    return np.asarray((high - low)[plane] > LONGEST_M)
