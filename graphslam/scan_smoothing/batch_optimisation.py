"""A tracked log of scans solved as one batch: calibration, loops, landmarks, all states at once.

Tracking gives a path that is right over metres. Loops are closed on a pose graph of submaps, and
the path follows its solution. There landmarks of different visits that lie together are tied; all
is solved, tied again where the covariances show that two are one, and solved to the end. By then
the map is known well enough to tell on which walls the returns are that are in no segment.
"""

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from graphslam.core.allocation import give_back_freed_memory
from graphslam.core.config import Config
from graphslam.core.geometry import Array
from graphslam.core.motion_models import Calibration
from graphslam.core.record import replace
from graphslam.core.records import Closure, Estimate, Start, Step
from graphslam.core.worker import Future
from graphslam.estimation.batch_calibration import recompute_motions
from graphslam.estimation.calibration_graph import (
    CONVERGED_ERROR,
    CalibratedSolution,
    CalibrationGraph,
)
from graphslam.estimation.log_noise import LogNoise
from graphslam.estimation.motion_arrays import at_calibration
from graphslam.estimation.motion_noise import (
    fit_motion_noise,
    middle_of_paths,
    noise_scales,
    scale_motion_noise,
    stated_robots,
)
from graphslam.estimation.optimisation import CONVERGED_ERROR_ROUGH
from graphslam.estimation.posterior_residuals import Posterior
from graphslam.estimation.settled import moved_to, settled
from graphslam.mapping.composite_walls import split_composites
from graphslam.mapping.doubled_walls import displacements
from graphslam.mapping.duplicate_landmarks import (
    find_duplicates,
    merged,
    seen_together,
)
from graphslam.mapping.landmark_map import mean_landmarks
from graphslam.mapping.loop_closure import Tamper, fix_position
from graphslam.mapping.loose_returns import with_loose_returns
from graphslam.mapping.moved_walls import part_moved
from graphslam.mapping.pushed_things import LEAST_ALIKE, part_pushed
from graphslam.mapping.reassociation import reassociate
from graphslam.mapping.redundant_closures import closures_not_in_landmarks
from graphslam.mapping.visits import tie_visits
from graphslam.odometry.preintegration import Track
from graphslam.pipeline.log_pass import timed
from graphslam.pipeline.scan_evidence import find_parked
from graphslam.scan_smoothing.path_closing import ClosedPaths, close_paths
from graphslam.scan_smoothing.placement_doubts import doubt_again
from graphslam.scan_smoothing.reoptimise_scans import add_mount_bias, with_closures
from graphslam.scan_smoothing.scan_refinement import refine_motions
from graphslam.scan_smoothing.scan_tracking import TrackedLog

#: factors on the gates of re-association (across, direction): with the closed paths, and solved
CLOSED_FACTORS, SOLVED_FACTORS = (1.0, 1.0), (1 / 2, 2 / 3)
#: times that the noise of odometry is looked for, each by the one found before
NOISE_ROUNDS = 2
#: states by which it is, about
NOISE_STATES = 800
#: times that things that were pushed alike are looked for: between more visits pushed again
PUSHED_ROUNDS = 3
#: times that visits are displaced: those after a displaced one may be as well
DISPLACED_ROUNDS = 2
#: peak memory from which on what closing loops has freed is half of what a process holds
LARGE_MB = 400.0


