"""Relative poses recorded in a log: which are used, and their conversion to closures."""

from bisect import bisect_right
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from graphslam.core.config import Config
from graphslam.core.geometry import compose, compose_cov, inverse, inverse_cov
from graphslam.core.records import (
    Closure,
    Message,
    RelativePose,
    Scan,
    Sighting,
    Start,
    TrueLandmark,
    Truth,
)
from graphslam.logs import LogSet
from graphslam.mapping.recorded_closure_verification import NOTHING_RECORDED, origin_prior, verify
from graphslam.odometry.preintegration import Track
from graphslam.pipeline.robot_settings import make_tracks
from graphslam.pipeline.robot_state import RobotState
from graphslam.pipeline.synchronisation import ODOMETRY

#: robot, time, other robot, its time, relative pose: identifies a recorded closure
ClosureId = tuple[str, int, str, int, tuple[float, ...]]


@dataclass(frozen=True, slots=True, eq=False)
class RecordedClosures:
    """Which relative poses of a log are used; see `ClosureDecision`.

    ``refused`` and ``kept`` by `closure_id`; ``frames`` of all robots that have a start.
    """

    starts: Mapping[str, Start]
    frames: Mapping[str, str]
    kept: frozenset[ClosureId]
    refused: Mapping[ClosureId, str]

    def start_times(self) -> dict[str, list[int]]:
        """Robot -> sorted times at which the used ones start."""
        times: dict[str, set[int]] = defaultdict(set)
        for _, _, other, start_ns, _ in self.kept:
            times[other].add(start_ns)
        return {robot: sorted(found) for robot, found in times.items()}

    def to_summary(self) -> dict[str, Any]:
        """For summary.json: number ``kept``, list of those ``refused``, and why."""
        refused = [
            {"robot": r, "time_ns": t, "other": o, "other_time_ns": s, "reason": why}
            for (r, t, o, s, _), why in self.refused.items()
        ]
        return {"kept": len(self.kept), "refused": refused}


def judge_recorded_closures(
    log: LogSet, config: Config, starts: Mapping[str, Start]
) -> RecordedClosures:
    """Decide which relative poses of a log to use, and the start poses that follow from them.

    In a log of relative poses only, robots that these do not place keep a frame of their own. The
    decision takes a pass over the odometry, made only where there are relative poses.
    """
    kinds = {topic.record for topic in log.topics}
    messages: list[RelativePose] = []
    tracks = make_tracks(log, config)
    if RelativePose in kinds and config.backend.verify_closures:
        read = log.messages((Truth, TrueLandmark, Scan, Sighting))
        messages = take_relative_poses(read, tracks)
    return accept_closures(log, config, starts, messages, tracks)


def take_relative_poses(
    messages: Iterable[Message], tracks: Mapping[str, Track]
) -> list[RelativePose]:
    """The relative poses among the messages of a log, whose odometry goes into ``tracks``."""
    found: list[RelativePose] = []
    for message in messages:
        if isinstance(message, ODOMETRY):
            tracks[message.robot].add(message)
        elif isinstance(message, RelativePose):
            found.append(message)
    return found


def accept_closures(
    log: LogSet,
    config: Config,
    starts: Mapping[str, Start],
    messages: Sequence[RelativePose],
    tracks: Mapping[str, Track],
) -> RecordedClosures:
    """See `judge_recorded_closures`, for the relative poses and the odometry of a log."""
    kinds = {topic.record for topic in log.topics}
    verified = NOTHING_RECORDED
    if config.backend.verify_closures:
        verified = verify(messages, tracks, starts)
    found, frames = dict(verified.starts), dict(verified.frames)
    if kinds & {Scan, Sighting}:
        # these may place a robot too, so only starts relative to another robot are used
        found = {robot: start for robot, start in found.items() if frames[robot] != robot}
    elif RelativePose in kinds:
        for robot in sorted(set(log.robots) - {*starts, *found}):
            found[robot], frames[robot] = origin_prior(), robot
    world = min(starts, default="")
    kept = frozenset(closure_id(messages[k]) for k in verified.kept)
    refused = {closure_id(messages[k]): why for k, why in verified.refused.items()}
    frames = {robot: frames.get(robot, world) for robot in log.robots if robot in {*starts, *found}}
    return RecordedClosures(found, frames, kept, refused)


def closure_id(message: RelativePose) -> ClosureId:
    """Identifies a recorded closure in every pass over the log."""
    ends = message.robot, message.time_ns, message.other, message.start_ns
    return (*ends, tuple(message.delta.tolist()))


def between_states(
    message: RelativePose,
    state_ns: int,
    runs: Mapping[str, RobotState],
    recorded: RecordedClosures,
) -> Closure | str:
    """A recorded relative pose as a closure between states, or why it is dropped.

    Odometry carries it to the states nearest before its ends.

    Args:
        message: as recorded.
        state_ns: time of the state nearest before its later end.
        runs: of every robot.
        recorded: which relative poses are accepted.
    """
    other = runs.get(message.other)
    if closure_id(message) in recorded.refused:
        return "rejected, see closures.refused"
    if message.other == message.robot and message.start_ns >= message.time_ns:
        return "its start is not before its end"
    if other is None or not other.started or message.start_ns < other.times[0]:
        return "no keyframe at its start time"
    other_ns = other.times[bisect_right(other.times, message.start_ns) - 1]
    delta, cov = message.delta, message.cov
    if other_ns < message.start_ns:
        lead = other.track.motion(other_ns, message.start_ns)
        cov = compose_cov(lead.delta, lead.cov, delta, cov)
        delta = compose(lead.delta, delta)
    if state_ns < message.time_ns:
        tail = runs[message.robot].track.motion(state_ns, message.time_ns)
        back = inverse(tail.delta)
        cov = compose_cov(delta, cov, back, inverse_cov(tail.delta, tail.cov))
        delta = compose(delta, back)
    is_verified = closure_id(message) in recorded.kept
    return Closure(message.robot, state_ns, message.other, other_ns, delta, cov, is_verified)
