"""The pipeline: from the messages of a log to a `Result`, readable top to bottom.

One event (a scan, or the sightings of one stamp) goes: motion since the robot's last state ->
keyframe or not -> observations in the base frame -> association -> `Step` -> back end. It branches
on no landmark kind, front end or back end; those are rows of tables.
"""

import dataclasses
import itertools
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from graphslam.associator import Associator
from graphslam.backends import BACKENDS
from graphslam.backends.isam2 import Isam2Backend
from graphslam.calibration import observed_information
from graphslam.clock_offsets import ClockFound, clocks_found
from graphslam.clocks import Clock, on_one_clock
from graphslam.config import Config, OdometryConfig, RobotConfig, load_config
from graphslam.consolidating import Tamper, consolidate
from graphslam.dead_reckoning import Track
from graphslam.errors import ConfigError, EstimationError, LogError
from graphslam.exchanged import exchanged_names, renamed
from graphslam.frontend import FRONT_ENDS, scan_points
from graphslam.frontend.robots import outline_of
from graphslam.frontend.sightings import sighting_observation
from graphslam.gathering import Gathered, Sources, carried, gather, met, shared, ways
from graphslam.geometry import (
    Array,
    compose,
    compose_cov,
    inverse,
    inverse_cov,
    rotate_cov,
)
from graphslam.logs import LogSet
from graphslam.models import transport
from graphslam.records import (
    Association,
    Closure,
    Estimate,
    Landmark,
    Message,
    Motion,
    Observation,
    Picture,
    RelativePose,
    Result,
    Scan,
    Sighting,
    Step,
    TrueLandmark,
    Truth,
)
from graphslam.refining import refine
from graphslam.robot_run import RobotRun
from graphslam.starts import start_poses
from graphslam.summary import make_landmarks, summarise
from graphslam.timeline import ODOMETRY, synchronise
from graphslam.trajectories import in_world, origin_shift, step_in_world
from graphslam.watching import Watcher

#: scans in the picture at most
MAX_PICTURES = 4000

#: times that the log is taken again by better clocks
MAX_CLOCKS = 4
#: s: sigma of the difference of two robots' clocks before anything is known
CLOCK_DOUBT_S = 0.5

Progress = Callable[[int], None]
Settings = TypeVar("Settings", OdometryConfig, RobotConfig)


