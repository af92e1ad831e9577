"""Which topics with point clouds are those of a planar laser, and read as scans."""

from collections.abc import Iterable, Sequence

import numpy as np

from graphslam.core.geometry import Array
from graphslam.logs import schemas
from graphslam.logs.findings import Finding, Severity
from graphslam.logs.point_cloud import cloud_points, is_planar
from graphslam.logs.recording import Recording, sample_messages
from graphslam.logs.topics import Topic

#: messages that are looked at
_SAMPLES = 4


def without_other_clouds(
    files: Sequence[Recording], topics: Sequence[Topic]
) -> tuple[list[Topic], list[Finding]]:
    """The topics but those of clouds that are no scans, or have a LaserScan beside them."""
    lasers = {t.robot for t in topics if t.schema == schemas.LASER_SCAN and t.count}
    kept: list[Topic] = []
    findings: list[Finding] = []
    for topic in topics:
        if topic.schema != schemas.POINT_CLOUD or not topic.count:
            kept.append(topic)
        elif all(map(is_planar, _sampled(files, topic))):
            text = "its points are level: it is read as scans, with all points at its stamp"
            findings.append(Finding("note", "clouds", topic.name, text))
            kept.append(topic)
        else:
            text = "is not read: its points are not those of one level laser"
            remedy = "record sensor_msgs/LaserScan, or make it of the cloud with "
            remedy += "pointcloud_to_laserscan"
            severity: Severity = "note" if lasers else "doubt"
            findings.append(Finding(severity, "unused", topic.name, text, remedy))
    return kept, findings


def _sampled(files: Sequence[Recording], topic: Topic) -> Iterable[Array]:
    found = False
    for file in files:
        data = sample_messages(file, topic.name, 1, _SAMPLES)
        for message in schemas.decode_all(topic.schema, data):
            found = True
            try:
                yield cloud_points(message)
            except ValueError:
                yield np.empty((0, 3))
    if not found:
        yield np.empty((0, 3))
