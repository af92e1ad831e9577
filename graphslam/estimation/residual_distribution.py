"""How the residuals of a source of measurements are distributed: their size and their tails.

A Student distribution fits both: few degrees of freedom where there are outliers, many where the
noise is Gaussian (K. L. Lange, R. J. A. Little and J. M. G. Taylor, Robust statistical modeling
using the t distribution, JASA 84, 1989, DOI 10.1080/01621459.1989.10478852). Its weights are those
of a Cauchy kernel whose squared scale is the number of degrees of freedom.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from graphslam.core.geometry import Array
from graphslam.estimation.posterior_residuals import Residuals
from graphslam.odometry.noise_estimation import CLIP_SIGMAS, SIGMA_OF_MEDIAN

#: degrees of freedom that are tried; with the most of them a kernel hardly weights anything, but
#: still bounds the influence of a gross error
DEGREES_OF_FREEDOM = (2.0, 3.0, 5.0, 8.0, 13.0, 20.0, 35.0, 60.0)
#: rounds of expectation maximisation, after which the scale changes by less than a thousandth
ROUNDS = 12
#: squared residuals, at least: those that are all zero have a size all the same
LEAST_VARIANCE = 1e-12
#: a shared error is significant if its variance is so many of the sigmas that it has by chance
SIGNIFICANT_SIGMAS = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class ResidualDistribution:
    """``variance`` (k,): factors on the variances stated; ``kernel_scale``: of a Cauchy kernel.

    Under that kernel with these variances the information of a measurement is, on average, what
    such an M-estimator gets from it: the factors contain the ratio of the two (P. J. Huber, Robust
    Statistics, 1981, section 6.3).
    """

    variance: Array
    kernel_scale: float


def fit_distribution(normalised: Array) -> ResidualDistribution:
    """The distribution of residuals (n, k), each divided by the sigma that it should have."""
    squared = np.maximum(np.square(normalised), LEAST_VARIANCE)
    fits = _fits(np.ascontiguousarray(squared.T))
    best = int(fits.likelihood.argmax())
    variance, nu = fits.variance[best], DEGREES_OF_FREEDOM[best]
    k = normalised.shape[1]
    d2 = (squared / variance).sum(axis=1)
    w = 1.0 / (1.0 + d2 / nu)
    slope = float(np.mean(w - 2.0 * w**2 * d2 / (nu * k)))
    factor = float(np.mean(w) * np.mean(w**2 * d2) / k / slope**2)
    return ResidualDistribution(variance * factor, math.sqrt(nu / factor))


class _Fits(NamedTuple):
    """Log likelihoods (f,) and variances (f, k) of the scale, for each of `DEGREES_OF_FREEDOM`."""

    likelihood: Array
    variance: Array


def _fits(squared: Array) -> _Fits:
    """Distributions of residuals, ``squared`` (k, n), each row contiguous."""
    k, n = squared.shape
    nu = np.array(DEGREES_OF_FREEDOM)[:, None]
    # a median of squares of normal variables is 0.455
    begin = np.median(squared, axis=1) / 0.455
    variance = np.tile(begin, (len(nu), 1))
    for _ in range(ROUNDS):
        variance = ((nu + k) / (nu + 1.0 / variance @ squared)) @ squared.T / n
    each = [
        math.lgamma((v + k) / 2) - math.lgamma(v / 2) - k / 2 * math.log(v * math.pi)
        for v in DEGREES_OF_FREEDOM
    ]
    tails = -(nu[:, 0] + k) / 2 * np.log1p(1.0 / variance @ squared / nu).sum(axis=1)
    return _Fits(n * (each - 0.5 * np.log(variance).sum(axis=1)) + tails, variance)


def shared_variance(found: Residuals) -> Array:
    """Factors (k,) on the variances of shared errors that make them likeliest; 0 where none shows.

    Without its prior, the estimate of an error would be its residual over its redundancy, with the
    variance that the other measurements leave: from those of all errors the factor follows by
    scoring. It counts only if it is significant.
    """
    factors = np.zeros(found.residual.shape[1])
    for axis in range(len(factors)):
        variance, left = found.variance[:, axis], found.redundancy[:, axis]
        error = found.residual[:, axis] / left / np.sqrt(variance)
        known = (1.0 - left) / left  # variance of that estimate, if there were no shared error
        x = 1.0
        for _ in range(ROUNDS):
            squared = error**2 / (x + known)
            # a few wrong identities are not the noise
            squared = np.minimum(squared, (CLIP_SIGMAS * SIGMA_OF_MEDIAN) ** 2 * np.median(squared))
            weight = (x + known) ** -2.0
            x = max(0.0, float(weight @ (squared * (x + known) - known) / weight.sum()))
        sigma = math.sqrt(2.0 / np.sum(np.maximum(known, 1e-12) ** -2.0))
        factors[axis] = x if x > SIGNIFICANT_SIGMAS * sigma else 0.0
    return factors
