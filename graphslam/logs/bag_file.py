"""ROS 1 bags (format 2.0): the readable blocks of a file, also if it has no index or is damaged.

The index at the end is not needed: one pass over the file lists the chunks that can be unpacked and
the messages in them. A bag whose recording was ended by force has no index, and its last chunk has
no length; what is in it is read as far as it goes.

Source: https://wiki.ros.org/Bags/Format/2.0
"""

import bz2
import struct
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import islice
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame

from graphslam.core.errors import LogError
from graphslam.core.sensor_config import LimitsConfig
from graphslam.logs.container_files import (
    digest,
    open_file,
    size_of,
    stream_reader,
    too_large,
)
from graphslam.logs.read_ahead import ReadAhead
from graphslam.logs.recording import (
    MAX_BLOCK,
    Block,
    BlockList,
    Channel,
    Piece,
    count_undescribed,
    one_line,
    undescribed,
)
from graphslam.logs.unpacked_chunks import UnpackedChunks

MAGIC = b"#ROSBAG V2.0\n"
ANY_VERSION = b"#ROSBAG V"

_MESSAGE, _BAG, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
_KNOWN = (_MESSAGE, _BAG, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION)
_U32 = struct.Struct("<I")
_TIME = struct.Struct("<II")
#: fields of a message's head, with their lengths
_CONN, _LOG_TIME = b"\x09\0\0\0conn=", b"\x0d\0\0\0time="
#: head of a record: longer ones are taken for damage; a connection's has its topic only
_MAX_HEAD = 1 << 16
#: the field of a chunk's head that says that it is one; after damage the next one is looked for
_CHUNK_MARK = b"\x04\0\0\0op=" + bytes([_CHUNK])
#: bytes before this mark in which the head begins
_BEFORE_MARK = 200
_SEARCHED = 1 << 20
#: compressions of which unpacking takes longer than the rest of reading
_SLOW = ("bz2",)


class _BagError(Exception):
    """Bytes that are no record of a bag, or a chunk that cannot be unpacked."""


class _Record(NamedTuple):
    """Head of a record, and where its data begins and ends."""

    op: int
    fields: Mapping[bytes, bytes]
    begin: int
    end: int

    @property
    def packing(self) -> str:
        """Compression of a chunk."""
        return self.fields.get(b"compression", b"").decode(errors="replace")


def index_bag(path: Path, limits: LimitsConfig) -> Piece:
    """Read through the bag ``path`` once and index it.

    Raises:
        LogError: it is encrypted, or a chunk is beyond ``limits``.
        OSError: it cannot be read.
    """
    with open_file(path) as stream:
        return _Indexer(path, stream, limits).run()


def _block_messages(
    kept: UnpackedChunks, stream: BinaryIO, block: Block, wanted: Collection[int]
) -> Iterator[tuple[int, int, bytes]]:
    """Connection, log time ns and data of the messages of wanted connections in a block."""
    first = _record_at(stream, block.offset)
    if first.op == _CHUNK:
        data = kept.get(block.offset)
        if data is None:
            data = _unpacked(first, _packed(stream, first))
        with suppress(_BagError):  # the index knows
            for connection, log_time_ns, begin, end in _messages_in(data, {}):
                if connection in wanted:
                    yield connection, log_time_ns, data[begin:end]
        return
    loose = (r for r in _records(stream, block.offset, block.end) if r.op == _MESSAGE)
    for record in islice(loose, sum(block.counts.values())):
        connection, log_time_ns = _message_head(record.fields)
        if connection in wanted:
            stream.seek(record.begin)
            yield connection, log_time_ns, stream.read(record.end - record.begin)


# ---------------------------------------------------------------- records


def _fields(head: bytes) -> dict[bytes, bytes]:
    """The fields of a record's head, by name.

    Raises:
        _BagError: it is not made of fields, or does not say what kind of record it is.
    """
    found = {}
    at = 0
    while at < len(head):
        size = int.from_bytes(head[at : at + 4], "little")
        field = head[at + 4 : at + 4 + size]
        name, equals, value = field.partition(b"=")
        if len(field) != size or not equals:
            raise _BagError("not the head of a record")
        found[name] = value
        at += 4 + size
    if len(found.get(b"op", b"")) != 1:
        raise _BagError("the head of a record lacks its kind")
    return found


