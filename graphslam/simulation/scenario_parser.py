"""Parsed TOML to the records of `graphslam.simulation.scenario`; errors are one line."""

import dataclasses
import difflib
import types
import typing
from collections.abc import Mapping
from math import isfinite
from operator import ge, gt, le
from typing import Any

from graphslam.simulation.scenario import ScenarioError

_NONE: Mapping[str, Any] = {}
_BOUNDS = (("above", gt, "above"), ("least", ge, "at least"), ("most", le, "at most"))


def build(kind: Any, value: Any, key: str = "", bounds: Mapping[str, Any] = _NONE) -> Any:
    """The value of type ``kind`` (record, mapping, tuple, optional or scalar) at ``key``.

    Numbers, also those in tuples, are checked against ``bounds``: above, least, most.

    Raises:
        ScenarioError: unknown or missing key, wrong type, number out of bounds; names the key.
    """
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        return _record(kind, value, key)
    if origin is types.UnionType:  # X | None: TOML has no null, the key is present or not
        return build(arguments[0], value, key, bounds)
    if origin is Mapping:
        items = _table(value, key)
        made = {name: build(arguments[1], v, f"{key}.{name}") for name, v in items.items()}
        return types.MappingProxyType(made)
    if origin is tuple:
        return _tuple(arguments, value, key, bounds)
    return _scalar(kind, value, key, bounds)


def _record(kind: Any, value: Any, key: str) -> Any:
    hints = typing.get_type_hints(kind)
    known = {f.name: f for f in dataclasses.fields(kind) if not f.metadata.get("hidden")}
    prefix = f"{key}." if key else ""
    for name in _table(value, key):
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean {close[0]}?" if close else f"known: {', '.join(known)}"
            raise ScenarioError(f"{prefix}{name}: unknown key; {hint}")
    for name, f in known.items():
        if name not in value and f.default is f.default_factory is dataclasses.MISSING:
            raise ScenarioError(f"{prefix}{name}: missing; give it")
    return kind(
        **{n: build(hints[n], v, f"{prefix}{n}", known[n].metadata) for n, v in value.items()}
    )


def _table(value: Any, key: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ScenarioError(f"{key}: expected a table, got {value!r}")
    return value


def _tuple(arguments: tuple[Any, ...], value: Any, key: str, bounds: Mapping[str, Any]) -> Any:
    if not isinstance(value, list):
        raise ScenarioError(f"{key}: expected a list, got {value!r}")
    if arguments[-1] is not ... and len(value) != len(arguments):
        raise ScenarioError(f"{key}: expected {len(arguments)} values, got {value!r}")
    return tuple(build(arguments[0], v, f"{key}[{i}]", bounds) for i, v in enumerate(value))


def _scalar(kind: Any, value: Any, key: str, bounds: Mapping[str, Any]) -> Any:
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise ScenarioError(f"{key}: expected {kind.__name__}, got {value!r}")
    if kind in (int, float):
        if not isfinite(value):
            raise ScenarioError(f"{key}: must be finite, got {value}")
        for bound, holds, text in _BOUNDS:
            if bound in bounds and not holds(value, bounds[bound]):
                raise ScenarioError(f"{key}: must be {text} {bounds[bound]:g}, got {value:g}")
    return value
