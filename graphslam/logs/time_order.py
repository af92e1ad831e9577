"""Sorting of messages by time, with repair of wrong stamps, in bounded memory.

A recorder under load stamps some messages too late: in CARMEN logs about one per second by
0.3-0.5 s. Recorded as a=.604, b=1.067, c=.802, d=.903, the message b belongs between a and c; with
its own stamp dead reckoning jumps back and forth (Intel: path of 675 m instead of 508 m). Such
glitches are detected per topic in the order of recording; then all topics are sorted together.
"""

import heapq
import math
from collections import Counter, deque
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import accumulate, islice

from graphslam.core import records
from graphslam.core.records import Message

TOO_LATE = "stamp: older than logs.reorder_s allows"
GLITCH = "stamp: glitch"
DUPLICATE = "stamp: duplicate"
REPEATED = "increment: recorded twice"
REPEATED_SIGHTING = "sighting: recorded twice"
#: what is counted of messages that are dropped
DROPPED = (TOO_LATE, REPEATED, REPEATED_SIGHTING)

#: s of lateness up to which a longer window is advised: it has so much of a log in memory
LONGEST_WINDOW_S = 30.0
#: s of lateness from which on a clock that was set back is as likely as a transport that was slow
LONGEST_DELAY_S = 2.0

# A stamp is compared with at most this many later ones of its topic within the window: an absurd
# one far in the future would otherwise never leave the window.
_LOOK_AHEAD = 128
# Equal stamps are treated as a group (one image of sightings). In a topic without stamps all are
# equal, so the size of a group is bounded.
_MAX_GROUP = 1000
# Sorted messages are passed on this many times per window, not after every message.
_EMISSIONS_PER_WINDOW = 16
_LONG_AGO, _FAR_AHEAD = -(1 << 63), 1 << 63

_Odometry = records.OdometryPose | records.WheelAngles | records.OdometryIncrement
# Samples of a continuous process, for which the order of recording is evidence of time.
# Increments and relative poses contain both of their times.
SAMPLED = (records.OdometryPose, records.WheelAngles, records.Scan, records.Sighting, records.Truth)
_SAMPLED = frozenset(SAMPLED)
_ONE_PER_STAMP = (_Odometry, records.Scan, records.Truth)
_RANKS: Mapping[type[Message], int] = {
    records.OdometryPose: 0,
    records.WheelAngles: 0,
    records.OdometryIncrement: 0,
    records.Truth: 1,
    records.TrueLandmark: 1,
    records.RelativePose: 2,
}


def late_remedy(late_s: float) -> str:
    """What mends that messages come up to ``late_s`` late by their stamps."""
    if late_s > LONGEST_WINDOW_S:
        return "let all topics be stamped by one clock that is not set back"
    keeps = f"--set logs.reorder_s={math.ceil(late_s + 0.1)} keeps them"
    if late_s > LONGEST_DELAY_S:
        keeps += "; if a clock was set back, cut the recording there instead"
    return keeps


def late_text(late_s: float) -> str:
    """That messages came up to ``late_s`` late, and what mends it."""
    return f"came up to {late_s:.1f} s late and were dropped; {late_remedy(late_s)}"


def recording_times(stamps_ns: Sequence[int]) -> list[int]:
    """Log times that keep the order of a file which has none.

    They never decrease: a message was recorded before all that come after it, hence not later than
    the earliest of their stamps.
    """
    return list(accumulate(reversed(stamps_ns), min))[::-1]


def sort_key(message: Message) -> tuple[int, int]:
    """Time, then rank: odometry before truth, relative poses, scans and sightings."""
    return message.time_ns, _RANKS.get(type(message), 3)


