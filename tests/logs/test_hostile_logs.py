"""Logs that are damaged, or made to do harm: nothing is lost in silence, nothing runs away."""

import itertools
import os
import struct
import tracemalloc
import zipfile
import zlib
from collections import Counter

import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.writer import Writer

from graphslam.core.config import Config, LimitsConfig, LogsConfig
from graphslam.core.errors import GraphSlamError, LogError, OutputError
from graphslam.core.output_folder import atomic_folder
from graphslam.importers.formats import IMPORTERS
from graphslam.importers.import_csv import import_csv
from graphslam.logs import LogWriter, open_logs
from graphslam.logs.containers import open_recording
from graphslam.logs.decoders import TopicContext, decode_messages
from graphslam.logs.recording import raw_messages
from graphslam.pipeline.robot_state import times_of_readings
from tests import mutations
from tests.recordings import bag, rosbag2

S = 1_000_000_000


def drive(path, seconds=40):
    with LogWriter(path) as log:
        for k in range(seconds * 10):
            log.odometry("robot", k * S // 10 + S, (0.05 * k, 0.01 * k, 0))
            log.scan(
                "robot", k * S // 10 + S + 7, 2 + np.random.default_rng(k).random(90),
                angle_min_rad=-1.0, angle_step_rad=0.02, range_max_m=20.0,
            )  # fmt: skip
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return drive(tmp_path_factory.mktemp("hostile") / "log.mcap").read_bytes()


def delivered(path, limits=LimitsConfig()):  # noqa: B008
    """The recording, and the messages that it really gives, of any topic."""
    file = open_recording(path, limits)
    return file, sum(1 for _ in raw_messages(file, {topic.name for topic in file.topics}))


# ---------------------------------------------------------------- silent loss


def test_records_of_somebodys_own_do_not_hide_the_chunks_behind_them(tmp_path, log):
    """MCAP allows them: offsets come from the walk over all records."""
    path = tmp_path / "log.mcap"
    path.write_bytes(mutations.with_private_records(log))
    file, found = delivered(path)
    assert found == file.messages == 800 and file.lost == 0 and not file.damage


def test_messages_on_channels_that_nobody_describes_are_lost_and_said(tmp_path):
    path = tmp_path / "log.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, use_chunking=False)
        writer.start("ros2", "test")
        number = writer.register_schema("a/msg/B", "ros2msg", b"")
        channels = [writer.register_channel(name, "cdr", number) for name in ("/a", "/b")]
        for k in range(100):
            writer.add_message(channels[k % 4 == 0], k, b"1234", k)
        writer.finish()
    second = [
        k for k, (opcode, body) in enumerate(mutations.records(path.read_bytes()))
        if opcode == Opcode.CHANNEL and body[:2] == struct.pack("<H", channels[1])
    ]  # fmt: skip
    found = mutations.records(path.read_bytes())
    path.write_bytes(mutations.mcap(one for k, one in enumerate(found) if k not in second))
    file, count = delivered(path)
    assert count == file.messages == 75 and file.lost == 25
    assert "25 messages are on channels that it does not describe" in file.damage


@pytest.mark.parametrize("kind", ["chunk", "chunk without statistics", "opcode"])
def test_a_chunk_that_is_missing_is_a_warning(tmp_path, log, kind):
    """Also where the file is otherwise whole: its statistics, or the index behind it, tell."""
    path = tmp_path / "log.mcap"
    data = mutations.without(log, {Opcode.CHUNK}, slice(1, 2))
    if kind == "chunk without statistics":
        data = mutations.without(data, {Opcode.STATISTICS})
    if kind == "opcode":
        found = mutations.records(log)
        at = next(k for k, one in enumerate(found) if one[0] == Opcode.CHUNK)
        found[at] = (0x46, found[at][1])
        data = mutations.without(mutations.mcap(found), {Opcode.STATISTICS})
    path.write_bytes(data)
    opened = open_logs([path], Config())
    assert any("messages are lost" in line for line in opened.warnings)
    file, found = delivered(path)
    assert found == file.messages < 800 and file.lost in (800 - found, None)


@pytest.mark.parametrize("container", ["mcap", "db3"])
def test_whatever_is_damaged_what_is_counted_is_delivered(tmp_path, log, container):
    """Read + lost is all there was, or the loss is said: for any damage, in any container."""
    path = tmp_path / "log.mcap"
    path.write_bytes(log)
    if container == "db3":
        from rosbags.rosbag2 import CompressionMode, StoragePlugin

        rosbag2(path, tmp_path / "bag", StoragePlugin.SQLITE3, CompressionMode.NONE)
        (path,) = (tmp_path / "bag").glob("*.db3")
    whole = path.read_bytes()
    target = tmp_path / f"damaged.{container}"
    for kind, data in itertools.islice(mutations.mutations(whole, seed=1), 60):
        target.write_bytes(data)
        try:
            file, found = delivered(target)
        except LogError as error:
            assert "\n" not in str(error)
            continue
        assert found == file.messages, kind
        assert container != "mcap" or found == 800 or file.lost != 0 or file.damage, kind


def test_a_log_that_changes_while_it_is_read_is_an_error_of_one_line(tmp_path, log):
    path = tmp_path / "log.mcap"
    path.write_bytes(log)
    file = open_recording(path)
    path.write_bytes(log[: len(log) // 2])
    with pytest.raises(LogError, match="changed while it was read"):
        list(raw_messages(file, {"/scan", "/odom"}))


# ---------------------------------------------------------------- two processes, one target


def test_two_writers_of_one_log_do_not_share_a_file_and_one_is_refused(tmp_path, monkeypatch):
    target = tmp_path / "log.mcap"
    with pytest.raises(OutputError, match="another process"), LogWriter(target) as first:
        first.odometry("robot", S, (1, 0, 0))
        with monkeypatch.context() as other:
            other.setattr(os, "getpid", lambda: 1)
            drive(target, 1)
    assert open_recording(target).messages == 20
    assert [path.name for path in tmp_path.iterdir()] == ["log.mcap"]


def test_two_writers_of_one_folder_the_second_is_refused_and_what_the_dead_left_is_removed(
    tmp_path,
):
    target, dead = tmp_path / "out", 4_000_000
    left = tmp_path / f".out.{dead}.part"
    left.mkdir()
    (left / "half").touch()
    (tmp_path / ".out.7.x").touch()
    with pytest.raises(OutputError, match="another process"), atomic_folder(target, None) as part:
        (part / "mine").touch()
        target.mkdir()
        (target / "theirs").touch()
    assert sorted(p.name for p in tmp_path.iterdir()) == [".out.7.x", "out", "out-new"]
    assert [p.name for p in target.iterdir()] == ["theirs"]
    # a process that died between moving the old folder away and putting the new one there
    target.rename(tmp_path / f".out.{dead}.old")
    with pytest.raises(ZeroDivisionError), atomic_folder(target, None):
        raise ZeroDivisionError
    assert [p.name for p in target.iterdir()] == ["theirs"]


@pytest.mark.parametrize("what", ["device", "link", "folder"])
def test_only_plain_files_are_replaced(tmp_path, what):
    target = tmp_path / "log.mcap"
    if what == "link":
        (tmp_path / "other").touch()
        target.symlink_to(tmp_path / "other")
    elif what == "folder":
        target.mkdir()
    else:
        os.mkfifo(target)
    with pytest.raises(OutputError, match="no plain file"):
        drive(target, 1)


@pytest.mark.parametrize("stop", [KeyboardInterrupt, SystemExit, OSError(28, "disk full")])
def test_what_ends_a_log_while_it_is_opened_leaves_nothing(tmp_path, monkeypatch, stop):
    """The block has not begun then, so nothing else removes the file."""

    def stopped(*_, **__):
        raise stop

    monkeypatch.setattr("graphslam.logs.writer.Writer.start", stopped)
    expected = OutputError if isinstance(stop, OSError) else stop
    with pytest.raises(expected), LogWriter(tmp_path / "log.mcap"):
        raise AssertionError
    assert not list(tmp_path.iterdir())


# ---------------------------------------------------------------- bombs and limits


def bomb(content, compression="zstd"):
    """An MCAP file with one chunk of ``content``."""
    packed = zstandard.ZstdCompressor().compress(content) if compression else content
    body = struct.pack("<QQQI", 0, 1, len(content), zlib.crc32(content))
    name = compression.encode()
    body += struct.pack("<I", len(name)) + name + struct.pack("<Q", len(packed)) + packed
    return mutations.mcap([(Opcode.HEADER, bytes(8)), (Opcode.CHUNK, body)])


@pytest.mark.parametrize(
    ("content", "limits", "setting"),
    [
        (bytes(30_000_000), LimitsConfig(chunk_mb=10), "limits.chunk_mb"),
        (
            (b"\x90" + bytes(8)) * 300_000,
            LimitsConfig(chunk_records=100_000),
            "limits.chunk_records",
        ),
    ],
)
def test_a_chunk_that_explodes_is_refused_by_the_name_of_the_limit(
    tmp_path, content, limits, setting
):
    path = tmp_path / "bomb.mcap"
    path.write_bytes(bomb(content))
    tracemalloc.start()
    with pytest.raises(LogError, match=setting):
        open_recording(path, limits)
    assert tracemalloc.get_traced_memory()[1] < len(content) + 20e6
    tracemalloc.stop()


@pytest.mark.parametrize("size", [0, 5, 36])
def test_a_chunk_of_no_length_is_damage_and_the_rest_is_read(tmp_path, log, size):
    found = mutations.records(log)
    at = next(k for k, one in enumerate(found) if one[0] == Opcode.CHUNK)
    found[at] = (found[at][0], found[at][1][:size])
    path = tmp_path / "log.mcap"
    path.write_bytes(mutations.mcap(found))
    file, count = delivered(path)
    assert 400 < count == file.messages < 800 and file.lost == 800 - count and file.damage


def test_limits_of_robots_and_their_names(tmp_path):
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        for name in ("a", "b", "c"):
            log.odometry(name, S, (0, 0, 0))
            log.scan(name, S, [1, 2], angle_min_rad=0, angle_step_rad=1, range_max_m=9)
    with pytest.raises(LogError, match=r"limits\.robots"):
        open_logs([path], Config(limits=LimitsConfig(robots=2)))
    renamed = {"/a/odom": "n" * 5000, "/a/scan": "n" * 5000}
    with pytest.raises(LogError, match="too long for a file"):
        open_logs([path], Config(logs=LogsConfig(topics=renamed)))


def test_a_clock_that_steps_by_years_does_not_fill_the_gap_with_poses():
    year = 365 * 86400 * S
    readings = np.concatenate([np.arange(0, 20 * S, S), year + np.arange(0, 20 * S, S)])
    times = times_of_readings(readings, S // 10, np.zeros(39, dtype=bool))
    assert len(times) == 2 * 191 and times[0] == 0 and times[-1] == year + 19 * S
    whole = times_of_readings(readings[:20], S // 10, np.zeros(19, dtype=bool))
    assert whole.tolist() == list(range(0, 19 * S + 1, S // 10))


#: writes one message of this kind, and why it is dropped
BEYOND = {
    "range": (
        lambda log: log.sighting("robot", S, (0, 1e9), np.eye(2)),
        "sighting: range is beyond what anything measures",
    ),
    "variance": (
        lambda log: log.sighting("robot", S, (0, 1), np.eye(2) * 1e30),
        "sighting: variance is beyond what a sensor has",
    ),
    "closure": (
        lambda log: log.relative_pose("robot", S, 2 * S, delta=(1e9, 0, 0), cov=np.eye(3)),
        "relative pose: farther than robots drive",
    ),
    "huge closure": (
        lambda log: log.relative_pose("robot", S, 2 * S, delta=(1e200, 0, 0), cov=np.eye(3)),
        "relative pose: farther than robots drive",
    ),
    "pose": (
        lambda log: log.odometry("robot", 3 * S, (1e200, 0, 0)),
        "odometry: farther than robots drive",
    ),
    "wheel": (
        lambda log: log.wheel_angles("robot", 3 * S, 1e30, 0),
        "joints: angle is beyond what a wheel turns",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BEYOND)
def test_what_no_sensor_measures_is_dropped_and_counted(tmp_path, name):
    write, reason = BEYOND[name]
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        if name != "wheel":
            log.odometry("robot", S, (0, 0, 0))
        else:
            log.wheel_angles("robot", S, 0, 0)
        write(log)
    opened = open_logs([path], Config())
    assert len(list(opened.messages())) == 1
    assert opened.dropped == {reason: 1}


def test_signalling_nans_are_no_return_and_no_warning_of_python(tmp_path):
    """Flipped bits make them; converting them is an invalid operation to the processor."""
    file = open_recording(drive(tmp_path / "log.mcap", 1))
    (data, *_) = (raw.data for raw in raw_messages(file, {"/scan"}))
    bad = data[:-8] + struct.pack("<I", 0x7FA00001) + data[-4:]  # its last range
    context = TopicContext("robot")
    (scan,) = decode_messages("sensor_msgs/msg/LaserScan", [bad], context, Counter())
    assert np.isnan(scan.ranges).sum() == 1


# ---------------------------------------------------------------- writer and importers


@pytest.mark.parametrize("stamp", [-1, 1 << 64])
def test_stamps_that_mcap_cannot_hold_are_an_error_of_one_line(tmp_path, stamp):
    with pytest.raises(GraphSlamError, match="cannot be written"), LogWriter(tmp_path / "l") as log:
        log.odometry("robot", stamp, (0, 0, 0))
    assert not list(tmp_path.iterdir())


def test_numbers_that_are_not_finite_are_malformed_lines(tmp_path):
    line = "FLASER 2 1.0 2.0 {0} 0 0 0 0 0 1.5 host 1.5\nODOM 0 0 {0} 0 0 0 1.5 host 1.5\n"
    source = tmp_path / "log.clf"
    source.write_text(line.format("inf") + line.format("0"))
    done = IMPORTERS["carmen"](source, tmp_path / "log.mcap")
    assert done.counts["/scan"] == done.counts["/odom"] == 1 and len(done.warnings) == 2
    (tmp_path / "odometry.csv").write_text("2,1,0,0\n1,0,0,inf\n")
    done = import_csv(tmp_path, tmp_path / "two.mcap")
    assert done.counts["/odom"] == 1 and done.warnings


def test_archives_that_are_encrypted_or_odd_are_errors_of_one_line(tmp_path):
    source = tmp_path / "log.zip"
    with zipfile.ZipFile(source, "w") as packed:
        packed.writestr("odometry.csv", "1,0,0,0\n")
    plain = source.read_bytes()
    for at, value in ((6, 1), (8, 77)):  # flags: encrypted; method: unknown
        data = bytearray(plain)
        for mark, offset in ((b"PK\x03\x04", at), (b"PK\x01\x02", at + 2)):
            data[data.index(mark) + offset] = value
        source.write_bytes(data)
        with pytest.raises(LogError, match="cannot be read to its end"):
            import_csv(source, tmp_path / "log.mcap")


@pytest.mark.parametrize("op", [5, 6, 7])
def test_lengths_in_a_bag_that_are_larger_than_it_take_no_memory(tmp_path, log, op):
    """Of chunks, and of what an index says of chunks and connections: 4 GB in a file of 1 MB."""
    (tmp_path / "log.mcap").write_bytes(log)
    path = bag(tmp_path / "log.mcap", tmp_path / "log.bag")
    data = bytearray(path.read_bytes())
    at = len(b"#ROSBAG V2.0\n")
    while b"op=" + bytes([op]) not in data[at : at + 4 + (head := u32(data, at))]:
        at += 8 + head + u32(data, at + 4 + head)
    struct.pack_into("<I", data, at + 4 + head, 0xFFFFFFF0)
    path.write_bytes(data)
    tracemalloc.start()
    recording = open_recording(path)
    assert tracemalloc.get_traced_memory()[1] < 50e6
    tracemalloc.stop()
    assert recording.damage


def u32(data, at):
    return int.from_bytes(data[at : at + 4], "little")


def test_a_length_of_no_file_loses_no_chunk(tmp_path, log):
    """Of an index behind a chunk: the other chunks are found by the summary."""
    data = bytearray(log)
    at = len(mutations.MAGIC)
    for opcode, body in mutations.records(log):
        if opcode == Opcode.MESSAGE_INDEX:
            break
        at += 9 + len(body)
    data[at + 8] = 0x7F
    path = tmp_path / "log.mcap"
    path.write_bytes(data)
    file, found = delivered(path)
    assert found == file.messages == 800 and file.damage
