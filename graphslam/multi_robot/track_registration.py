"""Where a robot began in the frame of one that saw it: weighted least squares with all correlation.

Unknowns are the pose at which the robot began and by how much its clock is late. Residuals are
where it was seen minus where it says it was. They go together: what odometry got wrong up to one
sighting stays wrong in all that follow, so the covariance of all residuals is needed, not that of
each, or many sightings would seem to know more than they do.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from graphslam.core.consistency import FIT
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, compose, rotation, rotation3, wrap
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Sighting
from graphslam.multi_robot.relative_frames import RobotEstimate, encounter_covariance
from graphslam.odometry.readings import IntArray

#: Gauss-Newton steps
STEPS = 6
#: s: over which a robot's velocity is taken
SPEED_S = 0.3
#: sightings at least
FEWEST = 3


@dataclass(frozen=True, slots=True, eq=False)
class FittedStart:
    """Where a robot began in its observer's frame: ``pose`` (3,), ``cov`` (3, 3) along its axes.

    ``late_s``: what the robot's clock reads more when it is where it was seen; ``used``: which
    sightings this is from; ``turn_sigma`` rad of how the robot was turned when it was seen.
    """

    pose: Array
    cov: Array
    late_s: float
    used: IntArray
    turn_sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class _ObservedPath:
    """Where a robot was seen at n times: ``at`` (n, 2), ``cov`` (n, n, 2, 2) of all together."""

    times_ns: IntArray
    at: Array
    cov: Array

    def some(self, use: IntArray) -> "_ObservedPath":
        return _ObservedPath(self.times_ns[use], self.at[use], self.cov[np.ix_(use, use)])


def fit_start(
    pose: Array,
    late_s: float,
    sightings: Sequence[Sighting],
    observer: RobotEstimate,
    robot: RobotEstimate,
    doubt_s: float,
) -> FittedStart | None:
    """Where a robot began in its observer's frame.

    Sightings that contradict all others leave, one by one.

    Args:
        pose: (3,) about where.
        late_s: about how late.
        sightings: n of the robot, bearing and range, in order of time.
        observer: what the observer knows by itself.
        robot: what the robot knows by itself.
        doubt_s: sigma of the difference of the clocks.

    Returns:
        None if too few sightings are left.
    """
    if len(sightings) < FEWEST:
        return None
    points, theirs = (
        _observed_path(sightings, observer),
        odometry_cross_covariance(robot, _times(sightings))[:, :, :2, :2],
    )
    use = np.arange(len(sightings))
    x = np.append(pose, late_s)
    while len(use) >= FEWEST:
        fit = _gauss_newton(x, points.some(use), theirs[np.ix_(use, use)], robot, doubt_s)
        x = fit.x
        if fit.d2.max() <= chi2_quantile(FIT, 2):
            first_ns = int(points.times_ns[use[0]])
            late_ns = round(1e9 * x[3])
            cov = fit.cov + encounter_covariance(
                x[:3], observer, robot, first_ns, first_ns + late_ns
            )
            turn_sigma = float(np.sqrt(fit.cov[2, 2]))
            return FittedStart(np.append(x[:2], wrap(x[2])), cov, float(x[3]), use, turn_sigma)
        use = np.delete(use, fit.d2.argmax())
    return None


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Pose and lateness (4,), covariance (3, 3) of the pose, how far off each sighting is (n,).

    ``d2``: as all others have it, squared, in sigmas.
    """

    x: Array
    cov: Array
    d2: Array


