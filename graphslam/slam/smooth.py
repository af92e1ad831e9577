"""The main job: from a log to a `Result`."""

import time
from dataclasses import replace
from functools import partial

from graphslam.core.config import Config
from graphslam.core.errors import ConfigError, EstimationError
from graphslam.core.records import Result
from graphslam.logs import LogSet
from graphslam.mapping.known_map import KnownMap
from graphslam.mapping.loop_closure import Tamper
from graphslam.pipeline.checkpoint import NOTHING_KEPT, Checkpoint
from graphslam.pipeline.findings import FinishedPass
from graphslam.pipeline.log_kind import is_scan_log, is_session_log
from graphslam.pipeline.log_pass import PriorKnowledge, Progress
from graphslam.pipeline.robot_settings import check_robots
from graphslam.pipeline.smoothing_job import SmoothingJob
from graphslam.scan_smoothing.log_reader import Reading
from graphslam.slam.failures import impossible_odometry
from graphslam.slam.final_result import make_result
from graphslam.slam.initialisation import initialise
from graphslam.slam.passes import run_passes
from graphslam.slam.pose_graph import is_pose_graph, solve_pose_graph
from graphslam.slam.sighting_passes import run_sighting_passes, solves_at_once
from graphslam.slam.starts_in_map import starts_in_map


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
        tamper: for tests, see `graphslam.mapping.loop_closure.Tamper`.
        ahead: what `graphslam.scan_smoothing.log_reader.read_ahead` gives, if anything.
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
    if known_map is not None:
        _check_localisable(log, config, known_map)
    job = SmoothingJob(log, config, progress, tamper, kept)
    try:
        result = kept.stage("result", partial(_solved, job, known_map, ahead, began))
    except EstimationError as error:
        if found := impossible_odometry(log, config):
            raise EstimationError(f"{error}; {'; '.join(found)}") from error
        raise
    summary = {**result.summary, "resumed": kept.resumed}
    return replace(result, summary=summary)


def _check_localisable(log: LogSet, config: Config, known_map: KnownMap) -> None:
    """Raise a ConfigError if logs like this one are not localised in a map like this one."""
    is_of_scans = is_scan_log(log, config)
    is_batch = solves_at_once(log, config)
    if config.backend.causal or not (is_of_scans or is_batch):
        raise ConfigError(
            "known_map.directory: only scans of one robot, or sightings with names, by back end "
            "batch and without --causal, are localised in a known map"
        )
    if is_of_scans and not known_map.places:
        raise ConfigError(
            f"known_map.directory: the map {known_map.name} is of a log without scans, in which "
            "scans are not localised"
        )


def _starts(log: LogSet, config: Config, known_map: KnownMap | None) -> PriorKnowledge:
    if known_map is not None and not is_scan_log(log, config):
        return starts_in_map(log, config, known_map)
    return initialise(log, config)


def _solved(
    job: SmoothingJob, known_map: KnownMap | None, ahead: Reading | None, began: float
) -> Result:
    """The result by the way that is for logs of this kind; arguments as of `smooth`."""
    log, config = job.log, job.config
    if is_pose_graph(log, config):
        return make_result(solve_pose_graph(job), began)
    # what only logs of scans need is imported for these
    if is_session_log(log, config):
        from graphslam.scan_smoothing.session_log import solve_session_log  # noqa: PLC0415

        return make_result(solve_session_log(job), began)
    known = job.kept.stage("starts", partial(_starts, log, config, known_map))
    known = replace(known, known_map=known_map)
    initialised = time.perf_counter()
    if is_scan_log(log, config):
        from graphslam.scan_smoothing.scan_log import solve_scan_log  # noqa: PLC0415

        finished: FinishedPass | None = solve_scan_log(job, known, ahead)
    else:
        finished = run_sighting_passes(job, known)
    finished = finished or run_passes(job, known)
    finished.pipeline.seconds["starts"] = initialised - began
    return make_result(finished, began)
