"""Recordings by their files: one row of `CONTAINERS` per container, found by its first bytes."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from graphslam.core.errors import LogError
from graphslam.core.output_folder import RECORDING_SUFFIXES
from graphslam.core.sensor_config import LimitsConfig
from graphslam.logs import bag_file, mcap_file, sqlite_file
from graphslam.logs.container_files import is_compressed, open_file
from graphslam.logs.recording import Piece, Recording
from graphslam.logs.rosbag2_metadata import METADATA, Metadata, read_metadata
from graphslam.logs.source_files import unpacked_beginning


class Container(NamedTuple):
    """A row of `CONTAINERS`: the bytes that a file begins with, and what indexes it."""

    magic: bytes
    make_index: Callable[[Path, LimitsConfig], Piece]


CONTAINERS: dict[str, Container] = {
    "MCAP": Container(mcap_file.MAGIC, mcap_file.index_mcap),
    "rosbag2 SQLite": Container(sqlite_file.MAGIC, sqlite_file.index_sqlite),
    "ROS 1 bag": Container(bag_file.MAGIC, bag_file.index_bag),
}

#: the limits of who names none
NO_MORE = LimitsConfig()

_LONGEST = max(len(container.magic) for container in CONTAINERS.values())
#: what is beside recordings in folders, and is not looked at
_PACKED = {b"\x1f\x8b": "gzip", b"BZh": "bzip2", b"\xfd7zXZ": "xz", b"PK\x03\x04": "zip"}


def open_recording(path: Path, limits: LimitsConfig = NO_MORE) -> Recording:
    """Read through ``path`` once and index it.

    It is a file of any row of `CONTAINERS`, also compressed with zstd, or a folder of such files,
    which are the pieces of one recording.

    Raises:
        LogError: no such file, unreadable, of no known container, without any message, or with a
            chunk beyond ``limits``.
    """
    try:
        recording = (
            _open_folder(path, limits)
            if path.is_dir()
            else Recording(path, (_indexed(path, limits),))
        )
    except FileNotFoundError as error:
        raise LogError(f"{path}: no such file; check the path") from error
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}; check the file") from error
    if not recording.messages:
        damage = recording.damage
        why = f"no message can be read: {damage}" if damage else "is an empty log"
        raise LogError(f"{path}: {why}; record it again or name another file")
    return recording


def is_recording(path: Path) -> bool:
    """Whether ``path`` is a file of any row of `CONTAINERS`, or a folder."""
    return path.is_dir() or (path.is_file() and _container_of(path) is not None)


def _indexed(path: Path, limits: LimitsConfig) -> Piece:
    container = _container_of(path)
    if container is None:
        raise LogError(f"{path}: {_what_it_is(path)}")
    return container.make_index(path, limits)


def _container_of(path: Path) -> Container | None:
    with open_file(path) as stream:
        return _container_that_begins(stream.read(_LONGEST))


def _container_that_begins(begin: bytes) -> Container | None:
    rows = CONTAINERS.values()
    return next((row for row in rows if begin.startswith(row.magic)), None)


def _what_it_is(path: Path) -> str:
    """What a file of no known container is, and what to do."""
    with open_file(path) as stream:
        begin = stream.read(_LONGEST)
    if not begin and is_compressed(path):
        return "is compressed with zstd and damaged at its beginning; copy it again"
    if not begin:
        return "is an empty file, not an MCAP file or another recording; is it the right one?"
    if begin.startswith(bag_file.ANY_VERSION):
        return "is a bag of an old version; `rosbag fix` makes one of version 2.0 of it"
    for magic, name in _PACKED.items():
        if begin.startswith(magic):
            # recordings, which `graphslam import rosbag` reads, are none of the formats that are
            # imported packed
            recording = _container_that_begins(unpacked_beginning(path, name, _LONGEST))
            return f"is packed with {name}; unpack it" + (
                "" if recording else ", or `graphslam import` it"
            )
    if path.name == METADATA:
        return "is the description of a recording; name the folder that it is in"
    return (
        f"is not an MCAP file, nor another recording ({', '.join(CONTAINERS)}); "
        "`graphslam import` turns other formats into MCAP"
    )


# ---------------------------------------------------------------- folders


def _open_folder(folder: Path, limits: LimitsConfig) -> Recording:
    """The files of recordings in ``folder`` as the pieces of one, in the order of time."""
    metadata = read_metadata(folder / METADATA)
    paths = [path for path in sorted(folder.iterdir()) if path.is_file()]
    if metadata.files:
        # other files, for example copies, are not part of the recording
        paths = [path for path in paths if metadata.listed(path.name)]
    paths = [path for path in paths if path.stat().st_size]
    found = [path for path in paths if _container_of(path)]
    rest = [path for path in paths if path not in found]
    others = [path.name for path in rest if path.suffix in RECORDING_SUFFIXES]
    damaged = f"{', '.join(others)} does not begin as a recording" if others else ""
    if not found:
        what = f"{damaged}; copy it again" if damaged else _without_recording(folder)
        raise LogError(f"{folder}: {what}")
    pieces = [_counted(_indexed(path, limits), metadata) for path in found]
    pieces = [piece for piece in pieces if piece.messages or piece.damage or piece.lost]
    pieces.sort(key=lambda piece: piece.start_ns)
    missing = metadata.missing([path.name for path in paths])
    absent = f"{', '.join(missing)} of {METADATA} is not there" if missing else ""
    return Recording(folder, tuple(pieces), "; ".join(filter(None, (absent, damaged))))


def _counted(piece: Piece, metadata: Metadata) -> Piece:
    """The piece with its lost messages, if the metadata has their number.

    It may know of more than the file does: what was cut out of it, for example.
    """
    stated = metadata.messages_of(piece.path.name)
    if stated is None or stated < piece.messages:
        return piece
    return replace(piece, lost=max(piece.lost or 0, stated - piece.messages))


def _without_recording(folder: Path) -> str:
    """What to say about a folder in which there is none."""
    inside = sorted(path.name for path in folder.iterdir() if path.is_dir())
    if inside:
        return f"is a directory without a recording; name a folder in it, such as {inside[0]}"
    return f"is a directory without a recording ({', '.join(CONTAINERS)}); name another one"
