"""Whether damaged recordings are read without loss in silence, tracebacks, hangs or much memory.

Logs of logs/, cut short, are written in every container that is read, by the formats' reference
writers. How many messages that are is what an independent reader says (that of `mcap`, or of
rosbags). Each file is then damaged by one of the kinds of tests/mutations.py (in a folder: one of
its files), and read in a process of its own, with 1 GB of memory and 60 s: all raw messages, the
records that they are decoded to, and for one of ten what `graphslam info` tells.

*whole*: every message is as it was; *told*: what is missing or changed is reported (as an error of
one line, as damage, or as a number of lost messages that is at least what is missing); *changed*:
contents are others and nobody is told, in a file without a CRC over them, where nobody can tell.
Not allowed: *silent* (messages are missing, or more than are said to be, or contents that have a
CRC are others), *traceback* (anything but an error of one line), *hang* and *memory*.

Rows are kept in mutated_files.jsonl as they are made, and an interrupted run goes on there.

Run: python benchmarks/mutated_files.py [DIR] [--files 2160] [--only TEXT] [--table]
exit code 1 if anything that is not allowed was found.
"""

import contextlib
import io
import itertools
import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import rosbags.rosbag1
import rosbags.rosbag2
from common import ROOT, parser
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

sys.path.insert(0, str(ROOT))
from graphslam.cli import main
from graphslam.core.config import Config
from graphslam.core.errors import GraphSlamError
from graphslam.logs import open_logs
from graphslam.logs.container_files import open_file
from graphslam.logs.containers import open_recording
from graphslam.logs.recording import raw_messages
from tests import mutations, recordings

#: logs of logs/, and how many of their messages are taken
LOGS = {"lab": 240, "two-robots": 400, "forest": 300}
MEMORY_BYTES, LIMIT_S = 1 << 30, 60
INFO_EVERY = 10
#: bytes of a chunk: so small that a short log has several
CHUNK = 12_000
#: where a chunk has the CRC of its contents
_CHUNK_CRC = slice(24, 28)
#: what may come of a damaged file, and what may not
ALLOWED = ("whole", "told", "changed")
FORBIDDEN = ("silent", "traceback", "hang", "memory")


# ---------------------------------------------------------------- containers


def first_messages(log: Path, target: Path, count: int, **options: Any) -> Path:
    """The first messages of an MCAP file, written by the library of MCAP."""
    made: dict[str, int] = {}
    with log.open("rb") as source, target.open("wb") as stream:
        writer = Writer(stream, chunk_size=CHUNK, **options)
        writer.start("ros2", "mutated_files")
        reader = make_reader(source)
        messages = reader.iter_messages(log_time_order=False)
        for schema, channel, message in itertools.islice(messages, count):
            if channel.topic not in made:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                made[channel.topic] = writer.register_channel(
                    channel.topic, channel.message_encoding, kind
                )
            writer.add_message(
                made[channel.topic], message.log_time, message.data, message.publish_time
            )
        writer.finish()
    return target


def again(log: Path, target: Path, **options: Any) -> Path:
    return first_messages(log, target, 1 << 40, **options)


#: name -> name of the file or folder, and what makes it of an MCAP log
CONTAINERS: dict[str, tuple[str, Callable[[Path, Path], Path]]] = {
    "MCAP, zstd": ("p.mcap", again),
    "MCAP, lz4": ("q.mcap", partial(again, compression=CompressionType.LZ4)),
    "MCAP, unpacked": ("r.mcap", partial(again, compression=CompressionType.NONE)),
    "MCAP, no chunks": ("s.mcap", partial(again, use_chunking=False)),
    **recordings.CONTAINERS,
}


def has_crc(path: Path) -> bool:
    """Whether every message is under a CRC: in a chunk of MCAP that has one."""
    files = [one for one in path.iterdir() if one.suffix != ".yaml"] if path.is_dir() else [path]
    for file in files:
        with open_file(file) as stream:
            data = stream.read()
        if not data.startswith(mutations.MAGIC):
            return False
        for opcode, body in mutations.records(data):
            if opcode == Opcode.MESSAGE:
                return False
            if opcode == Opcode.CHUNK and not any(body[_CHUNK_CRC]):
                return False
    return True


