"""A whole log of scans, read and tracked: keyframes, motions and observations, block by block.

Nothing here waits for an estimate of the whole log: a robot is tracked against what it saw in the
last metres of its path. What comes out are the steps of `batch_optimisation`, which solves them.
"""

import itertools
import time
from collections import defaultdict, deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from graphslam.core.config import Config
from graphslam.core.geometry import Array, between, compose, compose_cov, inverse, wrap
from graphslam.core.motion_models import Calibration
from graphslam.core.observation_arrays import ObservationArrays
from graphslam.core.records import (
    Closure,
    KeyframeScan,
    Message,
    Motion,
    Scan,
    Step,
    TrueLandmark,
    Truth,
)
from graphslam.logs import LogSet
from graphslam.logs.clock import to_common_clock
from graphslam.mapping.local_tracking import LocalTracker
from graphslam.multi_robot.robot_detection import COMPARED_SCANS, without_returns
from graphslam.odometry.online_calibration import TrackedMotions, calibration_from_motions
from graphslam.odometry.preintegration import Track
from graphslam.odometry.scan_odometry import (
    MIN_POINTS,
    checked_against_scans,
    match_off_lines,
    points_off_lines,
    scan_submap,
    suspect_motions,
)
from graphslam.perception.dynamic_objects import dynamic_returns_of_all
from graphslam.perception.front_ends import observe_block
from graphslam.perception.ordered_scan import Sweep, make_sweep, scan_points
from graphslam.perception.scan_matching import Submap
from graphslam.slam.keyframes import KeyframeSelector
from graphslam.slam.log_pass import LogPass, PriorKnowledge, Progress, counted, timed
from graphslam.slam.robot_state import RobotState
from graphslam.slam.synchronisation import ODOMETRY, synchronise

#: messages that are processed at once
BLOCK = 2000


@dataclass(slots=True, eq=False)
class TrackedPath:
    """The path of one robot as tracked: lists over its states, of which the first is the start.

    ``poses`` (3,) in the world; ``motions`` and ``moved`` between consecutive states, according to
    odometry, and according to tracking (pose and covariance along the axes of its start).
    ``anchors``: states at which submaps are centred; ``from_anchor``: pose of each state seen from
    the anchor before it (the first one from itself), with its covariance.
    """

    poses: list[Array] = field(default_factory=list)
    times: list[int] = field(default_factory=list)
    motions: list[Motion] = field(default_factory=list)
    calibrations: list[Calibration] = field(default_factory=list)
    moved: list[tuple[Array, Array]] = field(default_factory=list)
    anchors: list[int] = field(default_factory=list)
    from_anchor: list[tuple[Array, Array]] = field(default_factory=list)

    def anchor_steps(self) -> tuple[Array, Array]:
        """Poses (k - 1, 3) of anchors seen from the ones before, and covariances (k - 1, 3, 3)."""
        steps = [self.from_anchor[k] for k in self.anchors[1:]]
        poses, covs = [p for p, _ in steps], [c for _, c in steps]
        return np.array(poses).reshape(-1, 3), np.array(covs).reshape(-1, 3, 3)


@dataclass(slots=True, eq=False)
class _Robot:
    """What is kept of one robot from block to block."""

    run: RobotState
    path: TrackedPath
    tracker: LocalTracker | None = None
    anchor_m: float = 0.0
    last_scan: tuple[int, Array] | None = None
    earlier: deque[tuple[int, Sweep]] = field(default_factory=lambda: deque(maxlen=COMPARED_SCANS))


def calibrate_path(path: TrackedPath, track: Track) -> None:
    """Improve the calibration of a track from all motions of its path so far."""
    used = [k for k, m in enumerate(path.motions) if not m.from_scans]
    if not used:
        return
    motions, known = [path.motions[k] for k in used], [path.calibrations[k] for k in used]
    found = TrackedMotions(
        np.array([m.delta for m in motions]),
        np.array([m.cov for m in motions]),
        np.array([m.d_delta_d_calibration for m in motions]),
        np.array([c.mean for c in known]),
        np.array([c.cov for c in known]),
        np.array([path.moved[k][0] for k in used]),
        np.array([path.moved[k][1] for k in used]),
    )
    track.calibration = calibration_from_motions(found, track.prior, track.config)


