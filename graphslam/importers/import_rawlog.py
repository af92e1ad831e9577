"""Rawlogs of MRPT (`.rawlog`) to MCAP: lasers, odometry and gyroscope of one robot.

CObservation2DRangeScan becomes LaserScan with its mount in tf_static, CObservationOdometry
Odometry; where there is none, the motions of CActionRobotMovement2D are added up. The rates of
CObservationIMU become Imu. Everything else is counted.
"""

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from graphslam.core.errors import LogError
from graphslam.core.geometry import Array, compose
from graphslam.importers.import_summary import ImportSummary
from graphslam.importers.mrpt_objects import SkippedObjects
from graphslam.importers.mrpt_rawlog import (
    Item,
    LaserScan,
    RawlogMotion,
    Reading,
    TurnRate,
    read_rawlog,
)
from graphslam.logs import schemas
from graphslam.logs.cdr_writing import imu_bytes, tf_bytes
from graphslam.logs.physical_limits import MAX_RANGE_M
from graphslam.logs.schemas import DEFAULT_ROBOT
from graphslam.logs.source_files import MOST_BYTES
from graphslam.logs.time_order import recording_times
from graphslam.logs.writer import LogWriter, frame

#: decimals of poses that are sums of motions: what is behind them is rounding
_SUM_DECIMALS = 12
#: decimals of a mount, m and parts of a rotation, by which lasers are told apart
_MOUNT_DECIMALS = 4
#: mounts that lasers of one label may have: with more it is one that moves on the robot
_MOST_MOUNTS = 4
#: kinds of problems that are listed
_MOST_NOTES = 20

_Message = Reading | LaserScan | TurnRate
_Key = tuple[str, bytes]  # label and mount of a laser


class _Laser(NamedTuple):
    """A laser's frame, its mount (4, 4) and its largest range."""

    name: str
    mount: Array
    range_max_m: float


def import_rawlog(source: Path, target: Path) -> ImportSummary:
    """Convert the rawlog ``source``, packed with gzip or not, to the MCAP file ``target``.

    Log times keep the order of the file. Of one that is cut off or damaged what can be read is
    used.

    Raises:
        LogError: ``source`` cannot be read, is no rawlog, or has nothing that is used.
        OutputError: ``target`` cannot be written.
    """
    findings, notes = SkippedObjects(), list[str]()
    # all in memory, about 4 bytes per beam: lasers and log times are known at the end
    items = list(_bounded(source, read_rawlog(source, findings)))
    messages = list(_with_odometry(items, notes))
    for kind in (Reading, TurnRate):
        messages = _of_one_sensor(messages, kind, notes)
    lasers = _lasers([m for m in messages if isinstance(m, LaserScan)], notes)
    messages = [m for m in messages if not isinstance(m, LaserScan) or _key(m) in lasers]
    timed = [(m, m.stamp_ns) for m in messages if m.stamp_ns is not None]
    if len(timed) < len(messages):
        notes.append(f"{len(messages) - len(timed)} observations have no time, and are left out")
    notes += _problems(findings)
    if not any(isinstance(message, LaserScan | Reading) for message, _ in timed):
        raise LogError(
            f"{source}: has no scan and no odometry that can be read "
            f"({'; '.join(notes) or 'it is empty'}); is it a rawlog of a robot with a laser?"
        )
    log_times = recording_times([stamp_ns for _, stamp_ns in timed])
    told = {"format": "rawlog", "source": source.name, "stamps": "those of the file, to 100 ns"}
    with LogWriter(target, told) as log:
        if lasers:
            mounts = tf_bytes([_transform(log_times[0], laser) for laser in lasers.values()])
            log.encoded("/tf_static", schemas.TF_MESSAGE, mounts, log_times[0])
        for (message, stamp_ns), log_time_ns in zip(timed, log_times, strict=True):
            if isinstance(message, Reading):
                log.odometry(DEFAULT_ROBOT, stamp_ns, message.pose, log_time_ns=log_time_ns)
            elif isinstance(message, TurnRate):
                data = imu_bytes(stamp_ns, frame(DEFAULT_ROBOT, "base_link"), message.rad_s)
                log.encoded("/imu", schemas.IMU, data, log_time_ns)
            else:
                _write_scan(log, message, lasers[_key(message)], (stamp_ns, log_time_ns))
    return ImportSummary(source, target, log.counts, tuple(f"{source}: {note}" for note in notes))


def _bounded(source: Path, items: Iterable[Item]) -> Iterator[Item]:
    """The items, as long as their ranges are not more than a log can have."""
    held = 0
    for item in items:
        if isinstance(item, LaserScan):
            held += item.ranges.nbytes
            if held > MOST_BYTES:
                raise LogError(f"{source}: holds more than 2 GB of ranges; is it a log?")
        yield item


def _problems(findings: SkippedObjects) -> list[str]:
    """What was not read, most first."""
    found = [(n, f"{n} {name} are not used") for name, n in findings.skipped.items()]
    found += [(n, f"{n} left out: {why}") for why, n in findings.damaged.items()]
    notes = [text for _, text in sorted(found, reverse=True)]
    if len(notes) > _MOST_NOTES:
        notes[_MOST_NOTES:] = [f"{len(notes) - _MOST_NOTES} more kinds of objects are not used"]
    if findings.damage:
        notes.append(f"damaged: {findings.damage}; what is before is used")
    return notes


# ---------------------------------------------------------------- odometry


