"""A whole log of scans solved again: noise, loop closure, duplicate landmarks, calibration.

The calibration that was learned while the log was read is applied to the motions before it was
known. Loops are closed by matching submaps (`loop_closure`). Landmarks that turn out to be one are
merged, round after round. Where merged landmarks say what a closure says, the closure is removed,
since both come from the same scans.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from graphslam.core.config import Config
from graphslam.core.geometry import Array, compose, inverse, rotate_cov
from graphslam.core.records import Closure, Estimate, KeyframeScan, Start, Step
from graphslam.estimation.batch_calibration import ROUNDS, calibrate, recompute_motions
from graphslam.estimation.calibration_graph import CalibratedSolution
from graphslam.estimation.isam2 import Reoptimiser
from graphslam.estimation.joint_covariances import mount_errors
from graphslam.estimation.log_noise import LogNoise
from graphslam.estimation.motion_noise import fit_motion_noise, noise_scales, scale_motion_noise
from graphslam.mapping.composite_walls import split_composites
from graphslam.mapping.duplicate_landmarks import (
    find_duplicates,
    merged,
    seen_together,
)
from graphslam.mapping.landmark_map import LandmarkMap
from graphslam.mapping.loop_closure import (
    ALREADY_CLOSED,
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
from graphslam.mapping.reassociation import reassociate
from graphslam.mapping.robot_gating import RobotOffers
from graphslam.mapping.submaps import build_submaps, with_poses_from
from graphslam.mapping.visits import rejoin_visits, split_by_visit
from graphslam.odometry.interpolation import origin_shift
from graphslam.odometry.preintegration import Track

#: factors on the gates of re-association (across, direction), round by round
GATE_FACTORS = ((1.0, 1.0), (1 / 2, 2 / 3), (1 / 2, 2 / 3))
#: times that the noise of motions is estimated, at most; it is settled when it grows by less than
MAX_NOISE_ROUNDS, NOISE_GROWTH = 4, 1.1
#: a mount of one of several robots is corrected if it is off by so many of its sigmas
MOUNT_SIGMAS = 4.0
#: rounds of loop closing, at most
MAX_CLOSING_ROUNDS = 8
#: solutions from inflated to stated covariances of closures, at most; residuals that stay above
#: this share of those of the solution before make no progress
MAX_TIGHTENING_ROUNDS, NO_PROGRESS = 4, 0.9


def reoptimise_scan_log(
    steps: Sequence[Step],
    estimate: Estimate,
    tracks: Mapping[str, Track],
    landmarks: LandmarkMap,
    keyframe_scans: Iterable[KeyframeScan],
    config: Config,
    tamper: Tamper | None = None,
    robots: RobotOffers | None = None,
    frames: Mapping[str, str] | None = None,
) -> tuple[Estimate, tuple[Step, ...], Counter[str], LogNoise]:
    """Solve a log of scans again: motion noise, loop closure, duplicates, calibration.

    Args:
        steps: as recorded.
        estimate: of all their states and landmarks.
        tracks: odometry of every robot, with its final calibration.
        landmarks: the map beside the estimate; merged landmarks leave it.
        keyframe_scans: scan points seen from the states.
        config: settings.
        tamper: for tests, see `Tamper`.
        robots: what sightings of robots could be, used or not.
        frames: robot -> the robot whose base begins at the origin of its frame.

    Returns:
        The estimate, the steps behind it, counts of what was changed, by name, and the noise of
        the odometry.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    solve = Solver(config)
    steps, estimate = _with_observed_motion_noise(recompute_motions(steps, tracks), estimate, solve)
    counts: Counter[str] = Counter()
    noise = LogNoise()
    closures: list[Closure] = []
    if config.backend.close_loops:
        steps, closures, estimate = _close_loops(
            steps, estimate, keyframe_scans, landmarks, solve, tamper, counts, config
        )
    association = config.association
    for factor_m, factor_rad in GATE_FACTORS:
        steps, estimate = split_composites(steps, estimate, landmarks)
        estimate = solve(steps, estimate, closures)
        landmarks.update_from(steps, estimate)
        known = [e for e in landmarks.entries.values() if e.id in estimate.landmarks]
        joint = partial(solve.backend.joint, min(estimate.states))
        into = find_duplicates(known, seen_together(steps), joint)
        steps = merged(steps, into, landmarks)
        counts["landmarks_merged"] += len(into)
        # duplicates are merged first: else observations would move to and fro between the two
        again = reassociate(
            steps,
            estimate,
            landmarks.entries,
            factor_m * association.reassociation_gate_m,
            factor_rad * association.reassociation_gate_rad,
            association.overlap_gap_m,
        )
        if into or again.moved or again.dropped:
            steps = again.steps
        counts["observations_reassociated"] += again.moved
        counts["observations_dropped"] += again.dropped
    if closures:
        # those stay that the landmarks do not satisfy without them
        estimate = solve(steps, estimate)
        missed = violated(closures, estimate.states, ALREADY_CLOSED)
        closures = [c for c, off in zip(closures, missed, strict=True) if off]
        counts["closures_kept"] = len(closures)
    if robots is not None:
        steps = robots.associated_again(steps, estimate, config.robust, config)
    if config.odometry.calibrate:
        estimate = solve(steps, estimate, closures)
        closed = with_closures(steps, closures)

        def rebuild(estimate: Estimate, _last: bool) -> tuple[Step, ...]:
            made = recompute_motions(closed, tracks, estimate)
            return scale_motion_noise(made, noise_scales(made, estimate))

        solved: list[CalibratedSolution] = []  # the last one

        def keep(solution: CalibratedSolution, _made: Sequence[Step]) -> None:
            solved[:] = [solution]

        estimate, _ = calibrate(
            rebuild,
            estimate,
            tracks,
            config.robust,
            1,
            rough=len(tracks) == 1,
            solved_once=keep,
        )
        noise = fit_motion_noise(tracks, [solved[0].graph.posterior()])
        if len(tracks) > 1:
            # the world lies where the mount of the first robot puts it: a mount that this drive
            # does not tell would move the others away from where they started
            for track in tracks.values():
                track.hold_mount_unless(MOUNT_SIGMAS)
            closed = with_sensor_starts(closed, tracks, frames)
        rounds = ROUNDS - (len(tracks) == 1)
        estimate, steps = calibrate(
            rebuild,
            estimate,
            tracks,
            config.robust,
            rounds,
            joint=True,
            solved_once=keep,
            bias_m=config.front_end.floor_normal_m,
        )
        noise = replace(noise, lines=solved[0].graph.line_noise)
        add_mount_bias(estimate, tracks)
    else:
        estimate = solve(steps, estimate, closures, rough=False, joint=True)
        steps = with_closures(steps, closures)
    landmarks.update_from(steps, estimate)
    return estimate, steps, counts, noise