def recalibrate_path(path: TrackedPath, track: Track) -> None:
    """Apply the calibration found in the end to the whole path, also where it was not known yet.

    The pose of a state seen from its anchor is a mean of odometry and landmarks, weighted by their
    information; only the part of odometry changes.
    """
    used = np.array([k for k, m in enumerate(path.motions) if not m.from_scans], dtype=np.int64)
    if not len(used):
        return
    ends = np.array([(m.start_ns, m.end_ns) for m in path.motions], dtype=np.int64)
    old = np.array([m.delta for m in path.motions])
    noise = np.array([m.cov for m in path.motions])
    new = old.copy()
    new[used] = track.motions(ends[used, 0], ends[used, 1]).delta
    anchor_at = np.array(path.anchors)
    states = np.arange(len(path.times))
    before = anchor_at[np.clip(np.searchsorted(anchor_at, states) - 1, 0, None)]
    poses = [path.poses[0]]
    by_old = by_new = np.zeros(3)
    total = np.zeros((3, 3))
    found = path.from_anchor[:1]
    for k in range(1, len(states)):
        if before[k] == k - 1:  # the first state after an anchor
            by_old = by_new = np.zeros(3)
            total = np.zeros((3, 3))
        total = compose_cov(by_old, total, old[k - 1], noise[k - 1])
        by_old, by_new = compose(by_old, old[k - 1]), compose(by_new, new[k - 1])
        seen, cov = path.from_anchor[k]
        change = by_new - by_old
        change[2] = wrap(change[2])
        seen = seen + cov @ np.linalg.solve(total, change)
        found.append((seen, cov))
        poses.append(compose(poses[before[k]], seen))
    path.from_anchor, path.poses = found, poses


