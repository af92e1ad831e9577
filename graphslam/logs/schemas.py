"""Message types of a log, ROS 2's and our own, and their CDR encoding.

The only module that imports rosbags. Messages are rosbags' dataclasses whose number arrays are
numpy arrays. Our own types are defined here as ros2msg text, which `LogWriter` also puts into the
file, so that any ROS 2 or MCAP tool can decode them. docs/logs.md explains them.
"""

import struct
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from graphslam.core.errors import LogError
from graphslam.core.geometry import Array

#: numbers in a nav_msgs/Odometry: pose, twist and their covariances
_ODOMETRY_NUMBERS = 7 + 36 + 6 + 36

IntArray = np.ndarray[tuple[int, ...], np.dtype[np.int64]]

LASER_SCAN = "sensor_msgs/msg/LaserScan"
ODOMETRY = "nav_msgs/msg/Odometry"
JOINT_STATE = "sensor_msgs/msg/JointState"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
SIGHTING = "graphslam_msgs/msg/Sighting"
ODOMETRY_INCREMENT = "graphslam_msgs/msg/OdometryIncrement"
RELATIVE_POSE = "graphslam_msgs/msg/RelativePose"
TRUE_POSE = "graphslam_msgs/msg/TruePose"
TRUE_LANDMARK = "graphslam_msgs/msg/TrueLandmark"
TRUE_ASSOCIATIONS = "graphslam_msgs/msg/TrueAssociations"

#: fields that OdometryIncrement and RelativePose begin with
_START_AND_POSE = """\
std_msgs/Header header
builtin_interfaces/Time start
float64 x
float64 y
float64 phi
"""

DEFINITIONS: dict[str, str] = {
    SIGHTING: """\
# A landmark or another robot, seen from the sensor frame header.frame_id at header.stamp.
std_msgs/Header header
# Where it is: angle from the sensor's x axis, counter-clockwise, rad; distance, m.
float64 bearing
float64 range
# Its heading relative to the sensor's, rad; NaN = not measured.
float64 direction
# Covariance of (bearing, range, direction), row-major; the last row and column are ignored
# where direction is NaN.
float64[9] covariance
# Which landmark it is; empty = unknown.
string identity
# Name of the robot seen; empty = a landmark was seen.
string robot
""",
    ODOMETRY_INCREMENT: f"""\
# Pose of the base at header.stamp in the base frame at start: m, m, rad.
{_START_AND_POSE}\
# Covariance of additive errors (x, y, phi) along the axes of the base frame at start, row-major.
float64[9] covariance
""",
    RELATIVE_POSE: f"""\
# Pose of this robot's base at header.stamp in the base frame at start of the robot other.
{_START_AND_POSE}\
# Covariance of additive errors (x, y, phi) along the axes of the frame at start, row-major.
float64[9] covariance
# Name of the robot in whose frame the pose is given; empty = this robot itself.
string other
""",
    TRUE_POSE: """\
# True pose of the base in the world frame: m, m, rad.
std_msgs/Header header
float64 x
float64 y
float64 phi
""",
    TRUE_LANDMARK: """\
# A landmark as it truly is, in the world frame.
std_msgs/Header header
string identity
# point, segment or line
string kind
# m, m, rad; phi is NaN for a point.
float64 x
float64 y
float64 phi
# Its end points x1 y1 x2 y2, m; empty = none.
float64[] extent
""",
    TRUE_ASSOCIATIONS: """\
# What the beams of the scan, or the sightings of the image, of header.stamp truly met.
std_msgs/Header header
# Identities of true landmarks, and names of robots.
string[] names
# For every beam, or every sighting in the order of the log, its place in names; -1 = nothing.
int16[] targets
""",
}


class CdrError(Exception):
    """The bytes of one message do not fit its schema."""


@cache
def _typestore() -> Typestore:
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def decode(schema: str, data: bytes) -> Any:
    """The message in ``data`` (CDR with its four header bytes) of a known ``schema``.

    Raises:
        CdrError: the bytes are cut short or are not such a message.
    """
    try:
        return _typestore().deserialize_cdr(data, schema)
    except (SerdeError, IndexError, MemoryError, OverflowError) as error:
        raise CdrError(str(error)) from error


class PlanarOdometry(NamedTuple):
    """The used part of a nav_msgs/Odometry: stamp, position in the plane, quaternion x y z w."""

    stamp_ns: int
    x: float
    y: float
    rotation: tuple[float, float, float, float]


def decode_odometry(data: bytes) -> PlanarOdometry:
    """The beginning of a nav_msgs/Odometry; faster than `decode`, which makes ten objects of each.

    Raises:
        CdrError: the bytes are cut short.
    """
    order = "<" if data[1:2] == b"\x01" else ">"
    try:
        seconds, nanoseconds, size = struct.unpack_from(f"{order}iII", data, 4)
        # numbers are aligned to their size, counted from the end of CDR's four bytes
        at = 16 + size + -size % 4
        (size,) = struct.unpack_from(f"{order}I", data, at)
        at += 4 + size
        at += -(at - 4) % 8
        x, y, _, *rotation = struct.unpack_from(f"{order}7d", data, at)
    except struct.error as error:
        raise CdrError(str(error)) from error
    if len(data) < at + _ODOMETRY_NUMBERS * 8:
        raise CdrError("cut short")
    return PlanarOdometry(seconds * 1_000_000_000 + nanoseconds, x, y, tuple(rotation))


