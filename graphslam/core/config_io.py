"""Settings from TOML files and ``key=value`` overrides, and back to TOML text.

An unknown key, a wrong type or a value out of range is a `ConfigError` that names the key.
"""

import copy
import copyreg
import dataclasses
import difflib
import json
import math
import os
import tomllib
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from graphslam.core.config import Config
from graphslam.core.errors import ConfigError
from graphslam.core.presets import over, preset_settings

#: old name -> new name of keys that were renamed; an old name is accepted with a warning
RENAMED_KEYS = {
    "association.new_probability": "association.new_landmark_probability",
    "association.robots": "association.robot_sightings",
    "backend.polish": "backend.optimise_at_end",
    "backend.reconsider": "backend.reoptimise",
    "front_end.gap_share": "front_end.gap_ratio",
    "front_end.moving": "front_end.dynamic_objects",
    "keyframe.gather_s": "keyframe.sighting_window_s",
    "odometry.commanded": "odometry.commanded_velocities",
    "odometry.fixed": "odometry.fixed_calibration",
}


def load_config(
    path: Path | None = None, overrides: Sequence[str] = (), preset: str | None = None
) -> Config:
    """Defaults, then the preset, then the TOML file, then ``key=value`` overrides (dotted keys).

    A key of `RENAMED_KEYS` is accepted by its old name; `Config.warnings` then has a line on it.

    Raises:
        ConfigError: there is no such preset, the file cannot be read, a key is unknown, a value has
            the wrong type, or the file or the overrides give one setting by its old and its new
            name.
    """
    tree = _read(path)
    if preset is not None:
        tree = over(preset_settings(preset), tree)
    settings = map(parse_setting, overrides)
    return _override(tree, [(_split_key(key), value) for key, value in settings])


def chosen_config(
    config: Config | os.PathLike[str] | str | None = None,
    *,
    preset: str | None = None,
    **settings: Any,
) -> Config:
    """The defaults, over them preset, TOML file, ``settings``; over a `Config` the other two.

    Raises:
        ConfigError: the file cannot be read, or a setting is wrong.
    """
    if not isinstance(config, Config):
        config = load_config(Path(config) if config else None, (), preset)
    elif preset:
        config = with_preset(config, preset)
    return with_settings(config, settings) if settings else config


def with_preset(config: Config, name: str) -> Config:
    """The configuration with the settings of a preset over it.

    Raises:
        ConfigError: there is no such preset.
    """
    return with_settings(config, preset_settings(name))


def named_backend(
    path: Path | None, overrides: Sequence[str] = (), preset: str | None = None
) -> str | None:
    """The back end that preset, file and overrides, see `load_config`, ask for; None if none does.

    Raises:
        ConfigError: the file cannot be read, or an override has another form.
    """
    named = {} if preset is None else preset_settings(preset)
    table = over(named, _read(path)).get("backend", {})
    name = table.get("name") if isinstance(table, dict) else None
    for key, value in map(parse_setting, overrides):
        name = value if key == "backend.name" else name
    return None if name is None else str(name)


def _read(path: Path | None) -> dict[str, Any]:
    """The tree of a TOML file; empty without a file."""
    tree: dict[str, Any] = {}
    if path is not None:
        try:
            tree = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path}: not valid TOML: {error}") from error
    return tree


def parse_setting(text: str) -> tuple[str, Any]:
    """Dotted key and value of ``key=value``.

    Raises:
        ConfigError: the text has another form.
    """
    key, separator, value = text.partition("=")
    if not separator or not key.strip():
        raise ConfigError(f"--set {text}: write it as key=value, for example keyframe.mode=all")
    return key.strip(), _parse_value(value.strip())


def with_settings(config: Config, settings: Mapping[str, Any]) -> Config:
    """The configuration with other settings; what is not given stays as it is.

    Args:
        config: the settings to begin with.
        settings: dotted key -> value (``{"keyframe.mode": "all"}``) or table -> mapping
            (``{"keyframe": {"mode": "all"}}``); a text for a table that has a ``name`` is that name
            (``{"backend": "ekf"}``). An empty mapping empties its table. Arrays may stand for
            lists.

    Raises:
        ConfigError: as `load_config`.
    """
    tables, leaves = settings_of(Config), []
    for text, value in settings.items():
        keys = _split_key(text)
        if len(keys) == 1 and isinstance(value, str) and "name" in _hints(tables.get(keys[0])):
            keys = [*keys, "name"]
        leaves += _leaves(keys, value)
    changed = _override(tomllib.loads(dump_config(config)), leaves)
    return dataclasses.replace(changed, warnings=(*config.warnings, *changed.warnings))


