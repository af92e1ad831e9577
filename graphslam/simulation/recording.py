"""The log of one visit: all sensors of all robots sampled, with noise, stamped and written."""

import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from graphslam.core.geometry import Array, compose
from graphslam.logs import LogWriter
from graphslam.simulation.encoders import odometry, wheel_angles
from graphslam.simulation.laser import beam_fan, laser_mount, noise_free_scans, noisy_ranges
from graphslam.simulation.raycast import NO_SURFACE, Hits
from graphslam.simulation.scenario import Body, Laser, Scenario
from graphslam.simulation.scene import SimulatedRobot, SimulatedVisit
from graphslam.simulation.sensor_clock import sample_times, stamps
from graphslam.simulation.sightings import LANDMARKS, sighting_targets, simulate_sightings


class Event(NamedTuple):
    """A message to be written: its stamp, and the call that writes it."""

    stamp_ns: int
    write: Callable[[LogWriter], None]

    @classmethod
    def of(cls, method: Callable[..., None], robot: str, stamp_ns: int, **fields: Any) -> "Event":
        """A call of a `LogWriter` method."""
        return cls(stamp_ns, partial(method, robot=robot, stamp_ns=stamp_ns, **fields))


@dataclass(frozen=True, slots=True, eq=False)
class NoiseFreeScans:
    """Noise-free scans of a robot from laser ``poses`` (n, 3), world frame."""

    laser: Laser
    poses: Array
    hits: Hits


@dataclass(frozen=True, slots=True)
class RobotSummary:
    """Statistics of a robot; ``dead_reckoning_end_m``: final position error of its odometry."""

    path_m: float
    duration_s: float
    scans: int
    sightings: int
    dead_reckoning_end_m: float


@dataclass(frozen=True, eq=False)
class Recording:
    """A log that was written, with data that only the simulator knows."""

    visit: SimulatedVisit
    path: Path
    counts: Mapping[str, int]
    robots: Mapping[str, RobotSummary]
    scans: Mapping[str, NoiseFreeScans]


def sensor_rng(seed: int, *names: str) -> np.random.Generator:
    """Random numbers of one sensor, independent of which other sensors there are."""
    return np.random.default_rng([seed, *(zlib.crc32(name.encode()) for name in names)])


def record_visit(scenario: Scenario, visit: SimulatedVisit, path: Path, seed: int) -> Recording:
    """Simulate a visit and write its log to ``path``.

    Raises:
        OutputError: the log cannot be written.
    """
    events: list[Event] = []
    robots: dict[str, RobotSummary] = {}
    ideal_scans: dict[str, NoiseFreeScans] = {}
    sighted: set[str] = set()
    for name, actor in visit.actors.items():
        wheels, end_m = _wheels(name, actor, visit, seed)
        scans, ideal = _scans(name, actor, visit, seed)
        seen = list(_sightings(name, actor, visit, seed))
        true = sample_times(visit.duration_s, scenario.truth_period_s)
        truth = [
            Event.of(LogWriter.truth, name, t, pose=pose)
            for t, pose in zip(
                stamps(true, actor.robot.clock).tolist(), actor.drive.at(true).poses, strict=True
            )
        ]
        events += [*wheels, *truth, *scans, *(event for event, _ in seen)]
        if ideal is not None:
            events += _beam_associations(name, visit, ideal, scans)
            ideal_scans[name] = ideal
        events += _sighting_associations(name, seen)
        sighted |= {landmark for _, landmark in seen}
        robots[name] = RobotSummary(
            actor.drive.path_m, visit.duration_s, len(scans), len(seen), end_m
        )
    events.sort(key=lambda event: event.stamp_ns)  # stable: robots in order, odometry first
    first_ns = min(event.stamp_ns for event in events)
    with LogWriter(path, _notes(scenario, visit, seed)) as log:
        for name, actor in visit.actors.items():
            if actor.robot.laser is not None:
                log.mount(name, first_ns, laser_mount(actor.robot.laser))
        for event in _landmarks(visit, ideal_scans, sighted, first_ns):
            event.write(log)
        for event in events:
            event.write(log)
    return Recording(visit, path, log.counts, robots, ideal_scans)


