"""What a rawlog of MRPT holds: motions and sensory frames in turn, or observations alone.

One row of `_CLASSES` per class that is read, with the versions of its layout; all others are
counted. A frame and a collection of actions are read as what they hold, in the order of the file.

Source: https://www.mrpt.org/Rawlog_Format, and the bytes that MRPT 2.5.8 writes and reads.
"""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from graphslam.core.errors import LogError
from graphslam.core.geometry import Array
from graphslam.importers.mrpt_objects import ObjectReader, SkippedObjects, UnreadableError
from graphslam.logs.physical_limits import MAX_POSITION_M
from graphslam.logs.source_files import unreadable

Pose = tuple[float, float, float]

#: 100 ns from the year 1601, from which stamps count, to 1970
_EPOCH = 116_444_736_000_000_000
_LATEST_NS = (1 << 31) * 1_000_000_000
_LONGEST_SWEEP_S = 10.0
_MOST_BEAMS, _MOST_NUMBERS = 1_000_000, 64
#: where the measurements of a CObservationIMU have the rates about its axes x, y and z
_RATES = (5, 4, 3)
_IMU_NUMBERS = 31  # of version 4, which does not state it


class Reading(NamedTuple):
    """The base in the frame of the odometry."""

    stamp_ns: int | None
    label: str
    pose: Pose


class RawlogMotion(NamedTuple):
    """The base relative to where it was before the motion.

    ``group``: number of its collection, whose motions are one. ``matched``: not by odometry.
    """

    stamp_ns: int | None
    group: int
    delta: Pose
    matched: bool


class LaserScan(NamedTuple):
    """Ranges (n,) m, inf without a return, over ``view_rad``, negative for a clockwise laser.

    ``mount`` (4, 4): the laser in the frame of the base. ``sweep_s``: from first to last beam.
    """

    stamp_ns: int | None
    label: str
    mount: Array
    view_rad: float
    range_max_m: float
    ranges: NDArray[np.float32]
    sweep_s: float


class TurnRate(NamedTuple):
    """Rate of turning about the base's vertical axis."""

    stamp_ns: int | None
    label: str
    rad_s: float


Item = Reading | RawlogMotion | LaserScan | TurnRate


def read_rawlog(source: Path, findings: SkippedObjects) -> Iterator[Item]:
    """The items of the file ``source`` in its order; what is not among them: ``findings``.

    Raises:
        LogError: it cannot be read, or is no rawlog.
    """
    try:
        with source.open("rb") as stream:
            yield from _items(source, ObjectReader(source, stream, findings), findings)
    except OSError as error:
        if source.is_dir():
            raise LogError(f"{source}: is a directory; name the log in it") from error
        raise unreadable(source, error) from error


def _items(source: Path, data: ObjectReader, findings: SkippedObjects) -> Iterator[Item]:
    group, known = 0, False
    there = data.begin()
    while there:
        name = ""
        try:
            name, version = data.head()
            known = True
            group += name in _HOLDERS  # of whichever of them is whole
            if name in _HOLDERS and version < len(_HOLDERS[name]):
                data.take(_HOLDERS[name][version])
            elif name not in _CLASSES:
                findings.skipped[name] += 1
                there = data.search()
                continue
            else:
                read, versions = _CLASSES[name]
                if version not in versions:
                    raise UnreadableError(f"of version {version}")
                item = read(data, version)
                data.end()
                yield item._replace(group=group) if isinstance(item, RawlogMotion) else item
            there = data.begin()
        except UnreadableError as error:
            if not known:
                raise LogError(f"{source}: {error}; is it a rawlog of MRPT?") from error
            findings.damaged[f"{name or 'part'} {error}"] += 1
            there = data.search()


# ---------------------------------------------------------------- fields


def _stamp(data: ObjectReader) -> int | None:
    """Time in ns since 1970; None where none is stated."""
    stamp_ns: int = (data.unpack("Q")[0] - _EPOCH) * 100
    return stamp_ns if 0 <= stamp_ns < _LATEST_NS else None


def _finite(*values: float) -> None:
    if not all(math.isfinite(value) and abs(value) < MAX_POSITION_M for value in values):
        raise UnreadableError("has numbers that cannot be")


def _version(data: ObjectReader, expected: str) -> int:
    """Version of the object that begins here."""
    name, version = data.head()
    if name != expected:
        raise UnreadableError(f"has a {name} where a {expected} should be")
    return version


def _pose2(data: ObjectReader) -> Pose:
    """CPose2D."""
    version = _version(data, "CPose2D")
    x, y, phi = data.unpack("3d" if version else "3f")
    _finite(x, y, phi)
    data.end()
    return x, y, phi


def _pose3(data: ObjectReader) -> Array:
    """CPose3D as a matrix (4, 4)."""
    version = _version(data, "CPose3D")
    found = np.eye(4)
    if version < 2:
        found = _matrix(data, (4, 4))
    elif version == 2:
        *position, w, x, y, z = data.unpack("7d")
        found[:3, 3] = position
        found[:3, :3] = _rotation(np.array([w, x, y, z]))
    else:
        numbers = data.unpack("12d")
        found[:3, 3], found[:3, :3] = numbers[:3], np.reshape(numbers[3:], (3, 3))
    _finite(*found.ravel())
    if not np.allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-3):
        raise UnreadableError("has a rotation that is none")
    data.end()
    return found


