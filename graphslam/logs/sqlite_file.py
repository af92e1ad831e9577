"""rosbag2's SQLite files (.db3): the readable rows, also if the file is damaged.

A database that was cut off, or has damaged pages, is read around them: SQLite finds every row by
its number, and rows that it cannot reach are skipped. Nothing beside the file is needed.
"""

import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from urllib.parse import quote

from graphslam.core.errors import LogError
from graphslam.core.sensor_config import LimitsConfig
from graphslam.logs.container_files import digest, unchanged, unpacked_file
from graphslam.logs.recording import (
    MAX_BLOCK,
    Block,
    BlockList,
    Channel,
    Piece,
    ReadBlock,
    count_undescribed,
    one_line,
    undescribed,
)
from graphslam.logs.schemas import full_name

MAGIC = b"SQLite format 3\0"

#: number of a row, number of its topic, log time ns, message
_Row = tuple[int, int, int, bytes]
_ROWS = "SELECT id, topic_id, timestamp, data FROM messages WHERE id >= ? ORDER BY id LIMIT ?"
_ALL = -1
#: rows are numbered one after the other: no log has more
_MOST_ROWS = 1 << 40


def index_sqlite(path: Path, _limits: LimitsConfig) -> Piece:
    """Read through the database ``path`` once and index it.

    Raises:
        LogError: it is not one of rosbag2.
        OSError: it cannot be read.
    """
    with _database(path) as database:
        return _indexed(path, database)


@contextmanager
def _reading(piece: Piece) -> Iterator[ReadBlock]:
    """Reads blocks of ``piece``."""
    with _database(piece.path) as database:
        yield unchanged(partial(_block_messages, database), (sqlite3.Error,), piece.path)


@contextmanager
def _database(path: Path) -> Iterator[sqlite3.Connection]:
    with unpacked_file(path, _whole_pages) as plain:
        # what a recorder that was ended by force left to be merged into the file; without such a
        # file the database is opened so that nothing is written beside it
        pending = plain.with_name(plain.name + "-wal")
        lasting = "" if pending.is_file() and pending.stat().st_size else "&immutable=1"
        address = f"file:{quote(str(plain.absolute()))}?mode=ro{lasting}"
        with closing(sqlite3.connect(address, uri=True)) as database:
            database.text_factory = partial(str, encoding="utf-8", errors="replace")
            # without it a file that was cut off is refused as a whole
            database.execute("PRAGMA writable_schema=ON")
            yield database


def _whole_pages(head: bytes, size: int) -> int:
    """Size of a database of ``size`` bytes without the last page, if that was cut off.

    SQLite would fill it up with zeros, which would be taken for messages.
    """
    page = int.from_bytes(head[16:18], "big")
    page = 65536 if page == 1 else page
    return size - size % page if page else size


def _block_messages(
    database: sqlite3.Connection, block: Block, wanted: Collection[int]
) -> Iterator[tuple[int, int, bytes]]:
    """Topic's number, log time ns and data of the messages of wanted topics in a block."""
    # not by the number of its last row: to see that it is passed, SQLite would read the next page,
    # which may be damaged
    rows = (block.offset, block.end - block.offset + 1)
    for _, topic, log_time_ns, data in database.execute(_ROWS, rows):
        if topic in wanted and _is_message(topic, log_time_ns, data):
            yield topic, log_time_ns, data


def _is_message(topic: object, log_time_ns: object, data: object) -> bool:
    """Whether values of a row have their types: SQLite takes any."""
    return isinstance(topic, int) and isinstance(log_time_ns, int) and isinstance(data, bytes)


def _indexed(path: Path, database: sqlite3.Connection) -> Piece:
    try:
        topics = database.execute("SELECT id, name, type, serialization_format FROM topics")
        channels = {
            number: Channel(str(name), full_name(str(kind), str(encoding)), str(encoding))
            for number, name, kind, encoding in topics
        }
    except sqlite3.DatabaseError as error:
        raise LogError(
            f"{path}: is not an SQLite file of rosbag2, or its list of topics is damaged "
            f"({one_line(error)}); name another file"
        ) from error
    blocks = BlockList()
    damage: list[str] = []
    numbers: list[int] = []
    times: list[int] = []
    first = last = 0
    broken = False
    for row in _readable(database, damage):
        number, topic, log_time_ns, data = row
        if times and (len(times) == MAX_BLOCK or number != last + 1):
            # a block never reaches over rows that cannot be read
            blocks.add(first, last, numbers, times)
            numbers, times = [], []
        if not _is_message(topic, log_time_ns, data):
            broken = True
            continue
        first = first if times else number
        last = number
        numbers.append(topic)
        times.append(log_time_ns)
    blocks.add(first, last, numbers, times)
    if broken:
        damage.append("rows are not messages")
    unknown = count_undescribed(blocks.blocks, channels)
    return Piece(
        path=path,
        sha256=digest(path),
        channels=channels,
        blocks=tuple(blocks.blocks),
        in_order=blocks.in_order,
        lost=None if damage else unknown,
        damage="; ".join([*damage, *undescribed(unknown)]),
        open=_reading,
    )


def _readable(database: sqlite3.Connection, damage: list[str]) -> Iterator[_Row]:
    """All rows that can be read, in their order; what cannot is described in ``damage``."""
    last, step = 0, 0
    while last + step < _MOST_ROWS:
        try:
            for row in database.execute(_ROWS, (last + step + 1, _ALL)):
                if row[0] <= last + step:  # damaged pages may lead in a circle
                    raise sqlite3.DatabaseError("rows are out of order")
                if step:
                    damage[-1] += f" to {row[0] - 1}"
                    step = 0
                last = row[0]
                yield row
        except sqlite3.DatabaseError as error:
            if not step:
                damage.append(f"messages cannot be read ({one_line(error)}) from row {last + 1}")
            # rows of a damaged page are passed in growing steps
            step = max(1, 2 * step)
        else:
            return
