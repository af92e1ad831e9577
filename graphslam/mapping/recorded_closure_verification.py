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
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphslam.core.config import RobustConfig
from graphslam.core.consistency import FIT_PROBABILITY, greedy_max_clique, has_rival, rival_set
from graphslam.core.frame_forest import PRIOR_INFLATION, grow_frame_forest
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, adjoint, between, compose, inverse, log, rotate_cov
from graphslam.core.records import (
    Closure,
    Motion,
    RelativePose,
    Start,
    Step,
)
from graphslam.estimation.closure_graph import ClosureGraph
from graphslam.estimation.initial_estimate import initial_estimate
from graphslam.mapping.recorded_loops import OdometryChain, compared_loops, odometry_chains
from graphslam.odometry.preintegration import Track

#: closures compared with each other at once, in order of time; the work grows with its square
CHUNK = 1000
#: closures from which the largest consistent set is searched for; what it lacks is added later
SEARCH_STARTS = 4
#: scale of the redescending kernel of the joint solution, in sigmas
KERNEL_SIGMAS = 3.0
#: share of the information in a direction that the other closures must have for a comparison
MIN_SHARE = 1e-3
#: share of closures that may seem not to fit although all are true
MISFIT_SHARE = 0.01
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
) -> ClosureDecision:
    """Decide which relative poses of a log to use.

    Those with an end outside the odometry are not judged. ``starts`` are the known ones.

    Raises:
        EstimationError: a covariance is not positive definite.
    """
    judged = [k for k, m in enumerate(messages) if _has_ends(m, tracks)]
    if not judged:
        return NOTHING_RECORDED
    odometry = odometry_chains([messages[k] for k in judged], tracks)
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
            E, agree = compared_loops([messages[k] for k in chunk], odometry)
            frames_seen.update(zip(chunk, E, strict=True))
            worth = np.ones(len(chunk), dtype=np.float32)
            best = greedy_max_clique(agree, worth, SEARCH_STARTS)
            sets[pair] = sets.get(pair, []) + [chunk[n] for n in best]
            if pair[0] != pair[1]:
                rest = np.setdiff1d(np.arange(len(chunk)), best)
                rival = rival_set(agree, worth, rest, SEARCH_STARTS)
                if not has_rival(len(best), [len(rival)]):
                    clear.add(pair)
    placed, frames = _initial_starts(sets, clear, frames_seen, odometry, starts)
    believed = {
        k
        for (a, b), numbers in sets.items()
        for k in numbers
        if frames[a] == frames[b] and (a == b or (a, b) in clear or {a, b} <= set(starts))
    }
    candidates = [k for k in judged if frames[messages[k].robot] == frames[messages[k].other]]
    supported, graph = _settle(
        [messages[k] for k in candidates],
        {n for n, k in enumerate(candidates) if k in believed},
        odometry,
        tracks,
        {**placed, **starts},
    )
    kept = frozenset(candidates[n] for n in supported)
    apart = set(judged) - set(candidates)
    refused = {k: UNSUPPORTED if k in apart else CONTRADICTED for k in judged if k not in kept}
    found: dict[str, Start] = {}
    if placed:
        graph.solve(sorted(supported), robust=False, rough=False)
        for robot, states in graph.estimate().states.items():
            if robot in placed:
                wide = PRIOR_INFLATION**2 * states.covs[0]
                found[robot] = Start(states.poses[0], ORIGIN if frames[robot] == robot else wide)
    return ClosureDecision(refused, kept, found, frames)


def _has_ends(m: RelativePose, tracks: Mapping[str, Track]) -> bool:
    if m.robot == m.other and m.start_ns >= m.time_ns:
        return False
    return all(
        robot in tracks and len(tracks[robot]) > 0 and tracks[robot].first_ns <= time_ns
        for robot, time_ns in ((m.robot, m.time_ns), (m.other, m.start_ns))
    )


# ---------------------------------------------------------------- frames


