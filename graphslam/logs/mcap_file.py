"""MCAP: the readable blocks of a file, also if it is damaged.

The file's own summary is not trusted: one pass over the data section lists the blocks of messages
that are readable, with their CRCs checked. From a file that was cut off, has flipped bits or lacks
a summary everything readable is recovered, and lost messages are counted. The only module that
reads with `mcap`.
"""

import struct
import zlib
from collections.abc import Collection, Iterator
from functools import partial
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema, Statistics
from mcap.summary import Summary

from graphslam.core.sensor_config import LimitsConfig
from graphslam.logs.container_files import (
    digest,
    open_file,
    size_of,
    stream_reader,
    too_large,
)
from graphslam.logs.recording import (
    MAX_BLOCK,
    Block,
    BlockList,
    Piece,
    count_undescribed,
    one_line,
    undescribed,
)
from graphslam.logs.recording import Channel as TopicChannel

IntArray = np.ndarray[Any, np.dtype[np.int64]]
UnsignedArray = np.ndarray[Any, np.dtype[np.unsignedinteger[Any]]]

MAGIC = b"\x89MCAP0\r\n"
NOTES = "graphslam"  # name of the metadata record in which our own logs carry notes

# Errors that mcap, zstandard and lz4 raise on damaged bytes, found by flipping and cutting: their
# own, and those of the standard library for an invalid length, id or string.
DAMAGE = (
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
_RECORD, _LENGTH = struct.Struct("<BQ"), struct.Struct("<Q")
_MESSAGE = np.dtype([
    ("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"),
    ("log_time_ns", "<u8"), ("publish_time_ns", "<u8"),
])  # fmt: skip
_CHANNEL, _CHANNELS = struct.Struct("<H"), 1 << 16
# int: comparing with the enum is slow
_IS_MESSAGE = int(Opcode.MESSAGE)
#: opcodes from here on are for private use, and mean nothing to others
_PRIVATE = 0x80
#: number of the schema of channels without one
_NO_SCHEMA = 0
_READ: dict[int, Any] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.STATISTICS: Statistics,
    Opcode.METADATA: Metadata,
}
_NOT_NEEDED = frozenset(map(int, Opcode)) - _READ.keys()
#: files end before this byte: a system refuses to go there
_FARTHEST = 1 << 62
#: bytes that are unpacked at once where nobody knows how many there are
_PART = 1 << 20


class _TooLargeError(Exception):
    """A chunk is beyond a setting of [limits]; its text is the name."""


class _Most(NamedTuple):
    """Unpacked bytes and records that a chunk may have."""

    size: int
    records: int


#: what was indexed is not checked again
_UNLIMITED = _Most(1 << 40, 1 << 40)


def index_mcap(path: Path, limits: LimitsConfig) -> Piece:
    """Read through the MCAP file ``path`` once and index it.

    Raises:
        LogError: a chunk is beyond ``limits``.
        OSError: it cannot be read.
    """
    with open_file(path) as stream:
        return Indexer(path, stream, limits).run()


# ---------------------------------------------------------------- blocks


def records_from(stream: BinaryIO, offset: int) -> Iterator[tuple[int, int, bytes]]:
    """Offset, opcode and body of the records from ``offset`` to the footer, chunks unopened.

    Of message indexes only the channel: they are not needed and take longest to read.

    Raises:
        McapError: the file ends before the footer, or there is no record.
        OSError: it cannot be read.
    """
    while True:
        if offset > _FARTHEST:
            raise McapError("it ends inside a record")
        stream.seek(offset)
        head = stream.read(_RECORD.size)
        if len(head) < _RECORD.size:
            raise McapError("it ends without a footer")
        opcode, length = _RECORD.unpack(head)
        if opcode == 0:
            raise McapError("there is no record")
        if opcode == Opcode.MESSAGE_INDEX:
            yield offset, opcode, stream.read(min(length, _CHANNEL.size))
        else:
            body = stream.read(length)
            if len(body) < length:
                raise McapError("it ends inside a record")
            yield offset, opcode, body
        if opcode == Opcode.FOOTER:
            return
        offset += _RECORD.size + length


