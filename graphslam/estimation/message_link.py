"""Messages between robots over a network that loses some and delivers others late.

A robot's messages have numbers. Each begins at the state at which the one before ends, so they are
used in this order, each once: what comes too early waits, what comes twice is ignored. A number
that is missing before one that came has been lost, or is late; with its next message the receiver
says which it lacks, and the sender repeats those as they were. One sum of several messages would be
smaller, but who has received a part of it after all could not take the rest from it.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from heapq import heappop, heappush
from typing import Generic, TypeVar

import numpy as np

from graphslam.core.config import NetworkConfig

Content = TypeVar("Content")


@dataclass(frozen=True, slots=True, eq=False)
class Packet(Generic[Content]):
    """What a robot sends at a time: messages with their numbers, and what it lacks of others.

    ``lacking``: robot -> numbers of its messages.
    """

    sender: str
    sent_ns: int
    messages: Sequence[tuple[int, Content]]
    lacking: Mapping[str, frozenset[int]]


@dataclass(slots=True, eq=False)
class Inbox(Generic[Content]):
    """Messages of one sender: ``following`` is the number used next, ``early`` are waiting."""

    following: int = 0
    early: dict[int, Content] = field(default_factory=dict)

    def accept(self, messages: Iterable[tuple[int, Content]]) -> list[Content]:
        """The messages that can be used now, in the order of their numbers."""
        for number, content in messages:
            if number >= self.following:
                self.early.setdefault(number, content)
        ready = []
        while self.following in self.early:
            ready.append(self.early.pop(self.following))
            self.following += 1
        return ready

    def lacking(self) -> frozenset[int]:
        """Numbers that have not come although a higher one has."""
        return frozenset(range(self.following, max(self.early, default=0))) - self.early.keys()


@dataclass(slots=True, eq=False)
class Outbox(Generic[Content]):
    """All messages of a robot, ``contents``; when they were ``asked`` for and ``repeated``, ns."""

    contents: list[Content] = field(default_factory=list)
    asked: dict[int, int] = field(default_factory=dict)
    repeated: dict[int, int] = field(default_factory=dict)

    def ask(self, numbers: Iterable[int], sent_ns: int) -> None:
        """A receiver said at ``sent_ns`` that it lacks messages."""
        for number in numbers:
            self.asked[number] = max(sent_ns, self.asked.get(number, sent_ns))

    def send(self, content: Content, now_ns: int) -> list[tuple[int, Content]]:
        """A new message, and before it those that were asked for since they were last sent."""
        again = [n for n, at in sorted(self.asked.items()) if at > self.repeated.get(n, -1)]
        self.repeated.update(dict.fromkeys(again, now_ns))
        self.contents.append(content)
        return [(n, self.contents[n]) for n in (*again, len(self.contents) - 1)]


class Network(Generic[Content]):
    """Simulated: each receiver loses a packet or gets it late, independently of the others."""

    def __init__(self, config: NetworkConfig) -> None:
        self._loss, self._delay_ns = config.loss_ratio, 1e9 * config.delay_s
        self._rng = np.random.default_rng(config.seed)
        self._count = 0  # packets of one time in the order in which they were sent
        self._flying: list[tuple[int, int, str, Packet[Content]]] = []

    def send(self, packet: Packet[Content], receivers: Iterable[str]) -> None:
        """Send a packet."""
        for receiver in receivers:
            lost, late = self._rng.random(2)
            if lost >= self._loss:
                at = packet.sent_ns + round(late * self._delay_ns)
                heappush(self._flying, (at, self._count, receiver, packet))
                self._count += 1

    def arrived(self, now_ns: int) -> Iterator[tuple[str, Packet[Content]]]:
        """Receivers and packets that have arrived since the last call, in order of arrival."""
        while self._flying and self._flying[0][0] <= now_ns:
            *_, receiver, packet = heappop(self._flying)
            yield receiver, packet
