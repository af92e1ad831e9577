"""A recording of any container: its topics, and their raw messages in the order of recording.

A container's module makes one pass over a file and lists the blocks of messages that can be read
(`Piece`), and reads a block again when its messages are wanted. A recording has one piece, or
several that follow each other (split bags). What a message is made of is known to `translations`.
"""

import hashlib
import heapq
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise, starmap
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from graphslam.logs.container_files import changed
from graphslam.logs.translations import Translate, translation

_T = TypeVar("_T")

#: files that are open at once while blocks that overlap in time are merged
_MAX_OPEN = 16
#: most messages of a block that is not given by the file itself, so that a block is never large
MAX_BLOCK = 1000


class RawMessage(NamedTuple):
    """One message: topic, time of recording and encoded bytes, see `RawTopic`."""

    topic: str
    log_time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True, order=True)
class RawTopic:
    """A topic of a recording: schema name, encoding and number of readable messages.

    What can be decoded is ``cdr`` with the name of a ROS 2 schema, however it was recorded.
    """

    name: str
    schema: str
    encoding: str
    count: int


class Channel(NamedTuple):
    """A source of messages in a file: topic, schema and encoding as recorded."""

    topic: str
    schema: str
    encoding: str


@dataclass(frozen=True, slots=True)
class Block:
    """Messages that are read together: a chunk, or messages in a row.

    ``offset`` and ``end`` are bytes or row numbers, as the container counts. ``counts``: number of
    messages by channel.
    """

    offset: int
    end: int
    start_ns: int
    end_ns: int
    counts: Mapping[int, int]


#: channel, log time ns and data of the messages of the wanted channels in a block
ReadBlock = Callable[[Block, Collection[int]], Iterator[tuple[int, int, bytes]]]


@dataclass(frozen=True, slots=True)
class Piece:
    """Index of one file from one pass over it.

    ``lost`` is the number of messages that cannot be read, None if the file is damaged and does not
    say how many there were. ``damage`` describes the damage in one line, empty if there is none.
    ``in_order``: log times never decrease in file order. ``open`` opens the file to read blocks.
    """

    path: Path
    sha256: str
    channels: Mapping[int, Channel] = field(repr=False)
    blocks: tuple[Block, ...] = field(repr=False)
    in_order: bool
    lost: int | None
    damage: str
    open: Callable[["Piece"], AbstractContextManager[ReadBlock]] = field(repr=False)
    notes: Mapping[str, str] = field(default_factory=dict)

    @property
    def messages(self) -> int:
        """Number of readable messages."""
        counts = (block.counts.items() for block in self.blocks)
        return sum(n for items in counts for number, n in items if number in self.channels)

    @property
    def start_ns(self) -> int:
        """Earliest log time; 0 without messages."""
        return min((block.start_ns for block in self.blocks), default=0)

    @property
    def end_ns(self) -> int:
        """Latest log time; 0 without messages."""
        return max((block.end_ns for block in self.blocks), default=0)


@dataclass(frozen=True, slots=True)
class Derived:
    """A topic made of another one, ``source``.

    ``make(*arguments)`` begins a reading: it gives what turns each message of the source, with its
    log time, in their order, into messages of this topic.
    """

    name: str
    schema: str
    source: str
    count: int
    make: Callable[..., Callable[[bytes, int], Sequence[bytes]]]
    arguments: tuple[Any, ...]


