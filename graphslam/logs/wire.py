"""Messages in protobuf and JSON as plain values, by the fields that are of interest.

Source: https://protobuf.dev/programming-guides/encoding/
"""

import json
import struct
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_MASK64 = (1 << 64) - 1


class WireError(Exception):
    """The bytes of a message do not fit its fields."""


class Field(NamedTuple):
    """A field of a protobuf message: its name, and its kind.

    ``kind``: ``int``, ``double``, ``string``, ``doubles`` (repeated), or the fields of a message;
    ``many``: the message is repeated.
    """

    name: str
    kind: Any
    many: bool = False


#: fields of a message by their numbers
Fields = Mapping[int, Field]


def from_protobuf(data: bytes, fields: Fields) -> dict[str, Any]:
    """The ``fields`` that are in ``data``; others are skipped.

    Raises:
        WireError: the bytes are cut short or are not such a message.
    """
    found: dict[str, Any] = {}
    at = 0
    try:
        while at < len(data):
            key, at = _varint(data, at)
            value, at = _value(data, at, key & 7)
            field = fields.get(key >> 3)
            if field is None:
                continue
            if field.many:
                found.setdefault(field.name, []).append(from_protobuf(value, field.kind))
            elif field.kind == "doubles":
                found.setdefault(field.name, []).extend(_doubles(value))
            else:
                found[field.name] = _single(value, field.kind)
    except (IndexError, struct.error, ValueError, TypeError, AttributeError) as error:
        raise WireError(str(error)) from error
    return found


def _varint(data: bytes, at: int) -> tuple[int, int]:
    result = shift = 0
    while True:
        byte = data[at]
        at += 1
        result |= (byte & 0x7F) << shift
        if byte < 0x80:
            return result & _MASK64, at
        shift += 7


def _value(data: bytes, at: int, wire_type: int) -> tuple[Any, int]:
    if wire_type == _VARINT:
        return _varint(data, at)
    if wire_type == _BYTES:
        size, at = _varint(data, at)
    else:
        size = {_FIXED64: 8, _FIXED32: 4}.get(wire_type, -1)
    if size < 0 or at + size > len(data):
        raise WireError("a field reaches beyond its message")
    return data[at : at + size], at + size


def _single(value: Any, kind: Any) -> Any:
    if kind == "int":
        return value - (1 << 64) if value >> 63 else value
    if kind == "double":
        return struct.unpack("<d", value)[0]
    return value.decode() if kind == "string" else from_protobuf(value, kind)


def _doubles(value: bytes) -> list[float]:
    """Packed or single."""
    found: list[float] = np.frombuffer(value, "<f8").tolist()
    return found


def from_json(data: bytes) -> dict[str, Any]:
    """The object in ``data``.

    Raises:
        WireError: it is not JSON, or not an object.
    """
    try:
        found = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise WireError(str(error)) from error
    if not isinstance(found, dict):
        raise WireError("not an object")
    return found
