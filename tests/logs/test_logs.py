"""Logs: what is read equals what was written, in order of time, whatever state the file is in."""

import dataclasses
import re
import struct
from collections import Counter
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from paths import real_data
from rosbags.interfaces import Nodetype

from graphslam.core import records
from graphslam.core.config import Config, LogsConfig, RobotConfig
from graphslam.core.config_io import load_config
from graphslam.core.errors import LogError, OutputError
from graphslam.logs import LogSet, LogWriter, decoders, inspect_logs, open_logs, schemas
from graphslam.logs.cdr import CdrError
from graphslam.logs.containers import open_recording
from graphslam.logs.decoders import DECODERS, TopicContext, decode_messages
from graphslam.logs.recording import raw_messages
from graphslam.logs.schemas import ANYTHING, SOME_ROBOT
from graphslam.logs.time_order import TOO_LATE, MessageSorter
from tests import mutations

S = 1_000_000_000
COV2, COV3 = np.diag([0.01, 0.04]), np.diag([0.01, 0.02, 0.03])
SCAN = {"angle_min_rad": -1.0, "angle_step_rad": 0.02, "range_max_m": 20.0}


def read(path: Path, config: Config | None = None) -> tuple[LogSet, list[records.Message]]:
    logs = open_logs([path], config or Config())
    return logs, list(logs.messages())


def odometry_log(path: Path, stamps: Sequence[int], log_times: Sequence[int] | None = None) -> Path:
    """A log whose k-th message, in the order of recording, has the pose (k, 0, 0)."""
    with LogWriter(path) as log:
        for k, stamp in enumerate(stamps):
            log.odometry("robot", stamp, (k, 0, 0), log_time_ns=log_times[k] if log_times else k)
    return path


