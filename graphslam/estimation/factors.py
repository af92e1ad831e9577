"""GTSAM factors, keys and noise models, made only here.

GTSAM's errors of a `Pose2` are in its body frame (`retract` is the exponential map), and a factor's
error is *expected minus measured*. Our covariances are of additive errors along the axes of the
frame in which a quantity is given; the conversions are here.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial

import gtsam
import numpy as np

from graphslam.core.config import RobustConfig
from graphslam.core.errors import EstimationError
from graphslam.core.geometry import (
    Array,
    between,
    compose,
    exp,
    is_positive,
    rotate_cov,
    rotation3,
    wrap,
)
from graphslam.core.observation_models import MODELS, LineModel
from graphslam.core.records import Association, Closure, Motion, Start

#: m: sigma of a line landmark's origin along the line, relative to the state that first saw it. A
#: gauge: no other factor has information along the line, and to first order its size changes no
#: other estimate. To second order the direction's error couples the position along the line with
#: the normal. A smoother relinearises, so its gauge is wide; in a filter, which does not, a wide
#: one makes the estimate overconfident at any noise (docs/ekf-versus-smoothing.md).
LINE_GAUGE_SIGMA_M = 1.0
FILTER_GAUGE_SIGMA_M = 1e-3
#: m: the same where lines stay as they face. The error does not depend on where a line's origin is
#: if the noise of its observations follows; where that is kept, a wide gauge would be pulled along
LINE_HELD_SIGMA_M = 1e-4
NO_KERNEL = RobustConfig("none")
#: rad: see `turns_little`
LITTLE_TURN_RAD = 3e-3

#: a symbol's letter is in its highest byte, its number in the others
FIRST_STATE, FIRST_LANDMARK = (int(gtsam.symbol(letter, 0)) for letter in "xl")
#: states of a robot, at most: from one robot's keys to the next one's
STATES = 1 << 40


def state_key(robot_index: int, number: int) -> int:
    """Key of a robot's state; up to 2^16 robots and 2^40 states each."""
    return FIRST_STATE | robot_index * STATES | number


def landmark_key(landmark: int) -> int:
    """Key of a landmark."""
    return FIRST_LANDMARK | landmark


def is_state(key: int) -> bool:
    """Whether a key is that of a state, else that of a landmark."""
    return key >= FIRST_STATE


def number_of(key: int) -> tuple[int | None, int]:
    """Index of the robot and number of its state, or None and the landmark's number."""
    if not is_state(key):
        return None, key - FIRST_LANDMARK
    return divmod(key - FIRST_STATE, STATES)


def pose2(pose: Array) -> gtsam.Pose2:
    """GTSAM pose of an array (3,)."""
    return gtsam.Pose2(float(pose[0]), float(pose[1]), float(pose[2]))


def array3(pose: gtsam.Pose2) -> Array:
    """Array (3,) of a GTSAM pose."""
    return np.array([pose.x(), pose.y(), pose.theta()])


def read(values: gtsam.Values, key: int, dim: int) -> Array:
    """Value (dim,) of a variable, m and rad."""
    return array3(values.atPose2(key)) if dim == 3 else np.asarray(values.atPoint2(key))


def read_poses(values: gtsam.Values) -> Array:
    """All poses (n, 3), m and rad, in the order of their keys: those of lines before states."""
    return np.ascontiguousarray(gtsam.utilities.extractPose2(values))


def write(values: gtsam.Values, key: int, value: Array) -> None:
    """Insert a variable with its value (2,) or (3,)."""
    values.insert(key, pose2(value) if len(value) == 3 else value)


def overwrite(values: gtsam.Values, key: int, value: Array) -> None:
    """Replace the value (2,) or (3,) of a variable."""
    values.update(key, pose2(value) if len(value) == 3 else value)


def retracted(point: Array, z: Array) -> Array:
    """A pose (..., 3) or point (..., 2) corrected by z, of that shape, in its tangent space."""
    return compose(point, exp(z)) if point.shape[-1] == 3 else point + z


def gaussian(cov: Array) -> gtsam.noiseModel.Base:
    """Noise model of a covariance (k, k).

    Raises:
        EstimationError: the covariance is not positive definite.
    """
    if not is_positive(cov):
        raise EstimationError(f"covariance is not positive definite: {cov.tolist()}")
    if len(cov) == 3:
        return gtsam.noiseModel.Gaussian.SqrtInformation(_square_root_information(cov), True)
    return gtsam.noiseModel.Gaussian.Covariance(cov)


