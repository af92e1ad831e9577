"""Loop closure: revisited places are found and verified by matching submaps.

Where two submaps may overlap according to the estimate, the later one is searched for in the
earlier (`scan_matching`). A match is verified if most points of either submap are confirmed by the
other, few points lie in the other's free space, its position has a small sigma in every direction,
and no second match in the window is nearly as good. Of all verified closures the largest consistent
set is used, under the joint covariance of the estimate: J. Mangelson et al., ICRA 2018, DOI
10.1109/ICRA.2018.8460217, who judge pairwise consistency by odometry.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.companion import Companion
from graphslam.core.config import LoopClosureConfig
from graphslam.core.consistency import largest_consistent_set
from graphslam.core.gaussian import mahalanobis_squared
from graphslam.core.geometry import Array, between, log, rotate_cov, rotation3
from graphslam.core.records import Closure, Trajectory
from graphslam.mapping.corridor_direction import (
    common_direction,
    open_along,
    wall_direction,
)
from graphslam.mapping.submap_graph import relative_jacobian
from graphslam.mapping.submaps import State, SubmapPose, drift_covariance
from graphslam.perception.scan_matching import (
    Match,
    Submap,
    agreement,
    align_pairs,
    match_pairs,
    shares_on_others,
)

#: m between the middles of submaps that may show one place: the default reach of a submap
NEAR_M = 3.0
#: half the window of a search: so many sigmas of the relative pose, and this much more (m, m, rad)
SIGMAS, MARGIN = 3.0, np.array([0.6, 0.6, 0.08])
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
#: m: directions with larger sigmas do not count in a residual
UNKNOWN_M = 0.5
#: m: a match shifted by so much must have less than this share of the points on others
OPEN_SHIFT_M, OPEN_SHARE = 0.3, 0.95
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
#: a pair of submaps by their numbers, later and earlier, its guess (3,) and window (3,)
_Question = tuple[int, int, Array, Array]
#: stands between verifying closures and believing them: for tests, which add false ones. It gets
#: those just verified and the submaps so far, and returns all that are to be believed
Tamper = Callable[[list[Closure], Sequence[SubmapPose]], list[Closure]]


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
    H = relative_jacobian(h)
    return np.asarray(H @ both @ H.mT)


def verify_match(matches: Sequence[Match]) -> Match | None:
    """The first and best of the matches if it is verified, see the module's docstring."""
    if not matches or _rivals(matches):
        return None
    best = matches[0]
    sigma = np.sqrt(np.linalg.eigvalsh(best.cov[:2, :2])[-1])
    return best if _is_confirmed(best.same, best.absent) and sigma <= MAX_SIGMA_M else None


def verify_match_across(matches: Sequence[Match], earlier: Submap) -> Match | None:
    """As `verify_match`, but of several matches one behind the other along a corridor.

    If all that are nearly as good as the best differ in this one direction only, the best is
    returned with a covariance that leaves it open. The matches are poses in the ``earlier`` submap.
    """
    rivals = _rivals(matches)
    along = common_direction(matches[0], rivals) if rivals else None
    if along is None:
        return verify_match(matches)
    best = matches[0]
    sigma = np.sqrt(np.linalg.eigvalsh(best.cov[:2, :2])[-1])
    if not _is_confirmed(best.same, best.absent) or sigma > MAX_SIGMA_M:
        return None
    return replace(best, cov=open_along(best.cov, wall_direction(earlier, along)))


def _rivals(matches: Sequence[Match]) -> list[Match]:
    """Matches that are nearly as good as the first and best."""
    if not matches:
        return []
    least = RIVAL_SHARE * (matches[0].same - matches[0].absent)
    return [m for m in matches[1:] if m.same - m.absent > least]


def loop_closures(
    found: Sequence[SubmapPose],
    P: Array,
    examined: dict[Pair, Array],
    config: LoopClosureConfig,
    verify: "Verify",
) -> tuple[list[Closure], list[Closure]]:
    """Closures between submaps, each verified by itself.

    Args:
        found: the submaps.
        P: (3n, 3n) see `candidates`.
        examined: relative poses (3,) of pairs at which they were examined before; those need not be
            examined again. New ones are added.
        config: what counts as another visit, and how far is searched.
        verify: `verify_pairs`, or a `PairVerifier`.

    Returns:
        Closures that correct the estimate, found by a search; and closures that confirm it, where
        the two submaps match as they lie.
    """
    pairs = []
    for i, j, window in candidates(found, COV_INFLATION * P, config):
        guess = between(found[j].pose, found[i].pose)
        pairs.append(SubmapPair(found[i], found[j], guess, window))
    return verified_closures(pairs, examined, verify)


