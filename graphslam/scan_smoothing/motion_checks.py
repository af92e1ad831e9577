"""Motions by odometry checked against the scans at their ends, block by block.

Whether a motion is suspect is found where the scans are read (`scan_keyframes`). What it should be
is searched for in this process, which otherwise waits for the other one.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.config import Config
from graphslam.core.geometry import Array
from graphslam.core.observation_arrays import ObservationArrays
from graphslam.core.record import Record, replace
from graphslam.core.records import Closure, Motion
from graphslam.odometry.scan_odometry import check_motions, match_off_lines, points_off_lines
from graphslam.odometry.several_lasers import last_part
from graphslam.perception.scan_matching import make_submap


@dataclass(frozen=True, slots=True, eq=False)
class ScanKeyframe(Record):
    """A scan that is used, and how the robot came there.

    ``motion`` is since the keyframe before; None if that has the same time. ``seen`` are
    observations from the base, ``points`` (k, 2) m the returns in the frame of the laser, which is
    at ``mount`` (3,). ``matched``: a second measurement of the motion, by the scan.
    """

    time_ns: int
    mount: Array
    motion: Motion | None
    seen: ObservationArrays
    points: Array
    matched: Closure | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ScanPair(Record):
    """The motion between two consecutive scans of the first laser.

    ``before`` and ``now`` are numbers of keyframes in a block, ``before`` -1 where it is the last
    such scan of the blocks before. If states of other lasers are between the two, ``earlier`` is
    the part of the motion up to the last of these. ``suspect``: the scans may contradict it;
    ``has_paused``: the laser, in between.
    """

    before: int
    now: int
    motion: Motion
    earlier: Motion | None
    suspect: bool
    has_paused: bool = False


class MotionChecker:
    """Corrects motions of consecutive blocks; ``contradicted`` counts those that it did."""

    def __init__(self, robot: str, config: Config) -> None:
        """No scan yet."""
        self.contradicted = 0
        self._robot = robot
        self._config = config.scan_matching
        #: each scan is compared with the one before, whether the odometry is suspect or not
        self._all = config.odometry.scan_matching == "on"
        self._last_points = np.zeros((0, 2))

    def checked(
        self, keyframes: Sequence[ScanKeyframe], pairs: Sequence[ScanPair], last: int | None
    ) -> list[ScanKeyframe]:
        """The keyframes of a block, with better motions and with second measurements of them.

        Args:
            keyframes: of the block.
            pairs: scans of the block, to be compared with those before.
            last: number of the block's last keyframe of the first laser; None if it has none.
        """
        checked = list(keyframes)
        suspect = [pair for pair in pairs if pair.suspect]
        compared = pairs if self._all else suspect
        clouds = {-1: self._last_points}
        clouds |= {n: k.points for n, k in enumerate(keyframes)}
        wanted = {pair.before for pair in compared} | {pair.now for pair in suspect}
        submaps = {
            n: make_submap(np.zeros((1, 3)), [clouds[n]], self._config) for n in sorted(wanted)
        }
        better = check_motions(
            [pair.motion for pair in suspect],
            [submaps[pair.before] for pair in suspect],
            [submaps[pair.now] for pair in suspect],
            [pair.has_paused for pair in suspect],
        )
        whole = {pair.now: pair.motion for pair in pairs}
        for pair, motion in zip(suspect, better, strict=True):
            if not motion.from_scans:
                continue
            self.contradicted += 1
            own, last_own = keyframes[pair.now].motion, motion
            if pair.earlier is not None and own is not None:
                last_own = last_part(motion, pair.earlier, own)
            whole[pair.now] = motion
            checked[pair.now] = replace(checked[pair.now], motion=last_own)
        for pair in pairs if self._all else ():
            motion = whole[pair.now]
            if not motion.from_scans:
                seen, points = keyframes[pair.now].seen, keyframes[pair.now].points
                lines = [seen.one(n) for n in range(len(seen))]
                free = points_off_lines(points, lines, self._config)
                matched = match_off_lines(motion, submaps[pair.before], self._robot, free)
                checked[pair.now] = replace(checked[pair.now], matched=matched)
        if last is not None:
            self._last_points = keyframes[last].points
        return checked
