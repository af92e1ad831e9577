"""Walls as points along them, so that a tree finds the walls near a place."""

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, unit_vectors


def sample_walls(means: Array, extents: Array, spacing_m: float) -> tuple[Array, IntArray]:
    """Points (s, 2) along walls, world frame, both ends included, and the wall (s,) of each.

    Args:
        means: (n, 3) poses on the walls, x axis along them.
        extents: (n, 2) m, from where to where each reaches along its x axis.
        spacing_m: largest distance from one point to the next.
    """
    low, high = extents.T
    count = 2 + np.ceil((high - low) / spacing_m).astype(np.int64)
    of = np.repeat(np.arange(len(means)), count)
    nth = np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)
    along = low[of] + nth / (count[of] - 1) * (high - low)[of]
    return means[of, :2] + along[:, None] * unit_vectors(means[of, 2]), of
