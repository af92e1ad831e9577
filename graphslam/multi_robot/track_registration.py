"""Start of a robot in the frame of one that saw it: least squares with correlated errors.

Unknowns are the robot's start pose and the offset of its clock. Residuals are where it was seen
minus where it estimated itself to be. They are correlated: an odometry error before one sighting
stays in all that follow, so the joint covariance of all residuals is needed; with that of each
alone, many sightings would seem to determine more than they do.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.consistency import (
    FIT_PROBABILITY,
    LeastSquaresFit,
    generalised_least_squares,
    leave_one_out_distances,
)
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, compose, rotation, rotation3, wrap
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Sighting
from graphslam.multi_robot.relative_frames import RobotEstimate, encounter_covariance

#: Gauss-Newton steps; s: span over which a robot's velocity is taken
STEPS, VELOCITY_SPAN_S = 6, 0.3
#: least number of sightings: with two rows each, more rows than the four unknowns
MIN_SIGHTINGS = 3


@dataclass(frozen=True, slots=True, eq=False)
class FittedStart:
    """Start of a robot in its observer's frame: ``pose`` (3,), ``cov`` (3, 3) along its axes.

    ``clock_offset_s``: what the robot's clock reads more than its observer's; ``used``: indices of
    the sightings that are no outliers; ``heading_sigma`` rad of the robot's heading relative to the
    observer when it was seen, without both robots' drift.
    """

    pose: Array
    cov: Array
    clock_offset_s: float
    used: IntArray
    heading_sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class _ObservedPath:
    """Where a robot was seen at n times: ``points`` (n, 2), joint ``cov`` (n, n, 2, 2)."""

    times_ns: IntArray
    points: Array
    cov: Array

    def subset(self, use: IntArray) -> "_ObservedPath":
        return _ObservedPath(self.times_ns[use], self.points[use], self.cov[np.ix_(use, use)])


def fit_start(
    pose: Array,
    clock_offset_s: float,
    sightings: Sequence[Sighting],
    observer: RobotEstimate,
    robot: RobotEstimate,
    clock_sigma_s: float,
) -> FittedStart | None:
    """Start of a robot in its observer's frame.

    Sightings that all others contradict are removed, the worst first.

    Args:
        pose: (3,) initial guess.
        clock_offset_s: initial guess.
        sightings: n of the robot, bearing and range, in order of time.
        observer: estimate of the observer by itself.
        robot: estimate of the robot by itself.
        clock_sigma_s: sigma of the prior on the clock offset, whose mean is 0.

    Returns:
        None if too few sightings are left.
    """
    if len(sightings) < MIN_SIGHTINGS:
        return None
    times_ns = np.array([s.time_ns for s in sightings], dtype=np.int64)
    path = _observed_path(sightings, times_ns, observer)
    cov = odometry_cross_covariance(robot, times_ns)[:, :, :2, :2]
    use = np.arange(len(sightings))
    x = np.append(pose, clock_offset_s)
    while len(use) >= MIN_SIGHTINGS:
        x, fit = _gauss_newton(x, path.subset(use), cov[np.ix_(use, use)], robot, clock_sigma_s)
        d2 = leave_one_out_distances(fit.information, fit.residuals.reshape(-1, 2))
        if d2.max() <= chi2_quantile(FIT_PROBABILITY, 2):
            first_ns = int(times_ns[use[0]])
            drift = encounter_covariance(
                x[:3], observer, robot, first_ns, first_ns + round(1e9 * x[3])
            )
            start = np.append(x[:2], wrap(x[2]))
            heading_sigma = float(np.sqrt(fit.cov[2, 2]))
            return FittedStart(start, fit.cov[:3, :3] + drift, float(x[3]), use, heading_sigma)
        use = np.delete(use, d2.argmax())
    return None


def _gauss_newton(
    x: Array, path: _ObservedPath, cov: Array, robot: RobotEstimate, clock_sigma_s: float
) -> tuple[Array, LeastSquaresFit]:
    """Start pose and clock offset (4,), from a guess ``x`` (4,), and the fit of the last step.

    ``cov`` (n, n, 2, 2) is that of the robot's positions along its axes at the first time.
    """
    n, half_ns = len(path.points), round(1e9 * VELOCITY_SPAN_S / 2)
    prior = np.diag([0.0, 0.0, 0.0, clock_sigma_s**-2])
    for _ in range(STEPS):
        times = path.times_ns + round(1e9 * x[3])
        y, _ = robot.at(times)
        ahead, behind = (robot.at(times + shift)[0][:, :2] for shift in (half_ns, -half_ns))
        turn = rotation(float(x[2] + y[0, 2]))
        S = (path.cov + turn @ cov @ turn.T).transpose(0, 2, 1, 3).reshape(2 * n, -1)
        predicted = compose(x[:3], y)[:, :2]
        lever = predicted - x[:2]
        J = np.zeros((n, 2, 4))
        J[:, :, :2] = np.eye(2)
        J[:, 0, 2], J[:, 1, 2] = -lever[:, 1], lever[:, 0]
        J[:, :, 3] = (ahead - behind) @ rotation(float(x[2])).T / VELOCITY_SPAN_S
        residuals = (path.points - predicted).ravel()
        fit = generalised_least_squares(J.reshape(-1, 4), residuals, S, prior, -prior @ x)
        x = x + fit.x
    return x, fit


def _observed_path(
    sightings: Sequence[Sighting], times_ns: IntArray, observer: RobotEstimate
) -> _ObservedPath:
    """Where a robot was seen in its observer's frame."""
    poses, _ = observer.at(times_ns)
    lasers = compose(poses, np.array([s.mount for s in sightings]))
    z = np.array([s.z[:2] for s in sightings])
    R = np.array([s.cov[:2, :2] for s in sightings])
    points, (_, J) = MODELS["point"].invert(z, lasers), MODELS["point"].invert_jacobians(z, lasers)
    lever = points - poses[:, :2]
    H = np.tile(np.eye(2, 3), (len(z), 1, 1))
    H[:, 0, 2], H[:, 1, 2] = -lever[:, 1], lever[:, 0]
    turn = rotation3(float(poses[0, 2]))
    cov = H[:, None] @ (turn @ odometry_cross_covariance(observer, times_ns) @ turn.T) @ H[None].mT
    k = np.arange(len(z))
    cov[k, k] += J @ R @ J.mT
    return _ObservedPath(times_ns, points, cov)


