"""Robots that are set down elsewhere while scans and odometry go on.

From one scan to the next much of what was seen is gone (`graphslam.odometry.sudden_changes`). That
happens too where somebody steps in front of the laser, or a door is opened. So what was seen along
the metres before is compared with what is seen along those after it, in the result: of one place
the scans of either side confirm each other, people pass, and who stands there hides what is behind
him but does not let the laser see through walls. Of two places either side sees through what the
other one saw.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import ScanMatchingConfig
from graphslam.core.geometry import Array, between
from graphslam.core.records import KeyframeScan, Trajectory
from graphslam.odometry.sudden_changes import SuddenChange
from graphslam.perception.scan_matching import compare_with_scans, make_group

#: keyframes on either side that are compared, at most and at least, and how far from it, m: as
#: long as people stand in front of a slow robot, as short as a room
MOST_KEYFRAMES, LEAST_KEYFRAMES, FAR_M = 6, 3, 2.0
#: share of points on each other that two consecutive scans have less than those around them, at
#: least: 0.05 in an office without people
SUDDENLY = 0.2


class SceneChange(NamedTuple):
    """What the scans before and after a time see of each other's points.

    ``begin_ns``, ``end_ns``: two consecutive scans; ``less``: by how much smaller a share of their
    points is on each other than of those around them. ``same``: share of the points of either side
    that the other one confirms, the mean of both; ``gone`` and ``new``: share of those before, and
    after, that the other one saw through.
    """

    begin_ns: int
    end_ns: int
    less: float
    same: float
    gone: float
    new: float

    @property
    def contradicted(self) -> float:
        """Share of the points that the other side denies, of those that it can tell of."""
        denied = (self.gone + self.new) / 2
        return denied / max(denied + self.same, 1e-9)


def scene_changes(
    changes: Sequence[SuddenChange],
    scans: Sequence[KeyframeScan],
    states: Trajectory,
    config: ScanMatchingConfig,
) -> tuple[SceneChange, ...]:
    """How what is seen changes where consecutive scans suddenly have less in common.

    ``scans``: keyframes of the robot, at its ``states``, in the order of time.
    """
    sudden = [change for change in changes if change.usual - change.share >= SUDDENLY]
    if not sudden or not scans:
        return ()
    times = np.array([scan.time_ns for scan in scans], dtype=np.int64)
    poses = states.at(times)
    return tuple(
        found
        for change in sudden
        if (found := _scene_change(change, scans, times, poses, config)) is not None
    )


def _scene_change(
    change: SuddenChange,
    scans: Sequence[KeyframeScan],
    times_ns: IntArray,
    poses: Array,
    config: ScanMatchingConfig,
) -> SceneChange | None:
    """Of one change; None where there is too little before or after it."""
    split = int(np.searchsorted(times_ns, change.begin_ns, side="right"))
    before = range(max(split - MOST_KEYFRAMES, 0), split)
    after = range(split, min(split + MOST_KEYFRAMES, len(scans)))
    groups = []
    for which, nearest in ((before, split - 1), (after, split)):
        near = [k for k in which if np.hypot(*(poses[k] - poses[nearest])[:2]) <= FAR_M]
        if len(near) < LEAST_KEYFRAMES:
            return None
        seen = between(np.repeat(poses[split : split + 1], len(near), axis=0), poses[near])
        groups.append(make_group(seen, [scans[k].points for k in near], config))
    earlier, later = groups
    new_same, new = compare_with_scans(later.points, earlier)
    old_same, gone = compare_with_scans(earlier.points, later)
    return SceneChange(
        change.begin_ns,
        change.end_ns,
        change.usual - change.share,
        float(new_same.mean() + old_same.mean()) / 2,
        float((gone & ~old_same).mean()),
        float((new & ~new_same).mean()),
    )
