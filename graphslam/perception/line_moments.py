"""Moments of sets of returns, from which the deviation from any line follows.

The moments of returns are the sums of 1, x, y, x², xy, y²: M (6,). A line is a vector q (6,) such
that q·M / M[0] is the mean square deviation of those returns from it. So one product tests any set
of returns against any line, and the moments of a union are a sum.
"""

import math

import numpy as np

from graphslam.core.geometry import Array


def point_moments(points: Array) -> Array:
    """1, x, y, x², xy, y² of each of ``points`` (k, 2): (6, k)."""
    x, y = points.T
    return np.array((np.ones(len(x)), x, y, x * x, x * y, y * y))


def fitted_lines(moments: Array) -> Array:
    """The least-squares lines q (6, p) of p sets of returns with ``moments`` (6, p)."""
    x, y, xx, xy, yy = moments[1:] / moments[0]
    direction = 0.5 * np.arctan2(2 * (xy - x * y), xx - x * x - yy + y * y)
    a, b = -np.sin(direction), np.cos(direction)
    return _lines(a, b, a * x + b * y)


def offset_lines(d: Array, gamma: Array) -> Array:
    """The lines q (6, p) at distances d (p,) m, with normals in the directions gamma (p,) rad."""
    return _lines(np.cos(gamma), np.sin(gamma), d)


def _lines(a: Array, b: Array, d: Array) -> Array:
    """The lines a x + b y = d as q (6, p); a² + b² = 1."""
    return np.array((d * d, -2 * d * a, -2 * d * b, a * a, 2 * a * b, b * b))


def fitted_line(moments: Array) -> tuple[Array, float]:
    """One of `fitted_lines`, q (6,), and its direction in rad: for one line ten times as fast."""
    n, sx, sy, sxx, sxy, syy = moments.tolist()
    x, y = sx / n, sy / n
    direction = 0.5 * math.atan2(2 * (sxy / n - x * y), sxx / n - x * x - syy / n + y * y)
    a, b = -math.sin(direction), math.cos(direction)
    d = a * x + b * y
    return np.array((d * d, -2 * d * a, -2 * d * b, a * a, 2 * a * b, b * b)), direction


def mean_square(lines: Array, moments: Array) -> Array:
    """Mean square deviation (p,), m², of returns with ``moments`` (6, p) from ``lines`` (6, p)."""
    return np.asarray((lines * moments).sum(axis=0) / moments[0])


def mean_square_range(moments: Array) -> Array:
    """Mean squares (p,), m², of the ranges of returns with ``moments`` (6, p)."""
    return np.asarray((moments[3] + moments[5]) / moments[0])


def least_squares(moments: Array) -> Array:
    """Sums (p,), m², of squared deviations of returns with ``moments`` (6, p) from their lines."""
    n, x, y, xx, xy, yy = moments
    xx, xy, yy = xx - x * x / n, xy - x * y / n, yy - y * y / n
    return np.asarray(np.maximum(0.5 * (xx + yy - np.hypot(xx - yy, 2 * xy)), 0.0))