def _square_root_information(cov: Array) -> Array:
    """Upper triangular R (3, 3) with RᵀR the inverse of a covariance (3, 3): M⁻¹ of MMᵀ = cov.

    GTSAM inverts the covariance first. Where its eigenvalues span ten decades, the weakest
    direction of the inverse is rounding; here it is as good as the covariance.
    """
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = cov.tolist()
    M33 = math.sqrt(tt)
    M13, M23 = xt / M33, yt / M33
    M22 = math.sqrt(yy - M23 * M23)
    M12 = (xy - M13 * M23) / M22
    M11 = math.sqrt(xx - M12 * M12 - M13 * M13)
    R11, R22, R33 = 1.0 / M11, 1.0 / M22, 1.0 / M33
    R13 = (M12 * M23 * R22 - M13) * R11 * R33
    return np.array([[R11, -M12 * R11 * R22, R13], [0.0, R22, -M23 * R22 * R33], [0.0, 0.0, R33]])


_KERNELS: dict[str, Callable[[float], gtsam.noiseModel.mEstimator.Base]] = {
    "huber": gtsam.noiseModel.mEstimator.Huber.Create,
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy.Create,
    "geman-mcclure": gtsam.noiseModel.mEstimator.GemanMcClure.Create,
}


def robust(noise: gtsam.noiseModel.Base, config: RobustConfig) -> gtsam.noiseModel.Base:
    """``noise`` under the configured kernel."""
    if config.kernel == "none":
        return noise
    return gtsam.noiseModel.Robust.Create(_kernel(config.kernel, config.scale), noise)


def _all_robust(
    noises: Iterable[gtsam.noiseModel.Base], config: RobustConfig
) -> Iterable[gtsam.noiseModel.Base]:
    """`robust` of many."""
    if config.kernel == "none":
        return noises
    return map(
        partial(gtsam.noiseModel.Robust.Create, _kernel(config.kernel, config.scale)), noises
    )


@lru_cache
def _kernel(name: str, scale: float) -> gtsam.noiseModel.mEstimator.Base:
    return _KERNELS[name](scale)


def start_factor(key: int, start: Start) -> gtsam.NonlinearFactor:
    """Prior on a robot's first state."""
    cov = rotate_cov(start.cov, -float(start.pose[2]))
    return gtsam.PriorFactorPose2(key, pose2(start.pose), gaussian(cov))


def motion_factor(
    key: int, next_key: int, motion: Motion, kernel: RobustConfig = NO_KERNEL
) -> gtsam.NonlinearFactor:
    """Odometry between two states of one robot, under the kernel of motions."""
    own = replace(kernel, kernel=kernel.motions)
    return relative_pose_factor(key, next_key, motion.delta, motion.cov, own)


def motion_factors(
    ends: Iterable[tuple[int, int]], delta: Array, cov: Array
) -> list[gtsam.NonlinearFactor]:
    """`motion_factor` of n motions, faster.

    ``ends`` are their two states; ``delta`` (n, 3), ``cov`` (n, 3, 3), all positive definite.
    """
    roots = map(_square_root_information, rotate_cov(cov, -delta[:, 2]))
    gaussians = (gtsam.noiseModel.Gaussian.SqrtInformation(root, True) for root in roots)
    moved = zip(ends, delta.tolist(), gaussians, strict=True)
    return [gtsam.BetweenFactorPose2(*keys, gtsam.Pose2(*z), noise) for keys, z, noise in moved]


def closure_factor(
    key: int, other_key: int, closure: Closure, kernel: RobustConfig
) -> gtsam.NonlinearFactor:
    """A measured relative pose: ``key`` seen from ``other_key``; with ``kernel`` if unverified.

    The kernel's scale grows with the root of the number n of images behind the closure: in its
    tails, where the cost is proportional to the scale squared, it then costs as much as n closures.
    """
    wide = replace(kernel, scale=kernel.scale * math.sqrt(closure.scan_count))
    kernel = NO_KERNEL if closure.verified else wide
    return relative_pose_factor(other_key, key, closure.delta, closure.cov, kernel)


def relative_pose_factor(
    key: int, next_key: int, delta: Array, cov: Array, kernel: RobustConfig
) -> gtsam.NonlinearFactor:
    """Between factor; ``cov`` is along the first frame's axes, GTSAM's along the second's."""
    noise = robust(gaussian(rotate_cov(cov, -float(delta[2]))), kernel)
    return gtsam.BetweenFactorPose2(key, next_key, pose2(delta), noise)


def _pose_observation(
    key: int, target: int, seen: Association, kernel: RobustConfig, _x: Array, _t: Array
) -> gtsam.NonlinearFactor:
    return relative_pose_factor(key, target, seen.z, seen.cov, kernel)


