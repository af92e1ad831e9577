"""The split of thesis 4.7.6 as printed: by the variance of the deviations, from a whole scan."""

import numpy as np

from graphslam.core.geometry import Array
from graphslam.perception.ordered_scan import Indices


def split_by_variance(
    points: Array, first: int, last: int, allowed_m2: float, fewest: int
) -> list[tuple[int, int]]:
    """Runs of returns (first, last), both included, in order; neighbours share a return.

    0. One segment from the first to the last return. 1. Stop if the variance of the orthogonal
    deviations from it is below the allowed one. 2. Else split at the farthest return. 3. Go on with
    the parts that have enough returns; the others are dropped.

    Args:
        points: (k, 2) m, in the order of the beams.
        first: row of the first return.
        last: row of the last one.
        allowed_m2: mean square deviation from the chord between both ends.
        fewest: returns of a part.
    """
    found: list[tuple[int, int]] = []
    waiting = [(first, last)]
    while waiting:
        i, j = waiting.pop()
        if j - i + 1 < fewest:
            continue
        deviation = _deviations(points[i : j + 1])
        k = i + int(deviation.argmax())
        if float(deviation @ deviation) <= allowed_m2 * len(deviation) or k in (i, j):
            found.append((i, j))
        else:
            waiting += [(k, j), (i, k)]  # the last one is next
    return found


def _deviations(points: Array) -> Array:
    """Distances (k,) of points (k, 2) from the line through the first and the last, m."""
    chord = points[-1] - points[0]
    away = points - points[0]
    length = float(np.hypot(*chord))
    if length == 0.0:
        return np.asarray(np.hypot(*away.T))
    return np.asarray(np.abs(chord[0] * away[:, 1] - chord[1] * away[:, 0]) / length)


def first_and_last(runs: list[tuple[int, int]]) -> tuple[Indices, Indices]:
    """Runs as two arrays (p,)."""
    both = np.array(runs, dtype=np.intp).reshape(-1, 2)
    return both[:, 0], both[:, 1]