def _number(fields: Mapping[bytes, bytes], name: bytes, size: int = 4) -> int:
    value = fields.get(name, b"")
    if len(value) != size:
        raise _BagError(f"a record lacks {name.decode()}")
    return int.from_bytes(value, "little")


def _message_head(fields: Mapping[bytes, bytes]) -> tuple[int, int]:
    """Connection and log time ns of a message."""
    seconds, nanoseconds = _TIME.unpack(_number(fields, b"time", 8).to_bytes(8, "little"))
    return _number(fields, b"conn"), seconds * 1_000_000_000 + nanoseconds


def _record_at(stream: BinaryIO, offset: int) -> _Record:
    """The record at ``offset``, whose data may end after the file.

    Raises:
        EOFError: the file ends before its data.
        _BagError: there is none.
    """
    stream.seek(offset)
    length = stream.read(4)
    size = int.from_bytes(length, "little")
    if len(length) == 4 and size > _MAX_HEAD:
        raise _BagError("not the head of a record")
    head = stream.read(size + 4)
    if len(length) < 4 or len(head) < size + 4:
        raise EOFError("the file ends inside the head of a record")
    fields = _fields(head[:size])
    if fields[b"op"][0] not in _KNOWN:
        raise _BagError("a record of unknown kind")
    begin = offset + 8 + size
    return _Record(fields[b"op"][0], fields, begin, begin + _U32.unpack(head[size:])[0])


def _records(stream: BinaryIO, offset: int, limit: int) -> Iterator[_Record]:
    """The records from ``offset`` to ``limit``, chunks unopened."""
    while offset < limit:
        record = _record_at(stream, offset)
        yield record
        offset = record.end


# ---------------------------------------------------------------- chunks


def _packed(stream: BinaryIO, chunk: _Record) -> bytes:
    """A chunk as the file has it; if the file ends inside it, what is before the end."""
    stream.seek(chunk.begin)
    length = chunk.end - chunk.begin
    # without a length: the bag was not closed, and its last chunk ends with the file; if it is not
    # packed, its messages are read as those outside chunks
    return _read(stream, length or _SEARCHED * (chunk.packing != "none"))


def _unpacked(chunk: _Record, packed: bytes, most: int = -1) -> bytes:
    """Contents of a chunk of which ``packed`` is there.

    ``most``: so many bytes are enough.

    Raises:
        _BagError: it cannot be unpacked.
    """
    size = _number(chunk.fields, b"size")
    limit = size if size and (most < 0 or size < most) else most
    try:
        if chunk.packing == "none":
            return packed
        if chunk.packing == "bz2":
            return bz2.BZ2Decompressor().decompress(packed, limit)
        if chunk.packing == "lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, limit))
    except (OSError, EOFError, ValueError, RuntimeError, MemoryError) as error:
        raise _BagError(one_line(error)) from error
    raise _BagError(f"packed with {chunk.packing}")


def _read(stream: BinaryIO, size: int) -> bytes:
    """At most ``size`` bytes, piece by piece: memory for what there is, whatever a length says."""
    parts = []
    while size > 0 and (part := stream.read(min(size, _SEARCHED))):
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


