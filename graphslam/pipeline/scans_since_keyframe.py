"""Where scans without a state are when they come: by the walls that the last keyframe saw.

Odometry since the last keyframe says so to some degrees where it is poor. The walls that the
keyframe saw are seen again by the next scans; how much worse odometry is than stated is found from
those before. Nothing later is used, so it serves causal and live trajectories; final ones have the
whole map (`scans_between`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from statistics import median

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import Config, FrontEndConfig
from graphslam.core.geometry import Array, between, rotate_cov
from graphslam.core.motion_models import Calibration
from graphslam.core.records import Observation, Scan
from graphslam.mapping.returns_on_walls import WallTree
from graphslam.mapping.scan_to_map import LEAST_SHARE, TINY, ScanReturns, fit_to_walls
from graphslam.odometry.preintegration import Track
from graphslam.perception.ordered_scan import scan_points, thinned
from graphslam.pipeline.scans_between import BEAMS, can_match

#: scans that are matched at once, at most
MOST_HELD = 64
#: so many scans as expected are assumed before the first; a scan counts for so many later ones
ASSUMED, MEMORY = 20.0, 300.0
#: sigmas of the deviation of a surface: the wall that the keyframe saw has it too, and an error of
#: its direction
DEVIATIONS = 2.0
#: scans whose shares of returns on walls tell which share is little
SHARES = 100


@dataclass(slots=True, eq=False)
class ScansSinceKeyframe:
    """The scans of one robot since its last keyframe, and where they were found, seen from it.

    ``state_ns``: time of the keyframe; ``calibration`` of the odometry, known then; ``walls`` that
    it saw, in its frame, None if it saw none. ``times`` and ``states`` ns,
    ``poses`` (3,) and ``covs`` (3, 3) along the axes of the keyframe, of the scans that were
    matched. ``variances`` (3,): factors on the variances of odometry; ``counted``: from how many
    scans; ``shares``: of their returns on walls. ``unused``: both of the scans since the keyframe,
    which tell of the ones after the next.
    """

    config: FrontEndConfig
    calibration: Calibration
    state_ns: int = -1
    walls: WallTree | None = None
    held: list[Scan] = field(default_factory=list)
    times: list[int] = field(default_factory=list)
    states: list[int] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    covs: list[Array] = field(default_factory=list)
    variances: Array = field(default_factory=lambda: np.ones(3))
    counted: float = ASSUMED
    shares: list[float] = field(default_factory=list)
    unused: list[tuple[Array, float]] = field(default_factory=list)

    @classmethod
    def of_smoother(cls, config: Config, track: Track) -> "ScansSinceKeyframe | None":
        """For back ends that revise states; filters say what odometry says after the last one."""
        smoother = config.backend.name in ("batch", "isam2") and config.backend.horizon_s > 0
        matches = smoother and can_match(config)
        floor_m = DEVIATIONS * config.front_end.floor_normal_m
        seen = replace(config.front_end, floor_normal_m=floor_m)
        return cls(seen, track.used_calibration) if matches else None

    def begin(
        self, state_ns: int, calibration: Calibration, seen: Sequence[Observation], track: Track
    ) -> None:
        """The scan of a state (ns) is the keyframe; what was seen is in the frame of the state.

        ``calibration`` of the odometry is the one known then.
        """
        self.match(track)
        self.calibration = calibration
        for ratio, share in self.unused:
            self.shares = [*self.shares[1 - SHARES :], share]
            if self._is_found(share):
                self.counted = min(self.counted + 1.0, MEMORY)
                self.variances = self.variances + (ratio - self.variances) / self.counted
        self.variances, self.unused = np.maximum(self.variances, 1.0), []
        walls = [o for o in seen if o.extent is not None]
        self.state_ns = state_ns
        means, extents = (np.array(v) for v in ([o.z for o in walls], [o.extent for o in walls]))
        self.walls = WallTree.from_walls(means, extents) if walls else None

    def add(self, scan: Scan, track: Track) -> None:
        """A scan that gets no state."""
        if self.walls is not None and any(track.moved(self.state_ns, scan.time_ns)):
            self.held.append(thinned(scan, BEAMS))
            if len(self.held) >= MOST_HELD:
                self.match(track)

    def match(self, track: Track) -> None:
        """Find out where the scans were that came since this was asked last."""
        held, self.held = self.held, []
        if not held or self.walls is None:
            return
        at = np.array([scan.time_ns for scan in held], dtype=np.int64)
        first = np.zeros(len(at), dtype=np.int64)
        begin = np.full(len(at), self.state_ns, dtype=np.int64)
        prior, noise = track.coarse_motions(begin, at, [self.calibration], first)
        covs = rotate_cov(noise, -prior[:, 2]) + TINY
        sigmas = np.sqrt(self.variances)
        found = fit_to_walls(
            prior,
            sigmas[:, None] * covs * sigmas,
            _returns(held, self.config),
            self.walls,
            self.config,
        )
        # what odometry is off by, and what is not known of that
        squared = between(prior, found.poses) ** 2 + np.diagonal(found.covs, axis1=1, axis2=2)
        ratio = squared / np.diagonal(covs, axis1=1, axis2=2)
        back = rotate_cov(found.covs, found.poses[:, 2])
        self.unused += zip(ratio, found.share.tolist(), strict=True)
        del self.unused[: -int(MEMORY)]
        for k, scan in enumerate(held):
            if self._is_found(found.share[k]):
                self.times.append(scan.time_ns)
                self.states.append(self.state_ns)
                self.poses.append(found.poses[k])
                self.covs.append(back[k])

    def _is_found(self, share: float) -> bool:
        """Whether a scan of which a share of returns is on walls has found its place."""
        return share > 0 and share >= LEAST_SHARE * median(self.shares or [0.0])

    def at(self, times_ns: IntArray, states_ns: IntArray) -> tuple[IntArray, Array, Array]:
        """Of scans (n,) after states (n,): rows (m,), poses (m, 3) seen from the state, covs."""
        order = np.argsort(np.array(self.times, dtype=np.int64), kind="stable")
        times = np.array(self.times, dtype=np.int64)[order]
        if not len(times):
            return np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3))
        k = np.minimum(np.searchsorted(times, times_ns), len(times) - 1)
        which = order[k]
        same = (times[k] == times_ns) & (np.array(self.states, dtype=np.int64)[which] == states_ns)
        rows, which = np.flatnonzero(same), which[same]
        return rows, np.array(self.poses)[which], np.array(self.covs)[which]

    def forget(self) -> None:
        """Drop where scans were found; what odometry is like is kept."""
        for history in (self.times, self.states, self.poses, self.covs):
            history.clear()


def _returns(scans: Sequence[Scan], config: FrontEndConfig) -> ScanReturns:
    points = [scan_points(scan, config.max_range_m) for scan in scans]
    number = np.array([len(own) for own in points], dtype=np.int64)
    lasers = np.array([scan.mount[:2] for scan in scans])
    return ScanReturns(number, np.concatenate(points), lasers)