@dataclass(frozen=True, slots=True, eq=False)
class SubmapPair:
    """Two submaps that may show one place.

    ``guess`` (3,) is the estimated pose of the ``later`` in the ``earlier`` one, ``window`` (3,)
    half of what to search around it, m, m, rad.
    """

    later: SubmapPose
    earlier: SubmapPose
    guess: Array
    window: Array


@dataclass(frozen=True, slots=True, eq=False)
class Verified:
    """A verified relative pose (3,) of two submaps, its cov (3, 3), and if it was searched for."""

    pose: Array
    cov: Array
    is_searched: bool


#: whether pairs are verified, each None if it is not
Verify = Callable[[Sequence[SubmapPair]], list[Verified | None]]


def verified_closures(
    pairs: Sequence[SubmapPair], examined: dict[Pair, Array], verify: Verify
) -> tuple[list[Closure], list[Closure]]:
    """Closures of the pairs that are verified, each by itself; see `loop_closures`."""
    new = []
    for pair in pairs:
        states = pair.later.state, pair.earlier.state
        if states in examined and are_near(examined[states], pair.guess, ALREADY_CLOSED):
            continue
        examined[states] = pair.guess
        new.append(pair)
    correcting: list[Closure] = []
    confirming: list[Closure] = []
    for pair, found in zip(new, verify(new), strict=True):
        if found is not None:
            later, earlier = pair.later, pair.earlier
            images = min(len(later.submap.clouds), len(earlier.submap.clouds))
            closure = Closure(
                *later.state, *earlier.state, found.pose, found.cov, scan_count=images
            )
            (correcting if found.is_searched else confirming).append(closure)
    return correcting, confirming


class PairVerifier(Companion["list[_Question]", "list[Verified | None]"]):
    """`verify_pairs` of given submaps, half of the pairs in a second process.

    All pairs with the same earlier submap are verified in the same process, which keeps what it
    computed of it.
    """

    def __init__(self, submaps: Sequence[SubmapPose], *, along: bool = False) -> None:
        """Begin; for ``along`` see `verify_pairs`."""
        self._number = {s.state: k for k, s in enumerate(submaps)}

        def verify(questions: list[_Question]) -> list[Verified | None]:
            pairs = [SubmapPair(submaps[i], submaps[j], h, w) for i, j, h, w in questions]
            return verify_pairs(pairs, along=along)

        super().__init__(verify)

    def __call__(self, pairs: Sequence[SubmapPair]) -> list[Verified | None]:
        """How each of the pairs is verified, None if it is not."""
        number = self._number
        questions = [
            (number[p.later.state], number[p.earlier.state], p.guess, p.window) for p in pairs
        ]
        there = [k for k, (_, j, _, _) in enumerate(questions) if j % 2]
        here = [k for k, (_, j, _, _) in enumerate(questions) if not j % 2]
        if not self.forked:  # one batch is faster than two
            return self._function(questions)
        found: list[Verified | None] = [None] * len(pairs)
        answers = self.both([questions[k] for k in here], [questions[k] for k in there])
        for k, one in zip([*here, *there], [*answers[0], *answers[1]], strict=True):
            found[k] = one
        return found


def verify_pairs(pairs: Sequence[SubmapPair], *, along: bool = False) -> list[Verified | None]:
    """How each of the pairs is verified, None if it is not.

    Where a match lies where it is guessed, nothing is searched for. ``along``: matches that leave
    the direction of a corridor open are verified too, see `verify_match_across`.
    """
    found: list[Verified | None] = verify_in_place(pairs)
    rest = [k for k, one in enumerate(found) if one is None]
    searched = [pairs[k] for k in rest]
    matches = match_pairs(
        [p.later.submap for p in searched],
        [p.earlier.submap for p in searched],
        [p.guess for p in searched],
        [p.window for p in searched],
        MIN_COARSE_OVERLAP,
    )
    for k, own in zip(rest, matches, strict=True):
        earlier = pairs[k].earlier.submap
        best = verify_match_across(own, earlier) if along else verify_match(own)
        if best is not None:
            found[k] = Verified(best.pose, best.cov, True)
    return leave_open(pairs, found) if along else found