def odometry_cross_covariance(robot: RobotEstimate, times_ns: IntArray) -> Array:
    """Joint covariance (n, n, 3, 3) of a robot's poses at n times relative to that at the first.

    By odometry, along the robot's axes at the first time. An error before one time stays in all
    later ones, a heading error grows with what is driven afterwards; the calibration error is the
    same throughout.

    Args:
        robot: estimate of the robot by itself.
        times_ns: (n,), ascending.
    """
    moved = robot.track.motions(np.full_like(times_ns, times_ns[0]), times_ns)
    n, at = len(times_ns), moved.delta[:, :2]
    k = np.arange(n)
    calibration = moved.d_cal[:, None] @ robot.track.calibration.cov @ moved.d_cal[None].mT
    # the floor is added once to every motion, however short, and does not accumulate
    drove = (moved.length_m > 0) | (moved.delta[:, 2] != 0)
    once = np.where(drove[:, None, None], robot.track.floor_cov, 0.0)
    walk = moved.cov - calibration[k, k] - once
    F = np.tile(np.eye(3), (n, n, 1, 1))
    F[..., 0, 2] = at[:, None, 1] - at[None, :, 1]
    F[..., 1, 2] = at[None, :, 0] - at[:, None, 0]
    later = walk[:, None] @ F.mT  # of the error at the first index with that at a later second one
    upper = (k[:, None] <= k)[..., None, None]
    joint = np.where(upper, later, later.transpose(1, 0, 3, 2)) + calibration
    joint[k, k] += once
    return np.asarray(joint)
