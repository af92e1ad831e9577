"""Scenario files: those of the package and the user's own."""

import hashlib
import json
import re
import tomllib
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from graphslam.core.suggestions import did_you_mean
from graphslam.simulation.scenario import (
    Laser,
    LaterVisit,
    Leg,
    Robot,
    Scenario,
    ScenarioError,
    SightingSensor,
    StaticObjects,
)
from graphslam.simulation.scenario_names import SCENARIOS
from graphslam.simulation.scenario_parser import build
from graphslam.simulation.sightings import LANDMARKS, ROBOTS

_NAME = r"[A-Za-z][A-Za-z0-9_]*"


def load_scenario(scenario: str | Path) -> Scenario:
    """Load a scenario by its name in `SCENARIOS`, or from a TOML file.

    Raises:
        ScenarioError: no such name or file, not TOML, or a key or value is wrong; the message
            names the file and the key.
    """
    path, tree = _read(scenario)
    try:
        parsed: Scenario = build(Scenario, tree)
    except ScenarioError as error:
        raise ScenarioError(f"{path.name}: {error}") from error
    if parsed.world_of:
        parsed = _with_world_of(parsed, path)
    for problem in _inconsistencies(parsed):
        raise ScenarioError(f"{path.name}: {problem}")
    return replace(parsed, name=path.name)


def scenario_sha256(scenario: str | Path) -> str:
    """What a scenario says, as a SHA-256: of its file and those whose world it uses.

    Comments and the order of keys change nothing. The scenario can be loaded, see `load_scenario`.

    Raises:
        ScenarioError: a file cannot be read.
    """
    path, tree = _read(scenario)
    trees = [tree]
    while named := tree.get("world_of"):
        path, tree = _read(_world_file(path, named))
        if tree in trees:  # in a circle; it cannot be loaded
            break
        trees.append(tree)
    return hashlib.sha256(json.dumps(trees, sort_keys=True, default=str).encode()).hexdigest()


def _read(scenario: str | Path) -> tuple[Path, dict[str, Any]]:
    """The file of a scenario and its keys, as they are there."""
    path = SCENARIOS.get(str(scenario), Path(scenario))
    try:
        tree = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ScenarioError(
            f"{scenario}: neither a file nor one of {', '.join(SCENARIOS)}"
            f"{did_you_mean(str(scenario), SCENARIOS)}"
        ) from error
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{path}: not valid TOML: {error}") from error
    return path, tree


def _world_file(path: Path, world_of: str) -> str | Path:
    """The scenario whose world that of ``path`` uses: a file beside it, else one of its own."""
    beside = path.parent / world_of
    return beside if beside.is_file() else world_of


def _with_world_of(scenario: Scenario, path: Path) -> Scenario:
    """The scenario with the world of another one, whose file may be in the same folder."""
    if scenario.world != StaticObjects():
        raise ScenarioError(f"{path.name}: give either world or world_of")
    if path.parent / scenario.world_of == path:
        raise ScenarioError(f"{path.name}: world_of: names the file itself")
    other = load_scenario(_world_file(path, scenario.world_of))
    return replace(scenario, world=other.world)


def _inconsistencies(scenario: Scenario) -> Iterator[str]:
    """Problems with combinations of keys that are valid one by one."""
    if not scenario.robots:
        yield "robots: is empty; give at least one [robots.NAME]"
    for name, count in Counter(scenario.world.names).items():
        if count > 1:
            yield f"world: {count} things are named {name!r}; names must differ"
    for name, robot in scenario.robots.items():
        for problem in _robot(name, robot, scenario):
            yield f"robots.{name}{problem}"
    if scenario.later is not None:
        yield from _later(scenario.later, scenario)


def _later(later: LaterVisit, scenario: Scenario) -> Iterator[str]:
    names = scenario.world.names
    for name in (*(move.name for move in later.moved), *later.vanished):
        if name not in names:
            yield f"later: nothing is named {name!r}; known: {', '.join(names)}"
    for name in later.appeared.names:
        if name in names:
            yield f"later.appeared: {name!r} is there already; names must differ"
    for name, plan in later.robots.items():
        if name not in scenario.robots:
            yield f"later.robots.{name}: no such robot; known: {', '.join(scenario.robots)}"
        for problem in _drive(plan.drive):
            yield f"later.robots.{name}{problem}"


def _robot(name: str, robot: Robot, scenario: Scenario) -> Iterator[str]:
    if not re.fullmatch(_NAME, name):
        yield ": a name is letters, digits and _ (it becomes part of ROS topics)"
    body = robot.body
    if bool(body.radius_m) == bool(body.length_m and body.width_m):
        yield ".body: give either radius_m, or length_m and width_m"
    if body.rear_m > body.length_m:
        yield ".body.rear_m: is more than length_m"
    if not (robot.encoders.odometry or robot.encoders.joint_states):
        yield ".encoders: one of odometry and joint_states must be true"
    yield from _drive(robot.drive)
    if robot.laser is not None:
        yield from (f".laser{problem}" for problem in _laser(robot.laser))
    for sensor_name, laser in robot.lasers.items():
        if not re.fullmatch(_NAME, sensor_name) or sensor_name in ("laser", "base_link"):
            yield f".lasers.{sensor_name}: a name is letters, digits and _, and not laser"
        yield from (f".lasers.{sensor_name}{problem}" for problem in _laser(laser))
    for number, sensor in enumerate(robot.sightings):
        for problem in _sighting_sensor(sensor, scenario):
            yield f".sightings[{number}]{problem}"


def _drive(legs: tuple[Leg, ...]) -> Iterator[str]:
    for number, leg in enumerate(legs):
        if bool(leg.through_m) + bool(leg.turn_deg) + bool(leg.wait_s) != 1:
            yield f".drive[{number}]: give exactly one of through_m, turn_deg and wait_s"


def _laser(laser: Laser) -> Iterator[str]:
    if abs(laser.field_deg / laser.step_deg - (laser.beams - 1)) > 1e-9:
        yield ": field_deg is not a multiple of step_deg"
    if laser.range_min_m >= laser.range_max_m:
        yield ".range_min_m: is not below range_max_m"


def _sighting_sensor(sensor: SightingSensor, scenario: Scenario) -> Iterator[str]:
    known = {
        LANDMARKS: [cylinder.name for cylinder in scenario.world.cylinders],
        ROBOTS: list(scenario.robots),
    }
    if sensor.of not in known:
        yield f".of: {sensor.of!r} is not one of {', '.join(known)}"
    for name in sensor.names:
        if name not in known.get(sensor.of, []):
            yield f".names: {name!r} is not one of the {sensor.of}"
