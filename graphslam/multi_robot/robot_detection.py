"""Robots looked for in each other's scans, where the joint estimate expects them.

What is found becomes a `Sighting`, as if a camera had made it, and its returns leave the scan, so
that no landmark is made of them. The cluster must have the outline's shape, lie where the robot can
be, and be the only one that does. Returns of unknown things that move leave the scan too.
"""

from collections import Counter, defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Protocol

import numpy as np

from graphslam.core.config import FrontEndConfig
from graphslam.core.gaussian import chi2_quantile
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
from graphslam.estimation.backend import Backend, Joint
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

#: a robot is where it is expected with this probability
GATE_PROBABILITY = 0.999
#: m: how much the models of motion and outline may be off beyond what they say
SLACK_M = 0.05
#: another cluster must be this much farther off, in squared sigmas
RIVAL = 9.0
#: clusters that are fitted per robot, the nearest first
CANDIDATES = 3
#: m: returns this near to a robot may be of its edges, its wheels, its cables
MARGIN_M = 0.1
#: m: where a robot is known less well and not found, nothing is taken for its returns
KNOWN_M = 0.3
#: m, rad: a robot is looked for again once it or the observer moved so much
AGAIN_M, AGAIN_RAD = 0.1, 0.1
#: ns: over which a robot's speed is taken
SPEED_NS = 300_000_000
#: scans, the last ones, in which things that move may have been looked through
EARLIER = 4
#: scans that are kept, and ns between them where the observer stands
STORED, STORED_NS = 8, 1_000_000_000

#: an earlier scan, and the pose (3,) of the laser now in the frame of the laser then
View = tuple[Sweep, Array]
Flags = np.ndarray[tuple[int], np.dtype[np.bool_]]


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedPose:
    """Where a robot should be: ``pose`` (3,) and ``cov`` (3, 3) in the observer's base frame."""

    pose: Array
    cov: Array


@dataclass(frozen=True, slots=True, eq=False)
class DetectedRobots:
    """A scan without the returns of robots, and the sightings made of them."""

    scan: Scan
    sightings: tuple[Sighting, ...]


def expected_pose(
    joint: Joint, motion: Motion | None, other: Motion | None, doubt: Array
) -> ExpectedPose:
    """Where another robot should be seen, from the joint estimate of both robots' latest states.

    Args:
        joint: of the observer, and of the other robot as the first of its others.
        motion: of the observer since its state; None if there is none.
        other: the same of the other robot.
        doubt: (2,) m, its own axes: what the other robot drives within the time by which their
            clocks may differ.
    """
    x, t = joint.pose, joint.others[0]
    block = joint.slices[-len(joint.others)]
    at = np.r_[0:3, block.start : block.stop]
    P = joint.cov[np.ix_(at, at)].copy()
    for place, since in ((slice(0, 3), motion), (slice(3, 6), other)):
        if since is None:
            continue
        start = x if place.start == 0 else t
        F, W = compose_jacobians(start, since.delta)
        P[place] = F @ P[place]
        P[:, place] = P[:, place] @ F.T
        P[place, place] += W @ since.cov @ W.T
        if place.start == 0:
            x = compose(x, since.delta)
        else:
            t = compose(t, since.delta)
    h = between(x, t)
    H = np.hstack(MODELS["robot-pose"].jacobians(h, x, t))
    cov = rotate_cov(H @ P @ H.T, h[2])
    v = rotation(float(h[2])) @ doubt
    cov[:2, :2] += np.outer(v, v)
    return ExpectedPose(h, cov)


def detect_robots(
    scan: Scan,
    robots: Mapping[str, ExpectedPose],
    outlines: Mapping[str, Array],
    config: FrontEndConfig,
    elsewhere: Mapping[str, Sequence[View]] = MappingProxyType({}),
) -> DetectedRobots:
    """Find the robots of a scan.

    Args:
        scan: the scan.
        robots: name -> where it should be.
        outlines: name -> corners (k, 2), m, base frame.
        config: of the front end.
        elsewhere: name -> earlier scans at times when the robot was somewhere else: what stood
            there then is not the robot.
    """
    sweep = make_sweep(scan, config.max_range_m)
    gone = np.zeros(len(sweep.beam), dtype=np.bool_)
    sightings = []
    for name, there in robots.items():
        pose = between(scan.mount, there.pose)
        cov = rotate_cov(there.cov, -float(scan.mount[2]))
        fits = _fit_clusters(sweep, outlines[name], pose, cov, config, elsewhere.get(name, ()))
        one = fits[0] if fits else None
        if one is not None and (len(fits) == 1 or fits[1][0] > one[0] + RIVAL):
            sightings.append(_sighting(scan, name, one[1]))
        places = [fit.pose for _, fit in fits]
        if not fits and np.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1]) < KNOWN_M:
            places = [pose]
        for place in places:
            gone |= _near(sweep, place, outline_radius(outlines[name]) + MARGIN_M)
    if not gone.any():
        return DetectedRobots(scan, tuple(sightings))
    return DetectedRobots(_without_returns(scan, sweep, gone), tuple(sightings))


