"""CDR of the messages that others are turned into; much faster than rosbags' writer."""

import struct
from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from graphslam.logs import schemas
from graphslam.logs.cdr import HEADER

_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
#: numbers of the template that are replaced
_MARKS = (1.25, 2.25, 3.25, 4.25, 5.25, 6.25, 7.25)


def scan_bytes(
    stamp_ns: int,
    frame: str,
    start_rad: float,
    step_rad: float,
    ranges: NDArray[np.float32],
    limits_m: tuple[float, float] = (0.0, 0.0),
    times_s: tuple[float, float] = (0.0, 0.0),
) -> bytes:
    """sensor_msgs/LaserScan of ranges (n,) m; limits of 0 are none.

    ``times_s``: between two beams, and between two scans; 0: not known.

    Raises:
        LogError: the stamp does not fit.
    """
    data = bytearray(_LITTLE_ENDIAN)
    _add_stamp(data, stamp_ns)
    _add_text(data, frame)
    _align(data, 4)
    end = start_rad + step_rad * max(len(ranges) - 1, 0)
    data += struct.pack("<7f", start_rad, end, step_rad, *times_s, *limits_m)
    data += struct.pack("<I", len(ranges)) + ranges.astype("<f4").tobytes()
    return bytes(data + struct.pack("<I", 0))


def odometry_bytes(
    stamp_ns: int, frame: str, position: Sequence[float], turn: Sequence[float], child: str = ""
) -> bytes:
    """nav_msgs/Odometry: position x y z m and quaternion x y z w of ``child`` in ``frame``.

    Raises:
        LogError: the stamp does not fit.
    """
    return _odometry_template(frame, child).filled(stamp_ns, *position, *turn)


def imu_bytes(stamp_ns: int, frame: str, rate_rad_s: float) -> bytes:
    """sensor_msgs/Imu of a rate of turning about z; it has no orientation and no acceleration.

    Raises:
        LogError: the stamp does not fit.
    """
    return _imu_template(frame).filled(stamp_ns, rate_rad_s)


def tf_bytes(transforms: Sequence[tuple[int, str, str, Sequence[float]]]) -> bytes:
    """tf2_msgs/TFMessage of transforms: stamp ns, parent, child; x y z m, quaternion x y z w.

    Raises:
        LogError: a stamp does not fit.
    """
    data = bytearray(_LITTLE_ENDIAN + struct.pack("<I", len(transforms)))
    for stamp_ns, parent, child, values in transforms:
        _align(data, 4)
        _add_stamp(data, stamp_ns)
        _add_text(data, parent)
        _align(data, 4)
        _add_text(data, child)
        _align(data, 8)
        data += struct.pack("<7d", *values)
    return bytes(data)


def _add_stamp(data: bytearray, stamp_ns: int) -> None:
    data += struct.pack("<iI", *schemas.seconds_and_rest(stamp_ns))


def _add_text(data: bytearray, text: str) -> None:
    encoded = text.encode() + b"\0"
    data += struct.pack("<I", len(encoded)) + encoded


def _align(data: bytearray, size: int) -> None:
    data += bytes(-(len(data) - HEADER) % size)


@cache
def _imu_template(frame: str) -> schemas.Template:
    """sensor_msgs/Imu with the rate of turning."""
    zero = schemas.build("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    rate = schemas.build("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=_MARKS[0])
    unknown = np.array([-1.0, *np.zeros(8)])
    message = schemas.build(
        schemas.IMU,
        header=schemas.header(0, frame),
        orientation=schemas.build("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=unknown,
        angular_velocity=rate,
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=zero,
        linear_acceleration_covariance=unknown,
    )
    return schemas.Template(schemas.IMU, message, _MARKS[:1])


@cache
def _odometry_template(frame: str, child: str) -> schemas.Template:
    """nav_msgs/Odometry with the seven numbers of a transform."""
    x, y, z, a, b, c, d = _MARKS
    point = schemas.build("geometry_msgs/msg/Point", x=x, y=y, z=z)
    rotation = schemas.build("geometry_msgs/msg/Quaternion", x=a, y=b, z=c, w=d)
    zero = schemas.build("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    pose = schemas.build("geometry_msgs/msg/Pose", position=point, orientation=rotation)
    twist = schemas.build("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    kinds = "geometry_msgs/msg/PoseWithCovariance", "geometry_msgs/msg/TwistWithCovariance"
    message = schemas.build(
        schemas.ODOMETRY,
        header=schemas.header(0, frame),
        child_frame_id=child,
        pose=schemas.build(kinds[0], pose=pose, covariance=np.zeros(36)),
        twist=schemas.build(kinds[1], twist=twist, covariance=np.zeros(36)),
    )
    return schemas.Template(schemas.ODOMETRY, message, _MARKS)