def decode_true_poses(data: Sequence[bytes]) -> tuple[IntArray, Array]:
    """Stamps (n,) ns and poses (n, 3) of many `TRUE_POSE` messages at once.

    Ground truth of motion capture can be most of a log. Messages that differ in frame or byte order
    are decoded one by one; those that cannot be decoded are left out.
    """
    first = data[0] if data else b""
    # CDR: four header bytes, the second is the byte order; 8-byte numbers are aligned, counted
    # from the end of the header
    size = struct.unpack_from("<I", first, 12)[0] if len(first) >= 16 else 0
    gap = -(12 + size) % 8
    layout = np.dtype(
        [
            ("order", "V4"),
            ("sec", "<i4"),
            ("nanosec", "<u4"),
            ("frame_size", "<u4"),
            ("frame", f"V{size + gap}"),
            ("pose", "<f8", 3),
        ]
    )
    if (
        len(first) != layout.itemsize
        or first[1] != 1
        or not all(
            len(d) == len(first) and d[:4] == first[:4] and d[12:16] == first[12:16] for d in data
        )
    ):
        return _true_poses_singly(data)
    rows = np.frombuffer(b"".join(data), dtype=layout)
    return rows["sec"].astype(np.int64) * 1_000_000_000 + rows["nanosec"], rows["pose"].copy()


def decode_all(schema: str, data: Iterable[bytes]) -> Iterator[Any]:
    """The messages in ``data`` that can be decoded, see `decode`."""
    for encoded in data:
        with suppress(CdrError):
            yield decode(schema, encoded)


def _true_poses_singly(data: Sequence[bytes]) -> tuple[IntArray, Array]:
    found = list(decode_all(TRUE_POSE, data))
    stamps = np.array([stamp_ns(m.header.stamp) for m in found], dtype=np.int64)
    return stamps, np.array([(m.x, m.y, m.phi) for m in found], dtype=float).reshape(-1, 3)


def encode(schema: str, message: Any) -> bytes:
    """CDR bytes of ``message``, made by `build`; little-endian on every machine."""
    return bytes(_typestore().serialize_cdr(message, schema, little_endian=True))


class Template:
    """An encoded message in which the header's stamp and some float64 numbers are replaced."""

    def __init__(self, schema: str, message: Any, marks: Sequence[float]) -> None:
        """``message`` has the unique values ``marks`` where numbers will be replaced."""
        self._data = encode(schema, message)
        self._places = [self._data.index(struct.pack("<d", mark)) for mark in marks]

    def filled(self, stamp_ns: int, *numbers: float) -> bytes:
        """The bytes with this stamp and these numbers, in the order of the marks."""
        data = bytearray(self._data)
        # after CDR's own header of four bytes the message begins with its std_msgs/Header
        struct.pack_into("<iI", data, 4, *_seconds(stamp_ns))
        for place, number in zip(self._places, numbers, strict=True):
            struct.pack_into("<d", data, place, number)
        return bytes(data)


def build(schema: str, **fields: Any) -> Any:
    """A message of type ``schema``; all fields are required."""
    return _typestore().types[schema](**fields)


def definition(schema: str) -> bytes:
    """The ros2msg text of ``schema`` with its nested types, as MCAP stores it."""
    own, separator, nested = _typestore().generate_msgdef(schema, 2)[0].partition("=" * 80)
    # of our own types the text above, with its comments
    return (DEFINITIONS.get(schema, own) + separator + nested).encode()


def time(stamp_ns: int) -> Any:
    """builtin_interfaces/Time of integer nanoseconds.

    Raises:
        LogError: the stamp does not fit the signed 32-bit seconds of ROS 2.
    """
    seconds, nanoseconds = _seconds(stamp_ns)
    return build("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)


def _seconds(stamp_ns: int) -> tuple[int, int]:
    seconds, nanoseconds = divmod(int(stamp_ns), 1_000_000_000)
    if not -(2**31) <= seconds < 2**31:
        raise LogError(f"stamp {stamp_ns} ns cannot be written: ROS 2 has 32 bits for seconds")
    return seconds, nanoseconds


def header(stamp_ns: int, frame: str) -> Any:
    """std_msgs/Header with the stamp in integer nanoseconds."""
    return build("std_msgs/msg/Header", stamp=time(stamp_ns), frame_id=frame)


def stamp_ns(time_message: Any) -> int:
    """Integer nanoseconds of a builtin_interfaces/Time, never through a float."""
    return int(time_message.sec) * 1_000_000_000 + int(time_message.nanosec)
