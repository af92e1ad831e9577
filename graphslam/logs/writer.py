"""Writing of logs: ROS 2 MCAP files that any ROS 2 or MCAP tool opens.

The only module that writes with `mcap`.
"""

import math
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import cache, partial
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, Self

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import ArrayLike

from graphslam import __version__
from graphslam.core.errors import OutputError
from graphslam.core.geometry import Array
from graphslam.core.output_folder import Identity, check_same, identity, unfinished
from graphslam.logs import schemas
from graphslam.logs.mcap_file import NOTES
from graphslam.logs.schemas import DEFAULT_ROBOT

# Small chunks: a damaged one loses less; costs a few per cent of compression.
_CHUNK_BYTES = 64 * 1024
_TIMES = 1 << 64  # of 64 bits


class LogWriter:
    """Context manager that writes a log.

    The file appears under its name only if the block ends without an error; until then it has a
    temporary name in the same folder. What another process writes there meanwhile is not replaced,
    nor is anything but a file. Equal calls give equal bytes. Topics of robot ``robot`` are
    ``/odom``, ``/scan``, ...; those of any other robot ``/NAME/odom``, ... Frames follow the same
    rule: ``odom``, ``base_link``, ``laser``.

    Every method takes ``stamp_ns``, the header stamp, and ``log_time_ns``, the time of recording
    (default: the stamp), which gives the order of recording.
    """

    def __init__(self, path: Path | str, notes: Mapping[str, str] | None = None) -> None:
        """Prepare to write ``path``; ``notes`` go into the metadata record `graphslam`."""
        self.path = Path(path)
        self.counts: dict[str, int] = {}
        self._notes = dict(notes or {})
        self._partial = self.path
        self._before: Identity = None
        self._stream: BinaryIO | None = None
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    def __enter__(self) -> Self:
        """Open the temporary file.

        Raises:
            OutputError: the folder is missing or not writable, or no plain file stands there.
        """
        if os.path.lexists(self.path) and (self.path.is_symlink() or not self.path.is_file()):
            raise OutputError(f"{self.path}: is no plain file, so it is not replaced")
        try:
            self._partial = unfinished(self.path)
            self._before = identity(self.path)
            # until the block begins, whose end removes the file, nobody else would: signals come
            with ExitStack() as undo:
                undo.callback(self._partial.unlink, missing_ok=True)
                self._stream = undo.enter_context(self._partial.open("wb"))
                self._writer = Writer(self._stream, _CHUNK_BYTES, CompressionType.ZSTD)
                self._writer.start(profile="ros2", library=f"graphslam {__version__}")
                undo.pop_all()
        except OSError as error:
            why = f"cannot be written: {error.strerror}; check the folder"
            raise OutputError(f"{self.path}: {why}") from error
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Finish and rename the file, or remove it if the block raised."""
        assert self._stream is not None  # __enter__ opened it
        try:
            if kind is None:
                if self._notes:
                    self._writer.add_metadata(NOTES, self._notes)
                self._writer.finish()  # type: ignore[no-untyped-call]
            self._stream.close()
            if kind is None:
                check_same(self.path, self._before)
                self._partial.replace(self.path)
        except OSError as problem:
            raise OutputError(f"{self.path}: cannot be written: {problem.strerror}") from problem
        finally:
            self._stream.close()
            self._partial.unlink(missing_ok=True)

    # ------------------------------------------------------------ measurements

    def odometry(
        self,
        robot: str,
        stamp_ns: int,
        pose: ArrayLike,
        *,
        twist_variances: tuple[float, float, float] | None = None,
        log_time_ns: int | None = None,
    ) -> None:
        """nav_msgs/Odometry on ``odom``: pose (3,) of the base in the odometry frame.

        ``twist_variances``: of the velocity along x, y and of turning, if they are known.
        """
        x, y, phi = np.asarray(pose, dtype=float).tolist()
        z, w = math.sin(phi / 2), math.cos(phi / 2)
        data = _odometry_template(robot, twist_variances).filled(stamp_ns, x, y, z, w)
        self._add(_topic(robot, "odom"), schemas.ODOMETRY, data, stamp_ns, log_time_ns)

    def wheel_angles(
        self,
        robot: str,
        stamp_ns: int,
        left_rad: float,
        right_rad: float,
        *,
        log_time_ns: int | None = None,
    ) -> None:
        """sensor_msgs/JointState on ``joint_states``: accumulated wheel angles, never wrapped."""
        self._build(
            schemas.JOINT_STATE,
            (_topic(robot, "joint_states"), ""),
            (stamp_ns, log_time_ns),
            name=["left_wheel_joint", "right_wheel_joint"],
            position=np.array([left_rad, right_rad]),
            velocity=np.zeros(0),
            effort=np.zeros(0),
        )

    def increment(
        self,
        robot: str,
        start_ns: int,
        stamp_ns: int,
        *,
        delta: ArrayLike,
        cov: ArrayLike,
        log_time_ns: int | None = None,
    ) -> None:
        """OdometryIncrement on ``odom_increment``.

        ``delta`` (3,) is the base's pose at ``stamp_ns`` in the base frame at ``start_ns``, ``cov``
        (3, 3) of additive errors along the axes of the frame at ``start_ns``.
        """
        self._build(
            schemas.ODOMETRY_INCREMENT,
            (_topic(robot, "odom_increment"), frame(robot, "base_link")),
            (stamp_ns, log_time_ns),
            start=schemas.time(start_ns),
            **xy_phi(delta),
            covariance=_flat(cov),
        )

    def scan(
        self,
        robot: str,
        stamp_ns: int,
        ranges: ArrayLike,
        *,
        angle_min_rad: float,
        angle_step_rad: float,
        range_max_m: float,
        range_min_m: float = 0.0,
        beam_period_s: float = 0.0,
        sensor: str = "laser",
        log_time_ns: int | None = None,
    ) -> None:
        """sensor_msgs/LaserScan on ``scan``: ranges (n,) m in the laser frame, kept as float32.

        Of another ``sensor`` than ``laser`` it is on ``scan_SENSOR``, in that frame. A beam without
        a return is written as inf or as a value above ``range_max_m``. ``stamp_ns`` is that of the
        first beam, and each comes ``beam_period_s`` after the one before.
        """
        values = np.asarray(ranges, dtype=np.float32)
        self._build(
            schemas.LASER_SCAN,
            (
                _topic(robot, "scan" if sensor == "laser" else f"scan_{sensor}"),
                frame(robot, sensor),
            ),
            (stamp_ns, log_time_ns),
            angle_min=angle_min_rad,
            angle_max=angle_min_rad + angle_step_rad * (len(values) - 1),
            angle_increment=angle_step_rad,
            time_increment=beam_period_s,
            scan_time=beam_period_s * len(values),
            range_min=range_min_m,
            range_max=range_max_m,
            ranges=values,
            intensities=np.zeros(0, dtype=np.float32),
        )

    def mount(self, robot: str, stamp_ns: int, pose: ArrayLike, sensor: str = "laser") -> None:
        """tf2_msgs/TFMessage on ``/tf_static``: pose (3,) of the sensor in the base frame."""
        x, y, phi = np.asarray(pose, dtype=float).tolist()
        rotation = _rotation(math.sin(phi / 2), math.cos(phi / 2))
        transform = schemas.build(
            "geometry_msgs/msg/TransformStamped",
            header=schemas.header(stamp_ns, frame(robot, "base_link")),
            child_frame_id=frame(robot, sensor),
            transform=schemas.build(
                "geometry_msgs/msg/Transform", translation=_vector(x, y), rotation=rotation
            ),
        )
        message = schemas.build(schemas.TF_MESSAGE, transforms=[transform])
        self._add(_topic(DEFAULT_ROBOT, "tf_static"), schemas.TF_MESSAGE, message, stamp_ns, None)

    def sighting(
        self,
        robot: str,
        stamp_ns: int,
        z: ArrayLike,
        cov: ArrayLike,
        *,
        identity: str | None = None,
        seen_robot: str | None = None,
        sensor: str = "base_link",
        log_time_ns: int | None = None,
    ) -> None:
        """Sighting on ``sightings``: ``z`` (2,) or (3,), ``cov`` (2, 2) or (3, 3), zero if unknown.

        ``z`` is (bearing rad, range m[, direction rad]) in the frame of ``sensor``. ``seen_robot``
        is the name of a robot, `schemas.SOME_ROBOT` or `schemas.ANYTHING`; None for a landmark.
        """
        bearing, distance, *direction = np.asarray(z, dtype=float).tolist()
        full = np.zeros((3, 3))
        size = 2 + len(direction)
        full[:size, :size] = cov
        self._build(
            schemas.SIGHTING,
            (_topic(robot, "sightings"), frame(robot, sensor)),
            (stamp_ns, log_time_ns),
            bearing=bearing,
            range=distance,
            direction=direction[0] if direction else np.nan,
            covariance=full.ravel(),
            identity=identity or "",
            robot=seen_robot or "",
        )

    def relative_pose(
        self,
        robot: str,
        start_ns: int,
        stamp_ns: int,
        *,
        delta: ArrayLike,
        other: str | None = None,
        cov: ArrayLike,
        log_time_ns: int | None = None,
    ) -> None:
        """RelativePose on ``relative_poses``: the robot at ``stamp_ns`` relative to ``start_ns``.

        ``delta`` (3,) is in the base frame at ``start_ns`` of ``other`` (None: the robot itself),
        ``cov`` (3, 3) of additive errors along that frame's axes.
        """
        self._build(
            schemas.RELATIVE_POSE,
            (_topic(robot, "relative_poses"), frame(robot, "base_link")),
            (stamp_ns, log_time_ns),
            start=schemas.time(start_ns),
            **xy_phi(delta),
            covariance=_flat(cov),
            other=other or "",
        )

    # ------------------------------------------------------------ ground truth

    def truth(
        self, robot: str, stamp_ns: int, pose: ArrayLike, *, log_time_ns: int | None = None
    ) -> None:
        """TruePose on ``truth``: pose (3,) of the base in the world frame."""
        data = _truth_template().filled(stamp_ns, *np.asarray(pose, dtype=float).tolist())
        self._add(_topic(robot, "truth"), schemas.TRUE_POSE, data, stamp_ns, log_time_ns)

    def true_landmark(
        self,
        stamp_ns: int,
        identity: str,
        kind: str,
        pose: ArrayLike,
        *,
        extent: ArrayLike | None = None,
        log_time_ns: int | None = None,
    ) -> None:
        """TrueLandmark on ``/true_landmarks``: pose (3,), extent (2, 2) or None, world frame."""
        self._build(
            schemas.TRUE_LANDMARK,
            (_topic(DEFAULT_ROBOT, "true_landmarks"), "world"),
            (stamp_ns, log_time_ns),
            identity=identity,
            kind=kind,
            **xy_phi(pose),
            extent=np.zeros(0) if extent is None else _flat(extent),
        )

    def true_associations(
        self,
        robot: str,
        stamp_ns: int,
        of: str,
        names: Sequence[str],
        targets: ArrayLike,
        *,
        log_time_ns: int | None = None,
    ) -> None:
        """TrueAssociations on ``true_associations/OF`` for the beams of a scan, or for sightings.

        ``of``: the topic that they belong to (scan, sightings); ``targets`` (n,): indices into
        ``names``, -1 for nothing.
        """
        self._build(
            schemas.TRUE_ASSOCIATIONS,
            (_topic(robot, f"true_associations/{of}"), "world"),
            (stamp_ns, log_time_ns),
            names=list(names),
            targets=np.asarray(targets, dtype=np.int16),
        )

    def message(self, topic: str, schema: str, message: Any, stamp_ns: int) -> None:
        """Any ROS 2 message, made by `schemas.build`, on ``topic`` (with its leading slash)."""
        self._add(topic, schema, message, stamp_ns, None)

    def encoded(self, topic: str, schema: str, data: bytes, log_time_ns: int) -> None:
        """A message of a known schema in CDR, recorded at ``log_time_ns``, as it is."""
        self._add(topic, schema, data, log_time_ns, None)

    # ------------------------------------------------------------ internals

    def _build(
        self, schema: str, where: tuple[str, str], times: tuple[int, int | None], **fields: Any
    ) -> None:
        """Build a message and write it; topic and frame, stamp and log time, fields but header."""
        topic, frame_id = where
        message = schemas.build(schema, header=schemas.header(times[0], frame_id), **fields)
        self._add(topic, schema, message, *times)

    def _add(
        self, topic: str, schema: str, message: Any, stamp_ns: int, log_time_ns: int | None
    ) -> None:
        """Write a message made by `schemas.build`, or its bytes."""
        logged_ns = stamp_ns if log_time_ns is None else log_time_ns
        if not (0 <= logged_ns < _TIMES and 0 <= stamp_ns < _TIMES):
            raise OutputError(
                f"{self.path}: {topic}: a stamp of {stamp_ns} ns (recorded at {logged_ns} ns) "
                "cannot be written: MCAP counts from 1970"
            )
        channel = self._channel(topic, schema)
        sequence = self.counts[topic] = self.counts.get(topic, 0) + 1
        self._writer.add_message(
            channel_id=channel,
            log_time=logged_ns,
            publish_time=stamp_ns,
            data=message if isinstance(message, bytes) else schemas.encode(schema, message),
            sequence=sequence,
        )

    def _channel(self, topic: str, schema: str) -> int:
        if topic not in self._channels:
            if schema not in self._schemas:
                self._schemas[schema] = self._writer.register_schema(
                    schema, "ros2msg", schemas.definition(schema)
                )
            self._channels[topic] = self._writer.register_channel(
                topic, "cdr", self._schemas[schema], {"offered_qos_profiles": ""}
            )
        return self._channels[topic]


class Event(NamedTuple):
    """A message to be written: its stamp, and the call that writes it."""

    stamp_ns: int
    write: Callable[[LogWriter], None]

    @classmethod
    def of(cls, method: Callable[..., None], robot: str, stamp_ns: int, **fields: Any) -> "Event":
        """A call of a `LogWriter` method."""
        return cls(stamp_ns, partial(method, robot=robot, stamp_ns=stamp_ns, **fields))


@cache
def _odometry_template(
    robot: str, twist_variances: tuple[float, float, float] | None = None
) -> schemas.Template:
    """nav_msgs/Odometry with the numbers x, y and the quaternion's z, w."""
    covariance = np.zeros((6, 6))
    if twist_variances is not None:
        covariance[[0, 1, 5], [0, 1, 5]] = twist_variances
    x, y, z, w = marks = (1.25, 2.25, 3.25, 4.25)
    rotation = _rotation(z, w)
    point = schemas.build("geometry_msgs/msg/Point", x=x, y=y, z=0.0)
    pose = schemas.build("geometry_msgs/msg/Pose", position=point, orientation=rotation)
    at_rest = _vector(0.0, 0.0)
    twist = schemas.build("geometry_msgs/msg/Twist", linear=at_rest, angular=at_rest)
    message = schemas.build(
        schemas.ODOMETRY,
        header=schemas.header(0, frame(robot, "odom")),
        child_frame_id=frame(robot, "base_link"),
        pose=_with_covariance("Pose", np.zeros(36), pose=pose),
        twist=_with_covariance("Twist", covariance, twist=twist),
    )
    return schemas.Template(schemas.ODOMETRY, message, marks)


