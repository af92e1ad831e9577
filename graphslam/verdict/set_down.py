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
from graphslam.perception.scan_matching import ScanGroup, compare_with_scans, make_group

#: keyframes on either side that are compared together, at most and at least, and how far from it, m
MOST_KEYFRAMES, LEAST_KEYFRAMES, FAR_M = 6, 3, 2.0
#: keyframes on either side of which every second one is compared by itself: who stands in front of
#: a laser for 3 s is gone in the last of them
FURTHER = 12
#: ns that they have to last: at the ends of a log nobody knows whether what was seen comes back
LASTS_NS = 4_000_000_000
#: share of points of two scans that each other's can tell of, below which they are not compared
COMPARABLE = 0.1
#: share of points on each other that two consecutive scans have less than those around them, at
#: least: 0.05 in an office without people
SUDDENLY = 0.2


class SceneChange(NamedTuple):
    """What the scans before and after a time see of each other's points.

    ``begin_ns``, ``end_ns``: two consecutive scans. ``same``: share of the points of either side
    that the other one confirms, the mean of both; ``gone`` and ``new``: share of those before, and
    after, that the other one saw through. ``least``: of a scan before and one after, the two that
    contradict each other the least, as `contradicted`.
    """

    begin_ns: int
    end_ns: int
    same: float
    gone: float
    new: float
    least: float

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
    if not sudden:
        return ()
    times = np.array([scan.time_ns for scan in scans], dtype=np.int64)
    poses = states.at(times)
    clouds = [scan.points for scan in scans]
    found = (_scene_change(change, clouds, times, poses, config) for change in sudden)
    return tuple(one for one in found if one is not None)


def _scene_change(
    change: SuddenChange,
    clouds: Sequence[Array],
    times_ns: IntArray,
    poses: Array,
    config: ScanMatchingConfig,
) -> SceneChange | None:
    """Of one change; None where too little is known of before or after it."""
    split = int(np.searchsorted(times_ns, change.begin_ns, side="right"))
    # nearest first
    before = np.arange(split)[::-1][:FURTHER]
    after = np.arange(split, len(times_ns))[:FURTHER]
    near = [
        side[:MOST_KEYFRAMES][
            np.hypot(*(poses[side[:MOST_KEYFRAMES]] - poses[side[:1]])[:, :2].T) <= FAR_M
        ]
        for side in (before, after)
    ]
    if min(len(side) for side in near) < LEAST_KEYFRAMES:
        return None
    if any(np.ptp(times_ns[side]) < LASTS_NS for side in (before, after)):
        return None

    def group(which: IntArray) -> ScanGroup:
        seen = between(np.repeat(poses[split : split + 1], len(which), axis=0), poses[which])
        return make_group(seen, [clouds[k] for k in which.tolist()], config)

    same, gone, new = _seen_through(group(near[0]), group(near[1]))
    singles = [[group(side[k : k + 1]) for k in range(0, len(side), 2)] for side in (before, after)]
    pairs = np.array([_seen_through(a, b) for a in singles[0] for b in singles[1]])
    denied = pairs[:, 1:].mean(axis=1)
    told = denied + pairs[:, 0]
    shares = denied[told >= COMPARABLE] / told[told >= COMPARABLE]
    return SceneChange(
        change.begin_ns, change.end_ns, same, gone, new, float(shares.min(initial=1.0))
    )


def _seen_through(before: ScanGroup, after: ScanGroup) -> tuple[float, float, float]:
    """``same``, ``gone`` and ``new`` of `SceneChange`."""
    still, gone = compare_with_scans(before.points, after)
    already, new = compare_with_scans(after.points, before)
    same = float(still.mean() + already.mean()) / 2
    return same, float((gone & ~still).mean()), float((new & ~already).mean())