def _gauss_newton(
    x: Array, points: _ObservedPath, theirs: Array, robot: RobotEstimate, doubt_s: float
) -> _Fit:
    """Gauss-Newton steps from ``x`` (4,); ``theirs`` (n, n, 2, 2) along the robot's first axes."""
    count, apart_ns = len(points.at), round(1e9 * SPEED_S / 2)
    prior = np.diag([0.0, 0.0, 0.0, doubt_s**-2])
    for _ in range(STEPS):
        times = points.times_ns + round(1e9 * x[3])
        y, _ = robot.at(times)
        ahead, behind = (robot.at(times + way)[0][:, :2] for way in (apart_ns, -apart_ns))
        turn = rotation(float(x[2] + y[0, 2]))
        S = (points.cov + turn @ theirs @ turn.T).transpose(0, 2, 1, 3).reshape(2 * count, -1)
        at = compose(x[:3], y)[:, :2]
        off = at - x[:2]
        by = np.zeros((count, 2, 4))
        by[:, :, :2] = np.eye(2)
        by[:, 0, 2], by[:, 1, 2] = -off[:, 1], off[:, 0]
        by[:, :, 3] = (ahead - behind) @ rotation(float(x[2])).T / SPEED_S
        A = by.reshape(-1, 4)
        e = (points.at - at).ravel()
        factor = cho_factor(S)
        N = A.T @ cho_solve(factor, A) + prior
        x = x + np.linalg.solve(N, A.T @ cho_solve(factor, e) - prior @ x)
    information = cho_solve(factor, np.eye(2 * count))
    u = (information @ e).reshape(-1, 2)
    k = np.arange(count)
    own = information.reshape(count, 2, count, 2)[k, :, k]
    d2 = (u * np.linalg.solve(own, u[:, :, None])[:, :, 0]).sum(axis=1)
    scale = max(1.0, float(e @ information @ e) / max(2 * count - 4, 1))
    return _Fit(x, scale * np.linalg.inv(N)[:3, :3], d2)


def _times(sightings: Sequence[Sighting]) -> IntArray:
    return np.array([s.time_ns for s in sightings], dtype=np.int64)


def _observed_path(sightings: Sequence[Sighting], observer: RobotEstimate) -> _ObservedPath:
    """Where a robot was seen in its observer's frame."""
    times = _times(sightings)
    poses, _ = observer.at(times)
    lasers = compose(poses, np.array([s.mount for s in sightings]))
    z = np.array([s.z[:2] for s in sightings])
    R = np.array([s.cov[:2, :2] for s in sightings])
    at, (_, J) = MODELS["point"].invert(z, lasers), MODELS["point"].invert_jacobians(z, lasers)
    lever = at - poses[:, :2]
    H = np.tile(np.eye(2, 3), (len(z), 1, 1))
    H[:, 0, 2], H[:, 1, 2] = -lever[:, 1], lever[:, 0]
    turn = rotation3(float(poses[0, 2]))
    cov = H[:, None] @ (turn @ odometry_cross_covariance(observer, times) @ turn.T) @ H[None].mT
    k = np.arange(len(z))
    cov[k, k] += J @ R @ J.mT
    return _ObservedPath(times, at, cov)


def odometry_cross_covariance(view: RobotEstimate, times_ns: IntArray) -> Array:
    """How errors of a robot's poses since the first of n times go together: (n, n, 3, 3).

    By odometry, along its axes at the first. What went wrong up to one time stays wrong, its
    heading with all that is driven afterwards; the calibration is wrong all the time.

    Args:
        view: what the robot knows by itself.
        times_ns: (n,), ascending.
    """
    moved = view.track.motions(np.full_like(times_ns, times_ns[0]), times_ns)
    n, at = len(times_ns), moved.delta[:, :2]
    k = np.arange(n)
    calibration = moved.d_cal[:, None] @ view.track.calibration.cov @ moved.d_cal[None].mT
    # what every motion has, however short, does not grow along the way
    drove = (moved.length_m > 0) | (moved.delta[:, 2] != 0)
    once = np.where(drove[:, None, None], view.track.floor, 0.0)
    walk = moved.cov - calibration[k, k] - once
    F = np.tile(np.eye(3), (n, n, 1, 1))
    F[..., 0, 2] = at[:, None, 1] - at[None, :, 1]
    F[..., 1, 2] = at[None, :, 0] - at[:, None, 0]
    later = walk[:, None] @ F.mT  # the error at the first index with that at the second, later one
    upper = (k[:, None] <= k)[..., None, None]
    together = np.where(upper, later, later.transpose(1, 0, 3, 2)) + calibration
    together[k, k] += once
    return np.asarray(together)
