"""What is done with records by the thousand: sent to another process, and changed in one field.

The standard library looks up the fields of a dataclass anew for each object, in Python.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from functools import cache
from operator import attrgetter
from typing import Any, NamedTuple, TypeVar

import numpy as np

_T = TypeVar("_T")

#: numbers of an array that is sent together with others; larger ones would all be kept in memory
#: for the sake of one of them
MAX_STACKED = 9


class Record:
    """A frozen dataclass with slots, of two fields at least; pickled as a call of its class."""

    __slots__ = ()

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        """The class and the values of all fields."""
        kind: Any = type(self)
        return kind, _values_of(kind)(self)


def replace(record: _T, /, **changes: Any) -> _T:
    """`dataclasses.replace` of a dataclass with two fields at least, several times as fast."""
    kind: Any = type(record)
    made: _T = kind(**(dict(zip(_names_of(kind), _values_of(kind)(record), strict=True)) | changes))
    return made


@cache
def _names_of(kind: Any) -> tuple[str, ...]:
    return tuple(one.name for one in fields(kind))


@cache
def _values_of(kind: Any) -> Callable[[Any], tuple[Any, ...]]:
    return attrgetter(*_names_of(kind))


class Packed(NamedTuple):
    """Records to be sent to another process: small arrays of many of them as one.

    ``kinds``: the number of each one's class; ``fields``: by class, the values of all its records.
    """

    kinds: Sequence[int]
    fields: Sequence[tuple[type, Sequence["_Stack | Sequence[Any]"]]]


class _Stack(NamedTuple):
    """Arrays of one shape: ``which`` of the different ones ``arrays`` (n, ...) each is."""

    arrays: np.ndarray[Any, Any]
    which: Sequence[int]


def packed(records: Sequence[Any]) -> Packed:
    """Dataclasses with two fields at least, to be unpacked by `unpacked`."""
    numbers: dict[type, int] = defaultdict(lambda: len(numbers))
    kinds = [numbers[type(record)] for record in records]
    own: list[list[tuple[Any, ...]]] = [[] for _ in numbers]
    values_of = [_values_of(kind) for kind in numbers]
    for number, record in zip(kinds, records, strict=True):
        own[number].append(values_of[number](record))
    columns = [[_stacked(column) for column in zip(*rows, strict=True)] for rows in own]
    return Packed(kinds, list(zip(numbers, columns, strict=True)))


def unpacked(sent: Packed) -> Iterator[Any]:
    """The records in their order; what they shared is shared."""
    made = [
        map(kind, *(_separate(column) if isinstance(column, _Stack) else column for column in own))
        for kind, own in sent.fields
    ]
    return (next(made[number]) for number in sent.kinds)


def _stacked(values: Sequence[Any]) -> _Stack | Sequence[Any]:
    """The values of one field; arrays as one if all have one shape and are small."""
    first = values[0]
    if not isinstance(first, np.ndarray) or first.size > MAX_STACKED:
        return values
    shape = first.dtype, first.shape
    if any(not isinstance(v, np.ndarray) or (v.dtype, v.shape) != shape for v in values):
        return values
    different = {id(v): v for v in values}
    place = {name: k for k, name in enumerate(different)}
    arrays = np.concatenate([v.ravel() for v in different.values()])
    return _Stack(arrays.reshape(-1, *first.shape), [place[id(v)] for v in values])


def _separate(stack: _Stack) -> Iterator[np.ndarray[Any, Any]]:
    return map(list(stack.arrays).__getitem__, stack.which)
