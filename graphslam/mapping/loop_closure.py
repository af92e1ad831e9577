"""Loop closure: revisited places are found and verified by matching submaps.

Where two submaps may overlap according to the estimate, the later one is searched for in the
earlier (`scan_matching`). A match is verified if most points of either submap are confirmed by the
other, few points lie in the other's free space, its position has a small sigma in every direction,
and no second match in the window is nearly as good. Of all verified closures the largest consistent
set is used, under the joint covariance of the estimate: J. Mangelson et al., ICRA 2018, DOI
10.1109/ICRA.2018.8460217, who judge pairwise consistency by odometry.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from graphslam.core.config import LoopClosureConfig
from graphslam.core.consistency import has_rival, largest_consistent_set
from graphslam.core.gaussian import mahalanobis_squared
from graphslam.core.geometry import Array, between, log, rotate_cov, rotation3
from graphslam.core.records import Closure, Trajectory
from graphslam.core.worker import parallel_map
from graphslam.mapping.submaps import State, SubmapPose, drift_covariance
from graphslam.perception.scan_matching import IntArray, Match, Submap, agreement, align, match

#: m between the middles of submaps that may show one place: the default reach of a submap
NEAR_M = 3.0
#: half the window of a search: so many sigmas of the relative pose, and this much more (m, m, rad)
SIGMAS, MARGIN = 3.0, np.array([0.6, 0.6, 0.08])
#: pairs of submaps from which on a second process is used to match them
MIN_PARALLEL_PAIRS = 16
#: verified: least share of points confirmed, largest share in free space, of both submaps
MIN_CONFIRMED, MAX_SEEN_THROUGH = 0.4, 0.15
#: share of points on others in a coarse search below which `MIN_CONFIRMED` is out of reach, so that
#: it is not refined. Of 167 searches in Intel, 64 end here; the largest share confirmed in any of
#: those is 0.30, and the worst search that led to a closure has an overlap of 0.34
MIN_COARSE_OVERLAP = 0.2
#: m: sigma of a verified position, at most, in every direction
MAX_SIGMA_M = 0.08
#: the second best match may have at most this share of the best one's score
RIVAL_SHARE = 0.8
#: probability of the chi-square limits between closures, and factor on the covariance of the
#: estimate, which does not know of wrong associations
AGREE, COV_INFLATION = 0.99, 16.0
#: closures from which the search for the largest consistent set begins
CLIQUE_STARTS = 20
#: m, rad: pairs that lie as near as this need no closure; closures with larger residuals than the
#: second after the solution are taken back
ALREADY_CLOSED, MAX_RESIDUAL = (0.06, 0.01), (0.2, 0.03)

#: the later and the earlier state of a closure
Pair = tuple[State, State]


def candidates(
    found: Sequence[SubmapPose], P: Array, config: LoopClosureConfig
) -> list[tuple[int, int, Array]]:
    """Pairs of submaps that may show one place: later, earlier, and half the window (3,) to search.

    Of consecutive earlier submaps only the nearest is returned. All pairs are looked at, O(n²).
    ``P`` (3n, 3n) is the joint covariance of the submaps' poses, errors along each one's own axes.
    """
    limit = np.array([config.search_max_m, config.search_max_m, config.search_max_rad])
    n = len(found)
    poses, path = np.array([p.pose for p in found]), np.array([p.path_m for p in found])
    robots = np.unique([p.state[0] for p in found], return_inverse=True)[1]
    blocks = P.reshape(n, 3, n, 3).transpose(0, 2, 1, 3)
    pairs = []
    for i in range(1, n):
        away = between(poses[:i], poses[i])
        distance = np.hypot(away[:, 0], away[:, 1])
        apart = (robots[:i] != robots[i]) | (path[i] - path[:i] >= config.revisit_path_m)
        j = np.flatnonzero(apart & (distance <= NEAR_M + limit[0]))
        sigma = np.sqrt(np.diagonal(_relative(blocks, away[j], i, j), axis1=1, axis2=2))
        window = np.minimum(SIGMAS * sigma + MARGIN, limit)
        may = distance[j] <= NEAR_M + window[:, :2].max(axis=1)
        j, window = j[may], window[may]
        ends = np.flatnonzero((np.diff(j) > 1) | (np.diff(robots[j]) != 0)) + 1
        for stretch in np.split(np.arange(len(j)), ends):
            if len(stretch):
                k = stretch[distance[j[stretch]].argmin()]
                pairs.append((i, int(j[k]), window[k]))
    return pairs


def _relative(blocks: Array, h: Array, i: int, j: IntArray) -> Array:
    """Covariances (m, 3, 3) of the poses h (m, 3) of submap i relative to submaps j (m,).

    ``blocks`` (n, n, 3, 3) are those of the joint covariance of all submap poses.
    """
    own = np.broadcast_to(blocks[i, i], (len(j), 3, 3))
    both = np.block([[blocks[j, j], blocks[j, i]], [blocks[i, j], own]])
    H = _jacobian(h)
    return np.asarray(H @ both @ H.mT)


def _jacobian(h: Array) -> Array:
    """Jacobian (..., 3, 6) of relative poses h (..., 3) by both poses, along their own axes."""
    H = np.zeros((*h.shape[:-1], 3, 6))
    H[..., 0, 0] = H[..., 1, 1] = H[..., 2, 2] = -1.0
    H[..., 0, 2], H[..., 1, 2] = h[..., 1], -h[..., 0]
    H[..., 3:] = rotation3(h[..., 2])
    return H


def verify_match(matches: Sequence[Match]) -> Match | None:
    """The first and best of the matches if it is verified, see the module's docstring."""
    if not matches:
        return None
    best = matches[0]
    score = best.same - best.absent
    sigma = np.sqrt(np.linalg.eigvalsh(best.cov[:2, :2])[-1])
    good = (
        _is_confirmed(best.same, best.absent)
        and sigma <= MAX_SIGMA_M
        and not has_rival(score, (m.same - m.absent for m in matches[1:]), RIVAL_SHARE)
    )
    return best if good else None