def _message(body: bytes) -> Message:
    if len(body) < _MESSAGE.itemsize - _RECORD.size:
        raise McapError("a message is shorter than its head")
    message: Message = Message.read(ReadDataStream(BytesIO(body)), len(body))
    return message


class _Contents(NamedTuple):
    """Contents of a chunk: its bytes, messages, and schemas and channels (``others``).

    Of messages (n): channel and log time ns, begin and end of their data in the bytes.
    """

    data: bytes
    channels: UnsignedArray
    log_times_ns: UnsignedArray
    begins: IntArray
    ends: IntArray
    others: list[McapRecord]


def _chunk_at(stream: BinaryIO, offset: int, most: _Most) -> _Contents:
    """The records in the chunk at ``offset``; if the file ends inside it, those before the end.

    ``most``: how many unpacked bytes and how many records it may have.

    Raises:
        One of `DAMAGE` when the chunk is damaged in any other way, its CRC included.
    """
    stream.seek(offset)
    head = stream.read(_RECORD.size)
    if len(head) < _RECORD.size or head[0] != Opcode.CHUNK:
        raise McapError("no chunk where the index has one")
    length = _RECORD.unpack(head)[1]
    body = stream.read(length)
    chunk = Chunk.read(ReadDataStream(BytesIO(body)))
    return _records_in(chunk, most) if len(body) == length else _cut_chunk(chunk, most)


def _records_in(chunk: Chunk, most: _Most) -> _Contents:
    """The schemas, channels and messages in a chunk.

    Like mcap's ``breakup_chunk``, but without an object per message, which would be slow: only the
    lengths, which lead from record to record, are read one by one.

    Raises:
        One of `DAMAGE` when the chunk is damaged, its CRC included.
        _TooLargeError: there is more than ``most`` in it.
    """
    unpacked = _unpacked(chunk, most.size)
    if len(unpacked) > most.size:
        raise _TooLargeError("chunk_mb")
    if chunk.uncompressed_crc not in (0, zlib.crc32(unpacked)):
        raise McapError("its CRC is another one")
    size = len(unpacked)
    # padded, because the head of a message is read from every record, also from shorter ones
    data = unpacked + bytes(_MESSAGE.itemsize)
    starts: list[int] = []
    begin, head, length_at, append = 0, _RECORD.size, _LENGTH.unpack_from, starts.append
    for _ in range(min(most.records, size)):
        if begin >= size:
            break
        append(begin)
        begin += head + length_at(data, begin + 1)[0]
    if begin < size:
        raise _TooLargeError("chunk_records")
    if begin > size:
        raise McapError("a record reaches beyond its chunk")
    bounds = np.array([*starts, begin])
    at = bounds[:-1]
    # what would be a head at every byte
    heads = np.ndarray(size, f"V{_MESSAGE.itemsize}", data, strides=(1,))[at].view(_MESSAGE)
    is_message = heads["opcode"] == _IS_MESSAGE
    begins, ends = at[is_message] + _MESSAGE.itemsize, bounds[1:][is_message]
    if (ends < begins).any():
        raise McapError("a message is shorter than its head")
    others = []
    for k in np.flatnonzero(~is_message).tolist():
        opcode = int(heads["opcode"][k])
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            kind = Schema if opcode == Opcode.SCHEMA else Channel
            body = data[starts[k] + _RECORD.size : int(bounds[k + 1])]
            others.append(kind.read(ReadDataStream(BytesIO(body))))
    found = heads[is_message]
    return _Contents(data, found["channel"], found["log_time_ns"], begins, ends, others)