def parse_config(text: str) -> Config:
    """Settings from the TOML text that `dump_config` writes; keys as in `load_config`.

    Raises:
        ConfigError: a key is unknown, a value has the wrong type.
    """
    tree = tomllib.loads(text)
    return _config(tree, _rename(tree))


def dump_config(config: Config) -> str:
    """The effective configuration as TOML text that `load_config` reads back to an equal tree."""
    lines: list[str] = []
    _dump(config, (), lines)
    return "\n".join(lines).strip() + "\n"


def settings_of(kind: Any) -> dict[str, Any]:
    """Name -> type of every setting of a table, or of every table of `Config`."""
    hints = typing.get_type_hints(kind)
    fields = dataclasses.fields(kind)
    return {f.name: hints[f.name] for f in fields if f.metadata.get("setting", True)}


def _override(tree: dict[str, Any], settings: Sequence[tuple[list[str], Any]]) -> Config:
    """The configuration of a tree with ``settings`` (keys, value) over it, one after the other."""
    renamed = _rename(tree)
    given: dict[str, Any] = {}  # the settings alone: they win over the tree, also by the new name
    for keys, value in settings:
        _set(given, keys, value)
        one: dict[str, Any] = {}
        _set(one, keys, copy.deepcopy(value))
        _rename(one)
        _set(tree, *_follow(one, len(keys)))
    return _config(tree, [*renamed, *_rename(given)])


def _leaves(keys: list[str], value: Any) -> list[tuple[list[str], Any]]:
    """(keys, value) of every setting in nested mappings."""
    if isinstance(value, Mapping) and value:
        return [leaf for key, item in value.items() for leaf in _leaves([*keys, str(key)], item)]
    return [(keys, value.tolist() if hasattr(value, "tolist") else value)]


def _hints(kind: Any) -> dict[str, Any]:
    return settings_of(kind) if dataclasses.is_dataclass(kind) else {}


def _config(tree: dict[str, Any], renamed: Sequence[str]) -> Config:
    """The configuration of a tree without old names, with one warning for each in ``renamed``."""
    config = _build(Config, tree, "")
    assert isinstance(config, Config)  # narrows the type; _build returns what it is asked for
    warnings = [f"{old} is now called {RENAMED_KEYS[old]}" for old in dict.fromkeys(renamed)]
    return dataclasses.replace(config, warnings=tuple(warnings))


def _unpickled(text: str, warnings: tuple[str, ...]) -> Config:
    return dataclasses.replace(parse_config(text), warnings=warnings)


# as TOML text: the read-only mappings that `_build` makes have no pickle of their own
copyreg.pickle(Config, lambda config: (_unpickled, (dump_config(config), config.warnings)))


def _rename(tree: dict[str, Any]) -> list[str]:
    """Replace old names in a tree, in place; which old names there were.

    Raises:
        ConfigError: a setting is given by both names.
    """
    found = []
    for old, new in RENAMED_KEYS.items():
        table, key = old.split(".")
        settings, new_key = tree.get(table), new.removeprefix(f"{table}.")
        if isinstance(settings, dict) and key in settings:
            if new_key in settings:
                raise ConfigError(f"{old}: is the old name of {new}, which is given too")
            settings[new_key] = settings.pop(key)
            found.append(old)
    return found


def _split_key(text: str) -> list[str]:
    """The parts of a dotted key; a part with a dot of its own is quoted, as in TOML."""
    try:
        node: Any = tomllib.loads(f"{text} = 0")
    except tomllib.TOMLDecodeError:
        return text.split(".")
    return _follow(node)[0]


def _follow(node: Any, depth: float = math.inf) -> tuple[list[str], Any]:
    """Keys and value at the end of nested tables of one key each, ``depth`` tables at most."""
    keys: list[str] = []
    while isinstance(node, dict) and len(keys) < depth:
        ((key, node),) = node.items()
        keys.append(key)
    return keys, node


def _set(tree: dict[str, Any], keys: list[str], value: object) -> None:
    for depth, key in enumerate(keys[:-1]):
        tree = tree.setdefault(key, {})
        if not isinstance(tree, dict):
            raise ConfigError(f"{'.'.join(keys)}: {'.'.join(keys[: depth + 1])} is not a table")
    tree[keys[-1]] = value


