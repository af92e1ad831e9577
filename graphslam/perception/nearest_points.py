"""Nearest neighbours among fixed points, looked up in a grid.

A tree is searched for every query; where the same few hundred points are asked for thousands of
times, as in scan matching, a grid that holds the nearest point of each cell is faster. The point is
the nearest to the middle of the cell, so it may be farther away than the nearest one by up to a
cell's diagonal.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array


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
        import cv2  # noqa: PLC0415  (16 MB, which only scans need)

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


def nearest_of_each(grids: Sequence[NearestPoints], points: Array) -> IntArray:
    """Numbers (n, m) of the points that are nearest to ``points`` (2, n, m), m in each of n grids.

    The grids have cells of one size. Outside of a grid, it is any point that is beyond its reach.
    """
    low = np.array([grid.low for grid in grids])
    shape = np.array([grid.index.shape for grid in grids])
    x, y = (
        np.clip((points[k] - low[:, k : k + 1]) / grids[0].cell_m, 0, shape[:, k : k + 1] - 1)
        for k in (0, 1)
    )
    cells = x.astype(np.intp) * shape[:, 1:] + y.astype(np.intp)
    near = np.empty(cells.shape, dtype=np.int32)
    for grid, there, found in zip(grids, cells, near, strict=True):
        grid.index.take(there, out=found, mode="clip")
    return near.astype(np.intp)
