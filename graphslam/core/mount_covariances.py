"""Covariances of estimated mounts of sensors, and of an estimate with them."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from graphslam.core.geometry import Array


@dataclass(frozen=True, slots=True, eq=False)
class MountCovariance:
    """Covariance (3, 3) of a robot's mount, and of its states with it: ``states`` (n, 3, 3)."""

    mount: Array
    states: Array


@dataclass(frozen=True, slots=True, eq=False)
class MountCovariances:
    """Covariances of the mounts of R robots, stacked, and of an estimate with them.

    A mount is x, y, yaw along base axes. ``cov`` (3R, 3R) of all; ``states[robot]`` (n, 3, 3R):
    rows of its states, ``landmarks`` (d, 3R) by number, along world axes. Where mounts place the
    world, ``placing[robot]`` (3, 3R) is the twist of the world in which a robot is, by their
    errors: it moves a pose (x, y, phi) by (v_x - y w, v_y + x w, w).
    """

    robots: tuple[str, ...]
    cov: Array
    states: Mapping[str, Array]
    landmarks: Mapping[int, Array]
    placing: Mapping[str, Array] = field(default_factory=dict)

    def columns(self, robot: str) -> slice:
        """Where a robot's mount is among all."""
        begin = 3 * self.robots.index(robot)
        return slice(begin, begin + 3)

    def of(self, robot: str) -> MountCovariance | None:
        """Of a robot's own mount; None if it is not estimated."""
        if robot not in self.robots:
            return None
        own = self.columns(robot)
        return MountCovariance(self.cov[own, own], self.states[robot][:, :, own])
