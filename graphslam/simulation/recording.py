"""The log of one visit: all sensors of all robots sampled, with noise, stamped and written."""

import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.core.geometry import Array, compose
from graphslam.logs.cdr_writing import imu_bytes
from graphslam.logs.schemas import ANYTHING, IMU, SOME_ROBOT
from graphslam.logs.writer import Event, LogWriter, frame
from graphslam.simulation.encoders import odometry, turn_rates, wheel_angles
from graphslam.simulation.laser import (
    beam_fan,
    laser_mount,
    noise_free_scans,
    noisy_ranges,
    swept_scans,
    told_mount,
)
from graphslam.simulation.raycast import NO_SURFACE, Hits
from graphslam.simulation.scenario import Body, Encoders, Gyroscope, Laser, Scenario, SightingSensor
from graphslam.simulation.scene import SimulatedRobot, SimulatedVisit
from graphslam.simulation.sensor_clock import sample_times, stamps
from graphslam.simulation.sightings import (
    LANDMARKS,
    sighting_targets,
    simulate_sightings,
    with_faults,
)


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
class SimulatedLog:
    """A log that was written, with data that only the simulator knows."""

    visit: SimulatedVisit
    path: Path
    counts: Mapping[str, int]
    robots: Mapping[str, RobotSummary]
    scans: Mapping[str, NoiseFreeScans]  # of the first laser of each robot


def sensor_rng(seed: int, *names: str) -> np.random.Generator:
    """Random numbers of one sensor, independent of which other sensors there are."""
    return np.random.default_rng([seed, *(zlib.crc32(name.encode()) for name in names)])


def record_visit(
    scenario: Scenario,
    visit: SimulatedVisit,
    path: Path,
    seed: int,
    materials_seed: int | None = None,
) -> SimulatedLog:
    """Simulate a visit and write its log to ``path``.

    ``materials_seed`` is that of the biases of materials; the same as ``seed`` by default.

    Raises:
        OutputError: the log cannot be written.
    """
    materials = seed if materials_seed is None else materials_seed
    events: list[Event] = []
    robots: dict[str, RobotSummary] = {}
    ideal_scans: dict[str, NoiseFreeScans] = {}
    all_scans: list[NoiseFreeScans] = []
    sighted: set[str] = set()
    for name, actor in visit.actors.items():
        this = _Recorder(name, actor, visit, seed, materials)
        wheels, end_m = _wheels(this)
        events += _gyroscope(this)
        recorded = [_scans(this, *laser) for laser in actor.robot.scanners.items()]
        scans = [event for own, _ in recorded for event in own]
        seen = list(_sightings(this))
        events += [*wheels, *_truth(this, scenario.truth_period_s), *scans]
        events += [event for event, _ in seen]
        for own, ideal in recorded[:1]:
            events += _beam_associations(this, ideal, own)
            ideal_scans[name] = ideal
        all_scans += [ideal for _, ideal in recorded]
        events += _sighting_associations(this, seen)
        sighted |= {target for _, target in seen if target}
        robots[name] = RobotSummary(
            actor.drive.path_m, visit.duration_s, len(scans), len(seen), end_m
        )
    events.sort(key=lambda event: event.stamp_ns)  # stable: robots in order, odometry first
    first_ns = min(event.stamp_ns for event in events)
    with LogWriter(path, _notes(scenario, visit, seed, materials)) as log:
        for name, actor in visit.actors.items():
            for sensor, laser in actor.robot.scanners.items():
                log.mount(name, first_ns, told_mount(laser), sensor)
        for landmark in _landmarks(visit, all_scans, sighted):
            log.true_landmark(first_ns, **landmark)
        for event in events:
            event.write(log)
    return SimulatedLog(visit, path, log.counts, robots, ideal_scans)


def _notes(
    scenario: Scenario, visit: SimulatedVisit, seed: int, materials_seed: int
) -> dict[str, str]:
    """The metadata of the log, from which it can be reproduced."""
    notes = {"format": "simulation", "scenario": scenario.name, "seed": str(seed)}
    if materials_seed != seed:
        notes["materials seed"] = str(materials_seed)
    if visit.name:
        notes["visit"] = visit.name
    for name, actor in visit.actors.items():
        clock = actor.robot.clock
        if clock.offset_s or clock.drift_ppm:
            notes[f"clock {name}"] = f"{clock.offset_s:+g} s, {clock.drift_ppm:+g} ppm"
    return notes


