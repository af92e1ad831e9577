"""Loops of a solved log closed by matching its submaps, round after round.

Each round proposes closures by the estimate so far, believes the largest consistent set of them,
and solves with it; what the solution contradicts is taken back. `ClosureLedger` keeps what was
decided about each pair of submaps.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from enum import Enum, auto

import numpy as np

from graphslam.core.config import Config
from graphslam.core.geometry import Array
from graphslam.core.records import Closure, Estimate, KeyframeScan, Step
from graphslam.mapping.landmark_map import LandmarkMap
from graphslam.mapping.loop_closure import (
    MAX_RESIDUAL,
    Pair,
    PairVerifier,
    Tamper,
    consistent_closures,
    inflate_covariances,
    loop_closures,
    residuals,
    violated,
)
from graphslam.mapping.submaps import build_submaps, with_poses_from
from graphslam.mapping.visits import rejoin_visits, split_by_visit
from graphslam.scan_smoothing.solver import Solver

#: rounds of loop closing, at most
MAX_CLOSING_ROUNDS = 8
#: solutions from inflated to stated covariances of closures, at most; residuals that stay above
#: this share of those of the solution before make no progress
MAX_TIGHTENING_ROUNDS, NO_PROGRESS = 4, 0.9


class State(Enum):
    """What is decided about a verified closure."""

    REFUSED = auto()  # it contradicts others; it may be consistent once more is known
    CONFIRMING = auto()  # used: its submaps match as the estimate has them
    CORRECTING = auto()  # used: it moves the estimate


class ClosureLedger:
    """The verified closures of a log by pair of submaps, and what is decided about each.

    ``taken_back``: how many that moved the estimate were used once, and are not any more.
    """

    def __init__(self) -> None:
        """Nothing is decided."""
        self._entries: dict[Pair, tuple[Closure, State]] = {}
        self.taken_back = 0

    def having(self, *states: State) -> list[Closure]:
        """The closures in any of these states; the used ones in the order of being first used."""
        return [closure for closure, state in self._entries.values() if state in states]

    @property
    def used(self) -> list[Closure]:
        """Those of which an estimate is to be made."""
        return self.having(State.CONFIRMING, State.CORRECTING)

    def proposed(self, new: Sequence[Closure]) -> list[Closure]:
        """What may move the estimate in this round: the refused ones again, and ``new`` ones."""
        return [*({c.pair: c for c in [*self.having(State.REFUSED), *new]}).values()]

    def decide(
        self,
        proposed: Sequence[Closure],
        confirming: Sequence[Closure],
        consistent: Sequence[Closure],
    ) -> bool:
        """Use the ``consistent`` ones among the ``proposed`` and ``confirming`` ones of a round.

        Returns:
            Whether any of them moves the estimate. If not nothing more is used.
        """
        for closure in proposed:
            if closure not in consistent and self._state(closure.pair) in (None, State.REFUSED):
                self._entries[closure.pair] = closure, State.REFUSED
        moving = {c.pair for c in consistent if c not in confirming}
        for pair in moving:
            if self._state(pair) is State.REFUSED:
                del self._entries[pair]  # first used now
        if not moving:
            return False
        for closure in consistent:
            moves = closure.pair in moving or self._state(closure.pair) is State.CORRECTING
            state = State.CORRECTING if moves else State.CONFIRMING
            self._entries[closure.pair] = closure, state
        return True

    def take_back(self, contradicted: Sequence[bool]) -> None:
        """Forget those of `used` that the estimate with them contradicts."""
        for closure, is_off in zip(self.used, contradicted, strict=True):
            if is_off:
                self.taken_back += self._state(closure.pair) is State.CORRECTING
                del self._entries[closure.pair]

    def _state(self, pair: Pair) -> State | None:
        return self._entries[pair][1] if pair in self._entries else None


def close_loops(
    steps: tuple[Step, ...],
    estimate: Estimate,
    keyframe_scans: Iterable[KeyframeScan],
    landmarks: LandmarkMap,
    solve: Solver,
    tamper: Tamper | None,
    counts: Counter[str],
    config: Config,
) -> tuple[tuple[Step, ...], list[Closure], Estimate]:
    """Loops closed by matching submaps.

    Where landmarks of different visits are associated wrongly, the estimate is wrong and
    overconfident. So closures are judged by what is known without those associations, and
    landmarks of different visits are associated again afterwards.

    Args:
        steps: as recorded.
        estimate: of all their states and landmarks.
        keyframe_scans: scan points seen from the states.
        landmarks: the map beside the estimate.
        solve: solves steps with closures.
        tamper: for tests, see `Tamper`.
        counts: what was verified and refused is added.
        config: settings.

    Returns:
        Steps, the closures that are used, and the estimate with them.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    split = split_by_visit(steps, estimate.states, landmarks, config.loop_closure.revisit_path_m)
    closed = split.start(estimate)
    prior = solve(split.steps, closed)
    submaps = build_submaps(prior.states, keyframe_scans, config)  # bent by no wrong association
    ledger = ClosureLedger()
    examined: dict[Pair, Array] = {}
    with PairVerifier(submaps) as verify:
        for _ in range(MAX_CLOSING_ROUNDS if submaps else 0):
            P = solve.backend.state_covariance([submap.state for submap in submaps])
            new, confirming = loop_closures(
                with_poses_from(submaps, closed.states), P, examined, config.loop_closure, verify
            )
            if tamper is not None:
                new = [c for c in tamper([*new, *confirming], submaps) if c not in confirming]
            proposed = ledger.proposed(new)
            consistent = consistent_closures(
                [*proposed, *confirming], with_poses_from(submaps, prior.states), P
            )
            if not ledger.decide(proposed, confirming, consistent):
                break
            closed = prior = solve_with_tightening(split.steps, ledger.used, closed, solve)
            ledger.take_back(violated(ledger.used, closed.states, MAX_RESIDUAL))
    correcting = ledger.having(State.CORRECTING)
    counts["closures_verified"] = len(correcting)
    counts["closures_refused"] += ledger.taken_back + len(ledger.having(State.REFUSED))
    if not correcting:
        return steps, [], estimate
    return rejoin_visits(split, closed, landmarks, config.association), correcting, closed


def solve_with_tightening(
    steps: Sequence[Step], closures: Sequence[Closure], estimate: Estimate, solve: Solver
) -> Estimate:
    """Solved with closures whose covariances are inflated first, and tightened step by step."""
    before = np.inf
    for _ in range(MAX_TIGHTENING_ROUNDS):
        if not any(violated(closures, estimate.states, MAX_RESIDUAL)):
            return solve(steps, estimate, closures)
        estimate = solve(steps, estimate, inflate_covariances(closures, estimate.states))
        left = float(np.abs(residuals(closures, estimate.states)).sum())
        if left > NO_PROGRESS * before:
            break
        before = left
    # what holds the estimate back may be wrong associations: starting where all closures are
    # satisfied, the robust kernels tell which of the two is wrong
    held = solve(steps, estimate, [replace(closure, verified=True) for closure in closures])
    return solve(steps, held, closures)
