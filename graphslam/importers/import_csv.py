"""Tables of numbers to MCAP: odometry as CSV or TUM, scans as CSV.

A folder or archive with, per robot:

- ``odometry.csv``: stamp s, x m, y m, heading rad; or ``odometry.tum``: stamp s, x y z m, and the
  quaternion x y z w.
- ``scans.csv``: stamp s, first angle rad, step rad, then the ranges m; a range that is empty, nan,
  inf or not positive is no return.
- ``laser.csv``: x m, y m, heading rad of the laser on the base; without it the base itself.
- ``truth.csv`` or ``truth.tum``: true poses, as odometry.

Files of several robots are called ``NAME.odometry.csv``; upper and lower case are the same. Columns
of a file are separated by semicolons or tabs, and then decimal commas may be used, else by commas,
else by blanks; lines of poses have as many columns as each other. A first line of names may state
another order of columns (`csv_columns`). Lines that begin with ``#`` are left out.
"""

import math
import re
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import NamedTuple, TypeVar

import numpy as np

from graphslam.core.errors import LogError
from graphslam.importers import csv_units
from graphslam.importers.csv_columns import (
    MOUNT,
    POSES,
    SCANS,
    TUM_POSES,
    Columns,
    Kind,
    columns_of,
)
from graphslam.importers.csv_tables import Table, read_table
from graphslam.importers.import_carmen import finite, parse_stamp_ns
from graphslam.importers.import_summary import ImportSummary
from graphslam.logs.physical_limits import MAX_RANGE_M
from graphslam.logs.schemas import DEFAULT_ROBOT
from graphslam.logs.source_files import text_files
from graphslam.logs.writer import Event, LogWriter

_FILES = re.compile(
    r"(?:(?P<robot>.+)\.)?(?P<what>odometry|scans|laser|truth)\.(?P<kind>csv|tum)", re.IGNORECASE
)
_CALLED = "odometry.csv or .tum, scans.csv, laser.csv, truth.csv or .tum, or NAME.odometry.csv"
#: so many files that are not used are named
_MOST_TOLD = 10

Pose = tuple[float, float, float]
_T = TypeVar("_T")


class _File(NamedTuple):
    """A table: its name and text, whose it is, and what it has."""

    name: str
    text: str
    robot: str
    what: str
    kind: str


def import_csv(source: Path, target: Path) -> ImportSummary:
    """Convert the tables in ``source`` (a folder, .zip or .tar) to the MCAP file ``target``.

    Raises:
        LogError: ``source`` cannot be read, has none of the files, or two of one kind for a robot;
            a file has no usable line, or names of columns that leave one open.
        OutputError: ``target`` cannot be written.
    """
    files, others = _files(source)
    if not any(file.what == "odometry" for file in files):
        there = f"; it has {_some(others)}" if others else ""
        raise LogError(
            f"{source}: has no odometry.csv (stamp s, x m, y m, heading rad) or odometry.tum"
            f"{there}; is it a folder of tables?"
        )
    events: list[Event] = []
    mounts: dict[str, Pose] = {}
    warnings = []
    if others:
        are = "is" if len(others) == 1 else "are"
        warnings.append(f"{_some(others)} {are} not used: files are called {_CALLED}")
    for file in files:
        name = f"{source}: {file.name}"
        table = read_table(file.text, same_width=file.what != "scans")
        if file.what == "laser":
            columns = columns_of("mount", table.names, MOUNT, name)
            own_mounts, unreadable = _parsed(table, columns, _pose)
            if not own_mounts:
                raise LogError(
                    f"{name} has no usable line; it is x m, y m, heading rad of the "
                    "laser on the base; without the file the laser is at the base itself"
                )
            mounts[file.robot] = own_mounts[0]
        else:
            own, unreadable, doubts = _events(file, table, name)
            events += own
            warnings += [f"{file.name}: {doubt}" for doubt in doubts]
        if unreadable:
            warnings.append(f"{unreadable} lines of {file.name} cannot be read")
    events.sort(key=lambda event: event.stamp_ns)
    with LogWriter(target, {"format": "csv", "source": source.name}) as log:
        for robot, mount in mounts.items():
            log.mount(robot, events[0].stamp_ns, mount)
        for event in events:
            event.write(log)
    told = tuple(f"{source}: {warning}" for warning in warnings)
    return ImportSummary(source, target, log.counts, told)


