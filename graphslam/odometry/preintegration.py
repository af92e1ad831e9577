"""One robot's odometry as a continuous track: preintegrated motions between any two times.

A motion over an interval, its covariance and its derivative by the calibration are computed from
the `readings` when needed, and can be computed again with another calibration.
"""

from collections import defaultdict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace

import numpy as np

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.geometry import (
    Array,
    between,
    compose,
    inverse,
    inverse_cov,
    inverse_jacobian,
    wrap,
)
from graphslam.core.motion_models import (
    MOTION_SOURCES,
    RATES,
    Calibration,
    Compounded,
    Increments,
    compound,
    nominal_calibration,
    parameter_cov,
    with_rates,
)
from graphslam.core.records import Motion, Trajectory
from graphslam.odometry.coarse_motions import coarse_motions
from graphslam.odometry.increment_sums import Motions
from graphslam.odometry.integration_windows import in_windows
from graphslam.odometry.mounted_motions import of_mount
from graphslam.odometry.path_sums import LATENCY_STEP_NS, SumsAtStates, numbered_times
from graphslam.odometry.readings import Readings

#: m and rad: sigma of the motion of a robot that reports none
STANDING_SIGMA = 1e-4

#: of so many motions a track is integrated by itself: NumPy's cost per call no longer counts, but
#: whether arrays fit into the processor's cache does
MANY_MOTIONS = 1000


