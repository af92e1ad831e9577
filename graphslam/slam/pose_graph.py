"""Logs of relative poses only (g2o, iSAM, TORO files), solved at once.

There is nothing to associate in such a log. So it is not processed step by step: the log is read
once, recorded closures are judged, all states, motions and closures are made together, and one
graph is optimised from poses along its most accurate paths (`estimation.initial_estimate`).
"""

from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import Config
from graphslam.core.errors import LogError
from graphslam.core.records import (
    TRUE_RECORDS,
    Closure,
    Estimate,
    Motion,
    OdometryIncrement,
    RelativePose,
    Start,
    Step,
    TrueAssociations,
)
from graphslam.estimation.initial_estimate import initial_estimate
from graphslam.estimation.isam2 import Reoptimiser
from graphslam.estimation.replay import replay
from graphslam.logs import LogSet
from graphslam.odometry.given_increments import consecutive_motions
from graphslam.odometry.preintegration import Track
from graphslam.pipeline.findings import Findings, FinishedPass
from graphslam.pipeline.log_pass import PriorKnowledge, counted, timed
from graphslam.pipeline.pipeline import Pipeline
from graphslam.pipeline.recorded_closures import (
    accept_closures,
    closure_id,
    take_relative_poses,
)
from graphslam.pipeline.robot_settings import make_tracks
from graphslam.pipeline.robot_state import RobotState
from graphslam.pipeline.smoothing_job import SmoothingJob
from graphslam.pipeline.start_priors import start_poses
from graphslam.slam.initialisation import estimate_start_poses
from graphslam.slam.passes import pass_findings

#: keyframes' distances up to which poses between two states follow from these
BRIDGED_KEYFRAMES = 10


def is_pose_graph(log: LogSet, config: Config) -> bool:
    """Whether a log is only relative poses, and its solution is asked for, not a back end's way."""
    kinds = {topic.record for topic in log.topics} - {*TRUE_RECORDS, TrueAssociations}
    backend = config.backend
    at_once = backend.name == "batch" and backend.optimise_at_end and backend.reoptimise
    return at_once and kinds == {OdometryIncrement, RelativePose}


def solve_pose_graph(job: SmoothingJob) -> FinishedPass:
    """Solve a log of relative poses.

    Raises:
        LogError: no message of the log could be used.
        EstimationError: the estimate is indeterminate, or a given start pose is malformed.
    """
    log, config = job.log, job.config
    seconds: dict[str, float] = defaultdict(float)
    counts: Counter[str] = Counter()
    with timed(seconds, "read"):
        tracks = make_tracks(log, config)
        read = counted(log.messages(TRUE_RECORDS, prefetch=True), counts, job.progress)
        messages = take_relative_poses(read, tracks)
    with timed(seconds, "starts"):
        starts = start_poses(log, config)
        recorded = accept_closures(log, config, starts, messages, tracks)
        frames, _ = estimate_start_poses(log, config, {}, starts, recorded)
    pipeline = Pipeline(log, config, PriorKnowledge(frames, recorded))
    pipeline.seconds.update(seconds)
    pipeline.counts.update(counts)
    for robot, run in pipeline.runs.items():
        run.track = tracks[robot]
    with timed(pipeline.seconds, "motions"):
        steps = _make_steps(pipeline, messages)
    if not steps:
        raise LogError(f"{log.files[0].path}: nothing in it could be used; see `graphslam info`")
    with timed(pipeline.seconds, "final optimisation"):
        estimate, pipeline.steps = _solve(steps, config), steps
    if not config.backend.causal:
        return FinishedPass(pipeline, estimate, Findings({}, {}, {}))
    with timed(pipeline.seconds, "causal trajectories"):
        _record_causal(pipeline)
    return FinishedPass(pipeline, estimate, pass_findings(pipeline, estimate))


# ---------------------------------------------------------------- from messages to steps


