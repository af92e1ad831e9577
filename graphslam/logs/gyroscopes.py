"""Which robots of a log have a gyroscope that is used."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice

import numpy as np

from graphslam.core.config import Config
from graphslam.core.geometry import Array
from graphslam.core.records import OdometryPose
from graphslam.logs.decoders import TopicContext, decode_messages
from graphslam.logs.findings import Finding
from graphslam.logs.imu import IntArray, imu_topics, turn_rates
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
) -> tuple[dict[str, Turning], list[Finding]]:
    """The turning of each robot that reports poses of its odometry and has a gyroscope.

    Args:
        files: the recordings.
        topics: those that are used.
        contexts: of the topics.
        config: settings.
    """
    found: dict[str, Turning] = {}
    findings: list[Finding] = []
    robots = sorted({t.robot for t in topics if t.record in MOTION_KINDS})
    for robot in robots if config.odometry.gyroscope == "auto" else ():
        odometry = [t for t in topics if t.robot == robot and t.record is OdometryPose]
        names = imu_topics(files, robot, len(robots))
        if not (names and odometry):
            continue
        tree = static_tree(files, robot, sampled_edges(files, robot))
        times, rates = turn_rates(files, names[0], tree, base_frame(files, odometry[0]))
        poses = list(_poses(files, odometry[0], contexts[odometry[0].name]))
        at: IntArray = np.array([time for time, _ in poses], dtype=np.int64)
        turning = find_turning(
            names[0], times, rates, at, np.array([pose for _, pose in poses]).reshape(-1, 3)
        )
        where = f"robot {robot}"
        if isinstance(turning, str):
            text = f"the gyroscope of {names[0]} is not used: {turning}"
            remedy = "check its axes in /tf_static and its units"
            findings.append(Finding("note", "gyroscope", where, text, remedy))
        else:
            found[robot] = turning
            text = f"turning is that of the gyroscope of {names[0]}, less a bias of "
            text += f"{turning.bias:.2g} rad/s and a delay of {1e3 * turning.late_s:.0f} ms"
            remedy = "to leave it out: --set odometry.gyroscope=off"
            findings.append(Finding("note", "gyroscope", where, text, remedy))
    return found, findings


def _poses(
    files: Sequence[Recording], topic: Topic, context: TopicContext
) -> Iterator[tuple[int, Array]]:
    """Times, ns, and poses (3,) of the odometry, in the order of recording."""
    for file in files:
        raws = raw_messages(file, {topic.name})
        while batch := list(islice(raws, _BATCH)):
            decoded = decode_messages(topic.schema, [r.data for r in batch], context, Counter())
            for raw, message in zip(batch, decoded, strict=True):
                if isinstance(message, OdometryPose):
                    yield raw.log_time_ns if context.by_log_time else message.time_ns, message.pose
