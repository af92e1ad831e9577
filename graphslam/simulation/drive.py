"""A drive as a function of time: pose of the robot and accumulated travel of its base.

Legs begin and end at rest with a trapezoidal speed profile.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np

from graphslam.core.geometry import Array, wrap
from graphslam.simulation.path import Curve, round_corners
from graphslam.simulation.scenario import Leg, Robot

_ALIGNED_RAD = 1e-9  # smaller turns on the spot are left out


@dataclass(frozen=True, slots=True, eq=False)
class BaseStates:
    """True states of a robot's base at n times.

    ``poses`` (n, 3) world frame; ``travel`` (n,) m, signed along the robot's x axis, and
    ``turned`` (n,) rad, both accumulated since the start and never wrapped.
    """

    poses: Array
    travel: Array
    turned: Array


@dataclass(frozen=True, slots=True)
class TrapezoidalProfile:
    """Trapezoidal speed profile from rest to rest: distance, top speed, acceleration (any unit)."""

    distance: float
    speed: float
    acceleration: float

    @property
    def _ramp_s(self) -> float:
        return min(self.speed / self.acceleration, sqrt(self.distance / self.acceleration))

    @property
    def duration_s(self) -> float:
        """Time from rest to rest."""
        ramp = self._ramp_s
        return 2 * ramp + max(0.0, self.distance / (self.acceleration * ramp) - ramp)

    def at(self, time_s: Array) -> Array:
        """Distance covered (n,) at times (n,) s; 0 before the start, ``distance`` after the end."""
        ramp, whole = self._ramp_s, self.duration_s
        t = np.clip(time_s, 0.0, whole)
        up = np.minimum(t, ramp)
        down = np.clip(t - (whole - ramp), 0.0, None)
        level = np.clip(t - ramp, 0.0, whole - 2 * ramp)
        a, top = self.acceleration, self.acceleration * ramp
        return np.asarray(a * up**2 / 2 + top * level + top * down - a * down**2 / 2)


@dataclass(frozen=True, slots=True, eq=False)
class CurveMotion:
    """Motion along a curve, forwards or backwards."""

    curve: Curve
    profile: TrapezoidalProfile
    backwards: bool

    @property
    def duration_s(self) -> float:
        """Time from rest to rest."""
        return self.profile.duration_s

    def at(self, time_s: Array) -> BaseStates:
        """States at times (n,) s since the leg began; ``travel`` and ``turned`` since then too."""
        s = np.minimum(self.profile.at(time_s), self.curve.length_m)
        position, tangent = self.curve.at(s)
        heading = wrap(tangent + np.pi * self.backwards)
        turned = tangent - self.curve.heading[0]
        return BaseStates(np.column_stack([position, heading]), -s if self.backwards else s, turned)


@dataclass(frozen=True, slots=True, eq=False)
class TurnOnSpot:
    """Turn on the spot from ``start`` (3,) by ``angle_rad``; without a profile it is a wait."""

    start: Array
    angle_rad: float
    profile: TrapezoidalProfile | None
    wait_s: float = 0.0

    @property
    def duration_s(self) -> float:
        """Time from rest to rest."""
        return self.profile.duration_s if self.profile else self.wait_s

    def at(self, time_s: Array) -> BaseStates:
        """States at times (n,) s since the leg began; see `CurveMotion.at`."""
        turned = np.zeros(len(time_s))
        if self.profile:
            turned = np.sign(self.angle_rad) * self.profile.at(time_s)
        poses = np.tile(self.start, (len(time_s), 1))
        poses[:, 2] = wrap(poses[:, 2] + turned)
        return BaseStates(poses, np.zeros(len(time_s)), turned)


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A sequence of motions; ``begins_s``, ``travel`` and ``turned`` are at their starts."""

    motions: tuple[CurveMotion | TurnOnSpot, ...]
    begins_s: tuple[float, ...]
    travel: tuple[float, ...]
    turned: tuple[float, ...]

    @property
    def duration_s(self) -> float:
        """Time at which the last motion ends."""
        return self.begins_s[-1] + self.motions[-1].duration_s

    @property
    def path_m(self) -> float:
        """Length of the path, forwards and backwards."""
        return sum(m.curve.length_m for m in self.motions if isinstance(m, CurveMotion))

    def at(self, time_s: Array) -> BaseStates:
        """States at times (n,) s; at rest before the first motion and after the last."""
        times = np.asarray(time_s, dtype=float)
        which = np.clip(np.searchsorted(self.begins_s, times, side="right") - 1, 0, None)
        poses = np.zeros((len(times), 3))
        travel, turned = np.zeros(len(times)), np.zeros(len(times))
        for number in np.unique(which):
            rows = which == number
            states = self.motions[number].at(times[rows] - self.begins_s[number])
            poses[rows] = states.poses
            travel[rows] = self.travel[number] + states.travel
            turned[rows] = self.turned[number] + states.turned
        return BaseStates(poses, travel, turned)


def plan_drive(start: Array, legs: Sequence[Leg], robot: Robot) -> Drive:
    """The drive of a ``robot`` from pose ``start`` (3,) along ``legs``.

    Raises:
        ScenarioError: a leg's points coincide or turn back sharply.
    """
    motions: list[CurveMotion | TurnOnSpot] = []
    pose, begins_s, travel, turned = start, [0.0], [0.0], [0.0]
    for leg in legs:
        for motion in _motions(pose, leg, robot):
            motions.append(motion)
            end = motion.at(np.array([motion.duration_s]))
            pose = end.poses[0]
            begins_s.append(begins_s[-1] + motion.duration_s)
            travel.append(travel[-1] + float(end.travel[0]))
            turned.append(turned[-1] + float(end.turned[0]))
    motions.append(TurnOnSpot(pose, 0.0, None))  # at rest from now on
    return Drive(tuple(motions), tuple(begins_s), tuple(travel), tuple(turned))


def _motions(pose: Array, leg: Leg, robot: Robot) -> list[CurveMotion | TurnOnSpot]:
    """The motions of one leg; a path in another direction begins with a turn on the spot."""
    if leg.wait_s:
        return [TurnOnSpot(pose, 0.0, None, leg.wait_s)]
    rate = np.radians(robot.turn_rate_deg_s)
    if leg.turn_deg:
        angle = np.radians(leg.turn_deg)
        return [TurnOnSpot(pose, angle, TrapezoidalProfile(abs(angle), rate, 2 * rate))]
    points = [pose[:2].tolist(), *leg.through_m]
    curve = round_corners(points, robot.corner_m)
    angle = float(wrap(curve.heading[0] + np.pi * leg.reverse - pose[2]))
    speed = leg.speed_m_s or robot.speed_m_s
    profile = TrapezoidalProfile(curve.length_m, speed, robot.acceleration_m_s2)
    follow = CurveMotion(curve, profile, leg.reverse)
    if abs(angle) < _ALIGNED_RAD:
        return [follow]
    return [TurnOnSpot(pose, angle, TrapezoidalProfile(abs(angle), rate, 2 * rate)), follow]
