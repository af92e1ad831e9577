"""Odometry of velocities: geometry_msgs/Twist and TwistStamped, such as commands on /cmd_vel.

A velocity holds until the next one, as a robot keeps it, but not longer than a base that hears
nothing goes on. It is the last resort: commands say what a robot was told to do.
"""

import math
from collections.abc import Sequence

import numpy as np

from graphslam.core.geometry import compose, exp
from graphslam.logs import schemas
from graphslam.logs.cdr import CdrError
from graphslam.logs.cdr_writing import odometry_bytes
from graphslam.logs.recording import Derived, Recording, raw_messages

#: s after which a base without a new command stops, as drivers do
_HOLD_S = 0.5
#: ns: a stop so much earlier than the next command can still be put in its place in time
_PLACED_NS = 1_000_000_000


class TwistOdometry:
    """Turns velocities into nav_msgs/Odometry, as they come."""

    def __init__(self, schema: str, base: str) -> None:
        """``schema``: of the messages; ``base``: the frame that moves, where they name none."""
        self._schema, self._base = schema, base
        self._time_ns: int | None = None
        self._velocity, self._pose = np.zeros(3), np.zeros(3)

    def __call__(self, data: bytes, log_time_ns: int) -> list[bytes]:
        """The odometry up to a message: one or two poses, none if it cannot be read."""
        try:
            message = schemas.decode(self._schema, data)
        except CdrError:
            return []
        stamped = self._schema == schemas.TWIST_STAMPED
        time_ns = schemas.stamp_ns(message.header.stamp) if stamped else log_time_ns
        time_ns = time_ns or log_time_ns
        twist = message.twist if stamped else message
        velocity = np.array([twist.linear.x, twist.linear.y, twist.angular.z])
        if not np.isfinite(velocity).all():
            return []
        made = []
        if self._time_ns is not None:
            if time_ns <= self._time_ns:
                return []
            apart_s = 1e-9 * (time_ns - self._time_ns)
            self._pose = compose(self._pose, exp(min(apart_s, _HOLD_S) * self._velocity))
            stopped_ns = self._time_ns + round(1e9 * _HOLD_S)
            if stopped_ns < time_ns <= stopped_ns + _PLACED_NS and self._velocity.any():
                made.append(self._message(stopped_ns))
        self._time_ns, self._velocity = time_ns, velocity
        return [*made, self._message(time_ns)]

    def _message(self, stamp_ns: int) -> bytes:
        x, y, heading = self._pose.tolist()
        turn = (0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))
        return odometry_bytes(stamp_ns, "odom", (x, y, 0.0), turn, self._base)


def with_twist_odometry(
    recording: Recording, topic: str, base: str
) -> tuple[Recording, Derived | None]:
    """The recording with the odometry by the velocities of ``topic``; None if it has none."""
    schema = next((raw.schema for raw in recording.topics if raw.name == topic), "")
    if not schema:
        return recording, None
    make = TwistOdometry(schema, base)
    messages = raw_messages(recording, {topic})
    count = sum(len(make(raw.data, raw.log_time_ns)) for raw in messages)
    name, arguments = f"{topic} (integrated)", (schema, base)
    derived = Derived(name, schemas.ODOMETRY, topic, count, TwistOdometry, arguments)
    return recording.with_derived(derived), derived


def twist_topics(files: Sequence[Recording]) -> list[str]:
    """Topics with velocities: stamped ones first, then those with most messages."""
    found = [
        (raw.schema != schemas.TWIST_STAMPED, -raw.count, raw.name)
        for file in files
        for raw in file.topics
        if raw.schema in (schemas.TWIST, schemas.TWIST_STAMPED) and raw.count
    ]
    return list(dict.fromkeys(name for _, _, name in sorted(found)))
