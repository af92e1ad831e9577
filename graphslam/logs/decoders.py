"""ROS messages to the records of `graphslam.core.records`: one row of `DECODERS` per schema.

A decoder is a function of the message and of the topic's `TopicContext`. It raises
`UnusableMessageError` with a reason when the message must be dropped; the caller counts reasons.
Every decoder requires finite numbers and positive definite covariances.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from graphslam.core import records
from graphslam.core.geometry import Array, is_positive
from graphslam.logs import schemas

# No planar laser measures farther; some drivers write 1e6 or 65535 for an error.
MAX_RANGE_M = 1000.0


class UnusableMessageError(Exception):
    """A message that must be dropped; its text is the reason under which it is counted."""


@dataclass(frozen=True)
class TopicContext:
    """What a decoder needs to know about a topic in addition to the message.

    ``mounts`` gives the pose (3,) of each sensor frame in the base frame; ``inverted`` names the
    frames of sensors that are mounted upside down. Ranges of ``no_return_m`` or more mean no
    return. ``beams`` counts dropped beams of scans that are kept, by reason.
    """

    robot: str
    mounts: Mapping[str, Array] = field(default_factory=dict)
    inverted: frozenset[str] = frozenset()
    no_return_m: float = np.inf
    left_joint: str = ""
    right_joint: str = ""
    beams: Counter[str] = field(default_factory=Counter)


class Decoder(NamedTuple):
    """A row of `DECODERS`: record type, decoder, and optionally a faster `schemas.decode`."""

    record: type[records.Message]
    decode: Callable[[Any, TopicContext], records.Message]
    deserialize: Callable[[bytes], Any] | None = None


def scan(message: Any, topic: TopicContext) -> records.Scan:
    """sensor_msgs/LaserScan: ranges (n,) m, NaN without a return; beams counter-clockwise.

    ROS uses inf and NaN for no return, many drivers use 0. Negative ranges and ranges above
    `MAX_RANGE_M` are driver errors: these beams are dropped and counted.
    """
    ranges = np.asarray(message.ranges, dtype=float)
    start, step = float(message.angle_min), float(message.angle_increment)
    if not len(ranges):
        raise UnusableMessageError("scan: no beams")
    if not (np.isfinite(start) and np.isfinite(step) and step):
        raise UnusableMessageError("scan: angle increment is zero or angles are not finite")
    finite = np.isfinite(ranges)
    for defect, beams in (
        ("NaN", np.isnan(ranges)),
        ("infinite", np.isinf(ranges)),
        ("negative", finite & (ranges < 0)),
        ("absurd", finite & (ranges > MAX_RANGE_M)),
    ):
        if beams.any():
            topic.beams[f"range: {defect}"] += int(beams.sum())
    low, high = float(message.range_min), float(message.range_max)
    usable = finite & (ranges > 0) & (ranges <= MAX_RANGE_M) & (ranges < topic.no_return_m)
    # limits of 0, NaN or inf were not set by the driver: no limit
    if low > 0:
        usable &= ranges >= low
    if high > 0:
        usable &= ranges <= high
    ranges[~usable] = np.nan
    frame = frame_of(message)
    if frame in topic.inverted:
        # seen from above, an upside-down laser scans clockwise
        start, step = -start, -step
    if step < 0:
        start, step = start + step * (len(ranges) - 1), -step
        ranges = ranges[::-1].copy()
    mount = topic.mounts.get(frame, _NO_MOUNT)
    return records.Scan(*_source(message, topic), ranges, start, step, mount)


def odometry(message: schemas.PlanarOdometry, topic: TopicContext) -> records.OdometryPose:
    """nav_msgs/Odometry: the pose (3,) of the base in the odometry frame."""
    stamp, x, y, (q_x, q_y, q_z, q_w) = message
    norm = q_x * q_x + q_y * q_y + q_z * q_z + q_w * q_w
    if not 0.5 < norm < 2.0:  # also false for NaN
        raise UnusableMessageError("odometry: quaternion is not a rotation")
    if not math.isfinite(x + y):
        raise UnusableMessageError("odometry: not finite")
    yaw = math.atan2(2 * (q_w * q_z + q_x * q_y), norm - 2 * (q_y * q_y + q_z * q_z))
    return records.OdometryPose(topic.robot, stamp, stamp, np.array([x, y, yaw]))


def joint_state(message: Any, topic: TopicContext) -> records.WheelAngles:
    """sensor_msgs/JointState: the angles of the left and the right wheel, rad."""
    positions = dict(zip(message.name, np.asarray(message.position).tolist(), strict=False))
    left = _joint(positions, topic.left_joint, "left")
    right = _joint(positions, topic.right_joint, "right")
    _check_finite("joints", np.array([left, right]))
    return records.WheelAngles(*_source(message, topic), left, right)


def sighting(message: Any, topic: TopicContext) -> records.Sighting:
    """graphslam_msgs/Sighting: bearing rad, range m and, if measured, direction rad."""
    size = 2 if np.isnan(message.direction) else 3
    z = np.array([message.bearing, message.range, message.direction])[:size]
    cov = _covariance("sighting", message.covariance, size)
    _check_finite("sighting", z)
    if z[1] <= 0:
        raise UnusableMessageError("sighting: range is not positive")
    mount = topic.mounts.get(frame_of(message), _NO_MOUNT)
    identity, seen = message.identity or None, message.robot or None
    return records.Sighting(*_source(message, topic), z, cov, identity, seen, mount)


def odometry_increment(message: Any, topic: TopicContext) -> records.OdometryIncrement:
    """graphslam_msgs/OdometryIncrement; it must end after its start."""
    start, stamp = schemas.stamp_ns(message.start), stamp_of(message)
    if stamp <= start:
        raise UnusableMessageError("increment: does not end after its start")
    delta = _pose("increment", message)
    cov = _covariance("increment", message.covariance, 3)
    return records.OdometryIncrement(topic.robot, stamp, stamp, start, delta, cov)


def relative_pose(message: Any, topic: TopicContext) -> records.RelativePose:
    """graphslam_msgs/RelativePose; without another robot it is relative to the robot itself."""
    start = schemas.stamp_ns(message.start)
    delta = _pose("relative pose", message)
    cov = _covariance("relative pose", message.covariance, 3)
    other = message.other or topic.robot
    return records.RelativePose(*_source(message, topic), other, start, delta, cov)


def true_pose(message: Any, topic: TopicContext) -> records.Truth:
    """graphslam_msgs/TruePose: pose (3,) of the base in the world frame."""
    return records.Truth(*_source(message, topic), _pose("truth", message))


def true_landmark(message: Any, _topic: TopicContext) -> records.TrueLandmark:
    """graphslam_msgs/TrueLandmark; ``phi`` of a point may be NaN."""
    if message.kind not in ("point", "segment", "line"):
        raise UnusableMessageError("true landmark: kind is not point, segment or line")
    pose = np.array([message.x, message.y, message.phi])
    _check_finite("true landmark", pose[:2] if message.kind == "point" else pose)
    extent = np.asarray(message.extent, dtype=float)
    if len(extent) not in (0, 4):
        raise UnusableMessageError("true landmark: extent is not x1 y1 x2 y2")
    ends = extent.reshape(2, 2) if len(extent) else None
    stamp = stamp_of(message)
    return records.TrueLandmark("", stamp, stamp, message.identity, message.kind, pose, ends)


def true_associations(message: Any, topic: TopicContext) -> records.TrueAssociations:
    """graphslam_msgs/TrueAssociations; every target must be among the names."""
    names, targets = tuple(message.names), np.asarray(message.targets, dtype=np.int64)
    if len(targets) and not -1 <= targets.min() <= targets.max() < len(names):
        raise UnusableMessageError("true associations: a target is not among the names")
    return records.TrueAssociations(*_source(message, topic), names, targets)


DECODERS: dict[str, Decoder] = {
    schemas.LASER_SCAN: Decoder(records.Scan, scan),
    schemas.ODOMETRY: Decoder(records.OdometryPose, odometry, schemas.decode_odometry),
    schemas.JOINT_STATE: Decoder(records.WheelAngles, joint_state),
    schemas.SIGHTING: Decoder(records.Sighting, sighting),
    schemas.ODOMETRY_INCREMENT: Decoder(records.OdometryIncrement, odometry_increment),
    schemas.RELATIVE_POSE: Decoder(records.RelativePose, relative_pose),
    schemas.TRUE_POSE: Decoder(records.Truth, true_pose),
    schemas.TRUE_LANDMARK: Decoder(records.TrueLandmark, true_landmark),
    schemas.TRUE_ASSOCIATIONS: Decoder(records.TrueAssociations, true_associations),
}

_NO_MOUNT = np.zeros(3)


def stamp_of(message: Any) -> int:
    """Header stamp of a message, integer nanoseconds."""
    return schemas.stamp_ns(message.header.stamp)


def frame_of(message: Any) -> str:
    """Frame of a message's header, without the leading slash that ROS 1 tools write."""
    return str(message.header.frame_id).lstrip("/")