# ---------------------------------------------------------------- sensors


@dataclass(frozen=True, slots=True, eq=False)
class _Recorder:
    """A robot of a visit whose sensors are recorded."""

    name: str
    actor: SimulatedRobot
    visit: SimulatedVisit
    seed: int
    materials_seed: int

    def rng(self, sensor: str) -> np.random.Generator:
        """Random numbers of one of its sensors."""
        return sensor_rng(self.seed, self.visit.name, self.name, sensor)

    def times(
        self, sensor: Encoders | Gyroscope | Laser | SightingSensor
    ) -> tuple[Array, list[int]]:
        """True times (n,) s of a sensor's samples, and their stamps, ns."""
        times = sample_times(self.visit.duration_s, sensor.period_s, sensor.phase_s)
        return times, stamps(times, self.actor.robot.clock, sensor.latency_s).tolist()

    def others(self, times: Array) -> dict[str, tuple[Body, Array]]:
        """The other robots' bodies and poses (n, 3) at ``times`` (n,) s."""
        return {
            name: (actor.robot.body, actor.drive.at(times).poses)
            for name, actor in self.visit.actors.items()
            if name != self.name
        }


def _wheels(this: _Recorder) -> tuple[list[Event], float]:
    """The encoders' messages, and the final position error of dead reckoning, m."""
    encoders = this.actor.robot.encoders
    times, at = this.times(encoders)
    states = this.actor.drive.at(times)
    angles = wheel_angles(states, encoders, this.rng("encoders"))
    poses = odometry(angles, encoders)
    events = []
    for t, pose, (left, right) in zip(at, poses, angles.tolist(), strict=True):
        if encoders.odometry:
            events.append(Event.of(LogWriter.odometry, this.name, t, pose=pose))
        if encoders.joint_states:
            angle = {"left_rad": left, "right_rad": right}
            events.append(Event.of(LogWriter.wheel_angles, this.name, t, **angle))
    ends = compose(states.poses[0], poses[-1])
    return events, float(np.hypot(*(ends - states.poses[-1])[:2]))


def _gyroscope(this: _Recorder) -> Iterator[Event]:
    """The messages of the gyroscope, if there is one."""
    gyroscope = this.actor.robot.gyroscope
    if gyroscope is None:
        return
    times, at = this.times(gyroscope)
    rates = turn_rates(this.actor.drive.at(times), times, gyroscope, this.rng("gyroscope"))
    topic = f"/{frame(this.name, 'imu')}"
    for t, rate in zip(at, rates.tolist(), strict=True):
        data = imu_bytes(t, frame(this.name, "imu"), rate)
        yield Event(t, partial(_write_imu, topic, t, data))


def _write_imu(topic: str, stamp_ns: int, data: bytes, log: LogWriter) -> None:
    log.encoded(topic, IMU, data, stamp_ns)


def _scans(this: _Recorder, name: str, laser: Laser) -> tuple[list[Event], NoiseFreeScans]:
    """A laser's messages, and the noise-free scans."""
    times, at = this.times(laser)
    poses = this.actor.drive.at(times).poses
    world = this.visit.world
    if laser.sweep_s:
        hits = swept_scans(
            times, laser, world, lambda now: this.actor.drive.at(now).poses, this.others
        )
    else:
        hits = noise_free_scans(poses, laser, world, this.others(times))
    ranges = noisy_ranges(hits, _biases(this, laser), laser, this.rng(name))
    fan = beam_fan(laser)
    events = [
        Event.of(
            LogWriter.scan,
            this.name,
            t,
            ranges=row,
            angle_min_rad=fan.start_rad,
            angle_step_rad=fan.step_rad,
            range_min_m=laser.range_min_m,
            range_max_m=laser.range_max_m,
            beam_period_s=laser.beam_period_s,
            sensor=name,
        )
        for t, row in zip(at, ranges, strict=True)
    ]
    return events, NoiseFreeScans(laser, compose(poses, laser_mount(laser)), hits)


def _biases(this: _Recorder, laser: Laser) -> Array:
    """Range bias, m, of each surface (n,); the other robots' come last.

    A material has the same normalised bias at every visit and for every laser, times the laser's
    sigma, in all logs of one ``materials_seed``. Each face of a wall is a material, all faces of a
    box are one.
    """
    world = this.visit.world
    materials = [
        world.outlines[thing].name if world.outlines[thing].solid else name
        for name, thing in zip(world.names, world.things, strict=True)
    ]
    materials += [f"robot {other}" for other in this.visit.actors if other != this.name]
    draws = [
        sensor_rng(this.materials_seed, "material", material).normal() for material in materials
    ]
    return laser.bias_sigma_m * np.array(draws, dtype=float)


