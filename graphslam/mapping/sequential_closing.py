"""Loops closed in the order of the path, on a pose graph of submaps.

Where a robot comes back, the drift since the last closure decides how far a submap has to be
searched for. Closed in the order of the path, that is the drift of one loop, not of the whole log:
windows stay small and most later submaps need no search at all. A few submaps are taken at a time;
their closures must be consistent with each other and with what is closed already, and in the end
each with all the others. The number of
submaps that one is compared with is bounded, so the work grows with the path, not with its square,
however often a place is visited.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import LoopClosureConfig
from graphslam.core.consistency import distances_from_others
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, between, log, rotation3
from graphslam.core.records import Closure
from graphslam.mapping.loop_closure import (
    AGREE,
    ALREADY_CLOSED,
    COV_INFLATION,
    MARGIN,
    MAX_RESIDUAL,
    NEAR_M,
    SIGMAS,
    Pair,
    PairVerifier,
    SubmapPair,
    Tamper,
    are_near,
    consistent_closures,
    known_part,
    verified_closures,
)
from graphslam.mapping.submap_graph import SubmapConstraints, SubmapGraph
from graphslam.mapping.submaps import State, SubmapPose

#: submaps that are taken at a time, and rounds until nothing more is closed among them, at most
AT_ONCE, MAX_ROUNDS = 10, 4
#: earlier visits that one submap is compared with, at most
MAX_VISITS = 3
#: m, the default reach of a submap: visits within one such step of distance see the same, and the
#: first of them are taken. So later visits are joined to the first few, not to each other, and the
#: factor of the graph has as many entries per submap however many visits there are
SAME_M = NEAR_M
#: m, m, rad: two sigmas of a relative pose that another match would not improve
KNOWN = np.array([0.05, 0.05, 0.012])


@dataclass(frozen=True, slots=True, eq=False)
class ClosedLoops:
    """The result of `close_loops`.

    ``correcting`` closures were found by a search; those found where the submaps lay only confirm
    the path. ``refused`` are the pairs of those that were inconsistent, and stayed so.
    """

    correcting: tuple[Closure, ...]
    refused: frozenset[Pair]


class _Closer:
    """The pose graph, and the closures so far."""

    def __init__(
        self,
        submaps: Sequence[SubmapPose],
        nodes: IntArray,
        graph: SubmapGraph,
        config: LoopClosureConfig,
    ) -> None:
        self.graph, self.config, self.submaps, self.nodes = graph, config, list(submaps), nodes
        self.at: dict[State, int] = {s.state: k for k, s in enumerate(submaps)}
        self.robots = np.unique([s.state[0] for s in submaps], return_inverse=True)[1]
        self.path_m = np.array([s.path_m for s in submaps])
        # robots take turns by time, so that none is far ahead of the others
        self.order = np.argsort([s.state[1] for s in submaps], kind="stable")
        self.rank = np.argsort(self.order)  # place in this order
        self.accepted: dict[Pair, Closure] = {}
        self.correcting: set[Pair] = set()
        self.refused: set[Pair] = set()
        self.examined: dict[Pair, Array] = {}

    def placed(self, which: Iterable[int] | None = None) -> list[SubmapPose]:
        """Submaps, all or some of them, at the poses of the graph."""
        numbers = range(len(self.submaps)) if which is None else which
        return [replace(self.submaps[k], pose=self.graph.poses[self.nodes[k]]) for k in numbers]

    def candidates(self, later: IntArray) -> list[SubmapPair]:
        """Pairs that may show one place."""
        poses, config = self.graph.poses[self.nodes], self.config
        limit = np.array([config.search_max_m, config.search_max_m, config.search_max_rad])
        pairs: list[tuple[int, int]] = []
        for i in later.tolist():
            distance = np.hypot(*(poses[:, :2] - poses[i, :2]).T)
            apart = self.robots != self.robots[i]
            apart |= self.path_m[i] - self.path_m >= config.revisit_path_m
            # the graph has no poses of later ones yet, whatever their place among the submaps
            earlier = self.rank < self.rank[i]
            j = np.flatnonzero(earlier & apart & (distance <= NEAR_M + limit[0]))
            ends = np.flatnonzero((np.diff(j) > 1) | (np.diff(self.robots[j]) != 0)) + 1
            nearest = [s[distance[s].argmin()] for s in np.split(j, ends) if len(s)]
            nearest.sort(key=lambda k: (distance[k] // SAME_M, k))
            pairs += [(i, int(k)) for k in nearest[:MAX_VISITS]]
        # covariances only of pairs that are to be examined: they take most of the time
        pairs = [(i, j) for i, j in pairs if not self.is_examined(i, j)]
        if not pairs:
            return []
        i, j = np.array(pairs).T
        h, cov = self.graph.relative(self.nodes[i], self.nodes[j])
        sigma = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
        unknown = (2 * sigma > KNOWN).any(axis=1)
        sigma *= np.sqrt(COV_INFLATION)
        window = np.minimum(SIGMAS * sigma + MARGIN, limit)
        may = np.hypot(h[:, 0], h[:, 1]) <= NEAR_M + window[:, :2].max(axis=1)
        return [
            SubmapPair(self.submaps[i[k]], self.submaps[j[k]], h[k], window[k])
            for k in np.flatnonzero(may & unknown)
        ]

    def is_examined(self, i: int, j: int) -> bool:
        """Whether a pair was examined where it lies now."""
        before = self.examined.get((self.submaps[i].state, self.submaps[j].state))
        if before is None:
            return False
        own, other = self.graph.poses[self.nodes[[i, j]]]
        return are_near(before, between(other, own), ALREADY_CLOSED)

    def believe(self, correcting: list[Closure], confirming: list[Closure]) -> bool:
        """Add those that are consistent to the graph; whether any correct it."""
        proposed = [*correcting, *confirming]
        involved = np.unique([self.ends(c) for c in proposed])
        consistent = consistent_closures(
            proposed, self.placed(involved), self.graph.covariance(self.nodes[involved])
        )
        added = {c.pair for c in consistent} - {c.pair for c in confirming}
        self.refused |= {c.pair for c in correcting} - added
        self.accepted |= {c.pair: c for c in consistent}
        self.correcting |= added
        if consistent:
            self.solve()
        return bool(added)

    def solve(self) -> None:
        """Solve with all accepted closures; those that the solution violates are taken back."""
        before = self.graph.poses.copy()
        while self.accepted:
            measured = self.relative_poses()
            self.graph.poses = before.copy()  # wrong closures may bend the path beyond return
            self.graph.solve(measured)
            poses = self.graph.poses
            off = between(measured.delta, between(poses[measured.begin], poses[measured.end]))
            off = known_part(off, list(self.accepted.values()))
            wrong = np.hypot(off[:, 0], off[:, 1]) > MAX_RESIDUAL[0]
            wrong |= np.abs(off[:, 2]) > MAX_RESIDUAL[1]
            if not wrong.any():
                return
            self.take_back(np.flatnonzero(wrong))
        self.graph.poses = before
        self.graph.solve(None)

    def judge_again(self) -> None:
        """Take back closures that all the others contradict, the worst first.

        While little is closed a place that only looks alike is consistent with what is known. Later
        ones bend the path around it, so that its residual may be small; but without it they agree.
        They are compared as closures are when they are proposed.
        """
        while self.accepted:
            measured = self.relative_poses()
            h, S = self.graph.relative(measured.end, measured.begin)
            turn = rotation3(-measured.delta[:, 2])  # into the frames of the residuals
            r = log(between(measured.delta, h))
            R, S = (turn @ cov @ turn.mT for cov in (measured.cov, S))
            d2 = distances_from_others(r, R, S, COV_INFLATION)
            if d2.max() <= chi2_quantile(AGREE, 3):
                return
            self.take_back(np.array([d2.argmax()]))
            self.solve()

    def take_back(self, which: IntArray) -> None:
        """Refuse some of the accepted closures (k,), by their order."""
        pairs = list(self.accepted)
        for k in which:
            self.refused.add(pairs[k])
            self.correcting.discard(pairs[k])
            del self.accepted[pairs[k]]

    def ends(self, closure: Closure) -> tuple[int, int]:
        """Numbers of the earlier and the later submap."""
        return (
            self.at[closure.other, closure.other_time_ns],
            self.at[closure.robot, closure.time_ns],
        )

    def relative_poses(self) -> SubmapConstraints:
        """The accepted closures as arrays."""
        found = list(self.accepted.values())
        ends = self.nodes[np.array([self.ends(c) for c in found])]
        return SubmapConstraints(
            ends[:, 0], ends[:, 1], np.array([c.delta for c in found]),
            np.array([c.cov for c in found]),
        )  # fmt: skip


def close_loops(
    submaps: Sequence[SubmapPose],
    nodes: IntArray,
    graph: SubmapGraph,
    config: LoopClosureConfig,
    tamper: Tamper | None = None,
) -> ClosedLoops:
    """Close loops in the order of the path.

    Args:
        submaps: of all robots, those of each in the order of its path.
        nodes: (n,) of the submaps in the graph.
        graph: of their poses; its poses change.
        config: what counts as another visit, and how far is searched.
        tamper: for tests, see `Tamper`.
    """
    closer = _Closer(submaps, nodes, graph, config)
    order = closer.order
    with PairVerifier(submaps, along=True) as verify:
        ends = [*range(AT_ONCE, len(order) + AT_ONCE, AT_ONCE), len(order)]
        for n, end in enumerate(ends):
            known = order[:end]
            later = known[end - AT_ONCE :]
            graph.begin_with(nodes[known])
            if n == len(ends) - 1:
                # in the end all of them once more: later loops moved the path, and a place that was
                # out of reach may be in reach now
                later = order
                closer.judge_again()
            for _ in range(MAX_ROUNDS):
                found, confirming = verified_closures(
                    closer.candidates(later), closer.examined, verify
                )
                if tamper is not None:
                    told = tamper([*found, *confirming], closer.placed(known))
                    found = [c for c in told if c not in confirming]
                if not (found or confirming) or not closer.believe(found, confirming):
                    break
    closer.judge_again()
    graph.begin_with(None)
    graph.solve(closer.relative_poses() if closer.accepted else None)
    correcting = [c for pair, c in closer.accepted.items() if pair in closer.correcting]
    return ClosedLoops(tuple(correcting), frozenset(closer.refused - closer.accepted.keys()))
