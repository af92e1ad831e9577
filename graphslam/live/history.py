"""What was estimated so far, as trajectories: what is written of a drive that goes on."""

from collections.abc import Mapping

import numpy as np

from graphslam.core.geometry import compose, inverse
from graphslam.core.records import RobotResult, Trajectory
from graphslam.live.live_pass import LiveEstimate
from graphslam.results.scans_file import PlacedScan

#: keyframes whose returns are kept for the map, at most: then every second one is dropped
MOST_SCANS = 4000


class RobotHistory:
    """The estimates of one robot: some 150 bytes each."""

    def __init__(self) -> None:
        self._stamps = np.empty(1024, dtype=np.int64)
        self._rows = np.empty((1024, 18))  # pose, covariance, odometry, pose of the sensor
        self._count, self._has_scans = 0, False

    def __len__(self) -> int:
        return self._count

    def add(self, estimate: LiveEstimate) -> None:
        """Append an estimate."""
        if self._count == len(self._stamps):
            self._stamps = np.concatenate([self._stamps, np.empty_like(self._stamps)])
            self._rows = np.concatenate([self._rows, np.empty_like(self._rows)])
        e, self._has_scans = estimate, estimate.scan_pose is not None
        scan = np.full(3, np.nan) if e.scan_pose is None else e.scan_pose
        self._stamps[self._count] = e.stamp_ns
        self._rows[self._count] = np.concatenate([e.pose, e.cov.ravel(), e.odometry, scan])
        self._count += 1

    def result(self) -> RobotResult:
        """The trajectories, sorted by stamp; final poses are the causal ones."""
        order = np.argsort(self._stamps[: self._count], kind="stable")
        stamps, rows = self._stamps[order], self._rows[order]
        base = Trajectory(stamps, rows[:, :3], rows[:, 3:12].reshape(-1, 3, 3))
        unknown = np.full((len(stamps), 3, 3), np.nan)
        scan = Trajectory(stamps, rows[:, 15:], unknown) if self._has_scans else None
        begin = compose(rows[0, :3], inverse(rows[0, 12:15]))
        by_odometry = compose(np.broadcast_to(begin, (len(rows), 3)), rows[:, 12:15])
        return RobotResult(base, base, scan, scan, Trajectory(stamps, by_odometry, unknown))


class History:
    """The estimates of all robots and the scans of keyframes; ``largest_jump_m`` of any."""

    def __init__(self) -> None:
        self._robots: dict[str, RobotHistory] = {}
        self._scans: list[PlacedScan] = []
        self._every, self._keyframes = 1, 0
        self.largest_jump_m, self.last_ns = 0.0, 0

    def __len__(self) -> int:
        return sum(map(len, self._robots.values()))

    def add(self, estimate: LiveEstimate) -> None:
        """Append an estimate."""
        self._robots.setdefault(estimate.robot, RobotHistory()).add(estimate)
        self.last_ns = max(self.last_ns, estimate.stamp_ns)
        self.largest_jump_m = max(self.largest_jump_m, float(np.hypot(*estimate.jump[:2])))
        if estimate.points is None or estimate.scan_pose is None:
            return
        self._keyframes += 1
        if self._keyframes % self._every == 0:
            placed = PlacedScan(
                estimate.robot, estimate.stamp_ns, estimate.scan_pose, np.zeros(3), estimate.points
            )
            self._scans.append(placed)
        if len(self._scans) > MOST_SCANS:
            self._scans = self._scans[::2]
            self._every *= 2

    @property
    def scans(self) -> tuple[PlacedScan, ...]:
        """The scans of keyframes as they were placed, sorted by time."""
        return tuple(sorted(self._scans, key=lambda scan: (scan.time_ns, scan.robot)))

    def results(self) -> Mapping[str, RobotResult]:
        """The trajectories of every robot, sorted by name."""
        return {name: own.result() for name, own in sorted(self._robots.items())}