class Pipeline:
    """One run over a log."""

    def __init__(
        self,
        log: LogSet,
        config: Config,
        names: Mapping[str, str] | None = None,
        tamper: Tamper | None = None,
        clocks: Mapping[str, Clock] | None = None,
    ) -> None:
        """Nothing read yet.

        Args:
            log: opened logs.
            config: settings.
            names: false name -> right name of what is sighted.
            tamper: for tests.
            clocks: of robots whose clock is not that of the first.
        """
        self.log, self.config, self.names, self.clocks = log, config, names or {}, clocks or {}
        self.tamper = tamper
        self.backend = BACKENDS[config.backend.name](config)
        self.associator = Associator(config.association, self.backend)
        self.front_end = FRONT_ENDS[config.front_end.name]
        self.runs = {
            name: RobotRun(
                Track(
                    sensing(odometry_settings(config.odometry, log.notes), log.has_scans(name)),
                    robot_settings(name, config, log.notes),
                    mounted=True,
                ),
                clock=self.clocks.get(name, Clock()),
            )
            for name in log.robots
        }
        self.starts = start_poses(log, config)
        self.watcher = Watcher(
            self.backend, self.runs, outlines(log, config), config.front_end, CLOCK_DOUBT_S
        )
        self.steps: list[Step] = []
        self.sources: Sources = {}
        self.sightings: list[Sighting] = []  # of robots that entered at their own time
        self.pictures: list[Picture] = []
        self.counts: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self.seconds: dict[str, float] = defaultdict(float)
        self.step_ms: list[float] = []
        self.first_ns, self.last_ns = 1 << 63, 0

    # ------------------------------------------------------------ the loop

    def run(self, progress: Progress) -> None:
        """Take in every message of the log."""
        tracks = {name: run.track for name, run in self.runs.items()}
        read = _counted(self.log.messages((Truth, TrueLandmark)), self.counts, progress)
        messages = synchronise(
            self.wanted(on_one_clock(read, self.clocks)),
            tracks,
            self.config.odometry.max_gap_s,
            self.dropped,
            tuple(self.watcher.outlines),
        )
        # one robot has nobody to share a step with, and a scan makes its own
        alone = len(tracks) < 2 or any(map(self.log.has_scans, tracks))
        alone |= self.config.keyframe.mode == "all"
        span_ns = 0 if alone else round(1e9 * self.config.keyframe.gather_s)
        max_gap_ns = round(1e9 * self.config.odometry.max_gap_s)
        clock = time.perf_counter()
        for event in gather(events(messages), tracks, span_ns, max_gap_ns):
            self.seconds["read"] += time.perf_counter() - clock
            began = time.perf_counter()
            steps = len(self.steps)
            if isinstance(event, Gathered):
                self.take_gathered(event)
            else:
                self.take(event)
            clock = time.perf_counter()
            if len(self.steps) > steps:
                self.step_ms.append(1e3 * (clock - began))

    def wanted(self, messages: Iterable[Message]) -> Iterator[Message]:
        """Messages under right names, without sightings of robots where these are to be ignored."""
        ignore = self.config.association.robots == "ignore"
        for recorded in messages:
            message = recorded
            if self.names and isinstance(message, Sighting):
                message = renamed(message, self.names, self.log.robots)
            if isinstance(message, Sighting) and message.seen_robot == message.robot:
                self.dropped["sighting: a robot does not see itself"] += 1
            elif ignore and isinstance(message, Sighting) and message.seen_robot is not None:
                self.dropped["sighting: of a robot, ignored by association.robots"] += 1
            else:
                yield message

    def take_gathered(self, gathered: Gathered) -> None:
        """All images of a span, in one step at its end.

        Robots that moved, saw a robot or were seen get a state there. Their sightings are carried
        to it, those of others to their last state.
        """
        step_ns = gathered.time_ns
        self.first_ns = min(self.first_ns, gathered.first_ns)
        self.last_ns = max(self.last_ns, step_ns)
        meeting: set[str] = set()
        for image in gathered.images:
            run = self.runs[image[0].robot]
            if not run.started:
                self.start(image[0].robot, min(run.track.first_ns, image[0].time_ns))
            meeting |= {robot for s in image if s.seen_robot for robot in (s.robot, s.seen_robot)}
        for robot in meeting:
            if not self.runs[robot].started:
                self.start(robot, min(self.runs[robot].track.first_ns, step_ns))
        motions: dict[str, Motion] = {}
        for robot in gathered.robots:
            run = self.runs[robot]
            if robot in meeting or self.has_moved(run, run.state_ns, step_ns):
                motion = self.motion_since_state(robot, step_ns)
                if motion is not None:
                    motions[robot] = motion
                    run.path_m += motion.length_m
        began = time.perf_counter()
        known = {i for i, entry in self.associator.map.entries.items() if entry.in_graph}
        associations: tuple[Association, ...] = ()
        at = {r: step_ns if r in motions else self.runs[r].state_ns for r in gathered.robots}
        moved = ways(gathered, at, {robot: self.runs[robot].track for robot in at})
        every = [sighting for image in gathered.images for sighting in image]
        observed = iter(carried(every, [moved[s.robot, s.time_ns] for s in every]))
        for image in gathered.images:
            run, robot = self.runs[image[0].robot], image[0].robot
            state_ns = at[robot]
            seen = list(itertools.islice(observed, len(image)))
            for o, sighting in zip(seen, image, strict=True):
                self.sources[robot, state_ns, o.z.tobytes()] = sighting
            landmarks = [o for o, s in zip(seen, image, strict=True) if s.seen_robot is None]
            self.counts["observations"] += len(seen)
            if landmarks:
                associations += self.associator.associate(
                    robot,
                    state_ns,
                    landmarks,
                    run.causal_poses[-1],
                    motions.get(robot),
                    run.track,
                    run.path_m,
                    gathering=True,
                )
            for o, s in zip(seen, image, strict=True):
                if s.seen_robot is not None:
                    other = self.runs[s.seen_robot]
                    headings = [
                        r.causal_poses[-1][2] + (motions[name].delta[2] if name in motions else 0.0)
                        for name, r in ((s.seen_robot, other), (robot, run))
                    ]
                    turn = float(headings[0] - headings[1])
                    way = moved[s.seen_robot, s.time_ns]
                    association = met(o, s, state_ns, way, turn)
                    self.sources[robot, state_ns, association.z.tobytes()] = s
                    associations += (association,)
        self.note_covariances()
        self.seconds["association"] += time.perf_counter() - began
        self.enter(Step(step_ns, {}, motions, shared(associations)), known)

    def take(self, event: Sequence[Message]) -> None:
        """One event: everything one robot perceived at one time."""
        first = event[0]
        run, time_ns = self.runs[first.robot], first.time_ns
        self.first_ns, self.last_ns = min(self.first_ns, time_ns), max(self.last_ns, time_ns)
        if not run.started:
            self.start(first.robot, min(run.track.first_ns, time_ns))
        run.scans += [(m.stamp_ns, m.time_ns, m.mount) for m in event if isinstance(m, Scan)]
        self.counts["scans"] += isinstance(first, Scan)
        used = self.is_used(event)
        if isinstance(first, Scan):
            event = self.watcher.look(first, used, self.has_started)
            if self.config.association.robots == "ignore":
                event = [m for m in event if isinstance(m, Scan)]
        elif not used:
            event = ()
        if not event:
            return  # its pose follows from the states around it
        motion = self.motion_since_state(first.robot, time_ns)
        own_state = self.gets_state(event)
        began = time.perf_counter()
        seen = self.observations(event, None if own_state else motion)
        self.seconds["front end"] += time.perf_counter() - began
        self.advance(first.robot, time_ns, event, seen, motion if own_state else None)

    def start(self, robot: str, time_ns: int) -> None:
        """Give a robot its first state.

        Raises:
            EstimationError: it is not known where.
        """
        if robot not in self.starts:
            raise EstimationError(
                f"robot {robot}: its start is unknown; give --start {robot}=x,y,phi (m, rad) or "
                "--start truth"
            )
        start = self.starts[robot]
        if robot != min(self.starts):
            # priors are on the base, states on the sensor: where it sits is not known yet, nor is
            # where that of the first robot sits, to which the world is fixed
            cov = start.cov + rotate_cov(2 * self.runs[robot].track.mount_cov, start.pose[2])
            start = replace(start, cov=cov)
        step = Step(time_ns, starts={robot: start})
        self.note_covariances()
        self.backend.add(step)
        self.steps.append(step)
        self.note_state(robot, time_ns)

    def has_started(self, robot: str, time_ns: int) -> bool:
        """Whether a robot has a state at ``time_ns``, given one if it is known where it starts."""
        run = self.runs[robot]
        if not run.started and robot in self.starts and len(run.track):
            self.start(robot, min(run.track.first_ns, time_ns))
        return run.started

    def motion_since_state(self, robot: str, time_ns: int) -> Motion | None:
        """Motion since the robot's last state; None when it is at that very time."""
        run = self.runs[robot]
        if time_ns <= run.state_ns:
            return None
        return run.track.motion(run.state_ns, time_ns)

    def is_used(self, event: Sequence[Message]) -> bool:
        """Whether the event is more than a place on the trajectory.

        Scans overlap, so one is enough per stretch of motion since the last one used, whatever
        states other observations have made in between; sightings are all used.
        """
        first = event[0]
        if self.config.keyframe.mode == "all" or not isinstance(first, (Scan, *ODOMETRY)):
            return True
        run = self.runs[first.robot]
        if isinstance(first, ODOMETRY) or not self.has_moved(run, run.scanned_ns, first.time_ns):
            return False
        run.scanned_ns = first.time_ns
        return True

    def gets_state(self, event: Sequence[Message]) -> bool:
        """Whether a used event has a state at its own time, or is carried back to the last one."""
        first, run = event[0], self.runs[event[0].robot]
        return (
            self.config.keyframe.mode == "all"
            or isinstance(first, Scan)
            or any(isinstance(m, Sighting) and m.seen_robot for m in event)
            or self.has_moved(run, run.state_ns, first.time_ns)
        )

    def has_moved(self, run: RobotRun, since_ns: int | None, time_ns: int) -> bool:
        """Whether the robot moved by a keyframe's distance or angle; True since None."""
        if since_ns is None:
            return True
        path_m, turned_rad = run.track.moved(since_ns, time_ns)
        keyframe = self.config.keyframe
        return path_m >= keyframe.distance_m or turned_rad >= keyframe.angle_rad

    def observations(self, event: Sequence[Message], since: Motion | None) -> list[Observation]:
        """Landmarks seen, in the base frame of the state (``since`` carries back to it)."""
        out = []
        for message in event:
            if isinstance(message, Scan):
                found = self.front_end(message, self.config.front_end)
            elif isinstance(message, Sighting) and message.seen_robot is None:
                found = (sighting_observation(message),)
            else:
                continue
            for o in found:
                z, cov = transport(o.z, o.cov, message.mount, np.zeros((3, 3)))
                if since is not None:
                    z, cov = transport(z, cov, since.delta, since.cov)
                out.append(Observation(o.kind, z, cov, o.extent, o.identity))
        self.counts["observations"] += len(out)
        return out

    def advance(
        self,
        robot: str,
        time_ns: int,
        event: Sequence[Message],
        seen: list[Observation],
        motion: Motion | None,
    ) -> None:
        """Associate, make the step, give it to the back end."""
        run = self.runs[robot]
        motions: dict[str, Motion] = {robot: motion} if motion is not None else {}
        state_ns = time_ns if motion is not None else run.state_ns
        if motion is not None:
            run.path_m += motion.length_m
        began = time.perf_counter()
        known = {i for i, entry in self.associator.map.entries.items() if entry.in_graph}
        associations: tuple[Association, ...] = ()
        if seen:
            associations = self.associator.associate(
                robot, state_ns, seen, run.causal_poses[-1], motion, run.track, run.path_m
            )
        for message in event:
            if isinstance(message, Sighting) and message.seen_robot is not None:
                associations += self.robot_sighting(message, state_ns, motions)
        closures = tuple(self.closure(m, state_ns) for m in event if isinstance(m, RelativePose))
        self.note_covariances()
        self.seconds["association"] += time.perf_counter() - began
        if not (motions or associations or closures):
            return
        self.enter(Step(time_ns, {}, motions, associations, tuple(c for c in closures if c)), known)
        for message in event:
            if isinstance(message, Scan):
                points = scan_points(message, self.config.front_end.max_range_m)
                self.pictures.append(
                    Picture(robot, state_ns, points.astype(np.float32), message.mount)
                )

    def enter(self, step: Step, known: set[int]) -> None:
        """Give a step to the back end, and learn from it; ``known`` landmarks were there before."""
        if not (step.motions or step.associations or step.closures):
            return
        began = time.perf_counter()
        self.backend.add(step)
        self.associator.settle()
        self.steps.append(step)
        for name in step.motions:
            if self.config.odometry.calibrate:
                self.learn(name, step, known)
            self.note_state(name, step.time_ns)
        self.seconds["back end"] += time.perf_counter() - began

    def robot_sighting(
        self, message: Sighting, state_ns: int, motions: dict[str, Motion]
    ) -> tuple[Association, ...]:
        """A sighting of another robot: brings that robot's motion to the same time."""
        other = message.seen_robot
        assert other is not None
        self.sightings.append(message)
        if not self.runs[other].started:
            self.start(other, min(self.runs[other].track.first_ns, state_ns))
        moved = self.motion_since_state(other, state_ns)
        if moved is not None and other not in motions:
            motions[other] = moved
            self.runs[other].path_m += moved.length_m
        z, cov = message.z, message.cov
        model = "robot-point"
        if len(z) == 3:
            o = sighting_observation(message)
            z, cov, model = o.z, o.cov, "robot-pose"
        z, cov = transport(z, cov, message.mount, np.zeros((3, 3)))
        self.counts["observations"] += 1
        return (Association(message.robot, state_ns, other, model, z, cov),)

    def closure(self, message: RelativePose, state_ns: int) -> Closure | None:
        """A measured relative pose, carried by odometry to the states nearest before its ends."""
        other = self.runs.get(message.other)
        if message.other == message.robot and message.start_ns >= message.time_ns:
            self.dropped["relative pose: it does not begin before it ends"] += 1
            return None
        if other is None or not other.started or message.start_ns < other.times[0]:
            self.dropped["relative pose: its first end has no state"] += 1
            return None
        other_ns = other.times[int(np.searchsorted(other.times, message.start_ns, "right")) - 1]
        delta, cov = message.delta, message.cov
        if other_ns < message.start_ns:
            lead = other.track.motion(other_ns, message.start_ns)
            cov = compose_cov(lead.delta, lead.cov, delta, cov)
            delta = compose(lead.delta, delta)
        if state_ns < message.time_ns:
            tail = self.runs[message.robot].track.motion(state_ns, message.time_ns)
            back = inverse(tail.delta)
            cov = compose_cov(delta, cov, back, inverse_cov(tail.delta, tail.cov))
            delta = compose(delta, back)
        self.counts["loop_closures"] += 1
        return Closure(message.robot, state_ns, message.other, other_ns, delta, cov)

    def note_state(self, robot: str, time_ns: int) -> None:
        """Book a new state."""
        run = self.runs[robot]
        run.append(time_ns, self.backend.state_mean(robot))
        self.counts["keyframes"] += 1

    def learn(self, robot: str, step: Step, known: set[int]) -> None:
        """Improve the robot's calibration from a step; ``known`` landmarks were there before it."""
        run, pose = self.runs[robot], self.backend.state_mean(robot)
        seen = [
            a
            for a in step.associations
            if a.robot == robot and a.target in known and a.time_ns == step.time_ns
        ]
        landmarks = self.backend.landmark_means([a.target for a in seen if a.target in known])
        heading = float(run.causal_poses[-1][2])
        observed = observed_information(seen, pose, landmarks, heading)
        run.learn(step.motions[robot], pose, observed)

    def note_covariances(self) -> None:
        """Book the causal covariance of states that have none yet.

        Asked for as late as possible, just before the next step: by then association has needed
        the same marginal, and reading it from an incremental smoother is dear.
        """
        for robot, run in self.runs.items():
            if len(run.causal_covs) < len(run.times):
                run.causal_covs.append(self.backend.joint(robot, []).cov)

    def estimate(self) -> tuple[Estimate, bool]:
        """What the back end has at the end, and whether that is only where `reconsider` begins."""
        settings = self.config.backend
        if isinstance(self.backend, Isam2Backend) and settings.polish and settings.reconsider:
            return self.backend.rough(), True
        return self.backend.finish(), False

    def reconsider(self, estimate: Estimate) -> Estimate:
        """The log solved again from a rough estimate; the steps follow the result."""
        tracks = {name: run.track for name, run in self.runs.items() if run.started}
        if self.sources:
            refined = refine(self.steps, estimate, tracks, self.sources, self.config)
            self.steps = list(refined.steps)
            for name in tracks:
                self.runs[name].refined = self.config.odometry.calibrate
            return refined.estimate
        done = consolidate(
            self.steps,
            estimate,
            tracks,
            self.associator.map,
            self.pictures,
            self.config,
            self.tamper,
        )
        self.steps = list(done.steps)
        self.counts.update(done.counts)
        return done.estimate

    def clocks_found(self, estimate: Estimate) -> dict[str, ClockFound]:
        """What the robots' sightings of each other say about their clocks."""
        tracks = {name: run.track for name, run in self.runs.items() if run.started}
        seen = {id(s): s for s in self.sources.values() if s.seen_robot}.values()
        sightings = [*seen, *self.sightings]
        return clocks_found(
            self.steps, estimate, sightings, tracks, self.clocks, self.config.robust
        )

    def exchanged(self, estimate: Estimate) -> dict[str, str]:
        """Names of what was sighted that turn out to be each other's: false -> right name."""
        if not self.sources or self.config.association.identities == "ignore":
            return {}
        tracks = {name: run.track for name, run in self.runs.items() if run.started}
        sightings = {id(sighting): sighting for sighting in self.sources.values()}
        pairs = exchanged_names(sightings.values(), estimate, tracks)
        return {a: b for pair in pairs for a, b in (pair, pair[::-1])}


