"""Logs opened together: what robots they hold, and their messages in the order of time."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from graphslam.core import records
from graphslam.core.config import Config
from graphslam.core.errors import LogError
from graphslam.core.records import Message
from graphslam.core.worker import Prefetch
from graphslam.logs import schemas, time_order
from graphslam.logs.decoders import DECODERS, TopicContext, UnusableMessageError
from graphslam.logs.future_stamps import Recorded, repair_future_stamps
from graphslam.logs.mcap_file import McapFile, RawMessage, open_mcap, raw_messages
from graphslam.logs.topic_context import topic_contexts
from graphslam.logs.topics import ODOMETRY_KINDS, Topic, choose_topics, find_topics

#: messages that are worth a second process to read them
WORKER_MIN_MESSAGES = 10_000


@dataclass(frozen=True, slots=True)
class LogFile:
    """One file of a `LogSet`: ``messages`` read of all topics, ``lost`` None when unknown."""

    path: Path
    sha256: str
    messages: int
    lost: int | None


@dataclass
class LogSet:
    """Logs that belong together.

    Attributes:
        robots: names of the robots with odometry, sorted.
        files: what each file held.
        topics: the topics that are used.
        notes: the metadata record `graphslam` of the files, for example that stamps are invented.
        warnings: what had to be assumed or is wrong, one line each; `messages` adds to it when it
            has come to its end.
        dropped: number of messages (or single beams, reasons that begin with ``range:``) that
            were dropped, by reason; filled when `messages` has come to its end.
        repaired: the same for messages that are used although something was odd.
    """

    robots: tuple[str, ...]
    files: tuple[LogFile, ...]
    topics: tuple[Topic, ...]
    notes: Mapping[str, str]
    warnings: list[str]
    dropped: Counter[str]
    repaired: Counter[str]
    _mcap: Sequence[McapFile] = field(repr=False)
    _contexts: Mapping[str, TopicContext] = field(repr=False)
    _window_ns: int

    def __post_init__(self) -> None:
        self._opening_warnings = len(self.warnings)

    @property
    def opened(self) -> Sequence[McapFile]:
        """The files as they were opened, in the order of ``files``."""
        return self._mcap

    def has_scans(self, robot: str) -> bool:
        """Whether the logs hold laser scans of ``robot``."""
        return any(t.robot == robot and t.record is records.Scan for t in self.topics)

    def no_return_m(self, topic: str) -> float:
        """Range from which on a beam of ``topic`` means no return, m; inf when none was found."""
        return self._contexts[topic].no_return_m

    def count(self, without: tuple[type[Message], ...] = ()) -> int:
        """How many messages the files hold of all topics but those of the records ``without``."""
        return sum(topic.count for topic in self.topics if topic.record not in without)

    def messages(
        self, without: tuple[type[Message], ...] = (), *, ahead: bool = False
    ) -> Iterator[Message]:
        """All messages in the order of ``time_ns``; at equal times odometry comes first.

        Topics of the records ``without`` are passed over, which saves decoding them. Memory holds
        what falls into ``logs.reorder_s``, not the log. Every call starts anew. ``ahead``: a second
        process may read them, which pays where all are taken and something is done with them.
        """
        topics = {topic.name: topic for topic in self.topics if topic.record not in without}
        self._tell(_Told(Counter(), Counter(), []))
        ahead &= self.count(without) >= WORKER_MIN_MESSAGES
        for item in Prefetch(lambda: self._read(topics)) if ahead else self._read(topics):
            if isinstance(item, _Told):
                self._tell(item)
            else:
                yield item

    def _read(self, topics: Mapping[str, Topic]) -> Iterator["Message | _Told"]:
        """Messages of ``topics`` and, last, what `messages` adds to the attributes."""
        readers = [
            _FileReader(file, topics, self._contexts, self._window_ns) for file in self._mcap
        ]
        yield from time_order.merge([reader.messages() for reader in readers])
        told = _Told(Counter(), Counter(), [])
        for file, reader in zip(self._mcap, readers, strict=True):
            told.dropped.update(reader.dropped)
            for topic, counts in sorted(reader.line.counts.items()):
                told.warnings.extend(_warn_of_stamps(file, topic, counts))
                told.dropped[time_order.TOO_LATE] += counts.pop(time_order.TOO_LATE, 0)
                told.repaired.update(counts)
        yield told

    def _tell(self, told: "_Told") -> None:
        for counter, counts in ((self.dropped, told.dropped), (self.repaired, told.repaired)):
            counter.clear()
            counter.update(+counts)  # without zeros
        self.warnings[self._opening_warnings :] = told.warnings


@dataclass(frozen=True, slots=True)
class _Told:
    """What is known when all messages were read; see `LogSet`."""

    dropped: Counter[str]
    repaired: Counter[str]
    warnings: list[str]


def open_logs(paths: Sequence[Path], config: Config) -> LogSet:
    """Open ``paths`` (MCAP files) as one log and find out what is in it.

    Raises:
        LogError: a file is missing, not MCAP or empty; no topic is usable; all usable topics are
            empty; a robot has scans but no odometry. The message names file and topic.
    """
    if not paths:
        raise LogError("no log given; name at least one .mcap file")
    files = [open_mcap(Path(path)) for path in paths]
    for n, file in enumerate(files):
        if file.sha256 in {other.sha256 for other in files[:n]}:
            raise LogError(f"{file.path}: is given twice; each log counts once")
    topics, warnings = choose_topics(files, find_topics(files, config))
    contexts, assumed = topic_contexts(files, topics, config)
    notes: dict[str, str] = {}
    for file in files:
        notes |= file.notes
    return LogSet(
        robots=tuple(sorted({t.robot for t in topics if t.record in ODOMETRY_KINDS})),
        files=tuple(LogFile(f.path, f.sha256, f.messages, f.lost) for f in files),
        topics=tuple(topics),
        notes=notes,
        warnings=[
            *config.warnings,
            *(describe_damage(file) for file in files if file.damage),
            *warnings,
            *assumed,
        ],
        dropped=Counter(),
        repaired=Counter(),
        _mcap=files,
        _contexts=contexts,
        _window_ns=round(config.logs.reorder_s * 1e9),
    )


def decode_message(
    raw: RawMessage, topic: Topic, context: TopicContext, dropped: Counter[str]
) -> Message | None:
    """The record in one raw message; None, and the reason counted, when it must be dropped."""
    try:
        _, decode, read = DECODERS[topic.schema]
        return decode(read(raw.data) if read else schemas.decode(topic.schema, raw.data), context)
    except UnusableMessageError as reason:
        dropped[str(reason)] += 1
    except schemas.CdrError:
        dropped[f"{topic.schema}: cannot be decoded"] += 1
    return None


class _FileReader:
    """One pass over the messages of one file."""

    def __init__(
        self,
        file: McapFile,
        topics: Mapping[str, Topic],
        contexts: Mapping[str, TopicContext],
        window_ns: int,
    ) -> None:
        self.dropped: Counter[str] = Counter()
        self.line = time_order.MessageSorter(window_ns)
        self._file, self._topics = file, topics
        # beams are counted by the decoders, into this pass' own counter
        self._contexts = {n: replace(c, beams=self.dropped) for n, c in contexts.items()}

    def messages(self) -> Iterator[Message]:
        """Sorted messages of this file."""
        for topic, message, _ in repair_future_stamps(self._recorded(), time_order.SAMPLED):
            yield from self.line.push(topic, message)
        yield from self.line.finish()

    def _recorded(self) -> Iterator[Recorded]:
        """Messages in the order of recording, with their topic and log time."""
        for raw in raw_messages(self._file, self._topics.keys()):
            topic, context = self._topics[raw.topic], self._contexts[raw.topic]
            message = decode_message(raw, topic, context, self.dropped)
            if message is not None:
                yield raw.topic, message, raw.log_time_ns


def _warn_of_stamps(file: McapFile, topic: str, counts: Counter[str]) -> list[str]:
    """One line per kind of oddity among the stamps of a topic."""
    where = f"{file.path}: {topic}"
    lines = []
    if counts[time_order.GLITCH]:
        lines.append(
            f"{where}: {counts[time_order.GLITCH]} stamps contradict the order of recording; "
            "placed between their neighbours"
        )
    if counts[time_order.DUPLICATE]:
        lines.append(f"{where}: {counts[time_order.DUPLICATE]} messages repeat a stamp; kept")
    if counts[time_order.TOO_LATE]:
        lines.append(
            f"{where}: {counts[time_order.TOO_LATE]} messages came too late and were dropped; "
            "raise logs.reorder_s to keep them"
        )
    return lines


def describe_damage(file: McapFile) -> str:
    """One line that says what of a damaged file is lost."""
    lost = "an unknown number of" if file.lost is None else str(file.lost)
    return (
        f"{file.path}: damaged, {lost} messages are lost, {file.messages} are read: {file.damage}"
    )
