"""Where consecutive scans of a laser suddenly have less in common, though odometry goes on.

A robot that is set down elsewhere sees something else from one scan to the next. Keyframes are too
far apart to tell that from driving round a corner, so where two of them have less in common than
those before and after them, all scans between the two are compared. The worst places of a log alone
are looked at: what that costs does not depend on how long the log is.
"""

import heapq
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from graphslam.core.config import Config
from graphslam.core.geometry import Array, between
from graphslam.core.records import Scan
from graphslam.odometry.preintegration import Track
from graphslam.odometry.sweep_motion import undistorted_by_track
from graphslam.perception.ordered_scan import scan_points
from graphslam.perception.scan_pairs import fit_pairs

#: places of a log that are looked at, at most, and scans between two keyframes there
MOST_PLACES, MOST_SCANS = 16, 20
#: share of points on each other that keyframes have there, at most, and how much less than those
#: around: keyframes of one room have 0.7 and more, those that have nothing in common up to 0.68
LITTLE, LESS = 0.7, 0.15

Span = tuple[int, int]


class SuddenChange(NamedTuple):
    """Times, ns, of two consecutive scans; the share of the points of the later on the earlier one.

    ``usual``: that of the pairs of scans around them, at least.
    """

    begin_ns: int
    end_ns: int
    share: float
    usual: float


class SuddenChanges:
    """Collects the places block by block, and compares their scans at the end."""

    def __init__(self, track: Track, config: Config) -> None:
        """No scan yet; ``track`` is the odometry."""
        self._track, self._config = track, config
        #: the worst places: how much less, their keyframes' time and usual share, times and points
        self._places: list[tuple[float, int, float, list[int], list[Array]]] = []
        self._last_share = 0.0

    def add(
        self, shares: Mapping[Span, float], clouds: Mapping[int, Array], others: Sequence[Scan]
    ) -> None:
        """Take in a block.

        Args:
            shares: times, ns, of consecutive keyframes in their order -> share of points on each
                other.
            clouds: time, ns -> returns (k, 2) m of each of these keyframes.
            others: scans of the same laser that are no keyframes.
        """
        each = np.array([self._last_share, *shares.values()])
        # of the last one of a block it is not known what comes after it
        after = np.append(each[2:], 1.0)
        times = np.array([scan.time_ns for scan in others], dtype=np.int64)
        usual = np.minimum(each[:-1], after)
        for k, ((begin, end), share) in enumerate(shares.items()):
            less = float(usual[k]) - share
            is_among_worst = len(self._places) < MOST_PLACES or less > self._places[0][0]
            if share < LITTLE and less > LESS and is_among_worst:
                inside = np.flatnonzero((times > begin) & (times < end))
                if len(inside) > MOST_SCANS:
                    inside = inside[np.linspace(0, len(inside) - 1, MOST_SCANS).astype(np.int64)]
                some = undistorted_by_track([others[n] for n in inside.tolist()], self._track)
                found = dict(clouds) | {
                    s.time_ns: scan_points(s, self._config.front_end.max_range_m) for s in some
                }
                own = [begin, *(s.time_ns for s in some), end]
                place = (less, begin, float(usual[k]), own, [found[t] for t in own])
                if len(self._places) < MOST_PLACES:
                    heapq.heappush(self._places, place)
                else:
                    heapq.heapreplace(self._places, place)
        self._last_share = float(each[-1])

    def found(self) -> list[SuddenChange]:
        """Of each place the two consecutive scans that have the least in common, by time."""
        return sorted(self._change(*place[2:]) for place in self._places)

    def _change(self, usual: float, times: list[int], clouds: list[Array]) -> SuddenChange:
        """Of scans at one place."""
        poses = self._track.mounted_pose(np.array(times, dtype=np.int64))
        first = np.arange(len(times) - 1, dtype=np.int64)
        moved = between(poses[:-1], poses[1:])
        shares = fit_pairs(clouds, first, first + 1, moved, self._config.scan_matching).share
        k = int(shares.argmin())
        beside = np.delete(shares, k)
        around = float(beside.min()) if len(beside) else usual
        return SuddenChange(times[k], times[k + 1], float(shares[k]), around)
