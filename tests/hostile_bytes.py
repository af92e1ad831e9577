"""Every place where bytes of a stranger enter: what reads them, and bytes to begin with.

A reader may refuse what it is given, with a `GraphSlamError` of one line. Anything else that it
raises is a defect. `benchmarks/fuzz.py` looks for such bytes, tests keep those that were found.
"""

import gzip
import io
import itertools
import tempfile
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import recordings
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from graphslam.core.config import Config
from graphslam.core.config_io import load_config
from graphslam.core.errors import GraphSlamError
from graphslam.core.record_codec import read, write
from graphslam.core.records import Trajectory
from graphslam.importers import IMPORTERS
from graphslam.logs import open_logs
from graphslam.pipeline.checkpoint import kinds

ROOT = Path(__file__).parents[1]
#: messages of logs/ that recordings are made of
FEW = 40

FLASER = """PARAM robot_frontlaser_offset 0.25 nohost 0
ODOM 0 0 0 0 0 0 100.000001 host 0.1
FLASER 3 1.25 2.5 81.83 0 0 0 0 0 0 100.5 host 0.2
ROBOTLASER1 0 -1.57 3.14 1.57 81.9 0.01 0 3 1.25 2.5 8 0 0 0 0 0 0 0 0 0 0 0 0 0 101.5 host 0.2
ODOM 1 0 0.5 0 0 0 102.25 host 0.3
"""
G2O = """VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1 0 0.1
VERTEX_XY 2 3 4
EDGE_SE2 0 1 1 0 0 100 0 0 100 0 400
EDGE_SE2_XY 1 2 3 4 25 0 25
EDGE_PRIOR_SE2 0 0 0 0 1 0 0 1 0 1
"""
ISAM = """ODOMETRY 0 1 1 0 0 1 0 0 1 0 1
EDGE2 0 1 1 0 0 1 0 0 1 0 1
LANDMARK2 0 2 4 4 25 0 25
"""
MRCLAM = {
    "Barcodes.dat": "# Subject # Barcode #\n 1 \t 5 \n 2 14\n 6 63\n",
    "Landmark_Groundtruth.dat": " 6 \t 0.5 \t -4.25 \t 0.00004 \t 0.0003 \n",
    "Robot1_Odometry.dat": "1248272272.156 \t 0.1 \t 0.0 \n1248272273.156 0.2 -0.4\n",
    "Robot1_Measurement.dat": "1248272272.700 63 2.5 -0.25\n1248272272.800 14 1.5 0.125\n",
    "Robot1_Groundtruth.dat": "1248272272.103 1.5 -3.5 2.25\n",
}
TABLES = {
    "odometry.csv": "stamp,x,y,heading\n1.5,0,0,0\n1.75,0.1,0,0.01\n",
    "scans.csv": "stamp,first,step,ranges\n1.5,-1.57,0.5,1,2,,4\n",
    "truth.tum": "# true\n1.5 0 0 0 0 0 0 1\n",
    "laser.csv": "x,y,heading\n0.2,0,0\n",
}
TINYSLAM = " ".join(map(str, [212387282, 14710, 29221, 25178, *[0] * 20, *[1500] * 682, 0]))


class Target(NamedTuple):
    """What reads bytes, given them and an empty folder; and some bytes that it reads well."""

    take: Callable[[bytes, Path], object]
    seeds: Callable[[], Iterator[bytes]]


def refused(take: Callable[[], object]) -> str | None:
    """Call a reader: what it says of what it refuses, None if it takes it.

    Raises:
        Exception: of any other kind than `GraphSlamError`, or one of several lines.
    """
    try:
        take()
    except GraphSlamError as error:
        if "\n" in str(error) or not str(error):
            raise ValueError("its message is not of one line") from error
        return str(error)
    return None


# ---------------------------------------------------------------- recordings


def _recording(name: str, data: bytes, folder: Path) -> None:
    path = folder / name
    path.write_bytes(data)
    log = open_logs([path], Config())
    for _ in itertools.islice(log.messages(), 10_000):
        pass


def _beside(name: str, whole: dict[str, str], data: bytes, folder: Path, form: str) -> None:
    """One file of a folder is replaced: the one whose number is the first byte."""
    source = folder / name
    source.mkdir()
    names = sorted(whole)
    for k, own in enumerate(names):
        chosen = bool(data) and data[0] % len(names) == k
        (source / own).write_bytes(data[1:] if chosen else whole[own].encode())
    IMPORTERS[form](source, folder / "log.mcap")


def _numbered(whole: dict[str, str]) -> Iterator[bytes]:
    for k, own in enumerate(sorted(whole)):
        yield bytes([k]) + whole[own].encode()


@cache
def _few(log: str, **options) -> bytes:
    """The first messages of a log, by the library of MCAP."""
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=4000, **options)
    writer.start("ros2", "seed")
    made: dict[str, int] = {}
    with (ROOT / f"logs/{log}.mcap").open("rb") as source:
        found = make_reader(source).iter_messages(log_time_order=False)
        for schema, channel, message in itertools.islice(found, FEW):
            if channel.topic not in made:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                made[channel.topic] = writer.register_channel(
                    channel.topic, channel.message_encoding, kind
                )
            writer.add_message(made[channel.topic], message.log_time, message.data, 1)
    writer.finish()
    return stream.getvalue()


