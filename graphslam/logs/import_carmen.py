"""CARMEN logs (the format of the Radish and Freiburg data sets) to MCAP.

FLASER lines become LaserScan, ODOM lines Odometry, PARAM robot_frontlaser_offset the laser's
mount. The stamp is exactly the ipc time (third field from the end), because the published
relations refer to it.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from decimal import Decimal, DecimalException
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from graphslam.core.errors import LogError
from graphslam.logs.decoders import MAX_RANGE_M
from graphslam.logs.import_summary import ImportSummary
from graphslam.logs.no_return import find_no_return
from graphslam.logs.schemas import DEFAULT_ROBOT
from graphslam.logs.source_files import text_lines
from graphslam.logs.writer import LogWriter

Ranges = NDArray[np.float32]

_TRAILER = 3  # fields at the end: ipc time, host, logger time
_SCAN_TAIL = 6  # fields after the ranges: laser pose and odometry pose
_SAMPLE_EVERY = 20  # every 20th scan is searched for the no-return value


class _Odometry(NamedTuple):
    stamp_ns: int
    pose: tuple[float, float, float]


class _Scan(NamedTuple):
    stamp_ns: int
    ranges: Ranges


def import_carmen(source: Path, target: Path) -> ImportSummary:
    """Convert the CARMEN log ``source`` (plain, .gz, .bz2, .xz) to the MCAP file ``target``.

    Ranges are not changed (float32); ``range_max`` is set just below the log's no-return value, so
    that ROS tools interpret it correctly. Stamps in these files are not monotonic; the log times
    keep the order of the file.

    Raises:
        LogError: ``source`` cannot be read, or holds neither scans nor odometry.
        OutputError: ``target`` cannot be written.
    """
    malformed: Counter[str] = Counter()
    # all in memory, about 4 bytes per beam: the log times are computed from the end
    entries = list(_entries(source, malformed))
    offsets = [entry for entry in entries if isinstance(entry, float)]
    stamped = [entry for entry in entries if not isinstance(entry, float)]
    if not stamped:
        raise LogError(f"{source}: has no readable FLASER or ODOM line; is it CARMEN? Name the log")
    # log times that never decrease, so that readers keep the order of the file: a line was written
    # before all lines after it, hence not later than the earliest of their stamps
    log_times = list(accumulate((entry.stamp_ns for entry in reversed(stamped)), min))[::-1]
    scans = [entry.ranges for entry in stamped if isinstance(entry, _Scan)]
    no_return = find_no_return(scans[::_SAMPLE_EVERY])
    # without a no-return value the limit for any laser
    range_max = MAX_RANGE_M if no_return is None else float(np.nextafter(np.float32(no_return), 0))
    notes = {"format": "carmen", "source": source.name, "stamps": "ipc time, exact"}
    with LogWriter(target, notes) as log:
        log.mount(DEFAULT_ROBOT, log_times[0], (offsets[-1] if offsets else 0.0, 0.0, 0.0))
        for entry, log_time_ns in zip(stamped, log_times, strict=True):
            if isinstance(entry, _Odometry):
                log.odometry(DEFAULT_ROBOT, entry.stamp_ns, entry.pose, log_time_ns=log_time_ns)
            else:
                start, step = _beam_angles(len(entry.ranges))
                log.scan(
                    DEFAULT_ROBOT,
                    entry.stamp_ns,
                    entry.ranges,
                    angle_min_rad=start,
                    angle_step_rad=step,
                    range_max_m=range_max,
                    log_time_ns=log_time_ns,
                )
    warnings = [f"{source}: {n} {tag} lines cannot be read" for tag, n in sorted(malformed.items())]
    return ImportSummary(source, target, log.counts, tuple(warnings))


def parse_stamp_ns(text: str) -> int:
    """Nanoseconds of decimal seconds, exact to the ninth decimal, never through a float.

    Raises:
        ValueError: not a decimal number, or too large for the 32-bit seconds of a ROS stamp.
    """
    try:
        seconds = Decimal(text)
        if not 0 <= seconds < 2**31:
            raise ValueError(f"{text!r} is not a time")
        return int(seconds.scaleb(9).to_integral_value())
    except DecimalException as error:
        raise ValueError(f"{text!r} is not a time") from error


def _beam_angles(beams: int) -> tuple[float, float]:
    """First angle and step, rad, of a laser with a field of view of 180 degrees ahead.

    CARMEN's convention: the first beam points to -90 degrees. An odd number of beams includes
    +90 degrees (181 at 1, 361 at 0.5), an even number stops one step short of it (180 at 1).
    """
    return -np.pi / 2, np.pi / (beams - beams % 2) if beams > 1 else np.pi


def _entries(source: Path, malformed: Counter[str]) -> Iterator[_Odometry | _Scan | float]:
    """The parsed lines of a log in the order of the file; malformed lines are counted by tag.

    A number is the distance, m, of the laser ahead of the base.
    """
    for line in text_lines(source):
        fields = line.split()
        if not fields or fields[0] not in _PARSERS:
            continue
        try:
            entry = _PARSERS[fields[0]](fields)
        except (ValueError, IndexError):
            malformed[fields[0]] += 1
            continue
        if entry is not None:
            yield entry


def _odometry(fields: list[str]) -> _Odometry:
    """ODOM x y theta tv rv accel ipc_timestamp ipc_hostname logger_timestamp."""
    if len(fields) < 4 + _TRAILER:
        raise ValueError("too few fields")
    x, y, theta = map(float, fields[1:4])
    return _Odometry(parse_stamp_ns(fields[-_TRAILER]), (x, y, theta))


def _scan(fields: list[str]) -> _Scan:
    """FLASER n r1..rn x y theta odom_x odom_y odom_theta ipc_timestamp host logger_timestamp."""
    beams = int(fields[1])
    if len(fields) != 2 + beams + _SCAN_TAIL + _TRAILER:
        raise ValueError("the number of ranges differs from the count in the line")
    ranges = np.array([float(field) for field in fields[2 : 2 + beams]], dtype=np.float32)
    return _Scan(parse_stamp_ns(fields[-_TRAILER]), ranges)


def _parameter(fields: list[str]) -> float | None:
    """PARAM name value ipc_timestamp host logger_timestamp."""
    return float(fields[2]) if fields[1] == "robot_frontlaser_offset" else None


_PARSERS: dict[str, Callable[[list[str]], _Odometry | _Scan | float | None]] = {
    "ODOM": _odometry,
    "FLASER": _scan,
    "PARAM": _parameter,
}
