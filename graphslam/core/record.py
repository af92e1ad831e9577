"""The base of records that are sent to another process by the thousand."""

from collections.abc import Callable
from dataclasses import fields
from functools import cache
from operator import attrgetter
from typing import Any


class Record:
    """A frozen dataclass with slots, of two fields at least; pickled as a call of its class.

    By default such a class looks up its fields anew for every object, in Python, on both sides:
    that took longer than decoding a message.
    """

    __slots__ = ()

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        """The class and the values of all fields."""
        kind: Any = type(self)
        return kind, _values_of(kind)(self)


@cache
def _values_of(kind: Any) -> Callable[[Any], tuple[Any, ...]]:
    return attrgetter(*(one.name for one in fields(kind)))
