"""Dynamic objects: free-standing returns in space that an earlier scan saw as free.

Unknown moving objects (people, robots without an outline) must not become landmarks. An object that
stands free, and where an earlier beam passed well behind it, was not there then. Simple and
cautious: what no earlier scan has seen as free space is kept.
"""

from collections.abc import Sequence

import numpy as np

from graphslam.core.geometry import Array, transform, transform_each
from graphslam.perception.ordered_scan import Mask, Sweep, join_sweeps
from graphslam.perception.robot_outlines import free_standing_clusters

#: m: wider objects are part of the building
WIDEST_M = 1.5
#: m: space is free if an earlier beam went so much farther
BEHIND_M = 0.4
#: m: an earlier beam that ended so near to an object hit the same one
SAME_M = 0.1
#: share of its returns for which that holds at least; fewest returns of an object
MIN_SHARE, MIN_RETURNS = 0.8, 3


def was_present(points: Array, earlier: Sweep, earlier_from_here: Array) -> bool:
    """Whether an earlier scan saw an object where it is now, so that it has not moved.

    ``points`` (n, 2) are the object's returns, laser frame, ``earlier_from_here`` (3,) is the pose
    of the laser in the frame of the earlier scan's.
    """
    return bool(np.mean(returns_present_before(points, earlier, earlier_from_here)) >= MIN_SHARE)


def returns_present_before(points: Array, earlier: Sweep, earlier_from_here: Array) -> Mask:
    """Which points (n, 2), laser frame, an earlier scan saw too; arguments as in `was_present`."""
    r, before = _earlier_ranges(points, earlier, earlier_from_here)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.any(np.abs(before - r[:, None]) < SAME_M, axis=1))


def _earlier_ranges(points: Array, earlier: Sweep, earlier_from_here: Array) -> tuple[Array, Array]:
    """Ranges (n,) of points in the earlier frame; those (n, 3) of the three beams nearest to each.

    NaN outside the earlier scan's field of view.
    """
    there = transform(earlier_from_here, points)
    a = np.arctan2(there[:, 1], there[:, 0])
    turn = np.mod(a - earlier.angles[0] + earlier.step_rad / 2, 2 * np.pi)
    beam = np.floor(turn / earlier.step_rad).astype(np.int64)[:, None] + np.array([-1, 0, 1])
    n = len(earlier.ranges)
    seen = np.where((beam >= 0) & (beam < n), earlier.ranges[np.clip(beam, 0, n - 1)], np.nan)
    return np.hypot(*there.T), seen


def dynamic_returns(sweep: Sweep, views: Sequence[tuple[Sweep, Array]]) -> Mask:
    """Which returns (k,) of a scan are of objects in space that an earlier scan saw as free.

    ``views`` are earlier scans of the same laser, each with the pose (3,) of the scan's laser in
    its laser's frame.
    """
    gone = np.zeros(len(sweep.beam), dtype=np.bool_)
    found = free_standing_clusters(sweep, WIDEST_M)
    count = found.last - found.first + 1
    for earlier, earlier_from_here in views:
        if not len(found) or not len(earlier.ranges):
            continue
        r, before = _earlier_ranges(sweep.points, earlier, earlier_from_here)
        # both neighbouring beams must have passed as well: the laser may have turned a little less
        through = np.min(before, axis=1) > r + BEHIND_M  # a missing return, NaN, compares False
        sums = np.concatenate([[0], np.cumsum(through)])
        share = (sums[found.last + 1] - sums[found.first]) / count
        for k in np.flatnonzero((count >= MIN_RETURNS) & (share >= MIN_SHARE)):
            gone[found.first[k] : found.last[k] + 1] = True
    return gone


def dynamic_returns_of_all(
    sweeps: Sequence[Sweep], earlier_from_here: Sequence[Array]
) -> list[Mask]:
    """`dynamic_returns` of each of many scans, at once where all have one angle between beams.

    ``earlier_from_here[lag - 1]`` (s, 3) are the poses of each scan's laser in the frame of the
    laser ``lag`` scans before, not used where there is none.
    """
    if len({sweep.step_rad for sweep in sweeps}) == 1:
        joined = join_sweeps(sweeps)
        gone = _dynamic_returns_of_joined(joined, earlier_from_here)
        return np.split(gone, np.searchsorted(joined.scan, np.arange(1, len(sweeps))))
    return [
        dynamic_returns(
            sweep,
            [
                (sweeps[k - lag], poses[k])
                for lag, poses in enumerate(earlier_from_here, 1)
                if k >= lag
            ],
        )
        for k, sweep in enumerate(sweeps)
    ]


def _dynamic_returns_of_joined(sweep: Sweep, earlier_from_here: Sequence[Array]) -> Mask:
    """Which returns (k,) of joined scans are of moving objects."""
    gone = np.zeros(len(sweep.beam), dtype=np.bool_)
    found = free_standing_clusters(sweep, WIDEST_M)
    count = found.last - found.first + 1
    enough = np.flatnonzero(count >= MIN_RETURNS)
    if not len(enough):
        return gone
    # only returns of clusters are compared
    first, count = found.first[enough], count[enough]
    cluster = np.repeat(np.arange(len(enough)), count)
    ends = np.cumsum(count)
    rows = np.arange(len(cluster)) - np.repeat(ends - count, count) + first[cluster]
    scan, points = sweep.scan[rows], sweep.points[rows]
    size = np.diff(sweep.starts, append=len(sweep.ranges))
    for lag, poses in enumerate(earlier_from_here, 1):
        exists, other = scan >= lag, np.maximum(scan - lag, 0)
        there = transform_each(poses[scan], points)
        known = exists & (size[other] > 0)
        start = sweep.starts[other]
        a = np.arctan2(there[:, 1], there[:, 0])
        begin = sweep.angles[np.minimum(start, len(sweep.angles) - 1)]
        turn = np.mod(a - begin + sweep.step_rad / 2, 2 * np.pi)
        beam = np.floor(turn / sweep.step_rad).astype(np.int64)[:, None] + np.array([-1, 0, 1])
        inside = (beam >= 0) & (beam < size[other][:, None]) & known[:, None]
        at = np.where(inside, start[:, None] + beam, 0)
        before = np.where(inside, sweep.ranges[at], np.nan)
        # both neighbouring beams must have passed as well: the laser may have turned a little less
        through = np.min(before, axis=1) > np.hypot(*there.T) + BEHIND_M
        share = np.bincount(cluster[through], minlength=len(count)) / count
        gone[rows[(share >= MIN_SHARE)[cluster]]] = True
    return gone
