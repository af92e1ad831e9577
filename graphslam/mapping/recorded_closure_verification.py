"""Verification of recorded closures: which relative poses of a log are used, and robots' starts.

Recorded closures may be outliers, so none is accepted by itself.

1. Two closures between the same robots and the odometry between their ends make a loop; they agree
   if it closes within its uncertainty. Of all closures between two robots (or of one with itself)
   the largest set found that agrees in pairs is kept: J. Mangelson et al., ICRA 2018, DOI
   10.1109/ICRA.2018.8460217. It needs no start pose: each closure gives the start of one robot's
   odometry in the frame of the other's.
2. Robots whose start is unknown are placed by such a set, if it is clearly larger than any other
   consistent set; otherwise they stay in a frame of their own.
3. Everything is solved together under a redescending kernel, and each closure is compared with what
   all others predict (leave one out). Closures that contradict are removed, the worst first; left
   out ones that fit are added; until nothing changes.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from graphslam.core.config import BackendConfig, Config, RobustConfig
from graphslam.core.consistency import FIT_PROBABILITY, greedy_max_clique, has_rival, rival_set
from graphslam.core.frame_forest import PRIOR_INFLATION, grow_frame_forest
from graphslam.core.gaussian import chi2_quantile, mahalanobis_squared
from graphslam.core.geometry import Array, adjoint, between, compose, inverse, log, rotate_cov
from graphslam.core.records import Closure, Estimate, Motion, RelativePose, Start, Step
from graphslam.estimation.isam2 import Isam2Backend, Reoptimiser
from graphslam.odometry.preintegration import Track

#: probability up to which two closures agree; against all others together it is
#: `FIT_PROBABILITY`, so that true closures are rarely lost (false ones miss by far more)
AGREE = 0.99
#: closures compared with each other at once, in order of time; the work grows with its square
CHUNK = 1000
#: scale of the redescending kernel of the joint solution, in sigmas
KERNEL_SIGMAS = 3.0
#: share of the information in a direction that the other closures must have for a comparison
MIN_SHARE = 1e-3
#: rounds of removing and adding closures
MAX_ROUNDS = 30
#: prior covariance (m, rad) of the origin of a robot's own frame
ORIGIN = np.diag([1e-3, 1e-3, 1e-3]) ** 2

CONTRADICTED = "it contradicts the others"
UNSUPPORTED = "no other closure supports it"


@dataclass(frozen=True, slots=True, eq=False)
class ClosureDecision:
    """The decision: ``refused`` (index of the message -> why) and the indices ``kept``.

    ``starts``: start poses found for robots that had none; ``frames``: robot -> the robot whose
    start defines its frame. Both only of robots that have a relative pose.
    """

    refused: Mapping[int, str]
    kept: frozenset[int]
    starts: Mapping[str, Start]
    frames: Mapping[str, str]


NOTHING_RECORDED = ClosureDecision({}, frozenset(), {}, {})


def origin_prior() -> Start:
    """Start of a robot in a separate frame."""
    return Start(np.zeros(3), ORIGIN)


def verify(
    messages: Sequence[RelativePose],
    tracks: Mapping[str, Track],
    starts: Mapping[str, Start],
    config: Config,
) -> ClosureDecision:
    """Decide which relative poses of a log to use.

    Those with an end outside the odometry are not judged. ``starts`` are the known ones.

    Raises:
        EstimationError: a covariance is not positive definite.
    """
    judged = [k for k, m in enumerate(messages) if _has_ends(m, tracks)]
    if not judged:
        return NOTHING_RECORDED
    odometry = _odometry([messages[k] for k in judged], tracks)
    groups: dict[tuple[str, str], list[int]] = defaultdict(list)
    for k in judged:
        groups[messages[k].other, messages[k].robot].append(k)
    sets: dict[tuple[str, str], list[int]] = {}
    clear: set[tuple[str, str]] = set()
    frames_seen: dict[int, Array] = {}
    for pair, numbers in groups.items():
        numbers.sort(key=lambda k: messages[k].time_ns)
        for part in range(0, len(numbers), CHUNK):
            chunk = numbers[part : part + CHUNK]
            E, agree = _loops([messages[k] for k in chunk], odometry)
            frames_seen.update(zip(chunk, E, strict=True))
            worth = np.ones(len(chunk), dtype=np.float32)
            best = greedy_max_clique(agree, worth)
            rival = rival_set(agree, worth, np.setdiff1d(np.arange(len(chunk)), best))
            sets[pair] = sets.get(pair, []) + [chunk[n] for n in best]
            if not has_rival(len(best), [len(rival)]):
                clear.add(pair)
    placed, frames = _initial_starts(sets, clear, frames_seen, odometry, starts)
    believed = {
        k
        for (a, b), numbers in sets.items()
        for k in numbers
        if frames[a] == frames[b] and (a == b or (a, b) in clear or {a, b} <= set(starts))
    }
    solver = _Joint(messages, odometry, {**placed, **starts}, config)
    candidates = [k for k in judged if frames[messages[k].robot] == frames[messages[k].other]]
    believed, estimate = solver.settle(believed, candidates)
    refused = {
        k: CONTRADICTED if k in candidates else UNSUPPORTED for k in judged if k not in believed
    }
    found = {
        robot: Start(
            s.poses[0], ORIGIN if frames[robot] == robot else PRIOR_INFLATION**2 * s.covs[0]
        )
        for robot, s in estimate.states.items()
        if robot not in starts
    }
    return ClosureDecision(refused, frozenset(believed), found, frames)


def _has_ends(m: RelativePose, tracks: Mapping[str, Track]) -> bool:
    if m.robot == m.other and m.start_ns >= m.time_ns:
        return False
    return all(
        robot in tracks and len(tracks[robot]) > 0 and tracks[robot].first_ns <= time_ns
        for robot, time_ns in ((m.robot, m.time_ns), (m.other, m.start_ns))
    )


# ---------------------------------------------------------------- odometry


@dataclass(frozen=True, slots=True, eq=False)
class _OdometryChain:
    """A robot's odometry at the ends of closures: times (n,), poses (n, 3) from its first reading.

    ``spread`` (n, 3, 3) is the covariance of the odometry up to there, in the left tangent space of
    SE(2) at the first pose, so that the covariance of a stretch is the difference of its ends'.
    """

    times_ns: np.ndarray[tuple[int], np.dtype[np.int64]]
    poses: Array
    spread: Array
    motions: tuple[Motion, ...]

    def at(self, times_ns: Iterable[int]) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        """Indices (k,) of times in the chain."""
        return np.searchsorted(self.times_ns, np.array(list(times_ns), dtype=np.int64))


def _odometry(
    messages: Iterable[RelativePose], tracks: Mapping[str, Track]
) -> dict[str, _OdometryChain]:
    """Robot -> its odometry between the ends of closures, beginning with its first reading."""
    times: dict[str, set[int]] = defaultdict(set)
    for m in messages:
        times[m.robot] |= {tracks[m.robot].first_ns, m.time_ns}
        times[m.other] |= {tracks[m.other].first_ns, m.start_ns}
    chains = {}
    for robot, needed in sorted(times.items()):
        at = np.array(sorted(needed), dtype=np.int64)
        moved = tracks[robot].motions(at[:-1], at[1:])
        poses = np.zeros((len(at), 3))
        for k, delta in enumerate(moved.delta):
            poses[k + 1] = compose(poses[k], delta)
        A = adjoint(poses[1:])
        steps = A @ rotate_cov(moved.cov, -moved.delta[:, 2]) @ A.mT
        spread = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(steps, axis=0)])
        motions = tuple(moved.one(k, int(a), int(b)) for k, (a, b) in enumerate(pairwise(at)))
        chains[robot] = _OdometryChain(at, poses, spread, motions)
    return chains


# ---------------------------------------------------------------- pairs


def _loops(
    messages: Sequence[RelativePose], odometry: Mapping[str, _OdometryChain]
) -> tuple[Array, Array]:
    """Closures between the same two robots, compared in pairs.

    Closure a sees the first pose of its robot's odometry at E_a in the frame of the other's. The
    loop of two is E_a E_b⁻¹; its errors are those of both closures and of the odometry between
    their ends, all in the tangent space at the first pose of the other robot.

    Returns:
        E (n, 3), and which agree (n, n) bool.
    """
    other, own = odometry[messages[0].other], odometry[messages[0].robot]
    i, j = other.at(m.start_ns for m in messages), own.at(m.time_ns for m in messages)
    z = np.array([m.delta for m in messages])
    seen = compose(other.poses[i], z)
    E = compose(seen, inverse(own.poses[j]))
    A = adjoint(seen)
    R = A @ rotate_cov(np.array([m.cov for m in messages]), -z[:, 2]) @ A.mT
    gate = chi2_quantile(AGREE, 3)
    agree = np.zeros((len(z), len(z)), dtype=bool)
    A = adjoint(E)
    for a in range(len(z)):  # row by row: a matrix of 3 x 3 blocks would not fit
        loop = compose(E[a], inverse(E))
        turn = adjoint(loop)
        there, back = other.spread[i] - other.spread[i[a]], own.spread[j] - own.spread[j[a]]
        there *= np.sign(i - i[a])[:, None, None]
        back *= np.sign(j - j[a])[:, None, None]
        S = there + A[a] @ back @ A[a].T + R[a] + turn @ R @ turn.mT
        agree[a] = mahalanobis_squared(log(loop), S) <= gate
    agree &= agree.T
    np.fill_diagonal(agree, False)
    return E, agree


# ---------------------------------------------------------------- frames


def _initial_starts(
    sets: Mapping[tuple[str, str], Sequence[int]],
    clear: set[tuple[str, str]],
    seen: Mapping[int, Array],
    odometry: Mapping[str, _OdometryChain],
    starts: Mapping[str, Start],
) -> tuple[dict[str, Start], dict[str, str]]:
    """Initial start poses of robots that have none, and the frame of each robot.

    The largest set that connects a robot without a start to one with a start is followed first; if
    there is none, the next robot begins a separate frame.
    """
    edges = sorted(
        ((a, b) for a, b in sets if a != b and (a, b) in clear), key=lambda p: -len(sets[p])
    )

    def next_edge(poses: Mapping[str, Array]) -> tuple[str, str, Array] | None:
        for a, b in edges:
            E = seen[sets[a, b][0]]  # of b, in the frame of a
            if a in poses and b not in poses:
                return b, a, compose(poses[a], E)
            if b in poses and a not in poses:
                return a, b, compose(poses[b], inverse(E))
        return None

    given = {robot: starts[robot].pose for robot in odometry if robot in starts}
    world = min(starts, default="")
    poses, frames = grow_frame_forest(list(odometry), given, world, np.zeros(3), next_edge)
    wide = np.diag([1e3, 1e3, 3.0]) ** 2
    return {
        robot: Start(pose, ORIGIN if frames[robot] == robot else wide)
        for robot, pose in poses.items()
        if robot not in starts
    }, frames


# ---------------------------------------------------------------- everything together


class _Joint:
    """Solves odometry between the ends of closures together with any set of closures."""

    def __init__(
        self,
        messages: Sequence[RelativePose],
        odometry: Mapping[str, _OdometryChain],
        starts: Mapping[str, Start],
        config: Config,
    ) -> None:
        kernel = RobustConfig("geman-mcclure", KERNEL_SIGMAS)
        self._plain = replace(config, robust=RobustConfig("none"), backend=BackendConfig())
        self._robust = replace(self._plain, robust=kernel)
        self._closures = [
            Closure(m.robot, m.time_ns, m.other, m.start_ns, m.delta, m.cov) for m in messages
        ]
        self._starts: dict[int, dict[str, Start]] = defaultdict(dict)
        self._motions: dict[int, dict[str, Motion]] = defaultdict(dict)
        for robot, chain in odometry.items():
            self._starts[int(chain.times_ns[0])][robot] = starts[robot]
            for motion in chain.motions:
                self._motions[motion.end_ns][robot] = motion

    def settle(self, believed: set[int], candidates: Sequence[int]) -> tuple[set[int], Estimate]:
        """The candidates that support each other, beginning with ``believed``; and the estimate."""
        gate = chi2_quantile(FIT_PROBABILITY, 3)
        backend: Isam2Backend = Isam2Backend(self._plain)
        for step in self._steps(believed):
            backend.add(step)
        estimate = backend.finish()
        barred: set[int] = set()
        for _ in range(MAX_ROUNDS):
            batch = Reoptimiser(self._robust, self._steps(believed), estimate)
            estimate = batch.solve(rough=True)
            d2 = {k: self._misfit(k, k in believed, batch, estimate) for k in candidates}
            wrong = sorted((k for k in believed if d2[k] > gate), key=lambda k: -d2[k])
            new = {k for k in candidates if k not in believed | barred and d2[k] <= gate}
            if not wrong and not new:
                break
            # one outlier makes others look like outliers, so the worst are removed first
            gone = set(wrong[: max(1, len(wrong) // 4)])
            barred |= gone
            believed = believed - gone if gone else believed | new
        return believed, Reoptimiser(self._plain, self._steps(believed), estimate).solve()

    def _steps(self, believed: Iterable[int]) -> list[Step]:
        """Steps in the order of time, each closure where both of its ends are there."""
        at: dict[int, list[Closure]] = defaultdict(list)
        for k in sorted(believed):
            closure = self._closures[k]
            at[max(closure.time_ns, closure.other_time_ns)].append(closure)
        return [
            Step(t, self._starts.get(t, {}), self._motions.get(t, {}), (), tuple(at[t]))
            for t in sorted({*self._starts, *self._motions, *at})
        ]

    def _misfit(self, k: int, used: bool, backend: Reoptimiser, estimate: Estimate) -> float:
        """Squared Mahalanobis distance of a closure from what all others predict (leave one out).

        In units of the closure's own sigmas, along directions in which the estimate is independent:
        with m the variance of the relative pose by the estimate, r the residual and w the weight
        that the closure has in it (0 unless used), all others together predict r / (1 - w m) with
        variance m / (1 - w m). Directions in which they have hardly any information are left out.
        """
        c = self._closures[k]
        ends = (c.other, c.other_time_ns), (c.robot, c.time_ns)
        x, y = (estimate.states[robot].at(t) for robot, t in ends)
        h = between(x, y)
        L = np.linalg.cholesky(rotate_cov(c.cov, -float(c.delta[2])))
        r = np.linalg.solve(L, log(between(c.delta, h)))
        if ends[0] == ends[1]:
            return float(r @ r)
        J = np.linalg.solve(L, np.hstack([-adjoint(inverse(h)), np.eye(3)]))
        m, Q = np.linalg.eigh(J @ backend.state_covariance(ends) @ J.T)
        w = (KERNEL_SIGMAS**2 / (KERNEL_SIGMAS**2 + r @ r)) ** 2 if used else 0.0
        rest = 1.0 - w * m
        known = rest > MIN_SHARE
        r, m, rest = (Q.T @ r)[known], m[known], rest[known]
        return float(np.sum(r**2 / (rest * (rest + m))))
