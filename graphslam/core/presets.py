"""Presets: small documented differences from the defaults, each a TOML file of the package."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from graphslam.core.errors import ConfigError

_FOLDER = Path(__file__).parent / "presets"

#: name -> file of a preset
PRESETS: dict[str, Path] = {
    name: _FOLDER / f"{name}.toml" for name in ("thesis", "indoor", "points", "fleet")
}


def preset_text(name: str) -> str:
    """The file of a preset: what it is for, and its settings, each with its reason.

    Raises:
        ConfigError: there is no such preset.
    """
    if name not in PRESETS:
        raise ConfigError(f"--preset {name}: is not one of {', '.join(PRESETS)}")
    return PRESETS[name].read_text(encoding="utf-8")


def preset_settings(name: str) -> dict[str, Any]:
    """Table -> key -> value of a preset.

    Raises:
        ConfigError: there is no such preset.
    """
    return tomllib.loads(preset_text(name))


def preset_purpose(name: str) -> str:
    """What a preset is for: the comment that its file begins with.

    Raises:
        ConfigError: there is no such preset.
    """
    head = preset_text(name).partition("\n\n")[0]
    return " ".join(line.removeprefix("#").strip() for line in head.splitlines())


def over(tree: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    """A tree of settings with others over it, table by table; neither is changed."""
    out = dict(tree)
    for key, value in settings.items():
        below = out.get(key)
        if isinstance(value, Mapping) and isinstance(below, Mapping):
            out[key] = over(below, value)
        else:
            out[key] = value
    return out