@dataclass(frozen=True)
class Recording:
    """Pieces in the order of time; ``path`` is the file or the folder that holds them.

    ``damage`` of the whole is in one line; ``pieces_lost`` says which pieces are missing.
    ``derived``: topics that are made of others.
    """

    path: Path
    pieces: tuple[Piece, ...]
    pieces_lost: str = ""
    derived: tuple[Derived, ...] = ()

    @cached_property
    def sha256(self) -> str:
        """Of the file; of several, that of their digests one after the other."""
        if len(self.pieces) == 1:
            return self.pieces[0].sha256
        return hashlib.sha256("".join(p.sha256 for p in self.pieces).encode()).hexdigest()

    @cached_property
    def messages(self) -> int:
        """Number of readable messages."""
        return sum(piece.messages for piece in self.pieces)

    @property
    def lost(self) -> int | None:
        """Number of lost messages, None if it is not known."""
        if self.pieces_lost:
            return None
        known = [piece.lost for piece in self.pieces if piece.lost is not None]
        return sum(known) if len(known) == len(self.pieces) else None

    @property
    def damage(self) -> str:
        """What is damaged, in one line; empty if nothing is."""
        several = len(self.pieces) > 1
        told = [f"{p.path.name}: " * several + p.damage for p in self.pieces if p.damage]
        return "; ".join([*([self.pieces_lost] if self.pieces_lost else []), *told])

    @property
    def notes(self) -> Mapping[str, str]:
        """Notes in the files; of notes with the same key that of the last file."""
        return {key: note for piece in self.pieces for key, note in piece.notes.items()}

    @property
    def in_order(self) -> bool:
        """Whether log times never decrease from message to message."""
        follow = all(a.end_ns <= b.start_ns for a, b in pairwise(self.pieces))
        return follow and all(piece.in_order for piece in self.pieces)

    @cached_property
    def topics(self) -> tuple[RawTopic, ...]:
        """All topics, sorted by name, translated where that is possible."""
        counts: Counter[str] = Counter()
        kinds: dict[str, tuple[str, str]] = {}
        for piece in self.pieces:
            read = Counter[int]()
            for block in piece.blocks:
                read.update(block.counts)
            for number, (topic, schema, encoding) in piece.channels.items():
                counts[topic] += read[number]
                found = translation(schema, encoding)
                kinds.setdefault(topic, (found.schema, "cdr") if found else (schema, encoding))
        topics = [RawTopic(name, *kinds[name], counts[name]) for name in kinds]
        topics += [RawTopic(d.name, d.schema, "cdr", d.count) for d in self.derived]
        return tuple(sorted(topics))

    def source_of(self, topic: str) -> str:
        """The recorded topic that a topic is made of: itself, if it is not derived."""
        return next((one.source for one in self.derived if one.name == topic), topic)

    def span_ns(self, topic: str) -> tuple[int, int] | None:
        """Log times between which the messages of a topic lie; None if it has none."""
        source = self.source_of(topic)
        spans = [
            (block.start_ns, block.end_ns)
            for piece in self.pieces
            for block in piece.blocks
            if any(piece.channels[n].topic == source for n in block.counts if n in piece.channels)
        ]
        return (min(a for a, _ in spans), max(b for _, b in spans)) if spans else None

    def with_derived(self, derived: Derived) -> "Recording":
        """The recording with one more topic."""
        return replace(self, derived=(*self.derived, derived))


def count_undescribed(blocks: Sequence[Block], channels: Mapping[int, Channel]) -> int:
    """How many messages are on channels that the file does not describe.

    Nobody can tell what such messages are, so they are lost.
    """
    return sum(n for b in blocks for number, n in b.counts.items() if number not in channels)


def undescribed(count: int) -> list[str]:
    """What to say of messages that `count_undescribed` found."""
    return [f"{count} messages are on channels that it does not describe"] if count else []


class BlockList:
    """Blocks of a file as they are found, in its order."""

    def __init__(self) -> None:
        self.blocks: list[Block] = []
        self.in_order, self._latest_ns = True, -1

    def add(self, offset: int, end: int, channels: ArrayLike, times_ns: ArrayLike) -> None:
        """Add a block of messages (n), given by channel and log time; none is no block."""
        times = np.asarray(times_ns)
        if not times.size:
            return
        numbers, counts = np.unique(np.asarray(channels), return_counts=True)
        first, last = int(times.min()), int(times.max())
        self.in_order &= self._latest_ns <= int(times[0]) and bool((times[1:] >= times[:-1]).all())
        self._latest_ns = max(self._latest_ns, last)
        counted = dict(zip(numbers.tolist(), counts.tolist(), strict=True))
        self.blocks.append(Block(offset, end, first, last, counted))


