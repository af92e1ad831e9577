"""CARMEN logs (the format of the Radish and Freiburg data sets) to MCAP.

Lines of lasers become LaserScan, ODOM lines Odometry; where there are none, the robot's pose in the
lines of lasers does. The stamp is exactly the ipc time (third field from the end), because the
published relations refer to it.

Source: https://carmen.sourceforge.net/logger_playback.html
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from decimal import Decimal, DecimalException
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from graphslam.core.errors import LogError
from graphslam.core.geometry import between, wrap
from graphslam.importers.import_summary import ImportSummary
from graphslam.logs.no_return import find_no_return
from graphslam.logs.physical_limits import MAX_RANGE_M
from graphslam.logs.schemas import DEFAULT_ROBOT
from graphslam.logs.source_files import text_lines
from graphslam.logs.time_order import recording_times
from graphslam.logs.writer import LogWriter

Ranges = NDArray[np.float32]
_Pose = tuple[float, float, float]

_TRAILER = 3  # fields at the end: ipc time, host, logger time
_SAMPLE_EVERY = 20  # every 20th scan is searched for the no-return value
#: with so many lines of lasers of which none can be read a log is of another format
_MANY_LINES = 10
#: m and rad within which the pose of a laser on the robot must stay to be its mount
_MOUNT_SPREAD = 1e-3
#: lasers by the number in the names of their lines: frame, usual heading on the robot
_LASERS = {1: ("laser", 0.0), 2: ("rear_laser", np.pi), 3: ("laser3", 0.0), 4: ("laser4", 0.0)}


class _Odometry(NamedTuple):
    stamp_ns: int
    pose: _Pose


class _Truth(NamedTuple):
    stamp_ns: int
    pose: _Pose


class _Scan(NamedTuple):
    """A scan; ``angles``: first angle and step, rad.

    Poses of the laser and the robot are in the frame of the odometry, None if the line has none.
    """

    stamp_ns: int
    tag: str
    laser: int
    ranges: Ranges
    angles: tuple[float, float]
    laser_pose: _Pose | None = None
    robot_pose: _Pose | None = None


class _Offset(NamedTuple):
    """Distance of a laser ahead of the base, m."""

    laser: int
    ahead_m: float


_Entry = _Odometry | _Truth | _Scan | _Offset


def import_carmen(source: Path, target: Path) -> ImportSummary:
    """Convert the CARMEN log ``source`` (plain, .gz, .bz2, .xz) to the MCAP file ``target``.

    Ranges are not changed (float32); ``range_max`` is set just below the log's no-return value, so
    that ROS tools interpret it correctly. Stamps in these files are not monotonic; the log times
    keep the order of the file.

    Raises:
        LogError: ``source`` cannot be read, holds neither scans nor odometry, or many lines of
            lasers of which none can be read.
        OutputError: ``target`` cannot be written.
    """
    malformed: Counter[str] = Counter()
    # all in memory, about 4 bytes per beam: the log times are computed from the end
    entries = list(_entries(source, malformed))
    offsets = {entry.laser: entry.ahead_m for entry in entries if isinstance(entry, _Offset)}
    stamped = [entry for entry in entries if not isinstance(entry, _Offset)]
    if not stamped:
        raise LogError(
            f"{source}: has no readable line of a laser (FLASER, ROBOTLASER1) or ODOM line; is it "
            "CARMEN? Name the log"
        )
    unreadable = sum(count for tag, count in malformed.items() if tag in _SCANS)
    if unreadable >= _MANY_LINES and not any(isinstance(entry, _Scan) for entry in stamped):
        raise LogError(
            f"{source}: none of its {unreadable} lines of lasers can be read; they must have as "
            "many ranges as they state, and end with ipc time, host and logger time"
        )
    stamped, notes = _once(stamped)
    log_times = recording_times([entry.stamp_ns for entry in stamped])
    scans = [entry for entry in stamped if isinstance(entry, _Scan)]
    in_scans = not any(isinstance(entry, _Odometry) for entry in stamped)
    if in_scans and any(scan.robot_pose for scan in scans):
        notes.append("has no ODOM lines; the odometry is that in the lines of the laser")
    lasers = sorted({scan.laser for scan in scans})
    own = {laser: [scan for scan in scans if scan.laser == laser] for laser in lasers}
    limits = {laser: _range_max(own[laser]) for laser in lasers}
    told = {"format": "carmen", "source": source.name, "stamps": "ipc time, exact"}
    with LogWriter(target, told) as log:
        for laser in lasers or [1]:
            mount = _mount(laser, offsets.get(laser), own.get(laser, []))
            log.mount(DEFAULT_ROBOT, log_times[0], mount, _LASERS[laser][0])
        latest_ns = -1
        for entry, log_time_ns in zip(stamped, log_times, strict=True):
            stamp_ns = entry.stamp_ns
            if isinstance(entry, _Odometry):
                log.odometry(DEFAULT_ROBOT, stamp_ns, entry.pose, log_time_ns=log_time_ns)
            elif isinstance(entry, _Truth):
                log.truth(DEFAULT_ROBOT, stamp_ns, entry.pose, log_time_ns=log_time_ns)
            else:
                if in_scans and entry.robot_pose and stamp_ns != latest_ns:
                    latest_ns = stamp_ns  # two lasers may have one stamp
                    log.odometry(DEFAULT_ROBOT, stamp_ns, entry.robot_pose, log_time_ns=log_time_ns)
                log.scan(
                    DEFAULT_ROBOT,
                    stamp_ns,
                    entry.ranges,
                    angle_min_rad=entry.angles[0],
                    angle_step_rad=entry.angles[1],
                    range_max_m=limits[entry.laser],
                    sensor=_LASERS[entry.laser][0],
                    log_time_ns=log_time_ns,
                )
    notes += [f"{n} {tag} lines cannot be read" for tag, n in sorted(malformed.items())]
    return ImportSummary(source, target, log.counts, tuple(f"{source}: {note}" for note in notes))


def _once(
    entries: Sequence[_Odometry | _Truth | _Scan],
) -> tuple[list[_Odometry | _Truth | _Scan], list[str]]:
    """The entries with every laser once, and notes on what was left out.

    CARMEN logs the scans of a laser by up to three names: with the robot's pose, as they came from
    the laser, and with remissions. The first of `_SCANS` that is there is used.
    """
    counts = Counter((e.laser, e.tag) for e in entries if isinstance(e, _Scan))
    order = list(_SCANS)
    used: dict[int, str] = {}
    for laser, tag in sorted(counts, key=lambda kind: order.index(kind[1])):
        used.setdefault(laser, tag)
    notes = [
        f"{count} {tag} lines are not used: {used[laser]} has this laser"
        for (laser, tag), count in sorted(counts.items())
        if used[laser] != tag
    ]
    kept = [e for e in entries if not isinstance(e, _Scan) or used[e.laser] == e.tag]
    return kept, notes


def _range_max(scans: Sequence[_Scan]) -> float:
    """Just below the no-return value, m; without one the limit for any laser."""
    no_return = find_no_return([scan.ranges for scan in scans][::_SAMPLE_EVERY])
    return MAX_RANGE_M if no_return is None else float(np.nextafter(np.float32(no_return), 0))


def _mount(laser: int, ahead_m: float | None, scans: Sequence[_Scan]) -> _Pose:
    """Pose of a laser on the robot: as a PARAM says, else as the poses in its lines say."""
    heading = _LASERS[laser][1]
    if ahead_m is not None:
        return ahead_m, 0.0, heading
    poses = [(scan.robot_pose, scan.laser_pose) for scan in scans if scan.robot_pose]
    if poses:
        robot, own = np.array(poses).transpose(1, 0, 2)
        relative = between(robot, own)
        # headings from the first one: those of a laser that looks back are on both sides of pi
        relative[:, 2] = relative[0, 2] + wrap(relative[:, 2] - relative[0, 2])
        middle = np.median(relative, axis=0)
        # poses of the laser that were corrected by a SLAM program do not stay on the robot
        if (np.abs(between(middle, relative)) <= _MOUNT_SPREAD).all():
            x, y, phi = (float(value) + 0.0 for value in middle.round(6))
            return x, y, phi
    return 0.0, 0.0, heading


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


def _entries(source: Path, malformed: Counter[str]) -> Iterator[_Entry]:
    """The parsed lines of a log in the order of the file; malformed lines are counted by tag."""
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


def _pose(fields: Sequence[str]) -> _Pose:
    x, y, theta = map(finite, fields)
    return x, y, theta


def finite(text: str) -> float:
    """A number.

    Raises:
        ValueError: it is not finite, or no number.
    """
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text!r} is not finite")
    return value


def _ranges(fields: Sequence[str]) -> Ranges:
    with np.errstate(over="ignore"):  # what no float32 holds becomes infinite: no return
        return np.array([float(field) for field in fields], dtype=np.float32)


def _odometry(fields: list[str]) -> _Odometry:
    """ODOM x y theta tv rv accel ipc_timestamp ipc_hostname logger_timestamp."""
    if len(fields) < 4 + _TRAILER:
        raise ValueError("too few fields")
    return _Odometry(parse_stamp_ns(fields[-_TRAILER]), _pose(fields[1:4]))


def _truth(fields: list[str]) -> _Truth:
    """TRUEPOS true_x true_y true_theta odom_x odom_y odom_theta, and the end of all lines."""
    if len(fields) < 7 + _TRAILER:
        raise ValueError("too few fields")
    return _Truth(parse_stamp_ns(fields[-_TRAILER]), _pose(fields[1:4]))


def _scan(laser: int, fields: list[str]) -> _Scan:
    """FLASER n r1..rn x y theta odom_x odom_y odom_theta ipc_timestamp host logger_timestamp."""
    beams = int(fields[1])
    after = fields[2 + beams : -_TRAILER]
    if len(after) != 6 or beams < 0:
        raise ValueError("the number of ranges differs from the count in the line")
    ranges = _ranges(fields[2 : 2 + beams])
    stamp_ns, angles = parse_stamp_ns(fields[-_TRAILER]), _beam_angles(beams)
    poses = _pose(after[:3]), _pose(after[3:])
    return _Scan(stamp_ns, fields[0], laser, ranges, angles, *poses)


def _with_remissions(laser: int, fields: list[str]) -> _Scan:
    """REMISSIONFLASER n r1 remission1 .. rn remissionn, and the end of all lines."""
    beams = int(fields[1])
    if len(fields) != 2 + 2 * beams + _TRAILER or beams < 0:
        raise ValueError("the number of ranges differs from the count in the line")
    ranges = _ranges(fields[2 : 2 + 2 * beams : 2])
    stamp_ns = parse_stamp_ns(fields[-_TRAILER])
    return _Scan(stamp_ns, fields[0], laser, ranges, _beam_angles(beams))


def _new_scan(laser: int, fields: list[str]) -> _Scan:
    """ROBOTLASER1 and RAWLASER1.

    laser_type start_angle field_of_view angular_resolution maximum_range accuracy remission_mode
    n r1..rn m remission1..remissionm; ROBOTLASER1 goes on with the poses of laser and robot (3 + 3)
    and four or five numbers. Old logs have no m.
    """
    start, step, beams = finite(fields[2]), finite(fields[4]), int(fields[8])
    ranges, rest = fields[9 : 9 + beams], fields[9 + beams : -_TRAILER]
    if len(ranges) != beams:
        raise ValueError("the number of ranges differs from the count in the line")
    lengths = (10, 11) if fields[0].startswith("ROBOT") else (0,)
    if rest and rest[0].isdigit() and len(rest) - 1 - int(rest[0]) in lengths:
        rest = rest[1 + int(rest[0]) :]
    if len(rest) not in lengths:
        raise ValueError("the number of remissions differs from the count in the line")
    poses = (_pose(rest[:3]), _pose(rest[3:6])) if rest else (None, None)
    stamp_ns, own = parse_stamp_ns(fields[-_TRAILER]), _ranges(ranges)
    return _Scan(stamp_ns, fields[0], laser, own, (start, step), *poses)


def _parameter(fields: list[str]) -> _Offset | None:
    """PARAM name value ipc_timestamp host logger_timestamp."""
    laser = {"robot_frontlaser_offset": 1, "robot_rearlaser_offset": 2}.get(fields[1])
    return None if laser is None else _Offset(laser, finite(fields[2]))


#: lines of lasers; of several for one laser the first is used: those that have the robot's pose
_SCANS: dict[str, Callable[[list[str]], _Scan]] = {
    **{f"ROBOTLASER{n}": partial(_new_scan, n) for n in _LASERS},
    "FLASER": partial(_scan, 1),
    "RLASER": partial(_scan, 2),
    **{f"RAWLASER{n}": partial(_new_scan, n) for n in _LASERS},
    "REMISSIONFLASER": partial(_with_remissions, 1),
    "REMISSIONRLASER": partial(_with_remissions, 2),
}
_PARSERS: dict[str, Callable[[list[str]], _Entry | None]] = {
    "ODOM": _odometry,
    "TRUEPOS": _truth,
    "PARAM": _parameter,
    **_SCANS,
}
