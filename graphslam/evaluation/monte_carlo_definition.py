"""The definition of an experiment: a TOML file, or the name of one of the package.

Bounds of the numbers are in the metadata of the fields and are checked as those of scenarios.
Angles in files are degrees.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from graphslam.core.config import Config
from graphslam.core.config_io import load_config
from graphslam.core.errors import ConfigError
from graphslam.core.suggestions import did_you_mean
from graphslam.evaluation.thesis_experiments import EXPERIMENTS as THESIS_EXPERIMENTS
from graphslam.simulation import load_scenario
from graphslam.simulation.scenario import NOT_NEGATIVE, POSITIVE, SHARE, Point, ScenarioError
from graphslam.simulation.scenario_parser import build

_FOLDER = Path(__file__).parent / "experiments"
_PRESET = "preset="

#: name -> file of an experiment of the package
EXPERIMENTS: dict[str, Path] = {
    name: _FOLDER / f"{name}.toml"
    for name in (
        "ekf-versus-smoothing",
        "filters",
        "slip",
        "network",
        "thesis",
        "rooms",
        "consistency",
        "three-filters",
    )
}


@dataclass(frozen=True)
class PlannedMotions:
    """A part of a planned path: ``steps`` equal motions, each forward and then a turn."""

    steps: int = field(metadata={"least": 1})
    forward_m: float
    turn_deg: float = 0.0


@dataclass(frozen=True)
class BenchRobot:
    """A robot on the bench: the mean of its prior, and its path."""

    start_m: Point
    path: tuple[PlannedMotions, ...]
    start_deg: float = 0.0


@dataclass(frozen=True)
class Sigmas:
    """Standard deviations at noise scale 1; those of motions are per step.

    start_m, start_deg: of the start. along_m, across_m, turn_deg: of a motion. bearing_deg,
    range_m: of a sighting of a point. line_m, line_deg: normal offset and direction of a line where
    it is observed. robot_m, robot_deg: position and direction of another robot.
    """

    start_m: float = field(metadata=POSITIVE)
    start_deg: float = field(metadata=POSITIVE)
    along_m: float = field(metadata=POSITIVE)
    across_m: float = field(metadata=POSITIVE)
    turn_deg: float = field(metadata=POSITIVE)
    bearing_deg: float = field(metadata=POSITIVE)
    range_m: float = field(metadata=POSITIVE)
    line_m: float = field(metadata=POSITIVE)
    line_deg: float = field(metadata=POSITIVE)
    robot_m: float = field(default=0.1, metadata=POSITIVE)
    robot_deg: float = field(default=3.0, metadata=POSITIVE)


@dataclass(frozen=True)
class Slip:
    """Motions whose error is larger than stated.

    share: of each robot's motions, drawn one by one. scale: of the sigmas of their errors. told:
    variants whose motions state that, which no odometry does: what could be reached at best.
    """

    share: float = field(metadata=SHARE)
    scale: float = field(metadata=POSITIVE)
    told: tuple[str, ...] = ()


@dataclass(frozen=True)
class Bench:
    """A room, robots and noise, from which steps are drawn without a log.

    point_reach_m, line_reach_m: ranges at which points and lines are observed; which are observed
    follows from the planned path, so every run has the same graph. meet_every: the alphabetically
    first robot observes the others every so many steps; 0 = never. slip: motions that slip; by
    default none.
    """

    robots: Mapping[str, BenchRobot]
    points_m: tuple[Point, ...]
    walls_m: tuple[tuple[Point, Point], ...]
    sigma: Sigmas
    point_reach_m: float = field(default=5.0, metadata=POSITIVE)
    line_reach_m: float = field(default=5.0, metadata=POSITIVE)
    meet_every: int = field(default=0, metadata=NOT_NEGATIVE)
    slip: Slip | None = None


@dataclass(frozen=True)
class Logs:
    """Simulated logs: scenarios by name or file, and front ends.

    diverged_m: a run has diverged if its final trajectory is ever farther off than this.
    draw_starts: every robot begins where its prior says but for an error drawn from that prior. By
    default it begins exactly there, so that the best covariance looks too large.
    """

    scenarios: tuple[str, ...]
    front_ends: tuple[str, ...] = ("segments",)
    diverged_m: float = field(default=1.0, metadata=POSITIVE)
    draw_starts: bool = False


@dataclass(frozen=True)
class Chapter:
    """The experiments of the thesis' chapter 6, by their names, with front ends.

    Every seed is the sum of the definition's and the number of the run.
    """

    experiments: tuple[str, ...] = tuple(THESIS_EXPERIMENTS)
    front_ends: tuple[str, ...] = ("segments", "hough")


@dataclass(frozen=True)
class Definition:
    """An experiment: every variant at every noise scale, ``runs`` seeds each.

    variants: name -> settings as for ``--set``, over the common ``settings``; ``preset=NAME`` among
    them is as ``--preset``, under all of them. Exactly one of ``bench`` (steps drawn directly, true
    associations), ``logs`` (simulate, smooth, evaluate) and ``chapter`` (the thesis' own
    experiments).
    name: the file's; it is not a key.
    """

    variants: Mapping[str, tuple[str, ...]]
    description: str = ""
    runs: int = field(default=100, metadata={"least": 1})
    seed: int = field(default=0, metadata=NOT_NEGATIVE)
    noise_scales: tuple[float, ...] = field(default=(1.0,), metadata=POSITIVE)
    settings: tuple[str, ...] = ()
    bench: Bench | None = None
    logs: Logs | None = None
    chapter: Chapter | None = None
    name: str = field(default="", metadata={"hidden": True})

    def config(self, variant: str, *more: str) -> Config:
        """The configuration of a variant, with ``more`` settings over its own.

        Raises:
            ConfigError: a setting is wrong, or there is no such preset.
        """
        given = [*self.settings, *self.variants[variant], *more]
        presets = [text for text in given if text.startswith(_PRESET)]
        preset = presets[-1].removeprefix(_PRESET) if presets else None
        return load_config(None, [text for text in given if text not in presets], preset)


def load_definition(name: str | Path) -> Definition:
    """An experiment by its name in `EXPERIMENTS`, or from a TOML file.

    Raises:
        ConfigError: no such name or file, not TOML, or a key or value is wrong; the message names
            the file and the key.
    """
    path = EXPERIMENTS.get(str(name), Path(name))
    try:
        tree = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ConfigError(
            f"{name}: neither a file nor one of {', '.join(EXPERIMENTS)}"
            f"{did_you_mean(str(name), EXPERIMENTS)}"
        ) from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from error
    try:
        found: Definition = _plain(build(Definition, tree))
    except ScenarioError as error:
        raise ConfigError(f"{path.name}: {error}") from error
    problem = _problem(found)
    if problem:
        raise ConfigError(f"{path.name}: {problem}")
    for scenario in found.logs.scenarios if found.logs else ():
        try:
            load_scenario(scenario)
        except ScenarioError as error:
            raise ConfigError(f"{path.name}: logs.scenarios: {error}") from error
    if found.bench and found.bench.slip and set(found.bench.slip.told) - set(found.variants):
        raise ConfigError(f"{path.name}: bench.slip.told: give names of variants")
    for variant in found.variants:
        try:
            found.config(variant)
        except ConfigError as error:
            raise ConfigError(f"{path.name}: variants.{variant}: {error}") from error
    return replace(found, name=path.stem)


def _plain(node: Any) -> Any:
    """With dictionaries in place of read-only mappings, which cannot be pickled."""
    if is_dataclass(node) and not isinstance(node, type):
        return replace(node, **{f.name: _plain(getattr(node, f.name)) for f in fields(node)})
    if isinstance(node, Mapping):
        return {key: _plain(value) for key, value in node.items()}
    return node


def _problem(found: Definition) -> str:
    """What is wrong with the combination of keys; empty if nothing."""
    if not found.variants:
        return "variants: is empty; give at least one, for example isam2 = []"
    if sum(table is not None for table in (found.bench, found.logs, found.chapter)) != 1:
        return "give exactly one of the tables bench, logs and chapter"
    if found.chapter is not None:
        return _chapter_problem(found.chapter, found.noise_scales)
    if not found.noise_scales or len(set(found.noise_scales)) < len(found.noise_scales):
        return "noise_scales: give at least one, each once"
    if found.bench is not None:
        lengths = {sum(leg.steps for leg in r.path) for r in found.bench.robots.values()}
        if len(lengths) != 1 or lengths == {0}:
            return "bench.robots: all paths must have the same number of steps, at least one"
    return ""


def _chapter_problem(chapter: Chapter, noise_scales: tuple[float, ...]) -> str:
    if set(chapter.experiments) - set(THESIS_EXPERIMENTS) or not chapter.experiments:
        return f"chapter.experiments: give some of {', '.join(THESIS_EXPERIMENTS)}"
    return "" if noise_scales == (1.0,) else "noise_scales: the thesis' experiments have none"
