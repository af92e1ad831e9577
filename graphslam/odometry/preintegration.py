"""One robot's odometry as a continuous track: motions between any two times.

A motion over any interval, its covariance and its derivative by the calibration are computed from
the `readings` when asked for, and can be computed again with another calibration.
"""

from collections import defaultdict
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.geometry import (
    Array,
    between,
    compose,
    compose_jacobians,
    inverse,
    inverse_cov,
    rotation3,
    wrap,
)
from graphslam.core.motion_models import (
    MOTION_SOURCES,
    Calibration,
    Compounded,
    Increments,
    compound,
    mounted_motion,
    nominal_calibration,
)
from graphslam.core.records import Motion
from graphslam.odometry.readings import BoolArray, IntArray, Readings, reached, settle

#: m and rad: what a robot that reports no motion may still have moved between two states
STANDING_SIGMA = 1e-4

#: m of effort (see `Track.effort`): so short a motion is close enough to an arc to be one increment
COARSE_M = 0.3
#: ns: step of the difference quotient by latency; about one period of common odometry
LATENCY_STEP_NS = 50_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Motions:
    """Many motions: ``delta`` (n, 3), ``cov`` (n, 3, 3), ``d_cal`` (n, 3, p), ``length_m`` (n,)."""

    delta: Array
    cov: Array
    d_cal: Array
    length_m: Array

    def one(self, k: int, start_ns: int, end_ns: int) -> Motion:
        """The k-th of them, which is between these times."""
        length_m = float(self.length_m[k])
        return Motion(start_ns, end_ns, self.delta[k], self.cov[k], self.d_cal[k], length_m)

    def part(self, i: int, j: int) -> "Motions":
        """Those from the i-th up to the j-th."""
        which = slice(i, j)
        return Motions(self.delta[which], self.cov[which], self.d_cal[which], self.length_m[which])