def _with_odometry(items: Sequence[Item], notes: list[str]) -> Iterator[_Message]:
    """Items with the motions added up to readings, if there are no others.

    A motion ends at its own time; older ones state none and end at the first observation behind.
    """
    motions: dict[int, RawlogMotion] = {}
    for item in items:
        # several motions in one collection are one: that of odometry, or the first
        if isinstance(item, RawlogMotion) and (
            motions.setdefault(item.group, item).matched and not item.matched
        ):
            motions[item.group] = item
    if motions and any(isinstance(item, Reading) for item in items):
        notes.append(f"{len(motions)} actions are not used: observations have the odometry")
        motions = {}
    pose, open_ended = np.zeros(3), 0
    for item in items:
        if not isinstance(item, RawlogMotion):
            if open_ended and item.stamp_ns is not None:
                yield Reading(item.stamp_ns, "", _plain(pose))
                open_ended = 0
            yield item
        elif motions.get(item.group) is item:
            pose, open_ended = compose(pose, np.array(item.delta)), open_ended + 1
            if item.stamp_ns is not None:
                yield Reading(item.stamp_ns, "", _plain(pose))
                open_ended = 0
    if open_ended:
        notes.append(f"{open_ended} actions have no time, nor has an observation behind them")


def _plain(pose: Array) -> tuple[float, float, float]:
    x, y, phi = pose.round(_SUM_DECIMALS).tolist()
    return x, y, phi


def _of_one_sensor(
    messages: list[_Message], kind: type[Reading | TurnRate], notes: list[str]
) -> list[_Message]:
    """All messages but those of a kind that are not of the label with most of that kind."""
    counts = Counter(m.label for m in messages if isinstance(m, kind))
    for label, count in counts.most_common()[1:]:
        notes.append(f"{count} observations of {label!r} are not used: another sensor has more")
    used = counts.most_common(1)
    return [m for m in messages if not isinstance(m, kind) or m.label == used[0][0]]


# ---------------------------------------------------------------- lasers


def _key(scan: LaserScan) -> _Key:
    return scan.label, (scan.mount.round(_MOUNT_DECIMALS) + 0.0).tobytes()


def _lasers(scans: Sequence[LaserScan], notes: list[str]) -> dict[_Key, _Laser]:
    """The lasers, by label and mount, that with most scans first; notes on those that move."""
    own: dict[_Key, list[LaserScan]] = defaultdict(list)
    for scan in scans:
        own[_key(scan)].append(scan)
    mounts = Counter(label for label, _ in own)
    moving = {label: n for label, n in mounts.items() if n > _MOST_MOUNTS}
    for label, count in moving.items():
        number = sum(len(found) for key, found in own.items() if key[0] == label)
        notes.append(
            f"{number} scans of {label!r} are not used: it has {count} poses on the robot; "
            "only a laser that is fixed is read"
        )
    fixed = [key for key in own if key[0] not in moving]
    lasers: dict[_Key, _Laser] = {}
    for key in sorted(fixed, key=lambda key: -len(own[key])):
        name = _frame(key[0], {laser.name for laser in lasers.values()})
        lasers[key] = _Laser(name, own[key][0].mount, _range_max(own[key]))
    return lasers


def _frame(label: str, taken: set[str]) -> str:
    """`laser` for the first; of others the label, with a number where it is taken."""
    if not taken:
        return "laser"
    name = re.sub(r"\W+", "_", label, flags=re.ASCII).strip("_")[:50] or "laser"
    numbered = (name, *(f"{name}_{k}" for k in range(2, len(taken) + 3)))
    return next(one for one in numbered if one not in taken)


def _range_max(scans: Iterable[LaserScan]) -> float:
    """The stated limit, m, or the largest range that is marked as valid: some state too little."""
    found = 0.0
    for scan in scans:
        valid = scan.ranges[np.isfinite(scan.ranges)]
        found = max(found, scan.range_max_m, float(valid.max(initial=0.0)))
    return found if 0 < found <= MAX_RANGE_M else MAX_RANGE_M


def _transform(stamp_ns: int, laser: _Laser) -> tuple[int, str, str, Sequence[float]]:
    base, own = frame(DEFAULT_ROBOT, "base_link"), frame(DEFAULT_ROBOT, laser.name)
    return stamp_ns, base, own, (*laser.mount[:3, 3], *_quaternion(laser.mount[:3, :3]))


def _quaternion(R: Array) -> list[float]:
    """The quaternion x y z w of a rotation (3, 3): the eigenvector by Bar-Itzhack (2000).

    Source: DOI 10.2514/2.4654.
    """
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    K = np.array(
        [
            [a - e - i, b + d, c + g, h - f],
            [b + d, e - a - i, f + h, c - g],
            [c + g, f + h, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    found: list[float] = np.linalg.eigh(K)[1][:, -1].tolist()
    return found


def _write_scan(log: LogWriter, scan: LaserScan, laser: _Laser, times: tuple[int, int]) -> None:
    gaps = max(len(scan.ranges) - 1, 1)
    log.scan(
        DEFAULT_ROBOT,
        times[0],
        scan.ranges,
        angle_min_rad=-scan.view_rad / 2,
        angle_step_rad=scan.view_rad / gaps,
        range_max_m=laser.range_max_m,
        beam_period_s=scan.sweep_s / gaps,
        sensor=laser.name,
        log_time_ns=times[1],
    )