def _initial_starts(
    sets: Mapping[tuple[str, str], Sequence[int]],
    clear: set[tuple[str, str]],
    seen: Mapping[int, Array],
    odometry: Mapping[str, OdometryChain],
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


def _settle(
    messages: Sequence[RelativePose],
    believed: set[int],
    odometry: Mapping[str, OdometryChain],
    tracks: Mapping[str, Track],
    starts: Mapping[str, Start],
) -> tuple[set[int], ClosureGraph]:
    """The closures that support each other, beginning with ``believed``; and the graph of all.

    Its states are those at the ends of closures.
    """
    gate = chi2_quantile(FIT_PROBABILITY, 3)
    steps, closures = _steps(odometry, starts), _closures(messages)
    first = [closures[k] for k in sorted(believed)]
    if _has_false_parts(messages, believed, tracks, starts):
        graph = _graph(steps, closures, first)
        graph.solve(sorted(believed), robust=False)
    else:
        graph = _graph(steps, closures, closures)
        misfits = _misfits_of_all(graph, closures)
        if not misfits:
            return set(range(len(closures))), graph
        if misfits <= _tolerated(len(closures)):
            believed = set(range(len(closures)))
        else:
            graph.begin_at(initial_estimate(steps, first))
            graph.solve(sorted(believed), robust=False)
    barred: set[int] = set()
    for _ in range(MAX_ROUNDS):
        graph.solve(sorted(believed), robust=True)
        used = np.isin(np.arange(len(closures)), sorted(believed))
        d2 = _misfits(closures, used, *graph.ends())
        wrong = sorted((k for k in believed if d2[k] > gate), key=lambda k: -d2[k])
        new = set(np.flatnonzero(d2 <= gate).tolist()) - believed - barred
        if not wrong and not new:
            break
        # one outlier makes others look like outliers, so the worst are removed first
        gone = set(wrong[: max(1, len(wrong) // 4)])
        barred |= gone
        believed = believed - gone if gone else believed | new
    return believed, graph


def _has_false_parts(
    messages: Sequence[RelativePose],
    believed: set[int],
    tracks: Mapping[str, Track],
    starts: Mapping[str, Start],
) -> bool:
    """Whether parts of many closures have as many misfits as all together may not have.

    False ones tie poses far from each other, so the time to solve all together grows with the cube
    of their number. Those among a thousand are as false with the others: the parts of which the
    fewest are ``believed`` come first, until one has hardly any.
    """
    if len(messages) <= CHUNK:
        return False
    parts = [
        range(len(messages))[first : first + CHUNK] for first in range(0, len(messages), CHUNK)
    ]
    misfits = 0
    for part in sorted(parts, key=lambda part: len(believed & set(part)) / len(part)):
        some = [messages[k] for k in part]
        closures = _closures(some)
        graph = _graph(_steps(odometry_chains(some, tracks), starts), closures, closures)
        found = _misfits_of_all(graph, closures)
        misfits += found
        if misfits > _tolerated(len(messages)) or found <= _tolerated(len(part)):
            break
    return misfits > _tolerated(len(messages))


def _tolerated(closures: int) -> float:
    """How many of closures may not fit with all others although all are true."""
    return 1 + MISFIT_SHARE * closures


def _closures(messages: Iterable[RelativePose]) -> list[Closure]:
    return [Closure(m.robot, m.time_ns, m.other, m.start_ns, m.delta, m.cov) for m in messages]


def _graph(
    steps: Sequence[Step], closures: Sequence[Closure], followed: Sequence[Closure]
) -> ClosureGraph:
    """A graph of closures that begins where odometry and those ``followed`` lead."""
    kernel = RobustConfig("geman-mcclure", KERNEL_SIGMAS)
    return ClosureGraph(steps, initial_estimate(steps, followed), closures, kernel)


def _misfits_of_all(graph: ClosureGraph, closures: Sequence[Closure]) -> int:
    """How many closures do not fit when all are solved together, without a kernel.

    One that is false by more than chance leads others astray, so then these are many.
    """
    if not closures:
        return 0
    graph.solve(range(len(closures)), robust=False)
    used = np.ones(len(closures), dtype=np.bool_)
    d2 = _misfits(closures, used, *graph.ends(), robust=False)
    return int(np.count_nonzero(d2 > chi2_quantile(FIT_PROBABILITY, 3)))


def _steps(odometry: Mapping[str, OdometryChain], starts: Mapping[str, Start]) -> list[Step]:
    """Starts and motions of all robots, in the order of time."""
    first: dict[int, dict[str, Start]] = defaultdict(dict)
    motions: dict[int, dict[str, Motion]] = defaultdict(dict)
    for robot, chain in odometry.items():
        first[int(chain.times_ns[0])][robot] = starts[robot]
        for motion in chain.motions:
            motions[motion.end_ns][robot] = motion
    times = sorted({*first, *motions})
    return [Step(t, first.get(t, {}), motions.get(t, {})) for t in times]


def _misfits(
    closures: Sequence[Closure],
    used: NDArray[np.bool_],
    x: Array,
    y: Array,
    P: Array,
    *,
    robust: bool = True,
) -> Array:
    """Squared Mahalanobis distances (n,) of closures from what all others predict (leave one out).

    In units of each closure's own sigmas, along directions in which the estimate is independent:
    with m the variance of the relative pose by the estimate, r the residual and w the weight
    that the closure has in it (0 unless used), all others together predict r / (1 - w m) with
    variance m / (1 - w m). Directions in which they have hardly any information are left out.

    Args:
        closures: as measured.
        used: (n,) whether each is in the estimate.
        x: (n, 3) estimates of the states in whose frames they are.
        y: (n, 3) estimates of the others.
        P: (n, 6, 6) joint covariances of both, errors along each one's axes.
        robust: whether the estimate is under the kernel.
    """
    delta, cov = (np.array([getattr(c, name) for c in closures]) for name in ("delta", "cov"))
    h = between(x, y)
    L = np.linalg.cholesky(rotate_cov(cov, -delta[:, 2]))
    r = np.linalg.solve(L, log(between(delta, h))[:, :, None])
    unit = np.broadcast_to(np.eye(3), L.shape)
    J = np.linalg.solve(L, np.concatenate([-adjoint(inverse(h)), unit], axis=2))
    m, Q = np.linalg.eigh(J @ P @ J.mT)
    squared = (r * r).sum(axis=(1, 2))
    weight = (KERNEL_SIGMAS**2 / (KERNEL_SIGMAS**2 + squared)) ** 2 if robust else 1.0
    w = np.where(used, weight, 0.0)
    m = np.maximum(m, 0.0)  # rounding, where the poses are uncertain by far more than the closure
    rest = 1.0 - w[:, None] * m
    r = (Q.mT @ r)[:, :, 0]
    known = rest > MIN_SHARE
    rest = np.where(known, rest, 1.0)
    return np.asarray(np.where(known, r**2 / (rest * (rest + m)), 0.0).sum(axis=1))