def independent_count(path: Path) -> int:
    """How many messages a reader that is not ours finds."""
    if path.is_dir() and (path / "metadata.yaml").is_file():
        with rosbags.rosbag2.Reader(path) as bag2:
            return sum(1 for _ in bag2.messages())
    if path.suffix == ".bag":
        with rosbags.rosbag1.Reader(path) as bag1:
            return sum(1 for _ in bag1.messages())
    if path.is_dir():
        return sum(map(independent_count, path.iterdir()))
    with path.open("rb") as stream:
        return sum(1 for _ in make_reader(stream).iter_messages())


class Whole(NamedTuple):
    """A recording before it is damaged: how many messages, and each by its checksum."""

    path: Path
    count: int
    messages: Counter[int]
    has_crc: bool


def whole(log: str, container: str, folder: Path) -> Whole:
    short = folder / f"{log}.mcap"
    if not short.exists():
        first_messages(ROOT / "logs" / f"{log}.mcap", short, LOGS[log])
    name, make = CONTAINERS[container]
    place = folder / log
    place.mkdir(exist_ok=True)
    path = make(short, place / name)
    try:
        count = independent_count(path)
    except Exception:  # packed as a whole, or without metadata: not read by others
        count = independent_count(short)
    messages = Counter(map(checksum, raw(path)[1]))
    if messages.total() != count or _decoded(path):
        sys.exit(f"{container}: {messages.total()} messages are read where others read {count}")
    return Whole(path, count, messages, has_crc(path))


def raw(path: Path) -> tuple[Any, list[Any]]:
    file = open_recording(path)
    return file, list(raw_messages(file, {topic.name for topic in file.topics}))


def checksum(message: Any) -> int:
    return zlib.crc32(message.data, zlib.crc32(f"{message.topic} {message.log_time_ns}".encode()))


# ---------------------------------------------------------------- one damaged file


class Job(NamedTuple):
    """One damaged file: log, container and number, which is the seed of its damage."""

    log: str
    container: str
    number: int

    @property
    def name(self) -> str:
        """Identifies it among the rows."""
        return f"{self.log} | {self.container} | {self.number}"


def damaged(job: Job, given: Whole, folder: Path) -> tuple[str, Path]:
    """What was done, and where the damaged recording is."""
    target = folder / given.path.name
    seed = zlib.crc32(job.name.encode())
    if not given.path.is_dir():
        kind, data = next(mutations.mutations(given.path.read_bytes(), seed))
        target.write_bytes(data)
        return kind, target
    shutil.copytree(given.path, target)
    files = sorted(path for path in target.iterdir() if path.stat().st_size)
    chosen = files[seed % len(files)]
    kind, data = next(mutations.mutations(chosen.read_bytes(), seed))
    chosen.write_bytes(data)
    return f"{kind}, {chosen.name}", target


def read(path: Path, given: Whole, info: bool) -> dict[str, Any]:
    """What reading a damaged recording comes to: ``outcome`` and what it is of."""
    try:
        file, found = raw(path)
    except GraphSlamError as error:
        return {"outcome": _one_line(str(error)), "said": str(error)}
    read_now = Counter(map(checksum, found))
    missing = (given.messages - read_now).total()
    foreign = (read_now - given.messages).total()
    row = {
        "read": len(found), "missing": missing, "foreign": foreign,
        "lost": file.lost, "said": file.damage,
    }  # fmt: skip
    row["outcome"] = _outcome(row, given)
    for problem in (_decoded(path), _told(path) if info else ""):
        if problem:
            row |= {"outcome": problem, "said": problem}
    return row


def _outcome(row: dict[str, Any], given: Whole) -> str:
    if not row["missing"] and not row["foreign"]:
        return "whole"
    if row["lost"] is not None and given.count - row["read"] > row["lost"]:
        return "silent"  # or more than is said
    if row["lost"] != 0 or row["said"]:
        return "told"
    return "silent" if given.has_crc and row["missing"] else "changed"


def _decoded(path: Path) -> str:
    """What is wrong with the records of the log: `silent` if some are neither read nor dropped."""
    try:
        log = open_logs([path], Config())
        records = sum(1 for _ in log.messages())
    except GraphSlamError as error:
        return "" if _one_line(str(error)) == "told" else "traceback"
    dropped = sum(n for reason, n in log.dropped.items() if not reason.startswith("range:"))
    if any(_one_line(line) != "told" for line in log.warnings):
        return "traceback"
    return "silent" if records + dropped < log.count() else ""


