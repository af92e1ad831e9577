"""A recording that is read while it is written."""

import os
import shutil
import time
from itertools import chain

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from recordings import messages_of
from room_log import drive

from graphslam.core.config import Config
from graphslam.core.errors import LogError
from graphslam.logs import growing_mcap
from graphslam.logs.containers import open_recording
from graphslam.logs.growing_mcap import open_growing
from graphslam.logs.recording import raw_messages

LIMITS = Config().limits


def written(log, target, **options):
    """The messages of a log in a file with other chunks."""
    with target.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start()
        channels = {}
        for topic, schema, log_time, data in messages_of(log):
            if topic not in channels:
                number = writer.register_schema(schema, "ros2msg", b"")
                channels[topic] = writer.register_channel(topic, "cdr", number)
            writer.add_message(channels[topic], log_time, data, log_time)
        writer.finish()
    return target


FORMS = {
    "small chunks": {"chunk_size": 2000, "compression": CompressionType.ZSTD},
    "one chunk": {"chunk_size": 1 << 30},
    "no chunks": {"use_chunking": False},
}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The room's log in every form."""
    folder = tmp_path_factory.mktemp("forms")
    log = drive(folder / "room.mcap", seconds=10)
    return {
        name: written(log, folder / f"{k}.mcap", **options)
        for k, (name, options) in enumerate(FORMS.items())
    }


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("seed", range(3))
def test_a_file_that_grows_by_pieces_gives_every_message_once(files, form, seed, tmp_path):
    """In the order of the file, wherever the pieces end; the footer ends it."""
    whole = files[form].read_bytes()
    cuts = np.sort(np.random.default_rng(seed).integers(8, len(whole), 40)).tolist()
    path = tmp_path / "growing.mcap"
    path.write_bytes(whole[:8])
    found = []
    with open_growing(path, LIMITS, 1.0) as growing:
        for begin, end in zip([8, *cuts], [*cuts, len(whole)], strict=True):
            assert not growing.ended
            with path.open("ab") as stream:
                stream.write(whole[begin:end])
            growing.poll()
            found += chain.from_iterable(growing.new_blocks())
        assert growing.ended
        piece = growing.recording().pieces[0]
        assert (piece.damage, piece.lost) == ("", 0)
    recording = open_recording(files[form])
    assert found == list(raw_messages(recording, {topic.name for topic in recording.topics}))


@pytest.fixture
def half(files, tmp_path):
    """A recording of which half is there, as read so far."""
    whole = files["small chunks"].read_bytes()
    path = tmp_path / "growing.mcap"
    path.write_bytes(whole[: len(whole) // 2])
    with open_growing(path, LIMITS, 1.0) as growing:
        assert growing.poll()
        yield growing


def cut(path):
    os.truncate(path, path.stat().st_size // 2)


def replaced(path):
    other = path.with_suffix(".other")
    shutil.copy(path, other)
    other.replace(path)


def overwritten(path):
    size = path.stat().st_size
    path.write_bytes(bytes(size))  # the same file, other contents


@pytest.mark.parametrize(
    ("harm", "text"),
    [
        (cut, "was cut or overwritten"),
        (overwritten, "was cut or overwritten"),
        (replaced, "was replaced by another file"),
        (os.unlink, "was taken away"),
    ],
)
def test_a_file_that_is_not_the_same_any_more_is_refused(half, harm, text):
    """What was read of it may be wrong, and what follows does not belong to it."""
    harm(half.path)
    with pytest.raises(LogError, match=text):
        half.poll()


def test_reading_ends_when_nothing_comes(half, monkeypatch):
    """And not before: `idle` is called while there is hope.

    One chunk at a time is in memory, though all was there at the first look.
    """
    clock = [0.0]
    monkeypatch.setattr(growing_mcap.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(growing_mcap.time, "sleep", lambda s: clock.__setitem__(0, clock[0] + s))
    idle = []
    batches = list(half.batches(5.0, lambda: idle.append(clock[0])))
    assert sum(map(len, batches)) > 50
    assert max(map(len, batches)) < 0.2 * sum(map(len, batches))
    assert 4.8 < max(idle) <= 5.0 + growing_mcap.POLL_S


def test_what_was_not_whole_while_others_were_worked_on_is_no_damage(files, tmp_path):
    """A batch takes longer than `wait_s`, and meanwhile half of the next chunk was written."""
    whole = files["small chunks"].read_bytes()
    path = tmp_path / "growing.mcap"
    path.write_bytes(whole[: len(whole) // 2])
    wait_s, count = 0.3, 0
    with open_growing(path, LIMITS, 1.0) as growing:
        for batch in growing.batches(wait_s):
            count += len(batch)
            if path.stat().st_size < len(whole) // 2 + 700:
                with path.open("ab") as stream:  # chunks have 2000 bytes of messages
                    stream.write(whole[len(whole) // 2 :][:700])
                time.sleep(2 * wait_s)
        assert not growing.ended
    assert count > 50


def test_other_files_are_refused_before_anything_is_made(tmp_path):
    """A file of another kind, one that does not begin, a folder."""
    text = tmp_path / "text.mcap"
    text.write_text("hello, world")
    with pytest.raises(LogError, match="is no MCAP file"):
        open_growing(text, LIMITS, 1.0)
    with pytest.raises(LogError, match="nothing was written to it"):
        open_growing(tmp_path / "missing.mcap", LIMITS, 0.05)
    with pytest.raises(LogError, match="cannot be read"):
        open_growing(tmp_path, LIMITS, 1.0)
