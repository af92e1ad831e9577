"""Records of this program as bytes, and back: what a run keeps of itself on disk.

Not pickle: bytes on a disk may come from anybody, and unpickling them runs what they say. Here a
class is named by its place in a table that the reader brings along, and is filled without calling
anything of it. What is not in the table, and whatever is no data, cannot be read or written.

The same object at two places is one object again after reading (as long as it is not part of an
array), and floats, stamps and the order of arrays in memory are exactly what they were.
"""

import json
import re
from collections import Counter, defaultdict, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np

from graphslam.core.errors import GraphSlamError

#: types that JSON keeps as they are; of floats also infinities and NaN
PLAIN = frozenset({type(None), bool, int, float, str})
_LENGTH_BYTES = 8
#: kinds of numbers that an array may have: all of fixed size, and no objects
_NUMBERS = "biufc"
_NAME_OF_NUMBERS = re.compile(f"[<>|][{_NUMBERS}][0-9]{{1,2}}")
#: what reading bytes of somebody else may end in
_NOT_OURS = (
    ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError,
)  # fmt: skip


class CodecError(GraphSlamError):
    """Bytes that are none of `write`, or not of this table of classes."""


class Kinds:
    """The classes of which records may be, by name; ``left_out``: attributes that become None."""

    def __init__(
        self, classes: Sequence[type], left_out: Mapping[type, frozenset[str]] | None = None
    ) -> None:
        self.by_name = {f"{kind.__module__}.{kind.__qualname__}": kind for kind in classes}
        self.name_of = {kind: name for name, kind in self.by_name.items()}
        self.left_out = left_out or {}

    def attributes(self, value: Any) -> dict[str, Any]:
        """All that makes up a record, by name."""
        kind = type(value)
        if is_dataclass(kind):
            found = {f.name: getattr(value, f.name) for f in fields(kind)}
        else:
            found = dict(vars(value))
        return found | dict.fromkeys(self.left_out.get(kind, ()))


class Sink(Protocol):
    """What can be written to."""

    def write(self, data: bytes, /) -> object:
        """Take bytes."""


def write(value: Any, kinds: Kinds, stream: Sink) -> None:
    """Write a value: plain ones, arrays, containers of the standard library, records of ``kinds``.

    Raises:
        TypeError: it holds something else.
    """
    writer = _Writer(kinds)
    content = [writer.put(value), writer.shapes]
    text = json.dumps(content, separators=(",", ":")).encode()
    stream.write(len(text).to_bytes(_LENGTH_BYTES, "little"))
    stream.write(text)
    for array in writer.arrays:
        stream.write(array.tobytes("A"))


def read(data: bytes, kinds: Kinds) -> Any:
    """What `write` wrote.

    Raises:
        CodecError: it is something else.
    """
    try:
        start = _LENGTH_BYTES + int.from_bytes(data[:_LENGTH_BYTES], "little")
        content, shapes = json.loads(data[_LENGTH_BYTES:start])
        return _Reader(kinds, shapes, data, start).get(content)
    except _NOT_OURS as error:
        raise CodecError(f"no records of this program: {error}") from error


#: how the list begins that stands for a new object
_LETTERS: Mapping[type, str] = {
    np.ndarray: "a", list: "l", dict: "d", Counter: "c", set: "s", frozenset: "z", deque: "q",
    MappingProxyType: "d",
}  # fmt: skip


def _letter(kind: type, value: Any, kinds: Kinds) -> str:
    """Raises `TypeError` for what is not kept."""
    if kind in _LETTERS:
        return _LETTERS[kind]
    if kind in kinds.name_of:
        return "p" if isinstance(value, tuple) else "o"
    if kind is defaultdict and value.default_factory in (float, int):
        return "f" if value.default_factory is float else "i"
    raise TypeError(f"{kind.__module__}.{kind.__qualname__} is not kept on disk")


