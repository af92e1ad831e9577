"""Vertical cylinders (trees, poles, table legs) as points: thesis 7.2, "additional landmarks".

A cylinder stands free: a few consecutive returns with everything beside them farther away. Both of
its edges are then visible, and their directions tell as much as the ranges: the ranges of a thin
cylinder hardly show that it is round. The circle is fitted to both.

Symbols: beta, rho bearing (rad) and range (m) of the centre, R radius (m), phi direction of a beam,
delta = phi - beta.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from graphslam.core.config import FrontEndConfig
from graphslam.core.geometry import Array, wrap
from graphslam.core.records import Observation
from graphslam.perception.beam_noise import range_variance
from graphslam.perception.line_moments import fitted_lines, mean_square, mean_square_range
from graphslam.perception.ordered_scan import Indices, Mask, Sweep
from graphslam.perception.segments import MISSING_BEAMS

ITERATIONS = 3
"""Of Gauss-Newton, before and after outliers are removed; the edges give a good initial value."""

DAMPING = 1.0
"""1/m², 1/rad²: keeps the normal matrix regular at grazing incidence; the covariance is large."""

GRAZING = 0.2
"""Beams with a smaller cosine of incidence are not used: the linearisation fails there."""

FIT_PROBABILITY = 0.01
"""Significance of the chi-square test: clusters that fit worse than this share of circles."""

OUTLIER_SIGMAS = 4.0
"""The first and the last return may be mixed pixels: removed if their residual is larger."""


@dataclass(frozen=True, slots=True, eq=False)
class Circles:
    """Circles (m) fitted to returns, laser frame.

    ``state`` (m, 3): beta rad, rho m, R m. ``cov`` (m, 3, 3) of it, without floors. ``chi2`` (m,)
    of ranges and edges, with ``dof`` (m,); ``range_chi2`` (m,) of the ranges alone.
    """

    state: Array
    cov: Array
    chi2: Array
    dof: Indices
    range_chi2: Array


def cylinders(sweep: Sweep, config: FrontEndConfig) -> tuple[tuple[Observation, ...], Sweep]:
    """Cylinders of one scan, and the scan without their ``points``; its ranges stay.

    Observations are of kind ``point``: bearing and range of the centre, laser frame.
    """
    first, last = free_standing_runs(sweep, config)
    if not len(first):
        return (), sweep
    circles = fit_circles(sweep, first, last, config)
    radius = circles.state[:, 2]
    good = (radius >= config.cylinder_min_radius_m) & (radius <= config.cylinder_max_radius_m)
    good &= circles.chi2 <= chdtri(circles.dof, FIT_PROBABILITY)
    good &= circles.range_chi2 <= _line_chi2(sweep, first, last, config)
    floor = config.floor_normal_m**2
    seen = tuple(
        Observation("point", z[:2], P[:2, :2] + floor * np.diag([z[1] ** -2, 1.0]))
        for z, P in zip(circles.state[good], circles.cov[good], strict=True)
    )
    left = np.ones(len(sweep.beam), dtype=np.bool_)
    for i, j in zip(first[good], last[good], strict=True):
        left[i : j + 1] = False
    return seen, replace(sweep, beam=sweep.beam[left], points=sweep.points[left])


def free_standing_runs(sweep: Sweep, config: FrontEndConfig) -> tuple[Indices, Indices]:
    """First and last row of the runs of returns that may be a cylinder.

    On both sides the next return is more than ``gap_m`` farther away, or missing for more beams
    than drop-outs explain.
    """
    k = len(sweep.beam)
    if k < config.cylinder_points:
        none = np.zeros(0, dtype=np.intp)
        return none, none
    x, y = sweep.points.T
    r = sweep.ranges[sweep.beam]
    beam = np.concatenate(([-1], sweep.beam, [len(sweep.ranges)]))
    missing = beam[1:] - beam[:-1] > MISSING_BEAMS + 1  # (k + 1,) between rows i - 1 and i
    step = np.concatenate(([0.0], np.hypot(x[1:] - x[:-1], y[1:] - y[:-1]), [0.0]))
    rise = np.concatenate(([0.0], r[1:] - r[:-1], [0.0]))
    cut = missing | (step > config.gap_m)
    cut[0] = cut[-1] = True
    border = np.flatnonzero(cut)
    first, last = border[:-1], border[1:] - 1
    # a cut without missing beams is a step in range: up on leaving the object
    free = (missing[first] | (rise[first] < -config.gap_m / 2)) & (
        missing[last + 1] | (rise[last + 1] > config.gap_m / 2)
    )
    wide = np.hypot(x[last] - x[first], y[last] - y[first]) > 2 * config.cylinder_max_radius_m
    good = free & ~wide & (last - first + 1 >= config.cylinder_points)
    return first[good], last[good]


def fit_circles(sweep: Sweep, first: Indices, last: Indices, config: FrontEndConfig) -> Circles:
    """Weighted least squares of circles from ranges and edges, by Gauss-Newton.

    The range of a beam that hits the circle is rho cos(delta) - sqrt(R² - rho² sin²(delta)), with
    noise of the range along the beam. The circle's edges, beta ± asin(R / rho), lie between
    the last beam that hit it and the next: half a beam beyond, with a sigma of one beam. The
    returns of each circle are those from row ``first`` (m,) to ``last`` (m,), inclusive.
    """
    counts = last - first + 1
    column = np.arange(counts.max())
    rows = np.minimum(first[:, None] + column, last[:, None])
    used = column < counts[:, None]
    beam = sweep.beam[rows]
    r, phi = sweep.ranges[beam], sweep.angles[beam]
    half = sweep.step_rad / 2
    # a full circle's beams may pass pi; edges relative to the first beam do not
    low = phi[:, 0] - half
    high = low + wrap(phi[np.arange(len(first)), counts - 1] - phi[:, 0]) + 2 * half
    half_width = np.sin(np.clip((high - low) / 2, half, 1.2))
    nearest = np.where(used, r, np.inf).min(axis=1)
    R = nearest * half_width / (1 - half_width)
    state = np.array(((low + high) / 2, nearest + R, R)).T
    edges = np.array((low, high)).T
    variance, edge_sigma = range_variance(config, r * r), sweep.step_rad
    for round_ in range(2):
        for _ in range(ITERATIONS):
            e, J, w = _residuals(state, r, phi, used, edges, variance, edge_sigma)
            N = np.einsum("mni,mn,mnj->mij", J, w, J) + DAMPING * np.eye(3)
            step = np.linalg.solve(N, np.einsum("mni,mn,mn->mi", J, w, e)[..., None])[..., 0]
            R = np.clip(state[:, 2] + step[:, 2], 0.5 * state[:, 2], 2 * state[:, 2])
            rho = np.maximum(state[:, 1] + step[:, 1], nearest + 0.2 * R)
            state = np.array((state[:, 0] + step[:, 0], rho, R)).T
        e, J, w = _residuals(state, r, phi, used, edges, variance, edge_sigma)
        if round_ == 0:
            ends = (column == 0) | (column == counts[:, None] - 1)
            used &= ~(ends & (np.abs(e[:, :-2]) > OUTLIER_SIGMAS * np.sqrt(variance)))
    N = np.einsum("mni,mn,mnj->mij", J, w, J) + DAMPING * np.eye(3)
    square = w * e * e
    state[:, 0] = wrap(state[:, 0])
    return Circles(
        state,
        np.linalg.inv(N),
        square.sum(axis=1),
        np.maximum(np.count_nonzero(w, axis=1) - 3, 1),
        square[:, :-2].sum(axis=1),
    )


def _residuals(
    state: Array,
    r: Array,
    phi: Array,
    used: Mask,
    edges: Array,
    variance: Array | float,
    edge_sigma: float,
) -> tuple[Array, Array, Array]:
    """Residuals (m, n + 2), measured minus predicted, derivatives (m, n + 2, 3), weights."""
    beta, rho, R = state.T[:, :, None]
    delta = wrap(phi - beta)
    c, s = np.cos(delta), np.sin(delta)
    under = R * R - (rho * s) ** 2
    root = np.sqrt(np.maximum(under, (GRAZING * R) ** 2))
    J = np.zeros((*r.shape[:1], r.shape[1] + 2, 3))
    J[:, :-2, 0] = rho * s - rho * rho * s * c / root  # d delta / d beta = -1
    J[:, :-2, 1] = c + rho * s * s / root
    J[:, :-2, 2] = -R / root
    ratio = np.minimum(R / rho, 0.95)[:, 0]
    slope = 1 / (rho[:, 0] * np.sqrt(1 - ratio * ratio))
    half_width = np.arcsin(ratio)
    J[:, -2:, 0] = 1.0
    for n, sign in ((-2, -1.0), (-1, 1.0)):
        J[:, n, 1], J[:, n, 2] = -sign * slope * ratio, sign * slope
    expected = beta + half_width[:, None] * np.array((-1.0, 1.0))
    e = np.concatenate((r - (rho * c - root), wrap(edges - expected)), axis=1)
    w = np.full(e.shape, edge_sigma**-2)
    w[:, :-2] = (used & (under > (GRAZING * R) ** 2)) / variance
    return e, J, w


def _line_chi2(sweep: Sweep, first: Indices, last: Indices, config: FrontEndConfig) -> Array:
    """(m,) chi-square of straight lines through the same returns."""
    sums = np.cumsum(sweep.moments, axis=1)
    M = sums[:, last] - np.where(first > 0, sums[:, first - 1], 0.0)
    variance = range_variance(config, mean_square_range(M))
    return np.asarray(M[0] * mean_square(fitted_lines(M), M) / variance)
