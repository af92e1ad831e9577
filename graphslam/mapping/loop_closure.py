"""Loop closing that is verified: places seen twice, found by matching what was seen there.

The run is cut into submaps. Where two of them may be of one place, as far as the estimate can tell,
the later one is searched for in the earlier (`matching`). A closure is believed if most of what
either saw is confirmed by the other, little of it is looked through, no direction is left open, no
second place in the window fits nearly as well, and if it agrees with the other closures under the
joint covariance of the run: J. Mangelson et al., ICRA 2018, DOI 10.1109/ICRA.2018.8460217, for
pairwise consistency, there of odometry, here of everything that is known so far.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.consistency import has_rival, largest_consistent_set
from graphslam.core.geometry import (
    Array,
    adjoint,
    between,
    compose,
    inverse,
    log,
    path_length,
    rotate_cov,
    rotation,
    rotation3,
    transform,
    wrap,
)
from graphslam.core.records import Closure, Picture, Trajectory
from graphslam.core.worker import parallel_map
from graphslam.perception.scan_matching import (
    IntArray,
    Match,
    Submap,
    agreement,
    align,
    make_submap,
    match,
)

#: m of path: between submaps, what each takes in before and after its middle, between its scans
SPACING_M, REACH_M, SCAN_M = 3.0, 3.0, 0.5
#: rad turned between scans of a submap
SCAN_RAD = 0.4
#: points of a scan at least
FEWEST = 20
#: submaps of a run at most; a longer one has them farther apart
MAX_SUBMAPS = 400
#: m of path between two visits, and m between the middles of submaps that may show one place
APART_M, NEAR_M = 15.0, 3.0
#: the window searched: so many sigmas and this much more, at most so far (m, m, rad)
SIGMAS = 3.0
MARGIN, FARTHEST = np.array([0.6, 0.6, 0.08]), np.array([5.0, 5.0, 0.5])
#: pairs of places that are worth a second process to compare them
MANY = 16
#: verified: shares of points confirmed at least, looked through at most (of both)
SAME, ABSENT = 0.4, 0.15
#: share of points on others in a coarse search below which `SAME` is out of reach: looked at no
#: more closely. Of 167 searches in Intel, 64 end here; the most that any of those has the same is
#: 0.30, and the worst search that led to a closure has a share of 0.34
MIN_COARSE_OVERLAP = 0.2
#: how sure the position must be in every direction, m
SURE_M = 0.08
#: the second best may have at most this share of the best one's score
RIVAL_SHARE = 0.8
#: closures agree with each other up to this probability, by covariances that may be too small by
#: this factor (the estimate does not know of what it missed)
AGREE, TRUST = 0.99, 16.0
#: m, m, rad per root of a metre: what an estimate may have missed on the way
MISSED = np.array([0.02, 0.02, 0.01])
#: closures with which the search for those that agree begins: the ones that most agree with
STARTS = 20
#: m, rad: pairs that lie this well need no closure; closures that come out worse are taken back
CLOSED, BORNE_OUT = (0.06, 0.01), (0.2, 0.03)
#: states of one robot at one time
State = tuple[str, int]
#: the later and the earlier state of a closure
Pair = tuple[State, State]


@dataclass(frozen=True, slots=True, eq=False)
class SubmapPose:
    """A submap, the state that it is relative to, how far its robot had driven, when it was there.

    ``span_ns`` is the time of the first and of the last scan.
    """

    state: State
    pose: Array
    path_m: float
    span_ns: tuple[int, int]
    submap: Submap


def build_submaps(
    states: Mapping[str, Trajectory], pictures: Iterable[Picture]
) -> list[SubmapPose]:
    """Submaps along every robot's path.

    Args:
        states: estimates of all states.
        pictures: what was seen from them.
    """
    clouds = {(p.robot, p.time_ns): p for p in pictures if len(p.points) >= FEWEST}
    found = []
    for robot, states_of in states.items():
        seen = np.array([(robot, int(t)) in clouds for t in states_of.stamps_ns], dtype=bool)
        poses, stamps = states_of.poses[seen], states_of.stamps_ns[seen]
        if len(poses) < 2:
            continue
        path = path_length(poses)
        turned = np.concatenate([[0.0], np.cumsum(np.abs(wrap(np.diff(poses[:, 2]))))])
        spacing = max(SPACING_M, path[-1] / MAX_SUBMAPS)
        for middle in np.unique(np.searchsorted(path, np.arange(0.0, path[-1], spacing))):
            used: list[int] = []
            for k in np.flatnonzero(np.abs(path - path[middle]) <= REACH_M):
                if (
                    not used
                    or path[k] - path[used[-1]] >= SCAN_M
                    or turned[k] - turned[used[-1]] >= SCAN_RAD
                ):
                    used.append(int(k))
            seen_there = [clouds[robot, int(stamps[k])] for k in used]
            sensors = np.array([p.sensor for p in seen_there])
            submap = make_submap(
                compose(between(poses[middle], poses[used]), sensors),
                [transform(inverse(p.sensor), p.points.astype(float)) for p in seen_there],
            )
            state = robot, int(stamps[middle])
            span = int(stamps[used[0]]), int(stamps[used[-1]])
            found.append(SubmapPose(state, poses[middle], float(path[middle]), span, submap))
    return found


def with_poses_from(
    found: Sequence[SubmapPose], states: Mapping[str, Trajectory]
) -> list[SubmapPose]:
    """The same places where another estimate has them; what they show stays as it was."""
    return [
        replace(p, pose=states[robot].at(time_ns)) for p in found for robot, time_ns in [p.state]
    ]


def candidates(found: Sequence[SubmapPose], P: Array) -> list[tuple[int, int, Array]]:
    """Pairs of places that may be one: later, earlier, and half the window (3,) to search.

    Of a stretch of earlier places only the nearest is named.

    Args:
        found: the places.
        P: (3n, 3n) joint covariance of their poses, errors along each pose's own axes.
    """
    n = len(found)
    poses, path = np.array([p.pose for p in found]), np.array([p.path_m for p in found])
    robots = np.unique([p.state[0] for p in found], return_inverse=True)[1]
    blocks = P.reshape(n, 3, n, 3).transpose(0, 2, 1, 3)
    pairs = []
    for i in range(1, n):
        away = between(poses[:i], poses[i])
        distance = np.hypot(away[:, 0], away[:, 1])
        apart = (robots[:i] != robots[i]) | (path[i] - path[:i] >= APART_M)
        j = np.flatnonzero(apart & (distance <= NEAR_M + FARTHEST[0]))
        sigma = np.sqrt(np.diagonal(_relative(blocks, away[j], i, j), axis1=1, axis2=2))
        window = np.minimum(SIGMAS * sigma + MARGIN, FARTHEST)
        may = distance[j] <= NEAR_M + window[:, :2].max(axis=1)
        j, window = j[may], window[may]
        ends = np.flatnonzero((np.diff(j) > 1) | (np.diff(robots[j]) != 0)) + 1
        for stretch in np.split(np.arange(len(j)), ends):
            if len(stretch):
                k = stretch[distance[j[stretch]].argmin()]
                pairs.append((i, int(j[k]), window[k]))
    return pairs


def _relative(blocks: Array, h: Array, i: int, j: IntArray) -> Array:
    """Covariances (m, 3, 3) of place i as seen from places j (m,), where it is at h (m, 3).

    ``blocks`` (n, n, 3, 3) are of the joint covariance of all places.
    """
    own = np.broadcast_to(blocks[i, i], (len(j), 3, 3))
    both = np.block([[blocks[j, j], blocks[j, i]], [blocks[i, j], own]])
    H = _jacobian(h)
    return np.asarray(H @ both @ H.mT)


def _jacobian(h: Array) -> Array:
    """Of relative poses h (..., 3), (..., 3, 6) by errors of both poses along their own axes."""
    H = np.zeros((*h.shape[:-1], 3, 6))
    H[..., 0, 0] = H[..., 1, 1] = H[..., 2, 2] = -1.0
    H[..., 0, 2], H[..., 1, 2] = h[..., 1], -h[..., 0]
    H[..., 3:] = rotation3(h[..., 2])
    return H


def verify_match(matches: Sequence[Match]) -> Match | None:
    """The first of the matches if it can be believed."""
    if not matches:
        return None
    best = matches[0]
    score = best.same - best.absent
    sigma = np.sqrt(np.linalg.eigvalsh(best.cov[:2, :2])[-1])
    good = (
        best.same >= SAME
        and best.absent <= ABSENT * (best.same + best.absent)
        and sigma <= SURE_M
        and not has_rival(score, (m.same - m.absent for m in matches[1:]), RIVAL_SHARE)
    )
    return best if good else None


def loop_closures(
    found: Sequence[SubmapPose], P: Array, looked: dict[Pair, Array]
) -> tuple[list[Closure], list[Closure]]:
    """Closures between places, each verified by itself: those that were lost, and the others.

    A pair that lies where it should confirms the estimate; a pair that does not is searched for.

    Args:
        found: the places.
        P: (3n, 3n) joint covariance of their poses, errors along each pose's own axes.
        looked: relative poses (3,) at which pairs were looked at before, which need no second look;
            this adds to it.
    """
    asked: list[tuple[SubmapPose, SubmapPose, Array, Array]] = []
    for i, j, window in candidates(found, TRUST * P):
        later, earlier = found[i], found[j]
        guess = between(earlier.pose, later.pose)
        pair = later.state, earlier.state
        if pair in looked and _near(looked[pair], guess, CLOSED):
            continue
        looked[pair] = guess
        asked.append((later, earlier, guess, window))
    lost: list[Closure] = []
    confirmed: list[Closure] = []
    seen = parallel_map(_verify_pair, asked, fewest=MANY)
    for (later, earlier, _, _), there in zip(asked, seen, strict=True):
        if there is not None:
            was_lost, pose, cov = there
            (lost if was_lost else confirmed).append(_closure(later, earlier, pose, cov))
    return lost, confirmed


def _verify_pair(
    asked: tuple[SubmapPose, SubmapPose, Array, Array],
) -> tuple[bool, Array, Array] | None:
    """Whether a pair of places was lost, and how it lies (3,), (3, 3); None if it is no pair.

    ``asked``: the later and the earlier place, where it is believed to lie (3,), and half the
    window (3,) to search.
    """
    later, earlier, guess, window = asked
    there = verify_in_place(later.submap, earlier.submap, guess)
    if there is not None:
        return False, *there
    best = verify_match(match(later.submap, earlier.submap, guess, window, MIN_COARSE_OVERLAP))
    return None if best is None else (True, best.pose, best.cov)


def _closure(later: SubmapPose, earlier: SubmapPose, pose: Array, cov: Array) -> Closure:
    images = min(len(place.submap.clouds) for place in (later, earlier))
    return Closure(*later.state, *earlier.state, pose, cov, images=images)


def verify_in_place(source: Submap, target: Submap, guess: Array) -> tuple[Array, Array] | None:
    """Pose (3,) and covariance (3, 3) of a place that lies where it should, else None.

    As far as what was seen there can tell: along what it does not, the covariance is large.
    ``guess`` (3,) is where ``source`` is believed to be in ``target``.
    """
    pose, cov = align(source, target, guess)
    if not _near(guess, pose, CLOSED):
        return None
    same, absent = agreement(source, target, pose)
    return (pose, cov) if same >= SAME and absent <= ABSENT * (same + absent) else None


def _near(a: Array, b: Array, limits: tuple[float, float]) -> bool:
    off = between(a, b)
    return bool(np.hypot(off[0], off[1]) <= limits[0] and abs(off[2]) <= limits[1])


def consistent_closures(
    closures: Sequence[Closure], found: Sequence[SubmapPose], P: Array
) -> list[Closure]:
    """The largest set found of closures that agree with the estimate and, in pairs, among them.

    By what the estimate knows, and what it may have missed. Two agree if, once either is believed,
    the other is what is to be expected. Of those that agree
    in pairs the worst leaves until each is what is to be expected from all the others.

    Args:
        closures: between places.
        found: the places.
        P: (3n, 3n) joint covariance of their poses, errors along each pose's own axes.
    """
    if not closures:
        return []
    r, S = _innovations(closures, found, TRUST * P + drift_covariance(found))
    return [closures[k] for k in largest_consistent_set(r, S, AGREE, STARTS)]


def drift_covariance(found: Sequence[SubmapPose]) -> Array:
    """Joint covariance (3n, 3n) of what an estimate of places may have missed on the way.

    A wall taken for the one beside it bends the path there, and everything after it follows: a
    random walk along each robot's path, errors along each pose's own axes.
    """
    n = len(found)
    poses, path = np.array([p.pose for p in found]), np.array([p.path_m for p in found])
    robots = np.array([p.state[0] for p in found])
    D = np.zeros((n, n, 3, 3))
    for robot in np.unique(robots):
        own = np.flatnonzero(robots == robot)
        own = own[np.argsort(path[own], kind="stable")]
        k, steps = len(own), np.diff(path[own], prepend=path[own[0]])
        # how an error that arises at one place (second axis) moves a later one (first axis)
        G = adjoint(between(poses[own][:, None], poses[own])) * np.tri(k)[:, :, None, None]
        G = (G * np.sqrt(steps)[:, None, None] * MISSED).transpose(0, 2, 1, 3).reshape(3 * k, -1)
        D[np.ix_(own, own)] = (G @ G.T).reshape(k, 3, k, 3).transpose(0, 2, 1, 3)
    return D.transpose(0, 2, 1, 3).reshape(3 * n, 3 * n)


def _innovations(
    closures: Sequence[Closure], found: Sequence[SubmapPose], P: Array
) -> tuple[Array, Array]:
    """How closures differ from the estimate (n, 3), in their own frames; covariance (3n, 3n)."""
    at = {place.state: k for k, place in enumerate(found)}
    n = len(closures)
    r, J, R = np.zeros((n, 3)), np.zeros((3 * n, len(P))), np.zeros((3 * n, 3 * n))
    for k, closure in enumerate(closures):
        i = at[closure.robot, closure.time_ns]
        j = at[closure.other, closure.other_time_ns]
        h = between(found[j].pose, found[i].pose)
        r[k] = log(between(closure.delta, h))
        turn = np.eye(3)
        turn[:2, :2] = rotation(-float(closure.delta[2]))
        H, rows = turn @ _jacobian(h), slice(3 * k, 3 * k + 3)
        J[rows, 3 * j : 3 * j + 3], J[rows, 3 * i : 3 * i + 3] = H[:, :3], H[:, 3:]
        R[rows, rows] = turn @ closure.cov @ turn.T
    return r, J @ P @ J.T + R


def residuals(closures: Sequence[Closure], states: Mapping[str, Trajectory]) -> Array:
    """How an estimate differs from closures: (n, 3), in their own frames."""
    found = np.zeros((len(closures), 3))
    for k, c in enumerate(closures):
        ends = (c.other, c.other_time_ns), (c.robot, c.time_ns)
        poses = [states[r].at(t) for r, t in ends]
        found[k] = log(between(c.delta, between(*poses)))
    return found


def inflate_covariances(
    closures: Sequence[Closure], states: Mapping[str, Trajectory]
) -> list[Closure]:
    """Closures with covariances so large that an estimate lies within three sigmas of each.

    A robust kernel takes what is many sigmas off for wrong; verified closures are to be drawn tight
    step by step.
    """
    found = []
    for closure, r in zip(closures, residuals(closures, states), strict=True):
        turned = rotate_cov(closure.cov, -float(closure.delta[2]))
        scale = float(r @ np.linalg.solve(turned, r)) / 9.0
        found.append(replace(closure, cov=scale * closure.cov) if scale > 1.0 else closure)
    return found


def violated(
    closures: Sequence[Closure], states: Mapping[str, Trajectory], limits: tuple[float, float]
) -> list[bool]:
    """Which closures an estimate misses by more than ``limits`` (m, rad)."""
    off = residuals(closures, states)
    return list((np.hypot(off[:, 0], off[:, 1]) > limits[0]) | (np.abs(off[:, 2]) > limits[1]))
