"""Keyframe selection: which events are used, and which of them get a state of their own."""

from collections.abc import Sequence

import numpy as np

from graphslam.core.config import KeyframeConfig
from graphslam.core.geometry import wrap
from graphslam.core.records import Message, Scan, Sighting
from graphslam.perception.sightings import may_be_robot
from graphslam.pipeline.robot_state import RobotState


class KeyframeSelector:
    """Decides by motion since the last keyframe; mode ``all`` makes a state of everything.

    ``at_sightings``: sightings get a state at their own time wherever the robot has moved. What
    moves several of them to another time is an error that they share.
    """

    def __init__(self, config: KeyframeConfig, *, at_sightings: bool = False) -> None:
        self._config, self._at_sightings = config, at_sightings

    def is_used(self, event: Sequence[Message], run: RobotState) -> bool:
        """Whether an event becomes observations; else only its pose is reported.

        Scans overlap, so one is enough per stretch of motion since the last scan that was used,
        whatever states other observations have made in between. Sightings are all used. A scan that
        is used is noted in ``run``.
        """
        first = event[0]
        if self._config.mode == "all" or not isinstance(first, Scan):
            return True
        used = self.has_moved(run, run.scanned_ns, first.time_ns, self._config.scan_angle_rad)
        if used:
            run.scanned_ns = first.time_ns
        return used

    def used_scans(self, scans: Sequence[Scan], run: RobotState) -> tuple[list[Scan], list[Scan]]:
        """Those of consecutive scans of a robot for which `is_used` holds, at once; and others.

        Of scans while the robot stands one is among the others. Those that `RobotState.repeats`
        leaves out are among neither.
        """
        scans = [scan for scan in scans if not run.repeats.leaves_out(scan, run.track)]
        if self._config.mode == "all" or not scans:
            return scans, []
        since = scans[0].time_ns if run.scanned_ns is None else run.scanned_ns
        times = np.array([since, *(scan.time_ns for scan in scans)], dtype=np.int64)
        (path_m, heading), *driven = run.track.driven(times).tolist()
        used, others, angle_rad = [], [], self._config.scan_angle_rad
        there = run.track.driven(np.array([run.kept_ns or since], dtype=np.int64))[0].tolist()
        for scan, (at_m, at_rad) in zip(scans, driven, strict=True):
            turned = abs(float(wrap(at_rad - heading)))
            if run.scanned_ns is None or self._is_far(at_m - path_m, turned, angle_rad):
                run.scanned_ns, path_m, heading = scan.time_ns, at_m, at_rad
                used.append(scan)
            elif [at_m, at_rad] != there:
                others.append(scan)
            else:
                continue
            run.kept_ns, there = scan.time_ns, [at_m, at_rad]
        return used, others

    def gets_state(self, event: Sequence[Message], run: RobotState) -> bool:
        """Whether a used event gets a state at its own time; else it is moved to the last one."""
        first = event[0]
        return (
            self._config.mode == "all"
            or isinstance(first, Scan)
            or any(isinstance(m, Sighting) and may_be_robot(m) for m in event)
            or self.has_moved(run, run.state_ns, first.time_ns)
            or (self._at_sightings and any(run.track.moved(run.state_ns, first.time_ns)))
        )

    def has_moved(
        self, run: RobotState, since_ns: int | None, time_ns: int, angle_rad: float | None = None
    ) -> bool:
        """Whether a robot drove a keyframe's distance or turned by an angle since a time.

        Args:
            run: the robot.
            since_ns: from when; None = never before, so it has.
            time_ns: until when.
            angle_rad: the angle; None = that of a keyframe.
        """
        if since_ns is None:
            return True
        path_m, turned_rad = run.track.moved(since_ns, time_ns)
        return self._is_far(path_m, turned_rad, angle_rad)

    def is_keyframe(self, before: Sequence[float], now: Sequence[float]) -> bool:
        """`has_moved` by what a robot had driven then and now, see `Readings.driven`."""
        return self._is_far(now[0] - before[0], abs(float(wrap(now[1] - before[1]))), None)

    def _is_far(self, path_m: float, turned_rad: float, angle_rad: float | None) -> bool:
        least_rad = self._config.angle_rad if angle_rad is None else angle_rad
        return path_m >= self._config.distance_m or turned_rad >= least_rad