def _sightings(this: _Recorder) -> Iterator[tuple[Event, str]]:
    """The sightings' messages, each with the name of the target, empty where there is none."""
    for number, sensor in enumerate(this.actor.robot.sightings):
        times, at = this.times(sensor)
        poses = this.actor.drive.at(times).poses
        targets = list(sighting_targets(sensor, this.visit.world, this.others(times), len(times)))
        rng = this.rng(f"sightings {number}")
        landmark = sensor.of == LANDMARKS
        unnamed = (None if landmark else SOME_ROBOT) if sensor.told_apart else ANYTHING
        names = [target.name for target in targets]
        names = [name for name in names if name in sensor.names or not sensor.names]
        true = simulate_sightings(poses, sensor, targets, rng)
        for seen in with_faults(true, sensor, names, this.rng(f"faults {number}")):
            named = (None if landmark else seen.said) if sensor.identified else unnamed
            event = Event.of(
                LogWriter.sighting,
                this.name,
                at[seen.sample],
                z=seen.z,
                cov=seen.cov,
                identity=seen.said if landmark and sensor.identified else None,
                seen_robot=named,
            )
            yield event, seen.name


# ---------------------------------------------------------------- truth


def _truth(this: _Recorder, period_s: float) -> Iterator[Event]:
    """True poses of the robot."""
    times = sample_times(this.visit.duration_s, period_s)
    at, poses = stamps(times, this.actor.robot.clock).tolist(), this.actor.drive.at(times).poses
    for t, pose in zip(at, poses, strict=True):
        yield Event.of(LogWriter.truth, this.name, t, pose=pose)


def _beam_associations(
    this: _Recorder, ideal: NoiseFreeScans, scans: list[Event]
) -> Iterator[Event]:
    """True surface of each beam; for a spurious return that of the noise-free beam."""
    robots = [name for name in this.visit.actors if name != this.name]
    everything = np.array([*this.visit.world.names, *robots])
    for scan, surfaces in zip(scans, ideal.hits.surfaces, strict=True):
        hit, indices = np.unique(surfaces, return_inverse=True)
        nothing = int(NO_SURFACE in hit)  # sorted first, as it is negative
        truth = {"names": everything[hit[nothing:]].tolist(), "targets": indices - nothing}
        yield Event.of(LogWriter.true_associations, this.name, scan.stamp_ns, of="scan", **truth)


def _sighting_associations(this: _Recorder, seen: list[tuple[Event, str]]) -> Iterator[Event]:
    """True targets of sightings: one message per image, in the order of its sightings."""
    images: dict[int, list[str]] = {}
    for event, target in seen:
        images.setdefault(event.stamp_ns, []).append(target)
    for stamp_ns, names in images.items():
        known = [name for name in names if name]
        there = np.array([bool(name) for name in names])
        truth = {"names": known, "targets": np.where(there, np.cumsum(there) - 1, -1)}
        yield Event.of(LogWriter.true_associations, this.name, stamp_ns, of="sightings", **truth)


def _landmarks(
    visit: SimulatedVisit, scans: Iterable[NoiseFreeScans], sighted: set[str]
) -> Iterator[dict[str, Any]]:
    """Fields of true landmarks: the surfaces that a noise-free beam or a sighting reached."""
    world, reached = visit.world, set(sighted)
    for ideal in scans:
        numbers = np.unique(ideal.hits.surfaces)
        inside = (numbers != NO_SURFACE) & (numbers < len(world.names))  # the rest are robots
        reached |= {world.names[number] for number in numbers[inside]}
    for name, ends in zip(world.names, world.shapes.segments, strict=False):
        if name in reached:
            along = ends[1] - ends[0]
            pose = np.array([*ends.mean(axis=0), np.arctan2(along[1], along[0])])
            yield {"identity": name, "kind": "segment", "pose": pose, "extent": ends}
    for name, (x, y, _) in zip(world.circle_names, world.shapes.circles, strict=True):
        if name in reached:
            yield {"identity": name, "kind": "point", "pose": (x, y, np.nan)}
