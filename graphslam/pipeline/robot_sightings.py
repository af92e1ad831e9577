"""Which robots a sighting may be of, and where they are then.

A sighting that names a robot may be of that one; one of a robot without its name, or of something
that may be a robot, of all robots that are near what was seen. They are candidates of data
association beside landmarks (`graphslam.mapping.robot_candidates`).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import repeat

import numpy as np

from graphslam.core.config import Config
from graphslam.core.geometry import Array, compose
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Motion, Sighting
from graphslam.mapping.robot_candidates import RobotTarget
from graphslam.odometry.interpolation import HALF_SPAN_NS
from graphslam.perception.sightings import may_be_robot
from graphslam.pipeline.robot_state import RobotState
from graphslam.pipeline.sighting_batches import SightingBatch


class RobotCandidates:
    """The robots of a pass as candidates of data association."""

    def __init__(
        self,
        runs: Mapping[str, RobotState],
        frames: Mapping[str, str],
        config: Config,
        clock_sigma_s: float,
        start: Callable[[str, int], bool],
    ) -> None:
        """Made before the pass.

        Args:
            runs: the robots.
            frames: robot -> its frame.
            config: settings.
            clock_sigma_s: sigma of the difference of two robots' clocks.
            start: gives a robot its first state if it can have one at a time, ns, and returns
                whether it has one.
        """
        self._runs, self._frames, self._start = runs, frames, start
        self._max_distance_m = config.association.max_distance_m
        self._max_gap_ns = round(1e9 * config.odometry.max_gap_s)
        self._clock_sigma_s = clock_sigma_s

    def possible(self, sighting: Sighting) -> tuple[str, ...]:
        """Names of the robots that a sighting may be of, sorted; its observer has a state."""
        if sighting.seen_robot is not None:
            return (sighting.seen_robot,)
        if not may_be_robot(sighting):
            return ()
        time_ns = sighting.time_ns
        sensor = compose(self._predicted(sighting.robot, time_ns), sighting.mount)
        point = MODELS["point"].invert(sighting.z[:2], sensor)
        near = []
        for name, run in sorted(self._runs.items()):
            if (
                name != sighting.robot
                and self._frames[name] == self._frames[sighting.robot]
                and run.track.covers(time_ns, self._max_gap_ns)
                and self._start(name, time_ns)
            ):
                away = self._predicted(name, time_ns)[:2] - point
                if np.hypot(*away) < self._max_distance_m:
                    near.append(name)
        return tuple(near)

    def targets(self, names: Sequence[str], time_ns: int) -> list[RobotTarget]:
        """The robots at a time; they have states."""
        return [
            RobotTarget(name, self._since(name, time_ns), self.clock_shift(name, time_ns))
            for name in names
        ]

    def _since(self, name: str, time_ns: int) -> Motion | None:
        """Motion since the robot's latest state."""
        run = self._runs[name]
        return run.track.motion(run.state_ns, time_ns) if time_ns > run.state_ns else None

    def _predicted(self, name: str, time_ns: int) -> Array:
        """Where a robot is at a time, by its latest state."""
        pose, motion = self._runs[name].latest_pose, self._since(name, time_ns)
        return pose if motion is None else compose(pose, motion.delta)

    def clock_shift(self, name: str, time_ns: int) -> Array:
        """Sigma (2,) m of a robot's position along its path, for its clock."""
        if not self._clock_sigma_s:
            return np.zeros(2)
        around = time_ns - HALF_SPAN_NS, time_ns + HALF_SPAN_NS
        driven = self._runs[name].track.motion(*around).delta[:2]
        return np.asarray(driven * self._clock_sigma_s / (2e-9 * HALF_SPAN_NS))


def with_named_robots(
    batch: SightingBatch, possible: Sequence[Sequence[str]]
) -> tuple[SightingBatch, list[int]]:
    """A batch in which a sighting is there once for each robot that it may be of.

    A sighting of no robot stays as it is. ``possible``: the robots of each sighting in turn. Also
    the number of the sighting behind each one.
    """
    number = 0
    images: list[Sequence[Sighting]] = []
    behind: list[int] = []
    for image in batch.images:
        named: list[Sighting] = []
        for sighting in image:
            names = possible[number]
            own = [replace(sighting, seen_robot=name) for name in names] or [sighting]
            named += own
            behind += repeat(number, len(own))
            number += 1
        images.append(named)
    return SightingBatch(images), behind
