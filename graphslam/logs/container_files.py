"""Files of recordings as streams of bytes; those compressed with zstd are unpacked on the way."""

import hashlib
import io
import tempfile
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import zstandard

from graphslam.core.errors import LogError

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

    from graphslam.logs.recording import Block, Piece, ReadBlock

    #: number of its channel, log time ns, data
    Message = tuple[int, int, bytes]

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_BUFFER = 1 << 20
_HEAD = 100


def open_file(path: Path) -> BinaryIO:
    """``path`` for reading at any place; unpacked, if it is compressed with zstd.

    A compressed file that is damaged or cut off ends there. To go back in it means to begin again.

    Raises:
        OSError: it cannot be read.
    """
    if is_compressed(path):
        return io.BufferedReader(_Unpacked(path), _BUFFER)
    return path.open("rb")


@contextmanager
def stream_reader(
    block_messages: "Callable[[BinaryIO, Block, Collection[int]], Iterator[Message]]",
    errors: tuple[type[Exception], ...],
    piece: "Piece",
) -> "Iterator[ReadBlock]":
    """Reads blocks of ``piece`` by ``block_messages``, whose first argument is the open file.

    ``errors`` are those that it raises on damage, which was not there before.
    """
    with open_file(piece.path) as stream:
        yield unchanged(partial(block_messages, stream), errors, piece.path)


def unchanged(read: "ReadBlock", errors: tuple[type[Exception], ...], path: Path) -> "ReadBlock":
    """``read`` with a `LogError` in place of ``errors``: what it reads was read without before."""
    caught: tuple[type[Exception], ...] = (*errors, OSError)

    def reading(block: "Block", wanted: Collection[int]) -> "Iterator[Message]":
        try:
            yield from read(block, wanted)
        except caught as error:
            raise changed(path) from error

    return reading


def changed(path: Path) -> LogError:
    """The error for a file that is another one than when it was indexed."""
    return LogError(f"{path}: changed while it was read; read it when it is complete")


def too_large(path: Path, offset: int, setting: str) -> LogError:
    """The error for a chunk at byte ``offset`` that is beyond a setting of [limits]."""
    return LogError(
        f"{path}: the chunk at byte {offset}, when unpacked, is beyond limits.{setting}; "
        "raise it if the file is to be trusted"
    )


def is_compressed(path: Path) -> bool:
    """Whether the file is compressed with zstd."""
    with path.open("rb") as stream:
        return stream.read(len(ZSTD_MAGIC)) == ZSTD_MAGIC


@contextmanager
def unpacked_file(path: Path, usable: Callable[[bytes, int], int]) -> Iterator[Path]:
    """``path`` itself; a temporary file if it is compressed or only its beginning can be used.

    Args:
        path: a file.
        usable: from its first bytes and its size, unpacked, the size that can be used.
    """
    with open_file(path) as source:
        size = size_of(source)
        head = source.read(_HEAD)
        wanted = usable(head, size)
        if wanted == size and not is_compressed(path):
            yield path
            return
        with tempfile.NamedTemporaryFile(prefix="graphslam-", suffix=path.stem) as target:
            source.seek(0)
            while part := source.read(min(_BUFFER, wanted - target.tell())):
                target.write(part)
            target.flush()
            yield Path(target.name)


def size_of(stream: BinaryIO) -> int:
    """Number of bytes in ``stream``, which is left at its beginning."""
    size = stream.seek(0, io.SEEK_END)
    stream.seek(0)
    return size


def digest(path: Path) -> str:
    """SHA-256 of the file as it lies on the disk."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


class _Unpacked(io.RawIOBase):
    """The contents of a zstd file."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb")
        self._size: int | None = None
        self._restart()

    def _restart(self) -> None:
        self._file.seek(0)
        unpacker = zstandard.ZstdDecompressor()
        self._stream = unpacker.stream_reader(self._file, read_across_frames=True, closefd=False)
        self._at, self._broken = 0, False

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def readinto(self, buffer: "WriteableBuffer") -> int:
        view = memoryview(buffer).cast("B")
        try:
            data = b"" if self._broken else self._stream.read(len(view))
        except zstandard.ZstdError:
            data, self._broken = b"", True  # it ends where it is damaged
        view[: len(data)] = data
        self._at += len(data)
        return len(data)

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        if whence == io.SEEK_END:
            target = self._end() + offset
        else:
            target = offset + (self._at if whence == io.SEEK_CUR else 0)
        if target < 0:
            raise OSError("before the beginning of the file")
        if target < self._at:
            self._restart()
        part = bytearray(_BUFFER)
        while self._at < target:
            if not self.readinto(memoryview(part)[: min(_BUFFER, target - self._at)]):
                break
        return self._at

    def _end(self) -> int:
        """Number of bytes of the contents; reads on to it at the first call."""
        if self._size is None:
            part = bytearray(_BUFFER)
            while self.readinto(part):
                pass
            self._size = self._at
        return self._size

    def close(self) -> None:
        self._file.close()
        super().close()
