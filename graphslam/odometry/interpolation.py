"""Trajectories at any stamps, by odometry between states; results in other world frames."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.gaussian import chi2_quantile, mahalanobis_squared
from graphslam.core.geometry import (
    Array,
    adjoint,
    between,
    compose,
    compose_cov,
    compose_jacobians,
    exp,
    inverse,
    log,
    rotate_cov,
    rotation3,
    transform,
    wrap,
)
from graphslam.core.motion_models import Calibration
from graphslam.core.mount_covariances import MountCovariances
from graphslam.core.record import replace
from graphslam.core.records import Estimate, ScanTies, Start, Step, Trajectory
from graphslam.odometry.preintegration import Track
from graphslam.odometry.reading_gaps import covs_in_gaps

#: squared distance, three degrees of freedom, and m, rad, beyond which a motion that odometry did
#: not see is no noise. Where it is less, Intel's scans between states are better placed by noise
SLIP, SLIP_M, SLIP_RAD = float(chi2_quantile(0.9999, 3)), 0.2, 0.2
#: m², rad²: least variances of noise
TINY = 1e-10 * np.eye(3)
#: ns: a robot's velocity is its motion from so long before to so long after
HALF_SPAN_NS = 250_000_000


class BetterScans(Protocol):
    """Says of some scans better than odometry does where they were."""

    def __call__(
        self, times_ns: IntArray, poses: Array, covs: Array
    ) -> tuple[IntArray, Array, Array, Array]:
        """Of scans at ``times_ns`` (n,) rows (m,), poses (m, 3) and two covariances (m, 3, 3).

        ``poses`` (n, 3) are those by odometry between states, ``covs`` (n, 3, 3) their errors given
        the states, along their own axes. So are the covariances that are returned: of the better
        poses, and of those by odometry, which may turn out to be larger than was thought.
        """


def causal_at(
    states: Trajectory,
    last: IntArray,
    calibrations: Sequence[Calibration],
    track: Track,
    times_ns: IntArray,
    stamps_ns: IntArray,
    better: tuple[IntArray, Array, Array] | None = None,
) -> Trajectory:
    """Poses at ``times_ns``: the last state known at each, propagated by odometry.

    If the states are causal, so is the result: ``calibrations[i]`` is the calibration when state i
    was created. The covariance grows by that of odometry.

    Args:
        states: the states, stamped with their times.
        last: (n,) index of the last state known at each of ``times_ns``.
        calibrations: of the odometry, one per state.
        track: the robot's odometry.
        times_ns: (n,) when.
        stamps_ns: (n,) what the result is stamped with.
        better: rows (m,) where the motion since the state is known better than by odometry, motions
            (m, 3) and their covariances (m, 3, 3) along the axes of the state.
    """
    i, since = last, times_ns - states.stamps_ns[last]
    delta, noise = np.zeros((len(i), 3)), np.zeros((len(i), 3, 3))
    by_odometry = since != 0
    if better is not None:
        rows, delta[rows], noise[rows] = better
        by_odometry[rows] = False
    own = np.flatnonzero(by_odometry)
    if len(own):  # a live robot mostly has none
        begin, end = states.stamps_ns[i[own]], times_ns[own]
        delta[own], noise[own] = track.coarse_motions(begin, end, calibrations, i[own])
    covs = compose_cov(states.poses[i], states.covs[i], delta, noise)
    return Trajectory(stamps_ns, compose(states.poses[i], delta), covs)


@dataclass(frozen=True, slots=True, eq=False)
class _Interval:
    """Times (n,) between two states, and the odometry: from the first to them, and all of it.

    ``inside``: whether there is a second state. ``share`` of the motion that is driven, of the time
    where a ``slip`` is most of it; 0 if there is none.
    ``slip`` (n, 3): what the motion between the states is beyond that of the odometry, where that
    is no noise; else 0.
    """

    before: IntArray
    following: IntArray
    inside: np.ndarray[Any, np.dtype[np.bool_]]
    share: Array
    delta: Array
    noise: Array
    whole: Array
    whole_noise: Array
    slip: Array

    @classmethod
    def of(cls, states: Trajectory, track: Track, times_ns: IntArray) -> "_Interval":
        at, known = states.stamps_ns, [track.used_calibration]
        i = states.index_before(times_ns)
        following = np.minimum(i + 1, len(at) - 1)
        same = np.zeros(len(i), dtype=np.int64)
        delta, noise = track.coarse_motions(at[i], times_ns, known, same)
        begin, first, of = np.unique(i, return_index=True, return_inverse=True)
        end = at[following[first]]
        whole, whole_noise = track.coarse_motions(at[begin], end, known, same[: len(begin)])
        moved = between(states.poses[begin], states.poses[following[first]])
        slip = _slips(moved, whole, whole_noise)
        whole, whole_noise, slip = whole[of], whole_noise[of], slip[of]
        inside = following > i
        # as the motions are, by the odometry's clock: states may be late against it
        late_ns = track.latency_ns
        effort = track.effort(at - late_ns)
        driven = np.where(inside, effort[following] - effort[i], 0.0)
        since = track.effort(times_ns - late_ns) - effort[i]
        share = since / np.where(driven > 0, driven, 1.0)
        # most of the motion was not seen, and may have been while odometry stood
        unseen = np.hypot(slip[:, 0], slip[:, 1]) + np.abs(slip[:, 2]) > driven
        passed = (times_ns - at[i]) / np.maximum(at[following] - at[i], 1)
        share = np.where(unseen, passed, np.where(driven > 0, share, 0.0))
        share = np.clip(share, 0.0, 1.0)
        return cls(i, following, inside, share, delta, noise, whole, whole_noise, slip)

    def noise_between(self) -> Array:
        """Covariances (n, 3, 3) given the states, along the axes of the one before.

        Noise adds up bit by bit, and given both ends s (1 - s) of it is left. What a robot slips
        comes at once: it is in front of a pose, or behind it, with the chances s and 1 - s, which
        leaves the same share of its square.
        """
        s = self.share[:, None, None]
        whole = self.whole_noise + self.slip[:, :, None] * self.slip[:, None, :]
        return np.where(self.inside[:, None, None], s * (1 - s) * whole, self.noise)


def _slips(moved: Array, odometry: Array, noise: Array) -> Array:
    """What of motions (n, 3) is beyond those of odometry and their noise (n, 3, 3); 0 where not."""
    off = moved - odometry
    off[:, 2] = wrap(off[:, 2])
    slips = (np.hypot(off[:, 0], off[:, 1]) > SLIP_M) | (np.abs(off[:, 2]) > SLIP_RAD)
    slips &= mahalanobis_squared(off, noise + TINY) > SLIP
    return np.where(slips[:, None], off, 0.0)


def final_at(
    states: Trajectory, track: Track, times_ns: IntArray, stamps_ns: IntArray
) -> Trajectory:
    """Poses at ``times_ns`` between final states.

    The disagreement between odometry and the *next* state is spread over the interval in proportion
    to the motion in it, and the covariance is that of a bridge between both states.

    Args:
        states: the states, stamped with their times.
        track: the robot's odometry, its calibration the final one.
        times_ns: (n,) when.
        stamps_ns: (n,) what the result is stamped with.
    """
    interval = _Interval.of(states, track, times_ns)
    poses = _between(states, interval)
    noise = rotate_cov(interval.noise_between(), states.poses[interval.before, 2] - poses[:, 2])
    noise = noise + covs_in_gaps(track, times_ns - track.latency_ns)
    return Trajectory(stamps_ns, poses, _covs(states, interval, poses, noise))


def _between(states: Trajectory, interval: _Interval) -> Array:
    i, following = interval.before, interval.following
    miss = log(between(compose(states.poses[i], interval.whole), states.poses[following]))
    poses = compose(states.poses[i], interval.delta)
    miss = np.where(interval.inside[:, None], miss, 0.0)
    return compose(poses, exp(interval.share[:, None] * miss))


def _covs(states: Trajectory, interval: _Interval, poses: Array, noise: Array) -> Array:
    """Covariances (n, 3, 3) of poses between states, ``noise`` (n, 3, 3) being that given these.

    The noise is along the axes of each pose.
    """
    i, s = interval.before, interval.share[:, None, None]
    F, _ = compose_jacobians(states.poses[i], between(states.poses[i], poses))
    propagated = F @ states.covs[i] @ F.mT
    bridge = (1 - s) * propagated + s * states.covs[interval.following]
    known = np.where(interval.inside[:, None, None], bridge, propagated)
    return np.asarray(known + rotate_cov(noise, poses[:, 2]))


def final_scans(
    states: Trajectory,
    track: Track,
    times_ns: IntArray,
    stamps_ns: IntArray,
    mounts: Array,
    better: BetterScans | None = None,
) -> tuple[Trajectory, ScanTies]:
    """Poses of the states' frame at scans, see `final_at`, and how those of the scans follow.

    Given both states, the error between them is that of odometry: s (1 - s) of its covariance over
    the whole interval. After the last state it is that of the odometry since.

    Args:
        states: the states, stamped with their times.
        track: the robot's odometry, its calibration the final one.
        times_ns: (n,) of the scans.
        stamps_ns: (n,) what the result is stamped with.
        mounts: (n, 3) of the scans' sensors in the frame of the states.
        better: of scans that are known better.
    """
    interval = _Interval.of(states, track, times_ns)
    poses, before = _between(states, interval), interval.before
    noise = rotate_cov(interval.noise_between(), states.poses[before, 2] - poses[:, 2])
    by_odometry = noise.copy()
    if better is not None:
        rows, found, left, prior = better(times_ns, poses, noise)
        poses[rows], noise[rows], by_odometry[rows] = found, left, prior
    final = Trajectory(stamps_ns, poses, _covs(states, interval, poses, noise))
    # from the robot at the scan to the sensor
    J = adjoint(inverse(mounts))
    covs, odometry_covs = (J @ one @ J.mT for one in (noise, by_odometry))
    return final, ScanTies(before, interval.share, mounts, covs, odometry_covs)


def trajectory_of_mount(base: Trajectory, mounts: Array) -> Trajectory:
    """Trajectory of frames that sit at ``mounts`` (n, 3) or (3,) in the base frame, rigidly."""
    F, _ = compose_jacobians(base.poses, mounts)
    return Trajectory(base.stamps_ns, compose(base.poses, mounts), F @ base.covs @ F.mT)


def transform_trajectory(trajectory: Trajectory, world: Array) -> Trajectory:
    """The trajectory in the frame in which its world frame is at ``world`` (3,) or (n, 3)."""
    turn = rotation3(world[..., 2])
    poses = compose(np.broadcast_to(world, trajectory.poses.shape), trajectory.poses)
    return Trajectory(trajectory.stamps_ns, poses, turn @ trajectory.covs @ turn.mT)


@dataclass(frozen=True, slots=True, eq=False)
class FrameTransforms:
    """Poses (3,) of the old world frames in the new one, by robot and by landmark."""

    robots: Mapping[str, Array]
    landmarks: Mapping[int, Array]

    def estimate(self, estimate: Estimate) -> Estimate:
        """The estimate in the new frame; without landmarks that the map deleted.

        A smoother keeps those: what was seen of them still ties states together.
        """
        states = {n: transform_trajectory(t, self.robots[n]) for n, t in estimate.states.items()}
        landmarks = {}
        for number, (mean, cov) in estimate.landmarks.items():
            world = self.landmarks.get(number)
            if world is None:
                continue
            M = rotation3(world[2])[: len(mean), : len(mean)]
            moved = compose(world, mean) if len(mean) == 3 else transform(world, mean)
            landmarks[number] = (moved, M @ cov @ M.T)
        mounts = estimate.mounts and self._turned(estimate.mounts)
        return replace(estimate, states=states, landmarks=landmarks, mounts=mounts)

    def _turned(self, known: MountCovariances) -> MountCovariances:
        """The same along the axes of the new frames."""
        landmarks = {}
        for number, cross in known.landmarks.items():
            if number not in self.landmarks:
                continue
            turn = rotation3(self.landmarks[number][2])[: len(cross), : len(cross)]
            landmarks[number] = turn @ cross
        states = {n: rotation3(self.robots[n][2]) @ c for n, c in known.states.items()}
        return replace(known, states=states, landmarks=landmarks)

    def step(self, step: Step) -> Step:
        """The step with its starts in the new frame."""
        starts = {}
        for robot, start in step.starts.items():
            world = self.robots[robot]
            cov, *others = (
                None if cov is None else rotate_cov(cov, world[2])
                for cov in (start.cov, start.base_cov, start.world_cov)
            )
            assert cov is not None
            starts[robot] = Start(compose(world, start.pose), cov, *others)
        return replace(step, starts=starts)


def with_stamp_errors(base: Trajectory, track: Track, times_ns: IntArray) -> Trajectory:
    """Poses of a base at the stamps of its sensor, with the error of what these stamps mean.

    A latency found between two sensors does not tell which of them is late, and poses are given at
    the stamps of one. By half the square of the latency their times are uncertain: as likely it is
    this one's as the other's.

    Args:
        base: stamped by the sensor.
        track: the robot's odometry, its calibration the final one.
        times_ns: (n,) of the poses, as the track counts time.
    """
    late_s = 1e-9 * track.latency_ns
    if not late_s:
        return base
    around = times_ns - HALF_SPAN_NS, times_ns + HALF_SPAN_NS
    twist = log(between(*map(track.pose, around))) / (2e-9 * HALF_SPAN_NS)
    moved = (rotation3(base.poses[:, 2]) @ twist[:, :, None]) * late_s
    return replace(base, covs=base.covs + moved @ moved.mT / 2.0)


def origin_shift(start: Array, mounts: Array) -> Array:
    """World frames ``(..., 3)`` that bring a robot's *base* to its start pose.

    A prior puts the first state at ``start`` (3,), but states are rigid to the sensor, which sits
    at ``mounts`` (..., 3) from the base: ``start ∘ mount ∘ start⁻¹`` makes up for it.
    """
    return compose(compose(np.broadcast_to(start, mounts.shape), mounts), inverse(start))
