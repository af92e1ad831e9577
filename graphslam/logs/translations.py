"""Messages of other encodings and schemas as the ROS 2 messages in CDR that are decoded.

A row of `TRANSLATIONS` per encoding. A message that cannot be translated becomes empty, so that it
is counted where messages are decoded.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import zstandard

from graphslam.core.errors import LogError
from graphslam.logs import foxglove, schemas
from graphslam.logs.cdr import CdrError
from graphslam.logs.container_files import ZSTD_MAGIC
from graphslam.logs.multi_echo import MULTI_ECHO, first_echoes
from graphslam.logs.wire import WireError

#: from the bytes as recorded to CDR
Translate = Callable[[bytes], bytes]


class Translation(NamedTuple):
    """The name of a ROS 2 schema, and how a message becomes one; None: it is one."""

    schema: str
    translate: Translate | None


def _from_cdr(schema: str) -> Translation | None:
    if schema == MULTI_ECHO:
        return Translation(schemas.LASER_SCAN, _first_echoes)
    # rosbag2 may compress every message by itself
    return Translation(schema, _uncompressed)


def _first_echoes(data: bytes) -> bytes:
    try:
        return first_echoes(_uncompressed(data))
    except (CdrError, LogError):  # LogError: a stamp that ROS 2 does not have
        return b""


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
    if ros2 == MULTI_ECHO:
        return Translation(
            schemas.LASER_SCAN, lambda data: _first_echoes(_ros1_message(ros2, data))
        )
    return Translation(ros2, partial(_ros1_message, ros2)) if ros2 in schemas.KNOWN else None


def _ros1_message(schema: str, data: bytes) -> bytes:
    try:
        return schemas.ros1_to_cdr(schema, data)
    except CdrError:
        return b""


def _from_foxglove(encoding: str, schema: str) -> Translation | None:
    package, _, name = schema.partition(".")
    if package != "foxglove" or name not in foxglove.KINDS:
        return None
    return Translation(foxglove.KINDS[name].schema, partial(_foxglove_message, name, encoding))


def _foxglove_message(name: str, encoding: str, data: bytes) -> bytes:
    try:
        return foxglove.to_cdr(name, encoding, data)
    except WireError:
        return b""


TRANSLATIONS: dict[str, Callable[[str], Translation | None]] = {
    "cdr": _from_cdr,
    "json": partial(_from_foxglove, "json"),
    "protobuf": partial(_from_foxglove, "protobuf"),
    "ros1": _from_ros1,
}


@cache
def translation(schema: str, encoding: str) -> Translation | None:
    """How messages of a schema and an encoding are read; None if they are not."""
    row = TRANSLATIONS.get(encoding)
    return row(schema) if row else None
