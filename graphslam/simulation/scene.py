"""Visits of a scenario, ready to be recorded: world, robots with drives, no collisions."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from graphslam.core.geometry import Array
from graphslam.simulation.drive import Drive, plan_drive
from graphslam.simulation.robot_shapes import contacts, encloses, outline_shapes
from graphslam.simulation.scenario import Body, LaterVisit, Robot, Scenario, ScenarioError
from graphslam.simulation.world import (
    Outline,
    Shapes,
    World,
    displacement,
    find_crossing,
    find_degenerate,
    make_world,
    outlines_of,
)

REFERENCE, LATER = "reference", "later"

# Collisions are checked at least this often in time and path; turns on the spot need the first.
_CHECK_S, _CHECK_M = 0.05, 0.05
_CHUNK = 500  # poses per collision check, to limit memory


class SimulatedRobot(NamedTuple):
    """A robot of one visit with its drive."""

    robot: Robot
    drive: Drive


class SimulatedVisit(NamedTuple):
    """A visit to be recorded; ``name`` is empty unless there are two."""

    name: str
    world: World
    actors: Mapping[str, SimulatedRobot]
    duration_s: float


def prepare_visits(scenario: Scenario) -> tuple[SimulatedVisit, ...]:
    """The visits of a scenario, one or two, checked for collisions.

    Raises:
        ScenarioError: objects intersect, a drive is impossible, or a robot starts in an object or
            drives into one.
    """
    outlines = tuple(outlines_of(scenario.world))
    first = _visit(scenario, REFERENCE if scenario.later else "", outlines, scenario.robots)
    if scenario.later is None:
        return (first,)
    later = scenario.later
    robots = {
        name: replace(robot, start_m=plan.start_m, start_deg=plan.start_deg, drive=plan.drive)
        if (plan := later.robots.get(name))
        else robot
        for name, robot in scenario.robots.items()
    }
    return first, _visit(scenario, LATER, tuple(_rearranged(outlines, later)), robots)


def _visit(
    scenario: Scenario, name: str, outlines: Sequence[Outline], robots: Mapping[str, Robot]
) -> SimulatedVisit:
    where = f"{scenario.name}: " + (f"{name} visit: " if name else "")
    if short := find_degenerate(outlines):
        raise ScenarioError(f"{where}{short}: needs two different points")
    world = make_world(outlines)
    if pair := find_crossing(world):
        raise ScenarioError(
            f"{where}{pair[0]} and {pair[1]} cross; move one, or set may_cross = true"
        )
    actors = {}
    for robot_name, robot in sorted(robots.items()):
        start = np.array([*robot.start_m, np.radians(robot.start_deg)])
        try:
            actors[robot_name] = SimulatedRobot(robot, plan_drive(start, robot.drive, robot))
        except ScenarioError as error:
            raise ScenarioError(f"{where}robots.{robot_name}: {error}") from error
    end = max(actor.drive.duration_s for actor in actors.values())
    duration = scenario.duration_s or end
    if not duration:
        raise ScenarioError(f"{where}no robot drives; set duration_s")
    for problem in _collisions(world, actors, min(duration, end)):
        raise ScenarioError(f"{where}{problem}")
    return SimulatedVisit(name, world, actors, duration)


def _rearranged(outlines: Sequence[Outline], later: LaterVisit) -> Iterator[Outline]:
    """The world of the second visit."""
    motions = {move.name: displacement(move) for move in later.moved}
    for outline in outlines:
        if outline.name in motions:
            yield outline.moved(motions[outline.name])
        elif outline.name not in later.vanished:
            yield outline
    yield from outlines_of(later.appeared)


# ---------------------------------------------------------------- collisions


def _collisions(world: World, actors: Mapping[str, SimulatedRobot], end_s: float) -> Iterator[str]:
    """Collisions of robots, one line each, in the order of robots."""
    speeds = [
        max(actor.robot.speed_m_s, *(leg.speed_m_s for leg in actor.robot.drive), 0.0)
        for actor in actors.values()
    ]
    step_s = min(_CHECK_S, _CHECK_M / max(speeds))
    times = np.append(np.arange(0.0, end_s, step_s), end_s)
    poses = {name: actor.drive.at(times).poses for name, actor in actors.items()}
    for name, actor in actors.items():
        if hit := _first_collision(actor.robot.body, poses[name], world):
            sample, surface = hit
            yield _describe(name, poses[name][sample], times[sample], world.names[surface])
        for other, theirs in poses.items():
            if other > name:
                moving = outline_shapes(actors[other].robot.body, theirs)
                if hit := _first_contact(actor.robot.body, poses[name], moving):
                    yield _describe(name, poses[name][hit[0]], times[hit[0]], f"robot {other}")


def _describe(name: str, pose: Array, time_s: float, what: str) -> str:
    when = "starts in" if time_s == 0 else f"after {time_s:.1f} s drives into"
    return f"robots.{name}: {when} {what} at ({pose[0]:.2f}, {pose[1]:.2f}); move one of them"


def _first_collision(body: Body, poses: Array, world: World) -> tuple[int, int] | None:
    """First (sample, surface) at which a body overlaps a surface or is inside a solid object."""
    first = _first_contact(body, poses, world.shapes)
    for number, outline in enumerate(world.outlines):
        if outline.solid and not outline.radius_m:
            inside = np.flatnonzero(encloses(outline.points, poses[:, :2]))
            if len(inside) and (first is None or inside[0] < first[0]):
                first = int(inside[0]), int(np.argmax(world.things == number))
    return first


def _first_contact(body: Body, poses: Array, shapes: Shapes) -> tuple[int, int] | None:
    """First (sample, surface) at which a body overlaps one of the shapes."""
    for begin in range(0, len(poses), _CHUNK):
        part = slice(begin, begin + _CHUNK)
        moving = shapes.segments.ndim == 4
        here = Shapes(shapes.segments[part], shapes.circles[part]) if moving else shapes
        hits = np.argwhere(contacts(body, poses[part], here))
        if len(hits):
            return begin + int(hits[0, 0]), int(hits[0, 1])
    return None
