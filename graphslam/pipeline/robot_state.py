"""What a pass accumulates for one robot, and the trajectories made of it."""

from bisect import bisect_right
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.geometry import Array, between, compose, inverse
from graphslam.core.motion_models import Calibration
from graphslam.core.mount_covariances import MountCovariance
from graphslam.core.records import Motion, RobotResult, Scan, Step, Trajectory
from graphslam.logs.clock import Clock
from graphslam.odometry.calibration_jacobian import CalibratedSource
from graphslam.odometry.contradicted_motions import without_explained
from graphslam.odometry.interpolation import (
    BetterScans,
    causal_at,
    final_at,
    final_scans,
    origin_shift,
    trajectory_of_mount,
    transform_trajectory,
    with_stamp_errors,
)
from graphslam.odometry.mount_covariance import base_trajectory
from graphslam.odometry.online_calibration import Calibrator, to_summary
from graphslam.odometry.preintegration import Track
from graphslam.odometry.reading_gaps import moved_in_gaps
from graphslam.odometry.readings import EDGE_NS
from graphslam.odometry.sudden_changes import SuddenChange
from graphslam.perception.scan_matching import Submap
from graphslam.pipeline.repeated_scans import RepeatedScans
from graphslam.pipeline.scans_between import ScansBetween
from graphslam.pipeline.scans_since_keyframe import ScansSinceKeyframe

#: Hz at which the base of a robot without scans is reported
BASE_RATE_HZ = 10
#: poses are not reported in gaps of the odometry that are longer, though the robot stands in them
LONGEST_GAP_NS = 600_000_000_000
#: ns between two scans from which on they need not have anything in common
PAUSE_NS = 2_000_000_000


