"""The only place that makes GTSAM factors, keys and noise models.

GTSAM's errors of a `Pose2` live in its body frame (`retract` is the exponential map) and a factor's
error is *expected minus measured*. Our covariances are of additive errors along the axes of the
frame a quantity is given in; the conversions are here.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from graphslam.core.config import RobustConfig
from graphslam.core.errors import EstimationError
from graphslam.core.geometry import Array, is_positive, rotate_cov, rotation3
from graphslam.core.observation_models import LineModel
from graphslam.core.records import Association, Closure, Motion, Start

#: m: where on a wall a line landmark's origin sits, relative to the state that first saw it. A
#: gauge: the only factor with information along the line. To first order its size changes no other
#: estimate. To second order the direction's error couples what lies along the line with the normal:
#: a smoother leaves that to the gauge, so it is wide; a filter never linearises anew, and a wide
#: one makes it overconfident at any noise (docs/ekf-versus-smoothing.md).
LINE_GAUGE_SIGMA_M = 1.0
FILTER_GAUGE_SIGMA_M = 1e-3


#: a symbol's letter is in its highest byte, its number in the others
FIRST_STATE, FIRST_LANDMARK = (int(gtsam.symbol(letter, 0)) for letter in "xl")


def state_key(robot_index: int, number: int) -> int:
    """Key of a robot's state; up to 2^16 robots and 2^40 states each."""
    return FIRST_STATE | robot_index << 40 | number


def landmark_key(landmark: int) -> int:
    """Key of a landmark."""
    return FIRST_LANDMARK | landmark


def is_state(key: int) -> bool:
    """Whether a key is that of a state; that of a landmark else."""
    return key >= FIRST_STATE


def number_of(key: int) -> tuple[int | None, int]:
    """Whose state a key is (index of the robot) and which, or None and the landmark's number."""
    if not is_state(key):
        return None, key - FIRST_LANDMARK
    return divmod(key - FIRST_STATE, 1 << 40)


def pose2(pose: Array) -> gtsam.Pose2:
    """Array (3,) to GTSAM."""
    return gtsam.Pose2(float(pose[0]), float(pose[1]), float(pose[2]))


def array3(pose: gtsam.Pose2) -> Array:
    """GTSAM pose to array (3,)."""
    return np.array([pose.x(), pose.y(), pose.theta()])


def world_from_body(heading_rad: float) -> Array:
    """Matrix (3, 3) that turns body-frame errors of a pose into additive world-axis errors."""
    return rotation3(heading_rad)


def gaussian(cov: Array) -> gtsam.noiseModel.Base:
    """Noise model of a covariance (k, k).

    Raises:
        EstimationError: the covariance is not positive definite.
    """
    if not is_positive(cov):
        raise EstimationError(f"covariance is not positive definite: {cov.tolist()}")
    return gtsam.noiseModel.Gaussian.Covariance(cov)


_KERNELS: dict[str, Callable[[float], gtsam.noiseModel.mEstimator.Base]] = {
    "huber": gtsam.noiseModel.mEstimator.Huber.Create,
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy.Create,
    "geman-mcclure": gtsam.noiseModel.mEstimator.GemanMcClure.Create,
}


def robust(noise: gtsam.noiseModel.Base, config: RobustConfig) -> gtsam.noiseModel.Base:
    """``noise`` under the configured kernel."""
    if config.kernel == "none":
        return noise
    return gtsam.noiseModel.Robust.Create(_KERNELS[config.kernel](config.scale), noise)


def start_factor(key: int, start: Start) -> gtsam.NonlinearFactor:
    """Prior on a robot's first state."""
    cov = rotate_cov(start.cov, -float(start.pose[2]))
    return gtsam.PriorFactorPose2(key, pose2(start.pose), gaussian(cov))


def motion_factor(key: int, next_key: int, motion: Motion) -> gtsam.NonlinearFactor:
    """Odometry between two states of one robot."""
    return relative_pose_factor(key, next_key, motion.delta, gaussian, motion.cov)


def closure_factor(
    key: int, other_key: int, closure: Closure, kernel: RobustConfig
) -> gtsam.NonlinearFactor:
    """A measured relative pose: ``key`` seen from ``other_key``; under ``kernel`` if unverified.

    The kernel of n images' closure is wider by the root of n: far off, where a kernel's cost grows
    with its scale squared, it then costs what n observations of one image each would.
    """
    wide = replace(kernel, scale=kernel.scale * math.sqrt(closure.images))

    def noise(cov: Array) -> gtsam.noiseModel.Base:
        return gaussian(cov) if closure.verified else robust(gaussian(cov), wide)

    return relative_pose_factor(other_key, key, closure.delta, noise, closure.cov)


