"""MCAP: the readable blocks of a file, also if it is damaged.

The file's own summary is not trusted: one pass over the data section lists the blocks of messages
that are readable, with their CRCs checked. From a file that was cut off, has flipped bits or lacks
a summary everything readable is recovered, and lost messages are counted. The only module that
reads with `mcap`.
"""

import struct
from collections.abc import Collection, Iterator
from functools import partial
from io import SEEK_CUR, BytesIO
from itertools import islice
from pathlib import Path
from typing import BinaryIO, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema, Statistics
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.summary import Summary

from graphslam.logs.container_files import digest, open_file, size_of, stream_reader
from graphslam.logs.recording import MAX_BLOCK, Block, BlockList, Piece, one_line
from graphslam.logs.recording import Channel as TopicChannel

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


def index_mcap(path: Path) -> Piece:
    """Read through the MCAP file ``path`` once and index it.

    Raises:
        OSError: it cannot be read.
    """
    with open_file(path) as stream:
        return _Indexer(path, stream).run()


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
    stream: BinaryIO, block: Block, wanted: Collection[int]
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

    def __init__(self, path: Path, stream: BinaryIO) -> None:
        self.path, self.stream = path, stream
        self.size = size_of(stream)
        stream.seek(len(MAGIC))
        self.position = len(MAGIC)  # where the next record begins
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.blocks = BlockList()
        self.loose: list[tuple[int, Message]] = []
        self.damage: list[str] = []
        self.statistics: Statistics | None = None
        self.notes: dict[str, str] = {}
        self.tried: set[int] = set()  # offsets of chunks

    def run(self) -> Piece:
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
            if len(self.loose) == MAX_BLOCK:
                self.close_loose_block()
        elif isinstance(record, Chunk):
            self.close_loose_block()
            self.tried.add(offset)
            try:
                self.add_chunk(offset, _records_in(record))
            except _DAMAGE as error:
                self.damage.append(f"the chunk at byte {offset} is damaged ({one_line(error)})")
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
        self.blocks.add(offset, offset, [message[:2] for message in found.messages])

    def close_loose_block(self) -> None:
        if self.loose:
            messages = [(message.channel_id, message.log_time) for _, message in self.loose]
            self.blocks.add(self.loose[0][0], self.loose[-1][0], messages)
            self.loose = []

    def recover(self, error: Exception) -> None:
        """Index the chunks after the offset at which sequential reading failed."""
        self.close_loose_block()
        self.damage.append(
            f"it cannot be read from byte {self.position} of {self.size} ({one_line(error)})"
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

    def result(self) -> Piece:
        channels = {
            number: TopicChannel(c.topic, self.schemas[c.schema_id].name, c.message_encoding)
            for number, c in self.channels.items()
            if c.schema_id in self.schemas
        }
        lost: int | None = None if self.damage else 0
        if self.statistics is not None:
            messages = sum(sum(block.counts.values()) for block in self.blocks.blocks)
            lost = max(0, self.statistics.message_count - messages)
        return Piece(
            path=self.path,
            sha256=digest(self.path),
            channels=channels,
            blocks=tuple(self.blocks.blocks),
            in_order=self.blocks.in_order,
            lost=lost,
            damage="; ".join(self.damage),
            open=partial(stream_reader, _block_messages),
            notes=self.notes,
        )