class ScanLog(LogPass):
    """A pass over a log of scans; `run` reads and tracks it, ``paths`` are those of the robots."""

    def __init__(self, log: LogSet, config: Config, known: PriorKnowledge) -> None:
        """Reads nothing yet."""
        super().__init__(log, config, known)
        self.paths: dict[str, TrackedPath] = defaultdict(TrackedPath)
        self._matches_scans = config.odometry.scan_matching != "off" and (
            config.front_end.name != "none"
        )
        self._keyframes = KeyframeSelector(self.config.keyframe)
        self._numbers = itertools.count()
        self._robots = {name: _Robot(run, self.paths[name]) for name, run in self.runs.items()}

    def run(self, progress: Progress) -> None:
        """Take in every message of the log; ``progress`` gets the number of messages read."""
        tracks = {name: run.track for name, run in self.runs.items()}
        read = counted(
            self.log.messages((Truth, TrueLandmark), prefetch=True), self.counts, progress
        )
        max_gap_s = self.config.odometry.max_gap_s
        messages = synchronise(
            to_common_clock(read, self.known.clocks), tracks, max_gap_s, self.dropped
        )
        while True:
            with timed(self.seconds, "read"):
                block = list(itertools.islice(messages, BLOCK))
            if not block:
                break
            self._process(block)
        for name, robot in self._robots.items():
            if robot.tracker is not None:
                self._finish(name, robot)
        # robots are tracked one after the other, block by block
        self.steps.sort(key=lambda step: step.time_ns)

    def _process(self, block: Sequence[Message]) -> None:
        """Messages in the order of time: a block of the log."""
        scans: dict[str, list[Scan]] = defaultdict(list)
        self.record_time(block[0].time_ns)
        self.record_time(block[-1].time_ns)
        for message in block:
            robot = self._robots[message.robot]
            if robot.tracker is None:
                self._start(message.robot, robot, message.time_ns)
            if isinstance(message, Scan):
                scans[message.robot].append(message)
            elif not isinstance(message, ODOMETRY):
                raise TypeError(message)
        for name, found in scans.items():
            self._track(name, self._robots[name], found)

    def _start(self, name: str, robot: _Robot, time_ns: int) -> None:
        """The first state of a robot: where its odometry begins, or earlier."""
        start = self.start_prior(name)
        at_ns = min(robot.run.track.first_ns, time_ns)
        self.steps.append(Step(at_ns, starts={name: start}))
        robot.tracker = LocalTracker(name, self.config.association, start.pose, self._numbers)
        self._add_state(robot, at_ns)
        self._set_anchor(robot)

    def _add_state(self, robot: _Robot, time_ns: int) -> None:
        assert robot.tracker is not None
        robot.run.times.append(time_ns)
        robot.path.times.append(time_ns)
        robot.path.poses.append(robot.tracker.pose)
        robot.path.from_anchor.append(robot.tracker.anchor())
        self.counts["keyframes"] += 1

    def _track(self, name: str, robot: _Robot, scans: Sequence[Scan]) -> None:
        """The scans of a block of one robot."""
        run = robot.run
        run.scans += [(s.stamp_ns, s.time_ns, s.mount) for s in scans]
        self.counts["scans"] += len(scans)
        used = [s for s in scans if self._keyframes.is_used((s,), run)]
        if not used:
            return
        began = time.perf_counter()
        with timed(self.seconds, "motions"):
            motions = self._motions(run, used)
        with timed(self.seconds, "front end"):
            used, sweeps = self._sweeps(robot, used)
            found = observe_block(used, sweeps, self.config.front_end)
            seen = [
                o.from_mounts(np.broadcast_to(s.mount, (len(o), 3)))
                for o, s in zip(found, used, strict=True)
            ]
        self.counts["observations"] += sum(map(len, seen))
        points = [scan_points(scan, self.config.front_end.max_range_m) for scan in used]
        seconds: list[Closure | None] = [None] * len(used)
        if self._matches_scans:
            with timed(self.seconds, "scan matching"):
                motions, seconds = self._matched(robot, used, motions, seen, points)
        with timed(self.seconds, "tracking"):
            for each in zip(used, motions, seen, points, seconds, strict=True):
                self._track_one(name, robot, *each)
        if self.config.odometry.calibrate:
            with timed(self.seconds, "calibration"):
                calibrate_path(robot.path, run.track)
        self.step_ms += [1e3 * (time.perf_counter() - began) / len(used)] * len(used)

    def _motions(self, run: RobotState, used: Sequence[Scan]) -> list[Motion | None]:
        """The motion to each scan from the state before; None where a state is there already."""
        ends = np.array([run.state_ns, *(s.time_ns for s in used)], dtype=np.int64)
        many = run.track.motions(ends[:-1], ends[1:])
        return [
            many.one(k, int(ends[k]), int(ends[k + 1])) if ends[k + 1] > ends[k] else None
            for k in range(len(used))
        ]

    def _sweeps(self, robot: _Robot, used: list[Scan]) -> tuple[list[Scan], list[Sweep]]:
        """The scans and their sweeps without the returns of moving objects.

        Those are free-standing objects where earlier scans saw free space.
        """
        max_range_m = self.config.front_end.max_range_m
        sweeps = [make_sweep(scan, max_range_m) for scan in used]
        past = list(robot.earlier)
        robot.earlier += [(s.time_ns, sweep) for s, sweep in zip(used, sweeps, strict=True)]
        every = [sweep for _, sweep in past] + sweeps
        if self.config.front_end.dynamic_objects == "keep" or not every[0].step_rad:
            return used, sweeps
        times = np.array([t for t, _ in past] + [s.time_ns for s in used], dtype=np.int64)
        poses = robot.run.track.mounted_pose(times)
        mounts = np.array([s.mount for s in used])
        mounts = np.concatenate([np.repeat(mounts[:1], len(past), axis=0), mounts])
        views = []
        for lag in range(1, COMPARED_SCANS + 1):
            moved = between(np.roll(poses, lag, axis=0), poses)
            views.append(compose(compose(inverse(mounts), moved), mounts))
        for n, gone in enumerate(dynamic_returns_of_all(every, views)[len(past) :]):
            if gone.any():
                self.removed_returns["range: of a thing that moves"] += int(gone.sum())
                used[n] = without_returns(used[n], sweeps[n], gone)
                sweeps[n] = make_sweep(used[n], max_range_m)
        return used, sweeps

    def _matched(
        self,
        robot: _Robot,
        used: Sequence[Scan],
        motions: Sequence[Motion | None],
        seen: Sequence[ObservationArrays],
        points: Sequence[Array],
    ) -> tuple[list[Motion | None], list[Closure | None]]:
        """Motions checked against the scans at their ends, and second measurements of them."""
        config, auto = self.config.scan_matching, self.config.odometry.scan_matching == "auto"
        checked: list[Motion | None] = list(motions)
        seconds: list[Closure | None] = [None] * len(used)
        before = [robot.last_scan, *((s.time_ns, p) for s, p in zip(used, points, strict=True))]
        robot.last_scan = before[-1]
        pairs: list[tuple[int, Motion, Array, Array]] = []
        for k, motion in enumerate(motions):
            last, now = before[k], points[k]
            if motion is None or last is None or last[0] != motion.start_ns:
                continue
            if min(len(last[1]), len(now)) >= MIN_POINTS:
                pairs.append((k, motion, last[1], now))
        robot.run.motions += len(pairs)
        submaps: dict[int, Submap] = {}

        def submap(cloud: Array) -> Submap:
            if id(cloud) not in submaps:
                found = scan_submap(cloud, config)
                assert found is not None  # it has points enough
                submaps[id(cloud)] = found
            return submaps[id(cloud)]

        suspect = suspect_motions(
            [m for _, m, _, _ in pairs], [(a, b) for _, _, a, b in pairs], config
        )
        for (k, motion, last_points, now), is_doubtful in zip(pairs, suspect, strict=True):
            better = motion
            if is_doubtful:
                better = checked_against_scans(motion, submap(last_points), submap(now))
                checked[k] = better
                robot.run.contradicted += better.from_scans
            if not (auto or better.from_scans):
                lines = [seen[k].one(n) for n in range(len(seen[k]))]
                free = points_off_lines(now, lines, config)
                name = used[k].robot
                seconds[k] = match_off_lines(better, submap(last_points), name, free)
        return checked, seconds

    def _track_one(
        self,
        name: str,
        robot: _Robot,
        scan: Scan,
        motion: Motion | None,
        seen: ObservationArrays,
        points: Array,
        second: Closure | None,
    ) -> None:
        """One state: associate what was seen there, and make the step."""
        tracker = robot.tracker
        assert tracker is not None
        state_ns = robot.run.state_ns if motion is None else scan.time_ns
        if motion is not None:
            tracker.move(motion)
        associations, moved, cov = tracker.track(state_ns, seen)
        closures = () if second is None else (second,)
        motions = {} if motion is None else {name: motion}
        self.steps.append(Step(scan.time_ns, {}, motions, associations, closures))
        self.keyframe_scans.append(
            KeyframeScan(name, state_ns, points.astype(np.float32), scan.mount)
        )
        if motion is None:
            return
        robot.path.motions.append(motion)
        robot.path.calibrations.append(robot.run.track.calibration)
        robot.path.moved.append((moved, cov))
        self._add_state(robot, scan.time_ns)
        spacing = self.config.loop_closure.submap_spacing_m
        if tracker.path_m - robot.anchor_m >= spacing:
            self._set_anchor(robot)

    def _set_anchor(self, robot: _Robot) -> None:
        """A submap is centred at the present state."""
        assert robot.tracker is not None
        robot.tracker.set_anchor()
        robot.anchor_m = robot.tracker.path_m
        robot.path.anchors.append(len(robot.path.times) - 1)

    def _finish(self, name: str, robot: _Robot) -> None:
        """The end of the log: the last landmarks, and an anchor at the last state."""
        tracker, path = robot.tracker, robot.path
        assert tracker is not None
        if path.anchors[-1] != len(path.times) - 1:
            path.anchors.append(len(path.times) - 1)
        if self.config.odometry.calibrate:
            recalibrate_path(path, robot.run.track)
        tracker.retire_all()
        self.landmarks.entries |= tracker.entries
        self.landmarks.deleted += tracker.deleted
        self.rejected.update(tracker.rejected)
        for model, values in tracker.innovations.items():
            self.innovations.setdefault(model, []).extend(values)