def relative_pose_factor(
    key: int,
    next_key: int,
    delta: Array,
    noise: Callable[[Array], gtsam.noiseModel.Base],
    cov: Array,
) -> gtsam.NonlinearFactor:
    """Between factor; ``cov`` along the first frame's axes, GTSAM wants the measured frame's."""
    turned = rotate_cov(cov, -float(delta[2]))
    return gtsam.BetweenFactorPose2(key, next_key, pose2(delta), noise(turned))


def _pose_observation(
    key: int, target: int, seen: Association, kernel: RobustConfig, _x: Array, _t: Array
) -> gtsam.NonlinearFactor:
    noise = robust(gaussian(rotate_cov(seen.cov, -float(seen.z[2]))), kernel)
    return gtsam.BetweenFactorPose2(key, target, pose2(seen.z), noise)


def _line_observation(
    key: int, target: int, seen: Association, kernel: RobustConfig, x: Array, t: Array
) -> gtsam.NonlinearFactor:
    """The measurement, moved along its line to face the landmark's origin at the estimate.

    The square root information has a zero first row: nothing is known along the line.
    """
    faced, R = _facing(seen.z, seen.cov, x, t)
    return _line_factor(key, target, faced, R, kernel)


def line_factors(
    keys: Sequence[int],
    targets: Sequence[int],
    z: Array,
    cov: Array,
    x: Array,
    t: Array,
    kernel: RobustConfig,
) -> list[gtsam.NonlinearFactor]:
    """What `observation_factor` makes of n lines, at once.

    Args:
        keys: the observing states.
        targets: the lines' keys.
        z: (n, 3) measurements.
        cov: (n, 3, 3) their covariances.
        x: (n, 3) estimates of the states.
        t: (n, 3) estimates of the lines.
        kernel: robust kernel.
    """
    return [
        _line_factor(*made, kernel)
        for made in zip(keys, targets, *_facing(z, cov, x, t), strict=True)
    ]


def _facing(z: Array, cov: Array, x: Array, t: Array) -> tuple[Array, Array]:
    """Lines (..., 3) that face their landmarks, square root information (..., 3, 3)."""
    model = LineModel()
    R = np.zeros(cov.shape)
    # upper triangular U with UᵀU = V⁻¹: from the Cholesky factor of the inverse
    R[..., 1:, 1:] = np.linalg.cholesky(np.linalg.inv(model.noise(z, cov, x, t))).mT
    return model.facing(z, x, t), R


def _line_factor(
    key: int, target: int, faced: Array, R: Array, kernel: RobustConfig
) -> gtsam.NonlinearFactor:
    noise = robust(gtsam.noiseModel.Gaussian.SqrtInformation(R, False), kernel)
    return gtsam.BetweenFactorPose2(key, target, pose2(faced), noise)


def _point_observation(
    key: int, target: int, seen: Association, kernel: RobustConfig, _x: Array, _t: Array
) -> gtsam.NonlinearFactor:
    bearing, range_m = gtsam.Rot2(float(seen.z[0])), float(seen.z[1])
    return gtsam.BearingRangeFactor2D(
        key, target, bearing, range_m, robust(gaussian(seen.cov), kernel)
    )


def _robot_point_observation(
    key: int, target: int, seen: Association, kernel: RobustConfig, _x: Array, _t: Array
) -> gtsam.NonlinearFactor:
    bearing, range_m = gtsam.Rot2(float(seen.z[0])), float(seen.z[1])
    return gtsam.BearingRangeFactorPose2(
        key, target, bearing, range_m, robust(gaussian(seen.cov), kernel)
    )


_FactorMaker = Callable[[int, int, Association, RobustConfig, Array, Array], gtsam.NonlinearFactor]

#: row of `MODELS` -> its factor
FACTORS: dict[str, _FactorMaker] = {
    "point": _point_observation,
    "line": _line_observation,
    "segment": _pose_observation,
    "robot-pose": _pose_observation,
    "robot-point": _robot_point_observation,
}


def observation_factor(
    key: int, target: int, seen: Association, kernel: RobustConfig, x: Array, t: Array
) -> gtsam.NonlinearFactor:
    """Factor between a state and what was observed from it.

    Args:
        key: the observing state.
        target: key of the landmark, or of the observed robot's state.
        seen: the association.
        kernel: robust kernel.
        x: estimate (3,) of the observing state, where the factor is built.
        t: estimate of the target.
    """
    return FACTORS[seen.model](key, target, seen, kernel, x, t)


def line_gauge_factor(
    key: int, target: int, seen: Association, *, wide: bool = True
) -> gtsam.NonlinearFactor:
    """Ties a new line landmark's origin along its line; see `LINE_GAUGE_SIGMA_M`.

    ``wide`` for smoothers, not for filters.
    """
    R = np.zeros((3, 3))
    R[0, 0] = 1.0 / (LINE_GAUGE_SIGMA_M if wide else FILTER_GAUGE_SIGMA_M)
    noise = gtsam.noiseModel.Gaussian.SqrtInformation(R, False)
    return gtsam.BetweenFactorPose2(key, target, pose2(seen.z), noise)