@cache
def _truth_template() -> schemas.Template:
    """TruePose with the numbers x, y, phi."""
    marks = (1.25, 2.25, 3.25)
    message = schemas.build(schemas.TRUE_POSE, header=schemas.header(0, "world"), **xy_phi(marks))
    return schemas.Template(schemas.TRUE_POSE, message, marks)


def _topic(robot: str, name: str) -> str:
    return f"/{name}" if robot == DEFAULT_ROBOT else f"/{robot}/{name}"


def frame(robot: str, name: str) -> str:
    """Name of a robot's frame as `LogWriter` writes it."""
    return name if robot == DEFAULT_ROBOT else f"{robot}/{name}"


def xy_phi(pose: ArrayLike) -> dict[str, float]:
    """A pose (3,) as the fields x, y, phi of a message or a JSON object."""
    return dict(zip(("x", "y", "phi"), np.asarray(pose, dtype=float).tolist(), strict=True))


def _flat(matrix: ArrayLike) -> Array:
    return np.asarray(matrix, dtype=float).ravel()


def _vector(x: float, y: float) -> Any:
    return schemas.build("geometry_msgs/msg/Vector3", x=x, y=y, z=0.0)


def _rotation(z: float, w: float) -> Any:
    return schemas.build("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=z, w=w)


def _with_covariance(kind: str, covariance: ArrayLike, **fields: Any) -> Any:
    """PoseWithCovariance or TwistWithCovariance; zeros mean unknown in ROS."""
    return schemas.build(
        f"geometry_msgs/msg/{kind}WithCovariance", covariance=_flat(covariance), **fields
    )