def _messages_in(
    data: bytes, connections: dict[int, Channel]
) -> Iterator[tuple[int, int, int, int]]:
    """Messages of a chunk: connection, log time ns, begin and end of the data in the bytes.

    Adds the ``connections`` that are in it.

    Raises:
        _BagError: after the last record that is whole, if there is more.
    """
    at, size = 0, len(data)
    places: dict[int, tuple[int, int]] = {}  # by the size of the head
    while at < size:
        head = int.from_bytes(data[at : at + 4], "little")
        body = at + 8 + head
        end = body + int.from_bytes(data[body - 4 : body], "little")
        if max(body, end) > size:
            raise _BagError("a record reaches beyond its chunk")
        # heads of messages have a few forms only: their fields are parsed once for each
        form = places.get(head)
        if form is not None and (
            data[at + form[0] - len(_CONN) : at + form[0]] == _CONN
            and data[at + form[1] - len(_LOG_TIME) : at + form[1]] == _LOG_TIME
        ):
            connection = int.from_bytes(data[at + form[0] : at + form[0] + 4], "little")
            seconds, nanoseconds = _TIME.unpack_from(data, at + form[1])
            yield connection, seconds * 1_000_000_000 + nanoseconds, body, end
        else:
            fields = _fields(data[at + 4 : at + 4 + head])
            if fields[b"op"][0] == _MESSAGE:
                yield *_message_head(fields), body, end
                own = data[at : body - 4]
                places[head] = own.index(_CONN) + len(_CONN), own.index(_LOG_TIME) + len(_LOG_TIME)
            elif fields[b"op"][0] == _CONNECTION:
                _add_connection(fields, data[body:end], connections)
            else:
                raise _BagError("a chunk has something else than messages")
        at = end


def _add_connection(
    fields: Mapping[bytes, bytes], data: bytes, connections: dict[int, Channel]
) -> None:
    """Take over the connection of a record; its type is in the data, which are like a head."""
    own = _fields(b"\x04\0\0\0op=\x07" + data)
    topic = (fields.get(b"topic") or own.get(b"topic", b"")).decode(errors="replace")
    schema = own.get(b"type", b"").decode(errors="replace")
    connections.setdefault(_number(fields, b"conn"), Channel(topic, schema, "ros1"))


# ---------------------------------------------------------------- index


