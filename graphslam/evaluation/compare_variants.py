"""Variants of a comparison: specifications of back ends, and the settings they stand for."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from graphslam.core.config import Config
from graphslam.core.config_io import parse_setting, with_preset, with_settings
from graphslam.core.errors import ConfigError
from graphslam.core.presets import PRESETS
from graphslam.core.suggestions import did_you_mean
from graphslam.estimation.backends import BACKENDS

#: names of back ends in tables; the others have the name in `BACKENDS`
NAMES = {
    "batch": "Batch",
    "dead-reckoning": "Dead reckoning",
    "decentralised": "Decentralised",
    "ekf": "EKF",
    "imm": "IMM",
    "isam2": "iSAM2",
}


@dataclass(frozen=True, slots=True)
class Variant:
    """One row: its specification, its label in tables, and its settings."""

    spec: str
    label: str
    config: Config

    @property
    def horizon_s(self) -> float | None:
        """How long past poses are kept, s; None where the back end has no horizon."""
        return self.config.backend.horizon_s if self.config.backend.name == "isam2" else None


def parse_variants(specs: Sequence[str], config: Config | None = None) -> tuple[Variant, ...]:
    """The variants of ``specs``, each over the settings of ``config``.

    Raises:
        ConfigError: a specification is unknown, malformed or given twice; the message names it.
    """
    found = tuple(_variant(spec, config or Config()) for spec in specs)
    if not found:
        raise ConfigError("--backends: names no back end")
    for number, variant in enumerate(found):
        if variant.config in [other.config for other in found[:number]]:
            raise ConfigError(f"--backends: {variant.spec} is given twice")
    return found


def _variant(spec: str, config: Config) -> Variant:
    head, *settings = spec.split("+")
    name, colon, horizon = head.partition(":")
    label = NAMES.get(name, name)
    if name in PRESETS:
        config = with_preset(config, name)
        name, label = config.backend.name, f"{name}: {NAMES.get(config.backend.name, name)}"
    if name not in BACKENDS:
        known = ", ".join(sorted([*BACKENDS, *PRESETS]))
        hint = did_you_mean(name, [*BACKENDS, *PRESETS])
        raise ConfigError(f"--backends: {spec!r} is not one of {known}{hint}")
    if colon and name != "isam2":
        raise ConfigError(f"--backends {spec}: only isam2 has a horizon")
    if colon:
        settings.insert(0, f"backend.horizon_s={horizon}")
    try:
        config = with_settings(config, {"backend": name} | dict(map(parse_setting, settings)))
    except ConfigError as error:
        raise ConfigError(f"--backends {spec}: {error}") from error
    if name == "isam2" and math.isfinite(config.backend.horizon_s):
        label += f", horizon {config.backend.horizon_s:g} s"
    # the horizon is in the label, the error frame is added to that of a filter
    shown = ("backend.horizon_s=", "ekf.error=") if name == "ekf" else ("backend.horizon_s=",)
    extra = [text for text in settings if not text.startswith(shown)]
    return Variant(spec, ", ".join([label, *extra]), config)