def _told(path: Path) -> str:
    """What is wrong with `graphslam info` of the log."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main(["info", str(path)])
        except SystemExit as done:
            wrong = done.code not in (0, None, 1) or err.getvalue().count("\n") > 1
            return "traceback" if wrong or not (out.getvalue() or err.getvalue()) else ""
    return "traceback"


def _one_line(text: str) -> str:
    return "told" if text and "\n" not in text else "traceback"


def in_process(work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """``work`` in a forked process within the limits, with its time and memory."""
    begin = time.monotonic()
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        os.close(reader)
        signal.setitimer(signal.ITIMER_REAL, LIMIT_S)  # ends the process, whatever it is in
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
        warnings.simplefilter("error")  # a warning of Python is no message for people
        _reset_peak()
        try:
            row = work()
        except BaseException as error:  # whatever it is, it is what is looked for
            kind = "memory" if isinstance(error, MemoryError) else "traceback"
            row = {"outcome": kind, "said": traceback.format_exc()[-2000:]}
        row["memory_mb"] = _peak_mb()
        os.write(writer, json.dumps(row).encode()[:60_000])
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as stream:
        text = stream.read()
    _, status = os.waitpid(child, 0)
    if status:
        number = os.WTERMSIG(status)
        outcome = "hang" if number == signal.SIGALRM else "traceback"
        row = {"outcome": outcome, "said": f"ended by signal {number}", "memory_mb": 0}
    else:
        row = json.loads(text)
    return {**row, "seconds": round(time.monotonic() - begin, 3)}


def _reset_peak() -> None:
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _peak_mb() -> int:
    """Most memory that the process has had since `_reset_peak`, that of its parent included."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) // 1024
    return 0


# ---------------------------------------------------------------- all of them


def jobs(files: int) -> list[Job]:
    """So many damaged files, in an order in which the first few are of every container."""
    every = itertools.count()
    kinds = list(itertools.product(LOGS, CONTAINERS))
    return list(itertools.islice((Job(*kind, n) for n in every for kind in kinds), files))


def rows(wanted: Sequence[Job], done: set[str]) -> Iterator[dict[str, Any]]:
    with tempfile.TemporaryDirectory() as place:
        made: dict[tuple[str, str], Whole] = {}
        for number, job in enumerate(wanted):
            if job.name in done:
                continue
            key = job.log, job.container
            if key not in made:
                made[key] = whole(*key, Path(place))
            with tempfile.TemporaryDirectory() as folder:
                kind, path = damaged(job, made[key], Path(folder))
                info = number % INFO_EVERY == 0
                row = in_process(partial(read, path, made[key], info))
            yield {"name": job.name, "container": job.container, "kind": kind, **row}


def table(found: Sequence[dict[str, Any]]) -> str:
    groups: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in found:
        groups[row["container"]].append(row)
    kinds = (*ALLOWED, *FORBIDDEN)
    lines = [f"| container | files | {' | '.join(kinds)} | most memory, MB | longest, s |"]
    lines.append("|" + "---|" * (len(kinds) + 4))
    for name, group in [("all", list(found)), *groups.items()]:
        counts = Counter(row["outcome"] for row in group)
        memory = max(row["memory_mb"] for row in group)
        seconds = max(row["seconds"] for row in group)
        cells = " | ".join(str(counts[kind]) for kind in kinds)
        lines.append(f"| {name} | {len(group)} | {cells} | {memory} | {seconds:.1f} |")
    return "\n".join(lines)


def run() -> int:
    options = parser(__doc__)
    options.add_argument("directory", nargs="?", default="out/mutated_files", type=Path)
    options.add_argument("--files", type=int, default=2160, help="number of damaged files")
    options.add_argument("--only", default="", help="text in the names of the files that are read")
    options.add_argument("--table", action="store_true", help="print the table of what is there")
    given = options.parse_args()
    given.directory.mkdir(parents=True, exist_ok=True)
    kept = given.directory / "mutated_files.jsonl"
    found = [json.loads(line) for line in kept.open()] if kept.exists() else []
    wanted = [job for job in jobs(given.files) if given.only in job.name]
    if not given.table:
        with kept.open("a") as stream:
            for row in rows(wanted, {row["name"] for row in found}):
                stream.write(json.dumps(row) + "\n")
                stream.flush()
                found.append(row)
    names = {job.name for job in wanted}
    found = [row for row in found if row["name"] in names]
    if not found:
        print("nothing was read")
        return 1
    print(table(found))
    bad = [row for row in found if row["outcome"] in FORBIDDEN]
    for row in bad[:20]:
        print(f"{row['outcome']}: {row['name']} ({row['kind']}): {row['said'].strip()[-300:]}")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(run())
