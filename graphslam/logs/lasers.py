"""Several lasers on one robot: which of them are used besides the first one.

The first laser is the one with most messages. A further one is used if its mount is known, at
least roughly: it is estimated with the states. Two topics in one frame are of one laser (its
driver's and a filter's), and a scan in the frame of the base is put together from other lasers'.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from graphslam.core import records
from graphslam.core.config import Config
from graphslam.logs.decoders import TopicContext, frame_of
from graphslam.logs.findings import Finding
from graphslam.logs.recording import Recording
from graphslam.logs.schemas import POINT_CLOUD
from graphslam.logs.topic_context import base_frame, sample_decoded, topic_contexts
from graphslam.logs.topics import MOTION_KINDS, ODOMETRY_KINDS, Topic, lasers_of, unused


@dataclass(slots=True)
class FurtherLasers:
    """The further lasers that are used: topics, their contexts by name; and findings of all."""

    topics: list[Topic] = field(default_factory=list)
    contexts: dict[str, TopicContext] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)


def further_lasers(
    files: Sequence[Recording], topics: Sequence[Topic], chosen: Sequence[Topic], config: Config
) -> FurtherLasers:
    """The lasers that are used besides those among the ``chosen`` of all ``topics``."""
    found = FurtherLasers()
    first_only = _first_only(chosen, config)
    for first in (t for t in chosen if t.record is records.Scan):
        others = [t for t in lasers_of(topics, first.robot) if t != first]
        if not others:
            continue
        left_out = others if first_only else _add(files, first, others, chosen, config, found)
        if left_out:
            finding = unused("laser", [first, *left_out], chosen)
            if first_only:
                finding = replace(finding, text=f"{finding.text}: {first_only}")
            found.findings.append(finding)
    return found


def sensor_name(topic: Topic) -> str:
    """Name of a further laser: its topic's, without the robot's."""
    name = topic.name.strip("/").removeprefix(f"{topic.robot}/")
    return re.sub(r"[^A-Za-z0-9_-]", "_", name)


def _first_only(chosen: Sequence[Topic], config: Config) -> str:
    """Why only the first laser of each robot is used; empty if it is not so."""
    kinds = {topic.record for topic in chosen}
    if len({t.robot for t in chosen if t.record in MOTION_KINDS}) > 1:
        return "of several robots one laser each is used"
    if kinds & {records.Sighting, records.RelativePose}:
        return "beside sightings one laser is used"
    if not config.tracks_scans:
        return "only backend batch, with its other defaults, uses several lasers"
    return ""


def _add(
    files: Sequence[Recording],
    first: Topic,
    others: Sequence[Topic],
    chosen: Sequence[Topic],
    config: Config,
    found: FurtherLasers,
) -> list[Topic]:
    """Add those of the ``others`` that are used to ``found``; the topics that are no laser more."""
    odometry = [t for t in chosen if t.robot == first.robot and t.record in ODOMETRY_KINDS]
    base = base_frame(files, odometry[0]) if odometry else ""
    first_frame = _frame(files, first)
    frames, left_out = {first_frame}, []
    for topic in others:
        frame = _frame(files, topic)
        if (
            first_frame == base
            or topic.schema == POINT_CLOUD
            or frame in frames
            or frame in ("", base)
        ):
            left_out.append(topic)
            continue
        sensors = {topic.name: sensor_name(topic)}
        contexts, said = topic_contexts(files, [*odometry, topic], config, sensors)
        unknown = [finding for finding in said if finding.severity == "unusable"]
        if unknown:
            text = f"is not used: {unknown[0].text}"
            found.findings.append(
                Finding("note", "unused", unknown[0].topic, text, unknown[0].remedy)
            )
            continue
        frames.add(frame)
        found.topics.append(topic)
        found.contexts[topic.name] = contexts[topic.name]
        found.findings += said
    return left_out


def _frame(files: Sequence[Recording], topic: Topic) -> str:
    """The frame of the first scan; empty without one."""
    return next((frame_of(message) for message in sample_decoded(files, topic)), "")
