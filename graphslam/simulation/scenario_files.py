"""Scenario files: the ones that come with the package, and everyone's own."""

import re
import tomllib
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from graphslam.simulation.errors import ScenarioError
from graphslam.simulation.scenario import (
    Laser,
    LaterVisit,
    Leg,
    Robot,
    Scenario,
    SightingSensor,
    StaticObjects,
)
from graphslam.simulation.scenario_parser import build
from graphslam.simulation.sightings import LANDMARKS, ROBOTS

_FOLDER = Path(__file__).parent / "scenarios"

#: name -> file; docs/simulator.md says what each is for
SCENARIOS: dict[str, Path] = {
    name: _FOLDER / f"{name}.toml"
    for name in (
        "lab",
        "corridor",
        "two-robots",
        "robots-in-scans",
        "change",
        "office-loop",
        "long-corridor",
        "forest",
        "fleet",
    )
}


def load_scenario(scenario: str | Path) -> Scenario:
    """A scenario by its name in `SCENARIOS`, or from a TOML file of one's own.

    Raises:
        ScenarioError: no such name or file, not TOML, or a key or value is wrong; the message
            names the file and the key.
    """
    path = SCENARIOS.get(str(scenario), Path(scenario))
    try:
        tree = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ScenarioError(
            f"{scenario}: neither a file nor one of {', '.join(SCENARIOS)}"
        ) from error
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{path}: not valid TOML: {error}") from error
    try:
        found: Scenario = build(Scenario, tree)
    except ScenarioError as error:
        raise ScenarioError(f"{path.name}: {error}") from error
    if found.world_of:
        found = _with_world_of(found, path)
    for problem in _contradictions(found):
        raise ScenarioError(f"{path.name}: {problem}")
    return replace(found, name=path.name)


def _with_world_of(scenario: Scenario, path: Path) -> Scenario:
    """The scenario in another one's world, whose file may lie beside its own."""
    if scenario.world != StaticObjects():
        raise ScenarioError(f"{path.name}: give either world or world_of")
    beside = path.parent / scenario.world_of
    if beside == path:
        raise ScenarioError(f"{path.name}: world_of: names the file itself")
    other = load_scenario(beside if beside.is_file() else scenario.world_of)
    return replace(scenario, world=other.world)


def _contradictions(scenario: Scenario) -> Iterator[str]:
    """What the single keys allow and their combination does not."""
    if not scenario.robots:
        yield "robots: is empty; give at least one [robots.NAME]"
    names = Counter(_names(scenario.world))
    for name, count in names.items():
        if count > 1:
            yield f"world: {count} things are named {name!r}; names must differ"
    for name, robot in scenario.robots.items():
        for problem in _robot(name, robot, scenario):
            yield f"robots.{name}{problem}"
    if scenario.later is not None:
        yield from _later(scenario.later, scenario)


def _later(later: LaterVisit, scenario: Scenario) -> Iterator[str]:
    names = list(_names(scenario.world))
    for name in (*(move.name for move in later.moved), *later.vanished):
        if name not in names:
            yield f"later: nothing is named {name!r}; known: {', '.join(names)}"
    for name in _names(later.appeared):
        if name in names:
            yield f"later.appeared: {name!r} is there already; names must differ"
    for name, again in later.robots.items():
        if name not in scenario.robots:
            yield f"later.robots.{name}: no such robot; known: {', '.join(scenario.robots)}"
        for problem in _drive(again.drive):
            yield f"later.robots.{name}{problem}"


def _robot(name: str, robot: Robot, scenario: Scenario) -> Iterator[str]:
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
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
        yield from _laser(robot.laser)
    for number, seer in enumerate(robot.sightings):
        for problem in _seer(seer, scenario):
            yield f".sightings[{number}]{problem}"


def _drive(legs: tuple[Leg, ...]) -> Iterator[str]:
    for number, leg in enumerate(legs):
        if bool(leg.through_m) + bool(leg.turn_deg) + bool(leg.wait_s) != 1:
            yield f".drive[{number}]: give exactly one of through_m, turn_deg and wait_s"


def _laser(laser: Laser) -> Iterator[str]:
    if abs(laser.field_deg / laser.step_deg - (laser.beams - 1)) > 1e-9:
        yield ".laser: field_deg is not a multiple of step_deg"
    if laser.range_min_m >= laser.range_max_m:
        yield ".laser.range_min_m: is not below range_max_m"


def _seer(seer: SightingSensor, scenario: Scenario) -> Iterator[str]:
    known = {
        LANDMARKS: [cylinder.name for cylinder in scenario.world.cylinders],
        ROBOTS: list(scenario.robots),
    }
    if seer.of not in known:
        yield f".of: {seer.of!r} is not one of {', '.join(known)}"
    for name in seer.names:
        if name not in known.get(seer.of, []):
            yield f".names: {name!r} is not one of the {seer.of}"


def _names(things: StaticObjects) -> Iterator[str]:
    for kind in (things.walls, things.boxes, things.boards, things.cylinders, things.doors):
        yield from (thing.name for thing in kind)