def add_mount_bias(estimate: Estimate, tracks: Mapping[str, Track]) -> None:
    """Tracks get the part of their mounts' covariances that biases of surfaces have."""
    mounts = estimate.mounts
    if mounts is None or estimate.root is None:
        return
    errors = mount_errors(estimate.root, mounts)
    for name, track in tracks.items():
        if name in mounts.robots:
            own = errors[mounts.columns(name)]
            track.add_mount_cov(own @ own.T)  # of further lasers too: they see the same walls


def with_sensor_starts(
    steps: Sequence[Step],
    tracks: Mapping[str, Track],
    frames: Mapping[str, str] | None,
) -> tuple[Step, ...]:
    """Steps in which starts that were told of bases are those of the sensors on them.

    Several starts at a distance from each other tell the direction of the world much better than
    the heading of any of them does, if they are not taken for as uncertain as the sensors' mounts
    are before a drive has told of them.

    Args:
        steps: of all robots.
        tracks: with their mounts as they are now known, or held. A held one adds nothing: the
            path of the base begins where it was told, wherever on it the sensor sits.
        frames: see `reoptimise_scan_log`.
    """
    told = {
        robot: (start.pose, start.base_cov)
        for step in steps
        for robot, start in step.starts.items()
        if start.base_cov is not None and robot in tracks
    }
    if not told or frames is None or not {frames[robot] for robot in told} <= set(told):
        return tuple(steps)
    placed = {}
    for robot, (base, cov) in told.items():
        first = frames[robot]
        # where the mount of the first robot puts the world, see `FrameTransforms`
        shift = origin_shift(told[first][0], tracks[first].mount)
        pose = compose(inverse(shift), compose(base, tracks[robot].mount))
        placed[robot] = Start(pose, cov + rotate_cov(tracks[robot].mount_cov, pose[2]))
    return tuple(
        replace(step, starts={r: placed.get(r, s) for r, s in step.starts.items()})
        if step.starts
        else step
        for step in steps
    )


