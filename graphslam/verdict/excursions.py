"""Doubts about a path that leaves that of odometry for a while and comes back to it.

Wheels that slip, and robots that are pushed, do not come back to where their odometry is. Where an
estimate does, its sightings were wrong in between: all of them alike, so that none contradicts
another.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, between
from graphslam.verdict.doubts import MOVED_M, Reason, seconds
from graphslam.verdict.evidence import Evidence

#: ns: the path leaves within so long, and is back within so long
LEAVES_NS, BACK_NS = 2_500_000_000, 30_000_000_000
#: it leaves by more than `MOVED_M`, and by more than so many times what noise does half of the time
LEAVES = 10.0
#: it is back if so much of that is left at most
BACK = 0.4
#: images from which it is looked for
LEAST = 20


@dataclass(frozen=True, slots=True)
class Excursion:
    """When a path left that of odometry, and by how far, m; when it was back."""

    begin_ns: int
    end_ns: int
    away_m: float


def excursion_doubts(evidence: Evidence) -> Iterator[Reason]:
    """Robots without scans whose sightings take them off and back."""
    for robot in evidence.without_scans:
        found = largest_excursion(*robot.seen.at_images())
        if found is None:
            continue
        begin, end = (seconds(t, evidence.begin_ns) for t in (found.begin_ns, found.end_ns))
        text = (
            f"{robot.name}: its sightings move it {found.away_m:.2f} m off the path of its "
            f"odometry at {begin}, and back by {end}: they were wrong in between"
        )
        yield Reason("doubtful", "sightings", robot.name, text)


def largest_excursion(times_ns: IntArray, odometry: Array, poses: Array) -> Excursion | None:
    """The largest one of a path.

    What odometry misses of every motion is summed up in the world frame, with the headings of the
    estimate, so that a heading that odometry misses does not count. What a shorter part of a slip
    leaves may be made up for by noise, so only windows that see most of it count. Cost grows as the
    number of poses times those within `LEAVES_NS`, and as that of excursions times those within
    `BACK_NS`.

    Args:
        times_ns: (n,) ascending.
        odometry: (n, 3) poses by odometry.
        poses: (n, 3) the same as estimated.
    """
    if len(times_ns) < LEAST:
        return None
    told, own = (between(at[:-1], at[1:])[:, :2] for at in (odometry, poses))
    scale = float((told * own).sum() / max((told**2).sum(), 1e-9))
    left = own - scale * told
    c, s = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    missed = np.column_stack([c * left[:, 0] - s * left[:, 1], s * left[:, 0] + c * left[:, 1]])
    offset = np.concatenate([np.zeros((1, 2)), np.cumsum(missed, axis=0)])
    after = np.minimum(np.searchsorted(times_ns, times_ns + LEAVES_NS), len(times_ns) - 1)
    away = np.hypot(*(offset[after] - offset).T)
    limit = max(MOVED_M, LEAVES * float(np.median(away)))
    width = int(np.max(after - np.arange(len(after)))) + 1
    most = sliding_window_view(np.pad(away, width), 2 * width + 1).max(axis=1)
    largest: Excursion | None = None
    for k in np.flatnonzero((away > limit) & (away == most)).tolist():
        end = int(np.searchsorted(times_ns, times_ns[after[k]] + BACK_NS))
        rest = np.hypot(*(offset[after[k] : end] - offset[k]).T)
        back = np.flatnonzero(rest < BACK * away[k])
        if len(back) and (largest is None or away[k] > largest.away_m):
            when = int(times_ns[after[k] + back[0]])
            largest = Excursion(int(times_ns[k]), when, float(away[k]))
    return largest
