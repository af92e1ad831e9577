"""Containers: a drive is the same from any of them, damaged ones are read as far as they go."""

import bz2
import gzip
import io
import lzma
import shutil
import sqlite3
import struct
import zipfile
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import recordings
from hypothesis import given, settings
from hypothesis import strategies as st
from paths import real_data
from room_log import SECONDS, drive

import graphslam
from graphslam.core.config import Config
from graphslam.core.errors import LogError
from graphslam.importers import IMPORTERS
from graphslam.logs import is_recording, open_logs
from graphslam.logs.containers import CONTAINERS, open_recording
from graphslam.logs.recording import RawMessage, Recording, raw_messages


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("containers")


@pytest.fixture(scope="module")
def log(folder):
    """Twice round the room, as MCAP."""
    return drive(folder / "drive.mcap")


@pytest.fixture(scope="module")
def made(folder, log):
    """A function that gives the drive in a container; each is made once."""
    done: dict[str, Path] = {}

    def make(name: str) -> Path:
        if name not in done:
            file, write = recordings.CONTAINERS[name]
            done[name] = write(log, folder / file)
        return done[name]

    return make


@pytest.fixture(scope="module")
def contents(made):
    """A function that gives all messages of the drive in a container; each is read once."""
    return cache(lambda name: everything(open_recording(made(name))))


def everything(recording: Recording) -> list[RawMessage]:
    return list(raw_messages(recording, {topic.name for topic in recording.topics}))


def numbers(message):
    """All that a record says, as plain values."""
    values = [getattr(message, name) for name in type(message).__dataclass_fields__]
    return type(message), [v.tobytes() if isinstance(v, np.ndarray) else v for v in values]


# ---------------------------------------------------------------- the same from any


@pytest.mark.parametrize("name", recordings.CONTAINERS)
def test_every_container_gives_the_same_records(name, made, log):
    """To the bit, at the same times, in the same order; that of ROS 1 as well."""
    expected = [numbers(m) for m in open_logs([log], Config()).messages()]
    opened = open_logs([made(name)], Config())
    assert [numbers(m) for m in opened.messages()] == expected
    assert len(expected) > 600 and not opened.warnings and not opened.dropped
    assert [(file.messages, file.lost) for file in opened.files] == [(len(expected) + 1, 0)]


@pytest.mark.parametrize(
    "name", ["rosbag2 folder, sqlite3, zstd by file", "rosbag2 folder, split", "ROS 1 bag, lz4"]
)
def test_every_container_gives_the_same_trajectory(name, made, log):
    expected = graphslam.smooth(log).robots["robot"].final
    found = graphslam.smooth(made(name)).robots["robot"].final
    np.testing.assert_array_equal(found.stamps_ns, expected.stamps_ns)
    np.testing.assert_array_equal(found.poses, expected.poses)


@pytest.mark.parametrize("name", recordings.CONTAINERS)
def test_import_makes_mcap_of_every_container(name, made, log, tmp_path):
    summary = IMPORTERS["rosbag"](made(name), tmp_path / "log.mcap")
    assert not summary.warnings
    assert everything(open_recording(tmp_path / "log.mcap")) == everything(open_recording(log))


def test_the_container_is_told_by_the_first_bytes_and_not_by_the_name(made, log, tmp_path):
    for number, name in enumerate(("bare .db3", "ROS 1 bag", ".mcap.zstd")):
        target = tmp_path / f"{number}.log"
        shutil.copy(made(name), target)
        assert is_recording(target)
        assert open_recording(target).messages == open_recording(log).messages


def test_messages_are_read_in_the_order_of_log_times_whatever_the_rows_are(made, log, tmp_path):
    """rosbag2's cache may write rows out of order; nothing but their times says so."""
    path = tmp_path / "log.db3"
    shutil.copy(made("bare .db3"), path)
    with sqlite3.connect(path) as database:
        rows = database.execute("SELECT topic_id, timestamp, data FROM messages").fetchall()
        order = np.random.default_rng(3).permutation(len(rows))
        database.execute("DELETE FROM messages")
        database.executemany(
            "INSERT INTO messages(id, topic_id, timestamp, data) VALUES (?, ?, ?, ?)",
            [(int(k) * 3 + 5, *rows[row]) for k, row in enumerate(order)],
        )
    database.close()
    times = [raw.log_time_ns for raw in everything(open_recording(path))]
    assert times == sorted(times) and len(times) == len(rows)
    found = {(raw.topic, raw.data) for raw in everything(open_recording(path))}
    assert found == {(raw.topic, raw.data) for raw in everything(open_recording(log))}


