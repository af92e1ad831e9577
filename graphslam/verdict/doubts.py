"""Reasons to doubt a result, facts that are none, and what the checks share."""

from dataclasses import dataclass

from graphslam.core.arrays import IntArray

#: m, rad: a robot that its other sensors saw move by more did move, whatever odometry says
MOVED_M, MOVED_RAD = 0.3, 0.25


@dataclass(frozen=True, slots=True)
class Reason:
    """Why a result is doubtful or bad (``level``): one line about a robot, or "" for all.

    ``check`` names what was looked at.
    """

    level: str
    check: str
    about: str
    text: str


@dataclass(frozen=True, slots=True)
class Fact:
    """What a user may want to know of a robot (``about``) though it is no reason for doubt.

    ``check`` names what was looked at; ``share``: of the robot's sightings, if it is about these.
    """

    check: str
    about: str
    share: float | None
    text: str


def seconds(times_ns: IntArray | int, origin_ns: int) -> str:
    """A time, ns, as people read it: seconds since the log began at ``origin_ns``."""
    return f"{(float(times_ns) - origin_ns) * 1e-9:.1f} s"
