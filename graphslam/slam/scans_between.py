"""Scans between keyframes: what is kept of them while a log is read, and where they were.

They have no state. Once the map is known they are matched to it (`mapping.scan_to_map`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from graphslam.core.config import Config, FrontEndConfig
from graphslam.core.geometry import Array, between
from graphslam.core.records import Estimate, Scan, Trajectory
from graphslam.mapping.landmark_map import LandmarkMap
from graphslam.mapping.returns_on_walls import WallTree
from graphslam.mapping.scan_to_map import ScanReturns, match_to_walls
from graphslam.odometry.interpolation import MatchedScans, between_states
from graphslam.odometry.preintegration import Track
from graphslam.odometry.sweep_motion import undistorted_by_track
from graphslam.perception.ordered_scan import scan_points, thinned

#: beams of a scan that are kept, at most. All 180 of Intel's make errors 2 % less
BEAMS = 60


def are_matched(config: Config) -> bool:
    """Whether scans between keyframes are matched to the map: where the whole log is solved."""
    return config.keyframe.scans_between == "map" and config.backend.name == "batch"


@dataclass(slots=True, eq=False)
class ScansBetween:
    """Some returns of each scan of a robot that got no state, in the order of the log."""

    _times: list[int] = field(default_factory=list)
    _lasers: list[Array] = field(default_factory=list)
    _points: list[Array] = field(default_factory=list)

    def __len__(self) -> int:
        """How many scans there are."""
        return len(self._times)

    def add(self, scans: Sequence[Scan], track: Track, config: FrontEndConfig) -> None:
        """Keep some returns of scans of one laser; ``track`` is the odometry until their end."""
        for scan in undistorted_by_track([thinned(scan, BEAMS) for scan in scans], track):
            self._times.append(scan.time_ns)
            self._lasers.append(scan.mount[:2])
            self._points.append(scan_points(scan, config.max_range_m).astype(np.float32))

    def matched(
        self, states: Trajectory, track: Track, walls: WallTree | None, config: FrontEndConfig
    ) -> MatchedScans | None:
        """Where the scans were: by odometry between final ``states``, and by walls of their map.

        The states are those of the first laser. None without scans.
        """
        if not self._times:
            return None
        # as the trajectories are made: in the order of time
        order = np.argsort(self._times, kind="stable")
        points = [self._points[k] for k in order.tolist()]
        returns = ScanReturns(
            np.array([len(own) for own in points], dtype=np.int64),
            np.concatenate(points),
            np.array(self._lasers)[order],
        )
        times = np.array(self._times, dtype=np.int64)[order]
        poses, covs = between_states(states, track, times)
        found, covs = match_to_walls(poses, covs, returns, walls, config)
        return MatchedScans(times, between(poses, found), covs)


def walls_of_frames(
    landmarks: LandmarkMap, estimate: Estimate, frames: Mapping[int, str]
) -> dict[str, WallTree]:
    """The walls of each frame where the estimate has them.

    Args:
        landmarks: the map: what is a wall, and its ends.
        estimate: where they are.
        frames: landmark -> its frame.
    """
    found: dict[str, list[tuple[Array, Array]]] = {}
    for number, entry in landmarks.entries.items():
        if number in estimate.landmarks and entry.kind != "point":
            mean, _ = estimate.landmarks[number]
            found.setdefault(frames[number], []).append((mean, entry.extent))
    return {
        frame: WallTree.from_walls(*map(np.array, zip(*walls, strict=True)))
        for frame, walls in found.items()
    }
