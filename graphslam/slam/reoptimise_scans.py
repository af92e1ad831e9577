"""A whole log of scans solved again: noise, loop closure, duplicate landmarks, calibration.

The calibration that was learned while the log was read is applied to the motions before it was
known. Loops are closed by matching submaps (`loop_closure`). Landmarks that turn out to be one are
merged, round after round. Where merged landmarks say what a closure says, the closure is removed,
since both come from the same scans.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from graphslam.core.config import Config
from graphslam.core.geometry import Array
from graphslam.core.records import Closure, Estimate, Picture, Step
from graphslam.estimation.batch_calibration import calibrate, recompute_motions
from graphslam.estimation.isam2 import Reoptimiser
from graphslam.mapping.duplicate_landmarks import (
    duplicates,
    merge_entries,
    merge_targets,
    merged_steps,
    partners,
    seen_together,
)
from graphslam.mapping.landmark_map import LandmarkMap
from graphslam.mapping.loop_closure import (
    BORNE_OUT,
    CLOSED,
    Pair,
    SubmapPose,
    build_submaps,
    consistent_closures,
    inflate_covariances,
    loop_closures,
    residuals,
    violated,
    with_poses_from,
)
from graphslam.mapping.reassociation import reassociate
from graphslam.mapping.visits import rejoin_visits, split_by_visit
from graphslam.odometry.preintegration import Track
from graphslam.slam.motion_noise import noise_scales, scale_motion_noise

#: m across, rad: how far an observation may lie from a wall, from round to round
GATES = ((0.3, 0.15), (0.15, 0.1), (0.15, 0.1))
#: times that the noise of motions is estimated, at most; it is settled when it grows by less than
MAX_NOISE_ROUNDS, NOISE_GROWTH = 4, 1.1
#: rounds of loop closing, at most
MAX_CLOSING_ROUNDS = 8
#: solutions from inflated to stated covariances of closures, at most; residuals that stay above
#: this share of those of the solution before make no progress
MAX_TIGHTENING_ROUNDS, NO_PROGRESS = 4, 0.9

#: stands between verifying closures and believing them: for tests, which add false ones
Tamper = Callable[[list[Closure], Sequence[SubmapPose]], list[Closure]]


def reoptimise_scan_log(
    steps: Sequence[Step],
    estimate: Estimate,
    tracks: Mapping[str, Track],
    landmarks: LandmarkMap,
    pictures: Iterable[Picture],
    config: Config,
    tamper: Tamper | None = None,
) -> tuple[Estimate, tuple[Step, ...], Counter[str]]:
    """Solve a log of scans again: motion noise, loop closure, duplicates, calibration.

    Args:
        steps: as recorded.
        estimate: of all their states and landmarks.
        tracks: odometry of every robot, with its final calibration.
        landmarks: the map beside the estimate; merged landmarks leave it.
        pictures: scan points seen from the states.
        config: settings.
        tamper: for tests, see `Tamper`.

    Returns:
        The estimate, the steps behind it, and counts of what was changed, by name.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    solve = _Solver(config)
    steps, estimate = _with_observed_motion_noise(recompute_motions(steps, tracks), estimate, solve)
    counts: Counter[str] = Counter()
    closures: list[Closure] = []
    if config.backend.close_loops:
        steps, closures, estimate = _close_loops(
            steps, estimate, pictures, landmarks, solve, tamper, counts
        )
    for gates in GATES:
        estimate = solve(steps, estimate, closures)
        into = _duplicates(estimate, solve.backend, landmarks, steps)
        if into:
            kinds = {number: landmarks.entries[number].kind for number in into.values()}
            steps = merged_steps(steps, into, kinds)
            merge_entries(landmarks, into)
            counts["landmarks_merged"] += len(into)
        # duplicates are merged first: else observations would move to and fro between the two
        again = reassociate(steps, estimate, landmarks.entries, *gates)
        if into or again.moved or again.dropped:
            steps = again.steps
        counts["observations_reassociated"] += again.moved
        counts["observations_dropped"] += again.dropped
    if closures:
        # those stay that the landmarks do not satisfy without them
        estimate = solve(steps, estimate)
        missed = violated(closures, estimate.states, CLOSED)
        closures = [c for c, off in zip(closures, missed, strict=True) if off]
        counts["closures_kept"] = len(closures)
    if config.odometry.calibrate:
        estimate = solve(steps, estimate, closures)
        closed = with_closures(steps, closures)

        def rebuild(estimate: Estimate, _last: bool) -> tuple[Step, ...]:
            made = recompute_motions(closed, tracks)
            return scale_motion_noise(made, noise_scales(made, estimate))

        estimate, steps = calibrate(rebuild, estimate, tracks, config.robust)
    else:
        estimate = solve(steps, estimate, closures, rough=False)
        steps = with_closures(steps, closures)
    landmarks.follow(steps, estimate)
    return estimate, steps, counts