class Track(Readings):
    """Odometry readings of one robot and its motions between any two times."""

    def __init__(
        self, config: OdometryConfig, robot: RobotConfig, *, mounted: bool = False
    ) -> None:
        """An empty track; ``mounted``: its motions are those of a sensor's frame, see `motion`."""
        super().__init__(config, robot)
        self.calibration = nominal_calibration("given", config, False)
        self.nominal = self.calibration  # before any data
        self._mounted, self._p = mounted, 0

    def _begin(self, source: str, time_ns: int) -> None:
        super()._begin(source, time_ns)
        mounted = self._mounted and source != "given"
        self.calibration = self.nominal = nominal_calibration(source, self._config, mounted)
        self._p = len(self.calibration.mean) - 4 * mounted  # parameters of the increments

    @property
    def mount(self) -> Array:
        """Pose (3,) in the base frame of the frame whose motions this track describes."""
        return self.mount_of(self.calibration)

    def mount_of(self, calibration: Calibration) -> Array:
        """The mount (3,) according to a calibration of this track."""
        if len(calibration.mean) > self._p:
            return calibration.mean[self._p : self._p + 3]
        return np.zeros(3)

    @property
    def mount_cov(self) -> Array:
        """Covariance (3, 3) of `mount`; zeros for a track that is not mounted."""
        where = slice(self._p, self._p + 3)
        if len(self.calibration.mean) > self._p:
            return self.calibration.cov[where, where]
        return np.zeros((3, 3))

    @property
    def floor(self) -> Array:
        """Covariance (3, 3) that a motion of any length has beside what its readings add up to."""
        return np.zeros((3, 3)) if self.source == "given" else self._floor(True)

    @property
    def used_calibration(self) -> Calibration:
        """The calibration as it is applied: without latency where the stamps do not allow one."""
        known = self.calibration
        if len(known.mean) > self._p and self.bursty:
            return Calibration(known.names, np.append(known.mean[:-1], 0.0), known.cov)
        return known

    @property
    def latency_ns(self) -> int:
        """By how long the times of states are late against the odometry's; 0 if unobservable."""
        if len(self.calibration.mean) > self._p and not self.bursty:
            return round(float(self.calibration.mean[-1]) * 1e9)
        return 0

    def _increments(self, rows: Array, calibration: Array) -> Increments:
        return MOTION_SOURCES[self.source](rows, calibration, self._robot, self._config)

    def mounted_pose(self, times_ns: IntArray) -> Array:
        """Poses (n, 3) of the frame at ``mount``, the times ``latency_ns`` late; see `pose`.

        What lies between two of them is `motion` but for the calibration of the odometry, and
        cheap.
        """
        return compose(self.pose(times_ns - self.latency_ns), self.mount)

    def motion(self, start_ns: int, end_ns: int) -> Motion:
        """The motion from ``start_ns`` to ``end_ns`` with its covariance; thesis 4.4-4.15.

        Uses the current ``calibration`` (`pose`, `moved` and `effort` are by nominal values). For
        a mounted track it is the motion of the frame at ``mount`` in the base, the times being
        ``latency_ns`` late.
        """
        whole = self._compounded(start_ns - self.latency_ns, end_ns - self.latency_ns)
        if whole is None:
            return self._standing(start_ns, end_ns)
        delta, d_cal, cov = whole.delta, whole.d_cal, whole.cov
        if len(self.calibration.mean) > self._p:
            delta, d_mount = mounted_motion(delta, self.mount)
            # errors of the base's motion, as they move the mounted frame: with its lever arm
            lever = rotation3(-self.mount[2]) @ compose_jacobians(whole.delta, self.mount)[0]
            late = self._by_latency(start_ns, end_ns, whole.delta)
            d_cal = np.column_stack([lever @ d_cal, d_mount, lever @ late])
            cov = lever @ cov @ lever.T
        cov = cov + d_cal @ self.calibration.cov @ d_cal.T
        if self.source != "given":
            cov = cov + self._floor(whole.length_m > 0 or delta[2] != 0)
        return Motion(start_ns, end_ns, delta, cov, d_cal, whole.length_m)

    def uncovered(self, start_ns: IntArray | int, end_ns: IntArray | int) -> BoolArray:
        """Whether motions (...,) are in part where there are no readings yet, or no more."""
        late = self.latency_ns
        return np.asarray((start_ns - late < self.first_ns) | (end_ns - late > self.last_ns))

    def unseen(self, start_ns: int, end_ns: int) -> Array:
        """What of a motion the readings do not cover, (3,), at the speed next to what is missing.

        `motion` takes the robot to stand then; by so much it may be wrong.
        """
        if not self.uncovered(start_ns, end_ns):
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
        """As `motion`, but ``end_ns`` may be the earlier one: then the way back."""
        if end_ns >= start_ns:
            return self.motion(start_ns, end_ns)
        forth = self.motion(end_ns, start_ns)
        cov = inverse_cov(forth.delta, forth.cov)
        return replace(forth, start_ns=start_ns, end_ns=end_ns, delta=inverse(forth.delta), cov=cov)

    def motions(self, start_ns: IntArray, end_ns: IntArray) -> Motions:
        """What `between` gives, for times (n,) and (n,), at once; see `motions_of`."""
        return motions_of([(self, start_ns, end_ns)])[0]

    @property
    def _kind(self) -> Hashable:
        """Tracks of one kind can be worked out together: they differ in readings and calibration.

        Those of wheels are each of its own kind, as calibration is of a robot's own wheels.
        """
        own = self if self.source == "wheels" else None
        return self.source, self._count > 1, len(self.calibration.mean), self._config, own

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
            calibrations: those known at some states.
            which: (n,) which of them applies.

        Returns:
            Motions (n, 3) and their covariances (n, 3, 3), along the axes of each start.
        """
        self._settle()
        mean = np.array([c.mean for c in calibrations])[which]
        cal_cov = np.array([c.cov for c in calibrations])[which]
        p, mounted = self._p, mean.shape[1] > self._p
        late = np.zeros(len(which), dtype=np.int64)
        if mounted:
            late = np.rint(1e9 * mean[:, -1]).astype(np.int64)
        begin, end = start_ns - late, end_ns - late
        head, knot = self._walked(begin, end, mean[:, :p])
        tail = self._piece(knot, end, mean[:, :p])
        F, W = compose_jacobians(head.delta, tail.delta)
        delta = compose(head.delta, tail.delta)
        cov = F @ head.cov @ F.mT + W @ tail.cov @ W.mT
        d_cal = F @ head.d_cal + W @ tail.d_cal
        if mounted:
            F, _ = compose_jacobians(delta, mean[:, p : p + 3])
            lever = rotation3(-mean[:, p + 2]) @ F
            delta, d_mount = mounted_motion(delta, mean[:, p : p + 3])
            d_cal = np.concatenate([lever @ d_cal, d_mount], axis=2)
            cov = lever @ cov @ lever.mT
        used = d_cal.shape[2]
        cov = cov + d_cal @ cal_cov[:, :used, :used] @ d_cal.mT
        if self.source != "given":
            moved = (self.effort(end) > self.effort(begin))[:, None, None]
            cov = cov + np.where(moved, self._floor(True), self._floor(False))
        return delta, np.where((end_ns > start_ns)[:, None, None], cov, 0.0)

    def _piece(self, begin: IntArray, end: IntArray, calibration: Array) -> Increments:
        """Base motions between times (n,) of the odometry's clock, each as one increment."""
        rows = self._at(end, self._sums) - self._at(begin, self._sums)
        part = MOTION_SOURCES[self.source](rows, np.zeros(self._p), self._robot, self._config)
        delta = between(self.pose(begin), self.pose(end))
        delta = delta + np.einsum("nij,nj->ni", part.d_cal, calibration)
        return Increments(delta, part.cov, part.d_cal)

    def _walked(
        self, begin: IntArray, end: IntArray, calibration: Array
    ) -> tuple[Increments, IntArray]:
        """Motions (n) from ``begin`` to the last knot before ``end``, and the knots' times (n,).

        Knots lie `COARSE_M` of effort apart, counted from each start.
        """
        n, p = len(begin), self._p
        head = Increments(np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros((n, 3, p)))
        knot = begin.copy()
        if self._count < 2:
            return head, knot
        effort_begin, effort_end = self.effort(begin), self.effort(end)
        order = np.argsort(begin, kind="stable")
        groups = np.split(order, np.flatnonzero(np.diff(begin[order])) + 1)
        effort, times = self._effort[: self._count], self.times
        for group in groups:
            first, far = group[0], float(effort_end[group].max())
            levels = np.arange(effort_begin[first] + COARSE_M, far, COARSE_M)
            if not len(levels):
                continue
            ends = np.interp(levels, effort, times).astype(np.int64)
            begins = np.append(begin[first], ends[:-1])
            pieces = self._piece(begins, ends, np.tile(calibration[first], (len(ends), 1)))
            passed = np.searchsorted(ends, end[group], side="right")
            delta, cov, d_cal = np.zeros(3), np.zeros((3, 3)), np.zeros((3, p))
            for k in range(len(ends)):
                F, W = compose_jacobians(delta, pieces.delta[k])
                delta = compose(delta, pieces.delta[k])
                cov = F @ cov @ F.T + W @ pieces.cov[k] @ W.T
                d_cal = F @ d_cal + W @ pieces.d_cal[k]
                here = group[passed == k + 1]
                head.delta[here], head.cov[here], head.d_cal[here] = delta, cov, d_cal
                knot[here] = ends[k]
        return head, knot

    def _compounded(self, start_ns: int, end_ns: int) -> Compounded | None:
        """The base's motion between two times of the odometry's clock; None when it stands."""
        self._settle()
        times, n = self.times, self._count
        first = max(int(np.searchsorted(times, start_ns, side="right")), 1)
        last = min(int(np.searchsorted(times, end_ns, side="left")), n - 1)
        if end_ns <= start_ns or last < first:
            return None
        share = self._share(np.arange(first, last + 1), start_ns, end_ns)
        rows = self._rows[first : last + 1] * share[:, None]
        return compound(self._increments(rows, self.calibration.mean[: self._p]))

    def _by_latency(self, start_ns: int, end_ns: int, delta: Array) -> Array:
        """Derivative (3,) of the base's motion by the latency, /s; a one-sided difference."""
        if self.bursty:
            return np.zeros(3)
        late = self.latency_ns + LATENCY_STEP_NS
        later = self._compounded(start_ns - late, end_ns - late)
        change = (later.delta if later is not None else np.zeros(3)) - delta
        change[2] = wrap(change[2])
        return np.asarray(change * (1e9 / LATENCY_STEP_NS))

    def _standing(self, start_ns: int, end_ns: int) -> Motion:
        p = len(self.calibration.mean)
        return Motion(start_ns, end_ns, np.zeros(3), self._floor(False), np.zeros((3, p)), 0.0)

    def _floor(self, moved: bool) -> Array:
        """Covariance (3, 3) added once per interval; never zero, or two states would be welded."""
        if not moved:
            return np.diag([STANDING_SIGMA**2] * 3)
        return np.diag([self._config.floor_sigma_m**2] * 2 + [self._config.floor_sigma_rad**2])


