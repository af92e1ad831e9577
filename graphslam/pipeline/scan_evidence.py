"""What a robot's scans say of how it moved, where only they and the odometry are asked.

They are compared with each other, so it hardly matters which estimate of the path they are at.
"""

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from graphslam.core.arrays import stretches
from graphslam.core.geometry import Array
from graphslam.core.records import Estimate
from graphslam.pipeline.path_evidence import (
    NO_PATH,
    SPEEDS_M_S,
    PathMisfits,
    better_fit,
    path_misfits,
    speed_misfits,
)
from graphslam.pipeline.robot_state import RobotState

if TYPE_CHECKING:
    from graphslam.pipeline.log_pass import LogPass

#: a robot stands that moves less in a step (ns; m, rad), and does so for at least (ns)
PARKED_STEP_NS, PARKED_M, PARKED_RAD, PARKED_NS = 1_000_000_000, 0.01, 0.005, 4_000_000_000
#: scans that are looked at; m: a range that changed
SAMPLED_SCANS, CHANGED_M = 400, 0.15
#: how much more than by noise a range changed, and how many scans of one place show it
NOISE_FACTOR, LEAST_SCANS = 3.0, 3


class Parked(NamedTuple):
    """A time in which odometry stands.

    ``scan_change``: the largest share of a scan's beams that changed much in it; ``range_change``:
    by how much half of the beams changed at least, as far as that is above the noise, m: people
    who pass change fewer; ``speed_m_s``: at which its scans fit, along the walls, where they do
    not fit if it stands.
    """

    begin_ns: int
    end_ns: int
    scan_change: float
    range_change: float
    speed_m_s: float = 0.0


def find_parked(pipeline: "LogPass") -> dict[str, Sequence[Parked]]:
    """When each robot stood by its odometry, and how its scans changed; no estimate is needed."""
    return {name: tuple(_parked(pipeline, name, run)) for name, run in pipeline.started.items()}


def _parked(pipeline: "LogPass", name: str, run: RobotState) -> Iterator[Parked]:
    """When a robot stands by its odometry, and how its scans change meanwhile."""
    if name in pipeline.log.without_odometry or len(run.track) < 2:
        return
    grid = np.arange(run.track.first_ns, run.track.last_ns, PARKED_STEP_NS)
    moved = np.abs(np.diff(run.track.pose(grid), axis=0))
    stands = np.asarray((moved < np.array([PARKED_M, PARKED_M, PARKED_RAD])).all(axis=1))
    long = [
        (int(grid[a]), int(grid[b])) for a, b in stretches(stands) if grid[b] - grid[a] >= PARKED_NS
    ]
    scans = pipeline.log.sample_scans(name, SAMPLED_SCANS) if long and run.scans else []
    for begin, end in long:
        own = [scan for scan in scans if begin < scan.time_ns < end]
        changes = [_changed(own[0].ranges, scan.ranges) for scan in own[1:]]
        # creeping by a centimetre a second is standing too, but changes ranges in the end
        poses = run.track.pose(np.array([scan.time_ns for scan in own], dtype=np.int64))
        still = (np.abs(poses - poses[:1]) < [PARKED_M, PARKED_M, PARKED_RAD]).all(axis=1)
        same = [own[k] for k in np.flatnonzero(still).tolist()]
        halves = [_half_changed(same[0].ranges, scan.ranges) for scan in same[1:]]
        half = float(np.median(halves)) if len(halves) >= LEAST_SCANS else 0.0
        fit = better_fit(speed_misfits(same))
        speed = 0.0 if fit is None else abs(float(SPEEDS_M_S[fit]))
        yield Parked(begin, end, max(changes, default=0.0), half, speed)


def misfits_along_walls(pipeline: "LogPass", estimate: Estimate) -> dict[str, PathMisfits]:
    """How every robot's scans fit if its path was another one along walls.

    At most some hundred scans of each robot are looked at, however long the log is. There is
    nothing to doubt where all motion is that of the scans. ``estimate``: of the states.
    """
    found = dict.fromkeys(pipeline.started, NO_PATH)
    for name in found:
        if name not in pipeline.log.without_odometry:
            scans = [scan for scan in pipeline.keyframe_scans if scan.robot == name]
            found[name] = path_misfits(scans, estimate.states[name])
    return found


def _half_changed(before: Array, after: Array) -> float:
    """By how much half of the ranges changed at least, m; 0 where the noise may have done it.

    The noise is that of neighbouring beams about straight lines.
    """
    if len(before) != len(after):
        return 0.0
    both = np.isfinite(before) & np.isfinite(after)
    bends = before[:-2] - 2 * before[1:-1] + before[2:]
    bends = bends[np.isfinite(bends)]
    if not both.any() or not len(bends):
        return 0.0
    changed = float(np.median(np.abs(after - before)[both]))
    noise = float(np.median(np.abs(bends))) * math.sqrt(2 / 6)  # of a difference of two ranges
    return changed if changed > NOISE_FACTOR * noise else 0.0


def _changed(before: Array, after: Array) -> float:
    """Share of beams whose range changed; 0 where nothing can be compared."""
    if len(before) != len(after):
        return 0.0
    both = np.isfinite(before) & np.isfinite(after)
    if not both.any():
        return 0.0
    return float(np.mean(np.abs(after - before)[both] > CHANGED_M))
