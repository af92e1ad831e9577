"""Decoding context of each topic, from a sample of its messages: mounts and no-return values."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core import records
from graphslam.core.config import Config
from graphslam.core.geometry import Array
from graphslam.logs import schemas
from graphslam.logs.decoders import TopicContext, frame_of
from graphslam.logs.mounts import TransformTree, base_above, find_mount, is_level
from graphslam.logs.no_return import find_no_return
from graphslam.logs.recording import Recording, sample_messages
from graphslam.logs.tf_tree import sampled_edges, static_tree
from graphslam.logs.topics import ODOMETRY_KINDS, Topic

# 16 x 16 messages over the whole log: enough to find a frequent value, quick to read
_SAMPLE_BLOCKS, _SAMPLE_PER_BLOCK = 16, 16


@dataclass(frozen=True, slots=True)
class ScanShape:
    """Properties of a laser by its messages; a range limit that is not finite is None."""

    beams: int
    field_of_view_rad: float
    range_min_m: float | None
    range_max_m: float | None


def scan_shape(files: Sequence[Recording], topic: Topic) -> ScanShape | None:
    """Shape of the first scan of ``topic`` that can be decoded; None if there is none."""
    for message in sample_decoded(files, topic):
        beams = len(message.ranges)
        view = abs(float(message.angle_increment)) * max(beams - 1, 0)
        limits = (float(message.range_min), float(message.range_max))
        return ScanShape(beams, view, *(limit if np.isfinite(limit) else None for limit in limits))
    return None


def topic_contexts(
    files: Sequence[Recording], topics: Sequence[Topic], config: Config
) -> tuple[dict[str, TopicContext], list[str]]:
    """Decoding context of each topic, and warnings about assumptions that were made."""
    warnings: list[str] = []
    odometry = [t for kind in ODOMETRY_KINDS[::-1] for t in topics if t.record is kind]
    bases = {t.robot: base_frame(files, t) for t in odometry}  # the preferred kind comes last
    contexts = {}
    trees: dict[str, TransformTree] = {}
    for topic in topics:
        settings = config.robot(topic.robot)
        mounts: dict[str, Array] = {}
        inverted: set[str] = set()
        no_return = None
        if topic.record in (records.Scan, records.Sighting):
            messages = list(sample_decoded(files, topic))
            if topic.robot not in trees:
                edges = sampled_edges(files, topic.robot)
                trees[topic.robot] = static_tree(files, topic.robot, edges)
            tree = trees[topic.robot]
            for frame in sorted({frame_of(message) for message in messages}):
                base = bases[topic.robot] if topic.robot in bases else base_above(tree, frame)
                mounts[frame], upside_down, notes = _mount(topic, tree, base, frame, settings.laser)
                inverted |= {frame} if upside_down else set()
                warnings += notes
            if topic.record is records.Scan:
                no_return = find_no_return(message.ranges for message in messages)
        contexts[topic.name] = TopicContext(
            robot=topic.robot,
            mounts=mounts,
            inverted=frozenset(inverted),
            no_return_m=np.inf if no_return is None else no_return,
            at_once=not config.logs.undistort,
            left_joint=settings.left_joint,
            right_joint=settings.right_joint,
        )
    return contexts, warnings


def sample_decoded(files: Sequence[Recording], topic: Topic) -> Iterator[Any]:
    """Decoded messages of ``topic``, sampled evenly over the log."""
    for file in files:
        data = sample_messages(file, topic.name, _SAMPLE_BLOCKS, _SAMPLE_PER_BLOCK)
        # damaged messages are counted when the topic is read
        yield from schemas.decode_all(topic.schema, data)


def base_frame(files: Sequence[Recording], topic: Topic) -> str:
    """Frame whose motion an odometry topic describes."""
    if topic.record is records.WheelAngles:
        return "base_link"  # JointState has no such frame; this is ROS' convention
    for message in sample_decoded(files, topic):
        name = message.child_frame_id if topic.record is records.OdometryPose else frame_of(message)
        return str(name).lstrip("/") or "base_link"
    return "base_link"


def _mount(
    topic: Topic, tree: TransformTree, base: str, frame: str, configured: Sequence[float]
) -> tuple[Array, bool, list[str]]:
    """Pose (3,) of ``frame`` on the robot, whether it is upside down, and warnings."""
    where = f"{topic.name}: frame {frame or '(none)'}"
    found = find_mount(tree, base, frame)
    inverted = found is not None and found.inverted
    if len(configured) == 3 and topic.record is records.Scan:
        return np.array(configured, dtype=float), inverted, []
    if found is None:
        if topic.record is records.Sighting and not frame:
            return np.zeros(3), False, []  # no frame: measured from the base
        problem = f"tf_static has no transform from {base}; assumed to be the base itself"
        return np.zeros(3), False, [f"{where}: {problem}; set robots.{topic.robot}.laser"]
    notes = []
    if not is_level(found):
        tilt = np.rad2deg(found.tilt_rad)
        notes.append(f"{where}: is tilted by {tilt:.0f} deg; treated as level")
    return found.pose, inverted, notes
