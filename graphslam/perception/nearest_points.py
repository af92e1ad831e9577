"""Nearest neighbours among fixed points, looked up in a grid.

A tree is searched for every query; where the same few hundred points are asked for thousands of
times, as in scan matching, a grid that holds the nearest point of each cell is faster. The point is
the nearest to the middle of the cell, so it may be farther away than the nearest one by up to a
cell's diagonal.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from graphslam.core.geometry import Array

IntArray = NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class NearestPoints:
    """``index`` (nx, ny): number of the point that is nearest to each cell; first cell at ``low``.

    Cells have sides of ``cell_m``.
    """

    index: NDArray[np.int32]
    low: Array
    cell_m: float

    @classmethod
    def of(cls, points: Array, cell_m: float, reach_m: float) -> "NearestPoints":
        """The grid of points (n, 2) m, with a margin of ``reach_m`` around them."""
        margin = int(np.ceil(reach_m / cell_m)) + 1
        low = points.min(axis=0) - margin * cell_m
        cells = np.floor((points - low) / cell_m).astype(np.intp)
        occupied = np.ones(cells.max(axis=0) + margin + 1, dtype=np.uint8)
        occupied[cells[:, 0], cells[:, 1]] = 0
        _, label = cv2.distanceTransformWithLabels(
            occupied, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
        )
        # OpenCV numbers the occupied cells; a cell stands for the last of its points
        of_label = np.zeros(int(label.max()) + 1, dtype=np.int32)
        of_label[label[cells[:, 0], cells[:, 1]]] = np.arange(len(points))
        return cls(of_label[label], low, cell_m)


def nearest_of_each(
    grids: Sequence[NearestPoints], points: Array, which: IntArray, count: IntArray
) -> IntArray:
    """Numbers (m,) of the points that are nearest to ``points`` (m, 2), each in a grid of its own.

    Outside of a grid, it is any that is beyond the reach of the grid.

    Args:
        grids: n, with cells of one size.
        points: where to look.
        which: (m,) their grids by number, in ascending order.
        count: (n,) how many points there are for each grid.
    """
    low = np.array([grid.low for grid in grids])
    last = np.array([grid.index.shape for grid in grids]) - 1
    x, y = (
        np.clip((points[:, k] - low[which, k]) / grids[0].cell_m, 0, last[which, k]).astype(np.intp)
        for k in (0, 1)
    )
    cells = x * (last[which, 1] + 1) + y
    near = np.empty(len(points), dtype=np.int32)
    end = 0
    for grid, m in zip(grids, count.tolist(), strict=True):
        begin, end = end, end + m
        grid.index.take(cells[begin:end], out=near[begin:end], mode="clip")
    return near.astype(np.intp)