def smooth(
    log: LogSet,
    config: Config,
    progress: Progress = lambda _count: None,
    tamper: Tamper | None = None,
) -> Result:
    """Estimate everything that a log tells: the main job.

    Args:
        log: opened logs.
        config: settings.
        progress: called with the number of messages read so far.
        tamper: for tests, see `graphslam.consolidating.Tamper`.

    Raises:
        LogError: no message of the log could be used.
        ConfigError: a setting is about a robot that is not in the log.
        EstimationError: the estimate is indeterminate, or a robot's start is unknown.
    """
    began = time.perf_counter()
    check_robots(log, config)
    pipeline = _passed(Pipeline(log, config, None, tamper), progress)
    finishing = time.perf_counter()
    estimate, rough = pipeline.estimate()
    names = pipeline.exchanged(estimate)
    if names:
        pipeline = _passed(Pipeline(log, config, names, tamper), progress)
        finishing = time.perf_counter()
        estimate, rough = pipeline.estimate()
    clocks = pipeline.clocks_found(estimate)
    for _ in range(MAX_CLOCKS):
        if not any(found.differs for found in clocks.values()):
            break
        known = {robot: found.clock for robot, found in clocks.items()}
        pipeline = _passed(Pipeline(log, config, names, tamper, known), progress)
        finishing = time.perf_counter()
        estimate, rough = pipeline.estimate()
        clocks = pipeline.clocks_found(estimate)
    if rough:
        estimate = pipeline.reconsider(estimate)
    pipeline.seconds["final optimisation"] = time.perf_counter() - finishing
    finishing = time.perf_counter()
    runs = {name: run for name, run in sorted(pipeline.runs.items()) if run.started}
    first = next(iter(runs))
    start = pipeline.starts[first].pose
    world = origin_shift(start, runs[first].track.mount)
    causal_only = all(run.is_causal(estimate.states[name]) for name, run in runs.items())
    estimate = in_world(estimate, world)
    steps = tuple(step_in_world(step, world) for step in pipeline.steps)
    robots = {
        name: run.result(estimate.states[name], start, causal_only=causal_only)
        for name, run in runs.items()
    }
    pipeline.seconds["trajectories"] = time.perf_counter() - finishing
    landmarks: tuple[Landmark, ...] = make_landmarks(
        pipeline.associator.map.in_world(world), estimate
    )
    t0 = min(trajectory.stamps_ns[0] for trajectory in estimate.states.values())
    innovations = {
        model: np.array([((t - t0) * 1e-9, d2) for t, d2 in values]).reshape(-1, 2)
        for model, values in sorted(pipeline.associator.innovations.items())
    }
    pipeline.seconds["all"] = time.perf_counter() - began
    summary = summarise(
        log=log,
        config=config,
        estimate=estimate,
        counts=pipeline.counts,
        rejected=pipeline.associator.rejected,
        dropped=pipeline.dropped + pipeline.watcher.counts,
        tentative_deleted=pipeline.associator.map.deleted,
        line_closures=pipeline.associator.closures,
        landmarks=len(landmarks),
        seconds=pipeline.seconds,
        calibration={name: run.calibration_found() for name, run in runs.items()},
        clocks=clocks,
        warnings=run_warnings(pipeline),
        log_s=1e-9 * (pipeline.last_ns - pipeline.first_ns),
    )
    return Result(
        robots,
        landmarks,
        estimate,
        steps,
        tuple(pipeline.pictures[:: 1 + len(pipeline.pictures) // MAX_PICTURES]),
        innovations,
        np.array(pipeline.step_ms),
        summary,
    )


def _passed(pipeline: Pipeline, progress: Progress) -> Pipeline:
    """A pipeline after its log went by."""
    pipeline.run(progress)
    if not pipeline.steps:
        path = pipeline.log.files[0].path
        raise LogError(f"{path}: nothing in it could be used; see `graphslam info`")
    pipeline.note_covariances()
    return pipeline


def outlines(log: LogSet, config: Config) -> dict[str, Array]:
    """Robot -> corners (k, 2), m, of those whose outline is known."""
    known = {name: robot_settings(name, config, log.notes).outline for name in log.robots}
    return {name: outline_of(corners) for name, corners in known.items() if corners}


def robot_settings(name: str, config: Config, notes: Mapping[str, str]) -> RobotConfig:
    """Settings of a robot: the configuration's where set, else what the log's notes say of it."""
    noted = [f"{key}={value}" for key, value in notes.items() if key.startswith(f"robots.{name}.")]
    return _noted(config.robot(name), load_config(overrides=noted).robot(name), RobotConfig())


def odometry_settings(config: OdometryConfig, notes: Mapping[str, str]) -> OdometryConfig:
    """Settings of odometry: the configuration's where set, else what the log's notes say of it.

    How well velocities are driven that were only commanded is a property of the log's robots, which
    whoever wrote the log knows, as with the noise of sightings.
    """
    noted = [f"{key}={value}" for key, value in notes.items() if key.startswith("odometry.")]
    return _noted(config, load_config(overrides=noted).odometry, OdometryConfig())


def _noted(config: Settings, noted: Settings, default: Settings) -> Settings:
    """Settings as in ``config``, as in ``noted`` where they are the default."""
    changes = {
        field.name: getattr(noted, field.name)
        for field in dataclasses.fields(config)
        if getattr(config, field.name) == getattr(default, field.name)
    }
    return replace(config, **changes)


def sensing(config: OdometryConfig, scans: bool) -> OdometryConfig:
    """Settings of a robot's calibration: without a laser only the latency of its sightings."""
    if scans:
        return config
    return replace(
        config,
        laser_sigma_m=0.0,
        laser_sigma_rad=0.0,
        laser_latency_sigma_s=config.sighting_latency_sigma_s,
    )


def check_robots(log: LogSet, config: Config) -> None:
    """Refuse settings about robots that are not there.

    Raises:
        ConfigError: naming the key.
    """
    for name in config.robots:
        if name not in (*log.robots, "default"):
            known = ", ".join(log.robots)
            raise ConfigError(f"robots.{name}: the log has no robot {name}, but {known}")


def run_warnings(pipeline: Pipeline) -> list[str]:
    """What a user should know about a run although it went through."""
    warnings = [
        f"{name}: its odometry jumped {run.track.resets} times; taken to have gone on as before"
        for name, run in pipeline.runs.items()
        if run.track.resets
    ]
    warnings += [
        f"{name}: its wheel radii and axle are not set; the defaults of robots.{name}.* were used"
        for name, run in pipeline.runs.items()
        if run.track.source == "wheels"
        and replace(robot_settings(name, pipeline.config, pipeline.log.notes), outline=())
        == RobotConfig()
    ]
    warnings += [
        f"{a} and {b}: bore each other's code in all sightings; their names were exchanged back"
        for a, b in pipeline.names.items()
        if a < b
    ]
    warnings += [
        f"the back end could not use {count} x {reason}"
        for reason, count in sorted(pipeline.backend.skipped.items())
    ]
    if not any(step.associations or step.closures for step in pipeline.steps):
        warnings.append("no observation entered the estimate: this is dead reckoning")
    return warnings


def events(messages: Iterable[Message]) -> Iterator[list[Message]]:
    """Messages grouped: the sightings of one robot at one time are one image."""

    def key(message: Message) -> tuple[object, ...]:
        if isinstance(message, Sighting):
            return (message.robot, message.time_ns)
        return (id(message),)

    for _, group in itertools.groupby(messages, key):
        yield list(group)


def _counted(
    messages: Iterable[Message], counts: Counter[str], progress: Progress
) -> Iterator[Message]:
    for message in messages:
        counts["messages"] += 1
        if counts["messages"] % 500 == 0:
            progress(counts["messages"])
        yield message
