"""Which of many hypotheses agree: maximal consistent sets, leave-one-out tests, rivals, fits.

Hypotheses are judged in pairs first; the largest set that agrees in pairs is searched for greedily
(J. Mangelson et al., Pairwise consistent measurement set maximization, ICRA 2018, DOI
10.1109/ICRA.2018.8460217), and members that contradict all the others are removed.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphslam.core.arrays import IntArray
from graphslam.core.errors import EstimationError
from graphslam.core.gaussian import chi2_quantile, mahalanobis_squared
from graphslam.core.geometry import Array, transform, wrap

#: probability up to which a point or a relative pose still fits what it is compared with
FIT_PROBABILITY = 0.9999
#: m: points that lie closer together (root mean square) tell no direction
COINCIDENT_M = 1e-9
#: share of a measurement's variance by which a solution must know more than it for others to say
#: anything along that axis
LEAST_TOLD = 1e-3
#: an alternative with more than this share of the best one's support leaves a decision open
RIVAL_SHARE = 0.5
#: the same for squared Mahalanobis distances: an alternative at most this much farther off is a
#: rival. With Gaussian errors it has exp(-9/2), a hundredth, of the best one's likelihood
RIVAL_D2 = 9.0


def has_rival(support: float, others: Iterable[float], share: float = RIVAL_SHARE) -> bool:
    """Whether an alternative has more than ``share`` of the support of the best hypothesis."""
    return any(other > share * support for other in others)


def largest_consistent_set(r: Array, S: Array, probability: float, starts: int) -> list[int]:
    """Indices of the largest set found of measurements that agree with each other.

    Each must agree with the estimate alone. Two agree if, given either, the other is within its
    chi-square limit. From a set that agrees in pairs the worst is removed until each agrees with
    all the others together.

    Args:
        r: (n, 3) innovations of the measurements.
        S: (3n, 3n) their joint covariance, positive definite.
        probability: of the chi-square limits (3 degrees of freedom).
        starts: number of measurements to start the search from, the best connected first.
    """
    n, gate = len(r), chi2_quantile(probability, 3)
    blocks = S.reshape(n, 3, n, 3).transpose(0, 2, 1, 3)
    own = blocks[np.arange(n), np.arange(n)]
    gain = blocks @ np.linalg.inv(own)[None]  # [a, b]: gain of a by b
    rest = r[:, None] - (gain @ r[None, :, :, None])[..., 0]
    left = own[:, None] - gain @ blocks.transpose(1, 0, 2, 3)
    left[np.arange(n), np.arange(n)] = np.eye(3)  # of itself nothing is left
    fits = mahalanobis_squared(rest, left) <= gate
    alone = np.flatnonzero(mahalanobis_squared(r, own) <= gate)
    agree = (fits & fits.T)[np.ix_(alone, alone)]
    np.fill_diagonal(agree, False)
    best = greedy_max_clique(agree, np.ones(len(alone)), starts)
    return leave_one_out(alone[best], r, S, probability)


def leave_one_out(chosen: IntArray, r: Array, S: Array, probability: float) -> list[int]:
    """The chosen measurements that agree with all the others; the worst is removed first.

    Each removal inverts the covariance again, O(n³).

    Args:
        chosen: (m,) indices of measurements.
        r: (n, 3) innovations.
        S: (3n, 3n) their joint covariance.
        probability: of the chi-square limit (3 degrees of freedom).

    Raises:
        EstimationError: an innovation or a covariance is not a number, so nothing can be compared.
    """
    members, gate = [int(k) for k in chosen], chi2_quantile(probability, 3)
    while len(members) > 1:
        rows = np.concatenate([np.arange(3 * k, 3 * k + 3) for k in members])
        d2 = leave_one_out_distances(np.linalg.inv(S[np.ix_(rows, rows)]), r[members])
        if np.isnan(d2).any():
            raise EstimationError(
                f"{len(members)} measurements cannot be compared with each other: innovations or "
                "covariances of the estimate are not numbers; it has diverged"
            )
        if d2.max() <= gate:
            break
        members = [k for k, bad in zip(members, d2 == d2.max(), strict=True) if not bad]
    return members


def leave_one_out_distances(information: Array, r: Array) -> Array:
    """Squared Mahalanobis distances (n,) of residuals r (n, d) from what the others predict.

    Given all others, residual k is own⁻¹ (information r)_k with covariance own⁻¹, where own is the
    diagonal block (d, d) of ``information`` (nd, nd), the inverse of the joint covariance.
    """
    n, d = r.shape
    own = information.reshape(n, d, n, d)[np.arange(n), :, np.arange(n)]
    return mahalanobis_squared((information @ r.ravel()).reshape(n, d), own)


def distances_from_others(r: Array, R: Array, S: Array, inflation: float = 1.0) -> Array:
    """Squared Mahalanobis distances (n,) of measurements from what all others in a solution say.

    A measurement draws the solution to itself: one that is wrong where little else is known has
    hardly a residual. So it is compared with the solution without it (deleted residuals: R. Cook
    and S. Weisberg, Residuals and Influence in Regression, 1982). Along an axis in which the
    solution has a share s of the measurement's variance, a residual of r sigmas is r / (1 - s)
    sigmas without it, and what is measured is known to s / (1 - s) variances.

    Args:
        r: (n, d) residuals in the solution.
        R: (n, d, d) covariances of the measurements.
        S: (n, d, d) covariances of what they measure, in the solution; along the axes of R.
        inflation: factor on the covariances of what the others say.
    """
    L = np.linalg.cholesky(R)
    half = np.linalg.solve(L, S)
    share, axes = np.linalg.eigh(np.linalg.solve(L, half.mT))
    sigmas = (axes.mT @ np.linalg.solve(L, r[..., None]))[..., 0]
    left = 1.0 - share
    told = left > LEAST_TOLD  # else the others say nothing, and nothing is off
    left = np.where(told, left, 1.0)
    return np.asarray((sigmas**2 * told / (left * (left + inflation * share))).sum(axis=-1))


@dataclass(frozen=True, slots=True, eq=False)
class LeastSquaresFit:
    """Estimate ``x`` (d,) from m rows: covariance ``cov`` (d, d), ``gain`` (d, m) with x = gain b.

    ``scale``: by what ``cov`` is larger than the rows' covariance says, as residuals are; at least
    1. ``residuals`` (m,); ``information`` (m, m) is the inverse of the rows' covariance.
    """

    x: Array
    cov: Array
    gain: Array
    scale: float
    residuals: Array
    information: Array


def generalised_least_squares(
    A: Array, b: Array, S: Array, prior: Array | float = 0.0, pull: Array | float = 0.0
) -> LeastSquaresFit:
    """Solve A x = b, whose rows have correlated errors.

    Args:
        A: (m, d).
        b: (m,).
        S: (m, m) covariance of the errors of b.
        prior: information (d, d) of a prior on x.
        pull: prior information times prior mean, (d,).
    """
    m, d = A.shape
    information = np.linalg.inv(S)
    N = np.linalg.inv(A.T @ information @ A + prior)
    gain = N @ A.T @ information
    x = gain @ b + N @ np.broadcast_to(pull, d)
    e = b - A @ x
    scale = max(1.0, float(e @ information @ e) / max(m - d, 1))
    return LeastSquaresFit(x, scale * N, gain, scale, e, np.asarray(information))


def rival_set(
    agree: NDArray[Any],
    worth: Array | NDArray[np.float32],
    rest: IntArray,
    starts: int | None = None,
) -> IntArray:
    """The set among ``rest`` (k,) of which all agree in pairs and that is worth most, indices.

    See `greedy_max_clique`.
    """
    return rest[greedy_max_clique(agree[np.ix_(rest, rest)], worth[rest], starts)]


def greedy_max_clique(
    agree: NDArray[Any], worth: Array | NDArray[np.float32], starts: int | None = None
) -> IntArray:
    """Indices, in order, of a set that agrees in pairs and whose total worth is largest.

    Greedily from each start that may lead to a better one: the next member is the one that agrees
    with most of what is left.

    Args:
        agree: (n, n) bool, symmetric, False on the diagonal.
        worth: (n,) of each; single precision takes half the time where n is 1000.
        starts: number of members to start from, the best connected first; None = all.
    """
    best: list[int] = []
    most = 0.0
    possible = _worth_possible(agree, worth)
    links = agree * worth[:, None]  # what each is worth to those that agree with it
    degree = links.sum(axis=0) + worth
    for first in np.argsort(-degree, kind="stable")[:starts]:
        if degree[first] <= most:
            break
        chosen, free, total = [int(first)], agree[first], worth[first]
        gain = links[free].sum(axis=0)
        while free.any() and total + worth[free].sum() > most:
            k = int(np.where(free, gain, -1.0).argmax())
            chosen.append(k)
            total += worth[k]
            left = free & agree[k]
            gain = gain - links[free & ~left].sum(axis=0)
            free = left
        if total > most:
            best, most = chosen, float(total)
        if most >= possible:
            break
    return np.array(sorted(best), dtype=np.int64)


def _worth_possible(agree: NDArray[Any], worth: Array | NDArray[np.float32]) -> float:
    """No set that agrees in pairs is worth more: of two that disagree it has one at most.

    Disagreeing pairs are taken greedily, so the bound is tight where few disagree, and there each
    search is longest.
    """
    apart = ~agree.astype(bool)
    np.fill_diagonal(apart, False)
    free = np.ones(len(worth), dtype=bool)
    possible = float(worth.sum())
    for i in np.argsort(-apart.sum(axis=1), kind="stable"):
        rivals = np.flatnonzero(free & apart[i]) if free[i] else ()
        if len(rivals):
            j = rivals[np.argmax(worth[rivals])]
            free[[i, j]] = False
            possible -= float(min(worth[i], worth[j]))
    return possible


def fit_rigid_transform(
    p: Array, q: Array, variance: Array, turn_variance: float = np.inf
) -> tuple[Array, Array]:
    """The rigid move (3,) that takes points ``q`` (n, 2) to ``p`` (n, 2), with its covariance.

    Weighted least squares in closed form (B. Horn, JOSA A 4, 1987, DOI 10.1364/JOSAA.4.000629, in
    the plane). The covariance (3, 3), along the axes of ``p``, is scaled up where residuals are
    larger than ``variance`` (n,) says. ``turn_variance``, rad²: that of the turn without the
    points, which it does not exceed.
    """
    w = 1.0 / variance
    p_mean, q_mean = (np.average(x, axis=0, weights=w) for x in (p, q))
    u, v = p - p_mean, q - q_mean
    dot = (w * (u * v).sum(axis=1)).sum()
    cross = (w * (v[:, 0] * u[:, 1] - v[:, 1] * u[:, 0])).sum()
    pose = np.array([0.0, 0.0, np.arctan2(cross, dot)])
    pose[:2] = p_mean - transform(pose, q_mean[None])[0]
    misfit = (w * ((p - transform(pose, q)) ** 2).sum(axis=1)).sum()
    scale = max(1.0, misfit / max(2 * len(p) - 3, 1))
    turning = (w * (v**2).sum(axis=1)).sum()
    turned = 1.0 / turning if turning > w.sum() * COINCIDENT_M**2 else np.inf
    turned = min(turned, turn_variance)
    lever = pose[:2] - p_mean  # the turn is about the middle of the points
    J = np.array([-lever[1], lever[0], 1.0])
    cov = np.diag([1.0 / w.sum()] * 2 + [0.0])
    return pose, scale * (cov + (turned * np.outer(J, J) if np.isfinite(turned) else np.inf))


def poses_differ(a: Array, cov_a: Array, b: Array, cov_b: Array) -> bool:
    """Whether two poses (3,) are more apart than their covariances (3, 3) allow."""
    off = np.append(a[:2] - b[:2], wrap(a[2] - b[2]))
    return bool(mahalanobis_squared(off, cov_a + cov_b) > chi2_quantile(FIT_PROBABILITY, 3))