class _Indexer:
    """One pass over a bag: `run` does it, the other methods are its steps."""

    def __init__(self, path: Path, stream: BinaryIO, limits: LimitsConfig) -> None:
        self.path, self.stream, self.limits = path, stream, limits
        self.most = 1 + int(1e6 * limits.chunk_mb)  # a chunk has less
        self.ahead: ReadAhead[tuple[int, _Record]] = ReadAhead()
        self.size = size_of(stream)
        self.connections: dict[int, Channel] = {}
        self.blocks = BlockList()
        self.loose: list[tuple[int, int]] = []
        self.loose_from = self.loose_to = 0
        self.damage: list[str] = []
        self.stated = 0  # messages by the index
        self.has_index = False
        self.kept = UnpackedChunks()

    def run(self) -> Piece:
        with self.ahead:
            self.add_all()
            self.finish_chunks()
        self.close_loose_block()
        return self.result()

    def add_all(self) -> None:
        offset = len(MAGIC)
        while offset < self.size:
            try:
                record = _record_at(self.stream, offset)
                self.add(offset, record)
                if record.end > self.size and record.op != _CHUNK:
                    self.add_damage(f"it ends inside the record at byte {offset}")
                offset = record.end
                packing = record.fields.get(b"compression", b"none")
                if record.op == _CHUNK and record.end == record.begin and packing != b"none":
                    offset = self.next_chunk(offset + 1)
            except (_BagError, EOFError) as error:
                self.add_damage(
                    f"it cannot be read from byte {offset} of {self.size} ({one_line(error)})"
                )
                offset = self.next_chunk(offset + 1)

    def add(self, offset: int, record: _Record) -> None:
        if record.op == _CHUNK:
            self.close_loose_block()
            self.begin_chunk(offset, record)
            return
        if record.end > self.size or record.op == _INDEX:
            return  # the file ends inside it, or it tells nothing new
        self.finish_chunks()
        if record.op == _MESSAGE:
            self.loose_from = self.loose_from if self.loose else offset
            self.loose_to = record.end
            self.loose.append(_message_head(record.fields))
            if len(self.loose) == MAX_BLOCK:
                self.close_loose_block()
        elif record.op == _CONNECTION:
            self.stream.seek(record.begin)
            data = self.stream.read(record.end - record.begin)
            _add_connection(record.fields, data, self.connections)
        elif record.op == _CHUNK_INFO:
            self.add_counts(record)
        elif record.op == _BAG and record.fields.get(b"encryptor"):
            raise LogError(f"{self.path}: is encrypted; decrypt it with `rosbag decrypt`")

    def add_damage(self, damage: str) -> None:
        self.finish_chunks()  # which tell theirs first
        self.damage.append(damage)

    def begin_chunk(self, offset: int, record: _Record) -> None:
        packed = _packed(self.stream, record)
        unpacked = partial(_unpacked, record, packed, self.most)
        if record.packing not in _SLOW:
            self.finish_chunks()
            self.add_chunk(offset, record, unpacked)
            return
        size = len(packed) + (
            int.from_bytes(record.fields.get(b"size", b""), "little") or self.most
        )
        for (before, chunk), result in self.ahead.put((offset, record), unpacked, size):
            self.add_chunk(before, chunk, result)

    def finish_chunks(self) -> None:
        for (offset, chunk), unpacked in self.ahead.take_all():
            self.add_chunk(offset, chunk, unpacked)

    def add_chunk(self, offset: int, record: _Record, unpacked: Callable[[], bytes]) -> None:
        messages = []
        try:
            data = unpacked()
            if len(data) >= self.most:
                raise too_large(self.path, offset, "chunk_mb")
            # one by one: what comes before damage is kept
            for connection, log_time_ns, _, _ in _messages_in(data, self.connections):
                messages.append((connection, log_time_ns))
                if len(messages) > self.limits.chunk_records:
                    raise too_large(self.path, offset, "chunk_records")
        except _BagError as error:
            if record.end <= self.size:
                self.damage.append(f"the chunk at byte {offset} is damaged ({one_line(error)})")
        if messages and record.packing in _SLOW:
            self.kept.keep(offset, data)
        self.add_block(offset, record.end, messages)
        if record.end > self.size:
            self.damage.append(f"it ends inside the chunk at byte {offset}")

    def add_counts(self, record: _Record) -> None:
        """Add the numbers of messages that the index has for one chunk."""
        self.stream.seek(record.begin)
        data = self.stream.read(record.end - record.begin)
        self.has_index = True
        self.stated += sum(_U32.unpack_from(data, at)[0] for at in range(4, len(data) - 3, 8))

    def close_loose_block(self) -> None:
        self.add_block(self.loose_from, self.loose_to, self.loose)
        self.loose = []

    def add_block(self, offset: int, end: int, messages: Sequence[tuple[int, int]]) -> None:
        """Add a block of messages, given by connection and log time."""
        self.blocks.add(offset, end, [one for one, _ in messages], [ns for _, ns in messages])

    def next_chunk(self, offset: int) -> int:
        """Where the next chunk begins at or after ``offset``; the end of the file if nowhere."""
        keep = len(_CHUNK_MARK) + _BEFORE_MARK
        while offset < self.size:
            self.stream.seek(offset)
            part = self.stream.read(_SEARCHED)
            at = part.find(_CHUNK_MARK)
            while at >= 0:
                for start in range(offset + max(0, at - _BEFORE_MARK), offset + at):
                    if self.is_chunk(start):
                        return start
                at = part.find(_CHUNK_MARK, at + 1)
            if len(part) < _SEARCHED:
                break
            offset += len(part) - keep
        return self.size

    def is_chunk(self, offset: int) -> bool:
        try:
            record = _record_at(self.stream, offset)
            return record.op == _CHUNK and b"compression" in record.fields
        except (_BagError, EOFError):
            return False

    def result(self) -> Piece:
        if not self.has_index and not self.damage:
            self.damage.append("it has no index: its recording was not ended")
        unknown = count_undescribed(self.blocks.blocks, self.connections)
        lost: int | None = None if self.damage else unknown
        if self.has_index:
            messages = sum(sum(block.counts.values()) for block in self.blocks.blocks)
            lost = unknown + max(0, self.stated - messages)
        return Piece(
            path=self.path,
            sha256=digest(self.path),
            channels=self.connections,
            blocks=tuple(self.blocks.blocks),
            in_order=self.blocks.in_order,
            lost=lost,
            damage="; ".join([*self.damage, *undescribed(unknown)]),
            open=partial(
                stream_reader,
                partial(_block_messages, self.kept),
                (_BagError, EOFError, struct.error),
            ),
        )
