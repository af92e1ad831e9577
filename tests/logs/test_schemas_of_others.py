"""Other schemas: the same drive gives the same trajectory, whatever its messages are made of."""

import json
import struct
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer
from room_log import MOUNT, START_NS, drive

import graphslam
from graphslam.core import records
from graphslam.core.config import Config
from graphslam.logs import LogWriter, foxglove, open_logs, schemas
from graphslam.logs.cdr import Decoder, Layout
from graphslam.logs.cdr_writing import scan_bytes, tf_bytes
from graphslam.logs.multi_echo import MULTI_ECHO
from graphslam.logs.tf_tree import transforms_of
from graphslam.logs.wire import WireError


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    return drive(tmp_path_factory.mktemp("drive") / "drive.mcap", truth=False)


@pytest.fixture(scope="module")
def room(log) -> list[records.Message]:
    return list(open_logs([log], Config()).messages())


@pytest.fixture(scope="module")
def expected(log):
    return graphslam.smooth(log).robots["robot"].final


def turned(phi: float) -> tuple[float, float]:
    return float(np.sin(phi / 2)), float(np.cos(phi / 2))


# ---------------------------------------------------------------- writers

Drive = list[records.Message]


def stamp_of(message: records.Message, seconds: str, rest: str) -> dict[str, int]:
    whole, part = divmod(message.stamp_ns, 10**9)
    return {seconds: whole, rest: part}


def json_value(value: float) -> object:
    return None if np.isnan(value) else float(value)


