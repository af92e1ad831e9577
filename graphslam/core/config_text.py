"""All settings as documented TOML: what `graphslam config` prints."""

import dataclasses
import inspect
import math
import typing
from collections.abc import Mapping
from typing import Any, Literal

from graphslam.core.config import Config
from graphslam.core.config_io import settings_of, toml_value
from graphslam.core.presets import PRESETS, preset_purpose, preset_settings, preset_text

#: end of a key -> unit of its value; the first that fits
_UNITS = (
    ("_rad_per_m", "rad/m"),
    ("_m_s", "m/s"),
    ("_rad_s", "rad/s"),
    ("_probability", "0 to 1"),
    ("_rate", "0 to 1"),
    ("_m", "m"),
    ("_rad", "rad"),
    ("_s", "s"),
)
#: variances of the model error (thesis 4.14)
_VARIANCES = {
    f"k_{axis}_{of}": f"{unit}²/{of}"
    for axis, unit in (("x", "m"), ("y", "m"), ("phi", "rad"))
    for of in ("m", "rad", "s")
}


def unit_of(key: str) -> str | None:
    """Unit of a setting by its name; None for a number or a text."""
    if key in _VARIANCES:
        return _VARIANCES[key]
    return next((unit for end, unit in _UNITS if key.endswith(end)), None)


def choices_of(kind: Any) -> tuple[str, ...] | None:
    """What a setting of a type may be; None if that is not a list of words."""
    if typing.get_origin(kind) is tuple:  # several of them
        kind = typing.get_args(kind)[0]
    return typing.get_args(kind) if typing.get_origin(kind) is Literal else None


def documented_settings() -> str:
    """The whole tree with its defaults, units and explanations, as TOML, then the presets.

    Read back as a file it gives the defaults.
    """
    parts = []
    for name, kind in settings_of(Config).items():
        if typing.get_origin(kind) is Mapping:  # one table per name, none by default
            table = _table(f"{name}.NAME", typing.get_args(kind)[1])
            parts.append(_commented(table))
        else:
            parts.append(_table(name, kind))
    presets = [
        f"# ---- preset {name}: only what differs\n{_commented(preset_text(name).strip())}\n"
        for name in PRESETS
    ]
    return "\n".join([*parts, *presets])


def _table(title: str, kind: Any) -> str:
    """One table: its explanation as comments, then keys with defaults and units."""
    hints, defaults = settings_of(kind), kind()
    doc = [f"# {line}".rstrip() for line in inspect.cleandoc(kind.__doc__ or "").splitlines()]
    rows = []
    for key, hint in hints.items():
        value = getattr(defaults, key)
        choices = choices_of(hint)
        note = " | ".join(choices) if choices else unit_of(key)
        text = f"{key} = {'{}' if isinstance(value, Mapping) else toml_value(value)}"
        rows.append(f"{text}  # {note}" if note else text)
    return "\n".join([f"[{title}]", *doc, *rows, ""])


def _commented(text: str) -> str:
    """Every line as a comment; a line that is one already stays."""
    return "\n".join(
        line if line.startswith("#") else f"# {line}".rstrip() for line in text.split("\n")
    )


def settings_tree() -> dict[str, Any]:
    """Table -> key -> default, unit and choices, and the presets: what ``config --json`` prints."""
    tables = {}
    for name, kind in settings_of(Config).items():
        own = typing.get_args(kind)[1] if typing.get_origin(kind) is Mapping else kind
        defaults = dataclasses.asdict(own())
        tables[f"{name}.NAME" if own is not kind else name] = {
            key: {
                "default": "inf" if defaults[key] == math.inf else defaults[key],  # JSON has none
                "unit": unit_of(key),
                "choices": choices_of(hint),
            }
            for key, hint in settings_of(own).items()
        }
    presets = {
        name: {"purpose": preset_purpose(name), "settings": preset_settings(name)}
        for name in PRESETS
    }
    return {"settings": tables, "presets": presets}
