"""Odometry that stops for a while: scan matching tells how the robot moved meanwhile.

Where scans go on and the odometry is silent, poses of the odometry are put in at the times of the
scans, from scans matched one after the other (`graphslam.odometry.laser_odometry`). They begin at
the last scan that the odometry covers. Where scans do not determine the motion (a corridor) the
robot is taken to go on as before; once that may be too far off, nothing more is put in, and the
rest of the gap stays one.

When the odometry comes again it has counted the motion meanwhile, or not (its driver was restarted,
its wheels were not read). Where it contradicts the scans by more than their sigmas they are right,
and what follows is appended to where they say that the robot is.
"""

from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping
from itertools import pairwise

import numpy as np

from graphslam.core.config import Config
from graphslam.core.geometry import Array, between, compose, exp, inverse, log
from graphslam.core.record import replace
from graphslam.core.records import Message, OdometryPose, Scan
from graphslam.odometry.laser_odometry import LaserOdometry
from graphslam.odometry.preintegration import Track
from graphslam.odometry.reading_gaps import GAP_S

#: scans in front of a gap that the first in it is matched with
SCANS_BEFORE = 6
#: m, rad: sigmas of the position and of the heading in a gap up to which it is bridged; the heading
#: is that unsure only where a scan fitted nowhere, and then odometry after the gap knows better
MOST_SIGMA_M, MOST_SIGMA_RAD = 1.0, 0.3
#: by how much the odometry may differ from the scans after a gap: m, rad, share of the path, sigmas
AGREED_M, AGREED_RAD, AGREED_SHARE, AGREED_SIGMAS = 0.15, 0.1, 0.1, 2.0


class GapBridge:
    """The gaps in the odometry of one robot."""

    def __init__(self, config: Config) -> None:
        """No message yet."""
        self._config = config
        self._scans: deque[Scan] = deque(maxlen=SCANS_BEFORE)
        self._readings: deque[OdometryPose] = deque()  # as long as the scans in front of a gap
        self._moved = np.zeros(3)  # the odometry's frame in that of its first part
        self._laser: LaserOdometry | None = None  # in a gap
        self._pose, self._path_m = np.zeros(3), 0.0  # at the last scan in a gap
        self._sigma_m = 0.0  # of that position
        self._sigma_rad, self._variance_rad = 0.0, 0.0  # of the heading, alike
        self._variance = 0.0  # m²: of that position, up to the reference of the matching
        self._open = False  # no more of this gap is bridged

    def scan(self, scan: Scan) -> list[OdometryPose]:
        """The odometry that is put in front of a scan."""
        last = self._readings[-1] if self._readings else None
        gap_ns = round(1e9 * GAP_S)
        made: list[OdometryPose] = []
        if last is not None and scan.time_ns - last.time_ns > gap_ns and not self._open:
            made = self._begin(last) if self._laser is None else []
            if self._laser is not None:
                made += self._matched(self._laser, scan)
        self._scans.append(scan)
        return made

    @property
    def sigma_m(self) -> float:
        """Sigma of the position by the scans, m, since the last reading before a gap."""
        return float(self._sigma_m)

    def _begin(self, last: OdometryPose) -> list[OdometryPose]:
        """Match the scans in front of the gap, and those in it that came already."""
        known = [scan for scan in self._scans if scan.time_ns <= last.time_ns]
        if not known or known[-1].time_ns < self._readings[0].time_ns:
            self._open = True
            return []
        self._laser = LaserOdometry(self._config)
        self._path_m = self._variance = self._variance_rad = 0.0
        for scan in known:
            self._laser.add(scan)
        self._pose = self._at(known[-1].time_ns)
        made = []
        for scan in self._scans:
            if scan.time_ns > last.time_ns:
                made += self._matched(self._laser, scan)
        return made

    def _matched(self, laser: LaserOdometry, scan: Scan) -> list[OdometryPose]:
        is_reference = bool(laser.add(scan))
        variance = self._variance + laser.sigma_m**2
        variance_rad = self._variance_rad + laser.sigma_rad**2
        if variance > MOST_SIGMA_M**2 or variance_rad > MOST_SIGMA_RAD**2:
            self._open, self._laser = True, None
            return []
        self._pose = compose(self._pose, laser.increment)
        self._path_m += float(np.hypot(*laser.increment[:2]))
        self._sigma_m = np.sqrt(variance)
        self._sigma_rad = np.sqrt(variance_rad)
        if is_reference:
            self._variance, self._variance_rad = variance, variance_rad
        return [OdometryPose(scan.robot, scan.time_ns, scan.time_ns, self._pose)]

    def _at(self, time_ns: int) -> Array:
        """Pose (3,) of the odometry at a time that its readings cover."""
        readings = list(self._readings)
        for before, after in pairwise(readings):
            if before.time_ns <= time_ns <= after.time_ns:
                share = (time_ns - before.time_ns) / max(after.time_ns - before.time_ns, 1)
                return compose(before.pose, exp(share * log(between(before.pose, after.pose))))
        return readings[-1].pose

    def reading(self, message: OdometryPose) -> OdometryPose:
        """The odometry's own reading, appended to what the scans say of a gap before it."""
        if self._moved.any():
            message = replace(message, pose=compose(self._moved, message.pose))
        if self._laser is not None:
            off = between(self._pose, message.pose)
            # between the last scan and this reading the robot goes on as before
            reach = AGREED_M + AGREED_SHARE * self._path_m + AGREED_SIGMAS * self._sigma_m
            turn = AGREED_RAD + AGREED_SIGMAS * self._sigma_rad
            if np.hypot(*off[:2]) > reach or abs(off[2]) > turn:
                back = compose(self._pose, inverse(message.pose))
                self._moved = compose(back, self._moved)
                message = replace(message, pose=self._pose)
        if self._laser is not None or self._open:
            self._readings.clear()
        self._laser, self._open = None, False
        self._readings.append(message)
        first_ns = self._scans[0].time_ns if self._scans else message.time_ns
        while len(self._readings) > 2 and self._readings[1].time_ns < first_ns:
            self._readings.popleft()
        return message


def with_bridged_gaps(
    messages: Iterable[Message],
    robots: Collection[str],
    config: Config,
    tracks: Mapping[str, Track],
) -> Iterator[Message]:
    """Messages in time order; odometry put in where that of a robot is silent and scans go on.

    It comes with the scans of its time, not before them.

    Args:
        messages: in time order.
        robots: those whose odometry reports poses, and that have scans.
        config: settings.
        tracks: of the robots; each counts the scans from which its odometry was put in, and notes
            the largest sigma of a position by them.
    """
    if not robots:
        yield from messages
        return
    bridges = {robot: GapBridge(config) for robot in robots}
    for message in messages:
        bridge = bridges.get(message.robot)
        if bridge is not None and isinstance(message, OdometryPose):
            yield bridge.reading(message)
            continue
        if bridge is not None and isinstance(message, Scan) and not message.sensor:
            put_in = bridge.scan(message)
            if put_in:
                track = tracks[message.robot]
                track.bridged += len(put_in)
                track.bridged_sigma_m = max(track.bridged_sigma_m, bridge.sigma_m)
            yield from put_in
        yield message