def in_json(path: Path, room: Drive, odometry: str) -> Path:
    """Foxglove's schemas in JSON, written with `mcap`."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channels = {}

        def add(topic: str, name: str, message: dict, stamp: int) -> None:
            if topic not in channels:
                schema = writer.register_schema(f"foxglove.{name}", "jsonschema", b"{}")
                channels[topic] = writer.register_channel(topic, "json", schema)
            writer.add_message(channels[topic], stamp, json.dumps(message).encode(), stamp)

        def pose_of(pose: np.ndarray, position: str, orientation: str) -> dict:
            z, w = turned(pose[2])
            return {
                position: {"x": float(pose[0]), "y": float(pose[1]), "z": 0.0},
                orientation: {"x": 0.0, "y": 0.0, "z": z, "w": w},
            }

        mount = {
            "timestamp": {"sec": START_NS // 10**9, "nsec": START_NS % 10**9},
            "parent_frame_id": "base_link",
            "child_frame_id": "laser",
            **pose_of(MOUNT, "translation", "rotation"),
        }
        add("/tf_static", "FrameTransforms", {"transforms": [mount]}, START_NS)
        for message in room:
            stamp = {"timestamp": stamp_of(message, "sec", "nsec")}
            if isinstance(message, records.Scan):
                scan = stamp | {
                    "frame_id": "laser",
                    "pose": pose_of(np.zeros(3), "position", "orientation"),
                    "start_angle": message.angle_min_rad,
                    "end_angle": message.angle_min_rad
                    + message.angle_step_rad * (len(message.ranges) - 1),
                    "ranges": [json_value(r) for r in message.ranges],
                    "intensities": [],
                }
                add("/scan", "LaserScan", scan, message.stamp_ns)
            elif odometry == "PoseInFrame":
                own = {"frame_id": "odom", "pose": pose_of(message.pose, "position", "orientation")}
                add("/odom", odometry, stamp | own, message.stamp_ns)
            else:
                own = {"parent_frame_id": "odom", "child_frame_id": "base_link"}
                own |= pose_of(message.pose, "translation", "rotation")
                add("/tf", odometry, stamp | own, message.stamp_ns)
        writer.finish()
    return path


def in_protobuf(path: Path, room: Drive, odometry: str) -> Path:
    """Foxglove's schemas in protobuf, written with their SDK."""
    sdk = pytest.importorskip("foxglove", reason="needs foxglove-sdk")
    from foxglove import channels, messages

    def stamp(ns: int) -> object:
        return messages.Timestamp(ns // 10**9, ns % 10**9)

    def vector(pose: np.ndarray) -> object:
        return messages.Vector3(x=float(pose[0]), y=float(pose[1]), z=0.0)

    def turn(pose: np.ndarray) -> object:
        z, w = turned(pose[2])
        return messages.Quaternion(x=0.0, y=0.0, z=z, w=w)

    def transform(ns: int, parent: str, child: str, pose: np.ndarray) -> object:
        return messages.FrameTransform(
            timestamp=stamp(ns), parent_frame_id=parent, child_frame_id=child,
            translation=vector(pose), rotation=turn(pose),
        )  # fmt: skip

    context = sdk.Context()
    with sdk.open_mcap(path, context=context):
        scans = channels.LaserScanChannel("/scan", context=context)
        static = channels.FrameTransformsChannel("/tf_static", context=context)
        static.log(
            messages.FrameTransforms(transforms=[transform(START_NS, "base_link", "laser", MOUNT)]),
            log_time=START_NS,
        )
        kind = {"PoseInFrame": channels.PoseInFrameChannel}.get(
            odometry, channels.FrameTransformChannel
        )
        poses = kind("/odom" if odometry == "PoseInFrame" else "/tf", context=context)
        for message in room:
            ns = message.stamp_ns
            if isinstance(message, records.Scan):
                end = message.angle_min_rad + message.angle_step_rad * (len(message.ranges) - 1)
                own = messages.LaserScan(
                    timestamp=stamp(ns), frame_id="laser", start_angle=message.angle_min_rad,
                    end_angle=end, ranges=message.ranges.tolist(),
                )  # fmt: skip
                scans.log(own, log_time=ns)
            elif odometry == "PoseInFrame":
                pose = messages.Pose(position=vector(message.pose), orientation=turn(message.pose))
                own = messages.PoseInFrame(timestamp=stamp(ns), frame_id="odom", pose=pose)
                poses.log(own, log_time=ns)
            else:
                poses.log(transform(ns, "odom", "base_link", message.pose), log_time=ns)
    return path


def with_echoes(path: Path, room: Drive, _odometry: str) -> Path:
    """Scans as MultiEchoLaserScan of two echoes, of which the first is the wall's."""
    build = schemas.build
    with LogWriter(path) as out:
        out.mount("robot", START_NS, MOUNT)
        for message in room:
            if isinstance(message, records.OdometryPose):
                out.odometry("robot", message.stamp_ns, message.pose)
                continue
            echoes = [
                build(
                    "sensor_msgs/msg/LaserEcho",
                    echoes=np.array([] if np.isnan(r) else [r, r + 1], dtype=np.float32),
                )
                for r in message.ranges
            ]
            scan = build(
                MULTI_ECHO,
                header=schemas.header(message.stamp_ns, "laser"),
                angle_min=message.angle_min_rad,
                angle_max=0.0,
                angle_increment=message.angle_step_rad,
                time_increment=0.0,
                scan_time=0.0,
                range_min=0.0,
                range_max=20.0,
                ranges=echoes,
                intensities=[],
            )
            out.message("/scan", MULTI_ECHO, scan, message.stamp_ns)
    return path


CASES: dict[str, tuple[Callable[[Path, Drive, str], Path], str]] = {
    "JSON, PoseInFrame": (in_json, "PoseInFrame"),
    "JSON, FrameTransform": (in_json, "FrameTransform"),
    "protobuf, PoseInFrame": (in_protobuf, "PoseInFrame"),
    "protobuf, FrameTransform": (in_protobuf, "FrameTransform"),
    "MultiEchoLaserScan": (with_echoes, ""),
}


# ---------------------------------------------------------------- tests


@pytest.mark.parametrize("name", CASES)
def test_other_schemas_give_the_same_trajectory(name, room, expected, tmp_path):
    write, odometry = CASES[name]
    path = write(tmp_path / "log.mcap", room, odometry)
    log = open_logs([path], Config())
    found = list(log.messages())
    assert [(type(m), m.stamp_ns) for m in found] == [(type(m), m.stamp_ns) for m in room]
    assert {m.robot for m in found} == {"robot"} and not log.dropped.keys() - {"range: NaN"}
    for mine, theirs in zip(found, room, strict=True):
        if isinstance(mine, records.Scan):
            np.testing.assert_array_equal(mine.ranges, theirs.ranges)
            np.testing.assert_allclose(mine.mount, theirs.mount, atol=1e-12)
            np.testing.assert_allclose(mine.angles, theirs.angles, atol=1e-6)
        else:
            np.testing.assert_allclose(mine.pose, theirs.pose, atol=1e-12)
    trajectory = graphslam.smooth(path).robots["robot"].final
    np.testing.assert_array_equal(trajectory.stamps_ns, expected.stamps_ns)
    # headings written again as text or quaternion differ by 1e-16, which is not read
    np.testing.assert_array_equal(trajectory.poses, expected.poses)


def test_first_echoes_are_as_long_after_each_other_as_all_echoes(tmp_path):
    """By these times a sweep is corrected for the motion of the robot."""
    beams = [schemas.build("sensor_msgs/msg/LaserEcho", echoes=np.float32([2, 3]))] * 5
    scan = schemas.build(
        MULTI_ECHO, header=schemas.header(START_NS, "laser"), angle_min=-1.0, angle_max=1.0,
        angle_increment=0.5, time_increment=0.001, scan_time=0.025, range_min=0.1,
        range_max=30.0, ranges=beams, intensities=[],
    )  # fmt: skip
    with LogWriter(tmp_path / "log.mcap") as out:
        out.odometry("robot", START_NS, np.zeros(3))
        out.message("/scan", MULTI_ECHO, scan, START_NS)
    *_, found = open_logs([tmp_path / "log.mcap"], Config()).messages()
    assert found.beam_period_s == pytest.approx(0.001)


@pytest.mark.parametrize("encoding", ["json", "protobuf"])
@pytest.mark.parametrize("name", foxglove.KINDS)
@given(data=st.binary(max_size=60))
def test_bytes_that_are_no_message_are_refused_or_read(name, encoding, data):
    """Never another error: a damaged message is counted, it does not stop the reading."""
    with suppress(WireError):
        assert foxglove.to_cdr(name, encoding, data)


@pytest.mark.parametrize(
    "stamp", [{"sec": 7, "nsec": 5}, {"seconds": "7", "nanos": 5}, "1970-01-01T00:00:07.000000005Z"]
)
def test_timestamps_in_json_have_three_forms(stamp):
    message = {"timestamp": stamp, "parent_frame_id": "a", "child_frame_id": "b"}
    data = foxglove.to_cdr("FrameTransform", "json", json.dumps(message).encode())
    assert transforms_of(data) == [(7_000_000_005, "a", "b", (0, 0, 0, 0, 0, 0, 1))]


def test_a_scan_that_is_turned_in_its_frame_has_turned_beams_and_one_that_is_moved_is_refused():
    message = {"frame_id": "base", "start_angle": -1.0, "end_angle": 1.0, "ranges": [1, 2, 3]}
    z, w = turned(0.5)
    message["pose"] = {"orientation": {"x": 0, "y": 0, "z": z, "w": w}}
    data = foxglove.to_cdr("LaserScan", "json", json.dumps(message).encode())
    scan = schemas.decode(schemas.LASER_SCAN, data)
    assert scan.angle_min == pytest.approx(-0.5) and scan.angle_increment == pytest.approx(1.0)
    message["pose"] = {"position": {"x": 0.2, "y": 0, "z": 0}}
    with pytest.raises(WireError, match="offset"):
        foxglove.to_cdr("LaserScan", "json", json.dumps(message).encode())


@pytest.mark.parametrize("frame", ["", "a", "laser", "robot1/laser_frame"])
def test_what_is_written_is_what_the_reference_reads(frame):
    """Alignment depends on the lengths of names."""
    ranges, limits, times = np.float32([1, np.inf, 3]), (0.1, 9.0), (0.25, 0.5)
    data = scan_bytes(5_000_000_007, frame, -1.0, 0.5, ranges, limits, times)
    store = schemas._typestore()
    scan = store.deserialize_cdr(data, schemas.LASER_SCAN)
    assert scan.header.frame_id == frame and scan.header.stamp.nanosec == 7
    assert scan.ranges.tolist() == [1, np.inf, 3] and scan.range_max == 9.0
    assert (scan.time_increment, scan.scan_time) == times
    transforms = [(k, frame, f"child{'x' * k}", tuple(range(7))) for k in range(5)]
    message = store.deserialize_cdr(tf_bytes(transforms), schemas.TF_MESSAGE)
    names = [(t.header.frame_id, t.child_frame_id) for t in message.transforms]
    assert names == [(parent, child) for _, parent, child, _ in transforms]
    assert [tuple(t) for t in transforms_of(tf_bytes(transforms))] == transforms
    for transform in message.transforms:
        assert (transform.transform.translation.z, transform.transform.rotation.w) == (2, 6)


def test_names_of_types_without_msg_are_those_of_early_recordings(tmp_path, log):
    """`sensor_msgs/LaserScan` for `sensor_msgs/msg/LaserScan`."""
    path = tmp_path / "log.mcap"
    with path.open("wb") as target, log.open("rb") as source:
        writer = Writer(target)
        writer.start()
        channels: dict[str, int] = {}
        for schema, channel, message in make_reader(source).iter_messages(log_time_order=False):
            if channel.topic not in channels:
                name = schema.name.replace("/msg/", "/")
                number = writer.register_schema(name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", number)
            times = message.log_time, message.publish_time
            writer.add_message(channels[channel.topic], times[0], message.data, times[1])
        writer.finish()
    early, usual = (open_logs([p], Config()) for p in (path, log))
    assert early.topics and early.topics == usual.topics
    assert len(list(early.messages())) == len(list(usual.messages()))


@pytest.mark.parametrize("frame", [b"", b"laser"])
def test_strings_without_their_end_are_read_alike_one_by_one_and_many_at_once(frame):
    """Some writers leave the zero byte out. Were one way to refuse it, a laser would have no mount
    though its scans are read."""
    data = b"\0\1\0\0" + struct.pack("<iII", 5, 0, len(frame)) + frame
    decoder = Decoder({"Header": "int32 sec\nuint32 nanosec\nstring frame_id"})
    assert decoder.decode("Header", data).frame_id == frame.decode()
    layout = Layout("<")
    layout.number("sec", "i")
    layout.number("nanosec", "I")
    layout.string("frame", len(frame))
    assert layout.table([data], ("frame",))["frame"].tolist() == [frame]