def _rotation(q: Array) -> Array:
    """Matrix (3, 3) of a quaternion w x y z."""
    norm = math.hypot(*q)
    if not 0.5 < norm < 2:  # of NaN too
        raise UnreadableError("has a rotation that is none")
    w, x, y, z = q / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _matrix(data: ObjectReader, shape: tuple[int, int] | None = None) -> Array:
    """CMatrix, CMatrixF, or CMatrixD."""
    name, _ = data.head()
    rows, columns = data.unpack("2I")
    if rows * columns > _MOST_NUMBERS or shape not in (None, (rows, columns)):
        raise UnreadableError("has a matrix of another size")
    kind = "d" if name == "CMatrixD" else "f"
    found = np.reshape(data.unpack(f"{rows * columns}{kind}"), (rows, columns))
    data.end()
    return found


# ---------------------------------------------------------------- classes


def _reading(data: ObjectReader, version: int) -> Reading:
    """CObservationOdometry; its counts of ticks are without a size of the wheels."""
    pose, label = _pose2(data), data.text()
    stamp_ns = _stamp(data)
    if version == 1:
        data.take(1 + 2 * 4 + 1 + 2 * 4)
    elif version == 2:
        if data.take(1)[0]:
            data.take(2 * 4)
        if data.take(1)[0]:
            data.take(3 * 8)
    return Reading(stamp_ns, label, pose)


def _motion(data: ObjectReader, version: int) -> RawlogMotion:
    """CActionRobotMovement2D: an increment of odometry with options of a noise model, or a PDF."""
    if version < 2:
        delta = _mean(data)
        matched = data.unpack("i")[0] != 0
    else:
        matched = data.unpack("i")[0] != 0
        delta = _mean(data) if matched else _pose2(data)
        if not matched:
            data.take(44 if version < 4 else 48 if version < 5 else 56)
    velocities, ticks = (2 * 4, 2 * 4) if version < 7 else (3 * 8, 2 * 4)
    for size in (velocities, ticks) if version else ():
        if data.take(1)[0] or version < 7:
            data.take(size)
    return RawlogMotion(_stamp(data) if version >= 6 else None, 0, delta, matched)


def _mean(data: ObjectReader) -> Pose:
    """CPosePDFGaussian without its covariance."""
    name, version = data.head()
    if name != "CPosePDFGaussian" or version > 2:
        raise UnreadableError(f"has a {name} of version {version}, which is not read")
    mean = _pose2(data)
    if version:
        data.take(6 * (8 if version == 2 else 4))
    else:
        _matrix(data)
    data.end()
    return mean


def _scan(data: ObjectReader, version: int) -> LaserScan:
    """CObservation2DRangeScan."""
    view, counterclockwise, farthest = data.unpack("f?f")
    mount = _pose3(data)
    if version < 6:
        _matrix(data)  # covariance of the mount
    (beams,) = data.unpack("I")
    if beams > _MOST_BEAMS or not 0 <= view < 7:
        raise UnreadableError("has a number of beams or a field of view that cannot be")
    ranges = np.frombuffer(data.take(4 * beams), dtype="<f4").astype(np.float32)
    valid = np.frombuffer(data.take(beams), dtype=np.uint8) != 0 if version else ranges < farthest
    if version >= 2:
        data.take(4)  # sigma
    stamp_ns = _stamp(data) if version >= 3 else None
    if version >= 4:
        data.take(4)  # width of a beam
    label, pitch, sweep = "", 0.0, 0.0
    if version >= 5:
        label, (pitch,) = data.text(), data.unpack("d")
    if version >= 7 and data.take(1)[0]:
        data.take(4 * beams)  # intensities
    if version >= 8:
        (sweep,) = data.unpack("f")
    if pitch:
        raise UnreadableError("is of a laser that nods")
    if not 0 <= sweep < _LONGEST_SWEEP_S:
        sweep = 0.0
    ranges[~valid] = np.inf
    signed = view if counterclockwise else -view
    return LaserScan(stamp_ns, label, mount, signed, farthest, ranges, sweep)


def _rate(data: ObjectReader, version: int) -> TurnRate:
    """CObservationIMU: the rates of turning; the order of older versions depended on the device."""
    mount = _pose3(data)
    if version < 4:
        there = data.take(_count(data))
        stamp_ns = _stamp(data)
        numbers = data.unpack(f"{_count(data)}d")
    else:
        there = data.take(_IMU_NUMBERS)
        stamp_ns = _stamp(data)
        numbers = data.unpack(f"{_IMU_NUMBERS}d")
    label = data.text()
    if not (len(there) > _RATES[0] < len(numbers) and there[_RATES[2]]):
        raise UnreadableError("has no rate of turning")
    rates = [numbers[k] if there[k] else 0.0 for k in _RATES]
    _finite(*rates)
    return TurnRate(stamp_ns, label, float(mount[2, :3] @ rates))


def _count(data: ObjectReader) -> int:
    found: int = data.unpack("I")[0]
    if found > _MOST_NUMBERS:
        raise UnreadableError("has more measurements than there are")
    return found


#: what reads a class, and the versions of its layout
_CLASSES: dict[str, tuple[Callable[[ObjectReader, int], Item], range]] = {
    "CObservation2DRangeScan": (_scan, range(9)),
    "CObservationOdometry": (_reading, range(3)),
    "CObservationIMU": (_rate, range(2, 5)),
    "CActionRobotMovement2D": (_motion, range(8)),
}
#: bytes before what a holder holds, by version
_HOLDERS = {"CActionCollection": (4,), "CSensoryFrame": (16, 8, 4)}
