"""Whether recordings that have the same topics were made one after the other.

Parts of a drive, or a drive and the next one, are one robot's. Different messages of one topic at
the same time are not: they are of two robots that call their topics alike, or the clock of one
recording is wrong. Read as one robot, their scans and odometry would alternate.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path

from graphslam.core.errors import LogError
from graphslam.core.record import replace
from graphslam.core.records import Sighting
from graphslam.logs.decoders import TopicContext, decode_messages
from graphslam.logs.recording import Piece, RawMessage, Recording, first_and_last, messages_between
from graphslam.logs.topics import MOTION_KINDS, Topic

#: what only one robot can have said
_OF_ONE_ROBOT = (*MOTION_KINDS, Sighting)
#: s: parts of a recording may overlap by so much, where a recorder goes on in a new file
_OVERLAP_S = 2.0
#: where in an overlap messages are compared, as shares of it; s of each place; s by which what the
#: other recording has of it may be off
_PLACES, _COMPARED_S, _MARGIN_S = (0.15, 0.5, 0.85), 5.0, 1.0
#: share of equal messages from which on both recordings are of one robot, recorded twice
_SAME = 0.5
#: ns
_SECOND = 1_000_000_000


def check_separate_times(
    files: Sequence[Recording], topics: Sequence[Topic], contexts: Mapping[str, TopicContext]
) -> None:
    """Refuse recordings, or pieces of one, in which one topic says two things at the same time.

    Times are the stamps of messages, since these place them. Of each recording the first and the
    last messages are read, and some in between of two that overlap. Pieces of one recording are
    looked at where their log times overlap. Pairs are only compared by their times.

    Raises:
        LogError: two recordings are of two robots, or their clocks are wrong; it says what to do.
    """
    wanted = [topic for topic in topics if topic.count and topic.record in _OF_ONE_ROBOT]
    known: dict[tuple[Path, str], _Stamps | None] = {}

    def stamps(file: Recording, topic: Topic) -> "_Stamps | None":
        key = file.path, topic.name
        if key not in known:
            known[key] = _Stamps.of(file, topic, contexts[topic.name])
        return known[key]

    for a, b in _pairs(files):
        for topic in wanted:
            one, other = stamps(a, topic), stamps(b, topic)
            if one is None or other is None:
                continue
            begin, end = max(one.first_ns, other.first_ns), min(one.last_ns, other.last_ns)
            if end - begin > _OVERLAP_S * _SECOND and _differ(one, other, begin, end):
                raise LogError(
                    f"{a.path} and {b.path}: both have {topic.name} during the same "
                    f"{(end - begin) / _SECOND:.0f} s, with different messages: two robots whose "
                    "topics have the same names, or a wrong clock; smooth --same-place takes each "
                    "recording for itself; other commands take them one by one (compare: --each)"
                )


def _pairs(files: Sequence[Recording]) -> Iterator[tuple[Recording, Recording]]:
    """Each two recordings, and each two pieces of one that overlap by their log times."""
    yield from combinations(files, 2)
    for file in files:
        spans = sorted((p.start_ns, p.end_ns, n) for n, p in enumerate(file.pieces))
        for k, (_, end_ns, n) in enumerate(spans):
            own = file.pieces[n]
            for begin_ns, other_end_ns, m in spans[k + 1 :]:  # in a split bag none overlaps
                if begin_ns >= end_ns:
                    break
                if min(end_ns, other_end_ns) - begin_ns > _OVERLAP_S * _SECOND:
                    yield _alone(file, own), _alone(file, file.pieces[m])


def _alone(file: Recording, piece: Piece) -> Recording:
    """A piece as a recording of its own."""
    return replace(file, path=piece.path, pieces=(piece,))


class _Stamps:
    """The messages of a topic in a recording by their stamps, from ``first_ns`` to ``last_ns``.

    Log times are taken to be ahead of stamps by what they are in the first message.
    """

    def __init__(self, file: Recording, topic: str, first_ns: int, last_ns: int, ahead: int):
        self.first_ns, self.last_ns = first_ns, last_ns
        self._file, self._topic, self._ahead_ns = file, topic, ahead

    @classmethod
    def of(cls, file: Recording, topic: Topic, context: TopicContext) -> "_Stamps | None":
        """None if the recording has no message of the topic that can be read."""
        span = file.span_ns(topic.name)
        if span is None:
            return None
        begin, end = span
        if context.by_log_time or file.source_of(topic.name) != topic.name:
            return cls(file, topic.name, begin, end, 0)
        read = first_and_last(file, topic.name)
        known = _stamps(read, topic, context) if read else []
        if not known:
            return None
        (first_ns, log_ns), (last_ns, _) = min(known), max(known)
        return cls(file, topic.name, first_ns, last_ns, log_ns - first_ns)

    def between(self, begin_ns: int, end_ns: int) -> set[bytes]:
        """Different messages with stamps in an interval."""
        ahead = self._ahead_ns
        found = messages_between(self._file, self._topic, begin_ns + ahead, end_ns + ahead)
        return {raw.data for raw in found}


def _stamps(
    raw: Sequence[RawMessage], topic: Topic, context: TopicContext
) -> list[tuple[int, int]]:
    """Stamp and log time of those messages (at least one) that can be read."""
    made = decode_messages(
        topic.schema, [one.data for one in raw], replace(context, beams=Counter()), Counter()
    )
    pairs = zip(made, raw, strict=True)
    return [(message.stamp_ns, one.log_time_ns) for message, one in pairs if message is not None]


def _differ(a: _Stamps, b: _Stamps, begin_ns: int, end_ns: int) -> bool:
    """Whether two recordings have different messages of a topic, as far as is looked at."""
    margin = round(_MARGIN_S * _SECOND)
    shares = []
    for place in _PLACES:
        half = min(round(_COMPARED_S * _SECOND), end_ns - begin_ns) // 2
        middle = begin_ns + round(place * (end_ns - begin_ns))
        first, last = middle - half, middle + half
        for one, other in ((a, b), (b, a)):
            own, there = one.between(first, last), other.between(first - margin, last + margin)
            if own and there:
                shares.append(len(own & there) / len(own))
    # a recording that lacks messages has only those that the other one has
    return bool(shares) and max(shares) < _SAME
