"""Scans between keyframes: what is kept of them while a log is read, and where they were.

They have no state. Once the map is known they are matched to it (`mapping.scan_to_map`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import Config, FrontEndConfig
from graphslam.core.geometry import Array, polar_points, transform_each, wrap
from graphslam.core.records import Estimate, Scan
from graphslam.mapping.landmark_map import LandmarkMap
from graphslam.mapping.returns_on_walls import WallTree
from graphslam.mapping.scan_to_map import ScanReturns, match_to_walls
from graphslam.odometry.interpolation import BetterScans
from graphslam.odometry.preintegration import Track
from graphslam.odometry.sweep_motion import undistorted_by_track
from graphslam.perception.ordered_scan import beam_step, thinned

#: beams of a scan that are kept, at most. More make the errors of Intel 2 % less
BEAMS = 40
#: m, m, rad: a robot that moved by less, and no share of the way to the next state, stands
STILL = (1e-3, 1e-3, 1e-3)


def can_match(config: Config) -> bool:
    """Whether scans without a state may be matched to walls."""
    return config.keyframe.scans_between == "map" and config.front_end.name != "none"


def are_matched(config: Config) -> bool:
    """Whether scans between keyframes are matched to the map: where a whole log is solved again."""
    backend = config.backend
    solved = backend.name == "batch" and backend.reoptimise
    return solved and can_match(config)


@dataclass(slots=True, eq=False)
class ScansBetween:
    """Some beams of each scan of a robot that got no state, in the order of the log.

    Lists of what was added at once: ``times`` (n,) ns; ``mounts`` (n, 3) of the laser; ``number``
    (n,) of beams; ``ranges`` (k,) m and ``angles`` (k,) rad of all these, one scan after the other.
    """

    times: list[IntArray] = field(default_factory=list)
    mounts: list[Array] = field(default_factory=list)
    number: list[IntArray] = field(default_factory=list)
    ranges: list[Array] = field(default_factory=list)
    angles: list[Array] = field(default_factory=list)

    def add(self, scans: Sequence[Scan], track: Track) -> None:
        """Keep some beams of scans of one laser; ``track`` is the odometry until their end."""
        if not scans:
            return
        self.times.append(np.array([scan.time_ns for scan in scans], dtype=np.int64))
        self.mounts.append(np.array([scan.mount for scan in scans]))
        if _are_alike(scans):
            every = beam_step(scans[0], BEAMS)
            ranges = [scan.ranges[::every] for scan in scans]
            angles = [scans[0].angles[::every]] * len(scans)
        else:
            thin = undistorted_by_track([thinned(scan, BEAMS) for scan in scans], track)
            ranges, angles = [scan.ranges for scan in thin], [scan.angles for scan in thin]
        self.number.append(np.array([len(own) for own in ranges], dtype=np.int64))
        self.ranges.append(np.concatenate(ranges).astype(np.float32))
        self.angles.append(np.concatenate(angles).astype(np.float32))

    def matched_to(self, walls: WallTree | None, config: FrontEndConfig) -> BetterScans | None:
        """Says where the scans were by the walls of their map; None without scans or walls.

        While a robot stands one of its scans is kept: the others are where that one was, as those
        of the same stamp are.
        """
        if walls is None or not self.times:
            return None

        def better(
            times_ns: IntArray, poses: Array, covs: Array
        ) -> tuple[IntArray, Array, Array, Array]:
            own, kept = np.unique(np.concatenate(self.times), return_index=True)
            first, given = np.unique(times_ns, return_index=True)
            _, rows, scans = np.intersect1d(first, own, return_indices=True)
            rows = given[rows]
            if not len(rows):
                return rows, poses[rows], covs[rows], covs[rows]
            returns = self._returns(config.max_range_m)
            found, left, prior = match_to_walls(
                poses[rows], covs[rows], lambda some: returns.only(kept[scans[some]]), walls, config
            )
            before = np.searchsorted(times_ns[rows], times_ns, side="right") - 1
            moved = poses - poses[rows[before]]
            moved[:, 2] = wrap(moved[:, 2])
            near = (np.abs(moved) < STILL).all(axis=1)
            # the error of a heading between states tells how far from them it is
            still = near & (covs[:, 2, 2] == covs[rows[before], 2, 2])
            same = np.flatnonzero((before >= 0) & still)
            given = before[same]
            return same, found[given], left[given], prior[given]

        return better

    def _returns(self, max_range_m: float) -> ScanReturns:
        number, points = [], []
        added = zip(self.mounts, self.number, self.ranges, self.angles, strict=True)
        for mounts, beams, ranges, angles in added:  # one after the other, for the memory
            with np.errstate(invalid="ignore"):
                kept = (ranges > 0) & (ranges < max_range_m)
            scan = np.repeat(np.arange(len(mounts)), beams)[kept]
            seen = polar_points(ranges[kept].astype(float), angles[kept].astype(float))
            points.append(transform_each(mounts[scan], seen).astype(np.float32))
            number.append(np.bincount(scan, minlength=len(mounts)))
        lasers = np.concatenate(self.mounts)[:, :2]
        return ScanReturns(np.concatenate(number), np.concatenate(points), lasers)


def _are_alike(scans: Sequence[Scan]) -> bool:
    """Whether scans have the same beams, all measured at once."""
    beams = {(len(s.ranges), s.angle_min_rad, s.angle_step_rad, s.beam_period_s) for s in scans}
    return len(beams) == 1 and not scans[0].beam_period_s and all(s.bearings is None for s in scans)


def walls_of_frames(
    landmarks: LandmarkMap, estimate: Estimate, frames: Mapping[int, str]
) -> dict[str, WallTree]:
    """The walls of each frame where the estimate has them.

    Args:
        landmarks: the map: what is a wall, and its ends; in the same frames as the estimate.
        estimate: where they are.
        frames: landmark -> its frame.
    """
    found: dict[str, list[tuple[Array, Array]]] = {}
    for number, entry in landmarks.entries.items():
        if number in estimate.landmarks and entry.kind != "point":
            mean, _ = estimate.landmarks[number]
            found.setdefault(frames[number], []).append((mean, entry.extent_at(mean)))
    return {
        frame: WallTree.from_walls(*map(np.array, zip(*walls, strict=True)))
        for frame, walls in found.items()
    }
