"""One pass over a log: from its messages to steps in a back end, readable top to bottom.

One event (a scan, or the sightings of one stamp) goes: motion since the robot's last state ->
keyframe or not -> observations in the base frame -> association -> `Step` -> back end. It branches
on no landmark kind, front end or back end; those are rows of tables.
"""

import itertools
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from graphslam.core.config import Config
from graphslam.core.errors import EstimationError
from graphslam.core.geometry import (
    Array,
    compose,
    compose_cov,
    inverse,
    inverse_cov,
    rotate_cov,
    rotation3,
)
from graphslam.core.observation_models import transport
from graphslam.core.records import (
    Association,
    Closure,
    Estimate,
    Message,
    Motion,
    Observation,
    Picture,
    RelativePose,
    Scan,
    Sighting,
    Step,
    TrueLandmark,
    Truth,
)
from graphslam.estimation.backends import BACKENDS
from graphslam.estimation.clock_calibration import ClockEstimate, estimate_clocks
from graphslam.estimation.isam2 import Isam2Backend
from graphslam.logs import LogSet
from graphslam.logs.clock import Clock, to_common_clock
from graphslam.mapping.data_association import Associator
from graphslam.multi_robot.frame_tree import FrameAssignment
from graphslam.multi_robot.frames import RobotFrames
from graphslam.multi_robot.identity_swaps import find_swapped_identities, rename_identities
from graphslam.multi_robot.mutual_detection import ScanBuffer
from graphslam.multi_robot.robot_detection import RobotDetector
from graphslam.odometry.interpolation import FrameTransforms
from graphslam.odometry.online_calibration import observed_information
from graphslam.odometry.readings import settle
from graphslam.odometry.scan_odometry import (
    beside_lines,
    checked_against_scans,
    measured,
    scan_submap,
)
from graphslam.perception.front_ends import FRONT_ENDS
from graphslam.perception.ordered_scan import scan_points
from graphslam.perception.sightings import sighting_observation
from graphslam.slam.recorded_closures import RecordedClosures, closure_id
from graphslam.slam.reoptimise_scans import Tamper, reoptimise_scan_log
from graphslam.slam.reoptimise_sightings import reoptimise_sighting_log
from graphslam.slam.robot_settings import make_tracks, noted, outlines
from graphslam.slam.robot_state import RobotState
from graphslam.slam.sighting_batches import (
    SightingBatch,
    batch_motions,
    batch_sightings,
    events,
    inflate_repeated,
    robot_observations,
    to_state_frame,
)
from graphslam.slam.synchronisation import ODOMETRY, synchronise

#: s: sigma of the difference of two robots' clocks before anything is known
CLOCK_DOUBT_S = 0.5

Progress = Callable[[int], None]


@dataclass(frozen=True, slots=True, eq=False)
class PriorKnowledge:
    """What is known before a log goes by: from what was given, and from earlier passes.

    ``joined``: where robots start and in which frames. ``recorded``: which of the log's relative
    poses are believed. ``names``: false name -> right name of what is sighted. ``clocks``: of
    robots whose clock is not that of the first.
    """

    joined: FrameAssignment
    recorded: RecordedClosures
    names: Mapping[str, str] = field(default_factory=dict)
    clocks: Mapping[str, Clock] = field(default_factory=dict)


