"""Keyframes of a log of scans: read, preintegrated and segmented, block by block.

Nothing here needs to know where the robot is, so it goes on in the second process while the
keyframes before are tracked (`scan_tracking`). What tracking finds of the calibration is used for
later motions.
"""

import itertools
import time
from collections import Counter, defaultdict, deque
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from graphslam.core.config import Config
from graphslam.core.geometry import Array, between, compose, inverse
from graphslam.core.motion_models import Calibration
from graphslam.core.observation_arrays import ObservationArrays
from graphslam.core.record import replace
from graphslam.core.records import TRUE_RECORDS, Message, Motion, Scan
from graphslam.logs import LogSet
from graphslam.logs.log_set import ReadReport
from graphslam.multi_robot.robot_detection import COMPARED_SCANS, without_returns
from graphslam.odometry.calibration_jacobian import CalibratedSource
from graphslam.odometry.gap_bridging import with_bridged_gaps
from graphslam.odometry.laser_odometry import with_laser_odometry
from graphslam.odometry.noise_estimation import is_stated
from graphslam.odometry.online_calibration import Learnt
from graphslam.odometry.online_noise import noisier
from graphslam.odometry.scan_odometry import MIN_POINTS, suspect_motions
from graphslam.odometry.several_lasers import SeveralLasersTrack
from graphslam.odometry.sudden_changes import SuddenChanges
from graphslam.odometry.sweep_motion import undistorted_by_track
from graphslam.perception.dynamic_objects import dynamic_returns_of_all
from graphslam.perception.front_ends import observe_block
from graphslam.perception.ordered_scan import Sweep, make_sweep, scan_points
from graphslam.pipeline.keyframes import KeyframeSelector
from graphslam.pipeline.progress import counted, timed
from graphslam.pipeline.robot_settings import make_tracks, with_log_settings
from graphslam.pipeline.robot_state import RobotState
from graphslam.pipeline.scans_between import are_matched
from graphslam.pipeline.synchronisation import synchronise
from graphslam.scan_smoothing.consecutive_scans import ComparedScans, ConsecutiveScans
from graphslam.scan_smoothing.lost_overlap import HELD, scans_to_add
from graphslam.scan_smoothing.motion_checks import ScanKeyframe, ScanPair

#: messages that are processed at once; the first blocks are smaller, as little is known of the
#: calibration: each has twice as many as the one before
BLOCK, FIRST_BLOCK = 2000, 100
#: a further laser is not where its mount says if its scans contradict so much more of its motions
#: than the first one's do. In the lab it is up to 0.27 for mounts that calibration corrects (0.3 m,
#: 10°) and 0.98 for those turned by 90° or 180°; in an office, whose corridors look the same both
#: ways, 0.55 by 180°
WRONG_LASER_SHARE = 0.4
#: messages that are read while nobody waits for them, at most: some 20 MB
READ_AHEAD = 8000


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeBlock:
    """Consecutive keyframes; there may be none.

    ``start_ns``: time of the first state of the robot. ``pairs``: scans of the first laser that
    `MotionChecker` has to compare, ``last``: the number of its last keyframe, if there is one.
    ``source`` is what the motions are made with, ``prior`` its calibration before any data.
    ``noise_scale`` (3,): by how much variances of the noise of odometry are larger than stated.
    ``messages``: number of messages read so far; ``seconds`` that all this took.
    """

    start_ns: int
    keyframes: Sequence[ScanKeyframe]
    pairs: Sequence[ScanPair]
    last: int | None
    source: CalibratedSource
    noise_scale: Array
    prior: Calibration
    messages: int
    seconds: float


@dataclass(frozen=True, slots=True, eq=False)
class ReadLog:
    """What is known when all of a log was read.

    ``run`` has the odometry and all scans, but no states. ``report`` is that of the log itself.
    Counts and ``seconds`` are to be added to those of the pass. ``wrong_lasers``: name of each
    further laser that is not where its mount says -> share of its motions that scans contradict.
    """

    run: RobotState
    span_ns: tuple[int, int]
    counts: Counter[str]
    dropped: Counter[str]
    removed_returns: Counter[str]
    seconds: dict[str, float]
    report: ReadReport
    wrong_lasers: dict[str, float]


