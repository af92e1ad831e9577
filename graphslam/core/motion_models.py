"""Motion models: from wheels and odometry to increments with covariance (thesis 2.1, 4.8-4.15).

Every source of motion is brought to *twists*: motion on a circle segment, ``exp(twist)``. A twist
has two kinds of error. The white one is fresh in every increment, so its variance adds up. The
calibration error (a wrong wheel radius, a scale, a drift per metre) is one constant for much
longer than an interval between two states, so within an interval its *effect* adds up; the thesis
treats it as white (see docs/thesis.md for why that misstates it).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.geometry import Array, compose, exp, exp_jacobian, inverse, rotation3, wrap

#: a calibration parameter whose prior sigma is smaller, in any unit, is held
HELD_SIGMA = 1e-6
#: parameters of a calibration that are the mount of the sensor
MOUNT_NAMES = ("laser_x_m", "laser_y_m", "laser_yaw_rad")
#: 1/m: the shortening of the path by `command_increments` grows up to this curvature; robots that
#: turn more tightly hardly drive at all
MAX_CURVATURE_PER_M = 6.0

#: settings of the model error: its variances along each axis per metre, radian and second
RATES = tuple(f"k_{axis}_{unit}" for axis in ("x", "y", "phi") for unit in ("m", "rad", "s"))


def wheel_twist(angles_rad: Array, robot: RobotConfig) -> Array:
    """Twists ``(n, 3)`` (path m, 0, turning rad) of wheel rotations ``(n, 2)`` (left, right) rad.

    Thesis eq. 2.6 and 2.7, counter-clockwise positive: right wheel minus left.
    """
    left = robot.wheel_radius_left_m * angles_rad[:, 0]
    right = robot.wheel_radius_right_m * angles_rad[:, 1]
    return np.column_stack([(left + right) / 2, np.zeros(len(left)), (right - left) / robot.axle_m])


def wheel_jacobian(angles_rad: Array, robot: RobotConfig) -> Array:
    """Derivative ``(n, 3, 5)`` of the twists by (r_l, r_r, turn_l, turn_r, axle), eq. 4.11-4.13.

    The thesis differentiates the relative pose; that is this times `exp_jacobian` of the twist.
    """
    left, right = angles_rad[:, 0], angles_rad[:, 1]
    r_l, r_r, axle = robot.wheel_radius_left_m, robot.wheel_radius_right_m, robot.axle_m
    J = np.zeros((len(left), 3, 5))
    J[:, 0, 0], J[:, 0, 1], J[:, 0, 2], J[:, 0, 3] = left / 2, right / 2, r_l / 2, r_r / 2
    J[:, 2, 0], J[:, 2, 1] = -left / axle, right / axle
    J[:, 2, 2], J[:, 2, 3] = -r_l / axle, r_r / axle
    J[:, 2, 4] = -(r_r * right - r_l * left) / axle**2
    return J


def model_error_cov(
    twists: Array, seconds: Array, config: OdometryConfig, rates: Array | None = None
) -> Array:
    """Covariance ``(n, 3, 3)`` of the white model error of motions ``(n, 3)``, eq. 4.14.

    Along the axes of each increment's start frame; linear in path, turning and the ``seconds``
    (n,) in motion, so it does not depend on how finely the odometry is sampled. ``rates`` (n, 9),
    in the order of `RATES`, are those of each motion; without, all have those of ``config``.
    """
    used = rates_of_config(config) if rates is None else rates
    cov = np.zeros((len(twists), 3, 3))
    by_axis = used.reshape(-1, 3, 3) @ _amounts(twists, seconds)[:, :, None]
    cov[:, range(3), range(3)] = by_axis[:, :, 0]
    return cov


def rates_of_config(config: OdometryConfig) -> Array:
    """The rates (9,) of the model error by settings, in the order of `RATES`."""
    return np.array([getattr(config, name) for name in RATES])


def with_rates(config: OdometryConfig, rates: Array) -> OdometryConfig:
    """Settings with other rates (9,) of the noise, in the order of `RATES`."""
    values: dict[str, Any] = dict(zip(RATES, rates.tolist(), strict=True))
    return replace(config, **values)


def unit_error_covs(source: str, rows: Array, calibration: Array, robot: RobotConfig) -> Array:
    """Covariances ``(n, 9, 3, 3)`` of `model_error_cov` by a rate of one each, as in `RATES`.

    Of a source that does not state its noise, by its ``rows`` (n, k) and ``calibration`` (p,), see
    `MOTION_SOURCES`. Not by its increments: their headings are wrapped, and where the robot turns
    by more than half a turn between two readings they do not tell how far it turned and drove.
    """
    is_wheels = source == "wheels"
    twists = wheel_twist(rows, _calibrated(robot, calibration)) if is_wheels else rows[:, :3]
    covs = np.zeros((len(twists), 3, 3, 3, 3))  # motion, axis, unit, covariance
    for axis in range(3):
        covs[:, axis, :, axis, axis] = _amounts(twists, rows[:, -1])
    return covs.reshape(len(twists), len(RATES), 3, 3)


def _amounts(twists: Array, seconds: Array) -> Array:
    """What the model error grows with, (n, 3): path, turning, time in motion."""
    path, turn = np.hypot(twists[:, 0], twists[:, 1]), np.abs(twists[:, 2])
    return np.column_stack([path, turn, seconds])


@dataclass(frozen=True, slots=True, eq=False)
class Increments:
    """Consecutive motions: ``delta`` (n, 3), white ``cov`` (n, 3, 3), ``d_cal`` (n, 3, p).

    ``cov`` is along the axes of each increment's start frame, ``d_cal`` the derivative by the
    source's p calibration parameters.
    """

    delta: Array
    cov: Array
    d_cal: Array

    def part(self, i: int, j: int) -> "Increments":
        """The increments from the i-th up to the j-th, which is left out."""
        return Increments(self.delta[i:j], self.cov[i:j], self.d_cal[i:j])


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Calibration errors of a motion source: ``mean`` (p,), ``cov`` (p, p); nominal is zero."""

    names: tuple[str, ...]
    mean: Array
    cov: Array

    @property
    def is_held(self) -> bool:
        """Whether no parameter is to be estimated."""
        return not np.any(np.diag(self.cov) > HELD_SIGMA**2)

    def held(self) -> "Calibration":
        """The same means as if they were known: motions computed with it leave its errors out.

        The variance is 1e-18, not 0, so that covariances stay invertible.
        """
        return Calibration(self.names, self.mean, 1e-18 * np.eye(len(self.mean)))

    def part(self, parameters: IntArray) -> "Calibration":
        """That of some parameters alone."""
        names = tuple(self.names[k] for k in parameters.tolist())
        return Calibration(names, self.mean[parameters], self.cov[np.ix_(parameters, parameters)])

    def at_zero(self, parameters: Sequence[int]) -> "Calibration":
        """The same with some parameters zero and held."""
        mean, cov = self.mean.copy(), self.cov.copy()
        mean[parameters] = 0.0
        cov[parameters, :] = cov[:, parameters] = 0.0
        cov[parameters, parameters] = HELD_SIGMA**4
        return Calibration(self.names, mean, cov)