def _fit_clusters(
    sweep: Sweep,
    outline: Array,
    pose: Array,
    cov: Array,
    config: FrontEndConfig,
    elsewhere: Sequence[View],
) -> list[tuple[float, OutlineFit]]:
    """Clusters that can be the robot, as squared distance from what is expected and fit; by it."""
    size = 2 * outline_radius(outline)
    found = free_standing_clusters(sweep, size + MARGIN_M)
    near = np.hypot(*(cluster_centres(sweep, found) - pose[:2]).T) if len(found) else np.zeros(0)
    spread = float(np.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1]))
    enough = found.last - found.first + 1 >= MIN_RETURNS
    use = np.flatnonzero(enough & (near < 4 * (spread + SLACK_M) + size))
    fits = []
    for k in use[np.argsort(near[use], kind="stable")][:CANDIDATES]:
        sigma = min(float(np.sqrt(cov[2, 2])), 0.5)
        span = int(found.first[k]), int(found.last[k])
        fit = fit_outline(sweep, *span, found.unoccluded[k], outline, pose, sigma, config)
        if not fit.is_plausible:
            continue
        n = 3 if fit.heading_found else 2
        off = fit.pose - pose
        off[2] = wrap(off[2])
        S = cov[:n, :n] + fit.cov[:n, :n] + SLACK_M**2 * np.eye(n)
        d2 = float(off[:n] @ np.linalg.solve(S, off[:n]))
        points = sweep.points[span[0] : span[1] + 1]
        old = any(was_present(points, before, here) for before, here in elsewhere)
        if d2 < chi2_quantile(GATE_PROBABILITY, n) and not old:
            fits.append((d2, fit))
    return sorted(fits, key=lambda one: one[0])


def _sighting(scan: Scan, name: str, fit: OutlineFit) -> Sighting:
    """A fit as bearing and range, with direction where it was found."""
    x, y, phi = fit.pose
    r2 = x * x + y * y
    r = np.sqrt(r2)
    J = np.array([[-y / r2, x / r2, 0.0], [x / r, y / r, 0.0], [0.0, 0.0, 1.0]])
    n = 3 if fit.heading_found else 2
    z = np.array([np.arctan2(y, x), r, wrap(phi)])[:n]
    cov = (J @ fit.cov @ J.T)[:n, :n]
    return Sighting(scan.robot, scan.stamp_ns, scan.time_ns, z, cov, None, name, scan.mount)


def _near(sweep: Sweep, pose: Array, radius_m: float) -> Flags:
    """Which returns (k,) lie around a pose (3,)."""
    return np.asarray(np.hypot(*(sweep.points - pose[:2]).T) < radius_m)


def _without_returns(scan: Scan, sweep: Sweep, gone: Flags) -> Scan:
    """The scan without returns of rows ``gone`` (k,) of its sweep."""
    angles = sweep.angles[sweep.beam[gone]]
    beams = np.rint((angles - scan.angle_min_rad) / scan.angle_step_rad).astype(np.int64)
    ranges = scan.ranges.copy()
    ranges[beams % len(ranges)] = np.nan
    return replace(scan, ranges=ranges)


def _without_moving(scan: Scan, sweep: Sweep, views: Sequence[tuple[int, View]]) -> Scan:
    """The scan, of which ``sweep`` is made, without things that move."""
    gone = dynamic_returns(sweep, [view for _, view in views[-EARLIER:]])
    return _without_returns(scan, sweep, gone) if gone.any() else scan


class TrackedRobot(Protocol):
    """What the detector asks of a robot: its odometry track and the time of its latest state."""

    @property
    def track(self) -> Track:
        """Odometry of the robot."""

    @property
    def state_ns(self) -> int:
        """Time of the latest state; -1 before the first."""


