"""Raw messages of one MCAP file in the order of recording, also if the file is damaged.

The file's own summary is not trusted: one pass over the data section lists the blocks of messages
that are readable, with their CRCs checked. From a file that was cut off, has flipped bits or lacks
a summary everything readable is recovered, and lost messages are counted. The only module that
reads with `mcap`.
"""

import hashlib
import heapq
import struct
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from io import SEEK_CUR, BufferedReader, BytesIO
from itertools import islice, pairwise
from pathlib import Path
from typing import BinaryIO, NamedTuple, TypeVar

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema, Statistics
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.summary import Summary

from graphslam.core.errors import LogError

_T = TypeVar("_T")

MAGIC = b"\x89MCAP0\r\n"
NOTES = "graphslam"  # name of the metadata record in which our own logs carry notes

# Errors that mcap, zstandard and lz4 raise on damaged bytes, found by flipping and cutting: their
# own, and those of the standard library for an invalid length, id or string.
_DAMAGE = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    KeyError,
    TypeError,
    RuntimeError,
    MemoryError,
    OverflowError,
    EOFError,
)
# Head of every record (opcode, length), and head of a message: the same, channel, sequence number,
# log time, publish time; then its data.
_RECORD, _MESSAGE = struct.Struct("<BQ"), struct.Struct("<BQHIQQ")
# int: comparing with the enum is slow
_IS_MESSAGE = int(Opcode.MESSAGE)
# Messages outside chunks form blocks of at most this many, so that a block is never large.
_MAX_LOOSE_BLOCK = 1000


class RawMessage(NamedTuple):
    """One message as recorded: topic, time of recording and encoded bytes."""

    topic: str
    log_time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True, order=True)
class RawTopic:
    """A topic of one file: schema name, message encoding and number of readable messages."""

    name: str
    schema: str
    encoding: str
    count: int


@dataclass(frozen=True, slots=True)
class _Block:
    """A readable chunk, or a run of messages outside chunks."""

    offset: int
    start_ns: int
    end_ns: int
    counts: Mapping[int, int]  # channel id -> messages


@dataclass(frozen=True, slots=True)
class McapFile:
    """Index of an MCAP file from one pass over it; `raw_messages` reads it again.

    ``lost`` is the number of messages that cannot be read, None if the file is damaged and does not
    say how many there were. ``damage`` describes the damage in one line, empty if there is none.
    ``in_order``: log times never decrease in file order.
    """

    path: Path
    sha256: str
    topics: tuple[RawTopic, ...]
    messages: int
    lost: int | None
    damage: str
    notes: Mapping[str, str]
    in_order: bool
    blocks: tuple[_Block, ...] = field(repr=False)
    channels: Mapping[int, str] = field(repr=False)  # id -> topic


def open_mcap(path: Path) -> McapFile:
    """Read through ``path`` once and index it.

    Raises:
        LogError: no such file, a directory, unreadable, not MCAP, or without any message.
    """
    try:
        if path.is_dir():
            raise LogError(f"{path}: is a directory; name the .mcap files in it")
        with path.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                raise LogError(
                    f"{path}: is not an MCAP file; `graphslam import` turns other formats into MCAP"
                )
            file = _Indexer(path, stream).run()
    except FileNotFoundError as error:
        raise LogError(f"{path}: no such file; check the path") from error
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}; check the file") from error
    if not file.messages:
        why = f"no message can be read: {file.damage}" if file.damage else "is an empty log"
        raise LogError(f"{path}: {why}; record it again or name another file")
    return file


def raw_messages(file: McapFile, topics: Collection[str]) -> Iterator[RawMessage]:
    """Messages of ``topics`` in the order of recording.

    This is the order of the file if its log times never decrease, else that of the log times.
    Memory holds the blocks that overlap in log time, a single one if the file is in order.
    """
    wanted = {number for number, topic in file.channels.items() if topic in topics}
    blocks = [block for block in file.blocks if not wanted.isdisjoint(block.counts)]
    with file.path.open("rb") as stream:
        if file.in_order:
            for block in blocks:
                for channel, log_time_ns, data in _block_messages(stream, block, wanted):
                    yield RawMessage(file.channels[channel], log_time_ns, data)
        else:
            yield from _by_log_time(file, stream, blocks, wanted)


def sample_messages(file: McapFile, topic: str, blocks: int, per_block: int) -> Iterator[bytes]:
    """Data of about ``blocks * per_block`` messages of ``topic``, spread evenly over the file."""
    numbers = {number for number, name in file.channels.items() if name == topic}
    holding = [b for b in file.blocks if not numbers.isdisjoint(b.counts)]
    with file.path.open("rb") as stream:
        for block in _spread(holding, blocks):
            found = [data for _, _, data in _block_messages(stream, block, numbers)]
            yield from _spread(found, per_block)


