"""The chunks of an MCAP file: unpacked, checked, and taken apart into records."""

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import Any, BinaryIO, NamedTuple

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Schema

from graphslam.core.arrays import IntArray

UnsignedArray = np.ndarray[Any, np.dtype[np.unsignedinteger[Any]]]

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
RECORD, _LENGTH = struct.Struct("<BQ"), struct.Struct("<Q")
MESSAGE = np.dtype([
    ("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"),
    ("log_time_ns", "<u8"), ("publish_time_ns", "<u8"),
])  # fmt: skip
# int: comparing with the enum is slow
IS_MESSAGE = int(Opcode.MESSAGE)
#: bytes that are unpacked at once where nobody knows how many there are
_PART = 1 << 20


class TooLargeError(Exception):
    """A chunk is beyond a setting of [limits]; its text is the name."""


class Most(NamedTuple):
    """Unpacked bytes and records that a chunk may have."""

    size: int
    records: int


#: what was indexed is not checked again
UNLIMITED = Most(1 << 40, 1 << 40)


class Contents(NamedTuple):
    """Contents of a chunk: its bytes, messages, and schemas and channels (``others``).

    Of messages (n): channel and log time ns, begin and end of their data in the bytes.
    """

    data: bytes
    channels: UnsignedArray
    log_times_ns: UnsignedArray
    begins: IntArray
    ends: IntArray
    others: list[McapRecord]


def chunk_at(stream: BinaryIO, offset: int, most: Most) -> Contents:
    """The records in the chunk at ``offset``; if the file ends inside it, those before the end.

    ``most``: how many unpacked bytes and how many records it may have.

    Raises:
        One of `DAMAGE` when the chunk is damaged in any other way, its CRC included.
    """
    stream.seek(offset)
    head = stream.read(RECORD.size)
    if len(head) < RECORD.size or head[0] != Opcode.CHUNK:
        raise McapError("no chunk where the index has one")
    length = RECORD.unpack(head)[1]
    body = stream.read(length)
    chunk = Chunk.read(ReadDataStream(BytesIO(body)))
    return records_in(chunk, most) if len(body) == length else _cut_chunk(chunk, most)


def records_in(chunk: Chunk, most: Most) -> Contents:
    """The schemas, channels and messages in a chunk.

    Like mcap's ``breakup_chunk``, but without an object per message, which would be slow: only the
    lengths, which lead from record to record, are read one by one.

    Raises:
        One of `DAMAGE` when the chunk is damaged, its CRC included.
        TooLargeError: there is more than ``most`` in it.
    """
    unpacked = _unpacked(chunk, most.size)
    if len(unpacked) > most.size:
        raise TooLargeError("chunk_mb")
    if chunk.uncompressed_crc not in (0, zlib.crc32(unpacked)):
        raise McapError("its CRC is another one")
    size = len(unpacked)
    # padded, because the head of a message is read from every record, also from shorter ones
    data = unpacked + bytes(MESSAGE.itemsize)
    starts: list[int] = []
    begin, head, length_at, append = 0, RECORD.size, _LENGTH.unpack_from, starts.append
    for _ in range(min(most.records, size)):
        if begin >= size:
            break
        append(begin)
        begin += head + length_at(data, begin + 1)[0]
    if begin < size:
        raise TooLargeError("chunk_records")
    if begin > size:
        raise McapError("a record reaches beyond its chunk")
    bounds = np.array([*starts, begin])
    at = bounds[:-1]
    # what would be a head at every byte
    heads = np.ndarray(size, f"V{MESSAGE.itemsize}", data, strides=(1,))[at].view(MESSAGE)
    is_message = heads["opcode"] == IS_MESSAGE
    begins, ends = at[is_message] + MESSAGE.itemsize, bounds[1:][is_message]
    if (ends < begins).any():
        raise McapError("a message is shorter than its head")
    others = []
    for k in np.flatnonzero(~is_message).tolist():
        opcode = int(heads["opcode"][k])
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            kind = Schema if opcode == Opcode.SCHEMA else Channel
            body = data[starts[k] + RECORD.size : int(bounds[k + 1])]
            others.append(kind.read(ReadDataStream(BytesIO(body))))
    found = heads[is_message]
    return Contents(data, found["channel"], found["log_time_ns"], begins, ends, others)


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


def _cut_chunk(chunk: Chunk, most: Most) -> Contents:
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
    return records_in(Chunk("", data[:end], 0, 0, 0, end), most)
