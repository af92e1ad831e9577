"""The main job: from a log to a `Result`.

Mostly one pass (`pipeline`), after which the log is solved again. More passes where one shows that
the next should begin with other starts, names or clocks.
"""

import time
from dataclasses import replace
from functools import partial

import numpy as np

from graphslam.core.config import Config, RobotConfig
from graphslam.core.errors import LogError
from graphslam.core.records import Estimate, Result, RobotResult
from graphslam.core.worker import Future, parallel_map
from graphslam.estimation.clock_calibration import ClockEstimate
from graphslam.logs import LogSet
from graphslam.slam.initialisation import initialise, with_names
from graphslam.slam.pipeline import Pipeline, Progress
from graphslam.slam.reoptimise_scans import Tamper
from graphslam.slam.robot_settings import check_robots, robot_settings
from graphslam.slam.robot_state import Causal, span_warnings
from graphslam.slam.summary import make_landmarks, summarise

#: scans in the picture at most
MAX_PICTURES = 4000
#: times that the log is taken again by better clocks
MAX_CLOCKS = 4


def smooth(
    log: LogSet,
    config: Config,
    progress: Progress = lambda _count: None,
    tamper: Tamper | None = None,
) -> Result:
    """Estimate everything that a log tells: the main job.

    Args:
        log: opened logs.
        config: settings.
        progress: called with the number of messages read so far.
        tamper: for tests, see `graphslam.slam.reoptimise_scans.Tamper`.

    Raises:
        LogError: no message of the log could be used.
        ConfigError: a setting is about a robot that is not in the log.
        EstimationError: the estimate is indeterminate, or a robot's start is unknown.
    """
    began = time.perf_counter()
    check_robots(log, config)
    known = initialise(log, config)
    starts_s = time.perf_counter() - began
    passes = 0
    while True:
        pipeline = run_pass(Pipeline(log, config, known, tamper), progress)
        finishing = time.perf_counter()
        estimate, rough = pipeline.estimate()
        finding = Future(partial(pass_findings, pipeline, estimate))
        # it is seldom read again, so solving again, where that is quick, does not wait to know
        meanwhile = rough and pipeline.is_refined and not finding.done
        final = pipeline.reoptimise(estimate) if meanwhile else estimate
        names, clocks, causal = finding.result()
        if names and not known.names:
            known = with_names(known, log, config, names)
        elif passes < MAX_CLOCKS and any(found.needs_correction for found in clocks.values()):
            passes += 1
            known = replace(known, clocks={robot: found.clock for robot, found in clocks.items()})
        else:
            break
    estimate = pipeline.reoptimise(estimate) if rough and not meanwhile else final
    pipeline.seconds["starts"] = starts_s
    pipeline.seconds["final optimisation"] = time.perf_counter() - finishing
    finishing = time.perf_counter()
    runs = {name: run for name, run in sorted(pipeline.runs.items()) if run.started}
    worlds, frames = pipeline.worlds(), pipeline.frames
    causal_only = all(run.is_causal(estimate.states[name]) for name, run in runs.items())
    estimate = worlds.estimate(estimate)
    steps = tuple(map(worlds.step, pipeline.steps))

    def told(name: str) -> RobotResult:
        return runs[name].result(estimate.states[name], causal[name], causal_only=causal_only)

    robots = dict(zip(runs, parallel_map(told, list(runs)), strict=True))
    pipeline.seconds["trajectories"] = time.perf_counter() - finishing
    entries = pipeline.associator.map
    landmarks = make_landmarks(entries.in_worlds(worlds.landmarks), estimate)
    landmarks = frames.label_landmarks(landmarks, entries.entries.values())
    t0 = min(trajectory.stamps_ns[0] for trajectory in estimate.states.values())
    innovations = {
        model: np.array([((t - t0) * 1e-9, d2) for t, d2 in values]).reshape(-1, 2)
        for model, values in sorted(pipeline.associator.innovations.items())
    }
    pipeline.seconds["all"] = time.perf_counter() - began
    summary = summarise(
        log=log,
        config=config,
        estimate=estimate,
        counts=pipeline.counts,
        rejected=pipeline.associator.rejected,
        dropped=pipeline.dropped + pipeline.watcher.counts,
        tentative_deleted=pipeline.associator.map.deleted,
        line_closures=pipeline.associator.closures,
        landmarks=len(landmarks),
        seconds=pipeline.seconds,
        calibration={name: run.calibration_found() for name, run in runs.items()},
        odometry={
            name: {
                "motions": run.motions,
                "contradicted": run.contradicted,
                "resets": run.track.resets,
            }
            for name, run in runs.items()
        },
        closures=known.recorded.to_summary(),
        joined=known.joined,
        clocks=clocks,
        warnings=run_warnings(pipeline),
        log_s=1e-9 * (pipeline.last_ns - pipeline.first_ns),
    )
    return Result(
        robots,
        landmarks,
        estimate,
        steps,
        tuple(pipeline.pictures[:: 1 + len(pipeline.pictures) // MAX_PICTURES]),
        innovations,
        np.array(pipeline.step_ms),
        summary,
        config,
    )


def pass_findings(
    pipeline: Pipeline, estimate: Estimate
) -> tuple[dict[str, str], dict[str, ClockEstimate], dict[str, Causal]]:
    """What follows from a pass and needs no better estimate.

    Names (false -> right) and clocks by which the log was to be read, and causal trajectories.
    """
    frames = pipeline.frames
    causal = {
        name: run.causal(
            pipeline.starts[frames.of[name]].pose, frames.away.get(frames.of[name], 0.0)
        )
        for name, run in sorted(pipeline.runs.items())
        if run.started
    }
    return pipeline.exchanged(estimate), pipeline.estimate_clocks(estimate), causal


def run_pass(pipeline: Pipeline, progress: Progress) -> Pipeline:
    """A pipeline after its log went by."""
    pipeline.run(progress)
    if not pipeline.steps:
        path = pipeline.log.files[0].path
        raise LogError(f"{path}: nothing in it could be used; see `graphslam info`")
    pipeline.note_covariances()
    return pipeline


def run_warnings(pipeline: Pipeline) -> list[str]:
    """What a user should know about a run although it went through."""
    known = pipeline.known
    warnings = [
        f"{name}: its odometry jumped {run.track.resets} times; taken to have gone on as before"
        for name, run in pipeline.runs.items()
        if run.track.resets
    ]
    warnings += [
        f"{name}: scans contradict its odometry in {run.contradicted} of {run.motions} motions; "
        "these were taken from the scans"
        for name, run in pipeline.runs.items()
        if run.contradicted
    ]
    warnings += [
        f"{name}: its wheel radii and axle are not set; the defaults of robots.{name}.* were used"
        for name, run in pipeline.runs.items()
        if run.track.source == "wheels"
        and replace(robot_settings(name, pipeline.config, pipeline.log.notes), outline=())
        == RobotConfig()
    ]
    warnings += [
        f"{a} and {b}: bore each other's code in all sightings; their names were exchanged back"
        for a, b in known.names.items()
        if a < b
    ]
    warnings += span_warnings(
        {name: run.track for name, run in pipeline.runs.items()},
        unplaced=pipeline.dropped["sighting: no odometry near it"] > 0,
    )
    warnings += [
        f"the back end could not use {count} x {reason}"
        for reason, count in sorted(pipeline.backend.skipped.items())
    ]
    warnings += [
        f"{robot}: {known.joined.undecided.get(robot, 'nothing says where it was')}; its poses "
        f"are in a frame of its own, which begins where it began; --start {robot}=x,y,phi places it"
        for robot, run in pipeline.runs.items()
        if run.started and robot == pipeline.frames.of[robot] != known.joined.world
    ]
    if known.recorded.refused:
        warnings.append(
            f"{len(known.recorded.refused)} recorded closures are not believed; closures.refused"
            " in summary.json lists them"
        )
    if not any(step.associations or step.closures for step in pipeline.steps):
        warnings.append("no observation entered the estimate: this is dead reckoning")
    return warnings
