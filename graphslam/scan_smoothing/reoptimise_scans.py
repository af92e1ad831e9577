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

from graphslam.core.config import AssociationConfig, Config
from graphslam.core.geometry import compose, inverse, rotate_cov
from graphslam.core.records import Closure, Estimate, KeyframeScan, Start, Step
from graphslam.estimation.batch_calibration import ROUNDS, calibrate, recompute_motions
from graphslam.estimation.calibration_graph import CalibratedSolution
from graphslam.estimation.joint_covariances import mount_errors
from graphslam.estimation.log_noise import LogNoise
from graphslam.estimation.motion_noise import (
    fit_motion_noise,
    noise_scales,
    scale_motion_noise,
    stated_robots,
)
from graphslam.mapping.composite_walls import split_composites
from graphslam.mapping.duplicate_landmarks import (
    find_duplicates,
    merged,
    seen_together,
)
from graphslam.mapping.landmark_map import LandmarkMap
from graphslam.mapping.loop_closure import ALREADY_CLOSED, Tamper, violated
from graphslam.mapping.reassociation import reassociate
from graphslam.mapping.robot_gating import RobotOffers
from graphslam.odometry.interpolation import origin_shift
from graphslam.odometry.preintegration import Track
from graphslam.scan_smoothing.solver import Solver
from graphslam.scan_smoothing.submap_closing import close_loops

#: factors on the gates of re-association (across, direction), round by round
GATE_FACTORS = ((1.0, 1.0), (1 / 2, 2 / 3), (1 / 2, 2 / 3))
#: times that the noise of motions is estimated, at most; it is settled when it grows by less than
MAX_NOISE_ROUNDS, NOISE_GROWTH = 4, 1.1
#: a mount of one of several robots is corrected if it is off by so many of its sigmas
MOUNT_SIGMAS = 4.0


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
    closures: list[Closure] = []
    if config.backend.close_loops:
        steps, closures, estimate = close_loops(
            steps, estimate, keyframe_scans, landmarks, solve, tamper, counts, config
        )
    steps, estimate = _with_merged_landmarks(
        steps, estimate, closures, landmarks, solve, counts, config.association
    )
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
        estimate, steps, noise = _calibrated(closed, estimate, tracks, config, frames)
    else:
        estimate = solve(steps, estimate, closures, rough=False, joint=True)
        steps, noise = with_closures(steps, closures), LogNoise()
    landmarks.update_from(steps, estimate)
    return estimate, steps, counts, noise


def _with_merged_landmarks(
    steps: tuple[Step, ...],
    estimate: Estimate,
    closures: Sequence[Closure],
    landmarks: LandmarkMap,
    solve: Solver,
    counts: Counter[str],
    association: AssociationConfig,
) -> tuple[tuple[Step, ...], Estimate]:
    """Steps in which landmarks that are one are merged and each observation is of the best one.

    Round after round, by narrower gates; arguments as of `reoptimise_scan_log`.
    """
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
    return steps, estimate


def _calibrated(
    closed: tuple[Step, ...],
    estimate: Estimate,
    tracks: Mapping[str, Track],
    config: Config,
    frames: Mapping[str, str] | None,
) -> tuple[Estimate, tuple[Step, ...], LogNoise]:
    """The final solution, with the calibrations as unknowns and the noise that the log shows.

    Args:
        closed: steps that hold their closures.
        estimate: of their states and landmarks.
        tracks: get their calibrations, and the covariances of these.
        config: settings.
        frames: see `reoptimise_scan_log`.
    """

    def rebuild(estimate: Estimate, _last: bool) -> tuple[Step, ...]:
        made = recompute_motions(closed, tracks, estimate)
        return scale_motion_noise(made, noise_scales(made, estimate))

    solved: list[CalibratedSolution] = []  # the last one

    def keep(solution: CalibratedSolution, _made: Sequence[Step]) -> None:
        solved[:] = [solution]

    alone = len(tracks) == 1
    estimate, _ = calibrate(
        rebuild, estimate, tracks, config.robust, 1, rough=alone, solved_once=keep
    )
    noise = fit_motion_noise(tracks, [solved[0].graph.posterior(stated_robots(tracks))])
    if not alone:
        # the world lies where the mount of the first robot puts it: a mount that this drive
        # does not tell would move the others away from where they started
        for track in tracks.values():
            track.hold_mount_unless(MOUNT_SIGMAS)
        closed = with_sensor_starts(closed, tracks, frames)
    estimate, steps = calibrate(
        rebuild,
        estimate,
        tracks,
        config.robust,
        ROUNDS - alone,
        joint=True,
        solved_once=keep,
        bias_m=config.front_end.floor_normal_m,
    )
    noise = replace(noise, lines=solved[0].graph.line_noise)
    add_mount_bias(estimate, tracks)
    return estimate, steps, noise


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
