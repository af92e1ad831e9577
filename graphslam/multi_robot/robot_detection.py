"""Detection of robots in each other's scans, where the joint estimate expects them.

A detection becomes a `Sighting`, like one of a camera. Its returns are removed from the scan, so
that they create no landmark. A cluster is accepted as the robot if it has the outline's shape, is
the only one within the gate of the expected pose, and cannot be another robot as well. Returns of
unknown dynamic objects are removed too. Robots of unknown start are detected by `mutual_detection`.
"""

from collections import Counter, defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Protocol

import numpy as np

from graphslam.core.arrays import BoolArray
from graphslam.core.config import Config, FrontEndConfig
from graphslam.core.consistency import RIVAL_D2
from graphslam.core.gaussian import chi2_quantile, mahalanobis_squared, move_block
from graphslam.core.geometry import (
    Array,
    between,
    compose,
    compose_jacobians,
    inverse,
    rotate_cov,
    rotation,
    wrap,
)
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Motion, Scan, Sighting
from graphslam.estimation.backend import Backend, JointMarginal
from graphslam.odometry.preintegration import Track
from graphslam.perception.dynamic_objects import dynamic_returns, was_present
from graphslam.perception.ordered_scan import Sweep, make_sweep
from graphslam.perception.robot_outlines import (
    MIN_RETURNS,
    OutlineFit,
    cluster_centres,
    fit_outline,
    free_standing_clusters,
    outline_radius,
)

#: probability of the gate around the expected pose
GATE_PROBABILITY = 0.999
#: m: error of the motion and outline models beyond their covariance
MODEL_SIGMA_M = 0.05
#: clusters that are fitted per robot, the nearest first
MAX_CLUSTERS = 3
#: m: returns this near to a robot's outline may be of its edges, its wheels, its cables
MARGIN_M = 0.1
#: m: a position known less well, about the radius of a robot, does not tell which returns are the
#: robot's
MAX_POSITION_SIGMA_M = 0.3
#: rad: a robot is looked for again once it or the observer turned so much, or moved by
#: `multi_robot.sampling_m`
SAMPLING_RAD = 0.1
#: ns: half the span over which a robot's velocity is taken
HALF_SPAN_NS = 300_000_000
#: number of earlier scans that may show free space at a dynamic object
COMPARED_SCANS = 4
#: number of scans that are kept, and ns between them where the observer stands
KEPT_SCANS, KEPT_INTERVAL_NS = 8, 1_000_000_000

#: an earlier scan, and the present pose (3,) of the laser in the frame of the laser then
View = tuple[Sweep, Array]


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedPose:
    """Predicted pose of a robot: ``pose`` (3,), ``cov`` (3, 3) in the observer's base frame."""

    pose: Array
    cov: Array


def expected_pose(
    joint: JointMarginal, motion: Motion | None, other: Motion | None, clock_shift: Array
) -> ExpectedPose:
    """Pose of another robot as seen from the observer, from the joint estimate of their states.

    Args:
        joint: of the observer, and of the other robot as the first of its others.
        motion: of the observer since its state; None if there is none.
        other: the same of the other robot.
        clock_shift: (2,) m, along the other robot's axes: what it drives within one sigma of the
            offset of their clocks.
    """
    poses, since = [joint.pose, joint.others[0]], (motion, other)
    block = joint.slices[-len(joint.others)]
    at = np.r_[0:3, block.start : block.stop]
    P = joint.cov[np.ix_(at, at)].copy()
    for k, own in enumerate((slice(0, 3), slice(3, 6))):
        step = since[k]
        if step is None:
            continue
        F, W = compose_jacobians(poses[k], step.delta)
        move_block(P, own, F, W @ step.cov @ W.T)
        poses[k] = compose(poses[k], step.delta)
    h = between(poses[0], poses[1])
    H = np.hstack(MODELS["robot-pose"].jacobians(h, *poses))
    cov = rotate_cov(H @ P @ H.T, h[2])
    v = rotation(float(h[2])) @ clock_shift
    cov[:2, :2] += np.outer(v, v)
    return ExpectedPose(h, cov)