def _spread(items: Sequence[_T], n: int) -> Sequence[_T]:
    """At most ``n`` of the items, evenly spaced."""
    return items[:: max(1, -(-len(items) // n))]


def _by_log_time(
    file: McapFile, stream: BinaryIO, blocks: list[_Block], wanted: Collection[int]
) -> Iterator[RawMessage]:
    """Merge blocks that overlap in log time; equal times keep the order of the file."""
    heap: list[tuple[int, int, int, int, bytes]] = []

    def earliest() -> RawMessage:
        log_time_ns, _, _, channel, data = heapq.heappop(heap)
        return RawMessage(file.channels[channel], log_time_ns, data)

    for number, block in enumerate(sorted(blocks, key=lambda b: (b.start_ns, b.offset))):
        while heap and heap[0][0] < block.start_ns:
            yield earliest()
        for position, message in enumerate(_block_messages(stream, block, wanted)):
            channel, log_time_ns, data = message
            heapq.heappush(heap, (log_time_ns, number, position, channel, data))
    while heap:
        yield earliest()


# ---------------------------------------------------------------- blocks


def _records(stream: BinaryIO, offset: int, limit: int) -> Iterator[tuple[int, McapRecord]]:
    """Offset and record, chunks unopened, from ``offset`` to the footer or to the first damage."""
    stream.seek(offset)
    reader = StreamReader(stream, skip_magic=True, emit_chunks=True, record_size_limit=limit)
    for record in reader.records:
        yield offset, record
        offset = _after_indexes(stream)


def _after_indexes(stream: BinaryIO) -> int:
    """Skip message indexes, which are not needed and take longest to read; the new offset."""
    while True:
        offset = stream.tell()
        head = stream.read(_RECORD.size)
        if len(head) < _RECORD.size or head[0] != Opcode.MESSAGE_INDEX:
            return stream.seek(offset)
        stream.seek(_RECORD.unpack(head)[1], SEEK_CUR)


class _Contents(NamedTuple):
    """Contents of a chunk: its bytes, messages, and schemas and channels (``others``).

    A message is (channel, log time ns, begin and end of its data in the bytes).
    """

    data: bytes
    messages: list[tuple[int, int, int, int]]
    others: list[McapRecord]


def _chunk_at(stream: BinaryIO, offset: int) -> _Contents:
    """The records in the chunk at ``offset``; if the file ends inside it, those before the end.

    Raises:
        One of `_DAMAGE` when the chunk is damaged in any other way, its CRC included.
    """
    stream.seek(offset)
    head = stream.read(_RECORD.size)
    if len(head) < _RECORD.size or head[0] != Opcode.CHUNK:
        raise McapError("no chunk where the index has one")
    length = _RECORD.unpack(head)[1]
    body = stream.read(length)
    chunk = Chunk.read(ReadDataStream(BytesIO(body)))
    return _records_in(chunk) if len(body) == length else _cut_chunk(chunk)


def _records_in(chunk: Chunk) -> _Contents:
    """The schemas, channels and messages in a chunk.

    Like mcap's ``breakup_chunk``, but without an object per message, which would be slow.

    Raises:
        One of `_DAMAGE` when the chunk is damaged, its CRC included.
    """
    stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    # padded, because the head of a message is unpacked from every record, also from shorter ones
    data = stream.read(size) + bytes(_MESSAGE.size)
    found = _Contents(data, [], [])
    begin = 0
    while begin < size:
        opcode, length, channel, _, log_time_ns, _ = _MESSAGE.unpack_from(data, begin)
        inside, end = begin + _RECORD.size, begin + _RECORD.size + length
        if end > size:
            raise McapError("a record reaches beyond its chunk")
        if opcode == _IS_MESSAGE:
            if end < begin + _MESSAGE.size:
                raise McapError("a message is shorter than its head")
            found.messages.append((channel, log_time_ns, begin + _MESSAGE.size, end))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            kind = Schema if opcode == Opcode.SCHEMA else Channel
            found.others.append(kind.read(ReadDataStream(BytesIO(data[inside:end]))))
        begin = end
    return found


def _cut_chunk(chunk: Chunk) -> _Contents:
    """Complete records at the beginning of a chunk whose end is missing."""
    data = chunk.data
    if chunk.compression == "zstd":
        data = zstandard.ZstdDecompressor().decompressobj().decompress(data)
    elif chunk.compression:
        raise McapError(f"the beginning of a {chunk.compression} chunk cannot be read")
    end = 0
    while end + 9 <= len(data):
        length = int.from_bytes(data[end + 1 : end + 9], "little")
        if end + 9 + length > len(data):
            break
        end += 9 + length
    return _records_in(Chunk("", data[:end], 0, 0, 0, end))


def _block_messages(
    stream: BinaryIO, block: _Block, wanted: Collection[int]
) -> Iterator[tuple[int, int, bytes]]:
    """Channel, log time ns and data of the messages of wanted channels in a block."""
    stream.seek(block.offset)
    if stream.read(1)[0] == Opcode.CHUNK:
        data, messages, _ = _chunk_at(stream, block.offset)
        for channel, log_time_ns, begin, end in messages:
            if channel in wanted:
                yield channel, log_time_ns, data[begin:end]
        return
    count = sum(block.counts.values())
    loose = (r for _, r in _records(stream, block.offset, 1 << 40) if isinstance(r, Message))
    for message in islice(loose, count):
        if message.channel_id in wanted:
            yield message.channel_id, message.log_time, message.data


class _Indexer:
    """One pass over a file: `run` does it, the other methods are its steps."""

    def __init__(self, path: Path, stream: BufferedReader) -> None:
        self.path, self.stream = path, stream
        self.size = path.stat().st_size
        self.position = len(MAGIC)  # where the next record begins
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.blocks: list[_Block] = []
        self.loose: list[tuple[int, Message]] = []
        self.damage: list[str] = []
        self.statistics: Statistics | None = None
        self.notes: dict[str, str] = {}
        self.tried: set[int] = set()  # offsets of chunks
        self.in_order, self.latest_ns = True, -1

    def run(self) -> McapFile:
        try:
            for offset, record in _records(self.stream, self.position, self.size):
                self.add(offset, record)
                self.position = self.stream.tell()
        except _DAMAGE as error:
            self.recover(error)
        self.close_loose_block()
        return self.result()

    def add(self, offset: int, record: McapRecord) -> None:
        if isinstance(record, Message):
            self.loose.append((offset, record))
            if len(self.loose) == _MAX_LOOSE_BLOCK:
                self.close_loose_block()
        elif isinstance(record, Chunk):
            self.close_loose_block()
            self.tried.add(offset)
            try:
                self.add_chunk(offset, _records_in(record))
            except _DAMAGE as error:
                self.damage.append(f"the chunk at byte {offset} is damaged ({_one_line(error)})")
        elif isinstance(record, Statistics):
            self.statistics = record
        elif isinstance(record, Metadata) and record.name == NOTES:
            self.notes.update(record.metadata)
        else:
            self.describe(record)

    def describe(self, record: McapRecord) -> None:
        if isinstance(record, Schema):
            self.schemas.setdefault(record.id, record)
        elif isinstance(record, Channel):
            self.channels.setdefault(record.id, record)

    def add_chunk(self, offset: int, found: _Contents) -> None:
        for record in found.others:
            self.describe(record)
        if found.messages:
            self.add_block(offset, [message[:2] for message in found.messages])

    def add_block(self, offset: int, messages: Sequence[tuple[int, int]]) -> None:
        """Add a block of messages, given by channel and log time; at least one."""
        channels, times = zip(*messages, strict=True)
        self.in_order &= all(a <= b for a, b in pairwise((self.latest_ns, *times)))
        self.latest_ns = max(self.latest_ns, *times)
        self.blocks.append(_Block(offset, min(times), max(times), dict(Counter(channels))))

    def close_loose_block(self) -> None:
        if self.loose:
            messages = [(message.channel_id, message.log_time) for _, message in self.loose]
            self.add_block(self.loose[0][0], messages)
            self.loose = []

    def recover(self, error: Exception) -> None:
        """Index the chunks after the offset at which sequential reading failed."""
        self.close_loose_block()
        self.damage.append(
            f"it cannot be read from byte {self.position} of {self.size} ({_one_line(error)})"
        )
        offsets = [self.position]
        summary = self.summary()
        if summary is not None:
            self.statistics = self.statistics or summary.statistics
            for record in (*summary.schemas.values(), *summary.channels.values()):
                self.describe(record)
            offsets += [index.chunk_start_offset for index in summary.chunk_indexes]
        for offset in sorted(set(offsets) - self.tried):
            try:
                self.add_chunk(offset, _chunk_at(self.stream, offset))
            except _DAMAGE:
                continue  # lost; counted by the statistics record, if there is one

    def summary(self) -> Summary | None:
        try:
            self.stream.seek(0)
            return SeekingReader(self.stream, record_size_limit=self.size).get_summary()
        except (*_DAMAGE, OSError, StopIteration):  # OSError: a seek to before the beginning
            return None

    def result(self) -> McapFile:
        counts: Counter[int] = Counter()
        for block in self.blocks:
            counts.update(block.counts)
        known = {n: c for n, c in self.channels.items() if c.schema_id in self.schemas}
        per_topic: Counter[str] = Counter()
        for number, channel in known.items():
            per_topic[channel.topic] += counts[number]
        topics = {
            c.topic: RawTopic(
                c.topic, self.schemas[c.schema_id].name, c.message_encoding, per_topic[c.topic]
            )
            for c in known.values()
        }
        messages = sum(counts.values())
        self.stream.seek(0)
        lost: int | None = None if self.damage else 0
        if self.statistics is not None:
            lost = max(0, self.statistics.message_count - messages)
        return McapFile(
            path=self.path,
            sha256=hashlib.file_digest(self.stream, "sha256").hexdigest(),
            topics=tuple(sorted(topics.values())),
            messages=messages,
            lost=lost,
            damage="; ".join(self.damage),
            notes=self.notes,
            in_order=self.in_order,
            blocks=tuple(self.blocks),
            channels={number: channel.topic for number, channel in known.items()},
        )


def _one_line(error: Exception) -> str:
    """Text of an error of `_DAMAGE` in one line; its type if it has no text."""
    return " ".join(str(error).split()) or type(error).__name__
