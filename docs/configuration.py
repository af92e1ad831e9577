"""Writes docs/configuration.md from the dataclasses in `graphslam.core.config`.

Run: python docs/configuration.py   (or `make pages`)
"""

import dataclasses
import inspect
import json
import math
import re
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from graphslam.core.config import Config
from graphslam.core.config_io import RENAMED_KEYS, settings_of
from graphslam.core.presets import PRESETS, preset_purpose, preset_settings

PAGE = Path(__file__).with_suffix(".md")

HEAD = """\
# Configuration

Made from `graphslam/core/config.py` and `sensor_config.py` by `make pages`; change it there.

One tree of settings; `graphslam config` prints it as TOML, with units. `graphslam smooth` takes the
defaults, then `--preset NAME`, then `--config FILE.toml`, then its own options (`--backend isam2`
is `backend.name`, `--front-end` is `front_end.name`, `--start` is
`start.from_truth` or `start.poses.ROBOT`), then every `--set KEY=VALUE`; what comes later wins.
Keys carry their unit. An unknown key, a wrong type or a value out of range is an error that names
the key. `config.toml` in a result folder is the whole tree as used; `--config` takes it back.

```
graphslam smooth LOG.mcap -o DIR --set keyframe.mode=all --set robust.kernel=none
```
"""

PRESET_HEAD = """\
## Presets

Small differences from the defaults (`--preset NAME`, `preset="NAME"` in Python); `graphslam config
--preset NAME` prints one as a file, with the reason of each setting.

| preset | for | settings |
|---|---|---|"""

RENAMED = """\
## Renamed keys

An old name is accepted with a warning; one setting may not be given by both names.

| old name | name |
|---|---|"""


def page() -> str:
    """The whole page."""
    parts = [HEAD]
    for name, kind in settings_of(Config).items():
        if typing.get_origin(kind) is Mapping:  # one table per name
            parts.append(section(f"[{name}.NAME]", typing.get_args(kind)[1]))
        else:
            parts.append(section(f"[{name}]", kind))
    parts += [PRESET_HEAD, *(preset_row(name) for name in PRESETS), ""]
    return "\n".join(
        [*parts, RENAMED, *(f"| `{a}` | `{b}` |" for a, b in RENAMED_KEYS.items()), ""]
    )


def preset_row(name: str) -> str:
    """One line on a preset."""
    settings = [
        f"`{table}.{key}`"
        for table, own in preset_settings(name).items()
        for key in (own if table != "robots" else [f"{robot}.outline" for robot in own])
    ]
    return f"| `{name}` | {preset_purpose(name)} | {', '.join(settings)} |"


def section(title: str, kind: Any) -> str:
    """One table of settings: its docstring, then keys with values and defaults."""
    hints, defaults = typing.get_type_hints(kind), kind()
    rows = [
        f"| `{field.name}` | {values(hints[field.name])} | `{default(defaults, field.name)}` |"
        for field in dataclasses.fields(kind)
    ]
    text = prose(inspect.cleandoc(kind.__doc__), list(hints))
    return "\n".join(
        [f"## `{title}`", "", text, "", "| key | values | default |", "|---|---|---|", *rows, ""]
    )


def prose(text: str, keys: list[str]) -> str:
    """A docstring as Markdown: names of keys, and tables in brackets, as code."""
    text = re.sub(r"\n +", "\n", text)
    for key in keys:  # one without an underscore is also a word, unless a clause begins with it
        pattern = rf"\b{key}\b" if "_" in key else rf"(?m)(?:^|(?<=[.,;] )){key}(?=:)"
        text = re.sub(pattern, f"`{key}`", text)
    return re.sub(r"\[.*?\]", r"`\g<0>`", text)


def values(kind: Any) -> str:
    """What a key takes, in words."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        return ", ".join(f"`{value}`" for value in arguments)
    if origin is Mapping:
        return f"table of {values(arguments[1])}"
    if origin is tuple and typing.get_origin(arguments[0]) is Literal:
        return f"list, any of {values(arguments[0])}"
    if origin is tuple:
        return f"list of {plural(values(arguments[0]))}"
    return {float: "number", int: "whole number", bool: "`true`, `false`", str: "text"}[kind]


def plural(text: str) -> str:
    """The plural of what `values` says of a list's items."""
    noun, of, items = text.partition(" of ")
    return f"{noun}s{of}{items}"


def default(defaults: Any, name: str) -> str:
    """A default as TOML; a table is empty."""
    value = getattr(defaults, name)
    if value == math.inf:  # JSON, which writes all else as TOML does, has none
        return "inf"
    return "{}" if isinstance(value, Mapping) else json.dumps(value)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