def _files(source: Path) -> tuple[list[_File], list[str]]:
    """The tables in ``source`` by name, and the names of tables that are called otherwise.

    Raises:
        LogError: it cannot be read, or has two files with the same of one robot.
    """
    others: list[str] = []
    texts = text_files(source, _FILES, others)
    files: dict[tuple[str, str], _File] = {}
    for name, text in sorted(texts.items()):
        found = _FILES.fullmatch(name)
        assert found is not None  # `text_files` gives no others
        robot, what = found["robot"] or DEFAULT_ROBOT, found["what"].lower()
        file = _File(name, text, robot, what, found["kind"].lower())
        other = files.setdefault((robot, what), file)
        if other is not file:
            raise LogError(f"{source}: has both {other.name} and {name}; leave one of them")
    suffixes = (".csv", ".tum")
    tables = {name for name in others if PurePosixPath(name).suffix.lower() in suffixes}
    # archives made by macOS have a hidden file beside each
    return list(files.values()), sorted(name for name in tables if not name.startswith("."))


def _some(names: list[str]) -> str:
    """The names, or the first of very many."""
    more = len(names) - _MOST_TOLD
    return ", ".join(names[:_MOST_TOLD]) + (f" and {more} more" if more > 0 else "")


def _events(file: _File, table: Table, name: str) -> tuple[list[Event], int, list[str]]:
    """The records of a table, how many lines cannot be read, and doubts about its units.

    Raises:
        LogError: no line can be read, or its names of columns leave one open.
    """
    kind: Kind = "scans" if file.what == "scans" else "poses"
    usual = SCANS if kind == "scans" else TUM_POSES if file.kind == "tum" else POSES
    columns = columns_of(kind, table.names, usual, name)
    doubts: list[str] = []
    if kind == "scans":
        own, unreadable = _parsed(table, columns, lambda fields: _scan(file.robot, fields))
    else:
        poses, unreadable = _parsed(table, columns, _stamped_pose)
        method = LogWriter.truth if file.what == "truth" else LogWriter.odometry
        own = [Event.of(method, file.robot, stamp_ns, pose=pose) for stamp_ns, pose in poses]
        doubts = _doubts(file, columns, poses)
    if not own:
        raise LogError(
            f"{name} has no usable line; stamps are seconds, all numbers decimal, with commas only "
            "if ; or a tab is between the columns, and lines of poses have as many columns as "
            "their names"
        )
    return own, unreadable, doubts


def _parsed(
    table: Table, columns: Columns, parse: Callable[[list[str]], _T]
) -> tuple[list[_T], int]:
    """What ``parse`` makes of the columns of each line, and how many lines it cannot read."""
    made, unreadable = [], 0
    for fields in table.rows():
        try:
            if fields is None:
                raise ValueError("another number of columns")
            made.append(parse(columns.of(fields)))
        except (ValueError, IndexError):
            unreadable += 1
    return made, unreadable


def _doubts(file: _File, columns: Columns, poses: list[tuple[int, Pose]]) -> list[str]:
    """Questions about units that the names of columns do not state."""
    doubts = []
    # true poses may be a few that were surveyed
    if file.what == "odometry" and "stamp" not in columns.with_unit:
        doubts.append(csv_units.milliseconds(np.array([1e-9 * stamp_ns for stamp_ns, _ in poses])))
    if len(columns.picked) == len(POSES.picked) and "heading" not in columns.with_unit:
        rows = np.array([pose for _, pose in sorted(poses)]).reshape(-1, 3)
        doubts.append(csv_units.degrees(rows))
    return [doubt for doubt in doubts if doubt]


def _stamped_pose(fields: list[str]) -> tuple[int, Pose]:
    """Stamp ns, and the pose."""
    return parse_stamp_ns(fields[0]), _pose(fields[1:])


def _pose(fields: list[str]) -> Pose:
    """X m, y m, heading rad; or the planar part of x y m and the quaternion x y z w."""
    x, y, *rotation = map(finite, fields)
    if len(rotation) == 1:
        return x, y, rotation[0]
    qx, qy, qz, qw = rotation
    phi = math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
    return x, y, phi


def _scan(robot: str, fields: list[str]) -> Event:
    start, step = finite(fields[1]), finite(fields[2])
    with np.errstate(over="ignore"):  # what no float32 holds becomes infinite: no return
        ranges = np.array([float(r) if r else math.inf for r in fields[3:]]).astype(np.float32)
    return Event.of(
        LogWriter.scan,
        robot,
        parse_stamp_ns(fields[0]),
        ranges=ranges,
        angle_min_rad=start,
        angle_step_rad=step,
        range_max_m=MAX_RANGE_M,
    )