def odometry_increments(
    rows: Array,
    calibration: Array,
    _robot: RobotConfig,
    config: OdometryConfig,
    rates: Array | None = None,
) -> Increments:
    """Increments of an odometry that reports poses: ``rows`` (n, 4) are twists and seconds.

    Calibration parameters: relative scale of translation, relative scale of rotation, turning per
    metre driven forwards (rad/m): wheels of unequal size turn the robot the other way in reverse.
    """
    rows, seconds = rows[:, :3], rows[:, 3]
    d_twist = np.zeros((len(rows), 3, 3))
    d_twist[:, :2, 0] = rows[:, :2]
    d_twist[:, 2, 1] = rows[:, 2]
    d_twist[:, 2, 2] = rows[:, 0]
    twists = rows + (d_twist @ calibration[..., None])[..., 0]
    cov = model_error_cov(rows, seconds, config, rates)
    return Increments(exp(twists), cov, exp_jacobian(twists) @ d_twist)


def command_increments(
    rows: Array,
    calibration: Array,
    _robot: RobotConfig,
    config: OdometryConfig,
    rates: Array | None = None,
) -> Increments:
    """Increments of commanded velocities, as poses: ``rows`` (n, 4) are twists and seconds.

    Calibration parameters: those of `odometry_increments`, and the turning loss, in m²: the path is
    shorter by this times the squared curvature. This is the case if the commanded speed is that of
    a point at distance d from the middle of the axle, hypot(v, d ω): to second order too large by
    d²/2 times the squared curvature.
    """
    rows, seconds = rows[:, :3], rows[:, 3]
    path = np.maximum(np.hypot(rows[:, 0], rows[:, 1]), 1e-12)
    curvature = np.minimum(np.abs(rows[:, 2]) / path, MAX_CURVATURE_PER_M)
    d_twist = np.zeros((len(rows), 3, 4))
    d_twist[:, :2, 0] = rows[:, :2]
    d_twist[:, 2, 1] = rows[:, 2]
    d_twist[:, 2, 2] = rows[:, 0]
    d_twist[:, :2, 3] = -rows[:, :2] * (curvature**2)[:, None]
    twists = rows + (d_twist @ calibration[..., None])[..., 0]
    cov = model_error_cov(rows, seconds, config, rates)
    return Increments(exp(twists), cov, exp_jacobian(twists) @ d_twist)


