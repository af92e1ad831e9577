"""Which points of two maps of one place are where they were, and which were moved.

A rigid transform keeps distances: points that did not move are as far apart in one map as in the
other (as in `relative_frames`). The maps come with the joint covariance of their points. So what
their points have in common, as a drift between two parts of a map, is no difference between them.
"""

from dataclasses import dataclass

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.consistency import (
    FIT_PROBABILITY,
    fit_rigid_transform,
    greedy_max_clique,
    has_rival,
    leave_one_out_distances,
    rival_set,
)
from graphslam.core.gaussian import chi2_quantile, mahalanobis_squared
from graphslam.core.geometry import Array, transform

#: m: sigma that is added to where each session sees a point, for errors that its sightings share
FLOOR_M = 0.02
#: points that have to stand where they stood: two always agree with some motion
LEAST_COMMON = 3
#: probability of the chi-square gate of the difference of two distances
AGREE = 0.99
#: squared distance of a point from where others predict it, up to which it did not move
GATE = chi2_quantile(FIT_PROBABILITY, 2)
#: m², rad²: variances of the pose of one session in another before any point is compared
UNKNOWN = np.array([1e2, 1e2, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class CommonPoints:
    """Points of a session that are where they were before.

    ``which`` (k,): their indices; ``pose`` (3,) takes the session's points to those before.
    ``is_open``: nearly as many others agree on another pose.
    """

    which: IntArray
    pose: Array
    is_open: bool


def common_points(before: Array, now: Array, cov: Array) -> CommonPoints | None:
    """Which of n points of two sessions are where they were: the most that a motion explains.

    The largest set whose distances agree is found first. Each of it has to be where the others
    predict it, and all that is where they predict it belongs to it. The work grows with the cube of
    the number of points.

    Args:
        before: points (n, 2) m of earlier sessions.
        now: the same (n, 2) of another session; one point may be in it more than once.
        cov: (2n, 2n) m², of the differences ``before - now``.

    Returns:
        None if fewer than `LEAST_COMMON` agree, which tells nothing.
    """
    if len(before) < LEAST_COMMON:
        return None
    n = len(before)
    cov = cov + FLOOR_M**2 * np.eye(2 * n)
    blocks = cov.reshape(n, 2, n, 2).transpose(0, 2, 1, 3)
    own = blocks[np.arange(n), np.arange(n)]
    p, q = before[:, None] - before, now[:, None] - now
    far = np.hypot(p[..., 0], p[..., 1])
    along = p / np.maximum(far, FLOOR_M)[..., None]
    spread = own[:, None] + own - blocks - blocks.transpose(1, 0, 2, 3)
    variance = np.einsum("ijk,ijkl,ijl->ij", along, spread, along)
    apart = (far > 0.0) & (q != 0.0).any(axis=-1)  # else they share a point
    off = far - np.hypot(q[..., 0], q[..., 1])
    agree = apart & (off**2 <= chi2_quantile(AGREE, 1) * variance)
    best = _fit(greedy_max_clique(agree, np.ones(n)), before, now, cov)
    if best is None:
        return None
    # what they predict, of which some may be no farther from all others by chance
    chosen = best.members.tolist()
    for k in np.argsort(best.d2).tolist():
        if k not in chosen and best.d2[k] <= GATE and apart[k, chosen].all():
            chosen.append(k)
    rest = np.setdiff1d(np.arange(n), chosen)
    rival = _fit(rival_set(agree, np.ones(n), rest), before, now, cov)
    is_open = rival is not None and has_rival(len(chosen), [len(rival.members)])
    return CommonPoints(np.array(sorted(chosen)), best.pose, is_open)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """The ``pose`` (3,) that takes points now to those before, by those with indices ``members``.

    ``d2`` (n,): squared distance of each point from where the (other) members predict it.
    """

    members: IntArray
    pose: Array
    d2: Array


def _fit(members: IntArray, before: Array, now: Array, cov: Array) -> _Fit | None:
    """The pose by points that agree with each other, the worst left out first; of at least three.

    Nothing is known of the pose but by them: its errors are in the covariance.
    """
    pose = np.zeros(3)
    for _ in range(len(members)):
        if len(members) < LEAST_COMMON:
            return None
        # weights hardly matter for where it is computed
        pose, _ = fit_rigid_transform(before[members], now[members], np.ones(len(members)))
        there = transform(pose, now)
        turned = np.column_stack([pose[1] - there[:, 1], there[:, 0] - pose[0]])
        J = np.concatenate([np.tile(np.eye(2), (len(now), 1)), turned.reshape(-1, 1)], axis=1)
        S = cov + J @ np.diag(UNKNOWN) @ J.T
        rows = np.column_stack([2 * members, 2 * members + 1]).ravel()
        e = (before - there).ravel()
        information = np.linalg.inv(S[np.ix_(rows, rows)])
        gain = S[:, rows] @ information
        left = (e - gain @ e[rows]).reshape(-1, 2)
        spread = (S - gain @ S[rows]).reshape(len(now), 2, len(now), 2)
        own = spread[np.arange(len(now)), :, np.arange(len(now))]
        others = np.setdiff1d(np.arange(len(now)), members)
        d2 = np.empty(len(now))
        d2[others] = mahalanobis_squared(left[others], own[others])
        d2[members] = leave_one_out_distances(information, e[rows].reshape(-1, 2))
        if d2[members].max() <= GATE:
            moved = np.diag(UNKNOWN) @ J[rows].T @ information @ e[rows]
            return _Fit(members, pose + moved, d2)
        members = np.delete(members, d2[members].argmax())
    return None