@dataclass(frozen=True, slots=True, eq=False)
class DetectedRobots:
    """A scan without the returns of robots, and the sightings made from them."""

    scan: Scan
    sightings: tuple[Sighting, ...]


def detect_robots(
    scan: Scan,
    robots: Mapping[str, ExpectedPose],
    outlines: Mapping[str, Array],
    config: FrontEndConfig,
    without_robot: Mapping[str, Sequence[View]] = MappingProxyType({}),
) -> DetectedRobots:
    """Detect robots in a scan.

    Args:
        scan: the scan.
        robots: name -> expected pose.
        outlines: name -> corners (k, 2), m, base frame.
        config: of the front end.
        without_robot: name -> earlier scans when the robot was somewhere else: what stood there
            already is not the robot.
    """
    sweep = make_sweep(scan, config.max_range_m)
    gone = np.zeros(len(sweep.beam), dtype=np.bool_)
    found: dict[str, list[_Candidate]] = {}
    for name, expected in robots.items():
        pose = between(scan.mount, expected.pose)
        cov = rotate_cov(expected.cov, -float(scan.mount[2]))
        fits = _fit_clusters(sweep, outlines[name], pose, cov, config, without_robot.get(name, ()))
        found[name] = fits
        poses = [one.fit.pose for one in fits]
        if not fits and np.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1]) < MAX_POSITION_SIGMA_M:
            poses = [pose]
        for at in poses:
            radius_m = outline_radius(outlines[name]) + MARGIN_M
            gone |= np.hypot(*(sweep.points - at[:2]).T) < radius_m
    sightings = [
        _sighting(scan, name, found[name][0].fit) for name in found if _is_seen(name, found)
    ]
    if not gone.any():
        return DetectedRobots(scan, tuple(sightings))
    return DetectedRobots(without_returns(scan, sweep, gone), tuple(sightings))


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A cluster that may be a robot: ``cluster`` is its number in the scan, ``fit`` of the outline.

    ``d2``: squared distance from the expected pose. ``cost``: minus twice the logarithm of how
    likely the cluster's returns are if it is this robot, to compare robots by: that of the outline
    at the best pose, times the share of the expected poses that this fit leaves (Laplace).
    """

    cluster: int
    fit: OutlineFit
    d2: float
    cost: float


def _is_seen(name: str, found: Mapping[str, Sequence[_Candidate]]) -> bool:
    """Whether the first candidate of a robot is the robot: no other cluster, and no other robot.

    One of two robots that a cluster may be is hidden or beside its place, and nothing tells which.
    """
    if not found[name]:
        return False
    best, *others = found[name]
    if others and others[0].d2 <= best.d2 + RIVAL_D2:
        return False
    rivals = (one for other, fits in found.items() if other != name for one in fits)
    return all(r.cluster != best.cluster or r.cost > best.cost + RIVAL_D2 for r in rivals)


def _fit_clusters(
    sweep: Sweep,
    outline: Array,
    pose: Array,
    cov: Array,
    config: FrontEndConfig,
    without_robot: Sequence[View],
) -> list[_Candidate]:
    """Clusters in the gate of the expected pose ``pose`` (3,), ``cov`` (3, 3); nearest first."""
    size = 2 * outline_radius(outline)
    found = free_standing_clusters(sweep, size + MARGIN_M)
    near = np.hypot(*(cluster_centres(sweep, found) - pose[:2]).T) if len(found) else np.zeros(0)
    spread = float(np.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1]))
    enough = found.last - found.first + 1 >= MIN_RETURNS
    use = np.flatnonzero(enough & (near < 4 * (spread + MODEL_SIGMA_M) + size))
    fits = []
    for k in use[np.argsort(near[use], kind="stable")][:MAX_CLUSTERS]:
        sigma = min(float(np.sqrt(cov[2, 2])), 0.5)
        span = int(found.first[k]), int(found.last[k])
        fit = fit_outline(sweep, *span, found.unoccluded[k], outline, pose, sigma, config)
        if not fit.is_plausible:
            continue
        n = 3 if fit.heading_found else 2
        off = fit.pose - pose
        off[2] = wrap(off[2])
        P = fit.cov[:n, :n] + MODEL_SIGMA_M**2 * np.eye(n)
        S = cov[:n, :n] + P
        d2 = float(mahalanobis_squared(off[:n], S))
        points = sweep.points[span[0] : span[1] + 1]
        stood = any(was_present(points, before, here) for before, here in without_robot)
        if d2 < chi2_quantile(GATE_PROBABILITY, n) and not stood:
            wider = np.linalg.slogdet(S)[1] - np.linalg.slogdet(P)[1]
            fits.append(_Candidate(int(k), fit, d2, fit.chi2 + d2 + float(wider)))
    return sorted(fits, key=lambda one: one.d2)


def _sighting(scan: Scan, name: str, fit: OutlineFit) -> Sighting:
    """A fit as bearing and range, and heading if it was determined."""
    x, y, phi = fit.pose
    r2 = x * x + y * y
    r = np.sqrt(r2)
    J = np.array([[-y / r2, x / r2, 0.0], [x / r, y / r, 0.0], [0.0, 0.0, 1.0]])
    n = 3 if fit.heading_found else 2
    z = np.array([np.arctan2(y, x), r, wrap(phi)])[:n]
    cov = (J @ fit.cov @ J.T)[:n, :n]
    return Sighting(scan.robot, scan.stamp_ns, scan.time_ns, z, cov, None, name, scan.mount)


def without_returns(scan: Scan, sweep: Sweep, gone: BoolArray) -> Scan:
    """The scan without returns of rows ``gone`` (k,) of its sweep."""
    # a sweep has the beams in another order; those of a deskewed scan are not equally spaced
    angles, order = sweep.angles[sweep.beam[gone]], np.argsort(scan.angles)
    beams = order[np.searchsorted(scan.angles, angles, sorter=order)]
    ranges = scan.ranges.copy()
    ranges[beams] = np.nan
    return replace(scan, ranges=ranges)


def without_moving(scan: Scan, sweep: Sweep, views: Sequence[tuple[int, View]]) -> Scan:
    """The scan, whose returns are ``sweep``, without dynamic objects."""
    gone = dynamic_returns(sweep, [view for _, view in views[-COMPARED_SCANS:]])
    return without_returns(scan, sweep, gone) if gone.any() else scan


class TrackedRobot(Protocol):
    """What the detector needs of a robot: its odometry track and the time of its latest state."""

    @property
    def track(self) -> Track:
        """Odometry of the robot."""

    @property
    def state_ns(self) -> int:
        """Time of the latest state; -1 before the first."""


class RobotDetector:
    """Detects the other robots and dynamic objects in every scan.

    ``sightings``: all that were made; ``counts``: returns that were removed from scans, by reason.
    """

    def __init__(
        self,
        backend: Backend,
        robots: Mapping[str, TrackedRobot],
        outlines: Mapping[str, Array],
        config: Config,
        clock_sigma_s: float,
    ) -> None:
        """``clock_sigma_s``: sigma of the offset of two robots' clocks."""
        self.sightings: list[Sighting] = []
        self.counts: Counter[str] = Counter()
        self.outlines = outlines
        self._backend, self._robots, self._clock_sigma_s = backend, robots, clock_sigma_s
        self._config, self._sampling_m = config.front_end, config.multi_robot.sampling_m
        self._looked_ns: dict[tuple[str, str], int] = {}
        self._earlier: dict[str, deque[tuple[int, Sweep]]] = defaultdict(
            lambda: deque(maxlen=KEPT_SCANS)
        )

    def process(
        self, scan: Scan, used: bool, start: Callable[[str, int], bool]
    ) -> tuple[Scan | Sighting, ...]:
        """Split a scan into what the front end uses of it and sightings of robots.

        Args:
            scan: as recorded.
            used: whether the front end uses it; else it is searched for robots that moved since
                they were last looked for.
            start: gives a robot its first state if it can have one at a time, ns, and returns
                whether it has one.

        Returns:
            The scan, if it is used, without the returns of robots and dynamic objects; and the
            sightings.
        """
        others = {
            name: self._expected(scan, name)
            for name in self.outlines
            if name != scan.robot and (used or self._due(scan, name)) and start(name, scan.time_ns)
        }
        for name in others:
            self._looked_ns[scan.robot, name] = scan.time_ns
        if not (used or others):
            return ()
        sweep = make_sweep(scan, self._config.max_range_m)
        views = self._views(scan, KEPT_SCANS if others else COMPARED_SCANS)
        without_robot = {name: self._without_robot(scan, name, views) for name in others}
        found = DetectedRobots(scan, ())
        if others:
            found = detect_robots(scan, others, self.outlines, self._config, without_robot)
        self.sightings += found.sightings
        last = self._earlier[scan.robot]
        if used or (others and (not last or scan.time_ns - last[-1][0] >= KEPT_INTERVAL_NS)):
            last.append((scan.time_ns, sweep))
        if not used:
            return found.sightings
        self._count("robot", scan, found.scan)
        if self._config.dynamic_objects == "keep":
            return (found.scan, *found.sightings)
        if found.scan is not scan:
            sweep = make_sweep(found.scan, self._config.max_range_m)
        still = without_moving(found.scan, sweep, views)
        self._count("thing that moves", found.scan, still)
        return (still, *found.sightings)

    def _views(self, scan: Scan, count: int) -> list[tuple[int, View]]:
        """The observer's latest earlier scans, ``count`` at most, with their times."""
        earlier = list(self._earlier[scan.robot])[-count:]
        if not earlier:
            return []
        times = np.array([*(time_ns for time_ns, _ in earlier), scan.time_ns], dtype=np.int64)
        poses = self._robots[scan.robot].track.mounted_pose(times)
        moved = between(poses[:-1], poses[-1])
        lasers = compose(compose(inverse(scan.mount), moved), scan.mount)
        return [(t, (sweep, laser)) for (t, sweep), laser in zip(earlier, lasers, strict=True)]

    def _without_robot(
        self, scan: Scan, name: str, views: Sequence[tuple[int, View]]
    ) -> list[View]:
        """Earlier scans taken when a robot was farther than its size from where it is now."""
        track, size = self._robots[name].track, 2 * outline_radius(self.outlines[name])
        times = np.array([scan.time_ns, *(time_ns for time_ns, _ in views)], dtype=np.int64)
        away = np.hypot(*(between(track.pose(times[:1]), track.pose(times[1:]))[:, :2]).T) > size
        return [view for (_, view), far in zip(views, away, strict=True) if far]

    def _count(self, what: str, before: Scan, after: Scan) -> None:
        if after is not before:
            gone = np.isfinite(before.ranges) & ~np.isfinite(after.ranges)
            self.counts[f"range: of a {what}"] += int(gone.sum())

    def _due(self, scan: Scan, name: str) -> bool:
        """Whether observer or robot moved enough since it was last looked for."""
        last_ns = self._looked_ns.get((scan.robot, name))
        if last_ns is None:
            return True
        for robot in (scan.robot, name):
            path_m, turned_rad = self._robots[robot].track.moved(last_ns, scan.time_ns)
            if path_m >= self._sampling_m or turned_rad >= SAMPLING_RAD:
                return True
        return False

    def _expected(self, scan: Scan, name: str) -> ExpectedPose:
        around = scan.time_ns - HALF_SPAN_NS, scan.time_ns + HALF_SPAN_NS
        driven = self._robots[name].track.motion(*around).delta[:2]
        joint = self._backend.joint(scan.robot, [], [name])
        own, other = (self._since(robot, scan.time_ns) for robot in (scan.robot, name))
        clock_shift = driven * self._clock_sigma_s / (2e-9 * HALF_SPAN_NS)
        return expected_pose(joint, own, other, clock_shift)

    def _since(self, robot: str, time_ns: int) -> Motion | None:
        """Motion since the robot's latest state."""
        run = self._robots[robot]
        return run.track.motion(run.state_ns, time_ns) if time_ns > run.state_ns else None
