"""Occupancy grids by ray casting: what the beams of every scan passed and where they ended.

A scan is a polygon around its sensor: along each beam, and between two neighbouring beams across
the surface that both met, or, where there is none, as far as the nearer one went. It counts once
for a cell, however many of its beams passed there: near the sensor they are not independent. The
cells on its border have no vote against being occupied, except that of the next scan. Sums of
log-odds (Moravec and Elfes 1985) with the constants of OctoMap (Hornung et al. 2013,
doi:10.1007/s10514-012-9321-0).

Counts are kept in tiles, which exist where a beam has been, so that memory grows with what was
seen and not with the rectangle around it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array, compose, transform
from graphslam.results.scans_file import PlacedScan

Counts = NDArray[np.uint16]

#: log-odds of a beam that ended in a cell (probability 0.7) and of one that passed it (0.4)
HIT, PASS = float(np.log(0.7 / 0.3)), float(np.log(0.4 / 0.6))
#: certainty that is never exceeded (probabilities 0.12 and 0.97)
LEAST, MOST = float(np.log(0.12 / 0.88)), float(np.log(0.97 / 0.03))
#: log-odds above which a cell is occupied (probability 0.65) and below which it is free (0.35: two
#: scans passed)
OCCUPIED, FREE = float(np.log(0.65 / 0.35)), float(np.log(0.35 / 0.65))
#: most of the scans that met a free cell and ended there
HITS_OF_FREE = 0.1
#: cells along the edge of a tile
TILE = 256
#: bits of a cell's fraction in the corners of a polygon
SHIFT = 6
#: neighbouring beams met one surface if their ends are closer than this, m, or than so many times
#: the distance of the beams there
JOINED_M, JOINED_BEAMS = 0.1, 3.0
#: neighbours are at most so many times the usual angle apart; else a return is missing between them
NEIGHBOURS = 1.5
#: edges of cells to choose from, m, and most cells of a map
SIZES_M, MOST_CELLS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0), 64_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Fan:
    """Returns (n, 2) m of a scan in the world, by bearing, seen from ``sensor`` (2,)."""

    sensor: Array
    ends: Array


def fan(scan: PlacedScan) -> Fan:
    """A scan's returns in the world."""
    sensor = np.asarray(scan.sensor, dtype=float)
    offset = scan.points.astype(float) - sensor[:2]
    bearing = np.arctan2(offset[:, 1], offset[:, 0]) - sensor[2]
    order = np.argsort(np.mod(bearing + np.pi, 2 * np.pi), kind="stable")
    ends = transform(scan.pose, scan.points[order].astype(float))
    return Fan(compose(scan.pose, sensor)[:2], ends)


def cell_size(fans: Sequence[Fan]) -> float:
    """Edge of a cell, m: as fine as beams lie beside each other, as coarse as a map has room.

    The distance of beams where they end, rounded up to one of `SIZES_M`.
    """
    return _from_sizes(max(_beam_spacing(fans), _finest(fans)))


def _from_sizes(least: float) -> float:
    """The first of `SIZES_M` that is not below ``least``; where none is so large, ``least``."""
    return next((size for size in SIZES_M if size >= least), least)


