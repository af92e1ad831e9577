"""Which robots of a log have a gyroscope that is used."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from operator import itemgetter

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import Config, RobotConfig
from graphslam.core.config_io import load_config
from graphslam.core.geometry import Array, exp, rotation3
from graphslam.core.motion_models import wheel_twist
from graphslam.core.record import replace
from graphslam.core.records import OdometryPose, WheelAngles
from graphslam.logs.decoders import TopicContext, decode_messages
from graphslam.logs.findings import Finding
from graphslam.logs.imu import imu_topics, turn_rates
from graphslam.logs.imu_turning import Turning, find_turning
from graphslam.logs.recording import Recording, raw_messages
from graphslam.logs.tf_tree import sampled_edges, static_tree
from graphslam.logs.topic_context import base_frame
from graphslam.logs.topics import MOTION_KINDS, Topic

#: messages that are decoded together
_BATCH = 128


def find_gyroscopes(
    files: Sequence[Recording],
    topics: Sequence[Topic],
    contexts: Mapping[str, TopicContext],
    config: Config,
    wrapped: frozenset[str] = frozenset(),
) -> tuple[dict[str, Turning], list[Finding]]:
    """The turning of each robot that reports poses or wheel angles and has a gyroscope.

    Args:
        files: the recordings.
        topics: those that are used.
        contexts: of the topics.
        config: settings.
        wrapped: robots whose wheels' angles begin again after each turn, see `wheel_turns`.
    """
    found: dict[str, Turning] = {}
    findings: list[Finding] = []
    robots = sorted({t.robot for t in topics if t.record in MOTION_KINDS})
    for robot in robots if config.odometry.gyroscope == "auto" else ():
        kinds = (OdometryPose, WheelAngles)
        odometry = [t for t in topics if t.robot == robot and t.record in kinds]
        names = imu_topics(files, robot, len(robots))
        if not (names and odometry):
            continue
        wheels = _wheels(robot, files, config)
        at, poses = _poses(files, odometry[0], contexts, wheels, robot in wrapped)
        tree = static_tree(files, robot, sampled_edges(files, robot))
        base = base_frame(files, odometry[0])
        for name in names:
            turning = find_turning(name, *turn_rates(files, name, tree, base), at, poses)
            if isinstance(turning, Turning):
                found[robot] = replace(turning, wheels=wheels)
                findings.append(_used(robot, turning))
                break
            findings.append(_not_used(robot, name, turning))
    return found, findings


def _used(robot: str, turning: Turning) -> Finding:
    text = f"turning is that of the gyroscope of {turning.topic}, less a bias of "
    text += f"{turning.bias:.2g} rad/s and a delay of {1e3 * turning.late_s:.0f} ms"
    remedy = "to leave it out: --set odometry.gyroscope=off"
    return Finding("note", "gyroscope", f"robot {robot}", text, remedy)


def _not_used(robot: str, topic: str, why: str) -> Finding:
    text = f"the gyroscope of {robot} is not used: {why}"
    remedy = "check its axes in /tf_static and its units"
    return Finding("note", "gyroscope", topic, text, remedy)


def _poses(
    files: Sequence[Recording],
    topic: Topic,
    contexts: Mapping[str, TopicContext],
    wheels: RobotConfig,
    wrapped: bool,
) -> tuple[IntArray, Array]:
    """Times (n,) ns and poses (n, 3) of an odometry of poses or of angles of ``wheels``.

    ``wrapped``: the angles begin again after each turn.
    """
    readings = list(odometry_readings(files, topic, contexts[topic.name]))
    readings.sort(key=itemgetter(0))
    at: IntArray = np.array([time for time, _ in readings], dtype=np.int64)
    found = np.array([reading for _, reading in readings])
    if topic.record is WheelAngles:
        angles = found.reshape(-1, 2)
        found = _path(np.unwrap(angles, axis=0) if wrapped else angles, wheels)
    return at, found.reshape(-1, 3)


def _wheels(robot: str, files: Sequence[Recording], config: Config) -> RobotConfig:
    """The settings of a robot; what is at its default there is that of the notes of the log."""
    default, own = RobotConfig(), config.robot(robot)
    notes = {key: value for file in files for key, value in file.notes.items()}
    lines = [f"{k}={v}" for k, v in notes.items() if k.startswith(f"robots.{robot}.")]
    noted = load_config(overrides=lines).robot(robot)
    return replace(
        own,
        **{
            name: getattr(noted, name)
            for name in ("wheel_radius_left_m", "wheel_radius_right_m", "axle_m")
            if getattr(own, name) == getattr(default, name)
        },
    )


def _path(angles: Array, wheels: RobotConfig) -> Array:
    """Poses (n, 3) by angles (n, 2) of the wheels, rad."""
    steps = exp(wheel_twist(np.diff(angles, axis=0), wheels))
    heading = np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    moved = (rotation3(heading[:-1]) @ steps[:, :, None])[:, :2, 0]
    xy = np.concatenate([np.zeros((1, 2)), np.cumsum(moved, axis=0)])
    return np.column_stack([xy, heading])


def odometry_readings(
    files: Sequence[Recording], topic: Topic, context: TopicContext
) -> Iterator[tuple[int, Array]]:
    """Times, ns, and poses (3,) of the odometry or angles (2,), in the order of recording."""
    for file in files:
        raws = raw_messages(file, {topic.name})
        while batch := list(islice(raws, _BATCH)):
            decoded = decode_messages(topic.schema, [r.data for r in batch], context, Counter())
            for raw, message in zip(batch, decoded, strict=True):
                time_ns = raw.log_time_ns
                if message is not None and not context.by_log_time:
                    time_ns = message.time_ns
                if isinstance(message, OdometryPose):
                    yield time_ns, message.pose
                elif isinstance(message, WheelAngles):
                    yield time_ns, np.array([message.left_rad, message.right_rad])
