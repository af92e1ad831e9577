"""Message types of a log, ROS 2's and our own, and their CDR encoding.

Our own types are defined here as ros2msg text, which `LogWriter` also puts into the file, so that
any ROS 2 or MCAP tool can decode them. docs/logs.md explains them. Messages are read by `cdr` and
written by rosbags, which is imported only for that: its definitions of all types of all versions of
ROS 2 take a tenth of a second.
"""

import struct
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from functools import cache, lru_cache
from typing import Any

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.errors import LogError
from graphslam.core.geometry import Array
from graphslam.logs.cdr import (
    HEADER,
    CdrError,
    Decoder,
    Layout,
    byte_order,
    last_strings,
    string,
    u32,
)

DEFAULT_ROBOT = "robot"  # its topics have no namespace

LASER_SCAN = "sensor_msgs/msg/LaserScan"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
ODOMETRY = "nav_msgs/msg/Odometry"
IMU = "sensor_msgs/msg/Imu"
TWIST = "geometry_msgs/msg/Twist"
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"
JOINT_STATE = "sensor_msgs/msg/JointState"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
SIGHTING = "graphslam_msgs/msg/Sighting"
ODOMETRY_INCREMENT = "graphslam_msgs/msg/OdometryIncrement"
RELATIVE_POSE = "graphslam_msgs/msg/RelativePose"
TRUE_POSE = "graphslam_msgs/msg/TruePose"
TRUE_LANDMARK = "graphslam_msgs/msg/TrueLandmark"
TRUE_ASSOCIATIONS = "graphslam_msgs/msg/TrueAssociations"

#: what a Sighting says instead of a robot's name (no name: those are parts of topics)
SOME_ROBOT, ANYTHING = "?", "*"

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
# Name of the robot seen; empty = a landmark was seen; ? = a robot, it is not known which;
# * = a robot or a landmark, it is not known which of the two.
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