@dataclass(slots=True, eq=False)
class RobotState:
    """One robot's odometry, its states so far and its scans.

    ``times``: of the states, ns; for each state there is the causal pose, its covariance and the
    calibration known then. ``latest_pose`` (3,) is the present estimate of the latest one: after a
    batch step by more than when it was made. ``scans``: (stamp, time, mount) of each; ``between``:
    beams of those without a state, where they are kept, ``kept_ns`` the time of the last of these
    or of a scan with a state; ``has_scans``: whether its log has any: odometry beside sightings is
    calibrated by the noise that is stated or measured elsewhere;
    ``since_keyframe``: where they were when they came, if that is asked for;
    ``scanned_ns``: time of the last one used. States are poses of the sensor; the base is where the
    calibrated mount puts it. ``is_calibrated``: the track's calibration was estimated together with
    all states. ``scan``: time and submap of the latest state that has a scan; ``contradicted``: how
    many of ``motions`` the scans contradicted; ``lost``: times of consecutive scans that have
    nothing in common, see `ComparedScans`; ``changes``: where they suddenly have less;
    ``resumed_ns``: of scans that came after a pause of the laser. ``repeats``: scans that are
    reported and not used.
    Times are of the common clock, stamps of the robot's own ``clock``.
    """

    track: Track
    calibrator: Calibrator = field(init=False)
    path_m: float = 0.0
    scanned_ns: int | None = None
    times: list[int] = field(default_factory=list)
    causal_poses: list[Array] = field(default_factory=list)
    latest_pose: Array = field(default_factory=lambda: np.zeros(3))
    causal_covs: list[Array] = field(default_factory=list)
    calibrations: list[Calibration] = field(default_factory=list)
    scans: list[tuple[int, int, Array]] = field(default_factory=list)
    is_calibrated: bool = False
    scan: tuple[int, Submap] | None = None
    motions: int = 0
    contradicted: int = 0
    lost: list[tuple[int, int]] = field(default_factory=list)
    changes: list[SuddenChange] = field(default_factory=list)
    clock: Clock = field(default_factory=Clock)
    repeats: RepeatedScans = field(default_factory=RepeatedScans)
    between: ScansBetween = field(default_factory=ScansBetween)
    kept_ns: int | None = None
    has_scans: bool = True
    since_keyframe: ScansSinceKeyframe | None = None
    resumed_ns: set[int] = field(default_factory=set)
    _latest_scan_ns: int | None = None

    def __post_init__(self) -> None:
        """Calibrate the track's odometry by its own settings."""
        self.calibrator = Calibrator(self.track.config, is_noise_known=not self.has_scans)

    @property
    def started(self) -> bool:
        """Whether the robot has a state."""
        return bool(self.times)

    @property
    def state_ns(self) -> int:
        """Time of the latest state; -1 before the first."""
        return self.times[-1] if self.times else -1

    def note_scans(self, scans: Iterable[Scan]) -> None:
        """Take in scans of the first laser in the order of time, used or not."""
        for scan in scans:
            last_ns, self._latest_scan_ns = self._latest_scan_ns, scan.time_ns
            if last_ns is not None and scan.time_ns - last_ns > PAUSE_NS:
                self.resumed_ns.add(scan.time_ns)
            self.scans.append((scan.stamp_ns, scan.time_ns, scan.mount))

    def keep_between(self, scan: Scan) -> None:
        """Keep beams of a scan that gets no state, if the robot drove since the last one."""
        since_ns = max(self.scanned_ns or 0, self.kept_ns or 0)
        if since_ns and any(self.track.moved(since_ns, scan.time_ns)):
            self.between.add([scan], self.track)
            self.kept_ns = scan.time_ns

    def append(self, time_ns: int, pose: Array) -> None:
        """Record a new state; its covariance follows."""
        self.times.append(time_ns)
        self.causal_poses.append(pose)
        self.latest_pose = pose
        self.calibrations.append(self.track.used_calibration)

    def learn(self, motion: Motion, pose: Array, observed: Array) -> None:
        """Improve the calibration from the motion to a new state.

        Args:
            motion: according to odometry.
            pose: (3,) estimate of the new state.
            observed: (3, 3) see `Calibrator.update`.
        """
        moved = between(self.latest_pose, pose)
        self.track.calibration = self.calibrator.update(
            CalibratedSource.of(self.track), motion, moved, observed
        )

    def without_explained(self, steps: Iterable[Step], robot: str, scale: Array) -> list[Step]:
        """Steps without the contradictions that the calibration found explains.

        Arguments are those of `graphslam.odometry.contradicted_motions.without_explained`.
        """
        taken = without_explained(steps, robot, self.track, scale)
        self.contradicted = sum(
            step.motions[robot].from_scans for step in taken if robot in step.motions
        )
        return taken

    def is_causal(self, states: Trajectory) -> bool:
        """Whether final ``states`` equal the causal ones, as those of a filter do."""
        return np.array_equal(states.poses, self.causal_poses)

    def calibration_found(self, told: Mapping[str, Array]) -> dict[str, tuple[float, float, bool]]:
        """Parameter -> (value, sigma, observable) of the estimated calibration, see `to_summary`.

        ``told``: laser ("" the first) -> its mount (3,) according to the log.
        """
        if self.is_calibrated:
            return to_summary(self.track.calibration, self.track.prior.cov, told)
        return self.calibrator.summary(told)

    def causal(self, start: Array, away_m: float = 0.0) -> "Causal":
        """The causal trajectories.

        Args:
            start: (3,) prior pose of the robot that defines the frame.
            away_m: offset along x of that frame while it was estimated.
        """
        return self.causal_at_stamps(*self._report_times(), start, away_m)

    def causal_at_stamps(
        self,
        stamps: IntArray,
        times: IntArray,
        laser: Array,
        start: Array | None,
        away_m: float = 0.0,
    ) -> "Causal":
        """The causal trajectories at stamps (n,), which are times (n,) of the common clock.

        ``laser`` (n, 3): mounts of the sensors whose poses are asked for, if the robot has scans;
        ``start`` and ``away_m``: see `causal`; without ``start`` the world is that of the states.
        """
        # a live robot asks of its last states alone
        begin = max(bisect_right(self.times, int(times.min(initial=self.state_ns))) - 1, 0)
        poses = np.array(self.causal_poses[begin:]) - np.array([away_m, 0.0, 0.0])
        at, covs = np.array(self.times[begin:], dtype=np.int64), np.array(self.causal_covs[begin:])
        known, calibrations = Trajectory(at, poses, covs), self.calibrations[begin:]
        # mount and latency as known then, for the base pose and for the frame that starts at it
        last = known.index_before(times)
        if not self.scans:
            late_ns = np.array([self.track.reported_late_ns(c) for c in calibrations])
            times = times + late_ns[last]
        better = None
        if self.since_keyframe is not None:
            self.since_keyframe.match(self.track)
            better = self.since_keyframe.at(times, known.stamps_ns[last])
        causal = causal_at(known, last, calibrations, self.track, times, stamps, better)
        mount = np.array([self.track.mount_of(c) for c in calibrations])[last]
        if start is not None:
            causal = transform_trajectory(causal, origin_shift(start, mount))
        scan = trajectory_of_mount(causal, laser) if self.scans else None
        return Causal(trajectory_of_mount(causal, inverse(mount)), scan)

    def result(
        self,
        states: Trajectory,
        causal: "Causal | None",
        mount: MountCovariance | None = None,
        *,
        causal_only: bool = False,
        better: BetterScans | None = None,
    ) -> RobotResult:
        """Trajectories of the robot at the stamps that it is reported at.

        Args:
            states: the final states, world frame.
            causal: the causal trajectories; None if they are not asked for.
            mount: covariances of the states with the mount, where it is estimated with them.
            causal_only: final poses are the causal ones, also between the states, as a back end
                that revises no state does not revise the motion between states either.
            better: of scans that are known better than by odometry between states.
        """
        stamps, times, laser = self._report_times()
        states = self.track.at_first_laser(states)
        ties = None
        late_ns = 0
        if self.scans:
            final, ties = final_scans(states, self.track, times, stamps, laser, better)
        else:
            late_ns = self.track.reported_late_ns(self.track.calibration)
            times = times + late_ns
            final = final_at(states, self.track, times, stamps)
        if mount is None:
            base = trajectory_of_mount(final, inverse(self.track.mount))
        else:
            before = states.index_before(times)
            share = np.zeros(len(times)) if ties is None else ties.share
            base = base_trajectory(final, self.track.mount, mount, states, before, share)
        if self.scans:
            base = with_stamp_errors(base, self.track, times)
        at_start = compose(states.poses[0], inverse(self.track.mount))
        odometry = between(
            self.track.pose(self.times[0] - late_ns), self.track.pose(times - late_ns)
        )
        unknown = np.full((len(times), 3, 3), np.nan)
        by_odometry = Trajectory(stamps, compose(at_start, odometry), unknown)
        if causal is not None and causal_only:
            return RobotResult(causal.base, causal.base, causal.scan, causal.scan, by_odometry)
        scan = trajectory_of_mount(final, laser) if self.scans else None
        if causal is None:
            return RobotResult(base, None, scan, None, by_odometry, ties)
        return RobotResult(base, causal.base, scan, causal.scan, by_odometry, ties)

    def _report_times(self) -> tuple[IntArray, IntArray, Array]:
        """Stamps (n,), times (n,) and, for scans, laser mounts (n, 3), sorted by stamp."""
        if self.scans:
            scans = sorted(self.scans, key=lambda scan: scan[0])
            stamps, times = (np.array([scan[k] for scan in scans], dtype=np.int64) for k in (0, 1))
            return stamps, times, np.array([scan[2] for scan in scans])
        period = round(1e9 / BASE_RATE_HZ)
        longest_ns = round(1e9 * self.track.config.max_gap_s)
        unknown = moved_in_gaps(self.track, longest_ns)
        times = times_of_readings(self.track.times, period, unknown)
        return self.clock.to_local(times), times, np.zeros((0, 3))


