"""Sightings: cylinders and other robots seen as such, by bearing, range and perhaps direction."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.geometry import Array, between, wrap
from graphslam.simulation.raycast import BeamFan, cast_beams
from graphslam.simulation.robot_shapes import Flags, outline_shapes
from graphslam.simulation.scenario import Body, SightingSensor
from graphslam.simulation.world import Shapes, World

LANDMARKS, ROBOTS = "landmarks", "robots"
_ONE_BEAM = BeamFan(0.0, 1.0, 1)


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """Something that can be seen: its ``poses`` (n, 3) at the sampling times.

    ``blockers`` are the shapes that may stand before it: everything but itself.
    """

    name: str
    poses: Array
    radius_m: float
    blockers: tuple[Shapes, ...]


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedSighting:
    """One sighting: sample number, whom, ``z`` (2,) or (3,) and its covariance.

    ``z`` is bearing rad, range m and perhaps direction rad, in the base frame of the seer.
    """

    sample: int
    name: str
    z: Array
    cov: Array


def sighting_targets(
    seer: SightingSensor, world: World, others: Mapping[str, tuple[Body, Array]], samples: int
) -> Iterator[Target]:
    """What a sensor may see at its ``samples`` times: cylinders, or robots (their poses (n, 3))."""
    outlines = {name: outline_shapes(*other) for name, other in others.items()}
    if seer.of == ROBOTS:
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
    poses: Array, seer: SightingSensor, candidates: Sequence[Target], rng: np.random.Generator
) -> list[SimulatedSighting]:
    """All sightings from bases at ``poses`` (n, 3), in the order of time.

    A target is seen when its centre is in the field of view and within range, and nothing stands
    on the straight line to it.
    """
    sigmas = [np.radians(seer.bearing_sigma_deg), seer.range_sigma_m]
    if seer.of == ROBOTS and seer.direction_sigma_deg:
        sigmas.append(np.radians(seer.direction_sigma_deg))
    sigma = np.array(sigmas)
    found: list[SimulatedSighting] = []
    for target in candidates:
        if seer.names and target.name not in seer.names:
            continue
        relative = between(poses, target.poses)
        bearing = np.arctan2(relative[:, 1], relative[:, 0])
        distance = np.hypot(relative[:, 0], relative[:, 1])
        z = np.column_stack([bearing, distance, relative[:, 2]])[:, : len(sigma)]
        z = z + sigma * rng.normal(size=z.shape)
        z[:, 0] = wrap(z[:, 0])
        z[:, 2:] = wrap(z[:, 2:])
        visible = np.abs(bearing) <= np.radians(seer.field_deg) / 2
        visible &= (distance <= seer.range_max_m) & (z[:, 1] > 0)
        visible &= _line_of_sight(poses, bearing, distance, target)
        cov = np.diag(sigma**2)
        found += [
            SimulatedSighting(int(i), target.name, z[i], cov) for i in np.flatnonzero(visible)
        ]
    return sorted(found, key=lambda seen: seen.sample)


def _line_of_sight(poses: Array, bearing: Array, distance: Array, target: Target) -> Flags:
    """At which samples (n,) nothing stands before the target's surface."""
    towards = poses + np.column_stack([np.zeros((len(poses), 2)), bearing])
    free = np.full(len(poses), np.inf)
    for shapes in target.blockers:
        reach = float(distance.max(initial=0.0))
        free = np.minimum(free, cast_beams(towards, _ONE_BEAM, shapes, reach).ranges[:, 0])
    return np.asarray(free > distance - target.radius_m)


def _inner_radius(body: Body) -> float:
    """Radius, m, of the circle about the base that fits into the body."""
    if body.radius_m:
        return body.radius_m
    return min(body.rear_m, body.length_m - body.rear_m, body.width_m / 2)
