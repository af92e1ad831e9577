"""Statistics of estimation errors: root mean square, NEES with its chi-square bounds, coverage."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array

#: probability of the ellipsoids whose coverage is counted, and the tails of the NEES' bounds
PROBABILITY, TAILS, TAILS_99 = 0.95, (0.025, 0.975), (0.005, 0.995)
#: draws of a weighted sum of chi-squares, and how many of its largest weights are drawn one by one
DRAWS, DRAWN = 100_000, 60
NEES_NUMBERS = (
    "nees_per_dof", "effective_poses", "nees_bounds", "nees_bounds_99", "nees_verdict", "coverage"
)  # fmt: skip
#: what a NEES says of the covariances
TOO_CONFIDENT, TOO_CAUTIOUS, CONSISTENT = "too confident", "too cautious", "consistent"


def rms(values: Array) -> float | None:
    """Root mean square of values (n,); None without values."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def whitened(errors: Array, covs: Array) -> Array:
    """Errors (n, d) divided by the Cholesky roots of their covariances (n, d, d).

    NaN where a covariance is not finite or not positive definite.
    """
    values = np.full(errors.shape, np.nan)
    good = np.asarray(np.isfinite(covs).all(axis=(1, 2)))
    try:
        L = np.linalg.cholesky(covs[good])
    except np.linalg.LinAlgError:  # says nothing of which ones
        good[good] = np.linalg.eigvalsh(covs[good])[:, 0] > 0
        L = np.linalg.cholesky(covs[good])
    values[good] = np.linalg.solve(L, errors[good][..., None])[..., 0]
    return values


def nees(errors: Array, covs: Array) -> Array:
    """Normalised estimation error squared (n,) of errors (n, d) with covariances (n, d, d).

    NaN where a covariance is not finite or not positive definite. For a consistent estimate the
    expectation is d.

    Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and
    Navigation, 2001, section 5.4, DOI 10.1002/0471221279.
    """
    return np.asarray(np.square(whitened(errors, covs)).sum(axis=1))


def effective_number(normalised: Array) -> float:
    """How many independent errors a series of `whitened` ones (n, d) is worth, 1 to n.

    n / (1 + 2 sum r(k)), r(k) the correlation of the NEES at lag k. For Gaussian errors that is
    the squared Frobenius norm of the errors' own d x d correlation (Isserlis), whose mean is known
    to be zero: a mean that is estimated from the series would hide what it has in common. The sum
    ends where a pair of neighbouring lags is no longer correlated: C. Geyer, Practical Markov chain
    Monte Carlo, Statistical Science 7, 1992, DOI 10.1214/ss/1177011137 (initial positive sequence).
    """
    n = len(normalised)
    if n < 2:
        return float(n)
    padded = 1 << (2 * n - 1).bit_length()  # a transform of this length does not wrap around
    F = np.fft.rfft(normalised, padded, axis=0)
    R = np.fft.irfft(F.conj()[:, :, None] * F[:, None, :], padded, axis=0)[:n]
    squares = np.square(R).sum(axis=(1, 2))
    if not squares[0] > 0:
        return float(n)
    pairs = np.trace(R, axis1=1, axis2=2)[: n - n % 2].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0)
    lags = 2 * int(ends[0]) if len(ends) else n
    times = 2 * float(squares[:lags].sum() / squares[0]) - 1
    return n / min(max(times, 1.0), n)


def weighted_chi2_quantiles(weights: Array, probabilities: Sequence[float]) -> Array:
    """Quantiles (p,) of the sum of chi-squares of one degree of freedom times weights (k,).

    By drawing from it `DRAWS` times, from a fixed seed. Weights behind the largest count together,
    as a chi-square with their mean and variance (B. L. Welch, The generalization of Student's
    problem, Biometrika 34, 1947, DOI 10.1093/biomet/34.1-2.28).
    """
    rng = np.random.default_rng(0)
    w = np.sort(weights)[::-1]
    drawn = np.zeros(DRAWS)
    for weight in w[:DRAWN]:
        drawn += weight * np.square(rng.standard_normal(DRAWS))
    rest = w[DRAWN:]
    if rest.sum() > 0.0:
        scale = np.square(rest).sum() / rest.sum()
        drawn += rng.gamma(rest.sum() / scale / 2.0, 2.0 * scale, DRAWS)
    return np.quantile(drawn, probabilities)


def with_joint_bounds(found: Mapping[str, Any], weights: Array) -> dict[str, Any]:
    """`nees_statistics` whose bounds are those of the stated joint covariance.

    ``weights`` (k,): see `graphslam.evaluation.joint_nees`. Poses then count as so many independent
    ones as give the NEES the same variance.
    """
    k = len(weights)
    each = weighted_chi2_quantiles(weights, (*TAILS, *TAILS_99)) / k
    low, high, low_99, high_99 = map(float, each)
    return {
        **found,
        "effective_poses": float(np.square(weights.sum()) / np.square(weights).sum() / 3.0),
        "nees_bounds": [low, high],
        "nees_bounds_99": [low_99, high_99],
        "nees_verdict": _verdict(found["nees_per_dof"], low, high),
    }


def _verdict(mean: float, low: float, high: float) -> str:
    return TOO_CONFIDENT if mean > high else TOO_CAUTIOUS if mean < low else CONSISTENT


@dataclass(frozen=True, slots=True, eq=False)
class NeesSeries:
    """The NEES (n,) of a series of errors of ``dof`` dimensions, where it has usable covariances.

    ``effective``: how many independent ones they are worth, see `effective_number`.
    """

    values: Array
    effective: float
    dof: int


def nees_series(errors: Array, covs: Array) -> NeesSeries:
    """The NEES of errors (n, d), in the order of time, with covariances (n, d, d)."""
    found = whitened(errors, covs)
    found = found[np.isfinite(found).all(axis=1)]
    effective = effective_number(found) if len(found) else 0.0
    return NeesSeries(np.square(found).sum(axis=1), effective, errors.shape[1])


def nees_statistics(series: Sequence[NeesSeries]) -> dict[str, Any]:
    """The NEES of poses, its bounds and what they say: `NEES_NUMBERS`.

    The two-sided 95 % bounds, and those of 99 %, are chi-square quantiles of a mean over the
    `effective_number` of independent poses, which is that of each series (of a robot), summed;
    where the joint covariance is known, see `with_joint_bounds`. The verdict says what it means to
    be outside those of 95 %: covariances are `TOO_CONFIDENT` or `TOO_CAUTIOUS`, else `CONSISTENT`.
    ``coverage`` is that of the 95 % ellipsoids. Without a usable covariance all are None.
    """
    each = np.concatenate([np.zeros(0), *(one.values for one in series)])
    if not len(each):
        return dict.fromkeys(NEES_NUMBERS)
    effective, d = sum(one.effective for one in series), series[0].dof
    mean = float(each.mean() / d)
    bounds = (chi2_quantile((*TAILS, *TAILS_99), d * effective) / (d * effective)).tolist()
    verdict = _verdict(mean, *bounds[:2])
    coverage = float(np.mean(each <= chi2_quantile(PROBABILITY, d)))
    numbers = (mean, effective, bounds[:2], bounds[2:], verdict, coverage)
    return dict(zip(NEES_NUMBERS, numbers, strict=True))