class Track(Readings):
    """Odometry readings of one robot and its motions between any two times.

    ``summed_together``: whether `preintegrate_batch` may integrate it with other tracks.
    """

    summed_together = True

    def __init__(
        self,
        config: OdometryConfig,
        robot: RobotConfig,
        *,
        mounted: bool = False,
        late: bool = False,
    ) -> None:
        """An empty track.

        ``mounted``: its motions are those of a sensor's frame, see `motion`. This takes a
        calibration of odometry, which increments with covariances have not, unless the sensor is
        just ``late``.
        """
        super().__init__(config, robot)
        self.calibration = self._nominal("given", False)
        self.prior = self.calibration  # before any data
        self._mounted, self._late = mounted, late

    def _begin(self, source: str, time_ns: int) -> None:
        super()._begin(source, time_ns)
        self._mounted &= source != "given" or self._late
        self.calibration = self.prior = self._nominal(source, self._mounted)

    def _nominal(self, source: str, mounted: bool) -> Calibration:
        """The calibration before any data."""
        return nominal_calibration(source, self.config, mounted)

    @property
    def is_mounted(self) -> bool:
        """Whether the motions are those of a sensor whose mount and latency are calibrated."""
        return self._mounted and bool(self.source)

    @property
    def increment_parameters(self) -> int:
        """Number p of calibration parameters of the odometry; those of the mount follow them."""
        return len(self.calibration.mean) - 4 * self.is_mounted

    @property
    def mount(self) -> Array:
        """Pose (3,) in the base frame of the frame whose motions this track describes."""
        return self.mount_of(self.calibration)

    def mount_of(self, calibration: Calibration) -> Array:
        """The mount (3,) according to a calibration of this track."""
        return calibration.mean[self._mount_slice] if self.is_mounted else np.zeros(3)

    @property
    def mount_cov(self) -> Array:
        """Covariance (3, 3) of `mount`; zeros for a track that is not mounted."""
        where = self._mount_slice
        return self.calibration.cov[where, where] if self.is_mounted else np.zeros((3, 3))

    @property
    def _mount_slice(self) -> slice:
        return slice(self.increment_parameters, self.increment_parameters + 3)

    def add_mount_cov(self, cov: Array) -> None:
        """Add (3, 3) to the covariance of the mount."""
        if self.is_mounted:
            all_cov = self.calibration.cov.copy()
            all_cov[self._mount_slice, self._mount_slice] += cov
            self.calibration = replace(self.calibration, cov=all_cov)

    def hold_mount_unless(self, sigmas: float) -> None:
        """Take the sensor to be where the log says, unless that is so many sigmas off."""
        if self.is_mounted and self.mount @ np.linalg.inv(self.mount_cov) @ self.mount <= sigmas**2:
            mount = range(*self._mount_slice.indices(len(self.calibration.mean)))
            self.prior = self.prior.at_zero(mount)
            self.calibration = self.calibration.at_zero(mount)

    @property
    def floor_cov(self) -> Array:
        """Covariance (3, 3) that is added once to every motion, however short."""
        return np.zeros((3, 3)) if self.source == "given" else self.floor_cov_of(True)

    @property
    def used_calibration(self) -> Calibration:
        """The calibration as it is applied: without latency where the stamps do not allow one."""
        known = self.calibration
        if self.is_mounted and self.has_burst_stamps:
            return Calibration(known.names, np.append(known.mean[:-1], 0.0), known.cov)
        return known

    @property
    def latency_ns(self) -> int:
        """By how long the times of states are late against the odometry's; 0 if unobservable."""
        if self.is_mounted and not self.has_burst_stamps:
            return round(float(self.calibration.mean[self._mount_slice.stop]) * 1e9)
        return 0

    def laser(self, _sensor: str = "") -> tuple[Array, int]:
        """Mount (3,), by its error, and latency, ns, of a laser; see `SeveralLasersTrack`."""
        return self.mount, self.latency_ns

    def reported_late_ns(self, known: Calibration) -> int:
        """By how long the time of a state is later than that of the odometry it is reported at.

        States have the time at which their sensor saw something. Measured odometry says when the
        robot was there, so what is late is the sensor. A robot that follows its commands late is
        where the sensor sees it.
        """
        if self.source == "commands" or not self.is_mounted or self.has_burst_stamps:
            return 0
        return round(float(known.mean[self._mount_slice.stop]) * 1e9)

    def increments(self, rows: Array, calibration: Array, rates: Array | None = None) -> Increments:
        """Increments (n) of rows (n, k), by calibration parameters (p,) or (n, p).

        ``rates`` (n, 9): of the model error, in place of those of the settings.
        """
        made = MOTION_SOURCES[self.source](rows, calibration, self.robot, self.config, rates)
        if self.config.parameter_noise == "white" and self.source != "given":
            noise = parameter_cov(self.source, rows, self.robot, self.config)
            made = replace(made, cov=made.cov + noise)
        return made

    def mounted_pose(self, times_ns: IntArray, sensor: str = "") -> Array:
        """Poses (n, 3) of the frame at ``mount``, the times ``latency_ns`` late; see `pose`.

        The motion between two of them is `motion` without the calibration of the odometry. Cheap.
        ``sensor``: of which laser.
        """
        mount, late_ns = self.laser(sensor)
        return compose(self.pose(times_ns - late_ns), mount)

    def odometry_spans(
        self, start_ns: IntArray, end_ns: IntArray
    ) -> tuple[IntArray, IntArray, Array]:
        """Times (n,) of the odometry's clock between which states moved, and mounts at the ends."""
        late, n = self.latency_ns, len(start_ns)
        return start_ns - late, end_ns - late, np.broadcast_to(self.mount, (n, 3))

    def at_first_laser(self, states: Trajectory) -> Trajectory:
        """States as those of the first laser: there is one; see `SeveralLasersTrack`."""
        return states

    def motion(self, start_ns: int, end_ns: int) -> Motion:
        """The motion from ``start_ns`` to ``end_ns`` with its covariance; thesis 4.4-4.15.

        Uses the current ``calibration`` (`pose`, `moved` and `effort` are by nominal values). For
        a mounted track it is the motion of the frame at ``mount`` in the base, the times being
        ``latency_ns`` late.

        `motions` of one interval takes half as long again; where ``start`` cuts a reading, the
        noise of the rest of it is along the axes of the reading's start there, not of the cut.
        """
        whole = self._base_motion(start_ns, end_ns, self.latency_ns)
        if whole is None:
            d_cal = np.zeros((3, len(self.calibration.mean)))
            return Motion(start_ns, end_ns, np.zeros(3), self.floor_cov_of(False), d_cal, 0.0)
        delta, d_cal, cov = whole.delta, whole.d_cal, whole.cov
        if self.is_mounted:
            by_latency = self._by_latency(start_ns, end_ns, delta)
            delta, cov, d_cal = of_mount(delta, cov, d_cal, self.mount, by_latency)
        cov = cov + d_cal @ self.calibration.cov @ d_cal.T
        if self.source != "given":
            cov = cov + self.floor_cov_of(whole.length_m > 0 or delta[2] != 0)
        return Motion(start_ns, end_ns, delta, cov, d_cal, whole.length_m)

    def _base_motion(self, start_ns: int, end_ns: int, late_ns: int) -> Compounded | None:
        """The base's motion between times that are late; None when it stands."""
        rows = self.rows_between(start_ns - late_ns, end_ns - late_ns)
        if not len(rows):
            return None
        return compound(self.increments(rows, self.calibration.mean[: self.increment_parameters]))

    def _by_latency(self, start_ns: int, end_ns: int, delta: Array) -> Array:
        """Derivative (3,) of the base's motion by the latency, /s; a one-sided difference."""
        if self.has_burst_stamps:
            return np.zeros(3)
        later = self._base_motion(start_ns, end_ns, self.latency_ns + LATENCY_STEP_NS)
        change = (later.delta if later is not None else np.zeros(3)) - delta
        change[2] = wrap(change[2])
        return np.asarray(change * (1e9 / LATENCY_STEP_NS))

    def is_uncovered(self, start_ns: IntArray | int, end_ns: IntArray | int) -> BoolArray:
        """Whether motions (...,) are in part where there are no readings yet, or no more."""
        late = self.latency_ns
        return np.asarray((start_ns - late < self.first_ns) | (end_ns - late > self.last_ns))

    def uncovered_bound(self, start_ns: int, end_ns: int) -> Array:
        """Bound (3,) on the part of a motion without readings, at the speed next to it.

        `motion` assumes that the robot stands there; this is its possible error.
        """
        if not self.is_uncovered(start_ns, end_ns):
            return np.zeros(3)
        begin, end = start_ns - self.latency_ns, end_ns - self.latency_ns
        most = min(end - begin, self.last_ns - self.first_ns)
        before, after = (
            min(max(ns, 0), most) for ns in (self.first_ns - begin, end - self.last_ns)
        )
        ahead = between(self.pose(self.first_ns), self.pose(self.first_ns + before))
        behind = between(self.pose(self.last_ns - after), self.pose(self.last_ns))
        return np.abs(ahead) + np.abs(behind)

    def between(self, start_ns: int, end_ns: int) -> Motion:
        """As `motion`, but ``end_ns`` may be the earlier one: then the inverse motion."""
        if end_ns >= start_ns:
            return self.motion(start_ns, end_ns)
        forth = self.motion(end_ns, start_ns)
        cov = inverse_cov(forth.delta, forth.cov)
        d_cal = inverse_jacobian(forth.delta) @ forth.d_delta_d_calibration
        return Motion(start_ns, end_ns, inverse(forth.delta), cov, d_cal, forth.length_m)

    def motions(self, start_ns: IntArray, end_ns: IntArray) -> Motions:
        """What `between` gives, for times (n,) and (n,), at once; see `preintegrate_batch`."""
        return preintegrate_batch([(self, start_ns, end_ns)])[0]

    def motions_among(self, times_ns: IntArray) -> Callable[[IntArray, IntArray], Motions]:
        """`motions` between any of these times (n,), ascending; what they share is summed once."""
        sums = SumsAtStates([self], [times_ns])
        return lambda start_ns, end_ns: sums.motions(
            np.searchsorted(times_ns, start_ns), np.searchsorted(times_ns, end_ns)
        )

    @property
    def batch_key(self) -> Hashable:
        """Tracks with equal keys can be integrated together.

        Only their data, calibrations and rates of noise differ. Tracks of wheels are never
        integrated together: their geometry is of the robot.
        """
        own = self if self.source == "wheels" else None
        alike = with_rates(self.config, np.zeros(len(RATES)))
        return self.source, len(self) > 1, len(self.calibration.mean), alike, own

    def coarse_motions(
        self,
        start_ns: IntArray,
        end_ns: IntArray,
        calibrations: Sequence[Calibration],
        which: IntArray,
    ) -> tuple[Array, Array]:
        """Many motions at once, in pieces of `COARSE_M` that each count as one increment.

        What `motion` gives, but vectorised and with a calibration per motion; it leaves out the
        uncertainty of the latency.

        Args:
            start_ns: (n,) times.
            end_ns: (n,) times.
            calibrations: those of some states.
            which: (n,) index of the calibration that applies.

        Returns:
            Motions (n, 3) and their covariances (n, 3, 3), along the axes of each start.
        """
        mean = np.array([c.mean for c in calibrations])[which]
        cal_cov = np.array([c.cov for c in calibrations])[which]
        p, late = self.increment_parameters, np.zeros(len(which), dtype=np.int64)
        if self.is_mounted:
            late = np.rint(1e9 * mean[:, p + 3]).astype(np.int64)
        begin, end = start_ns - late, end_ns - late
        moved = coarse_motions(self, begin, end, mean[:, :p])
        delta, cov, d_cal = moved.delta, moved.cov, moved.d_cal
        if self.is_mounted:
            delta, cov, d_cal = of_mount(delta, cov, d_cal, mean[:, p : p + 3], None)
        used = d_cal.shape[2]
        cov = cov + d_cal @ cal_cov[:, :used, :used] @ d_cal.mT
        if self.source != "given":
            effort_begin, effort_end = self.effort(np.stack([begin, end]))
            drove = (effort_end > effort_begin)[:, None, None]
            cov = cov + np.where(drove, self.floor_cov_of(True), self.floor_cov_of(False))
        return delta, np.where((end_ns > start_ns)[:, None, None], cov, 0.0)

    def floor_cov_of(self, moved: bool) -> Array:
        """Covariance (3, 3) added once per interval; never zero, as it is inverted."""
        if not moved:
            return np.diag([STANDING_SIGMA**2] * 3)
        return np.diag([self.config.floor_sigma_m**2] * 2 + [self.config.floor_sigma_rad**2])


