"""Odometry of a robot that reports none: each scan aligned with those just before it.

A scan is aligned with a map of a few earlier scans, from a pose that is predicted at constant
velocity. The origin of the map is the *reference*, the latest of them; after some motion the scan
itself becomes the reference. So errors add up per reference, not per scan, and a robot that stands
does not drift.

What comes out are increments with covariances, as a robot could have reported them itself, so
nothing that follows has to know. The covariance of an alignment is that of the whole way from its
reference, of which each increment gets an equal share. In directions that the scans do not
determine it is that of a robot that drives anywhere (`OPEN_SIGMA_M`).
"""

from collections import deque
from collections.abc import Collection, Iterable, Iterator

import numpy as np

from graphslam.core.config import Config
from graphslam.core.geometry import Array, between, compose, exp, inverse, log, rotate_cov, rotation
from graphslam.core.records import Message, OdometryIncrement, Scan
from graphslam.odometry.sweep_motion import undistorted
from graphslam.perception.ordered_scan import scan_points
from graphslam.perception.scan_alignment import (
    align_scan,
    moved_scan,
    scan_map,
)
from graphslam.perception.scan_surfaces import scan_surfaces

#: a scan becomes the reference when the robot has moved or turned by this much since the last one,
#: or after so many scans: they are held in memory until then
REFERENCE_M, REFERENCE_RAD, REFERENCE_SCANS = 0.3, 0.25, 64
#: references in the map
MAP_SCANS = 16
#: sigmas of a prediction, m and rad per root of a second
PREDICTED_SIGMA_M, PREDICTED_SIGMA_RAD = 0.15, 0.3
#: sigmas where scans tell nothing, m and rad per root of a second: larger than of predictions, as
#: the error of a velocity goes on for many scans, but increments count as independent
OPEN_SIGMA_M, OPEN_SIGMA_RAD = 0.5, 1.0
#: s: the velocity is that of the last interval so long, at least, as stamps jitter; a prediction
#: goes no farther than the second
VELOCITY_S, PREDICTED_S = 0.3, 1.0
#: times between scans of which the mean is the usual one; no laser scans twice in this share of it:
#: such stamps are those of messages that waited and were recorded in a burst
PERIODS, BURST_SHARE = 32, 0.1
#: s: no time between two scans is shorter: stamps of a burst
SHORTEST_S = 1e-3
#: m/s and rad/s: half of the window in which a scan that fits nowhere is searched for, besides that
#: of `ScanMatchingConfig`, grows with the time since the one before; m: no farther than this
SEARCH_M_S, SEARCH_RAD_S, MOST_SEARCH_M = 1.0, 1.0, 3.0


