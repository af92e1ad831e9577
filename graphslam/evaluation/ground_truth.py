"""Ground truth for an evaluation: from the logs of a run, other logs, or TUM files."""

import os
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.core.config import Config
from graphslam.core.errors import LogError, OutputError
from graphslam.core.records import Result, Trajectory, TrueLandmark, Truth
from graphslam.core.worker import Future
from graphslam.evaluation.metrics import evaluate
from graphslam.logs import GroundTruth, LogSet, is_recording, read_truth, truth_from_recordings
from graphslam.logs.sessions import open_recordings
from graphslam.logs.topics import find_topics
from graphslam.results.file_formats import read_trajectory
from graphslam.results.folder import SavedResult
from graphslam.verdict.verdict import with_truth

#: ms that a message of a log takes where the truth among them is read, at most if it is small
MESSAGE_MS = 0.003
_NO_TRUTH = "holds no true poses or landmarks; give"


def has_truth(log: LogSet) -> bool:
    """Whether opened logs have a topic of true poses or landmarks."""
    return any(topic.record in (Truth, TrueLandmark) for topic in log.topics)


def truth_of_logs(log: LogSet) -> GroundTruth:
    """The truth in opened logs; empty if there is none."""
    if not has_truth(log):
        return GroundTruth({}, ())  # without reading the logs again
    return truth_from_recordings(log.opened, log.config)


def truth_later(log: LogSet) -> Future[GroundTruth]:
    """`truth_of_logs`, from the second process if there is any."""
    about_ms = MESSAGE_MS * log.count() if has_truth(log) else 0.0
    return Future(partial(truth_of_logs, log), urgent=False, about_ms=about_ms)


def truth_of_run(result: Result | SavedResult) -> GroundTruth:
    """The truth in the logs that a result was made from.

    Raises:
        LogError: a log has moved or changed, or none holds any truth.
    """
    logs = result.summary["logs"]
    found = read_truth([Path(log["path"]) for log in logs], result.config)
    for log, sha256 in zip(logs, found.sha256, strict=True):
        if log["sha256"] != sha256:
            raise LogError(f"{log['path']}: is not the log that was smoothed; give --truth")
    if not found:
        paths = ", ".join(log["path"] for log in logs)
        raise LogError(f"{paths}: {_NO_TRUTH} --truth or --relations")
    return found


def truth_of_files(sources: Sequence[str], robots: Sequence[str], config: Config) -> GroundTruth:
    """Truth from recordings and TUM files (``FILE.tum``, ``ROBOT=FILE.tum``).

    Args:
        sources: files as given on the command line; what they hold is combined.
        robots: names of the result's robots; with only one, a TUM file needs no name.
        config: settings of the result; by those of ``logs`` robots and sessions have their names.

    Raises:
        LogError: a log cannot be read, or none of them holds any truth.
        OutputError: a TUM file cannot be read, or it is not clear of which robot it is.
    """
    recordings, trajectories = [], dict[str, Trajectory]()
    for source in sources:
        if source.endswith(".mcap") or is_recording(Path(source)):
            recordings.append(Path(source))
        else:
            robot, path = _robot_and_path(source, robots)
            trajectories[robot] = read_trajectory(path)
    if not recordings:
        return GroundTruth(trajectories, ())
    found = _truth_in(recordings, config)
    if not found:
        raise LogError(f"{', '.join(map(str, recordings))}: {_NO_TRUTH} a file that does")
    return replace(found, trajectories={**found.trajectories, **trajectories})


def _truth_in(recordings: Sequence[Path], config: Config) -> GroundTruth:
    """The truth in recordings, of robots that are named as ``config`` names those of a result."""
    logs = config.logs
    if logs.same_place and len(recordings) > 1:
        return read_truth(recordings, config)
    # a recording by itself is no session, but may hold the truth of several
    every = replace(config, logs=replace(logs, same_place=False, topics={}))
    files, every = open_recordings(recordings, every)
    # `logs.topics` is about the logs of the run: these may lack a topic, or have others
    names = {
        topic.name: logs.topics.get(topic.name, topic.robot)
        for topic in find_topics(files, every)
        if topic.record in (Truth, TrueLandmark)
    }
    return truth_from_recordings(files, replace(every, logs=replace(every.logs, topics=names)))


def truth_given(
    truth: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] | GroundTruth,
    robots: Sequence[str],
    config: Config,
) -> GroundTruth:
    """Truth as a caller gives it: already read, or one or several of `truth_of_files`.

    Raises:
        LogError, OutputError: see `truth_of_files`.
    """
    if isinstance(truth, GroundTruth):
        return truth
    sources = [truth] if isinstance(truth, str | os.PathLike) else truth
    return truth_of_files([os.fspath(source) for source in sources], robots, config)


def errors_of_run(result: Result, truth: GroundTruth) -> dict[str, Any] | None:
    """Errors against the truth in the logs, None without; a warning where it does not fit.

    The verdict of the run takes them in.
    """
    if not truth:
        return None
    try:
        errors = evaluate(result, truth.trajectories, truth.landmarks)
    except OutputError as error:
        # the truth is of another time: no reason to lose the run
        result.summary["warnings"].append(f"not evaluated: {error}")
        return None
    sigmas = {
        name: float(np.sqrt(np.nanmean(np.trace(robot.final.covs[:, :2, :2], axis1=1, axis2=2))))
        for name, robot in result.robots.items()
        if np.isfinite(robot.final.covs[:, 0, 0]).any()
    }
    verdict = result.summary["verdict"]
    verdict.update(with_truth(verdict, errors, sigmas))
    return errors


def _robot_and_path(source: str, robots: Sequence[str]) -> tuple[str, Path]:
    name, separator, path = source.partition("=")
    if separator and name in robots:
        return name, Path(path)
    if len(robots) == 1 and (not separator or Path(source).exists()):
        return robots[0], Path(source)
    raise OutputError(
        f"--truth {source}: of which robot is it? write ROBOT=FILE.tum, ROBOT one of "
        f"{', '.join(robots)}"
    )
