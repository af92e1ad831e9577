"""Foxglove's schemas as the messages of ROS 2 that are decoded.

LaserScan -> sensor_msgs/LaserScan, PoseInFrame -> nav_msgs/Odometry, FrameTransform and
FrameTransforms -> tf2_msgs/TFMessage; in protobuf, in JSON, and in CDR (package foxglove_msgs).

Source: https://docs.foxglove.dev/docs/sdk/schemas
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from graphslam.core.errors import LogError
from graphslam.logs import schemas
from graphslam.logs.cdr_writing import odometry_bytes, scan_bytes, tf_bytes
from graphslam.logs.wire import Field, Fields, WireError, from_json, from_protobuf

_TIME: Fields = {1: Field("seconds", "int"), 2: Field("nanos", "int")}
_VECTOR: Fields = {n: Field(name, "double") for n, name in enumerate("xyz", 1)}
_QUATERNION: Fields = {n: Field(name, "double") for n, name in enumerate("xyzw", 1)}
_POSE: Fields = {1: Field("position", _VECTOR), 2: Field("orientation", _QUATERNION)}
_STAMP, _FRAME = Field("timestamp", _TIME), Field("frame_id", "string")
_SCAN: Fields = {
    1: _STAMP, 2: _FRAME, 3: Field("pose", _POSE), 4: Field("start_angle", "double"),
    5: Field("end_angle", "double"), 6: Field("ranges", "doubles"),
}  # fmt: skip
_POSE_IN_FRAME: Fields = {1: _STAMP, 2: _FRAME, 3: Field("pose", _POSE)}
_TRANSFORM: Fields = {
    1: _STAMP, 2: Field("parent_frame_id", "string"), 3: Field("child_frame_id", "string"),
    4: Field("translation", _VECTOR), 5: Field("rotation", _QUATERNION),
}  # fmt: skip
_TRANSFORMS: Fields = {1: Field("transforms", _TRANSFORM, many=True)}

#: numbers of a pose that is none; floating-point noise apart
_NONE = 1e-9


class Kind(NamedTuple):
    """A schema: its fields in protobuf, and the ROS 2 schema and what makes it of a message."""

    fields: Fields
    schema: str
    convert: Callable[[Mapping[str, Any]], bytes]


def _scan(message: Mapping[str, Any]) -> bytes:
    """foxglove.LaserScan; angles go from the first to the last range.

    Raises:
        WireError: the scan has a place of its own in its frame, or no ranges.
    """
    position, turn = _pose(message)
    if max(map(abs, (*position, *turn[:2]))) > _NONE:
        raise WireError("a scan with an offset in its frame")
    yaw = 2 * math.atan2(turn[2], turn[3])
    with np.errstate(over="ignore"):  # what no float32 holds becomes infinite: no return
        ranges = np.array([_number(r) for r in message.get("ranges", ())]).astype(np.float32)
    start, end = _number(message.get("start_angle", 0)), _number(message.get("end_angle", 0))
    step = (end - start) / (len(ranges) - 1) if len(ranges) > 1 else 0.0
    frame = str(message.get("frame_id", ""))
    return scan_bytes(_stamp_ns(message), frame, start + yaw, step, ranges)


def _odometry(message: Mapping[str, Any]) -> bytes:
    """foxglove.PoseInFrame: a pose in the frame of the odometry; of what, it does not say."""
    position, turn = _pose(message)
    return odometry_bytes(_stamp_ns(message), str(message.get("frame_id", "")), position, turn)


def _transform(message: Mapping[str, Any]) -> bytes:
    return tf_bytes([_one_transform(message)])


def _transforms(message: Mapping[str, Any]) -> bytes:
    return tf_bytes([_one_transform(one) for one in message.get("transforms", ())])


KINDS: dict[str, Kind] = {
    "LaserScan": Kind(_SCAN, schemas.LASER_SCAN, _scan),
    "PoseInFrame": Kind(_POSE_IN_FRAME, schemas.ODOMETRY, _odometry),
    "FrameTransform": Kind(_TRANSFORM, schemas.TF_MESSAGE, _transform),
    "FrameTransforms": Kind(_TRANSFORMS, schemas.TF_MESSAGE, _transforms),
}


def to_cdr(name: str, encoding: str, data: bytes) -> bytes:
    """The message of the schema ``name`` of `KINDS` in ``data`` as one of ROS 2 in CDR.

    Raises:
        WireError: the bytes are not such a message.
    """
    kind = KINDS[name]
    message = from_json(data) if encoding == "json" else from_protobuf(data, kind.fields)
    try:
        return kind.convert(message)
    except (TypeError, ValueError, AttributeError, OverflowError, LogError) as error:
        raise WireError(str(error)) from error


def _one_transform(message: Mapping[str, Any]) -> tuple[int, str, str, tuple[float, ...]]:
    moved = _numbers(message.get("translation"), "xyz")
    turn = _quaternion(message.get("rotation"))
    names = (str(message.get("parent_frame_id", "")), str(message.get("child_frame_id", "")))
    return _stamp_ns(message), *names, (*moved, *turn)


def _pose(message: Mapping[str, Any]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    pose = message.get("pose") or {}
    return _numbers(pose.get("position"), "xyz"), _quaternion(pose.get("orientation"))


def _quaternion(found: Mapping[str, Any] | None) -> tuple[float, ...]:
    """X y z w; one that is left out, or all zero, does not turn."""
    turn = _numbers(found, "xyzw")
    return turn if any(turn) else (0.0, 0.0, 0.0, 1.0)


def _numbers(found: Mapping[str, Any] | None, names: str) -> tuple[float, ...]:
    # protobuf leaves out what is zero
    return tuple(_number((found or {}).get(name, 0.0)) for name in names)


def _number(value: Any) -> float:
    """JSON has no NaN and infinity: they are null or text."""
    return math.nan if value is None else float(value)


def _stamp_ns(message: Mapping[str, Any]) -> int:
    """Nanoseconds of a timestamp: of protobuf, of JSON by Foxglove, or of JSON by protobuf."""
    stamp = message.get("timestamp") or {}
    if isinstance(stamp, str):  # 2024-05-01T12:00:00.123456789Z
        whole, _, rest = stamp.removesuffix("Z").partition(".")
        seconds = np.datetime64(whole, "s").astype(np.int64)
        return int(seconds) * 1_000_000_000 + int(rest.ljust(9, "0")[:9] or 0)
    seconds = stamp.get("seconds", stamp.get("sec", 0))
    return int(seconds) * 1_000_000_000 + int(stamp.get("nanos", stamp.get("nsec", 0)))
