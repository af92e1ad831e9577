"""Files of recordings, damaged on purpose."""

import struct
from collections.abc import Callable, Iterable, Iterator

from mcap.opcode import Opcode

MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
#: opcode and body of a record of MCAP
Record = tuple[int, bytes]


def records(data: bytes) -> list[Record]:
    """The records of an MCAP file, chunks unopened."""
    found, at = [], len(MAGIC)
    while at < len(data) - len(MAGIC):
        opcode, length = _HEAD.unpack_from(data, at)
        found.append((opcode, data[at + _HEAD.size : at + _HEAD.size + length]))
        at += _HEAD.size + length
    return found


def mcap(found: Iterable[Record]) -> bytes:
    """A file of records; offsets in its summary are those of the file that they come from."""
    body = b"".join(_HEAD.pack(opcode, len(one)) + one for opcode, one in found)
    return MAGIC + body + MAGIC


def without(data: bytes, opcodes: set[int], which: slice = slice(None)) -> bytes:
    """A file without some (``which``) of the records of these kinds."""
    found = records(data)
    places = [k for k, (opcode, _) in enumerate(found) if opcode in opcodes][which]
    return mcap(record for k, record in enumerate(found) if k not in places)


def with_private_records(data: bytes) -> bytes:
    """A file with a record of a kind of somebody's own before every chunk."""
    made: list[Record] = []
    for record in records(data):
        if record[0] == Opcode.CHUNK:
            made.append((0xC3, b"somebody's own"))
        made.append(record)
    return mcap(made)


def mutations(data: bytes, seed: int) -> Iterator[tuple[str, bytes]]:
    """Damaged copies of any file with what was done, without end: the same for the same seed."""
    import random

    rng = random.Random(seed)
    kinds: list[Callable[[random.Random, bytes], bytes]] = [
        _flipped, _cut, _zeroed, _removed, _repeated, _inserted, _overwritten, _numbers,
    ]  # fmt: skip
    while True:
        kind = rng.choice(kinds)
        yield kind.__name__.strip("_"), kind(rng, data)


def _place(rng, data):
    return rng.randrange(len(data))


def _flipped(rng, data):
    made = bytearray(data)
    for _ in range(rng.choice([1, 1, 1, 3, 10])):
        made[_place(rng, data)] ^= 1 << rng.randrange(8)
    return bytes(made)


def _cut(rng, data):
    return data[: _place(rng, data)]


def _zeroed(rng, data):
    at, size = _place(rng, data), rng.choice([1, 8, 100, 4096])
    return data[:at] + bytes(len(data[at : at + size])) + data[at + size :]


def _removed(rng, data):
    at = _place(rng, data)
    return data[:at] + data[at + rng.choice([1, 9, 1000]) :]


def _repeated(rng, data):
    at = _place(rng, data)
    return data[:at] + data[at : at + rng.choice([1, 100, 5000])] + data[at:]


def _inserted(rng, data):
    at = _place(rng, data)
    return data[:at] + rng.randbytes(rng.choice([1, 8, 300])) + data[at:]


def _overwritten(rng, data):
    at, size = _place(rng, data), rng.choice([4, 64, 2000])
    return data[:at] + rng.randbytes(len(data[at : at + size])) + data[at + size :]


def _numbers(rng, data):
    """A length, a count or an offset becomes an extreme one."""
    at = _place(rng, data)
    size = rng.choice([2, 4, 8])
    number = rng.choice([0, 1, (1 << 8 * size - 1) - 1, 1 << 8 * size - 1, (1 << 8 * size) - 1])
    return data[:at] + number.to_bytes(size, "little") + data[at + size :]