@dataclass(frozen=True, slots=True)
class AwaitCalibration:
    """Nothing to work on: from here on the calibration is waited for."""


ReadItem = KeyframeBlock | ReadLog | AwaitCalibration


def read_keyframes(
    log: LogSet, config: Config, uncalibrated: int, known: Learnt | None = None
) -> Generator[ReadItem, Learnt | None, None]:
    """The keyframes of the only robot of a log, and last a `ReadLog`.

    What is sent is the calibration for later motions, and their noise. After ``uncalibrated``
    blocks it is waited for: before, some of what follows is read, then comes a `AwaitCalibration`.
    ``known``: what is sent before the first block, with its prior.
    """
    reader = _Reader(log, with_log_settings(log, config), log.robots[0], known)
    for number, block in enumerate(reader.blocks(), 1):
        found = yield block
        if number == uncalibrated:
            reader.read_ahead()
            found = yield AwaitCalibration()
        if found is not None:
            reader.learn(found)
    yield reader.read_log()


class _Messages(Iterator[Message]):
    """Messages, some of which may be read before they are wanted."""

    def __init__(self, messages: Iterator[Message]) -> None:
        self._messages = messages
        self._held: deque[Message] = deque()

    def read(self, count: int) -> None:
        """Read this many, or all that are left."""
        self._held.extend(itertools.islice(self._messages, count))

    def __next__(self) -> Message:
        return self._held.popleft() if self._held else next(self._messages)


@dataclass(slots=True, eq=False)
class _Laser:
    """What is kept of one laser: its scans that were used or repeated, and the last sweeps.

    ``last``: time and returns of the scan before; ``compared`` how many of its motions were, by
    scans, and how many of them are ``suspect``.
    """

    run: RobotState
    last: tuple[int, Array] | None = None
    compared: int = 0
    suspect: int = 0
    earlier: deque[tuple[int, Sweep]] = field(default_factory=lambda: deque(maxlen=COMPARED_SCANS))


class _Image(NamedTuple):
    """A scan, what is seen in it from the base, and its returns (k, 2) m from the laser."""

    scan: Scan
    seen: ObservationArrays
    points: Array