def parameter_cov(source: str, rows: Array, robot: RobotConfig, config: OdometryConfig) -> Array:
    """Covariance (n, 3, 3) of w_p, eq. 4.9-4.13 as printed: parameters drawn anew in each row.

    It grows with the square of the rotations of a row, so it depends on how often the odometry is
    read. Of a source that reports poses, the rotations are those of the robot's nominal wheels.
    """
    wheels = source == "wheels"
    angles = (rows if wheels else rows_of_twists("wheels", rows[:, :3], robot))[:, :2]
    moved = np.any(angles != 0, axis=1)
    variances = np.zeros((len(angles), 5))
    variances[:, :2], variances[:, 4] = config.wheel_radius_sigma_m**2, config.axle_sigma_m**2
    if not wheels:  # `wheel_increments` has that of the counts
        variances[:, 2:4] = config.count_sigma_rad**2 * moved[:, None]
    J = exp_jacobian(wheel_twist(angles, robot)) @ wheel_jacobian(angles, robot)
    return np.asarray((J * variances[:, None, :]) @ J.mT)


def given_increments(
    rows: Array,
    _calibration: Array,
    _robot: RobotConfig,
    _config: OdometryConfig,
    _rates: Array | None = None,
) -> Increments:
    """Increments that bring their own covariance: ``rows`` (n, 12) are twist and covariance.

    Nothing to calibrate: p = 0.
    """
    n = len(rows)
    return Increments(exp(rows[:, :3]), rows[:, 3:].reshape(n, 3, 3), np.zeros((n, 3, 0)))


def wheel_increments(
    rows: Array,
    calibration: Array,
    robot: RobotConfig,
    config: OdometryConfig,
    rates: Array | None = None,
) -> Increments:
    """Increments of wheel rotations: ``rows`` (n, 3) left and right, rad, and seconds.

    Calibration parameters: corrections of left radius, right radius and axle length, m.
    The counting error of one reading enters two neighbouring increments with opposite signs and
    nearly cancels; it is treated as white here (cautious), thesis eq. 4.9.
    """
    robot = _calibrated(robot, calibration)
    rows, seconds = rows[:, :2], rows[:, 2]
    twists = wheel_twist(rows, robot)
    J = exp_jacobian(twists) @ wheel_jacobian(rows, robot)
    moved = np.any(rows != 0, axis=1)
    counting = (config.count_sigma_rad**2 * moved)[:, None, None]
    cov = model_error_cov(twists, seconds, config, rates) + counting * (
        J[:, :, 2:4] @ J[:, :, 2:4].mT
    )
    return Increments(exp(twists), cov, J[:, :, [0, 1, 4]])