class Pipeline:
    """One run over a log."""

    def __init__(
        self, log: LogSet, config: Config, known: PriorKnowledge, tamper: Tamper | None = None
    ) -> None:
        """Nothing read yet; for ``tamper`` see `graphslam.slam.reoptimise_scans.Tamper`."""
        config = replace(config, keyframe=noted(config.keyframe, "keyframe", log.notes))
        self.log, self.config, self.known = log, config, known
        self.tamper = tamper
        self.backend = BACKENDS[config.backend.name](config)
        self.associator = Associator(config.association, self.backend)
        self.front_end = FRONT_ENDS[config.front_end.name]
        # dead reckoning is of odometry alone
        self.matches_scans = config.odometry.scan_matching != "off" and (
            config.backend.name != "dead-reckoning" and config.front_end.name != "none"
        )
        self.runs = {
            name: RobotState(track, clock=known.clocks.get(name, Clock()))
            for name, track in make_tracks(log, config).items()
        }
        self.starts, self.frames = known.joined.starts, RobotFrames(known.joined)
        self.meetings: list[Sighting] = []  # of robots in frames that nothing relates
        self.kept = ScanBuffer({}, {})  # scans in which these are looked for afterwards
        self.watcher = RobotDetector(
            self.backend, self.runs, outlines(log, config), config.front_end, CLOCK_DOUBT_S
        )
        self.steps: list[Step] = []
        self.sources: list[Sighting] = []  # of steps of several images, see `Association.source`
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
        read = _counted(
            self.log.messages((Truth, TrueLandmark), prefetch=True), self.counts, progress
        )
        messages = synchronise(
            self.wanted(to_common_clock(read, self.known.clocks)),
            tracks,
            self.config.odometry.max_gap_s,
            self.dropped,
            tuple(self.watcher.outlines),
        )
        # one robot has nobody to share a step with, and a scan makes its own
        alone = len(tracks) < 2 or any(map(self.log.has_scans, tracks))
        alone |= self.config.keyframe.mode == "all"
        span_ns = 0 if alone else round(1e9 * self.config.keyframe.sighting_window_s)
        max_gap_ns = round(1e9 * self.config.odometry.max_gap_s)
        clock = time.perf_counter()
        for event in batch_sightings(events(messages), tracks, span_ns, max_gap_ns):
            self.seconds["read"] += time.perf_counter() - clock
            began = time.perf_counter()
            steps = len(self.steps)
            if isinstance(event, SightingBatch):
                self.add_sighting_batch(event)
            else:
                self.add_event(event)
            clock = time.perf_counter()
            if len(self.steps) > steps:
                self.step_ms.append(1e3 * (clock - began))

    def wanted(self, messages: Iterable[Message]) -> Iterator[Message]:
        """Messages under right names, without sightings of robots where these are to be ignored."""
        ignore = self.config.association.robot_sightings == "ignore"
        for recorded in messages:
            message = recorded
            if self.known.names and isinstance(message, Sighting):
                message = rename_identities(message, self.known.names, self.log.robots)
            if isinstance(message, Sighting) and message.seen_robot == message.robot:
                self.dropped["sighting: a robot does not see itself"] += 1
            elif ignore and isinstance(message, Sighting) and message.seen_robot is not None:
                self.dropped["sighting: of a robot, ignored by association.robot_sightings"] += 1
            elif self.frames.crosses_frames(message):
                kind = type(message).__name__.lower()
                self.dropped[f"{kind}: of a robot in a frame of its own"] += 1
                if isinstance(message, Sighting):
                    self.meetings.append(message)
            else:
                yield self.frames.with_frame_identity(message)

    def add_sighting_batch(self, gathered: SightingBatch) -> None:
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
        for robot in sorted(meeting):  # states in an order that no hash decides
            if not self.runs[robot].started:
                self.start(robot, min(self.runs[robot].track.first_ns, step_ns))
        settle(self.runs[robot].track for robot in gathered.robots)
        angle = self.config.keyframe.angle_rad
        last_ns = {
            robot: run.state_ns
            for robot, run in ((robot, self.runs[robot]) for robot in gathered.robots)
            if step_ns > run.state_ns
            and (robot in meeting or self.has_moved(run, run.state_ns, step_ns, angle))
        }
        at = {r: step_ns if r in last_ns else self.runs[r].state_ns for r in gathered.robots}
        moved, new = batch_motions(
            gathered, at, last_ns, {robot: self.runs[robot].track for robot in at}
        )
        motions = {robot: new[robot] for robot in last_ns}
        for robot, motion in motions.items():
            self.runs[robot].path_m += motion.length_m
        began = time.perf_counter()
        known = {i for i, entry in self.associator.map.entries.items() if entry.in_graph}
        associations: tuple[Association, ...] = ()
        every = [sighting for image in gathered.images for sighting in image]
        seen = to_state_frame(every, [moved[s.robot, s.time_ns] for s in every], len(self.sources))
        self.sources += every
        heading = {
            name: self.runs[name].causal_poses[-1][2]
            + (motions[name].delta[2] if name in motions else 0.0)
            for name in at
        }
        observed, robots = iter(seen), iter(robot_observations(every, seen, at, moved, heading))
        for image in gathered.images:
            own = list(itertools.islice(observed, len(image)))
            associations += self.seen_in(image, own, at[image[0].robot], motions)
            for sighting in image:
                if sighting.seen_robot is not None:
                    associations += (next(robots),)
        self.note_covariances()
        self.seconds["association"] += time.perf_counter() - began
        self.enter(Step(step_ns, {}, motions, inflate_repeated(associations)), known)

    def seen_in(
        self,
        image: Sequence[Sighting],
        seen: Sequence[Observation],
        state_ns: int,
        motions: Mapping[str, Motion],
    ) -> tuple[Association, ...]:
        """Associations of the landmarks in one image of a step of several.

        Args:
            image: sightings of one robot at one time.
            seen: the same in its base frame at its state.
            state_ns: time of that state.
            motions: of the step, of robots that get a state.
        """
        robot = image[0].robot
        run = self.runs[robot]
        landmarks = [o for o, s in zip(seen, image, strict=True) if s.seen_robot is None]
        self.counts["observations"] += len(seen)
        if not landmarks:
            return ()
        return self.associator.associate(
            robot,
            state_ns,
            landmarks,
            run.causal_poses[-1],
            motions.get(robot),
            run.track,
            run.path_m,
            gathering=True,
        )

    def add_event(self, event: Sequence[Message]) -> None:
        """One event: everything one robot perceived at one time."""
        first = event[0]
        run, time_ns = self.runs[first.robot], first.time_ns
        self.first_ns, self.last_ns = min(self.first_ns, time_ns), max(self.last_ns, time_ns)
        if not run.started:
            self.start(first.robot, min(run.track.first_ns, time_ns))
        if isinstance(first, ODOMETRY) and self.config.keyframe.mode != "all":
            return  # a place on the trajectory, no more; most of a log is this
        run.scans += [(m.stamp_ns, m.time_ns, m.mount) for m in event if isinstance(m, Scan)]
        self.counts["scans"] += isinstance(first, Scan)
        used = self.is_used(event)
        if isinstance(first, Scan):
            self.kept.add(first)
            event = self.watcher.process(first, used, self.has_started)
            if self.config.association.robot_sightings == "ignore":
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
        second = None
        if own_state and isinstance(first, Scan) and self.matches_scans:
            began = time.perf_counter()
            motion, second = self.matched(first, motion, seen)
            self.seconds["scan matching"] += time.perf_counter() - began
        self.advance(first.robot, time_ns, event, seen, motion if own_state else None, second)

    def matched(
        self, scan: Scan, motion: Motion | None, seen: list[Observation]
    ) -> tuple[Motion | None, Closure | None]:
        """The motion to a scan as that of the state before allows it, and a second source of it."""
        run = self.runs[scan.robot]
        points = scan_points(scan, self.config.front_end.max_range_m)
        now, last = scan_submap(points), run.scan
        run.scan = None if now is None else (scan.time_ns, now)
        if motion is None or now is None or last is None or last[0] != motion.start_ns:
            return motion, None
        run.motions += 1
        motion = checked_against_scans(motion, last[1], now)
        run.contradicted += motion.matched
        if self.config.odometry.scan_matching == "auto" or motion.matched:
            return motion, None
        return motion, measured(motion, last[1], scan.robot, beside_lines(points, seen))

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
        start = self.frames.offset_start(robot, self.starts[robot])
        if robot != self.frames.of[robot]:
            # priors are on the base, states on the sensor: where it sits is not known yet, nor is
            # where that of the first robot sits, to which the world is fixed
            cov = start.cov + rotate_cov(2 * self.runs[robot].track.mount_cov, start.pose[2])
            start = replace(start, cov=cov)
        step = Step(time_ns, starts={robot: start})
        self.note_covariances()
        self.backend.add(step)
        self.steps.append(step)
        self.note_state(robot, time_ns, self.backend.state_mean(robot))

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
        if self.config.keyframe.mode == "all" or not isinstance(first, Scan):
            return True
        run = self.runs[first.robot]
        angle = self.config.keyframe.scan_angle_rad
        if not self.has_moved(run, run.scanned_ns, first.time_ns, angle):
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
            or self.has_moved(run, run.state_ns, first.time_ns, self.config.keyframe.angle_rad)
        )

    def has_moved(
        self, run: RobotState, since_ns: int | None, time_ns: int, angle_rad: float
    ) -> bool:
        """Whether the robot moved by a keyframe's distance or by an angle; True since None."""
        if since_ns is None:
            return True
        path_m, turned_rad = run.track.moved(since_ns, time_ns)
        return path_m >= self.config.keyframe.distance_m or turned_rad >= angle_rad

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
        second: Closure | None,
    ) -> None:
        """Associate, make the step, give it to the back end; ``second`` source of the motion."""
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
        given = (self.closure(m, state_ns) for m in event if isinstance(m, RelativePose))
        closures = tuple(c for c in (second, *given) if c)
        self.note_covariances()
        self.seconds["association"] += time.perf_counter() - began
        if not (motions or associations or closures):
            return
        self.enter(Step(time_ns, {}, motions, associations, closures), known)
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
        poses = {name: self.backend.state_mean(name) for name in step.motions}
        if self.config.odometry.calibrate:
            self.learn(step, poses, known)
        for name, pose in poses.items():
            self.note_state(name, step.time_ns, pose)
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
        if closure_id(message) in self.known.recorded.refused:
            self.dropped["relative pose: not believed, see closures"] += 1
            return None
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
        verified = closure_id(message) in self.known.recorded.kept
        return Closure(message.robot, state_ns, message.other, other_ns, delta, cov, verified)

    def note_state(self, robot: str, time_ns: int, pose: Array) -> None:
        """Book a new state, which is at ``pose`` (3,)."""
        self.runs[robot].append(time_ns, pose)
        self.counts["keyframes"] += 1

    def learn(self, step: Step, poses: Mapping[str, Array], known: set[int]) -> None:
        """Improve robots' calibration from a step.

        Args:
            step: as the back end has it.
            poses: (3,) estimates of the states that it made.
            known: landmarks that were there before it.
        """
        seen = [
            a
            for a in step.associations
            if a.robot in poses and a.time_ns == step.time_ns and a.target in known
        ]
        landmarks = self.backend.landmark_means([a.target for a in seen if a.target in known])
        observed = observed_information(seen, poses, landmarks)
        for robot, pose in poses.items():
            turn = rotation3(-float(self.runs[robot].causal_poses[-1][2]))
            self.runs[robot].learn(step.motions[robot], pose, turn @ observed[robot] @ turn.T)

    def note_covariances(self) -> None:
        """Book the causal covariance of states that have none yet.

        Asked for as late as possible, just before the next step: by then association has needed
        the same marginal, and reading it from an incremental smoother is dear.
        """
        for robot, run in self.runs.items():
            if len(run.causal_covs) < len(run.times):
                run.causal_covs.append(self.backend.joint(robot, []).cov)

    def estimate(self) -> tuple[Estimate, bool]:
        """What the back end has at the end, and whether that is only where `reoptimise` begins."""
        settings = self.config.backend
        if (
            isinstance(self.backend, Isam2Backend)
            and settings.optimise_at_end
            and settings.reoptimise
        ):
            return self.backend.current_estimate(), True
        return self.backend.finish(), False

    @property
    def is_refined(self) -> bool:
        """Whether `reoptimise` is `refining`, which is quick, and not `consolidating`."""
        return bool(self.sources)

    def reoptimise(self, estimate: Estimate) -> Estimate:
        """The log solved again from a rough estimate; the steps follow the result."""
        tracks = {name: run.track for name, run in self.runs.items() if run.started}
        if self.is_refined:
            refined = reoptimise_sighting_log(
                self.steps, estimate, tracks, self.sources, self.config
            )
            self.steps = list(refined.steps)
            for name in tracks:
                self.runs[name].refined = self.config.odometry.calibrate
            return refined.estimate
        done = reoptimise_scan_log(
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
        for name in tracks:
            self.runs[name].refined = self.config.odometry.calibrate
        return done.estimate

    def estimate_clocks(self, estimate: Estimate) -> dict[str, ClockEstimate]:
        """What the robots' sightings of each other say about their clocks."""
        tracks = {name: run.track for name, run in self.runs.items() if run.started}
        sightings = [*(s for s in self.sources if s.seen_robot), *self.sightings]
        return estimate_clocks(
            self.steps, estimate, sightings, tracks, self.known.clocks, self.config
        )

    def worlds(self) -> FrameTransforms:
        """What takes every robot and landmark from where it was estimated into its frame."""
        tracks = {name: run.track for name, run in self.runs.items()}
        return self.frames.transforms(tracks, self.associator.map.entries.values())

    def exchanged(self, estimate: Estimate) -> dict[str, str]:
        """Names of what was sighted that turn out to be each other's: false -> right name."""
        if not self.sources or self.config.association.identities == "ignore":
            return {}
        tracks = {name: run.track for name, run in self.runs.items() if run.started}
        pairs = find_swapped_identities(self.sources, estimate, tracks)
        return {a: b for pair in pairs for a, b in (pair, pair[::-1])}


def _counted(
    messages: Iterable[Message], counts: Counter[str], progress: Progress
) -> Iterator[Message]:
    for message in messages:
        counts["messages"] += 1
        if counts["messages"] % 500 == 0:
            progress(counts["messages"])
        yield message
