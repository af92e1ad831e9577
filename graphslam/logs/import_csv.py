"""Tables of numbers to MCAP: odometry as CSV or TUM, scans as CSV.

A folder or archive with, per robot:

- ``odometry.csv``: stamp s, x m, y m, heading rad; or ``odometry.tum``: stamp s, x y z m, and the
  quaternion x y z w.
- ``scans.csv``: stamp s, first angle rad, step rad, then the ranges m; a range that is empty, nan,
  inf or not positive is no return.
- ``laser.csv``: x m, y m, heading rad of the laser on the base; without it the base itself.
- ``truth.csv`` or ``truth.tum``: true poses, as odometry.

Files of several robots are called ``NAME.odometry.csv``. Columns of a file are separated by
semicolons, and then decimal commas may be used, else by commas, else by blanks; lines of poses have
as many columns as each other. Lines that begin with ``#`` and a first line of names are left out.
"""

import math
import re
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from graphslam.core.errors import LogError
from graphslam.logs.import_carmen import finite, parse_stamp_ns
from graphslam.logs.import_summary import ImportSummary
from graphslam.logs.physical_limits import MAX_RANGE_M
from graphslam.logs.schemas import DEFAULT_ROBOT
from graphslam.logs.source_files import text_files
from graphslam.logs.writer import Event, LogWriter

_FILES = re.compile(r"(?:(?P<robot>.+)\.)?(?P<what>odometry|scans|laser|truth)\.(?P<kind>csv|tum)")
#: characters with which a number begins
_NUMERIC = frozenset("0123456789+-.")

Pose = tuple[float, float, float]
_T = TypeVar("_T")


def import_csv(source: Path, target: Path) -> ImportSummary:
    """Convert the tables in ``source`` (a folder, .zip or .tar) to the MCAP file ``target``.

    Raises:
        LogError: ``source`` cannot be read, has none of the files, or a file has no usable line.
        OutputError: ``target`` cannot be written.
    """
    texts = text_files(source, _FILES)
    if not any("odometry" in name for name in texts):
        raise LogError(
            f"{source}: has no odometry.csv (stamp s, x m, y m, heading rad) or odometry.tum; "
            "is it a folder of tables?"
        )
    events: list[Event] = []
    mounts: dict[str, Pose] = {}
    warnings = []
    for name, text in sorted(texts.items()):
        found = _FILES.fullmatch(name)
        assert found is not None  # `text_files` gives no others
        robot = found["robot"] or DEFAULT_ROBOT
        if found["what"] == "laser":
            own_mounts, unreadable = _parsed(text, _numbers, same_width=True)
            if not own_mounts:
                raise LogError(
                    f"{source}: {name} has no usable line; it is x m, y m, heading rad of the "
                    "laser on the base; without the file the laser is at the base itself"
                )
            mounts[robot] = own_mounts[0]
        else:
            parse = _event(found["what"], found["kind"], robot)
            own, unreadable = _parsed(text, parse, same_width=found["what"] != "scans")
            if not own:
                raise LogError(
                    f"{source}: {name} has no usable line; stamps are seconds, all numbers "
                    "decimal, with commas only if ; is between the columns, and lines of poses "
                    "have as many columns as their names"
                )
            events += own
        if unreadable:
            warnings.append(f"{source}: {unreadable} lines of {name} cannot be read")
    events.sort(key=lambda event: event.stamp_ns)
    with LogWriter(target, {"format": "csv", "source": source.name}) as log:
        for robot, mount in mounts.items():
            log.mount(robot, events[0].stamp_ns, mount)
        for event in events:
            event.write(log)
    return ImportSummary(source, target, log.counts, tuple(warnings))


def _parsed(
    text: str, parse: Callable[[list[str]], _T], *, same_width: bool
) -> tuple[list[_T], int]:
    """What ``parse`` makes of each line, and how many lines it cannot read.

    A first line of names is none of these. With ``same_width`` lines that have not as many columns
    as the names, or as most, cannot be read: a comma in them may be a decimal one.
    """
    lines = [line.strip() for line in text.removeprefix("\ufeff").splitlines()]
    lines = [line for line in lines if line and not line.startswith("#")]
    separator = _separator(lines)
    width = _width(lines, separator) if same_width else None
    made, unreadable = [], 0
    for number, line in enumerate(lines):
        fields = _fields(line, separator)
        try:
            if width not in (None, len(fields)):
                raise ValueError("another number of columns")
            made.append(parse(fields))
        except (ValueError, IndexError):
            unreadable += number > 0 or _is_numeric(line)
    return made, unreadable


def _separator(lines: Sequence[str]) -> str | None:
    """What is between the columns of most lines of numbers; None: blanks."""
    numeric = [line for line in lines if _is_numeric(line)]
    for separator in (";", ","):
        if 2 * sum(separator in line for line in numeric) > len(numeric):
            return separator
    return None


def _fields(line: str, separator: str | None) -> list[str]:
    """The columns of a line; next to semicolons a comma is that of a decimal number."""
    if separator == ";":
        line = line.replace(",", ".")
    return [field.strip() for field in line.split(separator)]


def _width(lines: Sequence[str], separator: str | None) -> int:
    """How many columns the lines have: as many as names, where these are separated like numbers."""
    if lines and not _is_numeric(lines[0]) and separator is not None and separator in lines[0]:
        return len(_fields(lines[0], separator))
    widths = Counter(len(_fields(line, separator)) for line in lines if _is_numeric(line))
    return widths.most_common(1)[0][0] if widths else 0


def _is_numeric(line: str) -> bool:
    return line[0] in _NUMERIC


def _event(what: str, kind: str, robot: str) -> Callable[[list[str]], Event]:
    """What makes an event of the fields of a line."""
    if what == "scans":
        return partial(_scan, robot)
    method = LogWriter.truth if what == "truth" else LogWriter.odometry
    return partial(_pose_event, method, robot, _tum_pose if kind == "tum" else _numbers)


def _pose_event(
    method: Callable[..., None],
    robot: str,
    pose_of: Callable[[list[str]], Pose],
    fields: list[str],
) -> Event:
    stamp_ns = parse_stamp_ns(fields[0])
    return Event.of(method, robot, stamp_ns, pose=pose_of(fields[1:]))


def _numbers(fields: list[str]) -> Pose:
    """X m, y m, heading rad; more columns are left out."""
    x, y, phi = map(finite, fields[:3])
    return x, y, phi


def _tum_pose(fields: list[str]) -> Pose:
    """The planar part of x y z m and the quaternion x y z w."""
    x, y, _, qx, qy, qz, qw = map(finite, fields[:7])
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