def _beam_spacing(fans: Sequence[Fan]) -> float:
    """Four fifths of the median distance of neighbouring beams where they end, m."""
    sample = [f.ends - f.sensor for f in fans[:: 1 + len(fans) // 200] if len(f.ends) > 1]
    spaces = [np.hypot(*ends.T) * _usual_angle(ends) for ends in sample]
    return 0.8 * float(np.median(np.concatenate([np.zeros(1), *spaces])))


def _finest(fans: Sequence[Fan]) -> float:
    """Edge of a cell, m, with which the map has at most `MOST_CELLS`, wherever cells begin."""
    low, high = _bounds(fans)
    width, height = (high - low).tolist()
    half = width + height
    # (width / size + 2) (height / size + 2) cells at most
    most = MOST_CELLS - 4
    return float((half + np.sqrt(half**2 + most * width * height)) / most)


def _rounded_up(value: float) -> float:
    """A positive number to two digits, not below it."""
    unit = 10.0 ** (np.floor(np.log10(value)) - 1)
    return float(np.ceil(value / unit) * unit)


def _turns(offset: Array) -> Array:
    """Angles (n - 1,) rad between neighbouring ends (n, 2) seen from the sensor."""
    bearings = np.arctan2(offset[:, 1], offset[:, 0])
    return np.asarray(np.mod(np.diff(bearings) + np.pi, 2 * np.pi) - np.pi)


def _usual_angle(offset: Array) -> float:
    return float(np.median(np.abs(_turns(offset))))


def _bounds(fans: Sequence[Fan]) -> tuple[Array, Array]:
    points = [np.zeros((0, 2)), *(f.ends for f in fans), *(f.sensor[None] for f in fans)]
    joined = np.concatenate(points)
    return (joined.min(axis=0), joined.max(axis=0)) if len(joined) else (np.zeros(2), np.ones(2))


@dataclass
class OccupancyGrid:
    """Counts of cells; cell (i, j) is over x from i ``cell_m``, y from j ``cell_m``.

    ``joins_ends``: the surface between two ends is hit as they are; else a scan has no vote there.
    ``tiles[a, b]`` is (hits, passes), each (TILE, TILE) with rows along y, from cell
    (a TILE, b TILE).
    """

    cell_m: float
    joins_ends: bool = False
    tiles: dict[tuple[int, int], tuple[Counts, Counts]] = field(default_factory=dict)

    def add(self, scan: Fan) -> None:
        """Count the cells that a scan's beams passed and those in which they ended."""
        if not len(scan.ends):
            return
        ends = np.floor(scan.ends / self.cell_m).astype(np.int64)
        at = np.floor(scan.sensor / self.cell_m).astype(np.int64)
        low = np.minimum(ends.min(axis=0), at)
        columns, rows = (np.maximum(ends.max(axis=0), at) - low + 1).tolist()
        passed = np.zeros((rows, columns), dtype=np.uint8)
        corners, border = _outline(scan)
        # a pixel's centre has whole coordinates
        fixed = np.round(((corners / self.cell_m - low) - 0.5) * (1 << SHIFT)).astype(np.int32)
        cv2.fillPoly(passed, [fixed], 1, shift=SHIFT)
        surface = fixed[1::2].copy()  # OpenCV takes no strides
        surfaces = [surface[a:b] for a, b in border]
        hit = np.zeros_like(passed)
        if self.joins_ends:
            cv2.polylines(hit, surfaces, False, 1, shift=SHIFT)
        else:
            cv2.polylines(passed, surfaces, False, 0, shift=SHIFT)
        hit[ends[:, 1] - low[1], ends[:, 0] - low[0]] = 1
        passed[hit > 0] = 0
        for key, tile, part in self._parts(low, passed.shape):
            if hit[part].any() or passed[part].any():
                hits, passes = self._tile(key)
                hits[tile] += hit[part]
                passes[tile] += passed[part]

    def _tile(self, key: tuple[int, int]) -> tuple[Counts, Counts]:
        if key not in self.tiles:
            shape = (TILE, TILE)
            self.tiles[key] = np.zeros(shape, np.uint16), np.zeros(shape, np.uint16)
        return self.tiles[key]

    def _parts(
        self, low: NDArray[np.int64], shape: tuple[int, ...]
    ) -> Iterator[tuple[tuple[int, int], tuple[slice, slice], tuple[slice, slice]]]:
        """Tiles under a rectangle of cells: key, part of the tile, part of the rectangle."""
        i, j = low.tolist()
        for b, (tile_y, part_y) in _cuts(j, shape[0]):
            for a, (tile_x, part_x) in _cuts(i, shape[1]):
                yield (a, b), (tile_y, tile_x), (part_y, part_x)

    def log_odds(self) -> tuple[NDArray[np.float32], tuple[int, int]]:
        """Log-odds (rows, columns) of cells, first row in the south, and the first cell (i, j).

        NaN where no beam has been.
        """
        known = {key: (h > 0) | (p > 0) for key, (h, p) in self.tiles.items()}
        inner = [
            np.array(key) * TILE + [[along[0], up[0]], [along[-1], up[-1]]]
            for key, seen in known.items()
            for along, up in [(np.flatnonzero(seen.any(axis=0)), np.flatnonzero(seen.any(axis=1)))]
        ]
        if not inner:
            return np.full((1, 1), np.nan, dtype=np.float32), (0, 0)
        low, high = np.min(inner, axis=(0, 1)), np.max(inner, axis=(0, 1))
        columns, rows = (high - low + 1).tolist()
        made = np.full((rows, columns), np.nan, dtype=np.float32)
        for (a, b), (hits, passes) in self.tiles.items():
            odds = np.clip(HIT * hits + PASS * passes, LEAST, MOST)
            # a wall at a cell's edge is hit there now and then, and passed more often
            often = hits > HITS_OF_FREE * (hits + passes)
            odds[often] = np.maximum(odds[often], FREE)
            odds[~known[a, b]] = np.nan
            left, below = a * TILE - int(low[0]), b * TILE - int(low[1])
            x, y = slice(max(left, 0), left + TILE), slice(max(below, 0), below + TILE)
            cut = odds[max(-below, 0) : rows - below, max(-left, 0) : columns - left]
            made[y, x] = cut
        return made, (int(low[0]), int(low[1]))


def _cuts(begin: int, count: int) -> Iterator[tuple[int, tuple[slice, slice]]]:
    """Numbers of the tiles under cells begin..begin + count, with both sides' parts."""
    first, last = begin // TILE, (begin + count - 1) // TILE
    edges = [begin, *((tile + 1) * TILE for tile in range(first, last)), begin + count]
    for tile, (a, b) in enumerate(pairwise(edges), first):
        yield tile, (slice(a - tile * TILE, b - tile * TILE), slice(a - begin, b - begin))


def _outline(scan: Fan) -> tuple[Array, list[tuple[int, int]]]:
    """Corners (2 n, 2) m of what a scan saw free, and runs [a, b) of ends on one surface.

    Corner 2k + 1 is the end of beam k; the one after it leads to the next beam: that end again if
    both are on one surface, the shorter range along the longer beam, or the sensor where beams
    between them are missing.
    """
    offset = scan.ends - scan.sensor
    r = np.hypot(*offset.T)
    n = len(r)
    turn = _turns(offset)
    usual = float(np.median(np.abs(turn))) if n > 1 else 0.0
    near = np.minimum(r[1:], r[:-1])
    gap = np.hypot(*np.diff(scan.ends, axis=0).T)
    neighbours = np.abs(turn) <= NEIGHBOURS * usual
    joined = neighbours & (gap < np.maximum(JOINED_M, JOINED_BEAMS * usual * near))
    corners = np.repeat(scan.ends, 2, axis=0)
    corners = np.concatenate([scan.sensor[None], corners[:-1]])
    farther = np.where(r[1:] > r[:-1], np.arange(1, n), np.arange(n - 1))
    share = near / np.maximum(r[farther], 1e-9)
    step = scan.sensor + share[:, None] * offset[farther]
    between = np.where(neighbours[:, None], step, scan.sensor)
    corners[2::2] = np.where(joined[:, None], scan.ends[:-1], between)
    breaks = np.flatnonzero(~joined) + 1
    return corners, list(pairwise([0, *breaks.tolist(), n]))


@dataclass(frozen=True, slots=True, eq=False)
class GridMap:
    """Log-odds (rows, columns) of cells of ``cell_m``, NaN where unknown; first row in the south.

    ``origin_m`` is the corner where the first row and column begin, in the world.
    """

    log_odds: NDArray[np.float32]
    cell_m: float
    origin_m: tuple[float, float]

    @property
    def occupied(self) -> NDArray[np.bool_]:
        """Which cells (rows, columns) are occupied: more probable than 0.65."""
        return np.asarray(self.log_odds > OCCUPIED)

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which cells (rows, columns) are free: two scans passed or more, hardly any ended."""
        return np.asarray(self.log_odds < FREE)


def grid_map(scans: Sequence[PlacedScan], cell_m: float | None = None) -> GridMap:
    """The map of some scans with cells of ``cell_m``, by default as the scans allow.

    Where cells are finer than beams lie beside each other, much of a surface is between ends: it
    is taken for hit there.

    Space that is free, but that nothing free joins to a sensor, was seen through what is occupied
    (an error of range or pose on the far side of a wall): it is unknown.

    Raises:
        ConfigError: the map would have more than `MOST_CELLS` cells.
    """
    fans = [fan(scan) for scan in scans]
    size = cell_size(fans) if cell_m is None else cell_m
    finest = _finest(fans)
    if size < finest:
        raise ConfigError(
            f"--resolution {size:g}: the map would have more than {MOST_CELLS} cells; the finest "
            f"possible is {_rounded_up(finest):g}"
        )
    counts = OccupancyGrid(size, joins_ends=size < _from_sizes(_beam_spacing(fans)))
    for one in fans:
        counts.add(one)
    log_odds, low = counts.log_odds()
    free = log_odds < FREE
    count, part = cv2.connectedComponents(free.astype(np.uint8), connectivity=4)
    sensors = np.array([one.sensor for one in fans]).reshape(-1, 2)
    at = np.floor(sensors / size).astype(np.int64) - np.array(low)
    inside = ((at >= 0) & (at < np.array(free.shape[::-1]))).all(axis=1)
    reached = np.zeros(count, dtype=np.bool_)
    reached[part[at[inside, 1], at[inside, 0]]] = True
    log_odds[free & ~reached[part]] = np.nan
    return GridMap(log_odds, size, (low[0] * size, low[1] * size))