#: types of ROS 2 that are read, and those in their fields
_ROS_DEFINITIONS: dict[str, str] = {
    LASER_SCAN: """\
std_msgs/Header header
float32 angle_min
float32 angle_max
float32 angle_increment
float32 time_increment
float32 scan_time
float32 range_min
float32 range_max
float32[] ranges
float32[] intensities
""",
    POINT_CLOUD: """\
std_msgs/Header header
uint32 height
uint32 width
sensor_msgs/PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
""",
    "sensor_msgs/PointField": "string name\nuint32 offset\nuint8 datatype\nuint32 count",
    ODOMETRY: """\
std_msgs/Header header
string child_frame_id
geometry_msgs/PoseWithCovariance pose
geometry_msgs/TwistWithCovariance twist
""",
    JOINT_STATE: """\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
""",
    TF_MESSAGE: "geometry_msgs/TransformStamped[] transforms",
    "geometry_msgs/TransformStamped": """\
std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform
""",
    "geometry_msgs/Transform": """\
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
""",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance",
    "geometry_msgs/Pose": "geometry_msgs/Vector3 position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    IMU: """\
std_msgs/Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance
""",
    TWIST: "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    TWIST_STAMPED: "std_msgs/Header header\ngeometry_msgs/Twist twist",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
}

_DECODER = Decoder(_ROS_DEFINITIONS | DEFINITIONS)
#: schemas that `decode` reads
KNOWN = frozenset(name for name in (*_ROS_DEFINITIONS, *DEFINITIONS) if "/msg/" in name)


def full_name(name: str, encoding: str) -> str:
    """The name of a type with its ``msg``, which early ROS 2 recordings leave out."""
    package, slash, kind = name.partition("/")
    is_short = encoding == "cdr" and slash and "/" not in kind
    return f"{package}/msg/{kind}" if is_short else name


@cache
def _typestore() -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: PLC0415

    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def ros1_to_cdr(schema: str, data: bytes) -> bytes:
    """The ROS 1 message in ``data``, of the type that ROS 2 calls ``schema``, in CDR.

    Raises:
        CdrError: the bytes are cut short or are not such a message.
    """
    from rosbags.serde import SerdeError  # noqa: PLC0415

    try:
        return bytes(_typestore().ros1_to_cdr(data, schema))
    except (SerdeError, struct.error, ValueError, IndexError, TypeError, AssertionError) as error:
        raise CdrError(str(error)) from error


def decode(schema: str, data: bytes) -> Any:
    """The message in ``data`` (CDR with its four header bytes) of a known ``schema``.

    Raises:
        CdrError: the bytes are cut short or are not such a message.
    """
    return _DECODER.decode(schema, data)


# ---------------------------------------------------------------- many messages at once

#: place of the length of frame_id in a std_msgs/Header at the beginning of a message
_FRAME_SIZE = HEADER + 8


def _after_frame(size: int) -> int:
    """Place of what follows a frame_id of ``size`` bytes, aligned to four bytes."""
    return _FRAME_SIZE + 4 + size + -size % 4


def odometry_table(data: Sequence[bytes]) -> Any:
    """Rows (n,) of nav_msgs/Odometry: stamp, ``xyz``, ``rotation`` (x y z w), ``twist_covariance``.

    Raises:
        CdrError: the messages are cut short or differ in the lengths of their frames.
    """
    order = byte_order(data[0])
    size = u32(data[0], _FRAME_SIZE, order)
    child_size = u32(data[0], _after_frame(size), order)
    return _odometry_layout(order, size, child_size).table(data, ("frame_size", "child_size"))


@lru_cache
def _odometry_layout(order: str, frame_size: int, child_size: int) -> Layout:
    layout = with_header(order, frame_size)
    layout.string("child", child_size)
    layout.number("xyz", "d", 3)
    layout.number("rotation", "d", 4)
    layout.skip(8 * (36 + 6))  # covariance of the pose, twist
    layout.number("twist_covariance", "d", 36)
    return layout


def sighting_table(data: Sequence[bytes]) -> tuple[Any, list[tuple[str, ...]]]:
    """Rows (n,) of Sighting with stamp, ``frame``, ``z`` and ``covariance``; identities and robots.

    Raises:
        CdrError: a message is cut short or is none, or they differ in their frames.
    """
    order = byte_order(data[0])
    size = u32(data[0], _FRAME_SIZE, order)
    layout = _sighting_layout(order, size)
    rows = layout.table([one[: layout.size] for one in data], ("frame_size", "frame"))
    string(data[0][_FRAME_SIZE + 4 :][:size])
    return rows, last_strings(data, layout.size, order, 2)


@lru_cache
def _sighting_layout(order: str, frame_size: int) -> Layout:
    layout = with_header(order, frame_size)
    layout.number("z", "d", 3)
    layout.number("covariance", "d", 9)
    return layout


def scan_table(data: Sequence[bytes]) -> Any:
    """Rows (n,) of sensor_msgs/LaserScan with stamp, ``frame``, limits and ``ranges`` (b,).

    Raises:
        CdrError: the messages are cut short or differ in their frames or in the number of beams.
    """
    order = byte_order(data[0])
    size = u32(data[0], _FRAME_SIZE, order)
    at = _after_frame(size) + 4 * len(_LIMITS)
    beams = u32(data[0], at, order)
    intensities = u32(data[0], at + 4 + 4 * beams, order)
    same = ("frame_size", "frame", "ranges_size", "intensities_size")
    rows = _scan_layout(order, size, beams, intensities).table(data, same)
    try:
        rows["frame"][0].decode()
    except UnicodeDecodeError as error:
        raise CdrError(str(error)) from error
    return rows


_LIMITS = (
    "angle_min", "angle_max", "angle_increment", "time_increment", "scan_time", "range_min",
    "range_max",
)  # fmt: skip


@lru_cache
def _scan_layout(order: str, frame_size: int, beams: int, intensities: int) -> Layout:
    layout = with_header(order, frame_size)
    for name in _LIMITS:
        layout.number(name, "f")
    layout.number("ranges_size", "I")
    layout.number("ranges", "f", beams)
    layout.number("intensities_size", "I")
    layout.skip(4 * intensities)
    return layout


def _true_pose_table(data: Sequence[bytes]) -> Any:
    order = byte_order(data[0])
    layout = with_header(order, u32(data[0], _FRAME_SIZE, order))
    layout.number("pose", "d", 3)
    return layout.table(data, ("frame_size",))


def with_header(order: str, frame_size: int) -> Layout:
    """A layout that begins with a std_msgs/Header."""
    layout = Layout(order)
    layout.number("sec", "i")
    layout.number("nanosec", "I")
    layout.string("frame", frame_size)
    return layout


def stamps_ns(rows: Any) -> IntArray:
    """Stamps (n,) ns of the rows of a table."""
    return np.asarray(rows["sec"].astype(np.int64) * 1_000_000_000 + rows["nanosec"])


def decode_true_poses(data: Sequence[bytes]) -> tuple[IntArray, Array]:
    """Stamps (n,) ns and poses (n, 3) of many `TRUE_POSE` messages at once.

    Ground truth of motion capture can be most of a log. Messages that differ in the length of
    their frames are decoded one by one; those that cannot be decoded are left out.
    """
    try:
        rows = _true_pose_table(data)
    except (CdrError, IndexError):  # IndexError: there are none
        return _true_poses_singly(data)
    return stamps_ns(rows), rows["pose"].astype(float)


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
        struct.pack_into("<iI", data, 4, *seconds_and_rest(stamp_ns))
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
    return bytes((DEFINITIONS.get(schema, own) + separator + nested).encode())


def time(stamp_ns: int) -> Any:
    """builtin_interfaces/Time of integer nanoseconds.

    Raises:
        LogError: the stamp does not fit the signed 32-bit seconds of ROS 2.
    """
    seconds, nanoseconds = seconds_and_rest(stamp_ns)
    return build("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)


def seconds_and_rest(stamp_ns: int) -> tuple[int, int]:
    """Seconds and nanoseconds of integer nanoseconds.

    Raises:
        LogError: the stamp does not fit the signed 32-bit seconds of ROS 2.
    """
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
