"""Odometry of a robot with several lasers, whose states are those of the laser that scanned there.

The state of a scan is rigid to its own laser: the frame at the error of that laser's mount in the
base, at the time at which that laser measured. A motion between states of two lasers so depends on
both mounts and both latencies, which are parameters of the calibration like those of the first, and
what one laser sees needs nothing of the other.
"""

from collections.abc import Callable, Sequence

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.geometry import (
    Array,
    between,
    compose,
    compose_cov,
    compose_jacobians,
    inverse,
    inverse_cov,
    inverse_jacobian,
    rotation3,
    wrap,
)
from graphslam.core.motion_models import Calibration, further_calibration, nominal_calibration
from graphslam.core.record import replace
from graphslam.core.records import Motion, Trajectory
from graphslam.odometry.increment_sums import Motions
from graphslam.odometry.path_sums import LATENCY_STEP_NS, path_sums
from graphslam.odometry.preintegration import Track


class SeveralLasersTrack(Track):
    """The track of a robot with further lasers.

    Times are states of the first laser, unless they were added by `add_states`.
    """

    summed_together = False  # the states of each laser are elsewhere

    def __init__(self, config: OdometryConfig, robot: RobotConfig, sensors: Sequence[str]) -> None:
        """An empty track; ``sensors``: names of the further lasers."""
        self._sensors = tuple(sensors)
        self._own = {sensor: np.zeros(0, dtype=np.int64) for sensor in sensors}
        super().__init__(config, robot, mounted=True)

    def _nominal(self, source: str, mounted: bool) -> Calibration:
        first = nominal_calibration(source, self.config, mounted)
        return further_calibration(first, self._sensors, self.config)

    @property
    def increment_parameters(self) -> int:
        """See `Track`: without those of all lasers."""
        return super().increment_parameters - 4 * len(self._sensors)

    def add_states(self, sensor: str, times_ns: IntArray) -> None:
        """States of a further laser; times (n,) in ascending order, after those before."""
        self._own[sensor] = np.concatenate([self._own[sensor], times_ns])

    def add_mount_cov(self, cov: Array) -> None:
        """Add (3, 3) to the covariance of the mount of each laser."""
        all_cov = self.calibration.cov.copy()
        for end in range(len(all_cov), self.increment_parameters, -4):
            all_cov[end - 4 : end - 1, end - 4 : end - 1] += cov
        self.calibration = replace(self.calibration, cov=all_cov)

    def laser_of(self, times_ns: IntArray) -> IntArray:
        """Which laser states are of, (n,): 0 the first, k the k-th of the further ones."""
        found = np.zeros(times_ns.shape, dtype=np.int64)
        for k, own in enumerate(self._own.values(), 1):
            at = np.minimum(np.searchsorted(own, times_ns), max(len(own) - 1, 0))
            if len(own):
                found[own[at] == times_ns] = k
        return found

    def laser(self, sensor: str = "") -> tuple[Array, int]:
        """Mount (3,), by its error, and latency, ns, of a laser."""
        k = 0 if not sensor else 1 + self._sensors.index(sensor)
        mounts, late = self._lasers()
        return mounts[k], int(late[k])

    def _lasers(self) -> tuple[Array, IntArray]:
        """Mounts (1 + n, 3) and latencies (1 + n,), ns, of all lasers."""
        p = self.increment_parameters
        mean = self.used_calibration.mean
        if not self.is_mounted:  # the first is where the odometry is
            mean = np.concatenate([mean[:p], np.zeros(4), mean[p:]])
        each = mean[p:].reshape(-1, 4)
        return each[:, :3], np.rint(1e9 * each[:, 3]).astype(np.int64)

    @property
    def used_calibration(self) -> Calibration:
        """See `Track`."""
        known = self.calibration
        if self.source and self.has_burst_stamps:
            mean = known.mean.copy()
            mean[self.increment_parameters + 3 :: 4] = 0.0
            return Calibration(known.names, mean, known.cov)
        return known

    def motion(self, start_ns: int, end_ns: int) -> Motion:
        """See `Track`."""
        ends = np.array([start_ns, end_ns], dtype=np.int64)
        return self.motions(ends[:1], ends[1:]).one(0, start_ns, end_ns)

    def between(self, start_ns: int, end_ns: int) -> Motion:
        """See `Track`."""
        return self.motion(start_ns, end_ns)

    def odometry_spans(
        self, start_ns: IntArray, end_ns: IntArray
    ) -> tuple[IntArray, IntArray, Array]:
        """See `Track`."""
        mounts, late = self._lasers()
        ends = [times - late[self.laser_of(times)] for times in (start_ns, end_ns)]
        return np.minimum(*ends), np.maximum(*ends), mounts[self.laser_of(end_ns)]

    def motions(self, start_ns: IntArray, end_ns: IntArray) -> Motions:
        """See `Track`; between states of whichever laser."""
        return self._motions(start_ns, end_ns, self.laser_of(start_ns), self.laser_of(end_ns))

    def motions_among(self, times_ns: IntArray) -> Callable[[IntArray, IntArray], Motions]:
        """See `Track`."""
        return self.motions

    def _motions(
        self, start_ns: IntArray, end_ns: IntArray, start_of: IntArray, end_of: IntArray
    ) -> Motions:
        """Motions from states of the lasers ``start_of`` (n,) to those of ``end_of`` (n,)."""
        self._integrate_pending()
        mounts, late = self._lasers()
        begin, end = start_ns - late[start_of], end_ns - late[end_of]
        times, at = np.unique(np.concatenate([begin, end]), return_inverse=True)
        a, b = np.split(at, 2)
        sums, earlier = path_sums([self], [times])
        # what the latency of one of two lasers changes may reverse the order of their times
        first, last = np.minimum(a, b), np.maximum(a, b)
        found = sums.motions_between(first, last)
        delta, cov, d_cal = found.delta, found.cov, found.d_cal
        back = end < begin
        if back.any():
            cov[back] = inverse_cov(delta[back], cov[back])
            d_cal[back] = inverse_jacobian(delta[back]) @ d_cal[back]
            delta[back] = inverse(delta[back])
        step = 0.0 if self.has_burst_stamps else 1e9 / LATENCY_STEP_NS
        by_start = _change(between(earlier[a], sums.pose[b]), delta) * step
        by_end = _change(between(sums.pose[a], earlier[b]), delta) * step
        M, N = mounts[start_of], mounts[end_of]
        back_turn = rotation3(-M[:, 2])
        J, W = compose_jacobians(delta, N)
        ends_at = compose(delta, N)
        moved = compose(inverse(M), ends_at)
        by_M = -back_turn
        by_M[:, 0, 2], by_M[:, 1, 2] = moved[:, 1], -moved[:, 0]
        lever = back_turn @ J
        p, rows = self.increment_parameters, np.arange(len(delta))
        # of every laser x, y, yaw and latency
        D = np.zeros((len(delta), 1 + len(self._sensors), 3, 4))
        D[rows, start_of, :, :3] += by_M
        D[rows, start_of, :, 3] += (lever @ by_start[:, :, None])[:, :, 0]
        D[rows, end_of, :, :3] += back_turn @ W
        D[rows, end_of, :, 3] += (lever @ by_end[:, :, None])[:, :, 0]
        if not self.is_mounted:
            D = D[:, 1:]
        d_cal = np.concatenate(
            [lever @ d_cal[:, :, :p], *(D[:, k] for k in range(D.shape[1]))], axis=2
        )
        cov = lever @ cov @ lever.mT
        cov = (cov + cov.mT) / 2 + d_cal @ self.calibration.cov @ d_cal.mT
        drove = (found.length_m > 0) | (found.delta[:, 2] != 0)
        cov = cov + np.where(drove[:, None, None], self.floor_cov, self.floor_cov_of(False))
        return Motions(moved, cov, d_cal, found.length_m)

    def at_first_laser(self, states: Trajectory) -> Trajectory:
        """States of all lasers as those of the first, at the times of each.

        The difference of two mounts, and that of latencies, is known much better than a state.
        """
        times, of = states.stamps_ns, self.laser_of(states.stamps_ns)
        other = np.flatnonzero(of)
        if not len(other):
            return states
        zero = np.zeros(len(other), dtype=np.int64)
        step = self._motions(times[other], times[other], of[other], zero).delta
        poses, covs = states.poses.copy(), states.covs.copy()
        F, _ = compose_jacobians(poses[other], step)
        covs[other] = F @ covs[other] @ F.mT
        poses[other] = compose(poses[other], step)
        return replace(states, poses=poses, covs=covs)


def last_part(whole: Motion, first: Motion, last: Motion) -> Motion:
    """The ``last`` of two motions, as the ``whole`` of both says that it is from scans."""
    back = inverse(first.delta)
    cov = compose_cov(back, inverse_cov(first.delta, first.cov), whole.delta, whole.cov)
    D = np.zeros_like(last.d_delta_d_calibration)
    return replace(
        last, delta=compose(back, whole.delta), cov=cov, d_delta_d_calibration=D, from_scans=True
    )


def _change(moved: Array, delta: Array) -> Array:
    change = moved - delta
    change[:, 2] = wrap(change[:, 2])
    return np.asarray(change)
