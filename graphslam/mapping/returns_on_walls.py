"""Returns of a laser on walls that are known: which return is of which wall.

A return counts for a wall if it lies on it, within its ends, seen from the side on which the laser
is. Returns that may be of either of two walls are left out: where a door and the wall beside it
were taken for one wall, between the two, each of their returns would confirm it.

Walls are found in a tree, so that the work grows with the number of returns.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from graphslam.core.arrays import IntArray
from graphslam.core.config import FrontEndConfig
from graphslam.core.geometry import Array
from graphslam.mapping.wall_samples import sample_walls
from graphslam.perception.beam_noise import range_variance
from graphslam.perception.line_fit import SMALLEST_SIGMA_M

#: m: walls are sampled at this distance to find those near a return
SAMPLE_M = 0.25
#: m: walls are looked up by cells of this size; how many of their samples near a cell count
CELL_M, NEIGHBOURS = 0.25, 6
#: m: returns that are nearer to each other along a wall share the deviation of its surface
SURFACE_M = 1.0


class WallTree(NamedTuple):
    """Walls (n), to be found by places: ``of`` (s,) is the wall of each point in ``samples``.

    ``means`` (n, 3) and ``extents`` (n, 2) m are as those of `sample_walls`.
    """

    means: Array
    extents: Array
    samples: cKDTree
    of: IntArray

    @classmethod
    def from_walls(cls, means: Array, extents: Array) -> "WallTree":
        """The tree of some walls, at least one."""
        points, of = sample_walls(means, extents, SAMPLE_M)
        return cls(means, extents, cKDTree(points), of)

    def near(self, points: Array) -> tuple[IntArray, IntArray]:
        """Pairs (p,), (p,) of a point (n, 2) and a wall near it, sorted.

        Looked up by cells, of which there are fewer than points.
        """
        cell = np.floor(points / CELL_M).astype(np.int64)
        low = cell.min(axis=0, initial=0)
        columns = int(cell[:, 1].max(initial=0) - low[1]) + 1
        key, of = np.unique((cell - low) @ np.array([columns, 1]), return_inverse=True)
        centre = (np.column_stack(np.divmod(key, columns)) + low + 0.5) * CELL_M
        reach = SAMPLE_M + CELL_M / np.sqrt(2.0)
        _, sample = self.samples.query(centre, NEIGHBOURS, distance_upper_bound=reach)
        found = sample < len(self.of)
        k, _ = np.nonzero(found)
        pair = np.unique(k * len(self.means) + self.of[sample[found]])
        cell_of, wall = pair // len(self.means), pair % len(self.means)
        count = np.bincount(cell_of, minlength=len(key))
        number = count[of]
        begin = (np.cumsum(count) - count)[of]
        row = np.repeat(np.arange(len(points)), number)
        at = np.arange(len(row)) + np.repeat(begin + number - np.cumsum(number), number)
        return row, wall[at]


class OnWalls(NamedTuple):
    """Returns (k,) on walls: their ``row`` and that of the ``wall`` in `WallTree.means`.

    ``along`` and ``across`` (k,) m: where they are in the frame of the wall. ``sigma`` (k,) m:
    noise of the latter.
    """

    row: IntArray
    wall: IntArray
    along: Array
    across: Array
    sigma: Array

    def weights(self, of: IntArray, floor_m: float) -> Array:
        """What each return counts (k,), 1 / m², with those that share its piece of surface.

        ``of`` (k,): equal for the returns of one scan on one wall; ``floor_m``: sigma of the
        deviation of a surface.
        """
        surface = np.floor(self.along / SURFACE_M).astype(np.int64)
        surface -= surface.min(initial=0)
        piece = of * (surface.max(initial=0) + 1) + surface
        _, which, count = np.unique(piece, return_inverse=True, return_counts=True)
        return np.asarray(1.0 / (self.sigma**2 + count[which] * floor_m**2))


def returns_on_walls(
    pairs: tuple[IntArray, IntArray],
    points: Array,
    lasers: Array,
    tree: WallTree,
    config: FrontEndConfig,
    *,
    gate: float,
    margin_m: float,
    heading_rad: ArrayLike,
    place_m: ArrayLike = 0.0,
) -> OnWalls:
    """The returns that lie on one wall alone.

    Args:
        pairs: rows of returns and of walls (p,), (p,) that are near each other, sorted.
        points: (n, 2) m, the returns, world frame.
        lasers: (n, 2) m, from where they are seen, world frame.
        tree: the walls.
        config: noise of returns and of surfaces.
        gate: sigmas that a return may be off its wall.
        margin_m: how far beyond the ends of a wall.
        heading_rad: sigma of the heading of the scan of each return, () or (n,).
        place_m: sigma of its place, () or (n,).
    """
    row, wall = pairs
    x, y, c, s = (v[wall] for v in (*tree.means[:, :2].T, *_unit(tree.means[:, 2])))
    dx, dy = points[row, 0] - x, points[row, 1] - y
    along, across = c * dx + s * dy, c * dy - s * dx
    low, high = tree.extents.T
    inside = np.flatnonzero((along > low[wall] - margin_m) & (along < high[wall] + margin_m))
    row, wall, along, across, c, s = (v[inside] for v in (row, wall, along, across, c, s))
    dx, dy = (points[row] - lasers[row]).T
    lever, normal = c * dx + s * dy, c * dy - s * dx
    square = lever * lever + normal * normal
    noise = np.sqrt(range_variance(config, square) / square) * np.abs(normal)
    sigma = np.maximum(noise, max(config.floor_normal_m, SMALLEST_SIGMA_M))
    turn, place = (np.broadcast_to(v, len(points))[row] for v in (heading_rad, place_m))
    reach = gate * np.sqrt(sigma**2 + (turn * lever) ** 2 + place**2)
    fits = np.flatnonzero((normal < 0) & (np.abs(across) < reach))  # from the sensor's side
    # `row` is sorted: those that fit one wall alone
    first = np.diff(row[fits], prepend=-1) > 0
    last = np.diff(row[fits], append=-1) != 0
    fits = fits[first & last]
    return OnWalls(row[fits], wall[fits], along[fits], across[fits], sigma[fits])


def _unit(angle_rad: Array) -> tuple[Array, Array]:
    return np.cos(angle_rad), np.sin(angle_rad)