def test_pieces_are_ordered_by_time_and_read_as_one(made, log):
    recording = open_recording(made("folder of MCAP files"))
    assert len(recording.pieces) == 4 and recording.in_order
    assert everything(recording) == everything(open_recording(log))


def test_pieces_that_overlap_in_time_are_merged(log, tmp_path):
    folder = tmp_path / "both"
    folder.mkdir()
    shutil.copy(log, folder / "1.mcap")
    drive(folder / "2.mcap", robot="other", seconds=SECONDS // 2)
    times = [raw.log_time_ns for raw in everything(open_recording(folder))]
    assert times == sorted(times) and len(times) > open_recording(log).messages


def test_a_real_bag_is_smoothed():
    path = real_data("rosbag/filipkro_mylaserdata3.bag")
    opened = open_logs([path], Config())
    counts = {topic.name: topic.count for topic in opened.topics}
    assert counts == {"/odom": 129, "/scan": 102}
    assert len(list(opened.messages())) == 231


# ---------------------------------------------------------------- damage


def test_a_recording_behind_another_in_one_file_is_said_to_be_left_out(log, tmp_path):
    """`cat a.mcap b.mcap`: the first one's footer ends what readers look at."""
    both = tmp_path / "both.mcap"
    both.write_bytes(2 * log.read_bytes())
    recording = open_recording(both)
    assert everything(recording) == everything(open_recording(log))
    assert "another recording begins behind its end" in recording.damage
    padded = tmp_path / "padded.mcap"
    padded.write_bytes(log.read_bytes() + bytes(100))
    assert not open_recording(padded).damage


WHOLE = ["bare .db3", "ROS 1 bag", "ROS 1 bag, bz2", "ROS 1 bag, lz4", ".mcap.zstd"]


@pytest.mark.parametrize("name", WHOLE)
@given(share=st.floats(0.0, 1.0))
@settings(max_examples=15, deadline=None)
def test_a_recording_that_was_cut_off_is_read_up_to_there(name, share, made, contents, folder):
    """What is read is the beginning of the whole, to the bit, and the cut is said."""
    whole = made(name)
    data = whole.read_bytes()
    path = folder / f"cut{whole.suffix}"
    path.write_bytes(data[: int(share * (len(data) - 1))])
    try:
        recording = open_recording(path)
    except LogError as error:
        assert "\n" not in str(error) and str(path) in str(error)
        return
    expected = contents(name)
    found = everything(recording)
    assert recording.damage and found == expected[: len(found)]
    assert recording.messages == len(found)


@pytest.mark.parametrize("name", ["bare .db3", "ROS 1 bag", "ROS 1 bag, lz4"])
@given(place=st.floats(0.05, 0.95), value=st.integers(0, 255))
@settings(max_examples=15, deadline=None)
def test_damage_in_the_middle_never_stops_reading(name, place, value, made, contents, folder):
    """4 KB are overwritten. There is no sum to check in SQLite: messages may have wrong numbers,
    but never more of them than there are bytes for."""
    whole = made(name)
    data = bytearray(whole.read_bytes())
    at = int(place * (len(data) - 4096))
    data[at : at + 4096] = bytes([value]) * 4096
    path = folder / f"middle{whole.suffix}"
    path.write_bytes(data)
    try:
        recording = open_recording(path)
    except LogError as error:
        assert "\n" not in str(error)
        return
    found = everything(recording)
    expected = {(raw.topic, raw.log_time_ns, raw.data) for raw in contents(name)}
    assert len(found) == recording.messages <= len(expected)
    if name == "bare .db3":
        wrong = [raw for raw in found if (raw.topic, raw.log_time_ns, raw.data) not in expected]
        assert len(wrong) <= 4096 // 100


def test_lost_messages_of_a_cut_piece_are_counted_by_the_metadata(made, tmp_path):
    target = tmp_path / "bag"
    shutil.copytree(made("rosbag2 folder, split"), target)
    piece = sorted(target.glob("*.db3"))[-1]
    piece.write_bytes(piece.read_bytes()[: piece.stat().st_size // 2])
    recording, whole = open_recording(target), open_recording(made("rosbag2 folder, split"))
    assert recording.lost == whole.messages - recording.messages > 50
    assert piece.name in recording.damage and "\n" not in recording.damage
    (warning,) = open_logs([target], Config()).warnings
    assert f"{recording.lost} messages are lost" in warning


def test_a_piece_that_is_not_there_is_said(made, tmp_path):
    target = tmp_path / "bag"
    shutil.copytree(made("rosbag2 folder, split"), target)
    sorted(target.glob("*.db3"))[1].unlink()
    (warning,) = open_logs([target], Config()).warnings
    assert "_1.db3 of metadata.yaml is not there" in warning
    assert "an unknown number of messages" in warning


def test_messages_that_only_the_metadata_knows_of_are_lost(made, tmp_path):
    """Rows that are gone from a database leave no other trace."""
    target = tmp_path / "bag"
    shutil.copytree(made("rosbag2 folder, split"), target)
    database = sqlite3.connect(sorted(target.glob("*.db3"))[0])
    database.execute("DELETE FROM messages WHERE id IN (3, 5)")
    database.commit()
    database.close()
    assert open_recording(target).lost == 2


def test_a_file_whose_first_bytes_are_damaged_is_not_passed_over(made, tmp_path):
    target = tmp_path / "logs"
    shutil.copytree(made("folder of MCAP files"), target)
    (target / "log_8.mcap").write_bytes(b"x" + (target / "log_8.mcap").read_bytes()[1:])
    (target / "notes.txt").write_text("not a recording")
    recording = open_recording(target)
    assert recording.damage == "log_8.mcap does not begin as a recording"
    assert recording.lost is None and recording.messages


def test_a_folder_is_read_without_its_metadata_and_with_damaged_one(made, log, tmp_path):
    target = tmp_path / "bag"
    shutil.copytree(made("rosbag2 folder, split"), target)
    for damaged in (b"rosbag2_bagfile_information: [", b"\xff\xfe", b"- 1", None):
        (target / "metadata.yaml").unlink()
        if damaged is not None:
            (target / "metadata.yaml").write_bytes(damaged)
        recording = open_recording(target)
        assert everything(recording) == everything(open_recording(log)) and not recording.damage
        (target / "metadata.yaml").touch()


@pytest.mark.parametrize("compression", ["", "lz4"])
def test_a_bag_without_index_is_read_whole(compression, log, tmp_path):
    """As `rosbag record` leaves it when it is killed: no index, no length of the last chunk."""
    whole = recordings.bag(log, tmp_path / "whole.bag", compression)
    data = bytearray(whole.read_bytes())
    chunk = data.index(b"op=\x05")
    # the index begins after the chunk, which is the only one
    begin = data.index(b"size=") + 9
    (length,) = struct.unpack_from("<I", data, begin)
    assert chunk < begin and begin + 4 + length < len(data)
    struct.pack_into("<I", data, begin, 0)
    struct.pack_into("<I", data, begin - 4, 0)
    path = tmp_path / "active.bag"
    path.write_bytes(data[: begin + 4 + length])
    recording = open_recording(path)
    assert everything(recording) == everything(open_recording(whole))
    assert recording.lost is None and "no index" in recording.damage


def test_reading_on_after_a_damaged_chunk_of_a_bag(log, tmp_path):
    """The length in the head of a record is wrong, so that nothing after it is where it should
    be: the next chunk is found by its head."""
    path = recordings.bag(log, tmp_path / "log.bag")
    data = path.read_bytes()
    begin = data.index(b"size=") + 9
    (length,) = struct.unpack_from("<I", data, begin)
    chunk = data[4109 : begin + 4 + length]
    assert chunk[8:].startswith((b"compression=", b"op=", b"size="))
    broken = bytearray(chunk)
    struct.pack_into("<I", broken, begin - 4109, length + 12345)
    two = tmp_path / "two.bag"
    two.write_bytes(data[:4109] + bytes(broken) + b"\x01\x02\x03" + chunk)
    recording = open_recording(two)
    assert recording.messages >= open_recording(path).messages and recording.damage


def test_messages_of_an_unfinished_database_are_read(log, tmp_path):
    """A recorder that was killed left rows in the -wal file beside the database."""
    path = recordings.bare_db3(log, tmp_path / "log.db3")
    database = sqlite3.connect(path)
    database.execute("PRAGMA journal_mode=WAL")
    database.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (1, 5, x'00')")
    database.commit()
    target = tmp_path / "killed"
    target.mkdir()
    for name in ("log.db3", "log.db3-wal"):
        shutil.copy(tmp_path / name, target / name)
    database.close()
    assert open_recording(target).messages == open_recording(log).messages + 1


# ---------------------------------------------------------------- what cannot be read


def _zipped(data: bytes) -> bytes:
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        archive.mkdir("drive")
        archive.writestr("drive/log", data)
    return made.getvalue()


PACKERS = {".gz": gzip.compress, ".bz2": bz2.compress, ".xz": lzma.compress, ".zip": _zipped}


def test_what_cannot_be_read_says_in_one_line_what_to_do(made, log, tmp_path):
    def refusal(name: str, data: bytes) -> str:
        path = tmp_path / name
        path.write_bytes(data)
        with pytest.raises(LogError) as caught:
            open_recording(path)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)
        return str(caught.value)

    assert "empty file" in refusal("empty.bag", b"")
    assert "rosbag fix" in refusal("old.bag", b"#ROSBAG V1.2\n" + bytes(100))
    assert "unpack it" in refusal("log.bag.gz", b"\x1f\x8b" + bytes(100))
    for suffix, pack in PACKERS.items():
        told = refusal(f"drive.mcap{suffix}", pack(log.read_bytes()))
        assert told.endswith("unpack it")  # `graphslam import` reads no packed recordings
        assert "graphslam import" in refusal(f"intel.clf{suffix}", pack(b"# CARMEN Logfile\n"))
    assert "graphslam import" in refusal("intel.clf", b"# CARMEN Logfile\nODOM 1 2 3\n")
    assert "name the folder" in refusal("metadata.yaml", b"rosbag2_bagfile_information:\n")
    assert "damaged at its beginning" in refusal("log.db3.zstd", b"\x28\xb5\x2f\xfd" + bytes(50))
    database = sqlite3.connect(tmp_path / "photos.db")
    database.execute("CREATE TABLE photos(id INTEGER)")
    database.commit()
    database.close()
    data = (tmp_path / "photos.db").read_bytes()
    assert "not an SQLite file of rosbag2" in refusal("photos.db3", data)
    head = made("ROS 1 bag").read_bytes()
    encrypted = head[:13] + struct.pack("<I", 8 + 4 + 18) + b"\4\0\0\0op=\3" + (
        struct.pack("<I", 18) + b"encryptor=rosbag/A" + bytes(4)
    )  # fmt: skip
    assert "encrypted" in refusal("secret.bag", encrypted + bytes(50))


def test_a_folder_without_a_recording_names_one_that_may_be_meant(made, tmp_path):
    (tmp_path / "bags" / "monday").mkdir(parents=True)
    with pytest.raises(LogError, match="such as monday"):
        open_recording(tmp_path / "bags")
    with pytest.raises(LogError, match=r"without a recording \(MCAP"):
        open_recording(tmp_path / "bags" / "monday")


def test_every_container_is_tested():
    """A row of `CONTAINERS` whose files no test makes would be a promise only."""
    begins = [row.magic for row in CONTAINERS.values()]
    assert len(begins) == len(set(begins)) == 3