def _parse_value(text: str) -> object:
    """A TOML value; what is not valid TOML is taken as a string, so quotes may be left out."""
    try:
        return tomllib.loads(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:
        return text


def _build(kind: Any, value: Any, key: str) -> Any:
    """The value of type ``kind`` (dataclass, mapping, tuple, literal or scalar) at ``key``."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        return _build_table(kind, value, key)
    if origin is Literal:
        if value not in arguments:
            raise ConfigError(f"{key}: {value!r} is not one of {', '.join(map(str, arguments))}")
        return value
    if origin is Mapping:
        if not isinstance(value, dict):
            raise ConfigError(f"{key}: expected a table, got {value!r}")
        return types.MappingProxyType(
            {name: _build(arguments[1], item, f"{key}.{name}") for name, item in value.items()}
        )
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise ConfigError(f"{key}: expected a list, got {value!r}")
        return tuple(_build(arguments[0], item, f"{key}[{i}]") for i, item in enumerate(value))
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value) if abs(value) < 2**1000 else float("inf")
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise ConfigError(f"{key}: expected {kind.__name__}, got {value!r}")
    if kind is float and not abs(value) < math.inf and not (value == math.inf and key in _INFINITE):
        raise ConfigError(f"{key}: must be finite, got {value!r}")
    if kind in (int, float) and "[" not in key:
        _check_range(key, value)
    return value


def _check_range(key: str, value: float) -> None:
    """Numbers are between 0 and a million, zero excluded for some, probabilities between 0 and 1.

    Raises:
        ConfigError: the value is outside.
    """
    name = key.rpartition(".")[2]
    if name.endswith(("_probability", "_rate")):
        if not 0 < value < 1:
            raise ConfigError(f"{key}: must be between 0 and 1, got {value!r}")
    elif value < 0:
        raise ConfigError(f"{key}: must not be negative, got {value!r}")
    elif value == 0 and name in _NOT_ZERO:
        raise ConfigError(f"{key}: must be greater than 0")
    elif value > 1e6 and key not in _INFINITE:
        raise ConfigError(f"{key}: must not exceed a million, got {value!r}")


#: settings that may be infinite
_INFINITE = {"association.delete_s", "backend.horizon_s", "limits.memory_mb"}

#: settings that would be a divisor of 0, or make a covariance singular
_NOT_ZERO = {
    "consecutive_beams",
    "scale",
    "split_m",
    "hough_delta_d_m",
    "hough_gamma_steps",
    "range_sigma_m",
    "point_sigma_m",
    "cell_m",
    "reach_m",
    "max_range_m",
    "max_distance_m",
    "relinearize_every",
    "relinearize_threshold",
    "origin_sigma_m",
    "origin_sigma_rad",
    "given_sigma_m",
    "given_sigma_rad",
    "truth_sigma_m",
    "truth_sigma_rad",
    "wheel_radius_left_m",
    "wheel_radius_right_m",
    "axle_m",
    "floor_sigma_m",
    "floor_sigma_rad",
    "sightings_to_promote",
    "resolution_m",
    "max_side_cells",
    "gate_m",
    "along_sigma_m",
    "iterations",
    "particles",
    "sampling_m",
    "place_cell_m",
    "place_range_m",
    "memory_mb",
    "chunk_mb",
    "chunk_records",
}


def _build_table(kind: Any, value: Any, key: str) -> Any:
    if not isinstance(value, dict):
        raise ConfigError(f"{key}: is a table of settings, got {value!r}")
    hints = settings_of(kind)
    for name in value:
        if name not in hints:
            close = difflib.get_close_matches(name, hints, n=1)
            hint = f"did you mean {close[0]}?" if close else f"known: {', '.join(hints)}"
            raise ConfigError(f"{f'{key}.{name}'.lstrip('.')}: unknown key; {hint}")
    return kind(
        **{n: _build(hints[n], item, f"{key}.{n}".lstrip(".")) for n, item in value.items()}
    )


def _dump(node: Any, path: tuple[str, ...], lines: list[str]) -> None:
    items = (
        [(name, getattr(node, name)) for name in settings_of(type(node))]
        if dataclasses.is_dataclass(node)
        else list(node.items())
    )
    plain = [(n, v) for n, v in items if not dataclasses.is_dataclass(v) and not _is_table(v)]
    if path and (plain or not items):
        lines += ["", f"[{'.'.join(map(_key, path))}]"]
    lines += [f"{_key(name)} = {toml_value(value)}" for name, value in plain]
    for name, value in items:
        if dataclasses.is_dataclass(value) or _is_table(value):
            _dump(value, (*path, name), lines)


def _is_table(value: object) -> bool:
    return isinstance(value, Mapping)


def _key(name: str) -> str:
    bare = name.replace("_", "").replace("-", "")
    return name if bare.isalnum() and bare.isascii() else _quote(name)


def _quote(text: str) -> str:
    # JSON's escapes are TOML's as well, and DEL is the one control character that JSON leaves alone
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def toml_value(value: Any) -> str:
    """A setting as TOML: a truth value, a number, a text, or a list of these."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    return _quote(value) if isinstance(value, str) else repr(value)
