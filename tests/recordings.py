"""The messages of a log in other containers, written by the formats' reference writers."""

import sqlite3
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import rosbags.rosbag1
import rosbags.rosbag2
import zstandard
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from graphslam.logs import schemas

#: topic, schema, log time ns, CDR bytes
Message = tuple[str, str, int, bytes]


def messages_of(log: Path) -> Iterator[Message]:
    """The messages of an MCAP file in its order."""
    with log.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages(log_time_order=False):
            yield channel.topic, schema.name, message.log_time, message.data


def typestore(version: Stores) -> Any:
    """Types of a version of ROS, and our own."""
    store = get_typestore(version)
    more = schemas.DEFINITIONS | {schemas.TF_MESSAGE: "geometry_msgs/TransformStamped[] transforms"}
    for name, text in more.items():
        if name not in store.types:  # ROS 1 lacks that of tf2
            store.register(get_types_from_msg(text, name))
    return store


def rosbag2(log: Path, target: Path, storage: StoragePlugin, compression: CompressionMode) -> Path:
    """A folder as `ros2 bag record` makes it."""
    store, made = typestore(Stores.ROS2_HUMBLE), {}
    writer = rosbags.rosbag2.Writer(target, version=9, storage_plugin=storage)
    writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        for topic, schema, log_time, data in messages_of(log):
            if topic not in made:
                made[topic] = writer.add_connection(topic, schema, typestore=store)
            writer.write(made[topic], log_time, data)
    return target


def bag(log: Path, target: Path, compression: str = "", chunk_bytes: int = 1 << 20) -> Path:
    """A ROS 1 bag."""
    store, made = typestore(Stores.ROS1_NOETIC), {}
    # fields of ROS 2 are read without, those of ROS 1 written with the number in headers
    plain = typestore(Stores.ROS2_HUMBLE)
    writer = rosbags.rosbag1.Writer(target)
    writer.chunk_threshold = chunk_bytes
    if compression:
        writer.set_compression(writer.CompressionFormat[compression.upper()])
    with writer:
        for topic, schema, log_time, data in messages_of(log):
            if topic not in made:
                made[topic] = writer.add_connection(topic, schema, typestore=store)
            writer.write(made[topic], log_time, plain.cdr_to_ros1(data, schema))
    return target


def ros1_mcap(log: Path, target: Path) -> Path:
    """An MCAP file with the encoding and the names of ROS 1, as of a converted bag."""
    plain, made = typestore(Stores.ROS2_HUMBLE), {}
    with target.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros1")
        for topic, schema, log_time, data in messages_of(log):
            if topic not in made:
                kind = writer.register_schema(schema.replace("/msg/", "/"), "ros1msg", b"")
                made[topic] = writer.register_channel(topic, "ros1", kind)
            own = bytes(plain.cdr_to_ros1(data, schema))
            writer.add_message(made[topic], log_time, own, log_time)
        writer.finish()
    return target


def bare_db3(log: Path, target: Path) -> Path:
    """A database without its folder and metadata.yaml."""
    folder = rosbag2(log, target.parent / "bare", StoragePlugin.SQLITE3, CompressionMode.NONE)
    return (folder / "bare.db3").rename(target)


def compressed(log: Path, target: Path) -> Path:
    """The file, compressed with zstd as a whole."""
    target.write_bytes(zstandard.ZstdCompressor().compress(log.read_bytes()))
    return target


def split_mcap(log: Path, target: Path, pieces: int = 4) -> Path:
    """A folder of MCAP files that follow each other, without metadata."""
    target.mkdir()
    messages = list(messages_of(log))
    size = -(-len(messages) // pieces)
    for number in range(pieces):
        # names that do not sort by number: `_10` comes before `_9`
        with (target / f"log_{number + 7}.mcap").open("wb") as stream:
            writer = Writer(stream)
            writer.start(profile="ros2")
            made = {}
            for topic, schema, log_time, data in messages[number * size : (number + 1) * size]:
                if topic not in made:
                    kind = writer.register_schema(schema, "ros2msg", schemas.definition(schema))
                    made[topic] = writer.register_channel(topic, "cdr", kind)
                writer.add_message(made[topic], log_time, data, log_time)
            writer.finish()
    return target


def split_rosbag2(log: Path, target: Path, pieces: int = 3) -> Path:
    """A folder of databases, as `ros2 bag record --max-bag-duration` makes it."""
    rosbag2(log, target, StoragePlugin.SQLITE3, CompressionMode.NONE)
    whole = target / f"{target.name}.db3"
    names = [f"{target.name}_{number}.db3" for number in range(pieces)]
    with sqlite3.connect(whole) as database:
        count = database.execute("SELECT count(*) FROM messages").fetchone()[0]
    size = -(-count // pieces)
    for number, name in enumerate(names):
        (target / name).write_bytes(whole.read_bytes())
        database = sqlite3.connect(target / name)
        keep = (number * size, (number + 1) * size)
        database.execute("DELETE FROM messages WHERE id <= ? OR id > ?", keep)
        database.commit()
        database.execute("VACUUM")
        database.close()
    whole.unlink()
    files = "".join(
        f"    - path: {name}\n      message_count: {min(size, count - number * size)}\n"
        for number, name in enumerate(names)
    )
    listed = "".join(f"    - {name}\n" for name in names)
    (target / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: sqlite3\n"
        f"  relative_file_paths:\n{listed}  message_count: {count}\n  files:\n{files}"
    )
    return target


_SQLITE, _MCAP = StoragePlugin.SQLITE3, StoragePlugin.MCAP
_NONE, _FILE, _MESSAGE = CompressionMode.NONE, CompressionMode.FILE, CompressionMode.MESSAGE

#: name, name of the file or folder, and what makes it of an MCAP log
CONTAINERS: dict[str, tuple[str, Callable[[Path, Path], Path]]] = {
    "rosbag2 folder, sqlite3": ("a", partial(rosbag2, storage=_SQLITE, compression=_NONE)),
    "rosbag2 folder, sqlite3, zstd by file": (
        "b", partial(rosbag2, storage=_SQLITE, compression=_FILE)),
    "rosbag2 folder, sqlite3, zstd by message": (
        "c", partial(rosbag2, storage=_SQLITE, compression=_MESSAGE)),
    "rosbag2 folder, MCAP": ("d", partial(rosbag2, storage=_MCAP, compression=_NONE)),
    "rosbag2 folder, MCAP, zstd by file": ("e", partial(rosbag2, storage=_MCAP, compression=_FILE)),
    "rosbag2 folder, MCAP, zstd by message": (
        "f", partial(rosbag2, storage=_MCAP, compression=_MESSAGE)),
    "rosbag2 folder, split": ("g", split_rosbag2),
    "bare .db3": ("h.db3", bare_db3),
    "ROS 1 bag": ("i.bag", bag),
    "ROS 1 bag, bz2": ("j.bag", partial(bag, compression="bz2")),
    "ROS 1 bag, lz4": ("k.bag", partial(bag, compression="lz4")),
    ".mcap.zstd": ("l.mcap.zstd", compressed),
    "folder of MCAP files": ("m", split_mcap),
    "MCAP, ROS 1 encoding": ("n.mcap", ros1_mcap),
}  # fmt: skip