def _unpacked(chunk: Chunk, most: int) -> bytes:
    """Contents of a chunk; of one that has more than ``most`` bytes a few more than that.

    Raises:
        One of `DAMAGE` when it cannot be unpacked.
    """
    if not chunk.compression:
        return chunk.data
    if chunk.compression == "lz4":
        packed = lz4.frame.LZ4FrameDecompressor()
        # memory for all that may come is taken at once: no more than the chunk says it has
        data = bytes(packed.decompress(chunk.data, min(chunk.uncompressed_size, most + 1)))
        if not packed.eof and len(data) <= most:
            raise McapError("it is not as long as it says")
        return data
    if chunk.compression != "zstd":
        raise McapError(f"packed with {chunk.compression}")
    size = zstandard.frame_content_size(chunk.data)
    if 0 <= size <= most:
        return zstandard.decompress(chunk.data, size)
    # without a size, or a size that is too large, which may be the damage
    with zstandard.ZstdDecompressor().stream_reader(chunk.data) as stream:
        return b"".join(_parts(stream, most + 1))


def _parts(stream: zstandard.ZstdDecompressionReader, size: int) -> Iterator[bytes]:
    """At most ``size`` bytes of a stream, piece by piece: memory for what there is."""
    while size > 0 and (part := stream.read(min(size, _PART))):
        size -= len(part)
        yield part


def _cut_chunk(chunk: Chunk, most: _Most) -> _Contents:
    """Complete records at the beginning of a chunk whose end is missing."""
    data = chunk.data
    if chunk.compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(data) as stream:
            data = b"".join(_parts(stream, most.size + 1))
    elif chunk.compression:
        raise McapError(f"the beginning of a {chunk.compression} chunk cannot be read")
    end = 0
    while end + 9 <= len(data):
        length = int.from_bytes(data[end + 1 : end + 9], "little")
        if end + 9 + length > len(data):
            break
        end += 9 + length
    return _records_in(Chunk("", data[:end], 0, 0, 0, end), most)


def block_messages(
    stream: BinaryIO, block: Block, wanted: Collection[int]
) -> Iterator[tuple[int, int, bytes]]:
    """Channel, log time ns and data of the messages of wanted channels in a block."""
    stream.seek(block.offset)
    if stream.read(1)[0] == Opcode.CHUNK:
        data, *columns, _ = _chunk_at(stream, block.offset, _UNLIMITED)
        is_wanted = np.zeros(_CHANNELS, dtype=bool)
        is_wanted[list(wanted)] = True
        use = is_wanted[columns[0]]
        for channel, log_time_ns, begin, end in zip(
            *(c[use].tolist() for c in columns), strict=True
        ):
            yield channel, log_time_ns, data[begin:end]
        return
    count = sum(block.counts.values())
    loose = (
        body for _, opcode, body in records_from(stream, block.offset) if opcode == _IS_MESSAGE
    )
    for message in map(_message, islice(loose, count)):
        if message.channel_id in wanted:
            yield message.channel_id, message.log_time, message.data


