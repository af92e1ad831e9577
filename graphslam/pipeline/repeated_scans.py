"""Scans that a laser repeats while its robot moves: the laser, or its driver, is frozen.

Such scans say that the robot stands, with great certainty, and all of them are wrong. What tells
them from those of a robot that stands is the noise of ranges: no two scans are the same, number for
number, and none are after a motion.
"""

from dataclasses import dataclass, field

import numpy as np

from graphslam.core.geometry import between
from graphslam.core.records import Scan
from graphslam.odometry.readings import Readings

#: m, rad: the robot moved by so much, by its odometry, since the scan was the same
MOVED_M, MOVED_RAD = 0.1, 0.1
#: different ranges that a scan has at least: that of an empty field looks the same everywhere
LEAST_RANGES = 10


@dataclass(slots=True, eq=False)
class RepeatedScans:
    """The scans of one robot that are left out.

    ``left_out``: of each its time, and that of the scan which it repeats, ns.
    """

    left_out: list[tuple[int, int]] = field(default_factory=list)
    _ranges: bytes = b""
    _first_ns: int = 0

    def leaves_out(self, scan: Scan, track: Readings) -> bool:
        """Whether the next scan repeats the one before although the robot moved since.

        Scans that are the same before it has moved are kept: it may stand. ``track`` is its
        odometry, up to the time of the scan at least.
        """
        ranges = scan.ranges.tobytes()
        if ranges != self._ranges:
            self._ranges, self._first_ns = ranges, scan.time_ns
            return False
        x, y, turned = between(track.pose(self._first_ns), track.pose(scan.time_ns)).tolist()
        if np.hypot(x, y) < MOVED_M and abs(turned) < MOVED_RAD:
            return False
        if len(np.unique(scan.ranges[np.isfinite(scan.ranges)])) < LEAST_RANGES:
            return False
        self.left_out.append((scan.time_ns, self._first_ns))
        return True