def _make_steps(pipeline: Pipeline, messages: Iterable[RelativePose]) -> list[Step]:
    """Steps of the whole log; the times of the states are recorded in ``pipeline.runs``."""
    usable = [message for message in messages if _is_usable(message, pipeline)]
    ends: dict[str, set[int]] = defaultdict(set)
    for message in usable:
        ends[message.robot].add(message.time_ns)
        if _has_start(message, pipeline):
            ends[message.other].add(message.start_ns)
    starts: dict[int, dict[str, Start]] = defaultdict(dict)
    motions: dict[int, dict[str, Motion]] = defaultdict(dict)
    for robot, run in sorted(pipeline.runs.items()):
        if not len(run.track):
            continue
        run.times = _state_times(pipeline, run, sorted(ends[robot]))
        pipeline.counts["keyframes"] += len(run.times)
        for time_ns in (run.times[0], run.track.last_ns, *ends[robot]):
            pipeline.record_time(time_ns)
        start = pipeline.frames.offset_start(robot, pipeline.starts[robot])
        starts[run.times[0]][robot] = start
        moved = consecutive_motions(run.track, np.array(run.times, dtype=np.int64))
        for k, (begin_ns, end_ns) in enumerate(pairwise(run.times)):
            motions[end_ns][robot] = moved.one(k, begin_ns, end_ns)
    closures: dict[int, list[Closure]] = defaultdict(list)
    for message in usable:
        times = pipeline.runs[message.robot].times
        closure = pipeline.closure(message, times[bisect_right(times, message.time_ns) - 1])
        if closure is not None:
            closures[max(closure.time_ns, closure.other_time_ns)].append(closure)
    return [
        Step(t, starts.get(t, {}), motions.get(t, {}), (), tuple(closures.get(t, ())))
        for t in sorted({*starts, *motions})
    ]


def _is_usable(message: RelativePose, pipeline: Pipeline) -> bool:
    """Whether odometry covers the time of a relative pose; those left out are counted."""
    run = pipeline.runs.get(message.robot)
    max_gap_ns = round(1e9 * pipeline.config.odometry.max_gap_s)
    if run is None or not run.track.covers(message.time_ns, max_gap_ns):
        pipeline.dropped["relativepose: no odometry near it"] += 1
        return False
    if pipeline.frames.crosses_frames(message):
        pipeline.dropped["relativepose: between robots in separate frames"] += 1
        return False
    return True


def _has_start(message: RelativePose, pipeline: Pipeline) -> bool:
    """Whether the state where a relative pose starts is one that odometry can give.

    Without a state of its own the closure would begin at the last one before, carried there by
    odometry that the motions between states have in them already.
    """
    other = pipeline.runs.get(message.other)
    max_gap_ns = round(1e9 * pipeline.config.odometry.max_gap_s)
    if closure_id(message) in pipeline.known.recorded.refused or other is None:
        return False
    return other.track.covers(message.start_ns, max_gap_ns)


def _state_times(pipeline: Pipeline, run: RobotState, ends_ns: Sequence[int]) -> list[int]:
    """Times of a robot's states: of every message, or of closures a keyframe's motion apart.

    And of readings in between, see `_readings_between`.
    """
    first_ns = min([run.track.first_ns, *ends_ns[:1]])
    if pipeline.config.keyframe.mode == "all":
        return sorted({first_ns, *run.track.times.tolist(), *ends_ns})
    times = [first_ns]
    for end_ns in ends_ns:
        if end_ns > times[-1] and pipeline.keyframes.has_moved(run, times[-1], end_ns):
            times.append(end_ns)
    between = _readings_between(run.track, np.array(times, dtype=np.int64), pipeline.config)
    return sorted({*times, *between})


def _readings_between(track: Track, times_ns: IntArray, config: Config) -> list[int]:
    """Times of readings that get a state, so that no two states (n,) are far from each other.

    What is reported between two states has their disagreement spread over the way, so the way must
    be short: over two rounds of a circle of 40 m that is wrong by metres.
    """
    readings = track.times
    readings = readings[(readings > times_ns[0]) & (readings < times_ns[-1])]
    before = np.searchsorted(times_ns, readings, side="right") - 1
    path_m = track.driven(readings)[:, 0] - track.driven(times_ns)[before, 0]
    stretch = np.floor(path_m / (BRIDGED_KEYFRAMES * config.keyframe.distance_m))
    _, first = np.unique(np.column_stack([before, stretch]), axis=0, return_index=True)
    return [int(t) for t in readings[first[stretch[first] > 0]]]


# ---------------------------------------------------------------- from steps to the estimate


def _solve(steps: Sequence[Step], config: Config) -> Estimate:
    """The estimate with the noise that the log states.

    Verified closures are taken for true. If others are used, the better of two solutions counts:
    one begins without them, the other follows them.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    closures = [closure for step in steps for closure in step.closures]
    verified = [closure for closure in closures if closure.verified]
    found = []
    for followed in [verified] if len(verified) == len(closures) else [verified, closures]:
        solver = Reoptimiser(config, steps, initial_estimate(steps, followed))
        found.append(solver.solve())
    return min(found, key=lambda estimate: estimate.error)


def _record_causal(pipeline: Pipeline) -> None:
    """Estimate every state from the steps up to it, with the incremental back end."""
    causal = replay(pipeline.steps, pipeline.backend).causal
    for robot, run in pipeline.started.items():
        run.causal_poses = list(causal[robot].poses)
        run.causal_covs = list(causal[robot].covs)
        run.calibrations = [run.track.used_calibration] * len(run.times)
