"""One pass over the messages of one recording: decoded, with repaired times, in order of these."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice

from graphslam.core import records
from graphslam.core.config import Config
from graphslam.core.records import Message
from graphslam.logs import time_order
from graphslam.logs.clock_steps import OTHER_CLOCK, Spans
from graphslam.logs.decoders import TopicContext, decode_messages
from graphslam.logs.future_stamps import Recorded, repair_future_stamps
from graphslam.logs.recording import RawMessage, Recording, raw_messages
from graphslam.logs.topics import Topic

NO_SPANS: Spans = {}

#: messages that are decoded together: enough for arrays to pay, few enough to hold in memory; fewer
#: where there are scans, which are large
_BATCH, _BATCH_WITH_SCANS = 1024, 128


class FileReader:
    """One pass over the messages of one file.

    ``dropped`` and the counts of ``sorter`` are those of the messages read so far.
    """

    def __init__(self, file: Recording, config: Config, spans: Spans = NO_SPANS) -> None:
        """Prepare to read ``file`` with the window of ``config.logs``.

        Messages of topics of which there are ``spans`` are left out if their times are not in it.
        """
        self.file = file
        self.sorter = time_order.MessageSorter(round(config.logs.reorder_s * 1e9))
        self.dropped: Counter[str] = Counter()
        self._spans = spans

    def recorded(
        self, topics: Mapping[str, Topic], contexts: Mapping[str, TopicContext]
    ) -> Iterator[Recorded]:
        """Messages of ``topics`` in the order of recording, with their topic and log time."""
        # decoders count dropped beams in the counter of this pass
        own = {name: replace(context, beams=self.dropped) for name, context in contexts.items()}
        raws = raw_messages(self.file, topics.keys())
        scans = any(topic.record is records.Scan for topic in topics.values())
        while batch := list(islice(raws, _BATCH_WITH_SCANS if scans else _BATCH)):
            yield from decoded(batch, topics, own, self.dropped)

    def sorted(self, recorded: Iterable[Recorded]) -> Iterator[Message]:
        """The messages in the order of their repaired times."""
        for topic, message, _ in repair_future_stamps(recorded, time_order.SAMPLED):
            first, last = self._spans.get(topic, (message.time_ns, message.time_ns))
            if not first <= message.time_ns <= last:
                self.dropped[OTHER_CLOCK] += 1
                continue
            yield from self.sorter.push(topic, message)
        yield from self.sorter.finish()


def decoded(
    batch: Sequence[RawMessage],
    topics: Mapping[str, Topic],
    contexts: Mapping[str, TopicContext],
    dropped: Counter[str],
) -> Iterator[Recorded]:
    """Messages of ``topics``, those of each decoded together; what cannot be is counted."""
    places: dict[str, list[int]] = {}
    for place, raw in enumerate(batch):
        places.setdefault(raw.topic, []).append(place)
    found: list[Message | None] = [None] * len(batch)
    for name, at in places.items():
        data = [batch[place].data for place in at]
        made = decode_messages(topics[name].schema, data, contexts[name], dropped)
        for place, message in zip(at, made, strict=True):
            found[place] = message
    for raw, message in zip(batch, found, strict=True):
        if message is not None:
            at_ns = raw.log_time_ns
            if contexts[raw.topic].by_log_time:
                yield raw.topic, replace(message, stamp_ns=at_ns, time_ns=at_ns), at_ns
            else:
                yield raw.topic, message, at_ns


_STAMP_DEFECTS = {
    time_order.GLITCH: "stamps contradict the order of recording; placed between their neighbours",
    time_order.DUPLICATE: "messages repeat a stamp; kept",
    time_order.TOO_LATE: "messages {late}",
    time_order.REPEATED: "increments were recorded twice; the second of each was dropped",
}


def stamp_warnings(reader: FileReader, topic: str, counts: Counter[str]) -> list[str]:
    """One line per kind of defect among the stamps of a topic."""
    late = time_order.late_text(reader.sorter.late_s(topic))
    return [
        f"{reader.file.path}: {topic}: {counts[kind]} {text.format(late=late)}"
        for kind, text in _STAMP_DEFECTS.items()
        if counts[kind]
    ]
