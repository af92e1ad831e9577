"""Text files that importers read: plain, compressed, in a folder or in an archive."""

import bz2
import gzip
import lzma
import re
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from io import BufferedIOBase
from itertools import chain
from pathlib import Path, PurePosixPath
from typing import TextIO, TypeVar

from graphslam.core.errors import LogError

_OPENERS: dict[str, Callable[..., TextIO]] = {".bz2": bz2.open, ".gz": gzip.open, ".xz": lzma.open}
_UNPACKERS: dict[str, Callable[..., BufferedIOBase]] = {
    "gzip": gzip.GzipFile,
    "bzip2": bz2.BZ2File,
    "xz": lzma.LZMAFile,
}
_ARCHIVE_SUFFIXES = {".zip", ".tar", ".tgz", ".tbz2", ".txz", *_OPENERS}
_T = TypeVar("_T")

#: of an encrypted archive RuntimeError, of one packed by an unknown method NotImplementedError; the
#: others from ValueError on are those of damaged heads
_READ_ERRORS = (
    OSError,
    EOFError,
    tarfile.TarError,
    zipfile.BadZipFile,
    lzma.LZMAError,
    zlib.error,
    RuntimeError,
    NotImplementedError,
    ValueError,
    OverflowError,
    struct.error,
)
#: no text of a data set is larger when it is unpacked
MOST_BYTES = 2_000_000_000


def text_lines(path: Path) -> Iterator[str]:
    """Lines of a text file, plain or compressed with gzip, bzip2 or xz.

    Bytes that are not UTF-8 are replaced: old logs have comments in any encoding. A byte-order mark
    is no part of the first line.

    Raises:
        LogError: no such file, a directory, or not readable to its end.
    """
    try:
        opener = _OPENERS.get(path.suffix, open)
        with opener(path, "rt", encoding="utf-8-sig", errors="replace") as lines:
            yield from lines
    except IsADirectoryError as error:
        raise LogError(f"{path}: is a directory; name the log in it") from error
    except _READ_ERRORS as error:
        raise unreadable(path, error) from error


def first_and_all(items: Iterator[_T], if_empty: str) -> tuple[_T, Iterator[_T]]:
    """The first of ``items``, and all of them.

    Raises:
        LogError: there is none; ``if_empty`` is its message.
    """
    for first in items:
        return first, chain((first,), items)
    raise LogError(if_empty)


def text_files(
    source: Path, names: re.Pattern[str], others: list[str] | None = None
) -> dict[str, str]:
    """Texts of all files in a folder or archive whose base name matches, at any depth.

    Args:
        source: a folder, a .zip or a .tar (plain or with any compression that Python knows);
            archives are read without unpacking.
        names: pattern that a base name must match in full.
        others: where base names of the other files are appended.

    Returns:
        Base name -> text; bytes that are not UTF-8 are replaced, and a byte-order mark is left out.

    Raises:
        LogError: no such file, not readable to its end, or two files of the same name.
    """
    texts: dict[str, str] = {}
    try:
        for path, read in _members(source):
            name = PurePosixPath(path).name
            if not names.fullmatch(name):
                if others is not None:
                    others.append(name)
                continue
            if name in texts:
                raise LogError(f"{source}: holds two files {name}; name the folder of one data set")
            text = read()
            if len(text) > MOST_BYTES:
                raise LogError(f"{source}: {name} is larger than 2 GB when unpacked; is it a log?")
            texts[name] = text.decode("utf-8-sig", errors="replace")
    except _READ_ERRORS as error:
        raise unreadable(source, error) from error
    return texts


def _members(source: Path) -> Iterator[tuple[str, Callable[[], bytes]]]:
    """Path and reader of each file in a folder or archive; none if it is another kind of file.

    Each must be read before the next is taken: tar is streamed, as seeking in .xz is slow.
    """
    if source.is_dir():
        yield from ((p.name, p.read_bytes) for p in sorted(source.rglob("*")) if p.is_file())
    elif zipfile.is_zipfile(source):
        with zipfile.ZipFile(source) as packed:
            for name in packed.namelist():
                yield name, partial(_unpack, packed, name)
    elif source.stat().st_size and (
        source.suffix.lower() in _ARCHIVE_SUFFIXES or tarfile.is_tarfile(source)
    ):
        with tarfile.open(source, "r|*") as archive:
            for member in archive:
                if content := archive.extractfile(member):
                    yield member.name, partial(content.read, 1 + MOST_BYTES)


def _unpack(packed: zipfile.ZipFile, name: str) -> bytes:
    with packed.open(name) as stream:
        return stream.read(1 + MOST_BYTES)


def unpacked_beginning(path: Path, packing: str, size: int) -> bytes:
    """The first ``size`` bytes of what is packed in ``path``; none if they cannot be unpacked.

    ``packing`` is gzip, bzip2, xz or zip; of a .zip it is the first file.
    """
    try:
        if packing == "zip":
            with zipfile.ZipFile(path) as packed:
                first = next(name for name in packed.namelist() if not name.endswith("/"))
                with packed.open(first) as stream:
                    return stream.read(size)
        with _UNPACKERS[packing](path, "rb") as stream:
            return stream.read(size)
    except (*_READ_ERRORS, StopIteration):
        return b""


def unreadable(source: Path, error: Exception) -> LogError:
    """What to say of a file whose reading ended with ``error``."""
    if isinstance(error, FileNotFoundError):
        return LogError(f"{source}: no such file; check the path")
    why = " ".join(str(getattr(error, "strerror", None) or error).split())
    return LogError(f"{source}: cannot be read to its end: {why}; fetch it again")
