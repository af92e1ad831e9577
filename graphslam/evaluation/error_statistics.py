"""Statistics of estimation errors: root mean square, NEES with its chi-square bounds, coverage."""

from typing import Any

import numpy as np

from graphslam.core.gaussian import chi2_quantile, mahalanobis_squared
from graphslam.core.geometry import Array

#: probability of the ellipsoids whose coverage is counted, and the tails of the NEES' bounds
PROBABILITY, TAILS = 0.95, (0.025, 0.975)


def rms(values: Array) -> float | None:
    """Root mean square of values (n,); None without values."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def nees(errors: Array, covs: Array) -> Array:
    """Normalised estimation error squared (n,) of errors (n, d) with covariances (n, d, d).

    NaN where a covariance is not finite or not positive definite. For a consistent estimate the
    expectation is d.

    Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and
    Navigation, 2001, section 5.4, DOI 10.1002/0471221279.
    """
    values = np.full(len(errors), np.nan)
    good = np.flatnonzero(np.isfinite(covs).all(axis=(1, 2)))
    good = good[np.linalg.eigvalsh(covs[good])[:, 0] > 0]
    values[good] = mahalanobis_squared(errors[good], covs[good])
    return values


def nees_statistics(errors: Array, covs: Array) -> dict[str, Any]:
    """``nees_per_dof``, its two-sided 95 % ``nees_bounds`` and ``coverage`` of the 95 % ellipsoids.

    The bounds are chi-square quantiles of a mean over n *independent* poses. Poses of one run are
    strongly correlated, so one run leaves the bounds far more often than in 5 % of cases: the
    bounds are a scale to read the number on, and a test of consistency needs many runs. Without a
    usable covariance all three are None.

    Args:
        errors: (n, d).
        covs: (n, d, d), along the same axes.
    """
    values = nees(errors, covs)
    values = values[np.isfinite(values)]
    if not len(values):
        return {"nees_per_dof": None, "nees_bounds": None, "coverage": None}
    dof = errors.shape[1]
    n = dof * len(values)
    return {
        "nees_per_dof": float(values.mean() / dof),
        "nees_bounds": [float(q) for q in chi2_quantile(TAILS, n) / n],
        "coverage": float(np.mean(values <= chi2_quantile(PROBABILITY, dof))),
    }
