"""An MCAP file that is still written: what was added to it since it was looked at last."""

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO, cast

from graphslam.core.errors import LogError
from graphslam.core.sensor_config import LimitsConfig
from graphslam.logs.mcap_chunks import DAMAGE, RECORD
from graphslam.logs.mcap_file import MAGIC, Indexer, block_messages, records_from
from graphslam.logs.recording import RawMessage, Recording
from graphslam.logs.translations import translation

#: s between two looks at the file
POLL_S = 0.02
#: bytes of the record read last by which it is known again
_KNOWN_AGAIN = 64


class GrowingMcap:
    """A reader that follows a file to its end, wherever that is now; a context manager.

    Records count once they are there as a whole, chunks too: what a recorder keeps in memory is not
    seen. ``ended``: the recorder closed the file.
    """

    def __init__(self, path: Path, stream: BinaryIO, limits: LimitsConfig) -> None:
        """``stream``: the open file, of which MAGIC is there."""
        self.path, self.ended = path, False
        self._stream = stream
        self._indexer = Indexer(path, stream, limits)
        self._last = b""  # the beginning of the record read last, which is at the indexer's place
        self._given = 0  # blocks
        self._end = len(MAGIC)  # of the record read last

    def __enter__(self) -> "GrowingMcap":
        return self

    def __exit__(self, *error: object) -> None:
        self._stream.close()

    def poll(self) -> bool:
        """Take in what was added; whether there was anything.

        Raises:
            LogError: the file was cut, replaced or taken away, or a chunk is beyond the limits.
        """
        self._check()
        indexer, begin, grown = self._indexer, self._indexer.position, False
        try:
            for offset, opcode, body in records_from(self._stream, begin):
                if self._last and offset == begin:
                    continue  # the one read last
                indexer.position, grown = offset, True
                self._end = offset + RECORD.size + len(body)
                indexer.add(offset, opcode, body)
            self.ended = True
        except DAMAGE:
            pass  # what is incomplete now may be complete soon
        indexer.close_loose_block()
        if grown:
            self._stream.seek(indexer.position)
            self._last = self._stream.read(_KNOWN_AGAIN)
        return grown

    def recording(self, *, is_over: bool = False) -> Recording:
        """What was read so far, as a recording.

        ``is_over``: nothing is added any more. What cannot be read at its end then is damage.
        """
        piece, left = self._indexer.result(), self._size() - self._end
        if is_over and not self.ended and left > 0:
            text = f"{left} bytes from byte {self._end} on are no whole record"
            piece = replace(piece, damage="; ".join(filter(None, (piece.damage, text))), lost=None)
        return Recording(self.path, (piece,))

    def kinds(self) -> dict[str, tuple[str, str]]:
        """Schema and encoding of the topics that are described so far, see `RawTopic`."""
        found = {}
        for channel in self._indexer.described().values():
            known = translation(channel.schema, channel.encoding)
            kind = (known.schema, "cdr") if known else (channel.schema, channel.encoding)
            found[channel.topic] = kind
        return found

    def new_blocks(self) -> Iterator[list[RawMessage]]:
        """Messages that `poll` found and that were not given yet, translated, block by block."""
        channels = {}
        for number, channel in self._indexer.described().items():
            found = translation(channel.schema, channel.encoding)
            channels[number] = channel.topic, found.translate if found else None
        blocks = self._indexer.blocks.blocks
        while self._given < len(blocks):
            block, batch = blocks[self._given], []
            self._given += 1
            for number, log_ns, data in block_messages(self._stream, block, channels.keys()):
                topic, translate = channels[number]
                batch.append(RawMessage(topic, log_ns, translate(data) if translate else data))
            yield batch

    def batches(
        self, wait_s: float, idle: Callable[[], None] = lambda: None
    ) -> Iterator[list[RawMessage]]:
        """The messages as they come, until the file ends or has not grown for ``wait_s``.

        One block at a time is in memory, however much was recorded before.

        ``idle``: called while there is nothing to read.

        Raises:
            LogError: it has grown for ``wait_s``, but by nothing that can be read; or see `poll`.
        """
        grown = longer = time.monotonic()  # by records, and by bytes
        size = self._size()
        while True:
            for batch in self.new_blocks():
                yield batch
                # what was added while it was worked on need not be whole yet
                grown = longer = time.monotonic()
            if self.ended:
                return
            if self._size() != size:
                longer, size = time.monotonic(), self._size()
            if self.poll():
                grown = time.monotonic()
                continue
            if time.monotonic() - grown > wait_s:
                if longer - grown < 0.5 * wait_s:
                    return  # at most a record that was not finished
                raise LogError(
                    f"{self.path}: grows, but is damaged: nothing can be read from byte "
                    f"{self._indexer.position} on; start the recorder and follow again"
                )
            idle()
            time.sleep(POLL_S)

    def _size(self) -> int:
        return os.fstat(self._stream.fileno()).st_size

    def _check(self) -> None:
        """Whether the file is still the one that was opened, with all that was read in it."""
        wrong = ""
        try:
            if not os.path.samestat(os.fstat(self._stream.fileno()), self.path.stat()):
                wrong = "was replaced by another file"
        except OSError:
            wrong = "was taken away"
        self._stream.seek(self._indexer.position)
        if not wrong and self._stream.read(len(self._last)) != self._last:
            wrong = "was cut or overwritten"
        if wrong:
            raise LogError(f"{self.path}: {wrong} while it was followed; follow it from its start")


def open_growing(path: Path, limits: LimitsConfig, wait_s: float) -> GrowingMcap:
    """Open a recording that may not have begun yet.

    Raises:
        LogError: it does not appear within ``wait_s``, or is no MCAP file.
    """
    begin = time.monotonic()
    while time.monotonic() - begin <= wait_s:
        try:
            stream = path.open("rb", buffering=0)
        except FileNotFoundError:
            time.sleep(POLL_S)
            continue
        except OSError as error:
            raise LogError(f"{path}: cannot be read: {error.strerror}; check the path") from error
        head = stream.read(len(MAGIC))
        if head == MAGIC:
            return GrowingMcap(path, cast(BinaryIO, stream), limits)
        stream.close()
        if not MAGIC.startswith(head):
            raise LogError(
                f"{path}: is no MCAP file, and only these can be followed; smooth reads the others"
            )
        time.sleep(POLL_S)
    raise LogError(f"{path}: nothing was written to it for {wait_s:g} s; start the recorder")
