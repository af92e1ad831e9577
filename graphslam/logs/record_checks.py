"""What a record must hold to be used: finite numbers, as sensors measure them, and covariances.

Records that are decoded are checked by the decoders as they are made, those that a program makes
itself (`graphslam.Session`) by `checked`. Both are dropped and counted for the same reasons.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from numbers import Integral
from typing import Any

import numpy as np

from graphslam.core import records
from graphslam.core.geometry import Array, is_positive
from graphslam.core.record import replace
from graphslam.logs import physical_limits as limits


class UnusableMessageError(Exception):
    """A message that must be dropped; its text is the reason under which it is counted."""


def checked(message: records.Message) -> records.Message:
    """A record that a program made, with its numbers as arrays, if it can be used.

    Raises:
        UnusableMessageError: it cannot.
    """
    made = _with_arrays(message)
    _CHECKS.get(type(made), _nothing)(made)
    return made


def _with_arrays(message: records.Message) -> records.Message:
    """The record with lists as arrays; raises `UnusableMessageError` where shapes are wrong."""
    what = type(message).__name__
    if not all(isinstance(t, Integral) for t in (message.stamp_ns, message.time_ns)):
        raise UnusableMessageError(f"{what}: stamp_ns and time_ns must be whole numbers")
    if not isinstance(getattr(message, "start_ns", 0), Integral):
        raise UnusableMessageError(f"{what}: start_ns must be a whole number")
    for field, also in _TEXTS.items():
        if not isinstance(getattr(message, field, ""), also):
            raise UnusableMessageError(f"{what}: {field} must be a text")
    sizes: dict[str, int] = {}
    arrays: dict[str, Array] = {}
    for field, shape in _SHAPES.get(type(message), {}).items():
        value = getattr(message, field)
        if value is None and field in _OPTIONAL:
            continue
        array = _as_array(value)
        wanted = [n if isinstance(n, int) else sizes.get(n) for n in shape]
        if (
            array is None
            or array.ndim != len(shape)
            or any(n not in (None, found) for n, found in zip(wanted, array.shape, strict=True))
        ):
            many = f"an array ({', '.join(map(str, shape))}) of numbers" if shape else "a number"
            raise UnusableMessageError(f"{what}: {field} must be {many}")
        sizes |= {n: k for n, k in zip(shape, array.shape, strict=True) if isinstance(n, str)}
        if shape and array is not value:
            arrays[field] = array
    return replace(message, **arrays) if arrays else message


def _as_array(value: Any) -> Array | None:
    """Numbers as an array; None if they are none."""
    try:
        return None if value is None else np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        return None


def check_finite(what: str, values: Array) -> None:
    """Raises `UnusableMessageError` where not all of ``values`` (n, ...) are finite."""
    if not np.isfinite(values).all():
        raise UnusableMessageError(f"{what}: not finite")


def check_pose(what: str, pose: Array) -> Array:
    """A pose (3,), m and rad; raises `UnusableMessageError` where no robot can be there."""
    check_finite(what, pose)
    if np.abs(pose[:2]).max() > limits.MAX_POSITION_M or abs(pose[2]) > limits.MAX_ANGLE_RAD:
        raise UnusableMessageError(f"{what}: farther than robots drive")
    return pose


def check_wheels(left_rad: float, right_rad: float) -> None:
    """Raises `UnusableMessageError` where no wheel turns like this."""
    check_finite("joints", np.array([left_rad, right_rad]))
    if max(abs(left_rad), abs(right_rad)) > limits.MAX_ANGLE_RAD:
        raise UnusableMessageError("joints: angle is beyond what a wheel turns")


def check_mount(what: str, mount: Array) -> None:
    """Raises `UnusableMessageError` where no robot carries a sensor at a pose (3,)."""
    check_finite(what, mount)
    if np.abs(mount[:2]).max() > limits.MAX_MOUNT_M or abs(mount[2]) > limits.MAX_ANGLE_RAD:
        raise UnusableMessageError(f"{what}: the sensor is beyond any robot")


def check_beams(number: int, angle_min_rad: float, angle_step_rad: float) -> None:
    """Raises `UnusableMessageError` where a scan has no beams, or they have no directions."""
    if not number:
        raise UnusableMessageError("scan: no beams")
    if not (math.isfinite(angle_min_rad) and math.isfinite(angle_step_rad) and angle_step_rad):
        raise UnusableMessageError("scan: angle increment is zero or angles are not finite")


def check_sighting(z: Array) -> None:
    """Raises `UnusableMessageError` where no bearing rad, range m and direction rad are like z."""
    if not all(map(math.isfinite, z.tolist())):
        raise UnusableMessageError("sighting: not finite")
    if z[1] < limits.MIN_SIGHTING_M:
        raise UnusableMessageError("sighting: range is not positive")
    if z[1] > limits.MAX_SIGHTING_M:
        raise UnusableMessageError("sighting: range is beyond what anything measures")


def checked_covariance(what: str, values: Array, size: int) -> Array:
    """The upper left (size, size) block of a covariance (n, n), made exactly symmetric.

    Raises:
        UnusableMessageError: it is no covariance, or none that a sensor has.
    """
    return _checked_covariance(what, np.asarray(values, dtype=float).tobytes(), size)


@lru_cache(maxsize=1024)
def _checked_covariance(what: str, values: bytes, size: int) -> Array:
    """See `checked_covariance`: sensors mostly state the same one, so messages share it."""
    numbers = np.frombuffer(values)
    whole = numbers.reshape(math.isqrt(len(numbers)), -1)
    cov = whole[:size, :size]
    cov = np.asarray((cov + cov.T) / 2)
    check_finite(what, cov)
    if not is_positive(cov):
        raise UnusableMessageError(f"{what}: covariance is not positive definite")
    variances = cov.diagonal()
    most = limits.MAX_SIGHTING_VARIANCE if what == "sighting" else limits.MAX_VARIANCE
    if variances.min() < limits.MIN_VARIANCE or variances.max() > most:
        raise UnusableMessageError(f"{what}: variance is beyond what a sensor has")
    cov.flags.writeable = False
    return cov


def _nothing(message: records.Message) -> None:
    """Nothing in it is used in arithmetic."""


def _sighting(message: records.Sighting) -> None:
    if len(message.z) not in (2, 3):
        raise UnusableMessageError("Sighting: z must be bearing, range and perhaps direction")
    check_sighting(message.z)
    check_mount("sighting", message.mount)
    checked_covariance("sighting", message.cov, len(message.z))


def _odometry(message: records.OdometryPose) -> None:
    check_pose("odometry", message.pose)


def _wheels(message: records.WheelAngles) -> None:
    check_wheels(message.left_rad, message.right_rad)


def _increment(message: records.OdometryIncrement) -> None:
    if message.stamp_ns <= message.start_ns:
        raise UnusableMessageError("increment: does not end after its start")
    check_pose("increment", message.delta)
    checked_covariance("increment", message.cov, 3)


def _relative_pose(message: records.RelativePose) -> None:
    check_pose("relative pose", message.delta)
    checked_covariance("relative pose", message.cov, 3)


def _scan(message: records.Scan) -> None:
    n = len(message.ranges)
    check_beams(n, message.angle_min_rad, message.angle_step_rad)
    check_mount("scan", message.mount)
    sweep_s = abs(message.beam_period_s) * (n - 1)
    if not sweep_s <= limits.SWEEP_SLACK * limits.MAX_SWEEP_S:
        raise UnusableMessageError(
            "scan: beam_period_s is not finite, or longer than a sweep takes"
        )
    if message.bearings is not None:
        check_finite("scan: bearings", message.bearings)


#: the numbers of records; where the same letter stands, the same number of elements
_SHAPES: dict[type[records.Message], dict[str, tuple[int | str, ...]]] = {
    records.OdometryPose: {"pose": (3,)},
    records.OdometryIncrement: {"delta": (3,), "cov": (3, 3)},
    records.WheelAngles: {"left_rad": (), "right_rad": ()},
    records.Scan: {
        "ranges": ("n",),
        "bearings": ("n",),
        "mount": (3,),
        "angle_min_rad": (),
        "angle_step_rad": (),
        "beam_period_s": (),
    },
    records.Sighting: {"z": ("k",), "cov": ("k", "k"), "mount": (3,)},
    records.RelativePose: {"delta": (3,), "cov": (3, 3)},
}
#: fields that are texts, some of which may be None
_TEXTS: dict[str, type | tuple[type, ...]] = {
    "robot": str, "other": str, "sensor": str, "may_be": str,
    "identity": (str, type(None)), "seen_robot": (str, type(None)),
}  # fmt: skip
#: those that a record need not have
_OPTIONAL = frozenset({"bearings"})

_CHECKS: dict[type[records.Message], Callable[[Any], None]] = {
    records.OdometryPose: _odometry,
    records.OdometryIncrement: _increment,
    records.WheelAngles: _wheels,
    records.Scan: _scan,
    records.Sighting: _sighting,
    records.RelativePose: _relative_pose,
}