class Solver:
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
        joint: bool = False,
    ) -> Estimate:
        """The estimate; the graph stays as long as steps are the same and go on from the last."""
        if self._solved is None or self._solved[0] is not steps or self._solved[1] is not start:
            self.backend = Reoptimiser(self._config, steps, start)
        estimate = self.backend.solve(closures, rough=rough, joint=joint)
        self._solved = steps, estimate
        return estimate


def _close_loops(
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

    Returns:
        Steps, the closures that are used, and the estimate with them.
    """
    split = split_by_visit(steps, estimate.states, landmarks, config.loop_closure.revisit_path_m)
    closed = split.start(estimate)
    prior = solve(split.steps, closed)
    submaps = build_submaps(prior.states, keyframe_scans, config)  # bent by no wrong association
    accepted: dict[Pair, Closure] = {}
    correcting: set[Pair] = set()  # those of them that correct the estimate
    refused: dict[Pair, Closure] = {}
    examined: dict[Pair, Array] = {}
    with PairVerifier(submaps) as verify:
        for _ in range(MAX_CLOSING_ROUNDS if submaps else 0):
            P = solve.backend.state_covariance([submap.state for submap in submaps])
            new, confirming = loop_closures(
                with_poses_from(submaps, closed.states), P, examined, config.loop_closure, verify
            )
            if tamper is not None:
                new = [c for c in tamper([*new, *confirming], submaps) if c not in confirming]
            # what was inconsistent before may be consistent now
            proposed = refused | {c.pair: c for c in new}
            consistent = consistent_closures(
                [*proposed.values(), *confirming], with_poses_from(submaps, prior.states), P
            )
            refused = {pair: c for pair, c in proposed.items() if c not in consistent}
            added = {c.pair for c in consistent if c not in confirming}
            if not added:
                break
            correcting |= added
            accepted |= {c.pair: c for c in consistent}
            closed = prior = _tightened(split.steps, [*accepted.values()], closed, solve)
            off = violated([*accepted.values()], closed.states, MAX_RESIDUAL)
            taken_back = {pair for pair, is_off in zip(accepted, off, strict=True) if is_off}
            counts["closures_refused"] += len(taken_back & correcting)
            accepted = {pair: c for pair, c in accepted.items() if pair not in taken_back}
            correcting -= taken_back
    counts["closures_verified"] = len(correcting)
    counts["closures_refused"] += len(refused)
    if not correcting:
        return steps, [], estimate
    closures = [closure for pair, closure in accepted.items() if pair in correcting]
    return rejoin_visits(split, closed, landmarks, config.association), closures, closed


def _tightened(
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


def _with_observed_motion_noise(
    steps: tuple[Step, ...], estimate: Estimate, solve: Solver
) -> tuple[tuple[Step, ...], Estimate]:
    """Steps with motions as noisy as the log shows them, and the estimate from them.

    Motions with too small a covariance hide their own errors in the estimate, so their noise is
    estimated again until it no longer grows.
    """
    scaled, scales = steps, {robot: np.ones(3) for robot in estimate.states}
    for _ in range(MAX_NOISE_ROUNDS):
        before, scales = scales, scales | noise_scales(steps, estimate)
        scaled = scale_motion_noise(steps, scales)
        estimate = solve(scaled, estimate)
        if all(np.all(scale <= NOISE_GROWTH * before[robot]) for robot, scale in scales.items()):
            break
    return scaled, estimate


def with_closures(steps: Sequence[Step], closures: Iterable[Closure]) -> tuple[Step, ...]:
    """Steps that hold closures too, each in the last step of the time when both states are known.

    Robots may have steps at the same time.
    """
    last = {step.time_ns: n for n, step in enumerate(steps)}
    at: dict[int, tuple[Closure, ...]] = {}
    for closure in closures:
        n = last[max(closure.time_ns, closure.other_time_ns)]
        at[n] = (*at.get(n, ()), closure)
    return tuple(
        replace(step, closures=(*step.closures, *at[n])) if n in at else step
        for n, step in enumerate(steps)
    )
