"""Ground truth in logs; read by evaluation only, needs no odometry."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from graphslam.core.config import Config
from graphslam.core.records import Trajectory, TrueAssociations, TrueLandmark, Truth
from graphslam.logs import schemas
from graphslam.logs.decoders import TopicContext, decode_messages
from graphslam.logs.recording import Recording, data_of_topics, raw_messages
from graphslam.logs.sessions import open_recordings
from graphslam.logs.topics import find_topics


@dataclass(frozen=True, slots=True, eq=False)
class GroundTruth:
    """True trajectories of robots' bases and true landmarks, world frame; either may be empty.

    Covariances are NaN. ``sha256``: digests of the logs, in their order.
    """

    trajectories: Mapping[str, Trajectory]
    landmarks: tuple[TrueLandmark, ...]
    sha256: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        """Whether there is any ground truth."""
        return bool(self.trajectories or self.landmarks)


def read_truth(paths: Sequence[Path], config: Config) -> GroundTruth:
    """All TruePose and TrueLandmark messages of ``paths``; both may be empty.

    Poses are sorted by header stamp. A landmark that appears repeatedly (per robot or file) is
    taken once, by its identity.

    Raises:
        LogError: a file is missing, of no known container, empty, or without any topic that can be
            decoded.
    """
    return truth_from_recordings(*open_recordings(paths, config))


def truth_from_recordings(files: Sequence[Recording], config: Config) -> GroundTruth:
    """`read_truth` of files that are already open."""
    topics = {t.name: t for t in find_topics(files, config) if t.record in (Truth, TrueLandmark)}
    poses: dict[str, list[bytes]] = defaultdict(list)
    landmarks: dict[str, TrueLandmark] = {}
    unusable: Counter[str] = Counter()  # `graphslam info` counts and shows these
    for file in files:
        for name, data in data_of_topics(file, topics.keys()).items():
            topic = topics[name]
            if topic.record is Truth:
                poses[topic.robot] += data
                continue
            for message in decode_messages(topic.schema, data, TopicContext(topic.robot), unusable):
                if isinstance(message, TrueLandmark):
                    landmarks[message.identity or f"without identity {len(landmarks)}"] = message
    trajectories = {robot: _trajectory(found) for robot, found in sorted(poses.items())}
    return GroundTruth(
        {robot: found for robot, found in trajectories.items() if len(found)},
        tuple(landmarks.values()),
        tuple(file.sha256 for file in files),
    )


def read_true_associations(
    paths: Sequence[Path], config: Config
) -> Mapping[str, tuple[TrueAssociations, ...]]:
    """True associations of scans and sightings: topic -> messages in the order of recording.

    Raises:
        LogError: a file is missing, of no known container, empty, or without any topic that can be
            decoded.
    """
    files, config = open_recordings(paths, config)
    topics = {t.name: t for t in find_topics(files, config) if t.record is TrueAssociations}
    found: dict[str, list[TrueAssociations]] = {name: [] for name in topics}
    unusable: Counter[str] = Counter()
    for file in files:
        for raw in raw_messages(file, topics.keys()):
            topic = topics[raw.topic]
            context = TopicContext(topic.robot)
            (message,) = decode_messages(topic.schema, [raw.data], context, unusable)
            if isinstance(message, TrueAssociations):
                found[raw.topic].append(message)
    return {name: tuple(messages) for name, messages in found.items()}


def _trajectory(messages: Sequence[bytes]) -> Trajectory:
    """The poses sorted by header stamp; malformed messages are left out."""
    stamps, poses = schemas.decode_true_poses(messages)
    finite = np.isfinite(poses).all(axis=1)
    stamps, poses = stamps[finite], poses[finite]
    order = np.argsort(stamps, kind="stable")
    return Trajectory(stamps[order], poses[order], np.full((len(order), 3, 3), np.nan))
