"""One pass over a log: from its messages to steps in a back end, readable top to bottom.

An event (a scan, or the sightings of one stamp) passes these stages: motion since the robot's last
state -> keyframe selection -> observations in the base frame -> data association -> `Step` -> back
end. Landmark kinds, front ends and back ends are rows of tables.
"""

import itertools
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from graphslam.core.config import Config
from graphslam.core.observation_models import transport
from graphslam.core.record import replace
from graphslam.core.records import (
    TRUE_RECORDS,
    Association,
    Closure,
    KeyframeScan,
    Message,
    Motion,
    Observation,
    RelativePose,
    Scan,
    Sighting,
    Step,
)
from graphslam.logs import LogSet
from graphslam.logs.clock import to_common_clock
from graphslam.mapping.data_association import Image
from graphslam.mapping.loop_closure import Tamper
from graphslam.mapping.robot_candidates import robot_associations, robots_in
from graphslam.multi_robot.identity_swaps import rename_identities
from graphslam.multi_robot.mutual_detection import ScanBuffer
from graphslam.multi_robot.robot_detection import RobotDetector
from graphslam.odometry.gap_bridging import with_bridged_gaps
from graphslam.odometry.laser_odometry import with_laser_odometry
from graphslam.odometry.readings import integrate_pending
from graphslam.odometry.scan_odometry import (
    checked_against_scans,
    match_off_lines,
    points_off_lines,
    scan_submap,
)
from graphslam.odometry.sweep_motion import undistorted_by_track
from graphslam.perception.front_ends import FRONT_ENDS
from graphslam.perception.ordered_scan import scan_points
from graphslam.perception.sightings import (
    may_be_landmark,
    may_be_robot,
    sighting_observation,
)
from graphslam.pipeline.keyframes import KeyframeSelector
from graphslam.pipeline.log_pass import PriorKnowledge, Progress, counted, timed
from graphslam.pipeline.recorded_closures import between_states
from graphslam.pipeline.robot_settings import outlines
from graphslam.pipeline.robot_sightings import RobotCandidates, with_named_robots
from graphslam.pipeline.scans_between import are_matched
from graphslam.pipeline.sighting_batches import (
    Event,
    SightingBatch,
    batch_motions,
    batch_sightings,
    events,
    inflate_repeated,
    robot_observations,
    to_state_frame,
)
from graphslam.pipeline.step_recorder import StepRecorder
from graphslam.pipeline.synchronisation import ODOMETRY, synchronise

#: s: sigma of the difference of two robots' clocks before anything is known
CLOCK_OFFSET_SIGMA_S = 0.5