def _line_observation(
    key: int, target: int, seen: Association, kernel: RobustConfig, x: Array, t: Array
) -> gtsam.NonlinearFactor:
    """The measurement, slid along its line to face the landmark's origin at the estimate.

    The square root information has a zero first row: no information along the line.
    """
    return _line_factor(key, target, *_facing(seen.z, seen.cov, x, t), kernel)


def line_factors(
    keys: Sequence[int],
    targets: Sequence[int],
    z: Array,
    cov: Array,
    x: Array,
    t: Array,
    kernel: RobustConfig,
    *,
    sliding: bool = False,
) -> list[gtsam.NonlinearFactor]:
    """The factors of n lines, as `observation_factor` makes them, computed at once.

    ``z`` (n, 3) are the measurements, ``cov`` (n, 3, 3) their covariances, ``x`` (n, 3) and ``t``
    (n, 3) the estimates of the observing states and of the lines. ``sliding``: see `line_rows`.
    """
    facing, roots = _facing(z, cov, x, t, sliding=sliding)
    create = gtsam.noiseModel.Gaussian.SqrtInformation
    noises = _all_robust((create(root, False) for root in roots), kernel)
    made = zip(keys, targets, facing.tolist(), noises, strict=True)
    return [gtsam.BetweenFactorPose2(a, b, gtsam.Pose2(*z), noise) for a, b, z, noise in made]


def _facing(
    z: Array, cov: Array, x: Array, t: Array, *, sliding: bool = False
) -> tuple[Array, Array]:
    """Lines (..., 3) facing their landmarks, and square root information (..., 3, 3)."""
    model = LineModel()
    R = np.zeros(cov.shape)
    # upper triangular U with UᵀU = V⁻¹: from the Cholesky factor of the inverse
    R[..., 1:, 1:] = np.linalg.cholesky(np.linalg.inv(model.noise(z, cov, x, t))).mT
    if sliding:
        R[..., 1:, :] = R[..., 1:, 1:] @ line_rows(z, x, t)
    return model.facing(z, x, t), R


def line_rows(z: Array, x: Array, t: Array) -> Array:
    """Rows (..., 2, 3) that take GTSAM's residual of a line to normal offset and direction.

    Where a line's origin is tells nothing. But the logarithm turns the residual by half of that of
    the direction, so that its normal part changes as the origin slides along the line: lines and
    states would be pulled along. With tan of that half, the sum of both parts changes no more;
    for the measurement that faces the origin it is the normal part itself. Second order: only
    what is said to be at its minimum needs it.
    """
    slope = np.tan(wrap(t[..., 2] - x[..., 2] - z[..., 2]) / 2)
    rows = np.zeros((*slope.shape, 2, 3))
    rows[..., 0, 1] = 1.0 / (1.0 - slope**2)
    rows[..., 0, 0] = -slope * rows[..., 0, 1]
    rows[..., 1, 2] = 1.0
    return rows


def _line_factor(
    key: int, target: int, z: Array, R: Array, kernel: RobustConfig
) -> gtsam.NonlinearFactor:
    noise = robust(gtsam.noiseModel.Gaussian.SqrtInformation(R, False), kernel)
    return gtsam.BetweenFactorPose2(key, target, pose2(z), noise)


_FactorMaker = Callable[[int, int, Association, RobustConfig, Array, Array], gtsam.NonlinearFactor]


def _bearing_range(factor: Callable[..., gtsam.NonlinearFactor]) -> _FactorMaker:
    """Maker of a bearing-range ``factor`` to a point or to a pose."""
    return lambda key, target, seen, kernel, _x, _t: factor(
        key,
        target,
        gtsam.Rot2(float(seen.z[0])),
        float(seen.z[1]),
        robust(gaussian(seen.cov), kernel),
    )


#: rows of `MODELS` whose measurements are bearing and range -> their factor
BEARING_RANGE: dict[str, type[gtsam.NonlinearFactor]] = {
    "point": gtsam.BearingRangeFactor2D,
    "robot-point": gtsam.BearingRangeFactorPose2,
}
#: row of `MODELS` -> its factor
FACTORS: dict[str, _FactorMaker] = {
    "point": _bearing_range(BEARING_RANGE["point"]),
    "line": _line_observation,
    "segment": _pose_observation,
    "robot-pose": _pose_observation,
    "robot-point": _bearing_range(BEARING_RANGE["robot-point"]),
}


