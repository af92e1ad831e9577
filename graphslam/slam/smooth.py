"""The main job: from a log to a `Result`."""

import time
from dataclasses import replace
from functools import partial

import numpy as np

from graphslam.core.config import Config
from graphslam.core.errors import ConfigError
from graphslam.core.records import Result, RobotResult
from graphslam.core.worker import Future, parallel_map
from graphslam.estimation.g2o import graph_error
from graphslam.estimation.settled import settled
from graphslam.logs import LogSet
from graphslam.mapping.known_map import KnownMap
from graphslam.mapping.landmark_records import make_landmarks
from graphslam.mapping.loop_closure import Tamper
from graphslam.odometry.mount_covariance import with_mount_errors
from graphslam.slam.checkpoint import NOTHING_KEPT, Checkpoint
from graphslam.slam.evidence import gather
from graphslam.slam.initialisation import initialise
from graphslam.slam.log_pass import Progress, timed
from graphslam.slam.log_reader import Reading, is_scan_log, is_session_log
from graphslam.slam.passes import FinishedPass, run_passes
from graphslam.slam.pose_graph import is_pose_graph, solve_pose_graph
from graphslam.slam.retirement import retired_landmarks
from graphslam.slam.robot_settings import check_robots
from graphslam.slam.scan_log import solve_scan_log
from graphslam.slam.scans_between import walls_of_frames
from graphslam.slam.session_log import solve_session_log
from graphslam.slam.sighting_passes import run_sighting_passes
from graphslam.slam.summary import summarise
from graphslam.slam.verdict import judge

#: scans that a result keeps for pictures, at most
MAX_PICTURES = 4000


def smooth(
    log: LogSet,
    config: Config,
    progress: Progress = lambda _count: None,
    tamper: Tamper | None = None,
    ahead: Reading | None = None,
    kept: Checkpoint = NOTHING_KEPT,
    known_map: KnownMap | None = None,
) -> Result:
    """Estimate trajectories, landmarks and calibration from a log: the main function.

    Args:
        log: opened logs.
        config: settings.
        progress: called with the number of messages read so far.
        tamper: for tests, see `graphslam.slam.reoptimise_scans.Tamper`.
        ahead: what `graphslam.slam.log_reader.open_ahead` gives after the log.
        kept: where stages are kept, and those of an earlier run.
        known_map: of an earlier result, in which the log is localised.

    Raises:
        LogError: no message of the log could be used.
        ConfigError: a setting is about a robot that is not in the log, or logs like this one
            cannot be localised in a known map.
        EstimationError: the estimate is indeterminate, or a robot's start is unknown.
    """
    began = time.perf_counter()
    check_robots(log, config)
    if known_map is not None and not (is_scan_log(log, config) and not config.backend.causal):
        raise ConfigError(
            "known_map.directory: only scans of one robot, by back end batch and without --causal, "
            "are localised in a known map"
        )
    solve = partial(_solved, log, config, progress, tamper, ahead, kept, began, known_map)
    result = kept.stage("result", solve)
    summary = {**result.summary, "resumed": kept.resumed}
    return replace(result, summary=summary)


def _solved(
    log: LogSet,
    config: Config,
    progress: Progress,
    tamper: Tamper | None,
    ahead: Reading | None,
    kept: Checkpoint,
    began: float,
    known_map: KnownMap | None,
) -> Result:
    """The result by the way that is for logs of this kind; arguments as of `smooth`."""
    if is_pose_graph(log, config):
        return make_result(solve_pose_graph(log, config, progress), began)
    if is_session_log(log, config):
        return make_result(solve_session_log(log, config, progress, tamper, kept), began)
    known = kept.stage("starts", lambda: initialise(log, config))
    known = replace(known, known_map=known_map)
    initialised = time.perf_counter()
    if is_scan_log(log, config):
        finished: FinishedPass | None = solve_scan_log(
            log, config, known, progress, tamper, ahead, kept
        )
    else:
        finished = run_sighting_passes(log, config, known, progress, kept)
    finished = finished or run_passes(log, config, known, progress, tamper, kept)
    finished.pipeline.seconds["starts"] = initialised - began
    return make_result(finished, began)