def loop_closures(
    found: Sequence[SubmapPose], P: Array, examined: dict[Pair, Array], config: LoopClosureConfig
) -> tuple[list[Closure], list[Closure]]:
    """Closures between submaps, each verified by itself.

    Args:
        found: the submaps.
        P: (3n, 3n) see `candidates`.
        examined: relative poses (3,) of pairs at which they were examined before; those need not be
            examined again. New ones are added.
        config: what counts as another visit, and how far is searched.

    Returns:
        Closures that correct the estimate, found by a search; and closures that confirm it, where
        the two submaps match as they lie.
    """
    pairs: list[tuple[SubmapPose, SubmapPose, Array, Array]] = []
    for i, j, window in candidates(found, COV_INFLATION * P, config):
        later, earlier = found[i], found[j]
        guess = between(earlier.pose, later.pose)
        pair = later.state, earlier.state
        if pair in examined and _near(examined[pair], guess, ALREADY_CLOSED):
            continue
        examined[pair] = guess
        pairs.append((later, earlier, guess, window))
    correcting: list[Closure] = []
    confirming: list[Closure] = []
    results = parallel_map(_verify_pair, pairs, fewest=MIN_PARALLEL_PAIRS)
    for (later, earlier, _, _), result in zip(pairs, results, strict=True):
        if result is not None:
            is_searched, pose, cov = result
            images = min(len(later.submap.clouds), len(earlier.submap.clouds))
            closure = Closure(*later.state, *earlier.state, pose, cov, scan_count=images)
            (correcting if is_searched else confirming).append(closure)
    return correcting, confirming


def _verify_pair(
    pair: tuple[SubmapPose, SubmapPose, Array, Array],
) -> tuple[bool, Array, Array] | None:
    """Whether a pair had to be searched for, its relative pose (3,) and covariance (3, 3).

    None if it is not verified. ``pair``: the later and the earlier submap, the estimated relative
    pose (3,), and half the window (3,) to search.
    """
    later, earlier, guess, window = pair
    in_place = verify_in_place(later.submap, earlier.submap, guess)
    if in_place is not None:
        return False, *in_place
    best = verify_match(match(later.submap, earlier.submap, guess, window, MIN_COARSE_OVERLAP))
    return None if best is None else (True, best.pose, best.cov)