class Pipeline(StepRecorder):
    """One pass over a log, and what it accumulates.

    ``sources`` are the sightings that `Association.source` numbers (steps of several images only);
    ``robot_sightings`` those of robots that entered at their own time; ``unrelated_sightings``
    those of robots in another frame, for which ``scan_buffer`` keeps scans.
    """

    def __init__(
        self,
        log: LogSet,
        config: Config,
        known: PriorKnowledge,
        tamper: Tamper | None = None,
        *,
        batch_steps: bool = True,
    ) -> None:
        """Reads nothing yet.

        For ``tamper`` see `graphslam.mapping.loop_closure.Tamper`, for the others `StepRecorder`.
        """
        super().__init__(log, config, known, batch_steps=batch_steps)
        self.tamper = tamper
        self.front_end = FRONT_ENDS[config.front_end.name]
        # dead reckoning is of odometry alone
        self.matches_scans = config.odometry.scan_matching != "off" and (
            config.backend.name != "dead-reckoning" and config.front_end.name != "none"
        )
        self.robot_detector = RobotDetector(
            self.backend, self.runs, outlines(log, config), config, CLOCK_OFFSET_SIGMA_S
        )
        # once an earlier pass has found the clocks they are known
        self.clock_sigma_s = 0.0 if known.clocks else CLOCK_OFFSET_SIGMA_S
        self.candidates = RobotCandidates(
            self.runs, self.frames.of, config, self.clock_sigma_s, self.has_started
        )
        self.scan_buffer = ScanBuffer({}, {}, 0.0)
        kinds = {topic.record for topic in log.topics}
        # of one robot alone; several have their sightings collected in batches
        self.of_sightings = len(log.robots) == 1 and config.keyframe.mode != "all"
        self.of_sightings &= Sighting in kinds and not kinds & {Scan, RelativePose}
        # sightings alone are solved again with states at their times
        self.keyframes = KeyframeSelector(self.config.keyframe, at_sightings=Scan in kinds)
        self.removed_returns = self.robot_detector.counts
        self.unrelated_sightings: list[Sighting] = []

    def run(self, progress: Progress) -> None:
        """Take in every message of the log; ``progress`` gets the number of messages read."""
        for _ in self.process(self.messages(progress)):
            pass
        self.counts["loop_closures"] += self.associator.closures
        self.landmarks.drop_index()

    def process(self, messages: Iterable[Message]) -> Iterator[Event]:
        """Take in messages, sorted by time; gives each event once it is taken in."""
        tracks = {name: run.track for name, run in self.runs.items()}
        read = self.accepted(to_common_clock(messages, self.known.clocks))
        read = with_laser_odometry(read, self.log.without_odometry, self.config)
        synchronised = synchronise(
            with_bridged_gaps(read, self.log.bridged, self.config, tracks),
            tracks,
            self.config.odometry.max_gap_s,
            self.dropped,
            tuple(self.robot_detector.outlines),
        )
        # a single robot shares no step with others, and every scan makes a step of its own
        alone = len(tracks) < 2 or any(map(self.log.has_scans, tracks))
        alone |= self.config.keyframe.mode == "all"
        span_ns = 0 if alone else round(1e9 * self.config.keyframe.sighting_window_s)
        max_gap_ns = round(1e9 * self.config.odometry.max_gap_s)
        clock = time.perf_counter()
        for event in batch_sightings(events(synchronised), tracks, span_ns, max_gap_ns):
            self.seconds["read"] += time.perf_counter() - clock
            began = time.perf_counter()
            steps = len(self.steps)
            if isinstance(event, SightingBatch):
                self.add_sighting_batch(event)
            else:
                self.add_event(event)
            if len(self.steps) > steps:
                self.step_ms.append(1e3 * (time.perf_counter() - began))
            yield event
            clock = time.perf_counter()

    def messages(self, progress: Progress) -> Iterator[Message]:
        """The messages of the log but truth, counted; for ``progress`` see `run`."""
        read = self.log.messages(TRUE_RECORDS, prefetch=True, keep=True)
        return counted(read, self.counts, progress)

    def accepted(self, messages: Iterable[Message]) -> Iterator[Message]:
        """Messages under their right identities, without sightings that are not to be used."""
        ignore = self.config.association.robot_sightings == "ignore"
        for recorded in messages:
            message = recorded
            if not isinstance(message, (Sighting, RelativePose)):  # most are: of one robot alone
                yield message
                continue
            if self.known.identities and isinstance(message, Sighting):
                message = rename_identities(message, self.known.identities, self.log.robots)
            if isinstance(message, Sighting) and message.seen_robot == message.robot:
                self.dropped["sighting: a robot does not see itself"] += 1
            elif ignore and isinstance(message, Sighting) and not may_be_landmark(message):
                self.dropped["sighting: of a robot, ignored by association.robot_sightings"] += 1
            elif ignore and isinstance(message, Sighting):
                yield self.frames.with_frame_identity(replace(message, may_be="landmark"))
            elif self.frames.crosses_frames(message):
                kind = type(message).__name__.lower()
                self.dropped[f"{kind}: between robots in separate frames"] += 1
                if isinstance(message, Sighting):
                    self.unrelated_sightings.append(message)
            else:
                yield self.frames.with_frame_identity(message)

    def add_sighting_batch(self, batch: SightingBatch) -> None:
        """All images of a span, in one step at its end.

        Robots that moved, saw a robot or were seen get a state there. Their sightings are moved to
        it by odometry, those of other robots to their last state.
        """
        step_ns = batch.time_ns
        self.record_time(batch.first_ns)
        self.record_time(step_ns)
        for image in batch.images:
            self.start_if_needed(image[0].robot)
        sightings = [sighting for image in batch.images for sighting in image]
        possible = [self.candidates.possible(sighting) for sighting in sightings]
        named, behind = with_named_robots(batch, possible)
        # robots that saw a robot or were seen
        mutual = {
            robot
            for image in named.images
            for s in image
            if s.seen_robot
            for robot in (s.robot, s.seen_robot)
        }
        for robot in sorted(mutual):  # states in an order that no hash decides
            self.start_if_needed(robot)
        integrate_pending(self.runs[robot].track for robot in named.robots)
        last_ns = {
            robot: run.state_ns
            for robot, run in ((robot, self.runs[robot]) for robot in named.robots)
            if step_ns > run.state_ns
            and (robot in mutual or self.keyframes.has_moved(run, run.state_ns, step_ns))
        }
        state_ns = {r: step_ns if r in last_ns else self.runs[r].state_ns for r in named.robots}
        to_image, motions = batch_motions(
            named, state_ns, last_ns, {robot: self.runs[robot].track for robot in state_ns}
        )
        motions = {robot: motions[robot] for robot in last_ns}
        for robot, motion in motions.items():
            self.runs[robot].path_m += motion.length_m
        with timed(self.seconds, "association"):
            associations: tuple[Association, ...] = ()
            seen = to_state_frame(
                sightings, [to_image[s.robot, s.time_ns] for s in sightings], len(self.sources)
            )
            self.sources += sightings
            heading = {
                name: self.runs[name].latest_pose[2]
                + (motions[name].delta[2] if name in motions else 0.0)
                for name in state_ns
            }
            offers = robot_observations(
                [s for image in named.images for s in image],
                [seen[k] for k in behind],
                state_ns,
                to_image,
                heading,
            )
            observations = iter(
                replace(o, robots=names, is_landmark=may_be_landmark(s))
                for o, s, names in zip(seen, sightings, possible, strict=True)
            )
            for image in batch.images:
                own = list(itertools.islice(observations, len(image)))
                associations += self.associate_image(image, own, state_ns[image[0].robot], motions)
            self.record_covariances()
        associations = self.moved_to_states(associations, offers)
        self.add_step(Step(step_ns, {}, motions, inflate_repeated(associations)), offers)

    def moved_to_states(
        self, associations: Sequence[Association], offers: Sequence[Association]
    ) -> tuple[Association, ...]:
        """Associations, those of robots as between states, as they are among ``offers``.

        The sightings behind them get the robots' names.
        """
        of_robots = {(a.source, a.target): a for a in offers}
        moved = []
        for a in associations:
            moved.append(of_robots[a.source, a.target] if isinstance(a.target, str) else a)
            if isinstance(a.target, str) and a.source is not None:
                self.sources[a.source] = replace(self.sources[a.source], seen_robot=a.target)
        return tuple(moved)

    def associate_image(
        self,
        image: Sequence[Sighting],
        seen: Sequence[Observation],
        state_ns: int,
        motions: Mapping[str, Motion],
    ) -> tuple[Association, ...]:
        """Associations of one image in a step of several, with robots as seen at its time.

        Args:
            image: sightings of one robot at one time.
            seen: the same in its base frame at its state.
            state_ns: time of that state.
            motions: of the step, of robots that get a state.
        """
        robot = image[0].robot
        run = self.runs[robot]
        self.counts["observations"] += len(seen)
        pose, motion = run.latest_pose, motions.get(robot)
        others = self.candidates.targets(robots_in(seen), image[0].time_ns)
        return self.associator.associate(
            Image(robot, state_ns, seen, pose, motion, run.track, run.path_m, True, others)
        )

    def add_event(self, event: Sequence[Message]) -> None:
        """One event: everything one robot perceived at one time."""
        first = event[0]
        run, time_ns = self.runs[first.robot], first.time_ns
        self.record_time(time_ns)
        self.start_if_needed(first.robot)
        if isinstance(first, ODOMETRY) and self.config.keyframe.mode != "all":
            self.add_closure_starts(first.robot, time_ns, self.keyframes)
            return  # most of a log; the track has it already
        left_out = isinstance(first, Scan) and run.repeats.leaves_out(first, run.track)
        if isinstance(first, Scan):  # an event of its own
            first, *_ = event = undistorted_by_track([first], run.track)
        run.note_scans(message for message in event if isinstance(message, Scan))
        self.counts["scans"] += isinstance(first, Scan)
        if left_out:
            return  # but where the robot was is reported
        used = self.keyframes.is_used(event, run)
        if isinstance(first, Scan):
            self.scan_buffer.add(first)
            event = self.robot_detector.process(first, used, self.has_started)
            if self.config.association.robot_sightings == "ignore":
                event = [m for m in event if isinstance(m, Scan)]
            if not used and are_matched(self.config):
                run.keep_between(first)
            if not used and run.since_keyframe is not None:
                run.since_keyframe.add(first, run.track)
        elif not used:
            event = ()
        if not event:
            return  # its pose follows from the states around it
        motion = self.motion_since_state(first.robot, time_ns)
        own_state = self.keyframes.gets_state(event, run)
        with timed(self.seconds, "front end"):
            seen = self.observations(event, None if own_state else motion)
        second = None
        if own_state and isinstance(first, Scan) and self.matches_scans:
            with timed(self.seconds, "scan matching"):
                motion, second = self.match_scan(first, motion, seen)
        self.advance(first.robot, time_ns, event, seen, motion if own_state else None, second)

    def match_scan(
        self, scan: Scan, motion: Motion | None, seen: list[Observation]
    ) -> tuple[Motion | None, Closure | None]:
        """The motion to a scan, checked against the scan of the state before.

        Returns:
            The motion, from the scans where these contradict odometry; and, if scan matching is on,
            a second, independent measurement of it.
        """
        run = self.runs[scan.robot]
        points = scan_points(scan, self.config.front_end.max_range_m)
        now, last = scan_submap(points, self.config.scan_matching), run.scan
        run.scan = None if now is None else (scan.time_ns, now)
        if motion is None or now is None or last is None or last[0] != motion.start_ns:
            return motion, None
        run.motions += 1
        has_paused = scan.time_ns in run.resumed_ns
        motion = checked_against_scans(motion, last[1], now, has_paused=has_paused)
        run.contradicted += motion.from_scans
        if self.config.odometry.scan_matching == "auto" or motion.from_scans:
            return motion, None
        free = points_off_lines(points, seen, self.config.scan_matching)
        return motion, match_off_lines(motion, last[1], scan.robot, free)

    def observations(self, event: Sequence[Message], since: Motion | None) -> list[Observation]:
        """What was seen, in the base frame of the state (at the start of ``since``, if given)."""
        out = []
        for message in event:
            source, is_landmark = None, True
            robots: tuple[str, ...] = ()
            if isinstance(message, Scan):
                found = self.front_end(message, self.config.front_end)
            elif isinstance(message, Sighting):
                found = (sighting_observation(message),)
                if message.seen_robot is not None:
                    self.start_if_needed(message.seen_robot)
                robots, is_landmark = self.candidates.possible(message), may_be_landmark(message)
                kept = self.sources if self.of_sightings else self.robot_sightings
                if self.of_sightings or may_be_robot(message):
                    source = len(kept)
                    kept.append(message)
            else:
                continue
            for o in found:
                z, cov = transport(o.z, o.cov, message.mount, np.zeros((3, 3)))
                if since is not None:
                    z, cov = transport(z, cov, since.delta, since.cov)
                out.append(
                    Observation(o.kind, z, cov, o.extent, o.identity, source, robots, is_landmark)
                )
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
        """Associate, make the step, give it to the back end; ``second``: see `match_scan`."""
        run = self.runs[robot]
        motions: dict[str, Motion] = {robot: motion} if motion is not None else {}
        state_ns = time_ns if motion is not None else run.state_ns
        if motion is not None:
            run.path_m += motion.length_m
        with timed(self.seconds, "association"):
            associations: tuple[Association, ...] = ()
            offers = robot_associations(robot, state_ns, seen)
            if seen:
                pose, others = run.latest_pose, robots_in(seen)
                targets = self.candidates.targets(others, state_ns)
                associations = self.associator.associate(
                    Image(
                        robot, state_ns, seen, pose, motion, run.track, run.path_m, robots=targets
                    )
                )
                self.name_robots(associations)
                for target in targets:
                    if target.motion is not None:
                        motions[target.name] = target.motion
                        self.runs[target.name].path_m += target.motion.length_m
            given = [self.closure(m, state_ns) for m in event if isinstance(m, RelativePose)]
            closures = tuple(c for c in (second, *given) if c)
            self.record_covariances()
        if not (motions or associations or closures):
            return
        self.add_step(Step(time_ns, {}, motions, associations, closures), offers)
        for message in event:
            if isinstance(message, Scan):
                if run.since_keyframe is not None:
                    run.since_keyframe.begin(state_ns, run.calibrations[-1], seen, run.track)
                points = scan_points(message, self.config.front_end.max_range_m)
                self.keyframe_scans.append(
                    KeyframeScan(robot, state_ns, points.astype(np.float32), message.mount)
                )

    def name_robots(self, associations: Sequence[Association]) -> None:
        """Give sightings of robots that entered at their own time the names of these."""
        for a in associations:
            if isinstance(a.target, str) and a.source is not None:
                named = replace(self.robot_sightings[a.source], seen_robot=a.target)
                self.robot_sightings[a.source] = named

    def closure(self, message: RelativePose, state_ns: int) -> Closure | None:
        """A recorded relative pose between the states nearest before its ends; None if dropped."""
        closure = between_states(message, state_ns, self.runs, self.known.recorded)
        if isinstance(closure, str):
            self.dropped[f"relative pose: {closure}"] += 1
            return None
        self.counts["loop_closures"] += 1
        return closure
