"""Robust kernels as formulas: what an M-estimator's cost is, and the weight that it gives."""

import math
from collections.abc import Callable

import numpy as np

from graphslam.core.config import RobustConfig
from graphslam.core.geometry import Array

#: kernel -> weight of an observation whose whitened residual has length d, for a scale k
WEIGHTS: dict[str, Callable[[float, float], float]] = {
    "none": lambda _d, _k: 1.0,
    "huber": lambda d, k: 1.0 if d <= k else k / d,
    "cauchy": lambda d, k: k * k / (k * k + d * d),
    "geman-mcclure": lambda d, k: (k * k / (k * k + d * d)) ** 2,
}
#: kernel -> costs (n,) of whitened residuals with lengths (n,), for a scale k
LOSSES: dict[str, Callable[[Array, float], Array]] = {
    "none": lambda d, _k: 0.5 * d * d,
    "huber": lambda d, k: np.where(d <= k, 0.5 * d * d, k * (d - 0.5 * k)),
    "cauchy": lambda d, k: 0.5 * k * k * np.log1p(np.square(d / k)),
    "geman-mcclure": lambda d, k: 0.5 * np.square(k * d) / (k * k + d * d),
}
#: relative change of a weight at which reweighting ends, and its largest number of rounds:
#: convergence is linear, and what is left of it must be rounding, or two filters that are the same
#: but for rounding would stop a round apart
CONVERGED, MAX_ROUNDS = 1e-12, 500


def robust_weight(innovation: Array, HPHt: Array, R: Array, robust: RobustConfig) -> float:
    """The weight that the smoother's M-estimator would give one observation.

    It weighs by the residual that is *left* after the update, not by the innovation: a large
    innovation is no outlier where the prediction is poor. Noise R/w leaves the whitened residual
    ``u_j / (1 + w a_j)``, with a_j the eigenvalues of H P Hᵀ whitened by R and u the whitened
    innovation in their axes. Each round of reweighting lowers w or leaves it, so starting at 1 it
    converges to the largest weight that agrees with the residual it leaves.

    ``innovation`` (k,) is measured minus expected, ``HPHt`` (k, k) the covariance of the expected
    measurement, ``R`` (k, k) that of the measurement.
    """
    if robust.kernel == "none":
        return 1.0
    L = np.linalg.cholesky(R)
    a, U = np.linalg.eigh(np.linalg.solve(L, np.linalg.solve(L, HPHt).T))
    u = U.T @ np.linalg.solve(L, innovation)
    weight, scale, w = WEIGHTS[robust.kernel], robust.scale, 1.0
    axes = list(zip(u.tolist(), np.maximum(a, 0.0).tolist(), strict=True))
    for _ in range(MAX_ROUNDS):
        left = math.hypot(*(own / (1.0 + w * spread) for own, spread in axes))
        before, w = w, weight(left, scale)
        if before - w <= CONVERGED * before:
            break
    return w