class _Writer:
    """Values as lists that begin with a letter; ``arrays`` follow, of ``shapes``."""

    def __init__(self, kinds: Kinds) -> None:
        self._kinds = kinds
        self._seen: dict[int, int] = {}
        self._held: list[Any] = []  # so that no number of an object is used again
        self.arrays: list[np.ndarray[Any, Any]] = []
        self.shapes: list[tuple[str, tuple[int, ...], str]] = []

    def put(self, value: Any) -> Any:
        kind = type(value)
        if kind in PLAIN:
            return value
        if kind is tuple:
            return ["t", *map(self.put, value)]
        number = self._seen.get(id(value))
        if number is not None:
            return ["=", number]
        if kind is bytes:
            return ["b", self._array(np.frombuffer(value, np.uint8))]
        if isinstance(value, np.generic):
            return ["n", self._array(np.asarray(value))]
        self._seen[id(value)] = len(self._held)
        self._held.append(value)
        return [_letter(kind, value, self._kinds), *self._content(kind, value)]

    def _content(self, kind: type, value: Any) -> Iterable[Any]:
        """What makes up an object, as in the list that stands for it."""
        if kind is np.ndarray:
            return [self._array(value)]
        if kind is list and set(map(type, value)) <= PLAIN:
            return list(value)
        if isinstance(value, (dict, MappingProxyType)):
            return self._pairs(value)
        if isinstance(value, (set, frozenset)):
            return map(self.put, sorted(value))
        if kind in self._kinds.name_of:
            named = isinstance(value, tuple)
            found = map(self.put, value) if named else self._pairs(self._kinds.attributes(value))
            return [self._kinds.name_of[kind], *found]
        return [*([value.maxlen] if kind is deque else []), *map(self.put, value)]

    def _pairs(self, value: Mapping[Any, Any]) -> list[Any]:
        return [self.put(one) for pair in value.items() for one in pair]

    def _array(self, array: np.ndarray[Any, Any]) -> int:
        if array.dtype.kind not in _NUMBERS:
            raise TypeError(f"arrays of {array.dtype} are not kept on disk")
        fortran = array.flags.f_contiguous and not array.flags.c_contiguous
        self.shapes.append((array.dtype.str, array.shape, "F" if fortran else "C"))
        self.arrays.append(array)
        return len(self.arrays) - 1


class _Reader:
    """The inverse of `_Writer`; objects are numbered in the same order."""

    def __init__(self, kinds: Kinds, shapes: Sequence[Any], data: bytes, start: int) -> None:
        self._kinds, self._made = kinds, list[Any]()
        self._arrays = []
        for dtype, shape, order in shapes:
            if not _NAME_OF_NUMBERS.fullmatch(dtype) or order not in ("C", "F"):
                raise ValueError(f"an array of {dtype}")
            kind = np.dtype(dtype)
            count = int(np.prod(shape, dtype=np.int64))
            flat = np.frombuffer(data, kind, count, start)
            self._arrays.append(flat.reshape(shape, order=order).copy(order="K"))
            start += flat.nbytes
        if start != len(data):
            raise ValueError("it is of another length")

    def get(self, content: Any) -> Any:
        if type(content) is not list:
            return content
        letter, *rest = content
        if letter == "t":
            return tuple(map(self.get, rest))
        if letter == "=":
            return self._made[rest[0]]
        if letter in ("a", "b", "n"):
            array = self._arrays[rest[0]]
            if letter == "a":
                self._made.append(array)
                return array
            return array.tobytes() if letter == "b" else array[()]
        return self._container(letter, rest)

    def _container(self, letter: str, rest: list[Any]) -> Any:
        """A new object, which is numbered before those in it."""
        made: Any
        if letter == "l":
            self._made.append(made := [])
            made.extend(map(self.get, rest))
        elif letter in "dcfi":
            self._made.append(made := _empty(letter))
            for key, value in self._pairs(rest):
                made[key] = value
        elif letter == "q":
            self._made.append(made := deque(maxlen=rest[0]))
            made.extend(map(self.get, rest[1:]))
        elif letter == "o":
            made = object.__new__(self._kinds.by_name[rest[0]])
            self._made.append(made)
            for key, value in self._pairs(rest[1:]):
                object.__setattr__(made, key, value)
        else:  # those that cannot be filled later, and so cannot hold themselves
            place = len(self._made)
            self._made.append(None)
            if letter == "p":
                kind = self._kinds.by_name[rest[0]]
                made = tuple.__new__(kind, tuple(map(self.get, rest[1:])))
            else:
                made = {"s": set, "z": frozenset}[letter](map(self.get, rest))
            self._made[place] = made
        return made

    def _pairs(self, rest: list[Any]) -> Any:
        read = map(self.get, rest)
        return zip(read, read, strict=True)


def _empty(letter: str) -> dict[Any, Any]:
    """The mapping that is to be filled."""
    if letter in "fi":
        return defaultdict(float if letter == "f" else int)
    return Counter() if letter == "c" else {}