def motions_of(asked: Sequence[tuple[Track, IntArray, IntArray]]) -> list[Motions]:
    """What `Track.between` gives for many times and several robots, at once.

    Differences of sums over each whole track: with P_k the pose after increment k, its error e
    moves the pose P at the end of an interval by T(P) F_k e, F_k (3, 3) as if the end were the
    origin and T(P) its lever arm. So the sums of F_k C_k F_kᵀ and F_k D_k up to both ends
    are all that an interval needs.

    Args:
        asked: tracks with the times (n,) and (n,) between which their motions are wanted.

    Returns:
        Motions (n) of each.
    """
    of_track: dict[Track, list[int]] = defaultdict(list)
    for k, (track, _, _) in enumerate(asked):
        of_track[track].append(k)
    settle(of_track)
    alike: dict[Hashable, list[Track]] = defaultdict(list)
    for track in of_track:
        alike[track._kind].append(track)
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
    """`motions_of` tracks of one kind, those of one after those of the other."""
    times, starts, ends, passed = [], [], [], 0
    for track, start, end in zip(tracks, start_ns, end_ns, strict=True):
        both = np.concatenate([np.minimum(start, end), np.maximum(start, end)])
        needed, at = np.unique(both, return_inverse=True)
        times.append(needed - track.latency_ns)
        starts.append(passed + at[: len(start)])
        ends.append(passed + at[len(start) :])
        passed += len(needed)
    a, b = np.concatenate(starts), np.concatenate(ends)
    which = np.repeat(np.arange(len(tracks)), [len(start) for start in start_ns])
    walk, earlier = _walks(tracks, times)
    delta = between(walk.delta[a], walk.delta[b])
    # from the odometry's frame and origin to the axes of the start, lever arm at the end
    T = rotation3(-walk.delta[a, 2]) @ _lever(walk.delta[b])
    cov = T @ (walk.cov[b] - walk.cov[a]) @ T.mT
    d_cal = T @ (walk.d_cal[b] - walk.d_cal[a])
    length = walk.length_m[b] - walk.length_m[a]
    first = tracks[0]
    if len(first.calibration.mean) > first._p:
        mount = np.array([track.mount for track in tracks])[which]
        lever = rotation3(-mount[:, 2]) @ compose_jacobians(delta, mount)[0]
        change = between(earlier[a], earlier[b]) - delta
        change[:, 2] = wrap(change[:, 2])
        rate = np.array([0.0 if track.bursty else 1e9 / LATENCY_STEP_NS for track in tracks])
        change *= rate[which, None]
        delta, d_mount = mounted_motion(delta, mount)
        d_cal = np.concatenate([lever @ d_cal, d_mount, lever @ change[:, :, None]], axis=2)
        cov = lever @ cov @ lever.mT
    known = np.array([track.calibration.cov for track in tracks])[which]
    cov = (cov + cov.mT) / 2 + d_cal @ known @ d_cal.mT
    moved = (length > 0) | (delta[:, 2] != 0)
    floor = first._floor(True) if first.source != "given" else np.zeros((3, 3))
    cov = cov + np.where(moved[:, None, None], floor, first._floor(False))
    back = np.concatenate(end_ns) < np.concatenate(start_ns)
    if back.any():
        cov[back] = inverse_cov(delta[back], cov[back])
        delta[back] = inverse(delta[back])
    return Motions(delta, cov, d_cal, length)


