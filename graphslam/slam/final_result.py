"""From a finished pass to the `Result`: all that was estimated, in the robots' own frames."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from graphslam.core.config import Config
from graphslam.core.geometry import Array
from graphslam.core.record import replace
from graphslam.core.records import Estimate, Result, RobotResult, Step
from graphslam.core.worker import Future, parallel_map
from graphslam.estimation.g2o import graph_error
from graphslam.estimation.settled import settled
from graphslam.mapping.landmark_map import LandmarkMap
from graphslam.mapping.landmark_records import make_landmarks
from graphslam.odometry.mount_covariance import with_mount_errors
from graphslam.pipeline.findings import FinishedPass
from graphslam.pipeline.log_pass import LogPass, timed
from graphslam.pipeline.path_evidence import MOST_SCANS, PathMisfits
from graphslam.pipeline.scan_evidence import misfits_along_walls
from graphslam.pipeline.scans_between import walls_of_frames
from graphslam.slam.retirement import retired_landmarks
from graphslam.slam.summary import summarise
from graphslam.verdict.evidence import gather
from graphslam.verdict.verdict import judge

#: ms that a factor of the graph takes for its error, a pose with its covariance for all results,
#: and a scan that is compared with another for what it says of the path
FACTOR_MS, POSE_MS, SCAN_MS = 0.004, 0.006, 0.2
#: scans that a result keeps for pictures, at most
MAX_PICTURES = 4000


def make_result(finished: FinishedPass, began: float) -> Result:
    """Everything in the robots' own frames, as one record.

    Args:
        finished: the last pass.
        began: when the job began (`time.perf_counter`).
    """
    pipeline = finished.pipeline
    with timed(pipeline.seconds, "trajectories"):
        final = _in_own_frames(finished)
        # in the second process, while the trajectories are made
        task = partial(_errors_and_misfits, pipeline, final)
        meanwhile = Future(task, about_ms=_about_ms(pipeline, final))
        final = _with_mount_errors(final, pipeline)
        robots = _robot_results(finished, final)
        error, plain, along_walls = meanwhile.result()
        estimate = replace(final.estimate, error=error)
    landmarks = pipeline.frames.label_landmarks(
        make_landmarks(final.landmarks, estimate), pipeline.landmarks.entries.values()
    )
    retired = retired_landmarks(pipeline, landmarks, estimate)
    landmarks = tuple(mark for mark in landmarks if mark.id not in retired)
    innovations = _innovations(pipeline, estimate)
    if finished.causal_later is not None:  # the second process was still at them
        causal = finished.causal_later()
        robots = {
            name: replace(robot, causal=causal[name].base, scan_causal=causal[name].scan)
            for name, robot in robots.items()
        }
    pipeline.seconds["all"] = time.perf_counter() - began
    summary = summarise(pipeline, estimate, plain, len(landmarks), finished.findings.clocks)
    if "known_map" in summary:
        summary["known_map"]["retired"] = list(retired.values())
    evidence = gather(pipeline, robots, final.steps, estimate, innovations, summary, along_walls)
    summary["verdict"] = judge(evidence)
    return Result(
        robots,
        landmarks,
        estimate,
        final.steps,
        tuple(pipeline.keyframe_scans[:: 1 + len(pipeline.keyframe_scans) // MAX_PICTURES]),
        innovations,
        np.array(pipeline.step_ms),
        summary,
        pipeline.given_config,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Final:
    """The estimate, its steps and its map in the robots' own frames.

    ``frames``: landmark -> the frame that it is in.
    """

    estimate: Estimate
    steps: tuple[Step, ...]
    landmarks: LandmarkMap
    frames: Mapping[int, str]


def _errors_and_misfits(
    pipeline: LogPass, final: _Final
) -> tuple[float, float, dict[str, PathMisfits]]:
    """The error of the graph with kernels and without, and how scans fit along robots' paths."""
    errors = graph_error(final.steps, final.estimate, pipeline.kernel)
    return *errors, misfits_along_walls(pipeline, final.estimate)


def _about_ms(pipeline: LogPass, final: _Final) -> float:
    """How long `_errors_and_misfits` takes."""
    factors = sum(len(step.motions) + len(step.associations) for step in final.steps)
    scans = min(len(pipeline.keyframe_scans), MOST_SCANS)
    return FACTOR_MS * factors + SCAN_MS * scans


def _in_own_frames(finished: FinishedPass) -> _Final:
    """The result of a pass there; if it is a batch's, at the exact minimum of its steps."""
    pipeline = finished.pipeline
    transforms = pipeline.transforms()
    estimate = transforms.estimate(finished.estimate)
    steps = tuple(map(transforms.step, pipeline.steps))
    landmarks = pipeline.landmarks.transformed(transforms.landmarks)
    if _is_batch(pipeline.config) and not finished.is_settled:
        estimate = settled(steps, estimate, pipeline.kernel)
        landmarks.update_from(steps, estimate)
    frames = pipeline.frames.landmark_frames(pipeline.landmarks.entries.values())
    return _Final(estimate, steps, landmarks, frames)


def _is_batch(config: Config) -> bool:
    """Whether the estimate is a minimum: that of the batch, not of a filter or of a window."""
    backend = config.backend
    return backend.name == "batch" and backend.optimise_at_end and backend.reoptimise


def _with_mount_errors(final: _Final, pipeline: LogPass) -> _Final:
    """The same with what mounts are off by: the starts of robots place their worlds by them.

    In a known map they do not.
    """
    if final.estimate.mounts is None or pipeline.known.known_map is not None:
        return final
    estimate = with_mount_errors(
        final.estimate,
        pipeline.frames.of,
        final.frames,
        {name: start.pose for name, start in pipeline.starts.items()},
        {name: run.track.mount for name, run in pipeline.started.items()},
    )
    return replace(final, estimate=estimate)


def _robot_results(finished: FinishedPass, final: _Final) -> dict[str, RobotResult]:
    """The trajectories of every robot; scans without a state are matched to the map."""
    pipeline, causal = finished.pipeline, finished.findings.causal
    runs, estimate = pipeline.started, final.estimate
    causal_only = bool(causal) and all(
        run.is_causal(finished.estimate.states[name]) for name, run in runs.items()
    )
    walls = {} if causal_only else walls_of_frames(final.landmarks, estimate, final.frames)

    def robot_result(name: str) -> RobotResult:
        run, mounts = runs[name], estimate.mounts
        mount = None if mounts is None else mounts.of(name)
        near = walls.get(pipeline.frames.of[name])
        better = run.between.matched_to(near, pipeline.config.front_end)
        return run.result(
            estimate.states[name], causal.get(name), mount, causal_only=causal_only, better=better
        )

    poses = [float(len(run.track)) for run in runs.values()]
    each = parallel_map(robot_result, list(runs), efforts=poses, unit_ms=POSE_MS)
    return dict(zip(runs, each, strict=True))


def _innovations(pipeline: LogPass, estimate: Estimate) -> dict[str, Array]:
    """Model -> (n, 2): seconds since the first state, and innovations squared."""
    first_ns = min(trajectory.stamps_ns[0] for trajectory in estimate.states.values())
    return {
        model: np.array([((t - first_ns) * 1e-9, d2) for t, d2 in values]).reshape(-1, 2)
        for model, values in sorted(pipeline.innovations.items())
    }