class _Reader:
    """What is kept from block to block."""

    def __init__(self, log: LogSet, config: Config, robot: str, known: Learnt | None) -> None:
        self._log, self._config, self._robot, self._known = log, config, robot, known
        self.run = RobotState(make_tracks(log, config)[robot])
        #: by laser: what the selection of its keyframes needs; the first one's is the robot's
        sensors = log.sensors(robot).values()
        self._lasers = {s: _Laser(RobotState(self.run.track) if s else self.run) for s in sensors}
        self._matches_scans = config.odometry.scan_matching != "off"
        self._keyframes = KeyframeSelector(config.keyframe)
        self._noise_scale = np.ones(3)
        self._state_ns: int | None = None
        self._state_of = ""  # the laser whose state is the last one
        self._consecutive = ConsecutiveScans(self.run.track, config.scan_matching)
        self._changes = SuddenChanges(self.run.track, config)
        #: of the first laser, since the last keyframe: the next one may show that they are needed
        self._held: list[Scan] = []
        self._counts: Counter[str] = Counter()
        self._dropped: Counter[str] = Counter()
        self._removed_returns: Counter[str] = Counter()
        self._seconds: dict[str, float] = defaultdict(float)
        self._span_ns = 1 << 63, 0
        self._messages = _Messages(iter(log.messages(TRUE_RECORDS, all_lasers=True)))

    def learn(self, found: Learnt) -> None:
        """Later motions are by this calibration, and as noisy where nobody says how noisy."""
        self.run.track.calibration = found.calibration
        if not is_stated(self.run.track):
            self._noise_scale = found.noise_scale

    def read_ahead(self) -> None:
        """Read some of the messages that later blocks are made of."""
        with timed(self._seconds, "read"):
            self._messages.read(READ_AHEAD)

    def read_log(self) -> ReadLog:
        """What is known in the end."""
        self._keep_between(list(self._held))
        self.run.changes = self._changes.found()
        for laser in self._lasers.values():
            if laser.run is not self.run:
                self.run.repeats.left_out += laser.run.repeats.left_out
        return ReadLog(
            self.run, self._span_ns, self._counts, self._dropped, self._removed_returns,
            self._seconds, self._log.report(), self._wrong_lasers(),
        )  # fmt: skip

    def _wrong_lasers(self) -> dict[str, float]:
        """See `ReadLog`; where odometry is bad, the scans of all lasers contradict it."""
        share = {s: one.suspect / max(one.compared, 1) for s, one in self._lasers.items()}
        most = share[""] + WRONG_LASER_SHARE
        return {s: found for s, found in share.items() if found > most}

    def blocks(self) -> Iterator[KeyframeBlock]:
        """The keyframes, by the latest calibration of the track."""
        track = self.run.track
        read = counted(self._messages, self._counts, lambda _count: None)
        max_gap_s = self._config.odometry.max_gap_s
        read = with_laser_odometry(read, self._log.without_odometry, self._config)
        read = with_bridged_gaps(read, self._log.bridged, self._config, {self._robot: track})
        messages = synchronise(read, {self._robot: track}, max_gap_s, self._dropped)
        first_ns, size = 0, FIRST_BLOCK
        while True:
            began = time.perf_counter()
            with timed(self._seconds, "read"):
                block = list(itertools.islice(messages, size))
            if not block:
                return
            size = min(2 * size, BLOCK)
            begin, end = self._span_ns
            self._span_ns = min(begin, block[0].time_ns), max(end, block[-1].time_ns)
            if self._state_ns is None:
                # the first state is where odometry begins, or earlier
                self._state_ns = first_ns = min(track.first_ns, block[0].time_ns)
            if self._known is not None:  # now that the source of the motion is known
                track.prior = self._known.prior
                self.learn(self._known)
                self._known = None
            source = CalibratedSource.of(track)
            keyframes, pairs, last = self._of_block(block)
            yield KeyframeBlock(
                first_ns, keyframes, pairs, last, source, self._noise_scale, track.prior,
                self._counts["messages"], time.perf_counter() - began,
            )  # fmt: skip

    def _of_block(
        self, block: Sequence[Message]
    ) -> tuple[list[ScanKeyframe], list[ScanPair], int | None]:
        """Keyframes, pairs to be compared, and the last of the first laser, see `KeyframeBlock`."""
        track = self.run.track
        scans = [message for message in block if isinstance(message, Scan)]
        self.run.note_scans(scan for scan in scans if not scan.sensor)
        self._counts["scans"] += len(scans)
        each: list[Scan] = []
        for sensor, laser in self._lasers.items():
            own = [scan for scan in scans if scan.sensor == sensor]
            kept, others = self._keyframes.used_scans(own, laser.run)
            each += undistorted_by_track(kept, track)
            if not sensor:
                self._held += others
        used = self._in_order(each)
        if not used:
            self._keep_between(self._held[:-HELD])
            return [], [], None
        images = self._observed(used)
        motions = self._motions([image.scan for image in images])
        compared = ComparedScans()
        if self._matches_scans:
            compared = self._compared(images, motions)
            more = self._scans_to_add(compared) if len(self._lasers) == 1 else []
            if more:
                # odometry does not say where these are, so not what moved since the ones before
                images += self._observed(more, keep_moving=True)
                images.sort(key=lambda image: image.scan.time_ns)
                motions = self._motions([image.scan for image in images])
                compared = self._compared(images, motions)
            self._count(images, compared)
            self._note_changes(images, compared)
        return self._finished(images, motions, compared)

    def _observed(self, used: list[Scan], *, keep_moving: bool = False) -> list["_Image"]:
        """What is seen in scans, without the returns of moving things or with them."""
        config = self._config.front_end
        seen: list[ObservationArrays] = [ObservationArrays.of(())] * len(used)
        with timed(self._seconds, "front end"):
            for sensor, laser in self._lasers.items():
                at = [n for n, scan in enumerate(used) if scan.sensor == sensor]
                own, sweeps = self._sweeps([used[n] for n in at], laser, keep_moving)
                found = observe_block(own, sweeps, config) if at else []
                for n, scan, o in zip(at, own, found, strict=True):
                    used[n] = scan
                    seen[n] = o.from_mounts(np.broadcast_to(scan.mount, (len(o), 3)))
            return [
                _Image(scan, o, scan_points(scan, config.max_range_m))
                for scan, o in zip(used, seen, strict=True)
            ]

    def _compared(
        self, images: Sequence["_Image"], motions: Sequence[Motion | None]
    ) -> ComparedScans:
        with timed(self._seconds, "scan matching"):
            points = [image.points for image in images]
            return self._consecutive.compare(
                [image.scan for image in images], motions, points, self.run.resumed_ns
            )

    def _scans_to_add(self, compared: ComparedScans) -> list[Scan]:
        """Scans that become keyframes: those before and after them have little in common."""
        more = scans_to_add(compared.lost, self._held)
        added = {scan.time_ns for scan in more}
        self._held = [scan for scan in self._held if scan.time_ns not in added]
        return undistorted_by_track(more, self.run.track)

    def _finished(
        self, images: Sequence["_Image"], motions: Sequence[Motion | None], compared: ComparedScans
    ) -> tuple[list[ScanKeyframe], list[ScanPair], int | None]:
        """See `_of_block`; the next block begins after the last of the scans."""
        last_ns = images[-1].scan.time_ns
        self._state_ns = last_ns
        self._counts["observations"] += sum(len(image.seen) for image in images)
        self._consecutive.end_block([i.scan for i in images], [i.points for i in images])
        self._keep_between([scan for scan in self._held if scan.time_ns <= last_ns])
        keyframes = [
            ScanKeyframe(i.scan.time_ns, i.scan.mount, motion, i.seen, i.points)
            for i, motion in zip(images, self._as_noisy(motions), strict=True)
        ]
        every = self._config.odometry.scan_matching != "auto"
        pairs = [pair for pair in compared.pairs if pair.suspect or every]
        of_first = [n for n, image in enumerate(images) if not image.scan.sensor]
        return keyframes, pairs, of_first[-1] if of_first else None

    def _keep_between(self, scans: Sequence[Scan]) -> None:
        """These, the first of those held, stay without a state."""
        del self._held[: len(scans)]
        if are_matched(self._config):
            self.run.between.add(scans, self.run.track)

    def _in_order(self, used: list[Scan]) -> list[Scan]:
        """Scans of all lasers in the order of time, each at that of its state.

        Those that two lasers measure at one time make two states, one of them 1 ns later.
        """
        if len(self._lasers) == 1:
            return used
        last_ns, last_of, found = self._state_ns or 0, self._state_of, []
        for one in sorted(used, key=lambda scan: scan.time_ns):
            time_ns = max(one.time_ns, last_ns + (one.sensor != last_of))
            last_ns, last_of = time_ns, one.sensor
            found.append(replace(one, time_ns=time_ns))
        self._state_of = last_of
        track = self.run.track
        if isinstance(track, SeveralLasersTrack):
            for sensor in filter(None, self._lasers):
                times = [scan.time_ns for scan in found if scan.sensor == sensor]
                track.add_states(sensor, np.array(times, dtype=np.int64))
        return found

    def _motions(self, used: Sequence[Scan]) -> list[Motion | None]:
        """The motion to each scan from the state before; None where a state is there already."""
        ends = np.array([self._state_ns, *(s.time_ns for s in used)], dtype=np.int64)
        with timed(self._seconds, "motions"):
            many = self.run.track.motions(ends[:-1], ends[1:])
        return [
            many.one(k, int(ends[k]), int(ends[k + 1])) if ends[k + 1] > ends[k] else None
            for k in range(len(used))
        ]

    def _as_noisy(self, motions: Sequence[Motion | None]) -> list[Motion | None]:
        """Motions as noisy as they were found to be; scans check them by what is stated."""
        shared, scale = self.run.track.calibration.cov, self._noise_scale
        if np.all(scale == 1.0):
            return list(motions)
        return [motion and noisier(motion, shared, scale) for motion in motions]

    def _sweeps(
        self, used: list[Scan], laser: "_Laser", keep_moving: bool
    ) -> tuple[list[Scan], list[Sweep]]:
        """The scans of a laser and their sweeps without the returns of moving objects.

        Those are free-standing objects where earlier scans saw free space.
        """
        max_range_m = self._config.front_end.max_range_m
        sweeps = [make_sweep(scan, max_range_m) for scan in used]
        if keep_moving:
            return used, sweeps
        past = list(laser.earlier)
        laser.earlier += [(s.time_ns, sweep) for s, sweep in zip(used, sweeps, strict=True)]
        every = [sweep for _, sweep in past] + sweeps
        if not used or self._config.front_end.dynamic_objects == "keep" or not every[0].step_rad:
            return used, sweeps
        times = np.array([t for t, _ in past] + [s.time_ns for s in used], dtype=np.int64)
        poses = self.run.track.mounted_pose(times, used[0].sensor)
        mounts = np.array([s.mount for s in used])
        mounts = np.concatenate([np.repeat(mounts[:1], len(past), axis=0), mounts])
        views = []
        for lag in range(1, COMPARED_SCANS + 1):
            moved = between(np.roll(poses, lag, axis=0), poses)
            views.append(compose(compose(inverse(mounts), moved), mounts))
        for n, gone in enumerate(dynamic_returns_of_all(every, views)[len(past) :]):
            if gone.any():
                self._removed_returns["range: of a thing that moves"] += int(gone.sum())
                used[n] = without_returns(used[n], sweeps[n], gone)
                sweeps[n] = make_sweep(used[n], max_range_m)
        return used, sweeps

    def _count(self, images: Sequence["_Image"], compared: ComparedScans) -> None:
        """Count motions, and those that scans contradict, of all lasers."""
        self.run.motions += len(compared.pairs)
        self.run.lost += compared.lost
        self._lasers[""].compared += len(compared.pairs)
        self._lasers[""].suspect += sum(pair.suspect for pair in compared.pairs)
        with timed(self._seconds, "scan matching"):
            self._compare_further([i.scan for i in images], [i.points for i in images])

    def _note_changes(self, images: Sequence["_Image"], compared: ComparedScans) -> None:
        last_ns, points = self._consecutive.last
        clouds = {last_ns: points} | {i.scan.time_ns: i.points for i in images if not i.scan.sensor}
        with timed(self._seconds, "scan matching"):
            self._changes.add(compared.shares, clouds, self._held)

    def _compare_further(self, used: Sequence[Scan], points: Sequence[Array]) -> None:
        """Count the motions of the further lasers that their scans contradict."""
        for sensor, laser in self._lasers.items():
            if not sensor:
                continue
            own = [n for n, scan in enumerate(used) if scan.sensor == sensor]
            seen = [(used[n].time_ns, points[n]) for n in own if len(points[n]) >= MIN_POINTS]
            seen = seen if laser.last is None else [laser.last, *seen]
            if len(seen) < 2:
                continue
            laser.last = seen[-1]
            times = np.array([time_ns for time_ns, _ in seen], dtype=np.int64)
            many = self.run.track.motions(times[:-1], times[1:])
            motions = [many.one(k, *times[k : k + 2].tolist()) for k in range(len(seen) - 1)]
            before = np.arange(len(motions), dtype=np.int64)
            clouds = [cloud for _, cloud in seen]
            suspect, _ = suspect_motions(
                motions, clouds, before, before + 1, self._config.scan_matching
            )
            laser.compared += len(motions)
            laser.suspect += int(suspect.sum())
