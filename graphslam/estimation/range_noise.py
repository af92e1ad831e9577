"""How the noise of ranges grows with the range: the same everywhere, in proportion to it, or both.

A laser's noise hardly depends on the range, that of a camera, which measures how large a thing
looks, is a share of it. Where a log does not state it the residuals tell.
"""

import math
from typing import NamedTuple

import numpy as np

from graphslam.core.geometry import Array

#: degrees of freedom of the Student distribution of the residuals, as for sightings with some
#: outliers: they are to tell little of how the noise grows
NU = 5.0
#: rounds of expectation maximisation
ROUNDS = 30
#: of the log likelihood: a model with one number more that gains less is not taken
GAIN = 8.0


class RangeNoise(NamedTuple):
    """Variance of the noise of a range r, m²: ``constant_m2`` + ``share2`` r²."""

    constant_m2: float
    share2: float

    def variance(self, ranges: Array) -> Array:
        """Of ranges (n,), m²."""
        return np.asarray(self.constant_m2 + self.share2 * ranges**2)

    @classmethod
    def behind(cls, ranges: Array, variances: Array) -> "RangeNoise":
        """The model that variances (n,) of ranges follow: exactly if they do, else the nearest."""
        A = np.column_stack([np.ones_like(ranges), ranges**2]) / variances[:, None]
        found, *_ = np.linalg.lstsq(A, np.ones_like(ranges))
        return cls(*np.maximum(found, 0.0).tolist())


def likelier_range_noise(ranges: Array, residual: Array, present: Array) -> RangeNoise | None:
    """What makes residuals likelier than multiples of their ``present`` variances do, else None.

    Args:
        ranges: (n,) m.
        residual: (n,) m, each as large as an error of the range by itself would be.
        present: (n,) m², of the model that is in use.
    """
    squared = residual**2
    scale = np.ones(1)
    for _ in range(ROUNDS):
        scale = np.array([np.mean(_weights(squared, scale * present) * squared / present)])
    before = _log_likelihood(squared, scale * present)
    basis = np.column_stack([np.ones_like(ranges), ranges**2])
    both = _fit(basis, squared)
    ends = [
        np.append(_fit(basis[:, :1], squared), 0.0),
        np.append(0.0, _fit(basis[:, 1:], squared)),
    ]
    found, likelihood = max(
        ((v, _log_likelihood(squared, basis @ v)) for v in (both, *ends)), key=lambda pair: pair[1]
    )
    return RangeNoise(*found.tolist()) if likelihood > before + GAIN else None


def _fit(basis: Array, squared: Array) -> Array:
    """Coefficients (k,), none below zero, of the variance ``basis`` (n, k) @ them, by scoring."""
    at = np.full(basis.shape[1], np.mean(squared)) / basis.mean(axis=0) / basis.shape[1]
    for _ in range(ROUNDS):
        v = basis @ at
        target = _weights(squared, v) * squared
        weighed = basis / v[:, None]
        found = np.linalg.solve(weighed.T @ weighed, weighed.T @ (target / v))
        # a part that comes out negative is nearly none; zero it would stay
        at = np.maximum(found, 1e-3 * at)
    return np.asarray(at)


def _weights(squared: Array, variance: Array) -> Array:
    return (NU + 1.0) / (NU + squared / variance)


def _log_likelihood(squared: Array, variance: Array) -> float:
    each = 0.5 * np.log(variance) + 0.5 * (NU + 1.0) * np.log1p(squared / variance / NU)
    total = -float(each.sum())
    return total if math.isfinite(total) else -math.inf