def raw_messages(recording: Recording, topics: Collection[str]) -> Iterator[RawMessage]:
    """Messages of ``topics`` in the order of recording.

    This is the order of the file if its log times never decrease, else that of the log times.
    Memory holds the blocks that overlap in log time, a single one if the file is in order.
    """
    derived = [one for one in recording.derived if one.name in topics]
    if not derived:
        yield from _recorded(recording, topics)
        return
    wanted = {*topics} | {one.source for one in derived}
    make = deriver(derived, topics)
    for raw in _recorded(recording, wanted):
        yield from make(raw)


def data_of_topics(recording: Recording, topics: Collection[str]) -> dict[str, list[bytes]]:
    """Data of all messages of each topic that has any, in the order of recording.

    What `raw_messages` gives, all at once: for topics without large messages.
    """
    found: dict[str, list[bytes]] = defaultdict(list)
    if not recording.in_order or any(one.name in topics for one in recording.derived):
        for raw in raw_messages(recording, topics):
            found[raw.topic].append(raw.data)
        return found
    with _Reader(topics) as reader:
        for piece in recording.pieces:
            for block in piece.blocks:
                if reader.has_any(piece, block):
                    reader.collect(piece, block, found)
    return found


def deriver(
    derived: Sequence[Derived], topics: Collection[str]
) -> Callable[[RawMessage], Iterator[RawMessage]]:
    """What gives the messages of ``topics`` for a message of any: made of it, and it itself."""
    makers = [(one, one.make(*one.arguments)) for one in derived]

    def messages_for(raw: RawMessage) -> Iterator[RawMessage]:
        for one, make in makers:
            if one.source == raw.topic:
                for data in make(raw.data, raw.log_time_ns):
                    yield RawMessage(one.name, raw.log_time_ns, data)
        if raw.topic in topics:
            yield raw

    return messages_for


def _recorded(recording: Recording, topics: Collection[str]) -> Iterator[RawMessage]:
    blocks = [(p, b) for p in recording.pieces for b in p.blocks]
    with _Reader(topics) as reader:
        blocks = [(piece, block) for piece, block in blocks if reader.has_any(piece, block)]
        if recording.in_order:
            for piece, block in blocks:
                yield from reader.read(piece, block)
        else:
            yield from _by_log_time(reader, blocks)


def messages_between(
    recording: Recording, topic: str, begin_ns: int, end_ns: int
) -> Iterator[RawMessage]:
    """Messages of a recorded ``topic`` with log times in an interval; other blocks are not read.

    Of a derived topic they are those of its source.
    """
    with _Reader((recording.source_of(topic),)) as reader:
        for piece in recording.pieces:
            for block in piece.blocks:
                apart = block.end_ns < begin_ns or block.start_ns > end_ns
                if not apart and reader.has_any(piece, block):
                    for raw in reader.read(piece, block):
                        if begin_ns <= raw.log_time_ns <= end_ns:
                            yield raw


def first_and_last(recording: Recording, topic: str) -> list[RawMessage]:
    """Messages of a recorded ``topic`` in the first and in the last block that has any."""
    with _Reader((topic,)) as reader:
        having = [(p, b) for p in recording.pieces for b in p.blocks if reader.has_any(p, b)]
        if not having:
            return []
        ends = min(having, key=lambda x: x[1].start_ns), max(having, key=lambda x: x[1].end_ns)
        return [raw for piece, block in ends for raw in reader.read(piece, block)]


def sample_messages(
    recording: Recording, topic: str, blocks: int, per_block: int
) -> Iterator[bytes]:
    """Data of about ``blocks * per_block`` messages of ``topic``, spread evenly over the file."""
    for derived in recording.derived:
        if derived.name == topic:
            make = derived.make(*derived.arguments)
            for raw in _sampled(recording, derived.source, blocks, per_block):
                yield from make(raw.data, raw.log_time_ns)
            return
    yield from (raw.data for raw in _sampled(recording, topic, blocks, per_block))