class RobotDetector:
    """Looks at every scan for the other robots, and for what moves.

    ``sightings`` are all that were made; ``counts`` returns that left scans, by reason.
    """

    def __init__(
        self,
        backend: Backend,
        runs: Mapping[str, TrackedRobot],
        outlines: Mapping[str, Array],
        config: FrontEndConfig,
        doubt_s: float,
    ) -> None:
        """``doubt_s``: sigma of the difference of two robots' clocks."""
        self.sightings: list[Sighting] = []
        self.counts: Counter[str] = Counter()
        self.outlines = outlines
        self._backend, self._runs, self._config, self._doubt_s = backend, runs, config, doubt_s
        self._looked: dict[tuple[str, str], int] = {}
        self._earlier: dict[str, deque[tuple[int, Sweep]]] = defaultdict(
            lambda: deque(maxlen=STORED)
        )

    def process(
        self, scan: Scan, used: bool, start: Callable[[str, int], bool]
    ) -> tuple[Scan | Sighting, ...]:
        """What of a scan is to be used.

        Args:
            scan: as recorded.
            used: whether landmarks are wanted of it; else only robots that moved since they were
                last looked for.
            start: sees to it that a robot has a state, and says whether it has one.

        Returns:
            The scan, if it is used, without the returns of robots and other things that move; and
            sightings of robots.
        """
        others = {
            name: self._expected(scan, name)
            for name in self.outlines
            if name != scan.robot and (used or self._due(scan, name)) and start(name, scan.time_ns)
        }
        for name in others:
            self._looked[scan.robot, name] = scan.time_ns
        if not (used or others):
            return ()
        sweep = make_sweep(scan, self._config.max_range_m)
        views = self._views(scan, STORED if others else EARLIER)
        elsewhere = {name: self._elsewhere(scan, name, views) for name in others}
        found = DetectedRobots(scan, ())
        if others:
            found = detect_robots(scan, others, self.outlines, self._config, elsewhere)
        self.sightings += found.sightings
        last = self._earlier[scan.robot]
        if used or (others and (not last or scan.time_ns - last[-1][0] >= STORED_NS)):
            last.append((scan.time_ns, sweep))
        if not used:
            return found.sightings
        self._count("robot", scan, found.scan)
        if self._config.dynamic_objects == "keep":
            return (found.scan, *found.sightings)
        if found.scan is not scan:
            sweep = make_sweep(found.scan, self._config.max_range_m)
        still = _without_moving(found.scan, sweep, views)
        self._count("thing that moves", found.scan, still)
        return (still, *found.sightings)

    def _views(self, scan: Scan, count: int) -> list[tuple[int, View]]:
        """The observer's latest scans before, so many at most, with their times."""
        earlier = list(self._earlier[scan.robot])[-count:]
        if not earlier:
            return []
        times = np.array([*(time_ns for time_ns, _ in earlier), scan.time_ns], dtype=np.int64)
        poses = self._runs[scan.robot].track.mounted_pose(times)
        moved = between(poses[:-1], poses[-1])
        lasers = compose(compose(inverse(scan.mount), moved), scan.mount)
        return [(t, (sweep, laser)) for (t, sweep), laser in zip(earlier, lasers, strict=True)]

    def _elsewhere(self, scan: Scan, name: str, views: Sequence[tuple[int, View]]) -> list[View]:
        """Earlier scans at times when a robot was where it cannot be taken for itself of now."""
        track, size = self._runs[name].track, 2 * outline_radius(self.outlines[name])
        times = np.array([scan.time_ns, *(time_ns for time_ns, _ in views)], dtype=np.int64)
        away = np.hypot(*(between(track.pose(times[:1]), track.pose(times[1:]))[:, :2]).T) > size
        return [view for (_, view), far in zip(views, away, strict=True) if far]

    def _count(self, what: str, before: Scan, after: Scan) -> None:
        if after is not before:
            gone = np.isfinite(before.ranges) & ~np.isfinite(after.ranges)
            self.counts[f"range: of a {what}"] += int(gone.sum())

    def _due(self, scan: Scan, name: str) -> bool:
        """Whether observer or robot moved enough since it was last looked for."""
        last_ns = self._looked.get((scan.robot, name))
        if last_ns is None:
            return True
        for robot in (scan.robot, name):
            path_m, turned_rad = self._runs[robot].track.moved(last_ns, scan.time_ns)
            if path_m >= AGAIN_M or turned_rad >= AGAIN_RAD:
                return True
        return False

    def _expected(self, scan: Scan, name: str) -> ExpectedPose:
        other = self._runs[name].track
        around = scan.time_ns - SPEED_NS, scan.time_ns + SPEED_NS
        doubt = other.motion(*around).delta[:2] * self._doubt_s / (2e-9 * SPEED_NS)
        joint = self._backend.joint(scan.robot, [], [name])
        since = (self._since(scan.robot, scan.time_ns), self._since(name, scan.time_ns))
        return expected_pose(joint, since[0], since[1], doubt)

    def _since(self, robot: str, time_ns: int) -> Motion | None:
        """Motion since the robot's latest state."""
        run = self._runs[robot]
        return run.track.motion(run.state_ns, time_ns) if time_ns > run.state_ns else None
