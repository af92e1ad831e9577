"""Robots' clocks: local against common time, and messages of all robots on one time line.

Offsets and drifts are estimated by `graphslam.estimation.clock_calibration`.
"""

import heapq
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.records import Message, OdometryIncrement, RelativePose


@dataclass(frozen=True, slots=True)
class Clock:
    """Error of a robot's clock: local minus common time is ``offset_s`` at ``epoch_ns``.

    It grows by ``drift`` seconds per second. The common clock is that of the first robot.
    """

    offset_s: float = 0.0
    drift: float = 0.0
    epoch_ns: int = 0

    def to_local(self, common_ns: IntArray) -> IntArray:
        """Readings (n,) ns of this clock at times (n,) ns of the common clock."""
        elapsed = common_ns - self.epoch_ns
        error = np.rint(1e9 * self.offset_s + self.drift * elapsed).astype(np.int64)
        return np.asarray(common_ns + error)

    def to_common(self, local_ns: int) -> int:
        """Time of the common clock when this clock reads ``local_ns``."""
        elapsed = local_ns - self.epoch_ns - 1e9 * self.offset_s
        return self.epoch_ns + round(elapsed / (1.0 + self.drift))

    def adjusted(self, offset_s: float, drift: float) -> "Clock":
        """The clock with ``offset_s`` and ``drift`` added to its own."""
        return replace(self, offset_s=self.offset_s + offset_s, drift=self.drift + drift)


def to_common_clock(messages: Iterable[Message], clocks: Mapping[str, Clock]) -> Iterator[Message]:
    """Messages with their ``time_ns`` in common time, sorted by it; stamps are not changed.

    Args:
        messages: sorted by local time.
        clocks: of the robots whose clocks differ from the common one.
    """
    if not clocks:
        yield from messages
        return
    heap: list[tuple[int, int, Message]] = []
    for number, message in enumerate(messages):
        local_ns = message.time_ns
        converted = _in_common_time(message, clocks)
        heapq.heappush(heap, (converted.time_ns, number, converted))
        # local times do not decrease, so no later message can come before this common time
        safe_ns = min(local_ns, *(clock.to_common(local_ns) for clock in clocks.values()))
        while heap and heap[0][0] < safe_ns:
            yield heapq.heappop(heap)[2]
    while heap:
        yield heapq.heappop(heap)[2]


def _in_common_time(message: Message, clocks: Mapping[str, Clock]) -> Message:
    """The message with all its times by the common clock."""
    if isinstance(message, RelativePose) and message.other in clocks:
        message = replace(message, start_ns=clocks[message.other].to_common(message.start_ns))
    clock = clocks.get(message.robot)
    if clock is None:
        return message
    if isinstance(message, OdometryIncrement):
        message = replace(message, start_ns=clock.to_common(message.start_ns))
    return replace(message, time_ns=clock.to_common(message.time_ns))