def _source(message: Any, topic: TopicContext) -> tuple[str, int, int]:
    """The first fields of every record: robot, stamp and time, which is the stamp at first."""
    stamp = stamp_of(message)
    return topic.robot, stamp, stamp


def _check_finite(what: str, values: Array) -> None:
    if not np.isfinite(values).all():
        raise UnusableMessageError(f"{what}: not finite")


def _pose(what: str, message: Any) -> Array:
    pose = np.array([message.x, message.y, message.phi])
    _check_finite(what, pose)
    return pose


def _covariance(what: str, values: Any, size: int) -> Array:
    """The upper left (size, size) block of nine numbers, made exactly symmetric."""
    cov = np.asarray(values, dtype=float).reshape(3, 3)[:size, :size]
    cov = np.asarray((cov + cov.T) / 2)
    _check_finite(what, cov)
    if not is_positive(cov):
        raise UnusableMessageError(f"{what}: covariance is not positive definite")
    return cov


def _joint(positions: Mapping[str, float], name: str, side: str) -> float:
    names = [name] if name else [n for n in positions if side in n.lower()]
    if len(names) != 1 or names[0] not in positions:
        raise UnusableMessageError(
            f"joints: {side} wheel missing or ambiguous; set robots.NAME.{side}_joint"
        )
    return positions[names[0]]
