"""Robots' clocks: what each reads at one time, and messages put on one time line."""

import heapq
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.records import Message, OdometryIncrement, RelativePose

IntArray = np.ndarray[tuple[int], np.dtype[np.int64]]


@dataclass(frozen=True, slots=True)
class Clock:
    """What a robot's clock reads more than the common one: ``offset_s`` at ``epoch_ns``, growing.

    ``drift`` is in seconds per second. The common clock is that of the first robot.
    """

    offset_s: float = 0.0
    drift: float = 0.0
    epoch_ns: int = 0

    def to_local(self, time_ns: IntArray) -> IntArray:
        """What it reads (n,) at times (n,) of the common clock."""
        since = time_ns - self.epoch_ns
        ahead = np.rint(1e9 * self.offset_s + self.drift * since).astype(np.int64)
        return np.asarray(time_ns + ahead)

    def to_common(self, own_ns: int) -> int:
        """Time of the common clock when it reads ``own_ns``."""
        since = own_ns - self.epoch_ns - 1e9 * self.offset_s
        return self.epoch_ns + round(since / (1.0 + self.drift))

    def adjusted(self, offset_s: float, drift: float) -> "Clock":
        """A clock that is ahead by so much more."""
        return replace(self, offset_s=self.offset_s + offset_s, drift=self.drift + drift)


def to_common_clock(messages: Iterable[Message], clocks: Mapping[str, Clock]) -> Iterator[Message]:
    """Messages with their times by the common clock, in its order; stamps stay as they are.

    Args:
        messages: in the order of their own times.
        clocks: of the robots whose clock differs.
    """
    if not clocks:
        yield from messages
        return
    heap: list[tuple[int, int, Message]] = []
    for number, message in enumerate(messages):
        own_ns = message.time_ns
        moved = _moved(message, clocks)
        heapq.heappush(heap, (moved.time_ns, number, moved))
        # whatever comes still has a later time of its own
        safe_ns = min(own_ns, *(clock.to_common(own_ns) for clock in clocks.values()))
        while heap and heap[0][0] < safe_ns:
            yield heapq.heappop(heap)[2]
    while heap:
        yield heapq.heappop(heap)[2]


def _moved(message: Message, clocks: Mapping[str, Clock]) -> Message:
    """The message by the common clock."""
    if isinstance(message, RelativePose) and message.other in clocks:
        message = replace(message, start_ns=clocks[message.other].to_common(message.start_ns))
    clock = clocks.get(message.robot)
    if clock is None:
        return message
    if isinstance(message, OdometryIncrement):
        message = replace(message, start_ns=clock.to_common(message.start_ns))
    return replace(message, time_ns=clock.to_common(message.time_ns))
