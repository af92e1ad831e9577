"""Passes over a log of named sightings, solved as a whole; see `sighting_pass`."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

from graphslam.core.config import Config
from graphslam.core.errors import LogError
from graphslam.core.worker import Future
from graphslam.estimation.clock_calibration import clocks_from_paths
from graphslam.estimation.settled import settled
from graphslam.logs import LogSet
from graphslam.pipeline.findings import Findings, FinishedPass
from graphslam.pipeline.log_pass import PriorKnowledge, timed
from graphslam.pipeline.robot_state import Causal
from graphslam.pipeline.smoothing_job import SmoothingJob
from graphslam.sighting_smoothing.causal_sightings import CausalReplay, replay_causally
from graphslam.sighting_smoothing.rough_solution import is_misfit
from graphslam.sighting_smoothing.sighting_pass import SightingPass, can_solve_at_once
from graphslam.sighting_smoothing.sighting_solution import (
    solve_finely,
    solve_roughly,
    solve_without_contradiction,
    with_gated_robots,
)
from graphslam.slam.initialisation import with_identities
from graphslam.slam.passes import decide_next_pass, find_clocks, find_swapped_names

#: ms that a sighting of a robot takes for the clocks: by the paths, and in the whole graph
PATH_CLOCK_MS, CLOCK_MS = 0.05, 0.09


def solves_at_once(log: LogSet, config: Config) -> bool:
    """Whether a log may be solved as a whole, if all that is sighted has a name."""
    settings = config.backend
    whole = settings.name == "batch" and settings.reoptimise and settings.optimise_at_end
    return whole and can_solve_at_once(log, config)


def run_sighting_passes(job: SmoothingJob, known: PriorKnowledge) -> FinishedPass | None:
    """`run_passes` without an incremental estimate; None for logs that need one.

    The causal trajectories are estimated in the second process.

    Raises:
        LogError: no message of the log could be used.
        EstimationError: the estimate is indeterminate, or a robot's start is unknown.
    """
    log, config = job.log, job.config
    if not solves_at_once(log, config):
        return None
    clock_passes = 0
    while True:
        one = SightingPass(log, config, known)
        job.kept.read_pass(one, partial(one.run, job.progress))
        if not one.all_named:
            return None
        if not one.steps:
            path = log.files[0].path
            raise LogError(f"{path}: nothing in it could be used; see `graphslam info`")
        _ = one.groups  # once for both processes
        in_map = known.known_map is not None
        replayed = Future(partial(replay_causally, one), urgent=False)  # waited for at the end
        with timed(one.seconds, "final optimisation"):
            rough, made = solve_roughly(one)
            if is_misfit(rough) and not known.identities and not in_map:
                # some sightings may be of something else
                swapped = find_swapped_names(one, solve_without_contradiction(one))
                if swapped:
                    replayed.cancel()
                    known = with_identities(known, log, config, swapped)
                    continue
            if is_misfit(rough) and len(one.tracks) == 1 and not in_map:
                # or odometry drifts too far for the rough solution, also for one that grows: with
                # every step added by itself the estimate mostly keeps near its minimum
                replayed.cancel()
                return None
            # all that is finer depends on the clocks; paths need the calibration
            seen = one.seen_robots
            asked = Future(
                partial(clocks_from_paths, seen, one.tracks, config),
                about_ms=PATH_CLOCK_MS * len(seen),
            )
            rough = with_gated_robots(one, rough, made)
            clocks = asked.result()
            if clocks and not known.clocks:
                replayed.cancel()
                known = replace(known, clocks=clocks)
                continue
            estimate, steps = solve_finely(one, rough)
            one.steps = list(steps)
            for run in one.started.values():
                run.is_calibrated = True
            # a log is seldom read again, so the result does not wait to know
            clocks_asked = Future(
                partial(find_clocks, one, estimate, coarsely=False), about_ms=CLOCK_MS * len(seen)
            )
            swapped = {} if in_map else find_swapped_names(one, estimate)
            estimate = settled(one.steps, estimate, one.kernel)
            found = clocks_asked.result()
        following = decide_next_pass(known, Findings(swapped, found, {}), log, config, clock_passes)
        if following is None:
            return FinishedPass(
                one,
                estimate,
                Findings(swapped, found, {}),
                is_settled=True,
                causal_later=partial(_causal, one, replayed),
            )
        replayed.cancel()
        clock_passes += following.clocks is not known.clocks
        known = following


def _causal(one: SightingPass, replayed: Future[CausalReplay]) -> Mapping[str, Causal]:
    """The causal trajectories of a pass; it gets the times of their steps."""
    with timed(one.seconds, "causal"):
        done = replayed.result()
    one.step_ms = done.step_ms.tolist()
    return done.trajectories
