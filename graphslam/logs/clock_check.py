"""Whether the topics of a robot are stamped by one clock: else no scan meets its odometry.

`info` knows all stamps. Before a log is smoothed, those of the first and last messages of each
topic tell, which costs no reading of the log.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

from graphslam.core import records
from graphslam.core.errors import LogError
from graphslam.logs.decoders import TopicContext, decode_messages
from graphslam.logs.findings import Finding
from graphslam.logs.recording import (
    RawMessage,
    Recording,
    deriver,
    first_and_last,
    sample_messages,
)
from graphslam.logs.topics import ODOMETRY_KINDS, Topic

#: messages of a topic that are decoded at each of its ends
_DECODED = 64
#: the rest of a topic is looked at where its ends are apart: blocks, messages of each
_BLOCKS, _PER_BLOCK = 16, 16
_SENSING = (records.Scan, records.Sighting)

#: first and last stamp, ns
Span = tuple[int, int]


def apart(topic: str, span: Span, moving: str, moved: Span, max_gap_s: float) -> Finding | None:
    """That the stamps of ``topic`` and those of odometry, ``moving``, have no time in common.

    ``span`` and ``moved``: from when to when each has stamps. They may be ``max_gap_s`` apart.
    """
    distance_s = 1e-9 * max(span[0] - moved[1], moved[0] - span[1])
    if distance_s <= max_gap_s:
        return None
    text = f"its stamps and those of {moving} are {distance_s:.1f} s apart"
    remedy = "let both be stamped by one clock (use_sim_time for all nodes, or none)"
    return Finding("unusable", "clocks", topic, text, remedy)


def check_clocks(
    files: Sequence[Recording],
    topics: Sequence[Topic],
    contexts: Mapping[str, TopicContext],
    max_gap_s: float,
) -> None:
    """Refuse a log in which a sensor and the odometry of its robot have no time in common.

    Clocks of several robots may differ. Of each of ``topics`` the first and the last messages are
    read, and more where they tell of two clocks. For ``max_gap_s`` see `apart`.

    Raises:
        LogError: a robot has such a sensor; it says so as `info` does.
    """
    for moving in (t for t in topics if t.count and t.record in ODOMETRY_KINDS):
        sensors = [t for t in topics if t.robot == moving.robot and t.record in _SENSING]
        moved = _span(files, moving, contexts[moving.name]) if sensors else None
        for sensor in sensors:
            span = _span(files, sensor, contexts[sensor.name])
            if not (span and moved and apart(sensor.name, span, moving.name, moved, max_gap_s)):
                continue
            span = _whole(files, sensor, contexts[sensor.name], span)
            moved = _whole(files, moving, contexts[moving.name], moved)
            if found := apart(sensor.name, span, moving.name, moved, max_gap_s):
                raise LogError(f"{', '.join(str(file.path) for file in files)}: {found.line}")


def _span(files: Sequence[Recording], topic: Topic, context: TopicContext) -> Span | None:
    """First and last stamp among those of the first and last messages; None without any."""
    found: list[int] = []
    for file in files:
        raws = first_and_last(file, file.source_of(topic.name))
        ends = [*raws[:_DECODED], *raws[-_DECODED:]]
        if derived := [one for one in file.derived if one.name == topic.name]:
            make = deriver(derived, ())
            ends = [raw for source in ends for raw in make(source)]
        found += _stamps(topic, context, ends)
    return (min(found), max(found)) if found else None


def _whole(files: Sequence[Recording], topic: Topic, context: TopicContext, ends: Span) -> Span:
    """The same of messages from the whole log, besides its ``ends``."""
    if context.by_log_time:
        return ends
    found = list(ends)
    for file in files:
        data = sample_messages(file, topic.name, _BLOCKS, _PER_BLOCK)
        found += _stamps(topic, context, [RawMessage(topic.name, 0, one) for one in data])
    return min(found), max(found)


def _stamps(topic: Topic, context: TopicContext, raws: Sequence[RawMessage]) -> list[int]:
    """Stamps, ns, of those messages that can be read, or the times of their recording."""
    if not raws:
        return []
    told = replace(context, without_ranges=True, beams=Counter())
    made = decode_messages(topic.schema, [raw.data for raw in raws], told, Counter())
    return [
        raw.log_time_ns if context.by_log_time else message.stamp_ns
        for raw, message in zip(raws, made, strict=True)
        if message is not None
    ]
