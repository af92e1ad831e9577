"""Chunks that are expensive to unpack, kept unpacked in a temporary file.

A recording is indexed, sampled and read, so each of its chunks is wanted several times. The file is
one per process, whatever number of recordings is open: it has no name, so it is gone with the last
of them however the program ends, and grows to `MOST_BYTES` at most; chunks beyond that are unpacked
again. Memory holds none. A forked process reads what was kept before the fork.
"""

import os
import tempfile
import weakref
from contextlib import suppress

#: size of the file; with no more space on the disk it ends earlier
MOST_BYTES = 1 << 29

_shared: "weakref.WeakValueDictionary[int, _TemporaryFile]" = weakref.WeakValueDictionary()


class UnpackedChunks:
    """Those of one file, by where they begin in it."""

    def __init__(self) -> None:
        """None yet."""
        self._places: dict[int, tuple[int, int]] = {}
        self._store: _TemporaryFile | None = None

    def keep(self, offset: int, data: bytes) -> None:
        """Keep the contents of the chunk at byte ``offset``, if there is room."""
        with suppress(OSError):  # no folder for temporary files, or a full disk
            self._store = self._store or _store_of_process()
            at = self._store.append(data)
            if at is not None:
                self._places[offset] = at, len(data)

    def get(self, offset: int) -> bytes | None:
        """The contents of the chunk at byte ``offset``; None if they were not kept."""
        place = self._places.get(offset)
        if place is None or self._store is None:
            return None
        at, size = place
        return self._store.read(at, size)


class _TemporaryFile:
    """A file without a name to which bytes are appended."""

    def __init__(self) -> None:
        file = tempfile.TemporaryFile(prefix="graphslam-", buffering=0)  # noqa: SIM115
        weakref.finalize(self, file.close)
        self._file, self._end = file, 0

    def append(self, data: bytes) -> int | None:
        """Where the data are in the file; None if there is no room for them."""
        at = self._end
        if at + len(data) > MOST_BYTES or os.pwrite(self._file.fileno(), data, at) < len(data):
            return None
        self._end += len(data)
        return at

    def read(self, at: int, size: int) -> bytes | None:
        """Bytes of the file; None if they cannot be read."""
        # not by the position of the file, which forked processes share
        data = os.pread(self._file.fileno(), size, at)
        return data if len(data) == size else None


def _store_of_process() -> _TemporaryFile:
    """The file of this process: the one it was forked from appends to its own."""
    store = _shared.get(os.getpid())
    if store is None:
        store = _shared[os.getpid()] = _TemporaryFile()
    return store