def verify_in_place(source: Submap, target: Submap, guess: Array) -> tuple[Array, Array] | None:
    """Pose (3,) and covariance (3, 3) of ``source`` in ``target`` if they match at ``guess`` (3,).

    None if they do not. The covariance is large along directions that the points leave open.
    """
    pose, cov = align(source, target, guess)
    if not _near(guess, pose, ALREADY_CLOSED):
        return None
    return (pose, cov) if _is_confirmed(*agreement(source, target, pose)) else None


def _is_confirmed(same: float, absent: float) -> bool:
    return same >= MIN_CONFIRMED and absent <= MAX_SEEN_THROUGH * (same + absent)


def _near(a: Array, b: Array, limits: tuple[float, float]) -> bool:
    off = between(a, b)
    return bool(np.hypot(off[0], off[1]) <= limits[0] and abs(off[2]) <= limits[1])


def consistent_closures(
    closures: Sequence[Closure], found: Sequence[SubmapPose], P: Array
) -> list[Closure]:
    """The largest set found of closures that agree with the estimate and with each other.

    The covariance ``P`` (3n, 3n) of the estimate, see `candidates`, is inflated by `COV_INFLATION`
    and unmodelled drift; see `largest_consistent_set` for the rule.
    """
    if not closures:
        return []
    r, S = _innovations(closures, found, COV_INFLATION * P + drift_covariance(found))
    return [closures[k] for k in largest_consistent_set(r, S, AGREE, CLIQUE_STARTS)]


def _innovations(
    closures: Sequence[Closure], found: Sequence[SubmapPose], P: Array
) -> tuple[Array, Array]:
    """Innovations (n, 3) of closures, in their own frames, and their covariance (3n, 3n)."""
    at = {submap.state: k for k, submap in enumerate(found)}
    n = len(closures)
    r, J, R = np.zeros((n, 3)), np.zeros((3 * n, len(P))), np.zeros((3 * n, 3 * n))
    for k, closure in enumerate(closures):
        i = at[closure.robot, closure.time_ns]
        j = at[closure.other, closure.other_time_ns]
        h = between(found[j].pose, found[i].pose)
        r[k] = log(between(closure.delta, h))
        turn = rotation3(-closure.delta[2])
        H, rows = turn @ _jacobian(h), slice(3 * k, 3 * k + 3)
        J[rows, 3 * j : 3 * j + 3], J[rows, 3 * i : 3 * i + 3] = H[:, :3], H[:, 3:]
        R[rows, rows] = turn @ closure.cov @ turn.T
    return r, J @ P @ J.T + R


def residuals(closures: Sequence[Closure], states: Mapping[str, Trajectory]) -> Array:
    """Residuals (n, 3) of closures at an estimate, in their own frames."""
    r = np.zeros((len(closures), 3))
    for k, c in enumerate(closures):
        earlier, later = states[c.other].at(c.other_time_ns), states[c.robot].at(c.time_ns)
        r[k] = log(between(c.delta, between(earlier, later)))
    return r


def inflate_covariances(
    closures: Sequence[Closure], states: Mapping[str, Trajectory]
) -> list[Closure]:
    """Closures with covariances so large that an estimate lies within three sigmas of each.

    A robust kernel treats what is many sigmas off as an outlier, so verified closures are tightened
    step by step.
    """
    inflated = []
    for closure, r in zip(closures, residuals(closures, states), strict=True):
        turned = rotate_cov(closure.cov, -float(closure.delta[2]))
        scale = float(mahalanobis_squared(r, turned)) / 9.0
        inflated.append(replace(closure, cov=scale * closure.cov) if scale > 1.0 else closure)
    return inflated


def violated(
    closures: Sequence[Closure], states: Mapping[str, Trajectory], limits: tuple[float, float]
) -> list[bool]:
    """Which closures have residuals larger than ``limits`` (m, rad) at an estimate."""
    off = residuals(closures, states)
    return list((np.hypot(off[:, 0], off[:, 1]) > limits[0]) | (np.abs(off[:, 2]) > limits[1]))
