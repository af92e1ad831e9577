"""Recordings of ROS in any container to one MCAP file of ROS 2 messages."""

from pathlib import Path

from graphslam.core.errors import LogError
from graphslam.importers.import_summary import ImportSummary
from graphslam.logs.containers import open_recording
from graphslam.logs.recording import raw_messages
from graphslam.logs.schemas import KNOWN
from graphslam.logs.writer import LogWriter


def import_rosbag(source: Path, target: Path) -> ImportSummary:
    """Write what can be decoded of ``source`` to the MCAP file ``target``.

    ``source``: whatever `open_recording` opens. Messages keep their bytes (those of ROS 1 become
    CDR, with the same values), their order and their log times.

    Raises:
        LogError: ``source`` cannot be read, or has no topic that is used.
        OutputError: ``target`` cannot be written.
    """
    recording = open_recording(source)
    topics = {t.name: t.schema for t in recording.topics if t.encoding == "cdr" and t.count}
    used = {name: schema for name, schema in topics.items() if schema in KNOWN}
    if not used:
        there = ", ".join(f"{t.name} ({t.schema}, {t.encoding})" for t in recording.topics)
        raise LogError(f"{source}: has no topic that is used; there are {there}")
    notes = {**recording.notes, "format": "rosbag", "source": source.name}
    with LogWriter(target, notes) as log:
        for raw in raw_messages(recording, used.keys()):
            log.encoded(raw.topic, used[raw.topic], raw.data, raw.log_time_ns)
    warnings = [
        f"{source}: {topic.name} ({topic.schema}) is not used, and not copied"
        for topic in recording.topics
        if topic.name not in used
    ]
    damage = [f"{source}: damaged: {recording.damage}"] if recording.damage else []
    return ImportSummary(source, target, log.counts, tuple(damage + warnings))