class MessageSorter:
    """Sorts the messages of one file, given in the order of recording.

    A stamp is a *glitch* (stamped too late) if a later message of its topic has an earlier stamp.
    The ``time_ns`` of such a message is set between its neighbours in the order of recording, in
    proportion to the messages recorded between them on *all* topics, so that a scan and the
    odometry recorded around it keep their order if both are late; ``stamp_ns`` is not changed. Two
    messages that contradict only each other are swapped, and their stamps are used. A message may
    come up to ``window_ns`` after younger ones; one older than what was already passed on is
    dropped. So is the second of two increments over the same time: it would count twice.

    The order of recording is more reliable than stamps because a topic has one publisher and one
    transport, which keep its order, and because clocks are read late, not early. The repair changed
    the path of Intel's dead reckoning from 675 m to 511 m (with `future_stamps` to 510 m); in the
    order of recording it is 509 m.

    Attributes:
        counts: per topic, how many were `GLITCH`, `DUPLICATE` (kept) and of each of `DROPPED`.
        late_in_a_row: per topic, of how many in a row none could be used, at most: `TOO_LATE`.
        ready: messages that follow the one that was passed on last, whatever is pushed next.
    """

    def __init__(self, window_ns: int, *, repair: bool = True) -> None:
        """Hold messages for about ``window_ns`` of log time.

        Without ``repair`` stamps are taken for true, and the order tells when messages came.
        """
        self.counts: dict[str, Counter[str]] = {}
        self.late_in_a_row: Counter[str] = Counter()
        self._late_now: Counter[str] = Counter()  # the row that goes on
        self.ready: deque[Message] = deque()
        self._repair = repair
        self._window_ns = window_ns
        self._repairs: dict[str, _GlitchRepair] = {}
        self._heap: list[tuple[tuple[int, int], int, str, Message]] = []
        self._spans: dict[str, tuple[int, int]] = {}  # topic -> that of its latest increment
        self._seen_ns, self._seen = _LONG_AGO, set[Hashable]()  # the sightings of the latest stamp
        self._number = 0
        self._recorded = 0
        self._late_ns: Counter[str] = Counter()
        self._latest_ns = self._emitted_ns = self._checked_ns = _LONG_AGO

    def late_s(self, topic: str) -> float:
        """By how much a message of ``topic`` that was `TOO_LATE` came late, at most, s."""
        repair = self._repairs.get(topic)
        return 1e-9 * max(self._late_ns[topic], repair.late_ns if repair else 0)

    def push(self, topic: str, message: Message) -> Iterable[Message]:
        """Add the next message recorded; those whose order is now final, sorted."""
        repair = self._repairs.get(topic)
        if repair is None:
            self.counts[topic] = Counter()
            repair = self._repairs[topic] = _GlitchRepair(self._window_ns, self.counts[topic])
        self._recorded += 1
        counts = self.counts[topic]
        late = counts.get(TOO_LATE, 0)
        if message.time_ns != message.stamp_ns:
            counts[GLITCH] += 1
        settled = repair.push(message, self._recorded) if self._repair else [message]
        if settled:
            self._place(topic, settled)
        late = counts.get(TOO_LATE, 0) - late
        if late or topic in self._late_now:
            self._note_late(topic, late)
        if self._latest_ns < self._checked_ns + self._window_ns // _EMISSIONS_PER_WINDOW:
            return ()
        return self._release()

    def _note_late(self, topic: str, late: int) -> None:
        """Count messages in a row that came too late: a clock that was set back makes a row."""
        self._late_now[topic] += late
        self.late_in_a_row[topic] = max(self.late_in_a_row[topic], self._late_now[topic])
        if not late:
            del self._late_now[topic]

    def _release(self) -> Iterator[Message]:
        """The messages, sorted, that nothing can precede any more."""
        self._checked_ns = self._latest_ns
        for name, repair in self._repairs.items():
            # a slow topic must not delay the others until its next message
            if settled := repair.settle_before(self._latest_ns - self._window_ns):
                self._place(name, settled)
        # a pending message may still be placed before messages that are already sorted
        pending = [repair.earliest_ns for repair in self._repairs.values()]
        yield from self._emit(min(self._latest_ns - self._window_ns, *pending))

    def finish(self) -> Iterator[Message]:
        """The remaining messages, sorted, after the last `push`."""
        for name, repair in self._repairs.items():
            self._place(name, repair.settle_before(_FAR_AHEAD))
        yield from self._emit(_FAR_AHEAD)

    def _place(self, topic: str, messages: Iterable[Message]) -> None:
        for message in messages:
            time_ns = message.time_ns
            if time_ns < self._emitted_ns:
                self.counts[topic][TOO_LATE] += 1
                late_ns = self._latest_ns - time_ns
                self._late_ns[topic] = max(late_ns, self._late_ns[topic])
                continue
            self._latest_ns = max(self._latest_ns, time_ns)
            heapq.heappush(self._heap, (sort_key(message), self._number, topic, message))
            self._number += 1

    def _emit(self, before_ns: int) -> Iterator[Message]:
        while self._heap and self._heap[0][0][0] < before_ns:
            *_, topic, message = heapq.heappop(self._heap)
            self._emitted_ns = message.time_ns
            if isinstance(message, records.OdometryIncrement):
                span = message.start_ns, message.stamp_ns
                if self._spans.get(topic) == span:
                    self.counts[topic][REPEATED] += 1
                    continue
                self._spans[topic] = span
            elif isinstance(message, records.Sighting) and self._is_repeated(message):
                self.counts[topic][REPEATED_SIGHTING] += 1
                continue
            self.ready.append(message)
        while self.ready:
            yield self.ready.popleft()

    def _is_repeated(self, message: records.Sighting) -> bool:
        """Whether the same was seen at the same time already: recordings that were put together."""
        if message.time_ns != self._seen_ns:
            self._seen_ns, self._seen = message.time_ns, set()
        numbers = (message.z.tobytes(), message.cov.tobytes(), message.mount.tobytes())
        what = (message.identity, message.seen_robot, message.may_be)
        whole = (message.robot, message.stamp_ns, *what, *numbers)
        if whole in self._seen:
            return True
        self._seen.add(whole)
        return False


