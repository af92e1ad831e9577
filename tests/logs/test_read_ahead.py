"""Chunks of bags are unpacked by threads ahead of their turn; nobody can tell but by the clock."""

import bz2
import struct
import threading
from pathlib import Path

import pytest
import recordings
from room_log import drive

from graphslam.core.errors import LogError
from graphslam.core.sensor_config import LimitsConfig
from graphslam.core.worker import THREADS
from graphslam.logs import read_ahead
from graphslam.logs.bag_file import index_bag
from graphslam.logs.containers import open_recording
from graphslam.logs.read_ahead import MOST_BYTES, ReadAhead
from graphslam.logs.recording import raw_messages


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """Twice round the room, as a bag of several chunks."""
    folder = tmp_path_factory.mktemp("bags")
    return recordings.bag(drive(folder / "drive.mcap"), folder / "drive.bag", "bz2", 100_000)


@pytest.fixture
def unpacked_by(monkeypatch):
    """The threads by which chunks are unpacked, in their order."""
    threads, unpacker = [], bz2.BZ2Decompressor

    class Noting:
        def decompress(self, data, most):
            threads.append(threading.current_thread())
            return unpacker().decompress(data, most)

    monkeypatch.setattr("graphslam.logs.bag_file.bz2.BZ2Decompressor", Noting)
    return threads


def threads() -> int:
    return sum(1 for _ in THREADS.iterdir())


def everything(recording):
    return list(raw_messages(recording, {topic.name for topic in recording.topics}))


def indexed(path: Path):
    """What is told of a bag."""
    piece = index_bag(path, LimitsConfig())
    return piece.blocks, piece.channels, piece.damage, piece.lost, piece.in_order


def test_results_come_in_order_each_with_its_error():
    def work(number: int) -> bytes:
        if number == 2:
            raise ValueError("two")
        return bytes([number])

    def taken(number: int, result) -> object:
        try:
            return number, result()
        except ValueError as error:
            return number, str(error)

    with ReadAhead[int]() as ahead:
        found = []
        for number in range(5):
            found += [taken(*one) for one in ahead.put(number, lambda n=number: work(n), 10)]
        found += [taken(*one) for one in ahead.take_all()]
    assert found == [(0, b"\0"), (1, b"\1"), (2, "two"), (3, b"\3"), (4, b"\4")]


def test_what_is_held_is_bounded():
    """Breaks if more is begun than there is room for, or if large work is done ahead."""
    held, most, begun = 0, 0, []
    size = MOST_BYTES // 3

    def note(number: int) -> bytes:
        begun.append((number, threading.current_thread() is threading.main_thread()))
        return b""

    with ReadAhead[int]() as ahead:
        for number in range(20):
            large = number % 5 == 4
            for before, result in ahead.put(
                number, lambda n=number: note(n), size * 4 if large else size
            ):
                result()
                held -= before % 5 != 4
            held += not large
            most = max(most, held)
        assert [result() for _, result in ahead.take_all()] == [b""] * held
    assert most == 3
    assert sorted(begun) == [(n, n % 5 == 4) for n in range(20)]


@pytest.mark.parametrize("stop", [KeyboardInterrupt, LogError])
def test_no_thread_is_left(stop, path, monkeypatch):
    """Also if reading is stopped half way. Breaks if what follows could not fork."""
    before = threads()
    indexed(path)
    assert threads() == before

    def stopping(*_):
        assert threads() > before
        raise stop

    monkeypatch.setattr("graphslam.logs.bag_file._Indexer.add_chunk", stopping)
    with pytest.raises(stop):
        index_bag(path, LimitsConfig())
    assert threads() == before


def test_chunks_are_unpacked_by_threads(path, unpacked_by):
    opened = open_recording(path)
    assert len(unpacked_by) == len(opened.pieces[0].blocks) > 3
    assert threading.main_thread() not in unpacked_by


@pytest.mark.parametrize("damage", ["none", "a chunk", "the head of a chunk", "cut off", "no size"])
def test_nothing_else_changes(damage, path, tmp_path, monkeypatch, unpacked_by):
    """The same is told of a bag, damaged or not, as without threads."""
    data = bytearray(path.read_bytes())
    starts = [at for at in range(len(data)) if data.startswith(b"compression=bz2", at)]
    third = starts[2]
    if damage == "a chunk":
        data[third + 2000 : third + 2010] = bytes(10)
    elif damage == "the head of a chunk":
        struct.pack_into("<I", data, third - 8, 1 << 30)
    elif damage == "cut off":
        data = data[: third + 2000]
    elif damage == "no size":
        at = data.index(b"size=", third)
        data[at : at + 4] = b"sise"
    broken = tmp_path / "broken.bag"
    broken.write_bytes(data)
    found, messages = indexed(broken), everything(open_recording(broken))
    assert bool(found[2]) == (damage != "none") and len(messages) > 100
    by_threads = {*unpacked_by}
    unpacked_by.clear()
    monkeypatch.setattr(read_ahead, "MOST_BYTES", 0)
    assert indexed(broken) == found and everything(open_recording(broken)) == messages
    assert {*unpacked_by} == {threading.main_thread()} and by_threads != {*unpacked_by}


def test_limits_hold(path):
    """The first chunk that is too large is told, whatever is unpacked after it."""
    whole = index_bag(path, LimitsConfig())
    with pytest.raises(LogError, match=f"at byte {whole.blocks[0].offset}, .*chunk_mb"):
        index_bag(path, LimitsConfig(chunk_mb=0.05))