def times_of_readings(readings_ns: IntArray, period_ns: int, unknown: BoolArray) -> IntArray:
    """Times (n,) at an even rate from the first to the last reading (m,), none in long gaps.

    There is nothing to report where nothing was recorded, and a clock that steps by years would
    fill the memory. ``unknown`` (m - 1,): after which readings it is not known where the robot was.
    """
    breaks = np.flatnonzero(unknown | (np.diff(readings_ns) > LONGEST_GAP_NS))
    begins = readings_ns[np.concatenate([[0], breaks + 1])]
    ends = readings_ns[np.concatenate([breaks, [len(readings_ns) - 1]])]
    return np.concatenate(
        [np.arange(a, b + 1, period_ns) for a, b in zip(begins, ends, strict=True)]
    )


@dataclass(frozen=True, slots=True, eq=False)
class Causal:
    """Causal trajectories of a robot's base and, if it has scans, of its sensor at those."""

    base: Trajectory
    scan: Trajectory | None


def span_warnings(tracks: Mapping[str, Track], *, unplaced: bool) -> list[str]:
    """Robots whose odometry does not cover the time of the others', one line each.

    Args:
        tracks: of every robot, whole.
        unplaced: whether sightings were dropped since no odometry is near them; without any it does
            not matter that one robot was switched on before another.
    """
    spans = {name: (t.first_ns, t.last_ns) for name, t in tracks.items() if len(t)}
    if len(spans) < 2:
        return []
    begin, end = min(a for a, _ in spans.values()), max(b for _, b in spans.values())
    lines = []
    for name, (a, b) in spans.items():
        part = f"its odometry covers {1e-9 * (a - begin):.1f} to {1e-9 * (b - begin):.1f} s of "
        part += f"{1e-9 * (end - begin):.1f} s"
        if not any(a <= d and c <= b for other, (c, d) in spans.items() if other != name):
            lines.append(
                f"{name}: {part}, does not overlap any other robot's in time; check the clocks"
            )
        elif unplaced and max(a - begin, end - b) > EDGE_NS:
            lines.append(f"{name}: {part}; sightings outside this interval are dropped")
    return lines
