"""What one visit measured and from where: the scans of a result folder with their laser poses."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphslam.core.errors import LogError, OutputError
from graphslam.core.geometry import Array, between, compose, compose_cov, polar_points, unit_vectors
from graphslam.core.records import Landmark, Scan
from graphslam.logs import open_logs
from graphslam.odometry.interpolation import mounted
from graphslam.results.folder import SavedResult

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

#: a return farther from the next beam's than this share of its range + this length, m, stands at
#: an edge: where a beam meets two surfaces its range is that of neither. What recedes faster than
#: this is seen at a grazing angle and tells little.
EDGE_SHARE, EDGE_M = 0.025, 0.06
#: nearer than this, m, a laser sees its own vehicle, dust, or means an error code
LEAST_M = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Visit:
    """All beams of one visit, flat; every pose in one world frame.

    Attributes:
        stamps_ns: (s,) of the scans.
        poses: (s, 3) of the laser.
        covs: (s, 3, 3) of additive world-axis errors.
        shared: (s, 3, 3) the part of them that may be the same in all scans; the rest is each
            scan's own.
        scan: (n,) which scan a beam belongs to; beams of a scan are neighbours in bearing.
        angle: (n,) rad in the laser's frame.
        range_m: (n,) NaN where nothing usable came back.
        surface: (n,) whether the return is on a surface: not an edge, not alone.
        landmarks: the map of the run.
        robots: how many robots' scans these are; neighbours in time are of one robot only if 1.
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

    @property
    def directions(self) -> Array:
        """Unit vectors (n, 2) of the beams in the world."""
        heading = self.poses[self.scan, 2] + self.angle
        return unit_vectors(heading)

    @property
    def ends(self) -> Array:
        """World points (n, 2) m that the beams reached."""
        return np.asarray(self.poses[self.scan, :2] + self.range_m[:, None] * self.directions)

    def transformed(self, pose: Array, cov: Array) -> "Visit":
        """The same visit after its world frame was put at ``pose`` (3,) with ``cov`` (3, 3)."""
        at = np.broadcast_to(pose, self.poses.shape)
        covs = compose_cov(at, np.broadcast_to(cov, self.covs.shape), self.poses, self.covs)
        return replace(self, poses=compose(at, self.poses), covs=covs, shared=covs)

    def select(self, scans: Bools) -> "Visit":
        """Only some scans; ``scans`` (s,) says which."""
        number = np.cumsum(scans) - 1
        beams = scans[self.scan]
        return Visit(
            self.stamps_ns[scans],
            self.poses[scans],
            self.covs[scans],
            self.shared[scans],
            number[self.scan[beams]],
            self.angle[beams],
            self.range_m[beams],
            self.surface[beams],
            self.landmarks,
            self.robots,
        )


def visit_from_scans(
    stamps_ns: Ints,
    poses: Array,
    covs: Array,
    sweeps: Sequence[tuple[Array, Array]],
    landmarks: tuple[Landmark, ...] = (),
) -> Visit:
    """A visit from scans.

    Args:
        stamps_ns: (s,).
        poses: (s, 3) of the laser in the world.
        covs: (s, 3, 3).
        sweeps: per scan its bearings (k,) rad, ascending, and ranges (k,) m, NaN without a return.
        landmarks: of the run's map.
    """
    counts = [len(angles) for angles, _ in sweeps]
    return Visit(
        stamps_ns,
        poses,
        covs,
        covs,
        np.repeat(np.arange(len(sweeps)), counts),
        np.concatenate([angles for angles, _ in sweeps]),
        np.concatenate([ranges for _, ranges in sweeps]),
        np.concatenate([on_surface(angles, ranges) for angles, ranges in sweeps]),
        landmarks,
    )


def on_surface(angles: Array, ranges: Array) -> Bools:
    """Which returns (k,) have neighbours close by on both sides.

    Args:
        angles: (k,) rad.
        ranges: (k,) m, NaN without a return.
    """
    points = polar_points(ranges, angles)
    gap = np.hypot(*np.diff(points, axis=0).T)
    nearer = np.fmin(ranges[1:], ranges[:-1])
    gap[nearer < LEAST_M] = np.inf
    joined = gap < EDGE_M + EDGE_SHARE * nearer  # false with NaN
    joined = np.concatenate([[False], joined, [False]])
    return np.asarray(joined[1:] & joined[:-1])


def load_visit(saved: SavedResult, directory: Path) -> Visit:
    """The scans of a result folder: ranges from the logs it names, poses from the folder.

    Raises:
        LogError: a log is gone or is another one now.
        OutputError: the result has no scans or no covariances.
    """
    logs = saved.summary["logs"]
    log = open_logs([Path(entry["path"]) for entry in logs], saved.config)
    for entry, file in zip(logs, log.files, strict=True):
        if entry["sha256"] != file.sha256:
            raise LogError(f"{file.path}: is not the log that {directory} was smoothed from")
    stamps, poses, covs, sweeps = [], [], [], []
    known: dict[tuple[str, int], tuple[Array, Array]] = {}
    for name, robot in saved.robots.items():
        if robot.scan_final is None:
            continue
        if not np.isfinite(robot.final.covs).all():
            raise OutputError(
                f"{directory}: {name} has no covariances; smooth its log with another back end"
            )
        laser = mounted(robot.final, between(robot.final.poses, robot.scan_final.poses))
        known |= {
            (name, int(stamp)): (pose, cov)
            for stamp, pose, cov in zip(laser.stamps_ns, laser.poses, laser.covs, strict=True)
        }
    for message in log.messages():
        if isinstance(message, Scan) and (message.robot, message.stamp_ns) in known:
            pose, cov = known[message.robot, message.stamp_ns]
            stamps.append(message.stamp_ns)
            poses.append(pose)
            covs.append(cov)
            order = slice(None) if message.angle_step_rad > 0 else slice(None, None, -1)
            sweeps.append((message.angles[order], message.ranges[order]))
    if not stamps:
        raise OutputError(f"{directory}: has no laser scans to compare")
    visit = visit_from_scans(
        np.array(stamps, dtype=np.int64), np.array(poses), np.array(covs), sweeps, saved.landmarks
    )
    return replace(visit, robots=len({name for name, _ in known}))


def select_time_span(visit: Visit, span_s: tuple[float, float], what: str) -> Visit:
    """The scans of a time span, s since the visit's first scan.

    Raises:
        OutputError: there is none; ``what`` names the span.
    """
    seconds = (visit.stamps_ns - visit.stamps_ns.min()) * 1e-9
    chosen = (seconds >= span_s[0]) & (seconds <= span_s[1])
    if not chosen.any():
        raise OutputError(
            f"{what} {span_s[0]:g}:{span_s[1]:g}: no scan in it; the scans span 0:{seconds.max():g}"
        )
    return visit.select(chosen)


def pose_to_dict(pose: Array, cov: Array) -> dict[str, Any]:
    """A pose (3,) m, rad with covariance (3, 3) as in changes.json."""
    x, y, phi = pose.tolist()
    return {"x": x, "y": y, "phi": phi, "covariance": cov.tolist()}
