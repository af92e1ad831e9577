"""ROS messages to the records of `graphslam.core.records`: one row of `DECODERS` per schema.

`decode_messages` decodes messages of a topic in its `TopicContext`. What must be dropped is counted
by reason. Every decoder requires finite numbers and positive definite covariances.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from graphslam.core import records
from graphslam.core.geometry import Array
from graphslam.logs import physical_limits as limits
from graphslam.logs import schemas
from graphslam.logs.cdr import CdrError
from graphslam.logs.laser_noise import BeamNoise
from graphslam.logs.mounts import Mount, levelled
from graphslam.logs.point_cloud import beam_step, cloud_points, is_planar, sweep_of
from graphslam.logs.record_checks import (
    UnusableMessageError,
    check_beams,
    check_finite,
    check_pose,
    check_sighting,
    check_wheels,
    checked_covariance,
)
from graphslam.logs.sighting_covariances import (
    common_covariance,
    polar_covariances,
    states_none,
)

#: decimals of a heading, rad, that are taken from a quaternion. Written again, it differs by 1e-16:
#: a solution, which ends where it has converged, would differ by 1e-9 m
HEADING_DECIMALS = 12
#: why a scan is dropped
_OTHER_LASER = "scan: of another laser on the same topic"


@dataclass(frozen=True)
class TopicContext:
    """What a decoder needs to know about a topic in addition to the message.

    ``mounts`` gives the pose (3,) of each sensor frame in the base frame; ``inverted`` names the
    frames of sensors that are mounted upside down, ``tilted`` has the mounts of those that are not
    level. Ranges of ``no_return_m`` or more mean no return; ``range_noise`` is that of the others,
    None where it is not known. With ``at_once`` all beams of a scan count as measured at its stamp.
    ``beams`` counts dropped beams of scans that are kept, by reason. With ``without_ranges`` scans
    get no ranges: only when they were taken is of interest. ``by_log_time``: the messages have no
    stamps; that of their recording is taken. ``sensor``: see `records.Scan`. ``only_frame``: if
    given, scans in other frames are dropped. ``session``: of a recording of several robots, which
    messages name as that recording does.
    """

    robot: str
    mounts: Mapping[str, Array] = field(default_factory=dict)
    inverted: frozenset[str] = frozenset()
    tilted: Mapping[str, Mount] = field(default_factory=dict)
    no_return_m: float = np.inf
    range_noise: BeamNoise | None = None
    at_once: bool = False
    left_joint: str = ""
    right_joint: str = ""
    beams: Counter[str] = field(default_factory=Counter)
    without_ranges: bool = False
    by_log_time: bool = False
    sensor: str = ""
    only_frame: str | None = None
    session: str = ""

    def named(self, robot: str) -> str:
        """The name in the log of a robot that a message names; empty if none."""
        return f"{self.session}.{robot}" if robot and self.session else robot


class Decoder(NamedTuple):
    """A row of `DECODERS`: type of record and decoder.

    With ``table`` the decoder takes the rows of many messages at once, see `schemas.scan_table`,
    and returns a record or a reason for dropping it for each; else one message at a time.
    """

    record: type[records.Message]
    decode: Callable[[Any, TopicContext], Any]
    table: Callable[[Sequence[bytes]], Any] | None = None


def scans(rows: Any, topic: TopicContext) -> list[records.Scan | str]:
    """sensor_msgs/LaserScan: ranges (n,) m, NaN without a return; beams counter-clockwise.

    ROS uses inf and NaN for no return, many drivers use 0. Negative ranges and ranges above
    `MAX_RANGE_M` are driver errors: these beams are dropped and counted.
    """
    beams = rows["ranges"].shape[1]
    ranges, usable = ((), ()) if topic.without_ranges else _usable_ranges(rows, topic.no_return_m)
    frame = rows["frame"][0].decode().lstrip("/")
    if topic.only_frame not in (None, frame):
        return [_OTHER_LASER for _ in rows]
    mount, inverted = topic.mounts.get(frame, _NO_MOUNT), frame in topic.inverted
    starts, steps = (rows[n].astype(float).tolist() for n in ("angle_min", "angle_increment"))
    periods = len(rows) * [0.0] if topic.at_once else _beam_periods(rows, beams)
    found: list[records.Scan | str] = []
    for i, stamp in enumerate(schemas.stamps_ns(rows).tolist()):
        start, step, period = starts[i], steps[i], periods[i]
        try:
            check_beams(beams, start, step)
        except UnusableMessageError as reason:
            found.append(str(reason))
            continue
        own = _NO_RANGES
        if not topic.without_ranges:
            own, fine = ranges[i].copy(), usable[i]  # a view would keep the scans of all rows
            if not fine.all():
                _count_defects(own[~fine], topic.beams)
                own[~fine] = np.nan
        if inverted:
            # seen from above, an upside-down laser scans clockwise
            start, step = -start, -step
        if step < 0:
            start, step, period = start + step * (beams - 1), -step, -period
            own = own[::-1].copy()
        scan = records.Scan(
            topic.robot, stamp, stamp, own, start, step, mount, period, sensor=topic.sensor
        )
        found.append(levelled(scan, topic.tilted[frame]) if frame in topic.tilted else scan)
    return found


def _beam_periods(rows: Any, beams: int) -> list[float]:
    """Time between two beams of each scan, s: ``time_increment`` where it can be true, else 0.

    Some drivers write nonsense: a sweep is neither longer than ``scan_time``, if that is given, nor
    than `physical_limits.MAX_SWEEP_S`.
    """
    between, whole = (rows[name].astype(float) for name in ("time_increment", "scan_time"))
    most = np.where((whole > 0) & (whole < limits.MAX_SWEEP_S), whole, limits.MAX_SWEEP_S)
    with np.errstate(invalid="ignore"):
        true = (between > 0) & (between * (beams - 1) <= limits.SWEEP_SLACK * most)
    found: list[float] = np.where(true, between, 0.0).tolist()
    return found


def _usable_ranges(rows: Any, no_return_m: float) -> tuple[Array, Array]:
    """Ranges (n, b) m, and which of them are measurements."""
    ranges = rows["ranges"].astype(float)
    low, high = (rows[name].astype(float)[:, None] for name in ("range_min", "range_max"))
    least = np.where(low > 0, low, 0.0)
    # limits of 0, NaN or inf were not set by the driver: no limit
    most = np.where(high > 0, np.minimum(high, limits.MAX_RANGE_M), limits.MAX_RANGE_M)
    usable = (ranges > 0) & (ranges >= least) & (ranges <= most) & (ranges < no_return_m)
    return ranges, usable


def _count_defects(ranges: Array, beams: Counter[str]) -> None:
    """Count ranges that are no measurements, by reason."""
    odd = ranges[~((ranges >= 0) & (ranges <= limits.MAX_RANGE_M))]
    if not len(odd):
        return
    finite = odd[np.isfinite(odd)]
    for defect, count in (
        ("NaN", np.count_nonzero(np.isnan(odd))),
        ("no return", np.count_nonzero(np.isinf(odd))),
        ("negative", np.count_nonzero(finite < 0)),
        ("absurd", np.count_nonzero(finite > 0)),
    ):
        if count:
            beams[f"range: {defect}"] += int(count)


def point_cloud(message: Any, topic: TopicContext) -> records.Scan:
    """sensor_msgs/PointCloud2 of a planar laser."""
    try:
        points = cloud_points(message)
    except ValueError as error:
        raise UnusableMessageError(f"cloud: {error}") from error
    if not is_planar(points):
        raise UnusableMessageError("cloud: points are not those of one level laser, or none")
    frame, stamp = frame_of(message), stamp_of(message)
    if topic.only_frame not in (None, frame):
        raise UnusableMessageError(_OTHER_LASER)
    if frame in topic.tilted:
        points, walls = topic.tilted[frame].levelled(points)
        points = points[walls]
        if not len(points):
            raise UnusableMessageError("cloud: a tilted laser sees the floor only")
    bearings, ranges = (_NO_RANGES, _NO_RANGES) if topic.without_ranges else sweep_of(points)
    ranges = np.where(ranges < min(topic.no_return_m, limits.MAX_RANGE_M), ranges, np.nan)
    if frame in topic.inverted:  # see `scans`
        bearings, ranges = -bearings[::-1], ranges[::-1].copy()
    start, step = (float(bearings[0]), beam_step(bearings)) if len(bearings) else (0.0, 1.0)
    mount = topic.mounts.get(frame, _NO_MOUNT)
    return records.Scan(topic.robot, stamp, stamp, ranges, start, step, mount, bearings=bearings)


def odometry(rows: Any, topic: TopicContext) -> list[records.OdometryPose | str]:
    """nav_msgs/Odometry: the pose (3,) of the base in the odometry frame."""
    q_x, q_y, q_z, q_w = rows["rotation"].T
    with np.errstate(all="ignore"):  # of numbers that are not finite
        norm = q_x * q_x + q_y * q_y + q_z * q_z + q_w * q_w
        sine, cosine = 2 * (q_w * q_z + q_x * q_y), norm - 2 * (q_y * q_y + q_z * q_z)
    # numpy's arctan2 depends on the machine in the last digit
    yaw = list(map(math.atan2, sine.tolist(), cosine.tolist()))
    poses = np.column_stack([rows["xyz"][:, :2], np.round(yaw, HEADING_DECIMALS)])
    is_rotation = ((norm > 0.5) & (norm < 2.0)).tolist()  # also false for NaN
    finite = np.isfinite(poses[:, :2]).all(axis=1).tolist()
    near = (np.abs(poses[:, :2]) <= limits.MAX_POSITION_M).all(axis=1).tolist()
    found: list[records.OdometryPose | str] = []
    for i, stamp in enumerate(schemas.stamps_ns(rows).tolist()):
        if not is_rotation[i]:
            found.append("odometry: quaternion is not a rotation")
        elif not finite[i]:
            found.append("odometry: not finite")
        elif not near[i]:
            found.append("odometry: farther than robots drive")
        else:
            found.append(records.OdometryPose(topic.robot, stamp, stamp, poses[i].copy()))
    return found


def joint_state(message: Any, topic: TopicContext) -> records.WheelAngles:
    """sensor_msgs/JointState: the angles of the left and the right wheel, rad."""
    positions = dict(zip(message.name, np.asarray(message.position).tolist(), strict=False))
    left = _joint(positions, topic.left_joint, "left")
    right = _joint(positions, topic.right_joint, "right")
    check_wheels(left, right)
    return records.WheelAngles(*_source(message, topic), left, right)


def sightings(
    rows: tuple[Any, Sequence[tuple[str, str]]], topic: TopicContext
) -> list[records.Sighting | str]:
    """graphslam_msgs/Sighting: bearing rad, range m and, if measured, direction rad."""
    numbers, of_what = rows
    measured, covs = numbers["z"].astype(float), numbers["covariance"].astype(float)
    sizes = np.where(np.isnan(measured[:, 2]), 2, 3).tolist()
    plain, usable = polar_covariances(measured, covs)
    unknown = states_none(measured, covs).tolist()
    mount = topic.mounts.get(numbers["frame"][0].decode().lstrip("/"), _NO_MOUNT)
    found: list[records.Sighting | str] = []
    for i, stamp in enumerate(schemas.stamps_ns(numbers).tolist()):
        z, (identity, robot) = measured[i, : sizes[i]].copy(), of_what[i]
        if usable[i]:
            cov = plain[i]
        else:
            try:
                check_sighting(z)
                cov = (
                    common_covariance(z)
                    if unknown[i]
                    else checked_covariance("sighting", covs[i], sizes[i])
                )
            except UnusableMessageError as reason:
                found.append(str(reason))
                continue
        may_be = _UNNAMED.get(robot)
        names = (identity or None, topic.named(robot) or None) if may_be is None else (None, None)
        seen = records.Sighting(
            topic.robot, stamp, stamp, z, cov, *names, mount,
            may_be or "landmark", not unknown[i],
        )  # fmt: skip
        found.append(seen)
    return found


def odometry_increment(message: Any, topic: TopicContext) -> records.OdometryIncrement:
    """graphslam_msgs/OdometryIncrement; it must end after its start."""
    start, stamp = schemas.stamp_ns(message.start), stamp_of(message)
    if stamp <= start:
        raise UnusableMessageError("increment: does not end after its start")
    delta = _pose("increment", message)
    cov = checked_covariance("increment", message.covariance, 3)
    return records.OdometryIncrement(topic.robot, stamp, stamp, start, delta, cov)


def relative_pose(message: Any, topic: TopicContext) -> records.RelativePose:
    """graphslam_msgs/RelativePose; without another robot it is relative to the robot itself."""
    start = schemas.stamp_ns(message.start)
    delta = _pose("relative pose", message)
    cov = checked_covariance("relative pose", message.covariance, 3)
    other = topic.named(message.other) or topic.robot
    return records.RelativePose(*_source(message, topic), other, start, delta, cov)


def true_pose(message: Any, topic: TopicContext) -> records.Truth:
    """graphslam_msgs/TruePose: pose (3,) of the base in the world frame."""
    return records.Truth(*_source(message, topic), _pose("truth", message))


def true_landmark(message: Any, _topic: TopicContext) -> records.TrueLandmark:
    """graphslam_msgs/TrueLandmark; ``phi`` of a point may be NaN."""
    if message.kind not in ("point", "segment", "line"):
        raise UnusableMessageError("true landmark: kind is not point, segment or line")
    pose = np.array([message.x, message.y, message.phi])
    check_finite("true landmark", pose[:2] if message.kind == "point" else pose)
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
    schemas.LASER_SCAN: Decoder(records.Scan, scans, schemas.scan_table),
    schemas.POINT_CLOUD: Decoder(records.Scan, point_cloud),
    schemas.ODOMETRY: Decoder(records.OdometryPose, odometry, schemas.odometry_table),
    schemas.JOINT_STATE: Decoder(records.WheelAngles, joint_state),
    schemas.SIGHTING: Decoder(records.Sighting, sightings, schemas.sighting_table),
    schemas.ODOMETRY_INCREMENT: Decoder(records.OdometryIncrement, odometry_increment),
    schemas.RELATIVE_POSE: Decoder(records.RelativePose, relative_pose),
    schemas.TRUE_POSE: Decoder(records.Truth, true_pose),
    schemas.TRUE_LANDMARK: Decoder(records.TrueLandmark, true_landmark),
    schemas.TRUE_ASSOCIATIONS: Decoder(records.TrueAssociations, true_associations),
}

_UNNAMED = {schemas.SOME_ROBOT: "robot", schemas.ANYTHING: "either"}
_NO_MOUNT = np.zeros(3)
_NO_RANGES = np.empty(0)


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


def _pose(what: str, message: Any) -> Array:
    return check_pose(what, np.array([message.x, message.y, message.phi]))


def _joint(positions: Mapping[str, float], name: str, side: str) -> float:
    names = [name] if name else [n for n in positions if side in n.lower()]
    if len(names) != 1 or names[0] not in positions:
        raise UnusableMessageError(
            f"joints: {side} wheel missing or ambiguous; set robots.NAME.{side}_joint"
        )
    return positions[names[0]]


def decode_messages(
    schema: str, data: Sequence[bytes], topic: TopicContext, dropped: Counter[str]
) -> list[records.Message | None]:
    """The records of messages of one topic; None for those that must be dropped.

    Args:
        schema: of the topic, a key of `DECODERS`.
        data: encoded messages, at least one.
        topic: its context.
        dropped: counts what is dropped by reason.
    """
    _, decode, table = DECODERS[schema]
    found: list[records.Message | str]
    try:
        # damaged numbers are looked at, and are nothing to warn of on the terminal
        with np.errstate(all="ignore"):
            if table is not None:
                found = decode(table(data), topic)
            else:
                found = [decode(schemas.decode(schema, one), topic) for one in data]
    except CdrError:
        found = [f"{schema}: cannot be decoded"]
    except UnusableMessageError as reason:
        found = [str(reason)]
    if len(found) < len(data):  # not all of them can be decoded together
        return [one for d in data for one in decode_messages(schema, [d], topic, dropped)]
    dropped.update(reason for reason in found if isinstance(reason, str))
    return [None if isinstance(one, str) else one for one in found]