def _sampled(recording: Recording, topic: str, blocks: int, per_block: int) -> Iterator[RawMessage]:
    with _Reader((topic,)) as reader:
        holding = [(p, b) for p in recording.pieces for b in p.blocks if reader.has_any(p, b)]
        for piece, block in _spread(holding, blocks):
            yield from reader.sample(piece, block, per_block)


def _spread(items: Sequence[_T], n: int) -> Sequence[_T]:
    """At most ``n`` of the items, evenly spaced."""
    return items[:: max(1, -(-len(items) // n))]


class _Reader:
    """Reads blocks of several files, of which the latest stay open; a context manager."""

    def __init__(self, topics: Collection[str]) -> None:
        self._topics = topics
        self._wanted: dict[Path, dict[int, tuple[str, Translate | None]]] = {}
        self._open: dict[Path, tuple[ReadBlock, ExitStack]] = {}

    def __enter__(self) -> "_Reader":
        return self

    def __exit__(self, *error: object) -> None:
        for _, stack in self._open.values():
            stack.close()

    def has_any(self, piece: Piece, block: Block) -> bool:
        """Whether there are messages of the topics in ``block``."""
        if piece.path not in self._wanted:
            self._wanted[piece.path] = {
                number: (channel.topic, found.translate if found else None)
                for number, channel in piece.channels.items()
                if channel.topic in self._topics
                for found in (translation(channel.schema, channel.encoding),)
            }
        return not self._wanted[piece.path].keys().isdisjoint(block.counts)

    def read(self, piece: Piece, block: Block) -> Iterator[RawMessage]:
        """The messages of the topics in ``block``, translated."""
        return starmap(self._translated(piece), self._read(piece, block))

    def collect(self, piece: Piece, block: Block, found: Mapping[str, list[bytes]]) -> None:
        """Add the data of the messages of the topics in ``block`` to the lists ``found``."""
        wanted = self._wanted[piece.path]
        for number, _, data in self._read(piece, block):
            topic, translate = wanted[number]
            found[topic].append(translate(data) if translate else data)

    def sample(self, piece: Piece, block: Block, n: int) -> Iterator[RawMessage]:
        """At most ``n`` of them, evenly spaced; only these are translated."""
        found = _spread(list(self._read(piece, block)), n)
        return starmap(self._translated(piece), found)

    def _read(self, piece: Piece, block: Block) -> Iterator[tuple[int, int, bytes]]:
        wanted = self._wanted[piece.path]
        if piece.path not in self._open:
            while len(self._open) >= _MAX_OPEN:
                self._open.pop(next(iter(self._open)))[1].close()
            stack = ExitStack()
            read: ReadBlock = stack.enter_context(piece.open(piece))
            self._open[piece.path] = read, stack
        missing = sum(n for number, n in block.counts.items() if number in wanted)
        for message in self._open[piece.path][0](block, wanted.keys()):
            missing -= 1
            yield message
        if missing:
            raise changed(piece.path)

    def _translated(self, piece: Piece) -> Callable[[int, int, bytes], RawMessage]:
        wanted = self._wanted[piece.path]

        def translated(channel: int, log_time_ns: int, data: bytes) -> RawMessage:
            topic, translate = wanted[channel]
            return RawMessage(topic, log_time_ns, translate(data) if translate else data)

        return translated


def _by_log_time(reader: _Reader, blocks: list[tuple[Piece, Block]]) -> Iterator[RawMessage]:
    """Merge blocks that overlap in log time; equal times keep the order of the file."""
    heap: list[tuple[int, int, int, RawMessage]] = []
    # a stable sort: equal times keep the order of pieces and blocks
    for number, (piece, block) in enumerate(sorted(blocks, key=lambda b: b[1].start_ns)):
        while heap and heap[0][0] < block.start_ns:
            yield heapq.heappop(heap)[3]
        for position, raw in enumerate(reader.read(piece, block)):
            heapq.heappush(heap, (raw.log_time_ns, number, position, raw))
    while heap:
        yield heapq.heappop(heap)[3]


def one_line(error: Exception) -> str:
    """Text of an error in one line; its type if it has no text."""
    return " ".join(str(error).split()) or type(error).__name__