def _notes(scenario: Scenario, visit: SimulatedVisit, seed: int) -> dict[str, str]:
    """The metadata of the log, from which it can be reproduced."""
    notes = {"format": "simulation", "scenario": scenario.name, "seed": str(seed)}
    if visit.name:
        notes["visit"] = visit.name
    for name, actor in visit.actors.items():
        clock = actor.robot.clock
        if clock.offset_s or clock.drift_ppm:
            notes[f"clock {name}"] = f"{clock.offset_s:+g} s, {clock.drift_ppm:+g} ppm"
    return notes


# ---------------------------------------------------------------- sensors


def _others(visit: SimulatedVisit, name: str, times: Array) -> dict[str, tuple[Body, Array]]:
    """The other robots' bodies and poses (n, 3) at ``times`` (n,) s."""
    return {
        other: (actor.robot.body, actor.drive.at(times).poses)
        for other, actor in visit.actors.items()
        if other != name
    }


def _wheels(
    name: str, actor: SimulatedRobot, visit: SimulatedVisit, seed: int
) -> tuple[list[Event], float]:
    """The encoders' messages, and the final position error of dead reckoning, m."""
    encoders = actor.robot.encoders
    times = sample_times(visit.duration_s, encoders.period_s, encoders.phase_s)
    states = actor.drive.at(times)
    angles = wheel_angles(states, encoders, sensor_rng(seed, visit.name, name, "encoders"))
    poses = odometry(angles, encoders)
    events = []
    for t, pose, (left, right) in zip(
        stamps(times, actor.robot.clock, encoders.latency_s).tolist(), poses, angles, strict=True
    ):
        if encoders.odometry:
            events.append(Event.of(LogWriter.odometry, name, t, pose=pose))
        if encoders.joint_states:
            angle = {"left_rad": float(left), "right_rad": float(right)}
            events.append(Event.of(LogWriter.wheel_angles, name, t, **angle))
    ends = compose(states.poses[0], poses[-1])
    return events, float(np.hypot(*(ends - states.poses[-1])[:2]))


def _scans(
    name: str, actor: SimulatedRobot, visit: SimulatedVisit, seed: int
) -> tuple[list[Event], NoiseFreeScans | None]:
    """The laser's messages, and the noise-free scans."""
    laser = actor.robot.laser
    if laser is None:
        return [], None
    times = sample_times(visit.duration_s, laser.period_s, laser.phase_s)
    poses = actor.drive.at(times).poses
    hits = noise_free_scans(poses, laser, visit.world, _others(visit, name, times))
    rng = sensor_rng(seed, visit.name, name, "laser")
    ranges = noisy_ranges(hits, _biases(visit, name, laser, seed), laser, rng)
    fan = beam_fan(laser)
    events = [
        Event.of(
            LogWriter.scan,
            name,
            t,
            ranges=row,
            angle_min_rad=fan.start_rad,
            angle_step_rad=fan.step_rad,
            range_min_m=laser.range_min_m,
            range_max_m=laser.range_max_m,
        )
        for t, row in zip(
            stamps(times, actor.robot.clock, laser.latency_s).tolist(), ranges, strict=True
        )
    ]
    return events, NoiseFreeScans(laser, compose(poses, laser_mount(laser)), hits)


def _biases(visit: SimulatedVisit, name: str, laser: Laser, seed: int) -> Array:
    """Range bias, m, of each surface (n,); the other robots' come last.

    A material has the same normalised bias at every visit and for every laser, times the laser's
    sigma. Each face of a wall is a material, all faces of a box are one.
    """
    world = visit.world
    materials = [
        name if not world.outlines[thing].solid else world.outlines[thing].name
        for name, thing in zip(world.names, world.things, strict=True)
    ]
    materials += [f"robot {other}" for other in visit.actors if other != name]
    draws = [sensor_rng(seed, "material", material).normal() for material in materials]
    return laser.bias_sigma_m * np.array(draws, dtype=float)