def bearing_range_factors(
    model: str,
    keys: Sequence[int],
    targets: Sequence[int],
    z: Array,
    cov: Array,
    kernel: RobustConfig,
) -> list[gtsam.NonlinearFactor]:
    """The factors of n bearings and ranges, as `observation_factor` makes them, faster.

    ``model`` is of `BEARING_RANGE`; ``z`` (n, 2) are the measurements, ``cov`` (n, 2, 2) their
    covariances, all positive definite.
    """
    # many sensors state one covariance for all: equal ones share a noise model
    first: dict[bytes, int] = {}
    like = [first.setdefault(one.tobytes(), k) for k, one in enumerate(cov)]
    several = list(first.values())
    made = _all_robust(map(gtsam.noiseModel.Gaussian.Covariance, cov[several]), kernel)
    noises = map(dict(zip(several, made, strict=True)).__getitem__, like)
    bearings = map(gtsam.Rot2, z[:, 0].tolist())
    return list(map(BEARING_RANGE[model], keys, targets, bearings, z[:, 1].tolist(), noises))


def observation_factor(
    key: int, target: int, seen: Association, kernel: RobustConfig, x: Array, t: Array
) -> gtsam.NonlinearFactor:
    """Factor of an observation from state ``key`` of a landmark or another robot's state.

    It is built at the estimates ``x`` (3,) of the observing state and ``t`` (2,) or (3,) of the
    target.
    """
    return FACTORS[seen.model](key, target, seen, kernel, x, t)


def line_gauge_factor(
    key: int, target: int, seen: Association, *, wide: bool = True
) -> gtsam.NonlinearFactor:
    """Fixes a new line landmark's origin along its line; ``wide`` for smoothers, not for filters.

    See `LINE_GAUGE_SIGMA_M`.
    """
    R = np.diag([1.0 / (LINE_GAUGE_SIGMA_M if wide else FILTER_GAUGE_SIGMA_M), 0.0, 0.0])
    return _line_factor(key, target, seen.z, R, NO_KERNEL)


def line_held_factor(key: int, target: int, x: Array, t: Array) -> gtsam.NonlinearFactor:
    """Holds a line's origin where its estimate (3,) has it, along the line, seen from a state (3,).

    See `LINE_HELD_SIGMA_M`.
    """
    R = np.diag([1.0 / LINE_HELD_SIGMA_M, 0.0, 0.0])
    return _line_factor(key, target, between(x, t), R, NO_KERNEL)


def turns_little(factor: gtsam.BetweenFactorPose2, values: Mapping[int, Array]) -> bool:
    """Whether a factor's residual turns so little that GTSAM's Jacobian has lost digits.

    Pose2::LogmapDerivative has sin α / (1 - cos α) - 2 / α for |α| > 1e-5 rad, whose rounding grows
    as α⁻³: one digit is left at 1e-5, six at 1e-4, nine at 1e-3.
    """
    key, target = factor.keys()
    turn = values[target][2] - values[key][2] - factor.measured().theta()
    return 1e-10 < abs(math.remainder(turn, math.tau)) < LITTLE_TURN_RAD


def linearised(
    factor: gtsam.BetweenFactorPose2, values: Mapping[int, Array]
) -> tuple[Array, Array]:
    """``factor.linearize`` with all digits, by the row of `MODELS`: A (k, 6) and b (k,).

    Its noise is Gaussian, without a kernel.
    """
    x, t = (values[key] for key in factor.keys())  # noqa: SIM118 (it is no mapping)
    z, model = array3(factor.measured()), MODELS["segment"]
    H_x, H_t = model.jacobians(z, x, t)
    noise = factor.noiseModel()
    assert isinstance(noise, gtsam.noiseModel.Gaussian)
    R = noise.R()
    A = R @ np.hstack([H_x @ rotation3(x[2]), H_t @ rotation3(t[2])])
    return A, -R @ model.residual(z, x, t)


def known_landmark_factor(
    numbers: Sequence[int], row: Array, means: Mapping[int, Array]
) -> gtsam.NonlinearFactor:
    """Whitened rows of the errors of known landmarks about their means, see `KnownLandmarks`.

    A `gtsam.LinearContainerFactor` has these rows wherever it is linearised.
    """
    keys = [landmark_key(number) for number in numbers]
    values, terms, end = gtsam.Values(), [], 0
    for key, number in zip(keys, numbers, strict=True):
        begin, end = end, end + len(means[number])
        terms.append((key, row[:, begin:end]))
        write(values, key, means[number])
    # a JacobianFactor is made of three variables at most; a conditional is one, of any number
    unit = gtsam.noiseModel.Unit.Create(len(row))
    made = gtsam.GaussianConditional(terms, 1, np.zeros(len(row)), unit)
    return gtsam.LinearContainerFactor(made, values)
