"""Objects of MRPT's binary serialization in a stream of bytes, packed with gzip or not.

An object is a byte 0x80 + length of its class' name, the name (with namespaces since MRPT 2), a
byte for the version of its layout, its fields without any length (little-endian), and the byte
0x88. Objects lie in each other, so what is not known cannot be jumped over by its length: the next
name of a class is looked for.

Source: https://docs.mrpt.org/reference/latest/class_mrpt_serialization_CArchive.html
"""

import re
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from graphslam.core.errors import LogError
from graphslam.logs.source_files import unreadable

GZIP_MAGIC = b"\x1f\x8b"
END = 0x88  # of an object
_NAME = re.compile(rb"(?:mrpt::(?:\w+::)?)?(C\w+)")
#: the first byte of an observation, an action or what holds them, and its name behind it
_WANTED = re.compile(
    rb"[\x80-\xff](?=(?:mrpt::obs::)?C(?:Observation|ActionRobot|ActionColl|SensoryFrame))"
)
_LONGEST_NAME = 0x7F
_PART = 1 << 16
#: bytes of a field, and of what lies between two objects that are known: no real ones are larger
_LARGEST, _FARTHEST = 1 << 24, 1 << 28


class UnreadableError(Exception):
    """An object that is not as its class and version should be; the text says what it is."""


@dataclass
class SkippedObjects:
    """What was not read, by class, and where the stream is damaged (empty: nowhere)."""

    skipped: Counter[str] = field(default_factory=Counter)
    damaged: Counter[str] = field(default_factory=Counter)
    damage: str = ""


class ObjectReader:
    """Fields of one object after the other, in bounded memory.

    Args:
        source: name of the file, for messages.
        stream: its bytes, at the beginning.
        findings: where damage of the packing is noted.
    """

    def __init__(self, source: Path, stream: BinaryIO, findings: SkippedObjects) -> None:
        self._source = source
        self._findings = findings
        self._parts = self._unpacked(stream)
        self._window = bytearray()  # from the beginning of the present object on
        self._at = 0

    def take(self, size: int) -> bytes:
        """The next ``size`` bytes.

        Raises:
            UnreadableError: there are not as many.
        """
        if size > _LARGEST or not self._fill(size):
            raise UnreadableError("is cut off, or states a size that it cannot have")
        self._at += size
        return bytes(self._window[self._at - size : self._at])

    def unpack(self, layout: str) -> tuple[Any, ...]:
        """Numbers by the codes of `struct`, little-endian without gaps."""
        return struct.unpack(f"<{layout}", self.take(struct.calcsize(f"<{layout}")))

    def text(self) -> str:
        """A text with its length before it."""
        return self.take(self.unpack("I")[0]).decode("utf-8", errors="replace")

    def head(self) -> tuple[str, int]:
        """Class, without namespaces, and version of the object that begins here.

        Raises:
            UnreadableError: none begins here.
        """
        length = self.take(1)[0] - 0x80
        name = _NAME.fullmatch(self.take(max(length, 0)))
        if name is None:
            raise UnreadableError("no object begins where one should")
        return name[1].decode(), self.take(1)[0]

    def end(self) -> None:
        """The end of an object.

        Raises:
            UnreadableError: it is not here: its fields are others.
        """
        if self.take(1)[0] != END:
            raise UnreadableError("does not end where it should")

    def begin(self) -> bool:
        """Go on from here to the next object, over the ends of those around it; is there any?"""
        while self._fill(1) and self._window[self._at] == END:
            self._at += 1
        self._forget()
        return self._fill(1)

    def search(self) -> bool:
        """Go to the next object of those that are looked for, behind the present one's first byte.

        Raises:
            LogError: there is none for longer than there can be in a rawlog.
        """
        self._at, passed = 1, 0
        while passed < _FARTHEST:
            while found := _WANTED.search(self._window, self._at):
                self._at = found.start()
                size = 1 + self._window[self._at] - 0x80
                if self._fill(size) and _NAME.fullmatch(
                    self._window, self._at + 1, self._at + size
                ):
                    self._forget()
                    return True
                self._at += 1
            # a name may have begun at the end of the window
            start = max(self._at, len(self._window) - _LONGEST_NAME - 1)
            passed += start - self._at
            self._at = start
            self._forget()
            if not self._fill(len(self._window) + 1):
                self._at = len(self._window)
                return False
        raise LogError(
            f"{self._source}: has no object that is known in {_FARTHEST >> 20} MB; is it a rawlog?"
        )

    def _forget(self) -> None:
        """What is before is not gone back to."""
        del self._window[: self._at]
        self._at = 0

    def _fill(self, size: int) -> bool:
        """Whether there are ``size`` bytes more."""
        while len(self._window) < self._at + size:
            part = next(self._parts, b"")
            if not part:
                return False
            self._window += part
        return True

    def _unpacked(self, stream: BinaryIO) -> Iterator[bytes]:
        """The bytes up to the end, or to where they cannot be unpacked; that is noted."""
        try:
            packed = stream.read(_PART)
            if not packed.startswith(GZIP_MAGIC):
                while packed:
                    yield packed
                    packed = stream.read(_PART)
                return
            while packed.startswith(GZIP_MAGIC):
                unpacker = zlib.decompressobj(zlib.MAX_WBITS | 16)
                while not unpacker.eof:
                    # small parts: what is unpacked in a step that finds an error is lost
                    part = unpacker.decompress(packed, _PART)
                    yield from filter(None, (part,))
                    packed = unpacker.unconsumed_tail
                    if not packed and len(part) < _PART and not unpacker.eof:
                        packed = stream.read(_PART)
                        if not packed:
                            self._findings.damage = "it is cut off"
                            return
                packed = unpacker.unused_data + stream.read(_PART)
        except zlib.error as error:
            self._findings.damage = " ".join(str(error).split())
        except OSError as error:
            raise unreadable(self._source, error) from error
