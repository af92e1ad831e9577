"""MCAP: the readable blocks of a file, also if it is damaged.

The file's own summary is not trusted: one pass over the data section lists the blocks of messages
that are readable, with their CRCs checked. From a file that was cut off, has flipped bits or lacks
a summary everything readable is recovered, and lost messages are counted.
"""

import struct
from collections.abc import Collection, Iterator
from functools import partial
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
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
from graphslam.logs.mcap_chunks import (
    DAMAGE,
    IS_MESSAGE,
    MESSAGE,
    RECORD,
    UNLIMITED,
    Contents,
    Most,
    TooLargeError,
    chunk_at,
    records_in,
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
from graphslam.logs.schemas import full_name

MAGIC = b"\x89MCAP0\r\n"
NOTES = "graphslam"  # name of the metadata record in which our own logs carry notes

# Of message indexes, and how many numbers channels may have.
_CHANNEL, _CHANNELS = struct.Struct("<H"), 1 << 16
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
        head = stream.read(RECORD.size)
        if len(head) < RECORD.size:
            raise McapError("it ends without a footer")
        opcode, length = RECORD.unpack(head)
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
        offset += RECORD.size + length


def _message(body: bytes) -> Message:
    if len(body) < MESSAGE.itemsize - RECORD.size:
        raise McapError("a message is shorter than its head")
    message: Message = Message.read(ReadDataStream(BytesIO(body)), len(body))
    return message


def block_messages(
    stream: BinaryIO, block: Block, wanted: Collection[int]
) -> Iterator[tuple[int, int, bytes]]:
    """Channel, log time ns and data of the messages of wanted channels in a block."""
    stream.seek(block.offset)
    if stream.read(1)[0] == Opcode.CHUNK:
        data, *columns, _ = chunk_at(stream, block.offset, UNLIMITED)
        is_wanted = np.zeros(_CHANNELS, dtype=bool)
        is_wanted[list(wanted)] = True
        use = is_wanted[columns[0]]
        for channel, log_time_ns, begin, end in zip(
            *(c[use].tolist() for c in columns), strict=True
        ):
            yield channel, log_time_ns, data[begin:end]
        return
    count = sum(block.counts.values())
    loose = (body for _, opcode, body in records_from(stream, block.offset) if opcode == IS_MESSAGE)
    for message in map(_message, islice(loose, count)):
        if message.channel_id in wanted:
            yield message.channel_id, message.log_time, message.data


class Indexer:
    """One pass over a file: `run` does it, the other methods are its steps."""

    def __init__(self, path: Path, stream: BinaryIO, limits: LimitsConfig) -> None:
        self.path, self.stream = path, stream
        self.most = Most(int(1e6 * limits.chunk_mb), limits.chunk_records)
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
            self.look_behind(offset + RECORD.size + len(body) + len(MAGIC))
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
        if opcode == IS_MESSAGE:
            self.add_message(offset, body)
            return
        self.close_loose_block()
        if opcode == Opcode.CHUNK:
            self.tried.add(offset)
        try:
            if opcode == Opcode.CHUNK:
                chunk = Chunk.read(ReadDataStream(BytesIO(body)))
                self.add_chunk(offset, records_in(chunk, self.most))
            elif opcode in _READ:
                self.describe(_READ[opcode].read(ReadDataStream(BytesIO(body))))
            elif opcode not in _NOT_NEEDED and opcode < _PRIVATE:
                raise McapError(f"its kind {opcode} is unknown")
        except TooLargeError as setting:
            raise too_large(self.path, offset, str(setting)) from setting
        except DAMAGE as error:
            what = "chunk" if opcode == Opcode.CHUNK else "record"
            self.damage.append(f"the {what} at byte {offset} is damaged ({one_line(error)})")

    def look_behind(self, end: int) -> None:
        """Another recording may follow, where files were written one behind the other."""
        self.stream.seek(end)
        if self.stream.read(len(MAGIC)) == MAGIC:
            rest = self.size - end
            text = f"another recording begins behind its end, {rest} bytes, and is not read: "
            self.damage.append(text + "store it as a file of its own")

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

    def add_chunk(self, offset: int, found: Contents) -> None:
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
                self.add_chunk(offset, chunk_at(self.stream, offset, self.most))
            except TooLargeError as setting:
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
            number: TopicChannel(
                c.topic, full_name(names[c.schema_id], c.message_encoding), c.message_encoding
            )
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
