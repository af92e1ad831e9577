"""A grid over the observed area, its distance map, and sums over cells and windows of cells."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from graphslam.change_detection.visit import Bools, Ints
from graphslam.core.geometry import Array

#: cells by which a grid is larger than the observed area on each side
_MARGIN_CELLS = 8


@dataclass(frozen=True, slots=True)
class Grid:
    """Square cells of ``cell_m``; cell (i, j) begins at ``origin_m`` + (i, j) cell_m."""

    origin_m: tuple[float, float]
    cell_m: float
    shape: tuple[int, int]

    def cells(self, points: Array) -> Ints:
        """Flat indices (n,) of the cells that hold ``points`` (n, 2) m; -1 outside of the grid."""
        with np.errstate(invalid="ignore"):
            i, j = np.floor((points.T - np.array(self.origin_m)[:, None]) / self.cell_m)
            inside = (i >= 0) & (i < self.shape[0]) & (j >= 0) & (j < self.shape[1])
            cell = i * self.shape[1] + j
        return np.where(inside, cell, -1.0).astype(np.int64)

    def centers(self, cells: Ints) -> Array:
        """Centres (n, 2) m of cells (n,)."""
        ij = np.column_stack(np.divmod(cells, self.shape[1]))
        return np.asarray(np.array(self.origin_m) + (ij + 0.5) * self.cell_m)

    def occupied(self, cells: Ints) -> tuple[Ints, Ints]:
        """The distinct ``cells`` (m,) of (n,), sorted, and the index of each cell among them."""
        number = np.zeros(self.shape[0] * self.shape[1], dtype=np.int64)
        number[cells] = 1
        unique = np.flatnonzero(number)
        number[unique] = np.arange(len(unique))
        return unique, number[cells]

    def neighbours(self, cells: Ints, radius: int) -> list[Ints]:
        """Per offset within ``radius`` cells the flat index of that neighbour of each cell (n,)."""
        offsets = range(-radius, radius + 1)
        return [cells + i * self.shape[1] + j for i in offsets for j in offsets]


def sorted_unique(numbers: Ints) -> Ints:
    """The distinct ``numbers`` (n,), sorted; np.unique's hash table is slower."""
    numbers = np.sort(numbers)
    first = np.ones(len(numbers), dtype=bool)
    first[1:] = numbers[1:] != numbers[:-1]
    return np.asarray(numbers[first])


def grid_over(points: Array, cell_m: float, max_cells: int) -> Grid:
    """A grid that holds ``points`` (n, 2) m; coarser than ``cell_m`` if it would be too large.

    The outermost 0.05 % on each side are left out: a few stray returns would blow up the grid.
    """
    low, high = np.quantile(points, [0.0005, 0.9995], axis=0)
    low, high = low - 0.5, high + 0.5
    size = high - low
    cell = max(cell_m, float(np.sqrt(size.prod() / max_cells)))
    count = np.ceil(size / cell).astype(int) + 2 * _MARGIN_CELLS
    origin = low - _MARGIN_CELLS * cell
    return Grid((float(origin[0]), float(origin[1])), cell, (int(count[0]), int(count[1])))


@dataclass(frozen=True, slots=True, eq=False)
class DistanceMap:
    """For every cell of a grid the nearest member of a set of cells.

    ``distance_m`` (cells,) float32 between centres, ``member`` (cells,) int32 its index in the set.
    """

    grid: Grid
    distance_m: NDArray[np.float32]
    member: NDArray[np.int32]


def distance_map(grid: Grid, cells: Ints, chosen: Bools) -> DistanceMap:
    """The distance map of the ``chosen`` (n,) ones of ``cells`` (n,), flat indices."""
    rows = np.nonzero(chosen)[0]
    cells = cells[rows]
    free = np.ones(grid.shape, dtype=np.uint8)
    free.reshape(-1)[cells] = 0
    distance, label = cv2.distanceTransformWithLabels(
        free, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    member_of_label = np.zeros(int(label.max()) + 1, dtype=np.int32)
    member_of_label[label.reshape(-1)[cells]] = rows
    return DistanceMap(
        grid, (distance * grid.cell_m).reshape(-1), member_of_label[label].reshape(-1)
    )


def row_sums(rows: Ints, weights: Array, size: int) -> Array:
    """Sums (size,) of ``weights`` (k,) over equal ``rows`` (k,)."""
    return np.asarray(np.bincount(rows, weights, size), dtype=float)


def window_sums(values: Array, windows: list[Ints]) -> Array:
    """Sums of ``values`` (n, ...) over each row's neighbours; a neighbour (n,) of -1 adds 0."""
    padded = np.concatenate([values, np.zeros((1, *values.shape[1:]))])
    total = np.zeros_like(values)
    for rows in windows:
        total += padded[rows]
    return np.asarray(total)


def neighbour_rows(grid: Grid, cells: Ints, radius: int) -> list[Ints]:
    """Per offset within ``radius`` the row in ``cells`` (n,) of each cell's neighbour; -1: none."""
    row = np.full(grid.shape[0] * grid.shape[1] + 1, -1, dtype=np.int32)
    row[cells] = np.arange(len(cells), dtype=np.int32)
    size = grid.shape[0] * grid.shape[1]
    return [
        row[np.where((n >= 0) & (n < size), n, size)].astype(np.int64)
        for n in grid.neighbours(cells, radius)
    ]