class _Solver:
    """Solves steps with closures; ``backend`` is the latest one, for its covariances."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._solved: tuple[Sequence[Step], Estimate] | None = None

    def __call__(
        self,
        steps: Sequence[Step],
        start: Estimate,
        closures: Sequence[Closure] = (),
        *,
        rough: bool = True,
    ) -> Estimate:
        """The estimate; the graph stays as long as steps are the same and go on from the last."""
        if self._solved is None or self._solved[0] is not steps or self._solved[1] is not start:
            self.backend = Reoptimiser(self._config, steps, start)
        estimate = self.backend.solve(closures, rough=rough)
        self._solved = steps, estimate
        return estimate


def _close_loops(
    steps: tuple[Step, ...],
    estimate: Estimate,
    pictures: Iterable[Picture],
    landmarks: LandmarkMap,
    solve: _Solver,
    tamper: Tamper | None,
    counts: Counter[str],
) -> tuple[tuple[Step, ...], list[Closure], Estimate]:
    """Loops closed by matching: steps, the closures that are believed, and the estimate with them.

    Where visits' landmarks are tied wrongly the estimate is wrong and sure of itself. So closures
    are judged by what is known without those ties, and landmarks are tied again afterwards.
    """
    taken_apart = split_by_visit(steps, estimate.states, landmarks)
    now = taken_apart.start(estimate)
    loose = solve(taken_apart.steps, now)
    seen = build_submaps(loose.states, pictures)  # bent by no tie
    believed: dict[Pair, Closure] = {}
    lost: set[Pair] = set()  # those of them that said something new
    refused: dict[Pair, Closure] = {}
    looked: dict[Pair, Array] = {}
    for _ in range(MAX_CLOSING_ROUNDS if seen else 0):
        P = solve.backend.state_covariance([place.state for place in seen])
        new, same = loop_closures(with_poses_from(seen, now.states), P, looked)
        if tamper is not None:
            new = [c for c in tamper([*new, *same], seen) if c not in same]
        # what did not agree before may do so now
        open_ones = refused | {c.pair: c for c in new}
        agreed = consistent_closures(
            [*open_ones.values(), *same], with_poses_from(seen, loose.states), P
        )
        refused = {pair: c for pair, c in open_ones.items() if c not in agreed}
        told = {c.pair for c in agreed if c not in same}
        if not told:
            break
        lost |= told
        believed |= {c.pair: c for c in agreed}
        now = loose = _tightened(taken_apart.steps, [*believed.values()], now, solve)
        gone = violated([*believed.values()], now.states, BORNE_OUT)
        taken_back = {pair for pair, off in zip(believed, gone, strict=True) if off}
        counts["closures_refused"] += len(taken_back & lost)
        believed = {pair: c for pair, c in believed.items() if pair not in taken_back}
        lost -= taken_back
    counts["closures_verified"] = len(lost)
    counts["closures_refused"] += len(refused)
    if not lost:
        return steps, [], estimate
    closures = [closure for pair, closure in believed.items() if pair in lost]
    return rejoin_visits(taken_apart, now, landmarks), closures, now


def _tightened(
    steps: Sequence[Step], closures: Sequence[Closure], estimate: Estimate, solve: _Solver
) -> Estimate:
    """Solved with closures that are slack first, and the tighter the nearer the estimate comes."""
    before = np.inf
    for _ in range(MAX_TIGHTENING_ROUNDS):
        if not any(violated(closures, estimate.states, BORNE_OUT)):
            return solve(steps, estimate, closures)
        estimate = solve(steps, estimate, inflate_covariances(closures, estimate.states))
        left = float(np.abs(residuals(closures, estimate.states)).sum())
        if left > NO_PROGRESS * before:
            break
        before = left
    # what holds the estimate back may be wrong and sure of itself: from where all closures hold,
    # kernels tell which of the two is
    held = solve(steps, estimate, [replace(closure, verified=True) for closure in closures])
    return solve(steps, held, closures)


def _with_observed_motion_noise(
    steps: tuple[Step, ...], estimate: Estimate, solve: _Solver
) -> tuple[tuple[Step, ...], Estimate]:
    """Steps with motions as noisy as the log shows them, and the estimate from them.

    Motions that are believed too much keep an estimate from showing how noisy they are, so their
    noise is estimated again until it grows no more.
    """
    scaled, scales = steps, {robot: np.ones(3) for robot in estimate.states}
    for _ in range(MAX_NOISE_ROUNDS):
        before, scales = scales, scales | noise_scales(steps, estimate)
        scaled = scale_motion_noise(steps, scales)
        estimate = solve(scaled, estimate)
        if all(np.all(scale <= NOISE_GROWTH * before[robot]) for robot, scale in scales.items()):
            break
    return scaled, estimate


def _duplicates(
    estimate: Estimate, backend: Reoptimiser, landmarks: LandmarkMap, steps: Sequence[Step]
) -> dict[int, int]:
    """Landmark that goes -> landmark that it becomes; the map follows the estimate."""
    landmarks.follow(steps, estimate)
    known = [entry for entry in landmarks.entries.values() if entry.id in estimate.landmarks]
    together = seen_together(steps)
    known = partners(known, together)
    if not known:
        return {}
    joint = backend.joint(min(estimate.states), [entry.id for entry in known])
    return merge_targets(duplicates(known, joint, together))


def with_closures(steps: Iterable[Step], closures: Iterable[Closure]) -> tuple[Step, ...]:
    """Steps that hold closures too, each in the step of its time."""
    at: dict[int, tuple[Closure, ...]] = {}
    for closure in closures:
        at[closure.time_ns] = (*at.get(closure.time_ns, ()), closure)
    return tuple(
        replace(step, closures=(*step.closures, *at[step.time_ns])) if step.time_ns in at else step
        for step in steps
    )