def _calibrated(robot: RobotConfig, calibration: Array) -> RobotConfig:
    """A robot with the corrections (3,) of its wheels, see `wheel_increments`."""
    return replace(
        robot,
        wheel_radius_left_m=robot.wheel_radius_left_m + calibration[0],
        wheel_radius_right_m=robot.wheel_radius_right_m + calibration[1],
        axle_m=robot.axle_m + calibration[2],
    )


def mounted_motion(delta: Array, mount: Array) -> tuple[Array, Array]:
    """The motion of a frame that sits at ``mount`` (..., 3) in a body that moves by ``delta``.

    Returns:
        ``inverse(mount) delta mount`` (..., 3), and its derivative (..., 3, 3) by the mount.
        Turning in place shows the mount's position, driving straight its direction.
    """
    D = rotation3(delta[..., 2]) - np.eye(3)
    if mount.any():
        moved = compose(inverse(mount), compose(delta, mount))
        D = rotation3(-mount[..., 2]) @ D
    else:  # as most are
        moved = delta.copy()
        moved[..., 2] = wrap(delta[..., 2])
    D[..., 0, 2], D[..., 1, 2] = moved[..., 1], -moved[..., 0]
    return moved, D


def nominal_calibration(source: str, config: OdometryConfig, mounted: bool) -> Calibration:
    """Prior of a source's calibration: mean zero, covariance from the settings' sigmas.

    With ``mounted`` the last four parameters are the error of the sensor's mounting pose in the log
    (x m, y m, yaw rad, base axes) and the latency of its stamps against the odometry's (s): the
    estimated states are rigid to the sensor and its clock.
    """
    sigmas = {
        "given": {},
        "odometry": {
            "translation_scale": config.translation_scale_sigma,
            "rotation_scale": config.rotation_scale_sigma,
            "drift_rad_per_m": config.drift_sigma_rad_per_m,
        },
        "commands": {
            "translation_scale": config.translation_scale_sigma,
            "rotation_scale": config.rotation_scale_sigma,
            "drift_rad_per_m": config.drift_sigma_rad_per_m,
            "turning_loss_m2": config.turning_lever_sigma_m**2 / 2,
        },
        "wheels": {
            "wheel_radius_left_m": config.wheel_radius_sigma_m,
            "wheel_radius_right_m": config.wheel_radius_sigma_m,
            "axle_m": config.axle_sigma_m,
        },
    }[source]
    if mounted:
        sigmas |= _laser_sigmas(config)
    held: set[str] = set(config.fixed_calibration)
    if config.parameter_noise == "white":  # then their errors are in every increment
        held |= {name for name in sigmas if not name.startswith("laser_")}
    known = [0.0 if name in held else sigma for name, sigma in sigmas.items()]
    return _prior(tuple(sigmas), known)


def further_calibration(
    first: Calibration, sensors: Sequence[str], config: OdometryConfig
) -> Calibration:
    """A calibration before any data, and after it mounts and latencies of further lasers.

    Their names are those of the first laser's after the name of the sensor and a dot.
    """
    sigmas = _laser_sigmas(config)
    known = [0.0 if name in config.fixed_calibration else s for name, s in sigmas.items()]
    names = tuple(f"{sensor}.{name}" for sensor in sensors for name in sigmas)
    more = _prior(names, known * len(sensors))
    p, q = len(first.mean), len(more.mean)
    cov = np.zeros((p + q, p + q))
    cov[:p, :p], cov[p:, p:] = first.cov, more.cov
    return Calibration(first.names + names, np.concatenate([first.mean, more.mean]), cov)


def several_lasers(calibration: Calibration) -> bool:
    """Whether there are mounts of further lasers in a calibration."""
    return any("." in name for name in calibration.names)


