"""A tracked log of scans solved as one batch: calibration, loops, landmarks, all states at once.

Tracking gives a path that is right over metres. Loops are closed on a pose graph of submaps, the
path follows its solution, and that is the start of the full solution: with landmarks of every visit
of their own at first, then with those tied that lie together.
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from graphslam.core.config import Config
from graphslam.core.records import Estimate, Step
from graphslam.estimation.batch_calibration import recompute_motions
from graphslam.estimation.calibration_graph import CalibratedSolution, solve_calibrated
from graphslam.mapping.duplicate_landmarks import (
    duplicates,
    merge_entries,
    merge_targets,
    merged_steps,
    possible_duplicates,
    seen_together,
)
from graphslam.mapping.landmark_map import LandmarkMap, first_estimates
from graphslam.mapping.loop_closure import ALREADY_CLOSED, fix_position, violated
from graphslam.mapping.reassociation import reassociate
from graphslam.mapping.redundant_closures import untied_closures
from graphslam.mapping.sequential_closing import Tamper
from graphslam.mapping.visits import tie_visits
from graphslam.odometry.preintegration import Track
from graphslam.slam.log_pass import timed
from graphslam.slam.motion_noise import noise_scales, scale_motion_noise
from graphslam.slam.path_closing import ClosedPaths, close_paths
from graphslam.slam.reoptimise_scans import with_closures
from graphslam.slam.scan_tracking import ScanLog

#: factors on the gates of re-association (across, direction), round by round
GATE_FACTORS = ((1.0, 1.0), (1 / 2, 2 / 3))


def optimise_scan_log(scan_log: ScanLog, tamper: Tamper | None = None) -> Estimate:
    """The final estimate of a log; its steps, landmarks, calibration and counts follow it.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    config, counts, seconds = scan_log.config, scan_log.counts, scan_log.seconds
    tracks = {name: run.track for name, run in scan_log.started.items()}
    steps: tuple[Step, ...] = tuple(scan_log.steps)
    with timed(seconds, "loop closure"):
        paths = close_paths(scan_log, tamper, match=config.backend.close_loops)
    fixing = sum(fix_position(paths.closures))
    counts["closures_verified"] = fixing
    counts["closures_across"] = len(paths.closures) - fixing
    counts["closures_refused"] += paths.refused
    with timed(seconds, "final"):
        start = Estimate(paths.states, first_estimates(steps, paths.states), 0.0, 0)
        estimate, steps = _solved(steps, start, paths, scan_log, tracks)
    scan_log.steps = list(steps)
    return estimate


@dataclass(frozen=True, slots=True, eq=False)
class _Solved:
    """A solution, and the steps as they were solved."""

    steps: tuple[Step, ...]
    solution: CalibratedSolution


def _solve(
    steps: tuple[Step, ...],
    start: Estimate,
    tracks: Mapping[str, Track],
    config: Config,
    *,
    rough: bool,
) -> _Solved:
    """All states, landmarks and, if it is wanted, the calibration of the tracks solved together.

    Motions are by the latest calibration, and as noisy as ``start`` shows them.
    """
    priors = {name: track.prior for name, track in tracks.items()}
    if not config.odometry.calibrate:
        priors = {name: prior.held() for name, prior in priors.items()}
    initial = {name: track.calibration for name, track in tracks.items()}
    for track in tracks.values():
        track.calibration = track.calibration.held()
    made = recompute_motions(steps, tracks)
    made = scale_motion_noise(made, noise_scales(made, start))
    solution = solve_calibrated(made, start, priors, initial, config.robust, rough=rough)
    for name, track in tracks.items():
        track.calibration = solution.calibrations[name]
    return _Solved(made, solution)


def _solved(
    steps: tuple[Step, ...],
    estimate: Estimate,
    paths: ClosedPaths,
    scan_log: ScanLog,
    tracks: Mapping[str, Track],
) -> tuple[Estimate, tuple[Step, ...]]:
    """All states, landmarks and the calibration, solved with landmarks tied and reassociated."""
    config, counts, landmarks = scan_log.config, scan_log.counts, scan_log.landmarks
    association, closures = config.association, list(paths.closures)
    for n, (factor_m, factor_rad) in enumerate(GATE_FACTORS):
        # once landmarks of different visits are tied, closures are no longer needed
        used = steps if n else with_closures(steps, closures)
        solution = _solve(used, estimate, tracks, config, rough=True).solution
        estimate = solution.estimate
        landmarks.update_from(steps, estimate)
        apart = seen_together(steps)
        into = tie_visits(landmarks, paths.uncertainty(steps), apart)
        steps = merged(steps, into, landmarks)
        apart = {frozenset(into.get(number, number) for number in pair) for pair in apart}
        also = find_duplicates(solution, landmarks, apart)
        steps = merged(steps, also, landmarks)
        counts["landmarks_merged"] += len(into) + len(also)
        again = reassociate(
            steps,
            estimate,
            landmarks.entries,
            factor_m * association.reassociation_gate_m,
            factor_rad * association.reassociation_gate_rad,
            association.overlap_gap_m,
            math.inf if n else config.loop_closure.revisit_path_m,
        )
        steps = again.steps
        counts["observations_reassociated"] += again.moved
        counts["observations_dropped"] += again.dropped
    missed = violated(closures, estimate.states, ALREADY_CLOSED)
    closures = [c for c, off in zip(closures, missed, strict=True) if off]
    closures = untied_closures(closures, paths.spans, steps, landmarks)
    counts["closures_kept"] = len(closures)
    done = _solve(with_closures(steps, closures), estimate, tracks, config, rough=False)
    estimate, steps = done.solution.estimate, done.steps
    landmarks.update_from(steps, estimate)
    for name in tracks:
        scan_log.runs[name].is_calibrated = config.odometry.calibrate
    return estimate, steps


def find_duplicates(
    solution: CalibratedSolution, landmarks: LandmarkMap, apart: Collection[frozenset[int]]
) -> dict[int, int]:
    """Landmark -> the one it is merged into, by the joint covariance; see `duplicates`."""
    known = [e for e in landmarks.entries.values() if e.id in solution.estimate.landmarks]
    known = possible_duplicates(known, apart)
    if not known:
        return {}
    return merge_targets(duplicates(known, solution.joint([e.id for e in known]), apart))


def merged(
    steps: tuple[Step, ...], into: Mapping[int, int], landmarks: LandmarkMap
) -> tuple[Step, ...]:
    """Steps with merged landmarks; the map follows."""
    if not into:
        return steps
    kinds = {number: landmarks.entries[number].kind for number in into.values()}
    merge_entries(landmarks, into)
    return merged_steps(steps, into, kinds)
