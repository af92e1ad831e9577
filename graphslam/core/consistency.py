"""Which of many hypotheses agree: maximal consistent sets, leave-one-out tests, rigid fits.

Hypotheses are judged in pairs first; the largest set that agrees in pairs is looked for greedily
(J. Mangelson et al., Pairwise consistent measurement set maximization, ICRA 2018, DOI
10.1109/ICRA.2018.8460217), and members that all the others contradict leave it.
"""

import numpy as np
from numpy.typing import NDArray

from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, transform, wrap

IntArray = NDArray[np.int64]

#: probability up to which a point or a relative pose still fits what it is compared with
FIT = 0.9999


def largest_consistent_set(r: Array, S: Array, probability: float, starts: int) -> list[int]:
    """Indices of the largest set found of measurements that agree with each other.

    Each must agree with the estimate alone. Two agree if, given either, the other is within its
    chi-square limit. Of those that agree in pairs the worst leaves until each agrees with all the
    others together.

    Args:
        r: (n, 3) innovations of the measurements.
        S: (3n, 3n) their joint covariance, positive definite.
        probability: of the chi-square limits (3 degrees of freedom).
        starts: with how many measurements the search begins, those first that most agree with.
    """
    n, gate = len(r), chi2_quantile(probability, 3)
    blocks = S.reshape(n, 3, n, 3).transpose(0, 2, 1, 3)
    own = blocks[np.arange(n), np.arange(n)]
    gain = blocks @ np.linalg.inv(own)[None]  # [a, b]: what b says of a
    rest = r[:, None] - (gain @ r[None, :, :, None])[..., 0]
    left = own[:, None] - gain @ blocks.transpose(1, 0, 2, 3)
    left[np.arange(n), np.arange(n)] = np.eye(3)  # of itself nothing is left
    given = (rest * np.linalg.solve(left, rest[..., None])[..., 0]).sum(axis=-1)
    fits = given <= gate
    alone = np.flatnonzero(np.einsum("ai,aij,aj->a", r, np.linalg.inv(own), r) <= gate)
    agree = (fits & fits.T)[np.ix_(alone, alone)]
    np.fill_diagonal(agree, False)
    best = greedy_max_clique(agree, np.ones(len(alone)), starts)
    return leave_one_out(alone[best], r, S, probability)


def leave_one_out(chosen: IntArray, r: Array, S: Array, probability: float) -> list[int]:
    """Those of the chosen measurements that all the others bear out; the worst leaves first.

    The inverse of the chosen measurements' covariance has in its blocks what the others leave of
    each: its residual is own⁻¹ pull and that residual's covariance own⁻¹. Each removal inverts
    again, O(n³).

    Args:
        chosen: (m,) indices of measurements.
        r: (n, 3) innovations.
        S: (3n, 3n) their joint covariance.
        probability: of the chi-square limit (3 degrees of freedom).
    """
    members, gate = [int(k) for k in chosen], chi2_quantile(probability, 3)
    while len(members) > 1:
        rows = np.concatenate([np.arange(3 * k, 3 * k + 3) for k in members])
        information = np.linalg.inv(S[np.ix_(rows, rows)])
        pull = (information @ r[members].ravel()).reshape(-1, 3, 1)
        diagonal = np.arange(len(members))
        own = information.reshape(len(members), 3, -1, 3)[diagonal, :, diagonal]
        d2 = (pull.mT @ np.linalg.solve(own, pull)).ravel()
        if d2.max() <= gate:
            break
        members = [k for k, bad in zip(members, d2 == d2.max(), strict=True) if not bad]
    return members


def greedy_max_clique(
    agree: Array, worth: Array | NDArray[np.float32], starts: int | None = None
) -> IntArray:
    """Indices, in order, of the set found of which all agree in pairs and that is worth most.

    Greedily from each that might have a better one: next comes whatever agrees with most of what
    is left.

    Args:
        agree: (n, n) bool, symmetric, False on the diagonal.
        worth: (n,) of each; single precision takes half the time where n is 1000.
        starts: from how many the search begins at most, the best connected first.
    """
    best: list[int] = []
    most = 0.0
    links = agree * worth
    degree = links.sum(axis=1) + worth
    for first in np.argsort(-degree, kind="stable")[:starts]:
        if degree[first] <= most:
            break
        chosen, free, total = [int(first)], agree[first].copy(), worth[first]
        while free.any() and total + worth[free].sum() > most:
            k = int(np.where(free, links @ free, -1.0).argmax())
            chosen.append(k)
            total += worth[k]
            free &= agree[k]
        if total > most:
            best, most = chosen, float(total)
    return np.array(sorted(best), dtype=np.int64)


def fit_rigid_transform(p: Array, q: Array, variance: Array) -> tuple[Array, Array]:
    """The rigid move (3,) that takes points ``q`` (n, 2) to ``p`` (n, 2), with its covariance.

    Weighted least squares in closed form (B. Horn, JOSA A 4, 1987, DOI 10.1364/JOSAA.4.000629, in
    the plane). The covariance (3, 3), along the axes of ``p``, is scaled up where residuals are
    larger than ``variance`` (n,) says.
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
    turned = 1.0 / turning if turning > 0 else np.inf
    lever = pose[:2] - p_mean  # the turn is about the middle of the points
    J = np.array([-lever[1], lever[0], 1.0])
    cov = np.diag([1.0 / w.sum()] * 2 + [0.0])
    return pose, scale * (cov + (turned * np.outer(J, J) if np.isfinite(turned) else np.inf))


def poses_differ(a: Array, cov_a: Array, b: Array, cov_b: Array) -> bool:
    """Whether two poses (3,) are more apart than their covariances (3, 3) allow."""
    off = np.append(a[:2] - b[:2], wrap(a[2] - b[2]))
    return bool(off @ np.linalg.solve(cov_a + cov_b, off) > chi2_quantile(FIT, 3))
