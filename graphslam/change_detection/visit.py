"""One visit: the scans that a result folder was made from, with the laser poses it estimated."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from graphslam.core.config import ChangesConfig
from graphslam.core.errors import ConfigError, LogError, OutputError
from graphslam.core.geometry import Array, between, compose, compose_cov, polar_points, unit_vectors
from graphslam.core.records import Landmark, Scan
from graphslam.logs import open_logs
from graphslam.odometry.interpolation import trajectory_of_mount
from graphslam.results.folder import SavedResult, check_one_frame

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

_DEFAULTS = ChangesConfig()

#: quantiles of absolute differences between which range noise is estimated
_MIDDLE = (0.3, 0.7)


@dataclass(frozen=True, slots=True, eq=False)
class Visit:
    """All beams of one visit, flat; every pose in one world frame.

    Attributes:
        stamps_ns: (s,) of the scans.
        poses: (s, 3) of the laser.
        covs: (s, 3, 3) of additive world-axis errors.
        shared: (s, 3, 3) the part of ``covs`` that may be common to all scans; the rest is
            independent between scans.
        scan: (n,) index of the beam's scan, ascending; within a scan bearings ascend.
        angle: (n,) rad in the laser's frame.
        range_m: (n,) NaN without a usable return.
        surface: (n,) whether the return is on a surface, see `on_surface`.
        landmarks: the map of the run.
        robots: number of robots that the scans come from.
        names: (s,) the robot of each scan; empty if unknown.
        recordings: robot -> SHA-256 of the recordings that hold its scans; empty if unknown.
    """

    stamps_ns: Ints
    poses: Array
    covs: Array
    shared: Array
    scan: Ints
    angle: Array
    range_m: Array
    surface: Bools
    landmarks: tuple[Landmark, ...]
    robots: int = 1
    names: tuple[str, ...] = ()
    recordings: Mapping[str, frozenset[str]] = field(default_factory=dict)

    def headings(self, beams: Bools | Ints | slice = slice(None)) -> Array:
        """Directions (k,) rad of some beams (k,) in the world; default: of all."""
        return np.asarray(self.poses[self.scan[beams], 2] + self.angle[beams])

    @property
    def directions(self) -> Array:
        """Unit vectors (n, 2) of the beams in the world."""
        return unit_vectors(self.headings())

    @property
    def ends(self) -> Array:
        """End points (n, 2) m of the beams in the world."""
        return self.ends_of(slice(None))

    def ends_of(self, beams: Bools | Ints | slice) -> Array:
        """`ends` (k, 2) of some of the beams."""
        at = self.poses[self.scan[beams], :2]
        return at + polar_points(self.range_m[beams], self.headings(beams))

    def transformed(self, pose: Array, cov: Array) -> "Visit":
        """The visit in a frame where its world is at ``pose`` (3,) with ``cov`` (3, 3)."""
        at = np.broadcast_to(pose, self.poses.shape)
        covs = compose_cov(at, np.broadcast_to(cov, self.covs.shape), self.poses, self.covs)
        return replace(self, poses=compose(at, self.poses), covs=covs, shared=covs)

    def select(self, scans: Bools) -> "Visit":
        """The visit with only the scans (s,) that are True in ``scans``."""
        number = np.cumsum(scans) - 1
        beams = scans[self.scan]
        names = tuple(name for name, kept in zip(self.names, scans, strict=False) if kept)
        return Visit(
            self.stamps_ns[scans], self.poses[scans], self.covs[scans], self.shared[scans],
            number[self.scan[beams]], self.angle[beams], self.range_m[beams], self.surface[beams],
            self.landmarks, len(set(names)) or self.robots, names, self.recordings,
        )  # fmt: skip

    def with_shown_landmarks(self) -> "Visit":
        """The visit without landmarks that none of its scans can show: seen at other times only."""
        times = np.sort(self.stamps_ns)
        shown = tuple(
            one
            for one in self.landmarks
            if np.searchsorted(times, one.first_ns) < np.searchsorted(times, one.last_ns, "right")
        )
        return replace(self, landmarks=shown)

    def shared_with(self, other: "Visit") -> Bools:
        """Which scans (s,) are in another visit too: of one recording, and of one time.

        Times alone do not tell: of two robots, or of two simulated days, they may be the same.
        """
        mine, theirs = (
            {sha256 for name in one.names for sha256 in one.recordings.get(name, ())}
            for one in (self, other)
        )
        common = mine & theirs
        of_common = [
            np.array([bool(common & one.recordings.get(name, set())) for name in one.names], bool)
            for one in (self, other)
        ]
        if not common:
            return np.zeros(len(self.stamps_ns), dtype=bool)
        return np.asarray(
            of_common[0] & np.isin(self.stamps_ns, other.stamps_ns[of_common[1]]), dtype=bool
        )


def visit_from_scans(
    stamps_ns: Ints,
    poses: Array,
    covs: Array,
    sweeps: Sequence[tuple[Array, Array]],
    landmarks: tuple[Landmark, ...] = (),
    config: ChangesConfig = _DEFAULTS,
) -> Visit:
    """A visit from scans with stamps (s,), poses (s, 3) of the laser in the world, covs (s, 3, 3).

    ``sweeps``: per scan its bearings (k,) rad, ascending, and ranges (k,) m, NaN without a return.
    """
    counts = [len(angles) for angles, _ in sweeps]
    return Visit(
        stamps_ns, poses, covs, covs,
        np.repeat(np.arange(len(sweeps)), counts),
        np.concatenate([angles for angles, _ in sweeps]),
        np.concatenate([ranges for _, ranges in sweeps]),
        np.concatenate([on_surface(angles, ranges, config) for angles, ranges in sweeps]),
        landmarks,
    )  # fmt: skip


def on_surface(angles: Array, ranges: Array, config: ChangesConfig = _DEFAULTS) -> Bools:
    """Which returns, at bearings (k,) rad and ranges (k,) m, have close neighbours on both sides.

    The others are at an edge, where a beam that meets two surfaces measures the range of neither,
    or on a surface seen at a grazing angle, which contributes little. NaN: no return.
    """
    points = polar_points(ranges, angles)
    gap = np.hypot(*np.diff(points, axis=0).T)
    nearer = np.fmin(ranges[1:], ranges[:-1])
    gap[nearer < config.min_range_m] = np.inf
    joined = gap < config.edge_gap_m + config.edge_gap_ratio * nearer  # false with NaN
    joined = np.concatenate([[False], joined, [False]])
    return np.asarray(joined[1:] & joined[:-1])


def scatter_of_ranges(visit: Visit) -> float:
    """Range noise sigma, m, of neighbouring beams, whatever surface they met; 0 if there are none.

    From the third differences of the ranges within scans: a straight surface has hardly any. Of
    their absolute values the mean between two quantiles leaves out corners and clutter, and unlike
    a median it is not rounded as the ranges are.
    """
    run = visit.surface[:-3] & visit.surface[1:-2] & visit.surface[2:-1] & visit.surface[3:]
    first = np.nonzero(run & (visit.scan[:-3] == visit.scan[3:]))[0]
    if not len(first):
        return 0.0
    near = visit.range_m[first[:, None] + np.arange(4)]
    third = np.sort(np.abs(near @ np.array([1.0, -3.0, 3.0, -1.0])))
    low, high = _MIDDLE
    middle = third[int(low * len(third)) : int(high * len(third)) + 1].mean()
    # the same of a normal distribution; that of third differences has 1 + 9 + 9 + 1 variances
    edges = norm.pdf(norm.ppf((1 + np.array(_MIDDLE)) / 2))
    normal = 2 * (edges[0] - edges[1]) / (high - low)
    return float(middle / normal / np.sqrt(20.0))


def load_visit(saved: SavedResult, directory: Path, config: ChangesConfig = _DEFAULTS) -> Visit:
    """The visit of a result folder: ranges from the logs that it names, poses from the folder.

    ``directory``: where the folder is, for messages.

    Raises:
        ConfigError: no range is between the least and the largest that are used.
        LogError: a log is missing or has changed.
        OutputError: the result has no scans or no covariances, or several frames.
    """
    if config.min_range_m >= config.max_range_m:
        raise ConfigError(
            f"changes.min_range_m: must be below changes.max_range_m, which is "
            f"{config.max_range_m:g}, got {config.min_range_m:g}"
        )
    check_one_frame(saved, directory)
    logs = saved.summary["logs"]
    log = open_logs([Path(entry["path"]) for entry in logs], saved.config)
    for entry, file in zip(logs, log.files, strict=True):
        if entry["sha256"] != file.sha256:
            raise LogError(f"{file.path}: is not the log that {directory} was smoothed from")
    laser_poses: dict[tuple[str, int], tuple[Array, Array]] = {}
    for name, robot in saved.robots.items():
        if robot.scan_final is None:
            continue
        if not np.isfinite(robot.final.covs).all():
            raise OutputError(
                f"{directory}: {name} has no covariances; smooth its log with another back end"
            )
        laser = trajectory_of_mount(robot.final, between(robot.final.poses, robot.scan_final.poses))
        laser_poses |= {
            (name, int(stamp)): (pose, cov)
            for stamp, pose, cov in zip(laser.stamps_ns, laser.poses, laser.covs, strict=True)
        }
    scans = [
        message
        for message in log.messages()
        if isinstance(message, Scan) and (message.robot, message.stamp_ns) in laser_poses
    ]
    if not scans:
        raise OutputError(f"{directory}: has no laser scans to compare")
    poses, covs = zip(*(laser_poses[scan.robot, scan.stamp_ns] for scan in scans), strict=True)
    stamps = np.array([scan.stamp_ns for scan in scans], dtype=np.int64)
    sweeps = [
        (s.angles, s.ranges) if s.angle_step_rad > 0 else (s.angles[::-1], s.ranges[::-1])
        for s in scans
    ]
    # of a known map, what this log did not see is not of this visit
    unseen = set(saved.summary.get("known_map", {}).get("unseen", ()))
    landmarks = tuple(one for one in saved.landmarks if one.id not in unseen)
    visit = visit_from_scans(stamps, np.array(poses), np.array(covs), sweeps, landmarks, config)
    names = tuple(scan.robot for scan in scans)
    recordings = {
        name: frozenset(one.sha256 for one in log.recordings_of(name)) for name in set(names)
    }
    robots = len({name for name, _ in laser_poses})
    return replace(visit, robots=robots, names=names, recordings=recordings)


def select_time_span(visit: Visit, span_s: tuple[float, float], what: str) -> Visit:
    """The scans of a time span, s since the visit's first scan.

    Raises:
        OutputError: there is none; ``what`` names the span in the message.
    """
    seconds = (visit.stamps_ns - visit.stamps_ns.min()) * 1e-9
    chosen = (seconds >= span_s[0]) & (seconds <= span_s[1])
    if not chosen.any():
        raise OutputError(
            f"{what} {span_s[0]:g}:{span_s[1]:g}: no scan in it; the scans span 0:{seconds.max():g}"
        )
    return visit.select(chosen)


def pose_to_dict(pose: Array, cov: Array) -> dict[str, Any]:
    """A pose (3,) m, rad with its covariance (3, 3), as in changes.json."""
    x, y, phi = pose.tolist()
    return {"x": x, "y": y, "phi": phi, "covariance": cov.tolist()}
