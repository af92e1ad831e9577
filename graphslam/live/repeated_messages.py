"""Messages that come twice: recordings that were put together, or two recorders of one topic."""

from collections import Counter, deque
from collections.abc import Iterable, Iterator

import numpy as np

from graphslam.core.records import Message, OdometryPose, Scan, WheelAngles

#: scans of a laser among which one with the same stamp is looked for: a clock that is set back by a
#: second gives the stamps of that second again
_SCANS = 128
REPEATED_SCAN = "scan: stamp repeated"


def without_repeated(messages: Iterable[Message], dropped: Counter[str]) -> Iterator[Message]:
    """The messages, sorted by time, without those that come again.

    Of scans of one laser with equal stamps the first one is used, whatever the others say: there is
    one pose for each stamp. Odometry of equal stamps is left out where it says the same.
    """
    stamps: dict[tuple[str, str], deque[int]] = {}
    latest: dict[tuple[str, type[Message]], OdometryPose | WheelAngles] = {}
    for message in messages:
        if isinstance(message, Scan):
            own = stamps.setdefault((message.robot, message.sensor), deque(maxlen=_SCANS))
            if message.stamp_ns in own:
                dropped[REPEATED_SCAN] += 1
                continue
            own.append(message.stamp_ns)
        elif isinstance(message, OdometryPose | WheelAngles):
            key = message.robot, type(message)
            if key in latest and _say_the_same(latest[key], message):
                dropped[f"{type(message).__name__.lower()}: recorded twice"] += 1
                continue
            latest[key] = message
        yield message


def _say_the_same(a: OdometryPose | WheelAngles, b: OdometryPose | WheelAngles) -> bool:
    if a.stamp_ns != b.stamp_ns:
        return False
    if isinstance(a, OdometryPose):
        return isinstance(b, OdometryPose) and np.array_equal(a.pose, b.pose)
    return isinstance(b, WheelAngles) and (a.left_rad, a.right_rad) == (b.left_rad, b.right_rad)
