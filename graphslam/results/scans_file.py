"""scans.npz: the scans of the keyframes, placed: what maps and viewers show of a result.

Motion during the sweep is taken out of them, and so are returns without a surface and, as far as
the run found them, moving things; the log is not needed any more. The layout is documented in
docs/formats.md.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphslam.core.errors import OutputError
from graphslam.core.geometry import Array
from graphslam.core.records import KeyframeScan, Trajectory
from graphslam.results.joint_file import UNREADABLE

FORMAT = 1
SCANS_FILE = "scans.npz"


@dataclass(frozen=True, slots=True, eq=False)
class PlacedScan:
    """Points (n, 2) m of a scan in the frame of a state at ``pose`` (3,) in the world.

    They were seen from ``sensor`` (3,) in the frame of the state.
    """

    robot: str
    time_ns: int
    pose: Array
    sensor: Array
    points: NDArray[Any]


def place_scans(
    scans: Sequence[KeyframeScan], states: Mapping[str, Trajectory]
) -> tuple[PlacedScan, ...]:
    """The scans of a result at its final states, in order of time; without states at none."""
    known = [scan for scan in scans if scan.robot in states]
    return tuple(
        PlacedScan(s.robot, s.time_ns, states[s.robot].at(s.time_ns), s.sensor, s.points)
        for s in sorted(known, key=lambda s: (s.time_ns, s.robot))
    )


def scans_bytes(scans: Sequence[PlacedScan]) -> bytes:
    """The content of the file."""
    names = sorted({scan.robot for scan in scans})
    number = {name: n for n, name in enumerate(names)}
    made = BytesIO()
    np.savez(
        made,
        format=np.array(FORMAT),
        robots=np.array(names, dtype=np.str_),
        robot=np.array([number[scan.robot] for scan in scans], dtype=np.int32),
        time_ns=np.array([scan.time_ns for scan in scans], dtype=np.int64),
        pose=np.array([scan.pose for scan in scans], dtype=float).reshape(-1, 3),
        sensor=np.array([scan.sensor for scan in scans], dtype=float).reshape(-1, 3),
        count=np.array([len(scan.points) for scan in scans], dtype=np.int64),
        points=np.concatenate([np.zeros((0, 2)), *(s.points for s in scans)], dtype=np.float32),
    )
    return made.getvalue()


def read_scans(path: Path) -> tuple[PlacedScan, ...]:
    """The file read back; none where there is no such file.

    Raises:
        OutputError: it cannot be read.
    """
    if not path.exists():
        return ()
    try:
        with path.open("rb") as stream, np.load(stream) as file:
            arrays = {name: file[name] for name in file.files}
            names = [str(name) for name in arrays["robots"]]
            clouds = np.split(arrays["points"], np.cumsum(arrays["count"])[:-1])
            return tuple(
                PlacedScan(names[robot], int(time_ns), pose, sensor, points)
                for robot, time_ns, pose, sensor, points in zip(
                    *(arrays[name] for name in ("robot", "time_ns", "pose", "sensor")),
                    clouds,
                    strict=True,
                )
            )
    except UNREADABLE as error:
        raise OutputError(f"{path}: {error}") from error