def _mcaps() -> Iterator[bytes]:
    for log in ("lab", "two-robots"):
        for compression in (CompressionType.NONE, CompressionType.ZSTD, CompressionType.LZ4):
            yield _few(log, compression=compression)
        yield _few(log, use_chunking=False)


def _containers(*names: str) -> Iterator[bytes]:
    with tempfile.TemporaryDirectory() as place:
        log = Path(place) / "few.mcap"
        log.write_bytes(_few("two-robots", compression=CompressionType.NONE))
        for name in names:
            own, make = recordings.CONTAINERS[name]
            yield make(log, Path(place) / own).read_bytes()


# ---------------------------------------------------------------- messages


@cache
def _topics() -> list[tuple[str, str, str, bytes, str, bytes]]:
    """Of all topics of the sample logs: topic, schema, its encoding and text, encoding, message."""
    found = {}
    for log in ("lab", "two-robots", "robots-in-scans", "fleet"):
        with (ROOT / f"logs/{log}.mcap").open("rb") as source:
            for schema, channel, message in make_reader(source).iter_messages():
                found.setdefault(
                    schema.name,
                    (channel.topic, schema.name, schema.encoding, schema.data,
                     channel.message_encoding, message.data),
                )  # fmt: skip
    return [found[name] for name in sorted(found)]


def _message(data: bytes, folder: Path) -> None:
    """A log whose messages are whole but one: of the topic whose number is the first byte."""
    topics = _topics()
    path = folder / "log.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start("ros2", "fuzz")
        for k, (topic, name, encoding, text, message_encoding, whole) in enumerate(topics):
            kind = writer.register_schema(name, encoding, text)
            channel = writer.register_channel(topic, message_encoding, kind)
            chosen = bool(data) and data[0] % len(topics) == k
            writer.add_message(channel, 1, data[1:] if chosen else whole, 1)
        writer.finish()
    _recording("again.mcap", path.read_bytes(), folder)


def _messages() -> Iterator[bytes]:
    for k, topic in enumerate(_topics()):
        yield bytes([k]) + topic[-1]


# ---------------------------------------------------------------- the rest


def _import(form: str, name: str, data: bytes, folder: Path) -> None:
    (folder / name).write_bytes(data)
    IMPORTERS[form](folder / name, folder / "log.mcap")


def _rawlogs() -> Iterator[bytes]:
    """Not packed: damage of the packing would hide all other; the last as MRPT wrote it."""
    for form in ("pairs", "observations"):
        packed = (ROOT / f"tests/importers/rawlog/{form}.rawlog").read_bytes()
        yield gzip.decompress(packed)[:8000]
    yield packed


def _settings(data: bytes, folder: Path) -> None:
    (folder / "settings.toml").write_bytes(data)
    load_config(folder / "settings.toml")


def _bytes(*texts: str) -> Callable[[], Iterator[bytes]]:
    return lambda: (text.encode() for text in texts)


SETTINGS = """[keyframe]
distance_m = 0.5
[robots.a]
axle_m = 0.3
[start.poses]
a = [0, 0, 0]
"""


def _checkpoint() -> Iterator[bytes]:
    stream = io.BytesIO()
    way = Trajectory(np.arange(2), np.zeros((2, 3)), np.zeros((2, 3, 3)))
    write((1.5, {"a": [way, way], ("b", 2): {"c"}}, np.float64(2.0), b"d"), kinds(), stream)
    yield stream.getvalue()


TARGETS: dict[str, Target] = {
    "MCAP": Target(partial(_recording, "a.mcap"), _mcaps),
    "SQLite": Target(partial(_recording, "a.db3"), partial(_containers, "bare .db3")),
    "ROS 1 bag": Target(
        partial(_recording, "a.bag"),
        partial(_containers, "ROS 1 bag", "ROS 1 bag, bz2", "ROS 1 bag, lz4"),
    ),
    "compressed file": Target(
        partial(_recording, "a.mcap.zstd"), partial(_containers, ".mcap.zstd")
    ),
    "messages": Target(_message, _messages),
    "CARMEN": Target(partial(_import, "carmen", "a.clf"), _bytes(FLASER)),
    "g2o, TORO": Target(partial(_import, "g2o", "a.g2o"), _bytes(G2O)),
    "iSAM": Target(partial(_import, "isam", "a.txt"), _bytes(ISAM)),
    "MRPT rawlog": Target(partial(_import, "rawlog", "a.rawlog"), _rawlogs),
    "tinySLAM": Target(partial(_import, "tinyslam", "a.dat"), _bytes(TINYSLAM)),
    "MRCLAM": Target(
        lambda data, folder: _beside("set", MRCLAM, data, folder, "mrclam"),
        partial(_numbered, MRCLAM),
    ),
    "tables": Target(
        lambda data, folder: _beside("tables", TABLES, data, folder, "csv"),
        partial(_numbered, TABLES),
    ),
    "settings": Target(_settings, _bytes(SETTINGS)),
    "checkpoint": Target(lambda data, _folder: read(data, kinds()), _checkpoint),
}