def drive(path: Path, seconds: int = 60, robot: str = "robot") -> Path:
    with LogWriter(path) as log:
        for k in range(seconds * 10):
            log.odometry(robot, k * S // 10 + S, (0.05 * k, 0, 0))
            if k % 2 == 0:
                ranges = 2 + np.random.default_rng(k).random(180)
                log.scan(robot, k * S // 10 + S + 7, ranges, **SCAN)
    return path


# ---------------------------------------------------------------- round trip


def test_every_kind_of_record_comes_back_as_it_was_written(tmp_path):
    path = tmp_path / "log.mcap"
    extent = np.array([[0.0, 1.0], [2.0, 3.0]])
    with LogWriter(path, {"stamps": "invented"}) as log:
        log.mount("robot1", 1, (0.2, -0.1, 0.3))
        log.odometry("robot1", 2 * S + 1, (1.0, 2.0, 3.0))
        log.scan("robot1", 2 * S + 2, [1.0, np.inf, 3.0], **SCAN)
        log.sighting("robot1", 3 * S, (0.1, 2.0), COV2, identity="7")
        log.sighting("robot1", 3 * S, (0.1, 2.0, -1.0), COV3, seen_robot="robot2")
        log.sighting("robot1", 3 * S, (0.1, 2.0), COV2, seen_robot=SOME_ROBOT)
        log.sighting("robot1", 3 * S, (0.1, 2.0), COV2, seen_robot=ANYTHING)
        log.relative_pose("robot1", S, 3 * S + 1, delta=(1, 2, 0.5), cov=COV3, other="robot2")
        log.truth("robot1", 3 * S + 2, (4, 5, 6))
        log.true_landmark(3 * S + 3, "wall", "segment", (1, 2, 0.1), extent=extent)
        log.increment("robot2", S, 3 * S + 4, delta=(0.1, 0.2, 0.3), cov=COV3)
        log.wheel_angles("robot3", 3 * S + 5, 10.5, 11.5)
    logs, messages = read(path)
    assert logs.robots == ("robot1", "robot2", "robot3")
    assert logs.notes == {"stamps": "invented"}
    assert not logs.warnings and not logs.repaired
    assert logs.dropped == {"range: no return": 1}
    assert logs.has_scans("robot1") and not logs.has_scans("robot2")
    odometry, scan, first, second, *unnamed, relative, truth, landmark, increment, wheels = messages
    assert isinstance(odometry, records.OdometryPose) and odometry.stamp_ns == 2 * S + 1
    np.testing.assert_allclose(odometry.pose, (1, 2, 3), atol=1e-15)
    assert isinstance(scan, records.Scan) and scan.robot == "robot1"
    np.testing.assert_array_equal(scan.ranges, [1, np.nan, 3])
    np.testing.assert_allclose(scan.mount, (0.2, -0.1, 0.3), atol=1e-15)
    np.testing.assert_allclose(scan.angles, [-1, -0.98, -0.96])
    assert (
        isinstance(first, records.Sighting) and first.z.shape == (2,) and first.cov.shape == (2, 2)
    )
    assert (first.identity, first.seen_robot) == ("7", None)
    assert isinstance(second, records.Sighting) and (second.identity, second.seen_robot) == (
        None,
        "robot2",
    )
    np.testing.assert_array_equal(second.cov, COV3)
    assert [(m.identity, m.seen_robot, m.may_be) for m in (first, second, *unnamed)] == [
        ("7", None, "landmark"),
        (None, "robot2", "landmark"),
        (None, None, "robot"),
        (None, None, "either"),
    ]
    assert isinstance(relative, records.RelativePose) and (relative.other, relative.start_ns) == (
        "robot2",
        S,
    )
    assert isinstance(truth, records.Truth) and truth.pose.tolist() == [4, 5, 6]
    assert isinstance(landmark, records.TrueLandmark) and landmark.robot == ""
    np.testing.assert_array_equal(landmark.extent, extent)
    assert isinstance(increment, records.OdometryIncrement) and increment.start_ns == S
    np.testing.assert_array_equal(increment.cov, COV3)
    assert isinstance(wheels, records.WheelAngles) and (wheels.left_rad, wheels.right_rad) == (
        10.5,
        11.5,
    )


def test_equal_calls_give_equal_bytes_and_a_ros2_file_of_cdr_only(tmp_path):
    one, two = drive(tmp_path / "one.mcap", 3), drive(tmp_path / "two.mcap", 3)
    assert one.read_bytes() == two.read_bytes()
    with one.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        assert reader.get_header().library.startswith("graphslam")
        summary = reader.get_summary()
        assert {c.message_encoding for c in summary.channels.values()} == {"cdr"}
        assert {s.encoding for s in summary.schemas.values()} == {"ros2msg"}


def test_a_log_is_written_where_a_string_says(tmp_path):
    """As every other path of the library's."""
    with LogWriter(f"{tmp_path}/named.mcap") as log:
        log.odometry("robot", S, np.zeros(3))
    assert len(read(tmp_path / "named.mcap")[1]) == 1


def test_a_log_that_failed_half_way_leaves_nothing_and_keeps_the_old_file(tmp_path):
    path = drive(tmp_path / "log.mcap", 1)
    before = path.read_bytes()
    with pytest.raises(RuntimeError, match="stop"), LogWriter(path) as log:
        log.odometry("robot", 1, (0, 0, 0))
        raise RuntimeError("stop")
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["log.mcap"]
    with pytest.raises(OutputError, match="cannot be written"), LogWriter(tmp_path / "no/log.mcap"):
        pass


def test_every_schema_of_ours_has_a_definition_and_every_decoder_a_schema():
    for name in (*DECODERS, *schemas.DEFINITIONS):
        assert b"std_msgs/Header header" in schemas.definition(name)
        assert name in DECODERS


def test_stamps_are_kept_to_the_digit(tmp_path):
    stamps = [976052857337284001 + k * 100_000_003 for k in range(5)]  # not exact as float64
    _, messages = read(odometry_log(tmp_path / "log.mcap", stamps))
    assert [m.stamp_ns for m in messages] == [m.time_ns for m in messages] == stamps


def test_reading_needs_memory_for_the_window_only(tmp_path):
    """The reader runs ahead of what it yields by the window and a batch, not by the log."""
    path = drive(tmp_path / "log.mcap", 120)
    logs = open_logs([path], Config())
    seen: list[int] = []
    original = DECODERS[schemas.ODOMETRY]

    def spy(rows, topic):
        found = original.decode(rows, topic)
        seen.append(found[-1].stamp_ns)
        return found

    DECODERS[schemas.ODOMETRY] = original._replace(decode=spy)
    try:
        lead = [seen[-1] - message.time_ns for message in logs.messages()]
    finally:
        DECODERS[schemas.ODOMETRY] = original
    # 128 messages at 15 Hz are read together
    assert max(lead) <= 14 * S


# ---------------------------------------------------------------- order


def test_odometry_comes_before_what_was_seen_at_the_same_time(tmp_path):
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        for k in range(1, 4):
            log.sighting("robot", k * S, (0, 1), COV2)
            log.scan("robot", k * S, [1, 2, 3], **SCAN)
            log.odometry("robot", k * S, (k, 0, 0))
    kinds = [type(m) for m in read(path)[1]]
    assert kinds[::3] == [records.OdometryPose] * 3


def test_topics_that_are_recorded_late_are_placed_by_their_stamps(tmp_path):
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        for k in range(100):
            log.odometry("robot", k * S // 10, (k, 0, 0), log_time_ns=k * S // 10)
            if k >= 15:  # scans arrive 1.5 s after their stamp
                stamp = (k - 15) * S // 10 + 1
                log.scan("robot", stamp, [1, 2, 3], **SCAN, log_time_ns=k * S // 10)
    logs, messages = read(path)
    assert [m.time_ns for m in messages] == sorted(m.stamp_ns for m in messages)
    assert len(messages) == 185 and not logs.dropped


def test_a_stamp_too_late_by_several_messages_is_placed_by_the_order_of_recording(tmp_path):
    """CARMEN: .604, 1.067, .802, .903: the second belongs between the first and the third."""
    milliseconds = [404, 503, 604, 1067, 802, 903, 1004, 1103]
    stamps = [ms * 1_000_000 for ms in milliseconds]
    logs, messages = read(odometry_log(tmp_path / "log.mcap", stamps))
    assert [m.pose[0] for m in messages] == list(range(8))
    assert messages[3].stamp_ns == 1067_000_000
    assert messages[3].time_ns == (604_000_000 + 802_000_000) // 2
    assert logs.repaired == {"stamp: glitch": 1} and not logs.dropped
    assert "1 stamps contradict" in logs.warnings[-1]


def test_a_run_of_late_stamps_is_spread_evenly(tmp_path):
    stamps = [ms * 1_000_000 for ms in (100, 200, 900, 901, 902, 600, 700, 800, 1000)]
    _, messages = read(odometry_log(tmp_path / "log.mcap", stamps))
    assert [m.time_ns // 1_000_000 for m in messages[2:5]] == [300, 400, 500]


def test_two_messages_that_only_overtook_each_other_go_by_their_stamps(tmp_path):
    logs, messages = read(odometry_log(tmp_path / "log.mcap", [1 * S, 3 * S, 2 * S, 4 * S]))
    assert [m.time_ns for m in messages] == [1 * S, 2 * S, 3 * S, 4 * S]
    assert [m.pose[0] for m in messages] == [0, 2, 1, 3]
    assert not logs.repaired and not logs.dropped


def test_one_absurd_stamp_in_the_future_or_at_zero_does_no_harm(tmp_path):
    stamps = [1000 * S + k * S // 10 for k in range(400)]
    stamps[100], stamps[200] = 4_000_000 * S // 2, 0
    logs, messages = read(odometry_log(tmp_path / "log.mcap", stamps))
    assert [int(m.pose[0]) for m in messages] == [k for k in range(400) if k != 200]
    assert sum(logs.dropped.values()) == 1


def test_a_message_older_than_the_window_is_dropped_and_counted(tmp_path):
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        for k in range(100):
            log.odometry("robot", k * S // 10 + S, (k, 0, 0))
        log.scan("robot", 2 * S, [1, 2, 3], **SCAN, log_time_ns=12 * S)
    logs, messages = read(path)
    assert len(messages) == 100 and sum(logs.dropped.values()) == 1
    (setting,) = re.findall("--set (logs.reorder_s=[0-9]+) keeps them", logs.warnings[-1])
    assert len(list(open_logs([path], load_config(None, [setting])).messages())) == 101
    assert "if a clock was set back, cut the recording there" in logs.warnings[-1]
    logs, messages = read(path, Config(logs=LogsConfig(reorder_s=20.0)))
    assert len(messages) == 101 and not logs.dropped


def test_equal_stamps_are_kept_and_counted_except_sightings_of_one_image(tmp_path):
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.odometry("robot", S, (0, 0, 0))
        for k in range(3):
            log.scan("robot", 2 * S, [1, 2, 3], **SCAN)
            log.sighting("robot", 2 * S, (0, 1 + k), COV2)
    logs, messages = read(path)
    assert len(messages) == 7 and logs.repaired == {"stamp: duplicate": 2}


def test_log_times_and_not_file_positions_tell_the_order_of_recording(tmp_path):
    stamps = list(range(S, 40 * S, S))
    shuffled = np.random.default_rng(1).permutation(len(stamps)).tolist()
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        for k in shuffled:
            log.odometry("robot", stamps[k], (k, 0, 0))
    logs, messages = read(path)
    assert [m.stamp_ns for m in messages] == stamps and not logs.repaired and not logs.dropped


@given(st.lists(st.tuples(st.sampled_from(["a", "b"]), st.integers(0, 60)), max_size=60))
def test_whatever_the_stamps_nothing_is_lost_uncounted_and_time_never_goes_back(recorded):
    line = MessageSorter(window_ns=10)
    messages = [(t, records.OdometryPose("robot", s, s, np.zeros(3))) for t, s in recorded]
    placed = [out for topic, message in messages for out in line.push(topic, message)]
    placed += line.finish()
    times = [message.time_ns for message in placed]
    dropped = sum(counts[TOO_LATE] for counts in line.counts.values())
    assert times == sorted(times) and len(placed) + dropped == len(recorded)
    assert {m.stamp_ns for m in placed} <= {stamp for _, stamp in recorded}


def test_increments_that_were_recorded_twice_count_once(tmp_path):
    """The second would double the path; that of another span stays."""
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        for k in (1, 1, 2, 3, 3):
            log.increment("robot", k * S, (k + 1) * S, delta=(1, 0, 0), cov=1e-4 * np.eye(3))
    logs, messages = read(path)
    assert [m.stamp_ns for m in messages] == [2 * S, 3 * S, 4 * S]
    assert {k: n for k, n in logs.dropped.items() if n} == {"increment: recorded twice": 2}
    assert any("2 increments were recorded twice" in warning for warning in logs.warnings)


def test_several_files_are_one_log(tmp_path):
    one, two = drive(tmp_path / "1.mcap", 5, "b"), drive(tmp_path / "2.mcap", 5, "a")
    logs = open_logs([one, two], Config())
    times = [m.time_ns for m in logs.messages()]
    assert logs.robots == ("a", "b") and len(times) == 150 and times == sorted(times)


def test_messages_can_be_read_twice(tmp_path):
    logs = open_logs([odometry_log(tmp_path / "log.mcap", [S, 3 * S, 3 * S])], Config())
    first = [m.time_ns for m in logs.messages()]
    warnings, repaired = list(logs.warnings), dict(logs.repaired)
    assert first == [m.time_ns for m in logs.messages()]
    assert warnings == logs.warnings and repaired == dict(logs.repaired)


# ---------------------------------------------------------------- contents


def scans_of(
    path: Path, ranges: Sequence[object], **shape: float
) -> tuple[LogSet, list[records.Scan]]:
    with LogWriter(path) as log:
        log.mount("robot", S, (0, 0, 0))
        log.odometry("robot", S, (0, 0, 0))
        for k, row in enumerate(ranges):
            log.scan("robot", (k + 2) * S, row, **(SCAN | shape))
    logs, messages = read(path)
    return logs, [m for m in messages if isinstance(m, records.Scan)]


def test_ranges_that_are_no_returns_become_nan_and_errors_are_counted(tmp_path):
    row = [1, np.nan, np.inf, -np.inf, 0, -2, 1e6, 0.01, 25, 20]
    logs, (scan,) = scans_of(tmp_path / "log.mcap", [row], range_min_m=0.1)
    expected = [1, *[np.nan] * 8, 20]
    np.testing.assert_array_equal(scan.ranges, expected)
    bad = {key: n for key, n in logs.dropped.items() if n}
    assert bad == {"range: NaN": 1, "range: no return": 2, "range: negative": 1, "range: absurd": 1}


def test_scans_without_beams_or_angles_are_dropped_and_counted(tmp_path):
    logs, scans = scans_of(tmp_path / "a.mcap", [[], [1, 2]])
    assert len(scans) == 1 and logs.dropped == {"scan: no beams": 1}
    for step in (0.0, np.nan):
        logs, scans = scans_of(tmp_path / "b.mcap", [[1, 2]], angle_step_rad=step)
        assert not scans and sum(logs.dropped.values()) == 1


def test_odometry_that_is_not_finite_is_dropped_and_counted(tmp_path):
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        for k, x in enumerate((0.0, np.nan, np.inf, 1.0)):
            log.odometry("robot", k * S, (x, 0, 0))
        log.odometry("robot", 4 * S, (0, 0, np.nan))
    logs, messages = read(path)
    assert len(messages) == 2 and sum(logs.dropped.values()) == 3


@pytest.mark.parametrize("code", [50.0, 81.83])
def test_the_range_that_means_no_return_is_found(tmp_path, code):
    rows = np.random.default_rng(0).uniform(1, 10, (50, 180)).round(2)
    rows[::2, 20:40] = code
    logs, scans = scans_of(tmp_path / "log.mcap", list(rows), range_max_m=100.0)
    assert np.isclose(logs.no_return_m("/scan"), code)
    assert np.isnan(scans[0].ranges).sum() == 20 and not np.isnan(scans[1].ranges).any()


def test_a_far_flat_wall_does_not_mean_no_return(tmp_path):
    """A robot at rest before a wall 8 m away, ranges in centimetres: equal maxima in every scan."""
    rows = 8 - np.random.default_rng(0).integers(0, 4, (50, 180)) / 100
    logs, _ = scans_of(tmp_path / "log.mcap", list(rows))
    assert logs.no_return_m("/scan") == np.inf


def test_an_upside_down_laser_and_a_clockwise_one_see_the_same_as_a_normal_one(tmp_path):
    """A return straight to the left stays on the left, whichever way the beams are counted."""
    path = tmp_path / "log.mcap"
    ranges = [1.0, 2.0, 3.0]  # at -1, -0.98 and -0.96 rad in the frame of the upside-down laser
    with LogWriter(path) as log:
        log.odometry("robot", S, (0, 0, 0))
        log.scan("robot", 2 * S, ranges, **SCAN)
        transform = schemas.build(
            "geometry_msgs/msg/Transform",
            translation=schemas.build("geometry_msgs/msg/Vector3", x=0.5, y=0.0, z=0.2),
            rotation=schemas.build("geometry_msgs/msg/Quaternion", x=1.0, y=0.0, z=0.0, w=0.0),
        )
        stamped = schemas.build(
            "geometry_msgs/msg/TransformStamped",
            header=schemas.header(S, "base_link"),
            child_frame_id="laser",
            transform=transform,
        )
        message = schemas.build(schemas.TF_MESSAGE, transforms=[stamped])
        log._add("/tf_static", schemas.TF_MESSAGE, message, S, None)
    _, (_, scan) = read(path)
    np.testing.assert_allclose(scan.ranges, ranges[::-1])
    np.testing.assert_allclose(scan.angles, [0.96, 0.98, 1.0], atol=1e-7)
    np.testing.assert_allclose(scan.mount, [0.5, 0, 0], atol=1e-15)
    shape = {"angle_min_rad": 1.0, "angle_step_rad": -0.02}
    _, (clockwise,) = scans_of(tmp_path / "clockwise.mcap", [ranges], **shape)
    np.testing.assert_allclose(clockwise.ranges, ranges[::-1])
    np.testing.assert_allclose(clockwise.angles, [0.96, 0.98, 1.0], atol=1e-7)


def test_the_mount_is_configured_or_found_or_warned_about(tmp_path):
    path = drive(tmp_path / "log.mcap", 2)  # has no tf_static
    logs, messages = read(path)
    assert "--set 'robots.robot.laser=" in logs.warnings[0] and len(logs.warnings) == 1
    config = Config(robots={"robot": RobotConfig(laser=(0.1, 0.2, 0.3))})
    logs, messages = read(path, config)
    scan = next(m for m in messages if isinstance(m, records.Scan))
    assert not logs.warnings and scan.mount.tolist() == [0.1, 0.2, 0.3]


def test_wheels_are_found_by_name_or_configured():
    message = schemas.build(
        schemas.JOINT_STATE,
        header=schemas.header(1, ""),
        name=["arm", "Left_wheel", "drive_b"],
        position=np.array([9.0, 1.0, 2.0]),
        velocity=np.zeros(0),
        effort=np.zeros(0),
    )
    decode = DECODERS[schemas.JOINT_STATE].decode
    with pytest.raises(Exception, match="right wheel missing"):
        decode(message, TopicContext("robot"))
    wheels = decode(message, TopicContext("robot", right_joint="drive_b"))
    assert (wheels.left_rad, wheels.right_rad) == (1.0, 2.0)


def test_one_source_of_odometry_is_chosen_and_said(tmp_path):
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        for k in range(3):
            log.wheel_angles("robot", k * S, k, k)
            log.odometry("robot", k * S, (k, 0, 0))
    logs, messages = read(path)
    assert {type(m) for m in messages} == {records.OdometryPose}
    (line,) = logs.warnings
    assert line.startswith("robot robot: odometry is taken from /odom; not used: /joint_states; ")
    config = Config(logs=LogsConfig(topics={"/joint_states": "alice"}))
    logs, messages = read(path, config)
    assert logs.robots == ("alice",) and {type(m) for m in messages} == {records.WheelAngles}


# ---------------------------------------------------------------- bad input


def error_of(path: Path, config: Config | None = None) -> str:
    with pytest.raises(LogError) as caught:
        open_logs([path], config or Config())
    text = str(caught.value)
    assert "\n" not in text and str(path) in text
    return text


def test_files_that_are_no_logs_get_one_clear_line(tmp_path):
    assert "no such file" in error_of(tmp_path / "missing.mcap")
    assert "is a directory" in error_of(tmp_path)
    text = tmp_path / "text.mcap"
    text.write_text("hello")
    assert "not an MCAP file" in error_of(text)
    text.write_bytes(b"")
    assert "not an MCAP file" in error_of(text)
    with LogWriter(tmp_path / "empty.mcap"):
        pass
    assert "empty log" in error_of(tmp_path / "empty.mcap")
    text.write_bytes(drive(tmp_path / "whole.mcap", 1).read_bytes()[:8])
    assert "no message can be read" in error_of(text)


def foreign_log(path: Path, schema: str, encoding: str = "cdr", count: int = 1) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "test")
        number = writer.register_schema(schema, "ros2msg", b"")
        channel = writer.register_channel("/topic", encoding, number)
        other = writer.register_channel("/chatter", "cdr", 0)
        for k in range(count):
            writer.add_message(channel, k, b"\0\1\0\0", k)
        writer.add_message(other, 1, b"", 1)
        writer.finish()
    return path


def test_logs_without_anything_usable_say_what_there_is(tmp_path):
    path = tmp_path / "log.mcap"
    assert "/topic (std_msgs/msg/String, cdr)" in error_of(foreign_log(path, "std_msgs/msg/String"))
    assert "(sensor_msgs/msg/LaserScan, cbor)" in error_of(
        foreign_log(path, schemas.LASER_SCAN, "cbor")
    )
    with LogWriter(path) as log:
        log.truth("robot", S, (0, 0, 0))
    assert "no odometry" in error_of(path)
    with LogWriter(path) as log:
        log.odometry("alice", S, (0, 0, 0))
        log.scan("bob", S, [1, 2], **SCAN)
    text = error_of(path)
    assert "scan without odometry" in text and "bob" in text and "/bob/scan" in text
    text = error_of(path, Config(logs=LogsConfig(topics={"/nothing": "alice"})))
    assert "/nothing" in text and "/alice/odom" in text


def test_a_robot_without_odometry_is_moved_by_its_scans(tmp_path):
    """Said by `info` and by the log; the base is the frame of tf whose name says so, else the
    laser itself, without a warning that there is no mount."""
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.mount("bob", S, (0.2, 0.0, 0.1))
        log.scan("bob", S, [1, 2], **SCAN)
    opened = open_logs([path], Config())
    assert opened.robots == opened.without_odometry == ("bob",)
    (line,) = opened.warnings
    assert line.startswith("robot bob: no odometry: scan matching of /bob/scan is used; record")
    (scan,) = opened.messages()
    assert scan.mount == pytest.approx([0.2, 0.0, 0.1])
    info = inspect_logs([path], Config())
    (robot,) = info.robots
    assert not info.problem and line in info.warnings
    assert not robot.problem and robot.odometry == "scan matching of /bob/scan"


def test_usable_topics_without_messages_are_named(tmp_path):
    path = tmp_path / "log.mcap"
    foreign_log(path, schemas.ODOMETRY, count=0)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "test")
        one = writer.register_schema(schemas.ODOMETRY, "ros2msg", b"")
        two = writer.register_schema("std_msgs/msg/String", "ros2msg", b"")
        writer.register_channel("/odom", "cdr", one)
        writer.add_message(writer.register_channel("/chatter", "cdr", two), 1, b"", 1)
        writer.finish()
    assert "all usable topics are empty: /odom" in error_of(path)


def test_messages_that_do_not_fit_their_schema_are_dropped_and_counted(tmp_path):
    logs, messages = read(foreign_log(tmp_path / "log.mcap", schemas.ODOMETRY, count=3))
    assert not messages and logs.dropped == {f"{schemas.ODOMETRY}: cannot be decoded": 3}


@pytest.mark.parametrize("share", [0.25, 0.5, 0.9])
def test_a_file_that_was_cut_gives_what_is_left(tmp_path, share):
    path = drive(tmp_path / "log.mcap")
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    logs, messages = read(path)
    # what is cut off within a block of zstd is lost with that block: about 70 messages here
    assert 900 * share - 120 < len(messages) < 900 * share + 60
    assert logs.files[0].lost is None and logs.files[0].messages == len(messages)
    assert "damaged" in logs.warnings[0]


def test_a_damaged_chunk_is_left_out_and_its_messages_are_counted(tmp_path):
    path = drive(tmp_path / "log.mcap", 600)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    logs, messages = read(path)
    lost = logs.files[0].lost
    assert lost is not None and 0 < lost < 900 * 3 and len(messages) == 9000 - lost


@pytest.mark.parametrize("compression", list(CompressionType))
def test_no_flipped_bit_is_ever_shown_raw_or_read_as_data(tmp_path, compression):
    path = tmp_path / "log.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, compression=compression, chunk_size=4000)
        writer.start("ros2", "test")
        number = writer.register_schema(schemas.TRUE_POSE, "ros2msg", b"")
        odometry = writer.register_schema(schemas.ODOMETRY_INCREMENT, "ros2msg", b"")
        channels = [
            writer.register_channel("/truth", "cdr", number),
            writer.register_channel("/odom_increment", "cdr", odometry),
        ]
        for k in range(1, 200):
            pose = schemas.build(
                schemas.TRUE_POSE, header=schemas.header(k, "w"), x=float(k), y=1.0, phi=2.0
            )
            writer.add_message(channels[0], k, schemas.encode(schemas.TRUE_POSE, pose), k)
            step = schemas.build(
                schemas.ODOMETRY_INCREMENT,
                header=schemas.header(k, "w"),
                start=schemas.time(k - 1),
                x=1.0,
                y=0.0,
                phi=0.0,
                covariance=np.eye(3).ravel(),
            )
            writer.add_message(channels[1], k, schemas.encode(schemas.ODOMETRY_INCREMENT, step), k)
        writer.finish()
    data = path.read_bytes()
    rng = np.random.default_rng(0)
    for position in rng.integers(8, len(data), 60).tolist():
        path.write_bytes(data[:position] + bytes([data[position] ^ 0x55]) + data[position + 1 :])
        try:
            _, messages = read(path)
        except LogError as error:
            assert "\n" not in str(error)
            continue
        for message in messages:
            if isinstance(message, records.Truth):
                assert message.pose.tolist() == [message.stamp_ns, 1, 2]


def test_files_without_summary_chunks_or_statistics_are_read_all_the_same(tmp_path):
    for options in (
        {"use_chunking": False},
        {"repeat_channels": False, "repeat_schemas": False},
        {"use_statistics": False, "use_summary_offsets": False},
    ):
        path = tmp_path / "log.mcap"
        with path.open("wb") as stream:
            writer = Writer(stream, **options)
            writer.start("ros2", "test")
            number = writer.register_schema(schemas.TRUE_POSE, "ros2msg", b"")
            channel = writer.register_channel("/truth", "cdr", number)
            for k in range(2500):
                writer.add_message(channel, 2500 - k, struct.pack("<I", k), k)
            writer.finish()
        file = open_recording(path)
        assert file.messages == 2500 and file.lost == 0 and not file.damage and not file.in_order
        numbers = [struct.unpack("<I", m.data)[0] for m in raw_messages(file, {"/truth"})]
        assert numbers == list(range(2500))[::-1]


# ---------------------------------------------------------------- info


def test_info_tells_what_is_in_a_log_and_what_is_odd(tmp_path):
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.mount("robot", S, (0, 0, 0))
        for k in range(1200):
            stamp = S + k * S // 10 + (5 * S if k >= 600 else 0)
            log.odometry("robot", stamp, (0.1 * k, 0, 0))
            log.scan("robot", stamp, [1.0, np.nan], **SCAN)
        log.truth("ghost", S, (0, 0, 0))
    info = inspect_logs([path], Config())
    topics = {topic.name: topic for topic in info.topics}
    odometry, scan = topics["/odom"], topics["/scan"]
    assert (odometry.count, odometry.used, odometry.robot) == (1200, True, "robot")
    assert odometry.median_period_s == pytest.approx(0.1)
    assert [gap.duration_s for gap in odometry.gaps] == [pytest.approx(5.1)]
    assert scan.dropouts == 0.5 and scan.scan is not None and scan.scan.beams == 2
    ghost, robot = info.robots
    assert ghost.problem == "has no odometry" and not robot.problem
    assert robot.path_m == pytest.approx(119.9) and robot.reverses is False
    assert robot.top_speed_m_s == pytest.approx(1.0, rel=1e-6)
    assert any("never reverses" in line for line in info.warnings)
    assert info.to_dict()["files"][0]["path"] == str(path)


def test_info_reports_what_keeps_a_log_from_being_smoothed(tmp_path):
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.scan("bob", S, [1, 2], **SCAN)
        log.odometry("alice", S, (0, 0, 0))
    info = inspect_logs([path], Config())
    assert "scan without odometry" in info.problem and info.topics[0].count == 1
    info = inspect_logs([foreign_log(path, "std_msgs/msg/String")], Config())
    assert "no usable topic" in info.problem and info.topics[-1].robot is None


def test_info_on_a_real_log():
    info = inspect_logs([real_data("mcap/intel_first600s.mcap")], Config())
    scan = next(topic for topic in info.topics if topic.name == "/scan")
    assert scan.count == 3035 and scan.no_return_m == pytest.approx(81.83)
    assert info.robots[0].reverses and not info.problem


def example(schema, frame="laser", size=3):
    """A message of any schema with different values in all its fields."""
    number = iter(range(1, 1000))

    def value(kind):
        what, detail = kind
        if what == Nodetype.NAME:
            fields = store.get_msgdef(detail).fields
            return store.types[detail](**{name: value(field) for name, field in fields})
        if what == Nodetype.BASE:
            text = {"string": f"{frame}{next(number)}", "bool": True}
            return text.get(detail[0], next(number))
        inner, count = detail
        count = count or size
        if inner[0] == Nodetype.BASE and inner[1][0] != "string":
            return np.arange(next(number), next(number) + count)[:count].astype(inner[1][0])
        return [value(inner) for _ in range(count)]

    store = schemas._typestore()
    return value((Nodetype.NAME, schema))


def assert_same(found, message):
    """Equal values in equal fields, also in nested messages."""
    for name in (
        f.name for f in dataclasses.fields(message) if f.name.islower() and f.name != "__msgtype__"
    ):
        a, b = getattr(found, name), getattr(message, name)
        if dataclasses.is_dataclass(b):
            assert_same(a, b)
        elif isinstance(b, list) and b and dataclasses.is_dataclass(b[0]):
            for one, other in zip(a, b, strict=True):
                assert_same(one, other)
        else:
            np.testing.assert_array_equal(a, b)
            assert np.asarray(a).dtype == np.asarray(b).dtype or not isinstance(b, np.ndarray)


@pytest.mark.parametrize("little", [True, False])
@pytest.mark.parametrize("size", [0, 1, 4])
@pytest.mark.parametrize("schema", [*DECODERS, schemas.TF_MESSAGE, schemas.TWIST_STAMPED])
def test_messages_are_read_as_rosbags_writes_them(schema, size, little):
    """Breaks if a field is missing, or a number is not where its size and the strings put it."""
    for frame in ("", "base", "odom_1"):
        message = example(schema, frame, size)
        data = bytes(schemas._typestore().serialize_cdr(message, schema, little_endian=little))
        assert_same(schemas.decode(schema, data), message)
        for cut in range(4, len(data) - 3, 5):
            with pytest.raises(CdrError):
                schemas.decode(schema, data[:cut])
        with pytest.raises(CdrError):
            schemas.decode(schema, data + bytes(4))


@pytest.mark.parametrize("schema", DECODERS)
@given(seed=st.integers(0, 10**6))
@settings(max_examples=40, derandomize=True, deadline=None)
def test_a_damaged_message_is_a_record_or_counted(schema, seed):
    """Never an error: it would stop the reading of all that follow."""
    data = serialized(schema)
    _, damaged = next(mutations.mutations(data, seed))
    dropped = Counter()
    (found,) = decode_messages(schema, [damaged], TopicContext("robot"), dropped)
    assert (found is None) == any(not reason.startswith("range:") for reason in dropped)


@cache
def serialized(schema):
    return bytes(schemas._typestore().serialize_cdr(example(schema, "odom", 4), schema))


@pytest.mark.parametrize("schema", [schemas.LASER_SCAN, schemas.ODOMETRY, schemas.SIGHTING])
@pytest.mark.parametrize("little", [True, False])
def test_messages_read_together_are_the_single_ones(schema, little):
    """Whatever the lengths of frames and scans, and with one that is cut short between them."""
    data = []
    for frame, size in (("a", 3), ("b", 3), ("longer", 3), ("longer", 1), ("a", 0), ("", 5)):
        message = example(schema, frame, size)
        if schema == schemas.ODOMETRY:
            turn = message.pose.pose.orientation
            turn.x, turn.y, turn.z, turn.w = 0.0, 0.0, 0.6, 0.8
        if schema == schemas.SIGHTING:
            message.range, message.direction = 2.0, np.nan if size == 3 else 0.5
            message.covariance, message.identity = np.eye(3).ravel(), size * "7"
        data.append(
            bytes(schemas._typestore().serialize_cdr(message, schema, little_endian=little))
        )
    data.insert(2, data[0][:30])
    for some in (data, [data[0]] * 3):
        together, singly = Counter(), Counter()
        found = decode_messages(schema, some, TopicContext("robot"), together)
        one_by_one = [
            message
            for one in some
            for message in decode_messages(schema, [one], TopicContext("robot"), singly)
        ]
        assert together == singly
        assert [m is None for m in found] == [m is None for m in one_by_one]
        for a, b in zip(found, one_by_one, strict=True):
            if a is not None:
                assert_same(a, b)


def test_scans_do_not_keep_each_other_in_memory(tmp_path):
    """Breaks if the ranges of a scan are a view of those of all scans that were read together."""
    path = drive(tmp_path / "log.mcap")
    scan = next(m for m in read(path)[1] if isinstance(m, records.Scan))
    assert scan.ranges.base is None or scan.ranges.base.size == scan.ranges.size


def test_odometry_alone_has_the_times_that_it_has_among_all_messages(tmp_path, monkeypatch):
    """Late stamps are placed by the order of all topics, so scans count although not decoded."""
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        for k in range(0, 400, 2):
            late = 9 * S // 10 if k % 30 == 4 else 0
            log.odometry("robot", k * S // 10 + late, (0.05 * k, 0, 0), log_time_ns=k)
            for i in range(k % 3):
                stamp = (k + i) * S // 10 + late
                log.scan("robot", stamp, np.full(30, 2.0), **SCAN, log_time_ns=k + 1)
    logs, messages = read(path)
    expected = [(m.stamp_ns, m.time_ns) for m in messages if isinstance(m, records.OdometryPose)]
    assert any(stamp != time for stamp, time in expected)
    without = [(m.stamp_ns, m.time_ns) for m in logs.messages((records.Scan,))]
    assert without != expected
    monkeypatch.setattr(decoders, "_usable_ranges", None)
    assert [(m.stamp_ns, m.time_ns) for m in logs.odometry()] == expected


@pytest.mark.parametrize("frames", [["world"] * 3, ["map", "world", "map"], ["", "", ""]])
def test_many_true_poses_at_once_are_the_single_ones(frames):
    """Numbers are aligned to 8 bytes after a frame's name of any length; stamps to the digit."""
    poses = [(1.5, -2.0, 3.0), (np.nan, 0.0, 0.0), (1e-9, 7.0, -3.1)]
    stamps = [1_248_444_187_156_000_001 + k for k in range(3)]
    data = [
        schemas.encode(
            schemas.TRUE_POSE,
            schemas.build(
                schemas.TRUE_POSE, header=schemas.header(stamp, frame), x=x, y=y, phi=phi
            ),
        )
        for stamp, frame, (x, y, phi) in zip(stamps, frames, poses, strict=True)
    ]
    found_ns, found = schemas.decode_true_poses(data)
    assert found_ns.tolist() == stamps
    np.testing.assert_array_equal(found, poses)
    found_ns, found = schemas.decode_true_poses([data[0], data[1][:20]])  # the second is cut short
    assert found_ns.tolist() == stamps[:1] and found.tolist() == [list(poses[0])]
