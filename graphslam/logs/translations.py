"""Messages of other encodings and schemas as the ROS 2 messages in CDR that are decoded.

A row of `TRANSLATIONS` per encoding. A message that cannot be translated becomes empty, so that it
is counted where messages are decoded.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import zstandard

from graphslam.logs import schemas
from graphslam.logs.cdr import CdrError
from graphslam.logs.container_files import ZSTD_MAGIC

#: from the bytes as recorded to CDR
Translate = Callable[[bytes], bytes]


class Translation(NamedTuple):
    """The name of a ROS 2 schema, and how a message becomes one; None: it is one."""

    schema: str
    translate: Translate | None


def _from_cdr(schema: str) -> Translation | None:
    # rosbag2 may compress every message by itself
    return Translation(schema, _uncompressed)


def _uncompressed(data: bytes) -> bytes:
    """The message without the zstd compression that it may have."""
    if data[:4] != ZSTD_MAGIC:
        return data
    try:
        return zstandard.ZstdDecompressor().decompressobj().decompress(data)
    except (zstandard.ZstdError, MemoryError):
        return b""


#: schemas of ROS 1 with another name than in ROS 2
_RENAMED = {"tf/tfMessage": schemas.TF_MESSAGE}


def _from_ros1(schema: str) -> Translation | None:
    package, _, name = schema.partition("/")
    ros2 = _RENAMED.get(schema, f"{package}/msg/{name.removeprefix('msg/')}")
    if ros2 not in schemas.KNOWN:
        return None
    return Translation(ros2, partial(_ros1_message, ros2))


def _ros1_message(schema: str, data: bytes) -> bytes:
    try:
        return schemas.ros1_to_cdr(schema, data)
    except CdrError:
        return b""


TRANSLATIONS: dict[str, Callable[[str], Translation | None]] = {
    "cdr": _from_cdr,
    "ros1": _from_ros1,
}


@cache
def translation(schema: str, encoding: str) -> Translation | None:
    """How messages of a schema and an encoding are read; None if they are not."""
    row = TRANSLATIONS.get(encoding)
    return row(schema) if row else None