def optimise_scan_log(
    scan_log: TrackedLog, tamper: Tamper | None = None, closed: ClosedPaths | None = None
) -> Estimate:
    """The final estimate of a log; its steps, landmarks, calibration and counts follow it.

    It is `settled` where `backend.optimise_at_end` asks for that. ``closed``: the paths, if their
    loops are closed already, as those in a known map are.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    config, counts, seconds = scan_log.config, scan_log.counts, scan_log.seconds
    tracks = {name: run.track for name, run in scan_log.started.items()}
    steps: tuple[Step, ...] = tuple(scan_log.steps)
    with timed(seconds, "loop closure"):
        paths = closed or close_paths(scan_log, tamper, match=config.backend.close_loops)
    # of submaps: small pieces, between which the solutions find no room
    give_back_freed_memory(LARGE_MB)
    fixing = sum(fix_position(paths.closures))
    counts["closures_verified"] = fixing
    counts["closures_across"] = len(paths.closures) - fixing
    counts["closures_refused"] += len(paths.refused)
    placed = _visits_placed(scan_log)
    between = [a for a, b in paths.refused if a[0] != b[0] and {a[0], b[0]} & placed]
    counts["closures_refused_between"] += len(between)
    with timed(seconds, "final"):
        if scan_log.known.known_map is not None:
            counts["closures_to_map"] = paths.to_map
        estimate, steps = _solved(steps, paths, scan_log, tracks)
    scan_log.steps = list(steps)
    return estimate


def _visits_placed(scan_log: TrackedLog) -> set[str]:
    """Visits that were placed by what they have in common, and not where somebody told.

    What else would fit was judged then, place by place.
    """
    told = scan_log.given_config.start
    if scan_log.known.known_map is not None:  # there what was told is only a hint
        return set(scan_log.started)
    return set() if told.from_truth else scan_log.started.keys() - told.poses.keys()


def _start(steps: Sequence[Step], paths: ClosedPaths, scan_log: TrackedLog) -> Estimate:
    """Where landmarks are by what is seen from the paths, or by an earlier map."""
    marks, known_map = mean_landmarks(steps, paths.states), scan_log.known.known_map
    if known_map is not None:
        marks |= {n: (m, np.full((len(m),) * 2, np.nan)) for n, m in known_map.known.means.items()}
    return Estimate(paths.states, marks, 0.0, 0)


class _Problem:
    """All states, landmarks and, if it is wanted, the calibration of the tracks, in one graph.

    Motions are by the latest calibration, and as noisy as ``start`` shows them.
    """

    def __init__(
        self,
        steps: tuple[Step, ...],
        start: Estimate,
        tracks: Mapping[str, Track],
        config: Config,
    ) -> None:
        priors = {name: track.prior for name, track in tracks.items()}
        if not config.odometry.calibrate:
            priors = {name: prior.held() for name, prior in priors.items()}
        self._tracks, self._kernel = tracks, config.robust
        self._bias_m = config.front_end.floor_normal_m
        self._initial = {name: track.calibration for name, track in tracks.items()}
        self._steps = self._with_motions(steps, start)
        self._graph = CalibrationGraph(
            self._steps, start, priors, self._initial, config.robust, calibrated=True
        )

    def _with_motions(self, steps: tuple[Step, ...], start: Estimate) -> tuple[Step, ...]:
        for name, track in self._tracks.items():
            track.calibration = self._initial[name].held()
        made = recompute_motions(steps, self._tracks, start)
        return scale_motion_noise(made, noise_scales(made, start))

    def solutions(self) -> Iterator[Posterior]:
        """Solutions with covariances, by the noise that the tracks have as each is asked for.

        Lines are as noisy as they show themselves. With what the front end states, which is more in
        most buildings, odometry would come out too exact: what both leave in residuals is known.
        ``start`` has to be a solution.
        """
        graph = self._graph
        graph.weigh_lines()
        for k in range(NOISE_ROUNDS):
            if k:
                steps = self._with_motions(self._steps, graph.solution()[0])
                graph.calibrate_motions(steps, self._initial)
            graph.optimise(CONVERGED_ERROR_ROUGH)
            yield graph.posterior(stated_robots(self._tracks))

    def solve_roughly(self) -> CalibratedSolution:
        """Without covariances, and ended early."""
        self._graph.optimise(CONVERGED_ERROR_ROUGH)
        return self._found(*self._graph.solution())

    def solve(
        self, *, settle: bool
    ) -> tuple[tuple[Step, ...], CalibratedSolution, Future[Estimate] | None]:
        """The steps as they are solved, the solution, and if wanted the exact minimum of the steps.

        Covariances are by the noise of lines that their residuals show, and the biases of surfaces.
        The minimum, without covariances, is sought in the second process meanwhile.
        """
        self._graph.optimise(CONVERGED_ERROR)
        near, calibrations = self._graph.solution()
        steps = at_calibration(self._steps, self._initial, calibrations)
        minimum = Future(lambda: settled(steps, near, self._kernel)) if settle else None
        found = self._graph.solution(marginals=True, joint=True, mounts=True, bias_m=self._bias_m)
        return steps, self._found(*found), minimum

    def _found(
        self, estimate: Estimate, calibrations: Mapping[str, Calibration]
    ) -> CalibratedSolution:
        for name, track in self._tracks.items():
            track.calibration = calibrations[name]
        return CalibratedSolution(estimate, calibrations, self._graph)


def _motion_noise(
    steps: Sequence[Step], solved: Estimate, tracks: Mapping[str, Track], config: Config
) -> LogNoise:
    """The noise of odometry, by the middle of a solved log; tracks get it, nothing else."""
    before = {name: track.calibration for name, track in tracks.items()}
    problem = _Problem(*middle_of_paths(steps, solved, NOISE_STATES), tracks, config)
    noise = fit_motion_noise(tracks, problem.solutions())
    for name, track in tracks.items():
        track.calibration = before[name]
    return noise


def _solved(
    steps: tuple[Step, ...],
    paths: ClosedPaths,
    scan_log: TrackedLog,
    tracks: Mapping[str, Track],
) -> tuple[Estimate, tuple[Step, ...]]:
    """All states, landmarks and the calibration, solved with landmarks tied and reassociated."""
    config, counts, landmarks = scan_log.config, scan_log.counts, scan_log.landmarks
    steps, rough, paths = _laid_on_walls(steps, paths, scan_log, tracks)
    closures = list(paths.closures)
    closed = with_closures(steps, closures)
    # all that follows needs nothing but this solution; the second process looks for the noise
    asked = (
        Future(lambda: _motion_noise(closed, rough.estimate, tracks, config))
        if config.odometry.calibrate
        else None
    )
    steps = _tied(steps, rough.estimate, rough, paths, scan_log)
    found = rough.estimate
    steps, found, pushed = _without_pushed(steps, found, closures, paths, scan_log, tracks)
    steps, found, moved = part_moved(steps, found, landmarks, scan_log.steps[0].known)
    scan_log.moved = pushed | moved
    counts["landmarks_moved"] = len(scan_log.moved)
    steps, found = split_composites(steps, found, landmarks)
    # once landmarks of different visits are tied, most closures are no longer needed
    closures = closures_not_in_landmarks(closures, paths.spans, steps, landmarks)
    counts["closures_kept"] = len(closures)
    scan_log.parked = find_parked(scan_log)
    landmarks.update_from(steps, found)
    more = with_loose_returns(
        steps, found, scan_log.keyframe_scans, landmarks.entries, config.front_end
    )
    counts["observations_by_loose_returns"] = _count_observations(more) - _count_observations(steps)
    steps = more
    noise = LogNoise() if asked is None else asked.result()
    for name, own in noise.odometry.items():
        tracks[name].config = own
    steps, near = refine_motions(
        steps,
        found,
        scan_log.keyframe_scans,
        scan_log.log.without_odometry,
        config.scan_matching,
    )
    problem = _Problem(with_closures(steps, closures), near, tracks, config)
    steps, done, minimum = problem.solve(settle=config.backend.optimise_at_end)
    scan_log.noise = replace(noise, lines=done.graph.line_noise).to_summary()
    estimate = done.estimate
    add_mount_bias(estimate, tracks)
    for name in tracks:
        scan_log.runs[name].is_calibrated = config.odometry.calibrate
    if minimum:
        estimate = moved_to(minimum.result(), estimate)
    # the minimum may have turned the map as a whole: ends of walls are where they are seen there
    landmarks.update_from(steps, estimate)
    known_map = scan_log.known.known_map
    places = known_map.places if known_map is not None else ()
    scan_log.displacements = displacements(steps, estimate, landmarks, places)
    if paths.by:
        doubt_again(scan_log, estimate.states, paths.by)
    return estimate, steps


def _laid_on_walls(
    steps: tuple[Step, ...],
    paths: ClosedPaths,
    scan_log: TrackedLog,
    tracks: Mapping[str, Track],
) -> tuple[tuple[Step, ...], CalibratedSolution, ClosedPaths]:
    """Steps with landmarks tied, and their rough solution, in which walls of all visits are one.

    Visits whose walls of the building stand beside those that were seen before are displaced, and
    all is tied again, without the closures that laid them there. The paths are those that were
    solved.
    """
    landmarks = scan_log.landmarks
    is_compared = bool(landmarks.known) or len(paths.states) > 1
    untied = landmarks.copies() if is_compared else {}
    for left in reversed(range(1 + DISPLACED_ROUNDS * is_compared)):
        start = _start(steps, paths, scan_log)
        tied = _tied(steps, start, None, paths, scan_log)
        closed = with_closures(tied, paths.closures)
        rough = _Problem(closed, start, tracks, scan_log.config).solve_roughly()
        if not left:
            break
        landmarks.update_from(tied, rough.estimate)
        found = displacements(tied, rough.estimate, landmarks)
        by = {name: one.by for name, one in found.items() if one.is_clear}
        if not by:
            break
        scan_log.counts["visits_displaced"] += len(by)
        paths = paths.displaced(rough.estimate.states, by)
        steps = _with_displaced_starts(steps, by, scan_log)
        landmarks.return_to(untied)
    return tied, rough, paths


def _with_displaced_starts(
    steps: Sequence[Step], by: Mapping[str, Array], scan_log: TrackedLog
) -> tuple[Step, ...]:
    """Steps in which starts that were found, not told, are displaced ``by`` (2,) m as well."""
    placed = _visits_placed(scan_log)
    by = {name: off for name, off in by.items() if name in placed}

    def at(name: str, start: Start) -> Start:
        return replace(start, pose=start.pose + np.append(by[name], 0.0)) if name in by else start

    return tuple(
        replace(step, starts={name: at(name, start) for name, start in step.starts.items()})
        if step.starts
        else step
        for step in steps
    )


def _without_pushed(
    steps: tuple[Step, ...],
    found: Estimate,
    closures: Sequence[Closure],
    paths: ClosedPaths,
    scan_log: TrackedLog,
    tracks: Mapping[str, Track],
) -> tuple[tuple[Step, ...], Estimate, dict[int, int]]:
    """Solved again, roughly, as long as things were pushed alike between visits.

    ``found`` is of the steps. Returned are those in which such things are no ties, their estimate,
    and the new landmarks -> those that they were.
    """
    landmarks, moved = scan_log.landmarks, dict[int, int]()
    known = scan_log.steps[0].known
    for _ in range(PUSHED_ROUNDS):
        landmarks.update_from(steps, found)
        # once some were pushed, others were as well
        least = 1 if moved else LEAST_ALIKE
        steps, found, made = part_pushed(steps, found, landmarks, known, least)
        if not made:
            break
        moved |= made
        # those that landmarks still say are between the building too: matched by what was pushed
        kept = closures_not_in_landmarks(closures, paths.spans, steps, landmarks)
        problem = _Problem(with_closures(steps, kept), found, tracks, scan_log.config)
        found = problem.solve_roughly().estimate
    return steps, found, moved


def _count_observations(steps: tuple[Step, ...]) -> int:
    return sum(len(step.associations) for step in steps)


def _tied(
    steps: tuple[Step, ...],
    estimate: Estimate,
    solution: CalibratedSolution | None,
    paths: ClosedPaths,
    scan_log: TrackedLog,
) -> tuple[Step, ...]:
    """Steps with landmarks that are one tied, and observations at the walls that they fit best.

    ``estimate`` is that of the closed paths, or of a ``solution``. Only the latter has covariances,
    and its visits lie together, so that an observation may move from one visit's wall to another's.
    """
    config, counts, landmarks = scan_log.config, scan_log.counts, scan_log.landmarks
    landmarks.update_from(steps, estimate)
    apart = seen_together(steps) | landmarks.known_pairs
    into = landmarks.without_known(tie_visits(landmarks, paths.uncertainty(steps), apart))
    steps = merged(steps, into, landmarks)
    counts["landmarks_merged"] += len(into)
    if solution:
        apart = {frozenset(into.get(number, number) for number in pair) for pair in apart}
        known = [e for e in landmarks.entries.values() if e.id in estimate.landmarks]
        into = landmarks.without_known(find_duplicates(known, apart, solution.joint))
        steps = merged(steps, into, landmarks)
        counts["landmarks_merged"] += len(into)
    factor_m, factor_rad = SOLVED_FACTORS if solution else CLOSED_FACTORS
    again = reassociate(
        steps,
        estimate,
        landmarks.entries,
        factor_m * config.association.reassociation_gate_m,
        factor_rad * config.association.reassociation_gate_rad,
        config.association.overlap_gap_m,
        math.inf if solution else config.loop_closure.revisit_path_m,
    )
    counts["observations_reassociated"] += again.moved
    counts["observations_dropped"] += again.dropped
    return again.steps