def _walks(tracks: Sequence[Track], times: Sequence[IntArray]) -> tuple[Motions, Array]:
    """Sums up to times (n,) of each track's clock, from a reading before all of them.

    ``cov`` and ``d_cal`` are the sums that `motions_of` speaks of: of the pose at the origin. The
    tracks are of one kind; their sums follow each other, and so do the poses (n, 3) by which it was
    `LATENCY_STEP_NS` earlier.
    """
    p, counts = tracks[0]._p, [len(t) for t in times]
    n = sum(counts)
    if tracks[0]._count < 2:
        zeros, covs = np.zeros((n, 3)), np.zeros((n, 3, 3))
        return Motions(zeros, covs, np.zeros((n, 3, p)), np.zeros(n)), zeros
    rows, around, places, origins, whole = [], [], [], [], 0
    for track, when in zip(tracks, times, strict=True):
        # the index is that of the reading that ends the interval which a time is in
        i = track.times.searchsorted([when, when - LATENCY_STEP_NS])
        i = np.minimum(np.maximum(i, 1), track._count - 1)
        first = int(i.min(initial=track._count - 1))
        last = int(i.max(initial=first))
        rows.append(track._rows[first:last])
        around.append((track._rows[i], track._times[i - 1], track._times[i], track._burst[i]))
        places.append(whole + i - first)  # where in all whole rows each part begins
        origins.append(whole)
        whole += last - first
    # the whole rows first..last-1, then the part of its row that each time has reached
    last_rows, begins, ends, bursts = (np.hstack(each) for each in zip(*around, strict=True))
    now = np.concatenate(times)
    share = reached(begins, ends, bursts, np.array([now, now - LATENCY_STEP_NS]))
    rows.append((last_rows * share[:, :, None]).reshape(2 * n, -1))
    at = np.concatenate([np.arange(whole), np.hstack(places).ravel()])
    of_part = np.repeat(np.arange(len(tracks)), counts)
    of_whole = np.repeat(np.arange(len(tracks)), [len(r) for r in rows[:-1]])
    which = np.concatenate([of_whole, of_part, of_part])
    origin = np.array(origins)[which]
    mean = np.array([track.calibration.mean[:p] for track in tracks])
    made = tracks[0]._increments(np.concatenate(rows), mean[0] if len(tracks) == 1 else mean[which])
    heading = np.concatenate([[0.0], np.cumsum(made.delta[:whole, 2])])
    step = rotation3((heading[at] - heading[origin])[:whole]) @ made.delta[:whole, :, None]
    place = np.vstack([np.zeros(2), np.cumsum(step[:, :2, 0], axis=0)])
    poses = np.column_stack([place, heading])
    poses = poses[at] - poses[origin]  # where each increment begins
    turn = rotation3(poses[:, 2])
    after = poses + (turn @ made.delta[:, :, None])[:, :, 0]
    used = slice(whole + n)  # of what was earlier, nothing but the pose is
    F = _lever(-after[used]) @ turn[used]  # what an increment's error does to the origin
    covs, d_cals = F @ made.cov[used] @ F.mT, F @ made.d_cal[used]
    up, base = at[whole : whole + n], origin[whole : whole + n]

    def upto(each: Array) -> Array:
        sums = np.concatenate([np.zeros((1, *each.shape[1:])), np.cumsum(each[:whole], axis=0)])
        return np.asarray(sums[up] - sums[base] + each[whole:])

    path = np.hypot(made.delta[used, 0], made.delta[used, 1])
    walk = Motions(after[whole : whole + n], upto(covs), upto(d_cals), upto(path))
    return walk, after[whole + n :]


def _lever(poses: Array) -> Array:
    """(n, 3, 3): what an error of a pose at the origin does at rigidly connected poses (n, 3)."""
    T = np.tile(np.eye(3), (len(poses), 1, 1))
    T[:, 0, 2], T[:, 1, 2] = -poses[:, 1], poses[:, 0]
    return T