def _sightings(
    name: str, actor: SimulatedRobot, visit: SimulatedVisit, seed: int
) -> Iterator[tuple[Event, str]]:
    """The sightings' messages, each with the name of the target."""
    for number, sensor in enumerate(actor.robot.sightings):
        times = sample_times(visit.duration_s, sensor.period_s, sensor.phase_s)
        poses = actor.drive.at(times).poses
        candidates = list(
            sighting_targets(sensor, visit.world, _others(visit, name, times), len(times))
        )
        rng = sensor_rng(seed, visit.name, name, f"sightings {number}")
        at = stamps(times, actor.robot.clock, sensor.latency_s).tolist()
        for seen in simulate_sightings(poses, sensor, candidates, rng):
            t, landmark = at[seen.sample], sensor.of == LANDMARKS
            event = Event.of(
                LogWriter.sighting,
                name,
                t,
                z=seen.z,
                cov=seen.cov,
                identity=seen.name if landmark and sensor.identified else None,
                seen_robot=None if landmark else seen.name,
            )
            yield event, seen.name


# ---------------------------------------------------------------- truth


def _beam_associations(
    name: str, visit: SimulatedVisit, ideal: NoiseFreeScans, scans: list[Event]
) -> Iterator[Event]:
    """True surface of each beam; for a spurious return that of the noise-free beam."""
    everything = np.array([*visit.world.names, *(other for other in visit.actors if other != name)])
    for scan, surfaces in zip(scans, ideal.hits.surfaces, strict=True):
        hit, indices = np.unique(surfaces, return_inverse=True)
        nothing = int(NO_SURFACE in hit)  # sorted first, as it is negative
        truth = {"names": everything[hit[nothing:]].tolist(), "targets": indices - nothing}
        yield Event.of(LogWriter.true_associations, name, scan.stamp_ns, of="scan", **truth)


def _sighting_associations(name: str, seen: list[tuple[Event, str]]) -> Iterator[Event]:
    """True targets of sightings: one message per image, in the order of its sightings."""
    images: dict[int, list[str]] = {}
    for event, target in seen:
        images.setdefault(event.stamp_ns, []).append(target)
    for stamp_ns, names in images.items():
        truth = {"names": names, "targets": np.arange(len(names))}
        yield Event.of(LogWriter.true_associations, name, stamp_ns, of="sightings", **truth)


def _landmarks(
    visit: SimulatedVisit,
    scans: Mapping[str, NoiseFreeScans],
    sighted: set[str],
    first_ns: int,
) -> Iterator[Event]:
    """True landmarks: the surfaces that a noise-free beam or a sighting reached."""
    world = visit.world
    reached = set(sighted)
    for ideal in scans.values():
        numbers = np.unique(ideal.hits.surfaces)
        inside = (numbers != NO_SURFACE) & (numbers < len(world.names))  # the rest are robots
        reached |= {world.names[number] for number in numbers[inside]}
    for number, name in enumerate(world.names):
        if name not in reached:
            continue
        straight = number < len(world.shapes.segments)
        ends = world.shapes.segments[number] if straight else None
        write = partial(
            LogWriter.true_landmark,
            stamp_ns=first_ns,
            identity=name,
            kind="segment" if straight else "point",
            pose=_middle(ends) if ends is not None else _center(visit, number),
            extent=ends,
        )
        yield Event(first_ns, write)


def _middle(ends: Array) -> Array:
    """Pose (3,) at the middle of a face (2, 2), x axis along it."""
    along = ends[1] - ends[0]
    return np.array([*ends.mean(axis=0), np.arctan2(along[1], along[0])])


def _center(visit: SimulatedVisit, number: int) -> Array:
    x, y, _ = visit.world.shapes.circles[number - len(visit.world.shapes.segments)]
    return np.array([x, y, np.nan])