def is_settled(config: Config) -> bool:
    """Whether the estimate is a minimum: that of the batch, not of a filter or of a window."""
    backend = config.backend
    return backend.name == "batch" and backend.optimise_at_end and backend.reoptimise


def make_result(finished: FinishedPass, began: float) -> Result:
    """Everything in the robots' own frames, as one record.

    Args:
        finished: the last pass.
        began: when the job began (`time.perf_counter`).
    """
    pipeline, causal = finished.pipeline, finished.findings.causal
    runs = pipeline.started
    with timed(pipeline.seconds, "trajectories"):
        causal_only = bool(causal) and all(
            run.is_causal(finished.estimate.states[name]) for name, run in runs.items()
        )
        transforms = pipeline.transforms()
        estimate = transforms.estimate(finished.estimate)
        steps = tuple(map(transforms.step, pipeline.steps))
        moved = pipeline.landmarks.transformed(transforms.landmarks)
        if is_settled(pipeline.config) and not finished.is_settled:
            estimate = settled(steps, estimate, pipeline.kernel)
            moved.update_from(steps, estimate)
        errors = Future(partial(graph_error, steps, estimate, pipeline.kernel))
        frames = pipeline.frames.landmark_frames(pipeline.landmarks.entries.values())
        # the starts of robots place their worlds, unless a known map does
        if estimate.mounts is not None and pipeline.known.known_map is None:
            estimate = with_mount_errors(
                estimate,
                pipeline.frames.of,
                frames,
                {name: start.pose for name, start in pipeline.starts.items()},
                {name: run.track.mount for name, run in runs.items()},
            )

        walls = walls_of_frames(moved, estimate, frames)

        def robot_result(name: str) -> RobotResult:
            run, states, mounts = runs[name], estimate.states[name], estimate.mounts
            mount = None if mounts is None else mounts.of(name)
            own = walls.get(pipeline.frames.of[name])
            better = run.between.matched_to(own, pipeline.config.front_end)
            return run.result(
                states, causal.get(name), mount, causal_only=causal_only, better=better
            )

        robots = dict(zip(runs, parallel_map(robot_result, list(runs)), strict=True))
        error, plain = errors.result()
        estimate = replace(estimate, error=error)
    landmarks = pipeline.frames.label_landmarks(
        make_landmarks(moved, estimate), pipeline.landmarks.entries.values()
    )
    retired = retired_landmarks(pipeline, landmarks, estimate)
    landmarks = tuple(mark for mark in landmarks if mark.id not in retired)
    t0 = min(trajectory.stamps_ns[0] for trajectory in estimate.states.values())
    innovations = {
        model: np.array([((t - t0) * 1e-9, d2) for t, d2 in values]).reshape(-1, 2)
        for model, values in sorted(pipeline.innovations.items())
    }
    if finished.causal_later is not None:  # the second process was still at them
        own = finished.causal_later()
        robots = {
            name: replace(robot, causal=own[name].base, scan_causal=own[name].scan)
            for name, robot in robots.items()
        }
    pipeline.seconds["all"] = time.perf_counter() - began
    summary = summarise(pipeline, estimate, plain, len(landmarks), finished.findings.clocks)
    if "known_map" in summary:
        summary["known_map"]["retired"] = list(retired.values())
    evidence = gather(pipeline, robots, steps, estimate, innovations, summary)
    summary["verdict"] = judge(evidence)
    return Result(
        robots,
        landmarks,
        estimate,
        steps,
        tuple(pipeline.keyframe_scans[:: 1 + len(pipeline.keyframe_scans) // MAX_PICTURES]),
        innovations,
        np.array(pipeline.step_ms),
        summary,
        pipeline.given_config,
    )