def verify_in_place(pairs: Sequence[SubmapPair]) -> list[Verified | None]:
    """The pairs that match where they are guessed; the others None.

    The covariance is large along directions that the points leave open.
    """
    poses, covs, _ = align_pairs(
        [p.later.submap for p in pairs],
        [p.earlier.submap for p in pairs],
        [p.guess for p in pairs],
    )
    return [
        Verified(pose, cov, False)
        if are_near(pair.guess, pose, ALREADY_CLOSED)
        and _is_confirmed(*agreement(pair.later.submap, pair.earlier.submap, pose))
        else None
        for pair, pose, cov in zip(pairs, poses, covs, strict=True)
    ]


def leave_open(
    pairs: Sequence[SubmapPair], found: Sequence[Verified | None]
) -> list[Verified | None]:
    """Verified pairs, each open along the walls of a corridor if a shift along them fits as well.

    Between parallel walls the noise of points looks like structure along them.
    """
    opened = list(found)
    matched = [(k, one) for k, one in enumerate(found) if one is not None and _is_position(one.cov)]
    if not matched:
        return opened
    weakest = np.linalg.eigh(np.array([one.cov[:2, :2] for _, one in matched]))[1][:, :, 1]
    along = np.array([
        wall_direction(pairs[k].earlier.submap, axis)
        for (k, _), axis in zip(matched, weakest, strict=True)
    ])  # fmt: skip
    shift = OPEN_SHIFT_M * np.column_stack([along, np.zeros(len(along))])
    poses = np.array([one.pose for _, one in matched])
    here, before, behind = shares_on_others(
        3 * [pairs[k].later.submap for k, _ in matched],
        3 * [pairs[k].earlier.submap for k, _ in matched],
        np.concatenate([poses, poses - shift, poses + shift]),
    ).reshape(3, -1)
    is_open = np.maximum(before, behind) >= OPEN_SHARE * here
    for (k, one), direction, really in zip(matched, along, is_open, strict=True):
        if really:
            opened[k] = replace(one, cov=open_along(one.cov, direction))
    return opened


def _is_confirmed(same: float, absent: float) -> bool:
    return same >= MIN_CONFIRMED and absent <= MAX_SEEN_THROUGH * (same + absent)


def are_near(a: Array, b: Array, limits: tuple[float, float]) -> bool:
    """Whether two poses (3,) are within limits (m, rad) of each other."""
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
        H, rows = turn @ relative_jacobian(h), slice(3 * k, 3 * k + 3)
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


def known_part(r: Array, closures: Sequence[Closure]) -> Array:
    """Residuals (n, 3) of closures without what lies along directions that they leave open."""
    if not closures:
        return r
    turn = np.array([c.delta[2] for c in closures])
    cov = rotate_cov(np.array([c.cov for c in closures]), -turn)[:, :2, :2]
    variances, axes = np.linalg.eigh(cov)
    along = (axes.mT @ r[:, :2, None])[:, :, 0] * (variances <= UNKNOWN_M**2)
    return np.column_stack([(axes @ along[:, :, None])[:, :, 0], r[:, 2]])


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


def fix_position(closures: Sequence[Closure]) -> list[bool]:
    """Which closures determine a relative pose in all directions."""
    return [_is_position(c.cov) for c in closures]


def _is_position(cov: Array) -> bool:
    """Whether a covariance (3, 3) of a relative pose is that of a position, not of a line."""
    return bool(np.linalg.eigvalsh(cov[:2, :2])[-1] <= UNKNOWN_M**2)


def violated(
    closures: Sequence[Closure], states: Mapping[str, Trajectory], limits: tuple[float, float]
) -> list[bool]:
    """Which closures have residuals larger than ``limits`` (m, rad) at an estimate."""
    off = known_part(residuals(closures, states), closures)
    return list((np.hypot(off[:, 0], off[:, 1]) > limits[0]) | (np.abs(off[:, 2]) > limits[1]))
