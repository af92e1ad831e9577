"""Chunks of bz2 bags are unpacked once; what is kept of them is bounded and goes away."""

import bz2
import gc
from pathlib import Path

import pytest
import recordings
from room_log import drive

from graphslam.core.config import Config
from graphslam.core.worker import Prefetch, allow_fork
from graphslam.logs import open_logs, unpacked_chunks
from graphslam.logs.containers import open_recording
from graphslam.logs.recording import raw_messages


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """Twice round the room, as a bag of several chunks."""
    folder = tmp_path_factory.mktemp("bags")
    return recordings.bag(drive(folder / "drive.mcap"), folder / "drive.bag", "bz2", 100_000)


@pytest.fixture
def unpacked(monkeypatch):
    """Lengths of all that is unpacked."""
    gc.collect()  # recordings of other tests, whose file these would share
    lengths, unpacker = [], bz2.BZ2Decompressor

    class Counting:
        def decompress(self, data, most):
            contents = unpacker().decompress(data, most)
            lengths.append(len(contents))
            return contents

    monkeypatch.setattr("graphslam.logs.bag_file.bz2.BZ2Decompressor", Counting)
    return lengths


def everything(recording):
    return list(raw_messages(recording, {topic.name for topic in recording.topics}))


def open_files():
    return len(list(Path("/proc/self/fd").iterdir()))


def test_chunks_are_unpacked_once(path, unpacked):
    """Indexed, sampled and read twice. Breaks if chunks are not kept."""
    opened = open_logs([path], Config())
    assert len(list(opened.messages())) == len(list(opened.messages())) > 600
    assert len(unpacked) == len(opened.opened[0].pieces[0].blocks) > 3


@pytest.mark.parametrize("room", ["none", "of one chunk", "full disk", "no such folder"])
def test_chunks_that_are_not_kept_are_unpacked_again(room, path, unpacked, monkeypatch):
    """The messages are the same. Breaks if a part of a chunk is kept, or an error gets out."""
    expected = everything(open_recording(path))
    chunks = len(unpacked)
    if room == "full disk":
        monkeypatch.setattr(unpacked_chunks.os, "pwrite", lambda *_: 10)
    elif room == "no such folder":
        monkeypatch.setattr(unpacked_chunks.tempfile, "tempdir", str(path.parent / "none"))
    else:
        most = max(unpacked) if room == "of one chunk" else 0
        monkeypatch.setattr(unpacked_chunks, "MOST_BYTES", most)
    unpacked.clear()
    assert everything(open_recording(path)) == expected
    assert len(unpacked) == 2 * chunks - (room == "of one chunk")


def test_the_file_goes_with_the_last_recording(path):
    """Recordings share one. Breaks if each has its own, or if it outlives them."""
    gc.collect()
    before = open_files()
    first, second = open_recording(path), open_recording(path)
    assert open_files() == before + 1
    assert everything(first) == everything(second)
    del first
    assert everything(second)
    del second
    gc.collect()
    assert open_files() == before


def test_a_second_process_reads_what_the_first_one_kept(path):
    """While both read. Breaks if they share the position in the file."""
    recording = open_recording(path)
    expected = everything(recording)
    allow_fork()
    try:
        ahead = Prefetch(lambda: iter(everything(recording)))
        assert everything(recording) == expected
        assert list(ahead) == expected
    finally:
        allow_fork(second=False)
