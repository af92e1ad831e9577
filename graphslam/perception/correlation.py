"""Correlation of points with an occupancy grid at many shifts: the coarse step of scan matching.

Within a window of shifts the grid is read directly; over a whole map its Fourier transform is
cheaper. Source: E. Olson, ICRA 2009, DOI 10.1109/ROBOT.2009.5152375.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graphslam.core.geometry import Array

#: value of cells next to an occupied one, which has 1: a point half a cell off still counts half
BESIDE = 0.5
#: values that are looked up at once, and how many a byte can sum: twice that fits
AT_ONCE, SUMMED = 1 << 20, 63


@dataclass(frozen=True, slots=True, eq=False)
class CorrelationGrid:
    """Cells of ``cell_m``: ``values`` (nx, ny), 1 where occupied, 0 unknown; first at ``low`` (2,).

    `BESIDE` next to occupied cells. All are multiples of a half.
    """

    values: NDArray[np.float32]
    low: Array
    cell_m: float

    def cells(self, points: Array) -> NDArray[np.intp]:
        """Cells (n, 2) of points (n, 2) m, which may lie outside of the grid."""
        return _cells(points - self.low, self.cell_m)

    def correlate_window(self, points: Array, shape: tuple[int, int]) -> Array:
        """Mean values (k, *shape) under k sets of points (k, n, 2) m shifted by 0, 1, ... cells.

        It takes as many bytes as the grid has cells, times the columns of a window: for submaps.
        """
        width, height = shape
        # small integers, whose sums are as exact as those of halves
        halves = np.rint(2 * self.values).astype(np.int8)
        # of each column on, as many columns as a window has, row after row: the values of a window
        # are then side by side, and are copied as one element
        columns = np.lib.stride_tricks.sliding_window_view(halves, height, axis=1)
        strips = np.ascontiguousarray(columns.transpose(1, 0, 2))
        starts = strips.shape[0], strips.shape[1] - width + 1
        windows = np.ndarray(starts, f"V{width * height}", strips, strides=strips.strides[:2])
        last = np.array([starts[1], starts[0]]) - 1
        x, y = np.moveaxis(np.clip(self.cells(points), 0, last), -1, 0)
        count = points.shape[1]
        sums = np.zeros((len(x), width, height), dtype=np.int32)
        at_once = max(1, AT_ONCE // (count * width * height))
        for k in range(0, len(x), at_once):
            found = windows[y[k : k + at_once], x[k : k + at_once]].view(np.int8)
            found = found.reshape(-1, count, width, height)
            for n in range(0, count, SUMMED):
                sums[k : k + at_once] += found[:, n : n + SUMMED].sum(axis=1, dtype=np.int8)
        return np.asarray(sums.astype(np.float32) / np.float32(2 * count))


@dataclass(frozen=True, slots=True, eq=False)
class GridSpectrum:
    """Fourier transform of a `CorrelationGrid`, padded to ``shape``; its ``low`` and ``cell_m``."""

    transformed: NDArray[np.complex64]
    shape: tuple[int, int]
    low: Array
    cell_m: float

    def correlate(self, points: Array) -> Array:
        """Mean values (shape) under points (n, 2) m with their origin in each of the cells."""
        from scipy import fft  # noqa: PLC0415  (imports for long)

        x, y = _cells(points, self.cell_m).T
        image = np.zeros(self.shape, dtype=np.float32)
        np.add.at(image, (x, y), np.float32(1.0 / len(x)))
        return np.asarray(fft.irfft2(self.transformed * fft.rfft2(image).conj(), self.shape))


def occupancy_grid(
    points: Array,
    cell_m: float,
    margin: ArrayLike,
    free: Array | None = None,
    free_value: float = 0.0,
) -> CorrelationGrid:
    """The grid of occupied points (n, 2) m.

    On each side are ``margin`` empty cells, one number or (2,), at least 1.
    The cells of points (k, 2) m in ``free`` space have ``free_value`` unless they are occupied or
    next to it; points outside of the grid are left out.
    """
    margin = np.asarray(margin)
    low = points.min(axis=0) - margin * cell_m
    cells = _cells(points - low, cell_m)
    grid = CorrelationGrid(np.zeros(cells.max(axis=0) + margin + 1, dtype=np.float32), low, cell_m)
    values = grid.values
    if free is not None:
        at = grid.cells(free)
        x, y = at[((at >= 0) & (at < values.shape)).all(axis=1)].T
        values[x, y] = free_value
    x, y = cells.T
    for value, reach in ((BESIDE, 1), (1.0, 0)):
        for i in range(-reach, reach + 1):
            for j in range(-reach, reach + 1):
                values[x + i, y + j] = value
    return grid


def grid_spectrum(grid: CorrelationGrid) -> GridSpectrum:
    """The Fourier transform of a grid, for correlation at all shifts."""
    from scipy import fft  # noqa: PLC0415  (imports for long)

    nx, ny = (fft.next_fast_len(size, real=True) for size in grid.values.shape)
    return GridSpectrum(fft.rfft2(grid.values, (nx, ny)), (nx, ny), grid.low, grid.cell_m)


def _cells(points: Array, cell_m: float) -> NDArray[np.intp]:
    return np.asarray(np.round(points / cell_m).astype(np.intp))
