"""Fewer of what is too many to be shown: at even intervals, and never more than asked for."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

_T = TypeVar("_T", bound=np.generic)


def evenly_thinned(items: NDArray[_T], most: int) -> NDArray[_T]:
    """Every n-th row of ``items`` (k, ...), the first one always: at most ``most`` of them."""
    return items[:: max(1, -(-len(items) // most))]


def rows_to_the_last(count: int, most: int) -> NDArray[np.int64]:
    """Numbers of rows at even intervals, of ``count``, the last one always: at most ``most`` >= 2.

    The last interval may be shorter.
    """
    last = count - 1
    return np.append(np.arange(0, last, max(1, -(-last // (most - 1)))), last)


def rows_along(
    points: NDArray[np.float64], within: float, even: int, most: int
) -> NDArray[np.int64]:
    """Numbers of rows of a path (n, 2): straight lines between them stay ``within`` of all of it.

    ``even`` >= 2 of them are at even intervals, see `rows_to_the_last`; the others are where such
    lines leave the path by the most, again and again (Douglas and Peucker 1973, all lines at once).
    At most ``most`` >= ``even``: where more are needed, those are left out that move the path by
    the least. The work grows with n times the depth of this, at most the even interval.
    """
    found = [rows_to_the_last(len(points), even)]
    begin, end = found[0][:-1], found[0][1:]
    worth = [np.full(len(found[0]), np.inf)]
    of_line = worth[0][1:]
    while True:
        long = end - begin > 1
        begin, end, of_line = begin[long], end[long], of_line[long]
        if not len(begin):
            break
        inner = end - begin - 1
        first = np.cumsum(inner) - inner
        line = np.repeat(np.arange(len(inner)), inner)
        rows = np.arange(len(line)) + np.repeat(begin + 1 - first, inner)
        off = _off_lines(points[rows], points[begin[line]], points[end[line]])
        farthest = np.maximum.reduceat(off, first)
        at = np.flatnonzero(off == farthest[line])
        at = rows[at[np.searchsorted(line[at], np.arange(len(inner)))]]
        # never more than that of the row that made the line: it is of use only with that one
        of_line = np.minimum(of_line, farthest)
        split = farthest > within
        begin, end, at, of_line = begin[split], end[split], at[split], of_line[split]
        found.append(at)
        worth.append(of_line)
        begin, end = np.concatenate([begin, at]), np.concatenate([at, end])
        of_line = np.tile(of_line, 2)
    best = np.argsort(-np.concatenate(worth), kind="stable")[:most]
    return np.sort(np.concatenate(found)[best])


def _off_lines(
    points: NDArray[np.float64], begin: NDArray[np.float64], end: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Distances (n,) of points (n, 2) from the lines between ``begin`` and ``end`` (n, 2)."""
    along, offset = end - begin, points - begin
    squared = np.einsum("ij,ij->i", along, along)
    share = np.einsum("ij,ij->i", along, offset) / np.where(squared > 0, squared, 1.0)
    offset -= np.clip(share, 0.0, 1.0)[:, None] * along
    return np.asarray(np.nan_to_num(np.hypot(*offset.T)))  # what is unknown splits no line