def preintegrate_batch(asked: Sequence[tuple[Track, IntArray, IntArray]]) -> list[Motions]:
    """What `Track.between` gives for many times and several robots, at once: motions (n) of each.

    ``asked``: tracks with the start times (n,) and end times (n,) of motions.
    """
    together = [one for one in asked if one[0].summed_together]
    summed = iter(in_windows(together, _integrated) if together else ())
    return [
        next(summed) if track.summed_together else track.motions(start_ns, end_ns)
        for track, start_ns, end_ns in asked
    ]


def _integrated(asked: Sequence[tuple[Track, IntArray, IntArray]]) -> list[Motions]:
    """`preintegrate_batch`, all in one piece."""
    of_track: dict[Track, list[int]] = defaultdict(list)
    for k, (track, _, _) in enumerate(asked):
        of_track[track].append(k)
    alike: dict[Hashable, list[Track]] = defaultdict(list)
    for track, numbers in of_track.items():
        is_few = sum(len(asked[k][1]) for k in numbers) < MANY_MOTIONS
        alike[track.batch_key if is_few else track].append(track)
    found: dict[int, Motions] = {}
    for tracks in alike.values():
        order = [k for track in tracks for k in of_track[track]]
        start_ns, end_ns = (
            [np.concatenate([asked[k][which] for k in of_track[track]]) for track in tracks]
            for which in (1, 2)
        )
        many = _motions(tracks, start_ns, end_ns)
        done = 0
        for k in order:
            found[k] = many.part(done, done := done + len(asked[k][1]))
    return [found[k] for k in range(len(asked))]


def _motions(
    tracks: Sequence[Track], start_ns: Sequence[IntArray], end_ns: Sequence[IntArray]
) -> Motions:
    """`preintegrate_batch` tracks with one `Track.batch_key`, track after track."""
    times, starts, ends = numbered_times(start_ns, end_ns)
    return SumsAtStates(tracks, times).motions(starts, ends)