def merge(files: Sequence[Iterable[Message]]) -> Iterator[Message]:
    """One sorted stream from several sorted ones; ties keep the order of the files."""
    if len(files) == 1:
        return iter(files[0])  # `heapq.merge` takes as long for each message as to sort it
    return heapq.merge(*files, key=sort_key)


class _GlitchRepair:
    """Repairs the glitches of one topic; every method returns the messages whose time is final."""

    def __init__(self, window_ns: int, counts: Counter[str]) -> None:
        self._window_ns, self._counts = window_ns, counts
        self._pending: deque[list[Message]] = deque()  # groups of equal stamp
        self._stamps: deque[int] = deque()  # of the pending groups
        self._numbers: deque[int] = deque()  # their positions in the order of recording
        self._settled: deque[int] = deque(maxlen=_LOOK_AHEAD)  # last settled stamps
        self._placed_ns = _LONG_AGO  # latest time of a settled message
        self._placed_number = 0  # its position in the order of recording
        self.late_ns = 0  # by how much a dropped message was late, at most

    @property
    def earliest_ns(self) -> int:
        """Lower bound of the times of pending messages."""
        return self._placed_ns if self._stamps else _FAR_AHEAD

    def push(self, message: Message, number: int) -> list[Message]:
        if type(message) not in _SAMPLED:
            return [message]
        # its time so far, see `future_stamps`; usually its stamp
        stamp_ns, stamps = message.time_ns, self._stamps
        if stamp_ns < self._placed_ns - self._window_ns:
            # dropped here: as the earliest stamp it would turn all pending ones into glitches
            self._counts[TOO_LATE] += 1
            late_ns = (stamps[-1] if stamps else self._placed_ns) - stamp_ns
            self.late_ns = max(self.late_ns, late_ns)
            return []
        if stamps and stamps[-1] == stamp_ns:
            self._counts[DUPLICATE] += isinstance(message, _ONE_PER_STAMP)
            if len(self._pending[-1]) < _MAX_GROUP:
                self._pending[-1].append(message)
                return []
        self._pending.append([message])
        stamps.append(stamp_ns)
        self._numbers.append(number)
        settled = []
        while stamp_ns - stamps[0] > self._window_ns or len(stamps) > _LOOK_AHEAD:
            settled += self._settle()
        return settled

    def settle_before(self, stamp_ns: int) -> list[Message]:
        settled = []
        while self._stamps and self._stamps[0] < stamp_ns:
            settled += self._settle()
        return settled

    def _settle(self) -> list[Message]:
        group, stamp_ns = self._pending.popleft(), self._stamps.popleft()
        number = self._numbers.popleft()
        time_ns = self._time_of(stamp_ns, number)
        if time_ns != stamp_ns:
            self._counts[GLITCH] += len(group)
            group = [replace(message, time_ns=time_ns) for message in group]
        if time_ns >= self._placed_ns:
            self._placed_ns, self._placed_number = time_ns, number
        self._settled.append(stamp_ns)
        return group

    def _time_of(self, stamp_ns: int, number: int) -> int:
        """Time of a message whose stamp was just taken from the front of the queue."""
        later = self._stamps
        if not later or min(later) >= stamp_ns:
            return stamp_ns
        earlier = [position for position, s in enumerate(later) if s < stamp_ns]
        first, first_ns = earlier[0], later[earlier[0]]
        between = list(islice(later, first))
        alone = not any(s > first_ns for s in (*self._settled, *between))
        if len(earlier) == 1 and alone:
            return stamp_ns  # a swap
        if self._placed_ns == _LONG_AGO:
            return first_ns
        # all stamps in between are later than first_ns too: a run of glitches, interpolated here
        before = self._placed_number
        part, whole = number - before, self._numbers[first] - before
        return self._placed_ns + (first_ns - self._placed_ns) * part // whole