class LaserOdometry:
    """The odometry of one robot by its scans."""

    def __init__(self, config: Config) -> None:
        """No scan yet."""
        self._config = config.scan_matching
        self._max_range_m = config.front_end.max_range_m
        self._scans: list[tuple[Array, Array]] = []  # of the map, the reference last
        self._last: Scan | None = None
        # of the last scan in the map: its pose, with errors as predicted and as stated
        self._pose, self._cov, self._stated = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
        self._ways: list[tuple[Scan, Scan, Array]] = []  # since the reference: from, to, increment
        self._recent: deque[tuple[float, Array]] = deque()  # s and increment: of `VELOCITY_S`
        self._periods: deque[float] = deque(maxlen=PERIODS)  # s between the last scans
        #: motion (3,) of the base to the last scan from that before
        self.increment = np.zeros(3)
        #: m: sigma of the position since the reference, in the direction that is known least
        self.sigma_m = 0.0
        #: rad: sigma of the heading since the reference
        self.sigma_rad = 0.0

    def add(self, scan: Scan) -> list[OdometryIncrement]:
        """Take in the next scan.

        Returns:
            Increments to all scans up to this one that had none; none until the next reference.
        """
        velocity = self._velocity()
        points = scan_points(undistorted(scan, _of_laser(velocity, scan.mount)), self._max_range_m)
        surfaces = scan_surfaces(points, scan.mount[:2], scan.angle_step_rad, self._config)
        shown = np.asarray(surfaces[1][: len(points)].any(axis=(1, 2)))
        last, self._last = self._last, scan
        if last is None:
            self._refer_to(points, surfaces, scan.mount)
            return []
        seconds = max(1e-9 * (scan.time_ns - last.time_ns), SHORTEST_S)
        moved = exp(min(seconds, PREDICTED_S) * velocity)
        before, guess = self._pose, compose(self._pose, moved)
        window = np.array([SEARCH_M_S, SEARCH_M_S, SEARCH_RAD_S]) * seconds
        window = np.minimum(window, [MOST_SEARCH_M, MOST_SEARCH_M, np.pi / 2])
        config = self._config
        window += [config.search_m, config.search_m, config.search_rad]
        self._periods.append(min(seconds, PREDICTED_S))
        usual_s = self._usual_s()
        late = (self._periods[-1] - usual_s) * velocity
        open_s = max(seconds, usual_s)
        cov = self._cov + _variances(PREDICTED_SIGMA_M, PREDICTED_SIGMA_RAD) * open_s
        cov += rotate_cov(np.outer(late, late), float(before[2]))
        found = align_scan(points, shown, self._map, guess, cov, before, window)
        self._pose, self._cov = found.pose, _updated(cov, found.information)
        stated = self._stated + _variances(OPEN_SIGMA_M, OPEN_SIGMA_RAD) * open_s
        self._stated = _updated(stated, found.information)
        self.increment = increment = between(before, found.pose)
        self.sigma_m = float(np.sqrt(np.linalg.eigvalsh(self._stated[:2, :2])[-1]))
        self.sigma_rad = float(np.sqrt(self._stated[2, 2]))
        self._ways.append((last, scan, increment))
        self._recent.append((seconds, increment))
        while sum(s for s, _ in self._recent) - self._recent[0][0] >= VELOCITY_S:
            self._recent.popleft()
        x, y, turned = found.pose
        near = np.hypot(x, y) < REFERENCE_M and abs(turned) < REFERENCE_RAD
        if near and found.share > 0.0 and len(self._ways) < REFERENCE_SCANS:
            return []
        made = self.finish()
        self._refer_to(points, surfaces, scan.mount)
        return made

    def finish(self) -> list[OdometryIncrement]:
        """Increments to all scans that had none."""
        # the floor is an error of the map, which stays much the same from reference to reference
        floor = _variances(self._config.floor_m, self._config.floor_rad) / MAP_SCANS
        shared = (self._stated + floor) / max(len(self._ways), 1)
        heading, made = 0.0, []
        for start, end, increment in self._ways:
            cov = rotate_cov(shared, -heading)
            made.append(
                OdometryIncrement(
                    end.robot, end.stamp_ns, end.time_ns, start.time_ns, increment, cov
                )
            )
            heading += float(increment[2])
        self._ways.clear()
        return made

    def _usual_s(self) -> float:
        """Time since the scan before, s; of stamps in bursts, the mean of the last times."""
        mean = sum(self._periods) / len(self._periods)
        return mean if min(self._periods) < BURST_SHARE * mean else self._periods[-1]

    def _velocity(self) -> Array:
        """Twist (3,) per second of the last scans."""
        moved, seconds = np.zeros(3), 0.0
        for span, increment in self._recent:
            moved, seconds = compose(moved, increment), seconds + span
        return np.asarray(log(moved) / max(seconds, VELOCITY_S))

    def _refer_to(self, points: Array, surfaces: tuple[Array, Array], mount: Array) -> None:
        """Make the last scan, of points (n, 2), by a laser at ``mount`` (3,), the reference."""
        back = inverse(self._pose)
        kept = self._scans[1 - MAP_SCANS :]
        self._scans = [moved_scan(scan, back) for scan in kept]
        self._scans.append(surfaces)
        self._map = scan_map(self._scans, points, mount, self._config)
        self._pose, self._cov, self._stated = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))


def _variances(sigma_m: float, sigma_rad: float) -> Array:
    return np.diag([sigma_m**2, sigma_m**2, sigma_rad**2])


def _of_laser(velocity: Array, mount: Array) -> Array:
    """Twist (3,) of a laser at ``mount`` (3,), by that of the base."""
    x, y, turning = velocity
    at_laser = rotation(-float(mount[2])) @ [x - turning * mount[1], y + turning * mount[0]]
    return np.append(at_laser, turning)


def _updated(cov: Array, information: Array) -> Array:
    """A covariance (3, 3) after a measurement with such information (3, 3)."""
    return np.asarray(np.linalg.inv(np.linalg.inv(cov) + information), dtype=float)


def with_laser_odometry(
    messages: Iterable[Message], robots: Collection[str], config: Config
) -> Iterator[Message]:
    """Messages in time order; in front of each scan the odometry increment that leads to it.

    Of a robot with several lasers these are the scans of the first.

    Args:
        messages: in time order.
        robots: those that have scans and no odometry.
        config: settings.
    """
    if not robots:
        yield from messages
        return
    odometers = {robot: LaserOdometry(config) for robot in robots}
    waiting: deque[Message] = deque()
    ready: dict[str, deque[OdometryIncrement]] = {robot: deque() for robot in robots}
    begun: set[str] = set()

    def released() -> Iterator[Message]:
        """What is in front and has all that it needs."""
        while waiting:
            head = waiting[0]
            if isinstance(head, Scan) and head.robot in odometers and not head.sensor:
                if head.robot in begun:
                    if not ready[head.robot]:
                        return
                    yield ready[head.robot].popleft()
                begun.add(head.robot)
            yield waiting.popleft()

    for message in messages:
        waiting.append(message)
        if isinstance(message, Scan) and message.robot in odometers and not message.sensor:
            ready[message.robot] += odometers[message.robot].add(message)
        yield from released()
    for robot, odometer in odometers.items():
        ready[robot] += odometer.finish()
    yield from released()
