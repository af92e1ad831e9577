"""CDR, the encoding of ROS 2 messages: from bytes to plain values.

`Decoder` reads any message of a known definition. `Layout` reads many messages at once, if their
strings and sequences have equal lengths, so that every number has the same place in all of them.

Source: OMG, DDS Interoperability Wire Protocol 2.5, section 10 (CDR).
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

#: header before every message; its second byte is the byte order, 1 for little-endian
HEADER = 4
#: bytes after a message that only pad it
_PADDING = 3

_CODES = {
    "bool": "?", "byte": "B", "char": "b", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H",
    "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip


class CdrError(Exception):
    """The bytes of one message do not fit its schema."""


class _Cursor:
    """Place in the bytes of a message."""

    __slots__ = ("at", "data", "order")

    def __init__(self, data: bytes) -> None:
        self.data, self.at, self.order = data, HEADER, byte_order(data)


_Read = Callable[[_Cursor], Any]


def byte_order(data: bytes) -> str:
    """``<`` or ``>``.

    Raises:
        CdrError: the header is not that of plain CDR.
    """
    order = {b"\x00\x00": ">", b"\x00\x01": "<"}.get(bytes(data[:2]))
    if order is None or len(data) < HEADER:
        raise CdrError("not plain CDR")
    return order


class Decoder:
    """Reads messages by definitions in the text form of ROS 2 (ros2msg).

    A message becomes a namespace of its fields; arrays of numbers are numpy arrays (n,).
    """

    def __init__(self, definitions: Mapping[str, str]) -> None:
        """``definitions``: name of a type, as it is written in fields, -> its text."""
        self._definitions = definitions
        self._compiled: dict[str, _Read] = {}

    def decode(self, name: str, data: bytes) -> Any:
        """The message of type ``name`` in ``data``.

        Raises:
            CdrError: the bytes are cut short or are not such a message.
        """
        cursor = _Cursor(data)
        try:
            message = self._message(name)(cursor)
        except (struct.error, ValueError, OverflowError) as error:
            raise CdrError(str(error)) from error
        if not len(data) - _PADDING <= cursor.at <= len(data):
            raise CdrError("longer or shorter than its fields")
        return message

    def _message(self, name: str) -> _Read:
        if name not in self._compiled:
            lines = [line.split("#")[0].split() for line in self._definitions[name].splitlines()]
            fields = [(field, self._field(kind)) for kind, field in filter(None, lines)]
            self._compiled[name] = lambda cursor: SimpleNamespace(
                **{field: read(cursor) for field, read in fields}
            )
        return self._compiled[name]

    def _field(self, kind: str) -> _Read:
        element, bracket, size = kind.partition("[")
        count = int(size[:-1]) if len(size) > 1 else None  # None: the message has the number
        if not bracket:
            if element == "string":
                return _string
            return _number(_CODES[element]) if element in _CODES else self._message(element)
        if element in _CODES:
            return _numbers(_CODES[element], count)
        read = self._field(element)
        length = _number("I")
        return lambda cursor: [
            read(cursor) for _ in range(length(cursor) if count is None else count)
        ]


def _number(code: str) -> _Read:
    size = struct.calcsize(code)
    unpack = {order: struct.Struct(order + code).unpack_from for order in "<>"}

    def read(cursor: _Cursor) -> Any:
        at = _aligned(cursor.at, size)
        cursor.at = at + size
        return unpack[cursor.order](cursor.data, at)[0]

    return read


def _numbers(code: str, count: int | None) -> _Read:
    size, length = struct.calcsize(code), _number("I")

    def read(cursor: _Cursor) -> Any:
        number = length(cursor) if count is None else count
        if not number:
            return np.empty(0, dtype=code)  # without padding
        at = _aligned(cursor.at, size)
        cursor.at = at + number * size
        found = np.frombuffer(cursor.data, cursor.order + code, number, at)
        return found.astype(code, copy=False)

    return read


_length = _number("I")


def _string(cursor: _Cursor) -> str:
    size = _length(cursor)
    raw = cursor.data[cursor.at : cursor.at + size]
    cursor.at += size
    if len(raw) != size:
        raise CdrError("a string is cut short")
    return string(raw)


def string(raw: bytes) -> str:
    """The text of a string; its end, a zero byte, is not always written.

    Raises:
        CdrError: it is no text.
    """
    try:
        return raw.removesuffix(b"\0").decode()
    except UnicodeDecodeError as error:
        raise CdrError(str(error)) from error


def _aligned(at: int, size: int) -> int:
    """Numbers lie at multiples of their size, counted from the end of the header."""
    return at + -(at - HEADER) % size


class Layout:
    """Places of the fields of messages whose strings and sequences have given lengths."""

    def __init__(self, order: str) -> None:
        """``order``: see `byte_order`."""
        self.order, self.size = order, HEADER
        self._fields: list[tuple[str, Any, int]] = [("head", f"S{HEADER}", 0)]

    def number(self, name: str, code: str, count: int | None = None) -> None:
        """The next field is a number with a type code of `struct`, or an array of ``count``."""
        at = self.size if count == 0 else _aligned(self.size, struct.calcsize(code))
        kind: Any = self.order + code if count is None else (self.order + code, (count,))
        self._fields.append((name, kind, at))
        self.size = at + (1 if count is None else count) * struct.calcsize(code)

    def string(self, name: str, size: int) -> None:
        """The next field is a string of ``size`` bytes with its end; ``name_size`` precedes it."""
        self.number(f"{name}_size", "I")
        self._fields.append((name, f"S{size}", self.size))
        self.size += size

    def skip(self, size: int) -> None:
        """The next ``size`` bytes are not read."""
        self.size += size

    def table(self, data: Sequence[bytes], same: Sequence[str]) -> Any:
        """Rows (n,) of the fields of n messages; the fields ``same`` are equal in all of them.

        Raises:
            CdrError: the messages do not have this layout, or differ in these fields.
        """
        names, kinds, offsets = zip(*self._fields, strict=True)
        size = len(data[0])
        if not self.size <= size <= self.size + _PADDING or any(len(one) != size for one in data):
            raise CdrError("the lengths do not fit the layout")
        kind: Any = {"names": names, "formats": kinds, "offsets": offsets, "itemsize": size}
        rows: Any = np.frombuffer(b"".join(data), dtype=np.dtype(kind))
        if any((rows[name] != rows[name][0]).any() for name in ("head", *same)):
            raise CdrError("the messages differ in their layout")
        return rows


def last_strings(data: Sequence[bytes], at: int, order: str, count: int) -> list[tuple[str, ...]]:
    """The ``count`` strings with which each of many messages ends, from the byte ``at`` on.

    Raises:
        CdrError: one is cut short, or does not end there.
    """
    length, found = struct.Struct(order + "I").unpack_from, []
    try:
        for one in data:
            end, strings = at, []
            for _ in range(count):
                begin = _aligned(end, 4) + 4
                end = begin + length(one, begin - 4)[0]
                strings.append(string(one[begin:end]))
            if not end <= len(one) <= end + _PADDING:
                raise CdrError("longer or shorter than its fields")
            found.append(tuple(strings))
    except struct.error as error:
        raise CdrError(str(error)) from error
    return found


def u32(data: bytes, at: int, order: str) -> int:
    """The length of a string or sequence at ``at``.

    Raises:
        CdrError: the message ends before.
    """
    try:
        return int(struct.unpack_from(order + "I", data, at)[0])
    except struct.error as error:
        raise CdrError(str(error)) from error
