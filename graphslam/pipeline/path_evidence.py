"""What consecutive scans say of the path along walls, where odometry alone measures it."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, between, compose
from graphslam.core.records import KeyframeScan, Scan, Trajectory
from graphslam.perception.along_walls import NearReturns, misfits, near_returns, open_direction
from graphslam.perception.ordered_scan import scan_points

#: what the path is multiplied by: itself, and what is far from what calibration explains
FACTORS = np.array([1.0, -2.0, -1.5, -1.0, -0.75, -0.5, 0.5, 1.75, 2.0, 2.5, 3.0])
#: m/s along walls of a robot that is said to stand
SPEEDS_M_S = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.75, 1.0, 1.25, 1.5])
SPEEDS_M_S = np.concatenate([SPEEDS_M_S, -SPEEDS_M_S[1:]])
#: m: between two scans that are compared; rad: turned by at most; m: along the walls at least
APART_M, TURNED_RAD, ALONG_M = 0.6, 0.2, 0.3
#: s: between two scans of a robot that stands; pairs of them, in a window
STANDS_S, STANDS_PAIRS = (0.8, 3.0), 40
#: scans of a robot that are looked at, and pairs of them
MOST_SCANS, MOST_PAIRS = 600, 200
MAX_RANGE_M = 30.0
#: something else is said if it fits by this factor better, what is reported does not fit (in
#: squared sigmas: noise alone is below), and so many pairs, of this share, agree
BETTER, MISFIT, LEAST_PAIRS, AGREEING = 0.75, 1.0, 6, 0.75


class PathMisfits(NamedTuple):
    """Pairs of scans along walls: when (n,), and `misfits` (n, f) by `FACTORS` on the path."""

    times_ns: IntArray
    misfits: Array


NO_PATH = PathMisfits(np.zeros(0, dtype=np.int64), np.zeros((0, len(FACTORS))))


def better_fit(misfits: Array) -> int | None:
    """The column of misfits (n, h) that fits far better than the first one; None if none does.

    Where scans have nothing that tells one from the other all fit: none is better then.
    """
    if len(misfits) < LEAST_PAIRS:
        return None
    mean = misfits.mean(axis=0)
    best = int(mean.argmin())
    agree = np.mean(misfits[:, best] < misfits[:, 0])
    is_better = mean[0] > MISFIT and mean[best] < BETTER * mean[0] and agree >= AGREEING
    return best if is_better else None


def path_misfits(scans: Iterable[KeyframeScan], states: Trajectory) -> PathMisfits:
    """How well scans of one robot fit each other where they leave the path along walls open.

    Args:
        scans: of its keyframes, in order.
        states: the poses that they were made from.
    """
    stamps = set(states.stamps_ns.tolist())
    own = [scan for scan in scans if scan.time_ns in stamps]
    if len(own) < 2:
        return NO_PATH
    at = states.at(np.array([scan.time_ns for scan in own], dtype=np.int64))
    lasers = compose(at, np.array([scan.sensor for scan in own]))
    path = np.hypot(*np.diff(lasers[:, :2], axis=0).T)
    path = np.concatenate([[0.0], np.cumsum(path)])
    later = np.searchsorted(path, path + APART_M)
    firsts = np.flatnonzero(later < len(own))
    motions = between(lasers[firsts], lasers[later[firsts]])
    straight = np.abs(motions[:, 2]) < TURNED_RAD
    firsts, motions = firsts[straight], motions[straight]
    some = np.unique(np.linspace(0, len(firsts) - 1, min(len(firsts), MOST_SCANS)).astype(int))
    found: list[tuple[int, NearReturns, NearReturns, Array]] = []
    for first, motion in zip(firsts[some].tolist(), motions[some], strict=True):
        before = near_returns(own[first].points, own[first].sensor)
        axis = None if before is None else open_direction(before)
        if axis is None or before is None or abs(motion[:2] @ axis) < ALONG_M:
            continue
        other = own[int(later[first])]
        after = near_returns(other.points, other.sensor)
        if after is not None:
            along = (motion[:2] @ axis) * axis
            poses = motion + (FACTORS[:, None] - 1.0) * np.append(along, 0.0)
            found.append((other.time_ns, before, after, poses))
    found = found[:: 1 + len(found) // MOST_PAIRS]
    if not found:
        return NO_PATH
    times = np.array([time for time, *_ in found], dtype=np.int64)
    return PathMisfits(times, np.array([misfits(a, b, poses) for _, a, b, poses in found]))


def speed_misfits(scans: Sequence[Scan]) -> Array:
    """`misfits` (n, s) of pairs of scans of a robot that stands, if it moves at `SPEEDS_M_S`.

    Args:
        scans: in order of time, from one place by odometry.
    """
    times = np.array([scan.time_ns for scan in scans], dtype=np.int64) * 1e-9
    apart = times[None] - times[:, None]
    pairs = np.argwhere((apart >= STANDS_S[0]) & (apart <= STANDS_S[1]))
    found = []
    for first, second in pairs[:: 1 + len(pairs) // STANDS_PAIRS].tolist():
        one, other = scans[first], scans[second]
        before, after = (near_returns(scan_points(s, MAX_RANGE_M), s.mount) for s in (one, other))
        axis = None if before is None else open_direction(before)
        if axis is None or before is None or after is None:
            continue
        moved = SPEEDS_M_S * apart[first, second]
        found.append(misfits(before, after, np.append(axis, 0.0) * moved[:, None]))
    return np.array(found).reshape(-1, len(SPEEDS_M_S))