class Indexer:
    """One pass over a file: `run` does it, the other methods are its steps."""

    def __init__(self, path: Path, stream: BinaryIO, limits: LimitsConfig) -> None:
        self.path, self.stream = path, stream
        self.most = _Most(int(1e6 * limits.chunk_mb), limits.chunk_records)
        self.size = size_of(stream)
        stream.seek(len(MAGIC))
        self.position = len(MAGIC)  # where the next record begins
        self.indexed: set[bytes] | None = None  # channels whose indexes the last chunk has
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.blocks = BlockList()
        self.loose: list[tuple[int, Message]] = []
        self.damage: list[str] = []
        self.statistics: Statistics | None = None
        self.notes: dict[str, str] = {}
        self.tried: set[int] = set()  # offsets of chunks

    def run(self) -> Piece:
        """Read the whole file."""
        try:
            for offset, opcode, body in records_from(self.stream, self.position):
                self.position = offset
                self.add(offset, opcode, body)
        except DAMAGE as error:
            self.recover(error)
        self.close_loose_block()
        return self.result()

    def add(self, offset: int, opcode: int, body: bytes) -> None:
        """Take in a record; of its own damage only it is lost, because its length is known."""
        if opcode == Opcode.MESSAGE_INDEX:
            if self.indexed is None or body in self.indexed:
                self.damage.append(f"the chunk of the index at byte {offset} is missing")
                self.indexed = set()
            self.indexed.add(body)
            return
        self.indexed = set() if opcode == Opcode.CHUNK else None
        if opcode == _IS_MESSAGE:
            self.add_message(offset, body)
            return
        self.close_loose_block()
        if opcode == Opcode.CHUNK:
            self.tried.add(offset)
        try:
            if opcode == Opcode.CHUNK:
                chunk = Chunk.read(ReadDataStream(BytesIO(body)))
                self.add_chunk(offset, _records_in(chunk, self.most))
            elif opcode in _READ:
                self.describe(_READ[opcode].read(ReadDataStream(BytesIO(body))))
            elif opcode not in _NOT_NEEDED and opcode < _PRIVATE:
                raise McapError(f"its kind {opcode} is unknown")
        except _TooLargeError as setting:
            raise too_large(self.path, offset, str(setting)) from setting
        except DAMAGE as error:
            what = "chunk" if opcode == Opcode.CHUNK else "record"
            self.damage.append(f"the {what} at byte {offset} is damaged ({one_line(error)})")

    def add_message(self, offset: int, body: bytes) -> None:
        """Take in a message outside chunks."""
        try:
            self.loose.append((offset, _message(body)))
        except DAMAGE as error:
            # the block ends here, because its messages are counted when it is read again
            self.damage.append(f"the record at byte {offset} is damaged ({one_line(error)})")
            self.close_loose_block()
        if len(self.loose) == MAX_BLOCK:
            self.close_loose_block()

    def describe(self, record: McapRecord) -> None:
        """Take in what is said of the file: schemas, channels, statistics, notes."""
        if isinstance(record, Schema):
            self.schemas.setdefault(record.id, record)
        elif isinstance(record, Channel):
            self.channels.setdefault(record.id, record)
        elif isinstance(record, Statistics):
            self.statistics = record
        elif isinstance(record, Metadata) and record.name == NOTES:
            self.notes.update(record.metadata)

    def add_chunk(self, offset: int, found: _Contents) -> None:
        """Take in the contents of a chunk."""
        for record in found.others:
            self.describe(record)
        self.blocks.add(offset, offset, found.channels, found.log_times_ns)

    def close_loose_block(self) -> None:
        """End the block of messages outside chunks."""
        if self.loose:
            channels = [message.channel_id for _, message in self.loose]
            times = [message.log_time for _, message in self.loose]
            self.blocks.add(self.loose[0][0], self.loose[-1][0], channels, times)
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
                self.add_chunk(offset, _chunk_at(self.stream, offset, self.most))
            except _TooLargeError as setting:
                raise too_large(self.path, offset, str(setting)) from setting
            except DAMAGE:
                continue  # lost; counted by the statistics record, if there is one

    def summary(self) -> Summary | None:
        """The file's own summary, if it can be read."""
        try:
            self.stream.seek(0)
            return SeekingReader(self.stream, record_size_limit=self.size).get_summary()
        except (*DAMAGE, OSError, StopIteration):  # OSError: a seek to before the beginning
            return None

    def described(self) -> dict[int, TopicChannel]:
        """The channels whose schema is there, or that have none."""
        names = {number: schema.name for number, schema in self.schemas.items()}
        names[_NO_SCHEMA] = ""
        return {
            number: TopicChannel(c.topic, names[c.schema_id], c.message_encoding)
            for number, c in self.channels.items()
            if c.schema_id in names
        }

    def result(self) -> Piece:
        """The index of what was taken in."""
        channels = self.described()
        unknown = count_undescribed(self.blocks.blocks, channels)
        lost: int | None = None if self.damage else unknown
        if self.statistics is not None:
            messages = sum(sum(block.counts.values()) for block in self.blocks.blocks)
            lost = unknown + max(0, self.statistics.message_count - messages)
        return Piece(
            path=self.path,
            sha256=digest(self.path),
            channels=channels,
            blocks=tuple(self.blocks.blocks),
            in_order=self.blocks.in_order,
            lost=lost,
            damage="; ".join([*self.damage, *undescribed(unknown)]),
            open=partial(stream_reader, block_messages, (*DAMAGE, IndexError)),
            notes=self.notes,
        )
