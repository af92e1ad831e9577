"""Simulated sightings of cylinders and other robots: bearing, range, optionally direction."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.arrays import BoolArray
from graphslam.core.geometry import Array, between, wrap
from graphslam.simulation.raycast import BeamFan, cast_beams
from graphslam.simulation.robot_shapes import outline_shapes
from graphslam.simulation.scenario import Body, SightingSensor
from graphslam.simulation.world import Shapes, World

LANDMARKS, ROBOTS = "landmarks", "robots"
_ONE_BEAM = BeamFan(0.0, 1.0, 1)


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """A possible target with its ``poses`` (n, 3) at the sampling times.

    ``occluders``: shapes that may hide it, all but its own.
    """

    name: str
    poses: Array
    radius_m: float
    occluders: tuple[Shapes, ...]


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedSighting:
    """One sighting: sample index, name of the target, ``z`` (2,) or (3,) and its covariance.

    ``z`` is bearing rad, range m and optionally direction rad, in the observer's base frame.
    ``said``: the target's name in the message; ``name`` is empty where nothing is there.
    """

    sample: int
    name: str
    z: Array
    cov: Array
    said: str


def sighting_targets(
    sensor: SightingSensor, world: World, others: Mapping[str, tuple[Body, Array]], samples: int
) -> Iterator[Target]:
    """Possible targets at the ``samples`` times: cylinders, or robots with poses (n, 3)."""
    outlines = {name: outline_shapes(*other) for name, other in others.items()}
    if sensor.of == ROBOTS:
        for name, (body, poses) in others.items():
            rest = tuple(shapes for other, shapes in outlines.items() if other != name)
            yield Target(name, poses, _inner_radius(body), (world.shapes, *rest))
        return
    segments, circles = world.shapes.segments, world.shapes.circles
    for number, name in enumerate(world.circle_names):
        x, y, radius = circles[number]
        static = Shapes(segments, np.delete(circles, number, axis=0))
        pose = np.tile([x, y, 0.0], (samples, 1))
        yield Target(name, pose, float(radius), (static, *outlines.values()))


def simulate_sightings(
    poses: Array, sensor: SightingSensor, candidates: Sequence[Target], rng: np.random.Generator
) -> list[SimulatedSighting]:
    """All sightings from bases at ``poses`` (n, 3), sorted by time.

    A target is seen if its centre is in the field of view and within range, and the straight line
    to it is free.
    """
    sigmas = [np.radians(sensor.bearing_sigma_deg), sensor.range_sigma_m]
    if sensor.of == ROBOTS and sensor.direction_sigma_deg:
        sigmas.append(np.radians(sensor.direction_sigma_deg))
    sigma = np.array(sigmas)
    found: list[SimulatedSighting] = []
    for target in candidates:
        if sensor.names and target.name not in sensor.names:
            continue
        relative = between(poses, target.poses)
        bearing = np.arctan2(relative[:, 1], relative[:, 0])
        distance = np.hypot(relative[:, 0], relative[:, 1])
        z = np.column_stack([bearing, distance, relative[:, 2]])[:, : len(sigma)]
        z = z + sigma * rng.normal(size=z.shape)
        z[:, 0] = wrap(z[:, 0])
        z[:, 2:] = wrap(z[:, 2:])
        visible = np.abs(bearing) <= np.radians(sensor.field_deg) / 2
        visible &= (distance <= sensor.range_max_m) & (z[:, 1] > 0)
        visible &= _line_of_sight(poses, bearing, distance, target)
        cov = np.diag(sigma**2)
        samples = np.flatnonzero(visible).tolist()
        found += [SimulatedSighting(i, target.name, z[i], cov, target.name) for i in samples]
    return sorted(found, key=lambda seen: seen.sample)


def with_faults(
    sightings: Iterable[SimulatedSighting],
    sensor: SightingSensor,
    names: Sequence[str],
    rng: np.random.Generator,
) -> Iterator[SimulatedSighting]:
    """Sightings, some under another one of the ``names``, and false ones behind true ones."""
    for seen in sightings:
        others = [name for name in names if name != seen.name]
        exchanged = others and rng.random() < sensor.exchanged_share
        yield replace(seen, said=str(rng.choice(others))) if exchanged else seen
        if rng.random() < sensor.false_share:
            half = np.radians(sensor.field_deg) / 2
            z = np.array([*rng.uniform([-half, 0.0], [half, sensor.range_max_m]), 0.0])
            z[2] = rng.uniform(-np.pi, np.pi)
            z = z[: len(seen.z)]
            yield SimulatedSighting(seen.sample, "", z, seen.cov, str(rng.choice(list(names))))


def _line_of_sight(poses: Array, bearing: Array, distance: Array, target: Target) -> BoolArray:
    """Whether the line of sight to the target's surface is free, per sample (n,)."""
    towards = poses + np.column_stack([np.zeros((len(poses), 2)), bearing])
    free = np.full(len(poses), np.inf)
    for shapes in target.occluders:
        reach = float(distance.max(initial=0.0))
        free = np.minimum(free, cast_beams(towards, _ONE_BEAM, shapes, reach).ranges[:, 0])
    return np.asarray(free > distance - target.radius_m)


def _inner_radius(body: Body) -> float:
    """Radius, m, of the largest circle about the base inside the body."""
    if body.radius_m:
        return body.radius_m
    return min(body.rear_m, body.length_m - body.rear_m, body.width_m / 2)