def of_odometry(calibration: Calibration) -> BoolArray:
    """Which parameters (p,) are those of the odometry itself, not of mounts and latencies."""
    return np.array(["laser_" not in name for name in calibration.names], dtype=np.bool_)


def _laser_sigmas(config: OdometryConfig) -> dict[str, float]:
    """Prior sigmas of a laser's mount and latency."""
    return {
        "laser_x_m": config.laser_sigma_m,
        "laser_y_m": config.laser_sigma_m,
        "laser_yaw_rad": config.laser_sigma_rad,
        "laser_latency_s": config.laser_latency_sigma_s,
    }


def _prior(names: tuple[str, ...], sigmas: Sequence[float]) -> Calibration:
    # a parameter whose sigma is 0 is held, without making the covariance singular
    values = np.maximum(np.array(sigmas, dtype=float), 1e-9)
    return Calibration(names, np.zeros(len(values)), np.diag(values**2))


class MotionSource(Protocol):
    """Increments (n) of a source's rows (n, k), see the functions above.

    Calibrations are (p,) or (n, p), ``rates`` (n, 9) those of `model_error_cov`.
    """

    def __call__(
        self, rows: Array, calibration: Array, robot: RobotConfig, config: OdometryConfig,
        rates: Array | None = None, /,
    ) -> Increments:  # fmt: skip
        """Make them."""


#: motion source -> increments of its rows; rows scale with the share of an interval that is used
MOTION_SOURCES: dict[str, MotionSource] = {
    "given": given_increments,
    "odometry": odometry_increments,
    "commands": command_increments,
    "wheels": wheel_increments,
}


def rows_of_twists(source: str, twists: Array, robot: RobotConfig) -> Array:
    """The rows of a source without stated covariances that report twists (n, 3); 0 s in motion."""
    if source == "wheels":
        path, half = twists[:, 0], 0.5 * robot.axle_m * twists[:, 2]
        turns = (
            (path - half) / robot.wheel_radius_left_m,
            (path + half) / robot.wheel_radius_right_m,
        )
        return np.column_stack([*turns, np.zeros(len(twists))])
    return np.column_stack([twists, np.zeros(len(twists))])


@dataclass(frozen=True, slots=True, eq=False)
class Compounded:
    """A chain of increments as one motion; see `compound`. ``length_m`` is the path."""

    delta: Array
    cov: Array
    d_cal: Array
    length_m: float


def compound(parts: Increments) -> Compounded:
    """One motion from consecutive increments, eq. 4.4 and 4.7 applied n times, without a loop.

    With p_k the pose after k increments in the frame of the first, an additive error e of
    increment k moves the end by ``rotation3(heading of p_(k-1)) e`` and, through its heading part,
    by that times the vector from p_k to the end, turned a quarter.

    Returns:
        ``delta`` (3,), white ``cov`` (3, 3) along the start frame's axes, ``d_cal`` (3, p).
    """
    n = len(parts.delta)
    before = np.concatenate([[0.0], np.cumsum(parts.delta[:, 2])])
    c, s = np.cos(before[:-1]), np.sin(before[:-1])
    dx, dy = parts.delta[:, 0], parts.delta[:, 1]
    x = np.cumsum(c * dx - s * dy)
    y = np.cumsum(s * dx + c * dy)
    E = np.zeros((n, 3, 3))
    E[:, 0, 0] = E[:, 1, 1] = c
    E[:, 0, 1], E[:, 1, 0] = -s, s
    E[:, 0, 2], E[:, 1, 2] = -(y[-1] - y), x[-1] - x
    E[:, 2, 2] = 1.0
    cov = (E @ parts.cov @ E.mT).sum(axis=0)
    d_cal = (E @ parts.d_cal).sum(axis=0)
    length_m = float(np.hypot(dx, dy).sum())
    return Compounded(np.array([x[-1], y[-1], before[-1]]), cov, d_cal, length_m)
