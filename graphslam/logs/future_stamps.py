"""Stamps that are later than the time at which their message was recorded.

A message cannot be stamped after it was recorded, so a stamp that says so is wrong: typically a
logging process fell behind and read its clock late. When all topics come from one process the true
place is known well: between the messages that were recorded before and after. Importers write such
logs with ``log_time`` = the earliest stamp of a message and all that follow it in the source.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace

from graphslam.core.records import Message

#: ns: a stamp may be this much later than the recording: clocks are read twice
TOLERANCE_NS = 1_000_000
#: a run of more messages than this is no hiccup of a logger
LONGEST_RUN = 64

Recorded = tuple[str, Message, int]


def repair_future_stamps(
    recorded: Iterable[Recorded], sampled: tuple[type, ...]
) -> Iterator[Recorded]:
    """Give messages that are stamped after their recording a ``time_ns`` that fits the recording.

    A run of them is spread evenly between the last sound message and their time of recording. A
    topic of which more than half is stamped after its recording has another clock than the
    recorder; it is left as it is.

    Args:
        recorded: (topic, message, log_time ns) in the order of recording.
        sampled: kinds of message for which the order of recording is evidence of time.

    Yields:
        The same, in the same order.
    """
    run: list[Recorded] = []
    sound_ns: int | None = None  # time of the last sound message
    late: Counter[str] = Counter()
    seen: Counter[str] = Counter()
    for topic, message, log_ns in recorded:
        is_late = isinstance(message, sampled) and message.stamp_ns > log_ns + TOLERANCE_NS
        seen[topic] += 1
        late[topic] += is_late
        if is_late and 2 * late[topic] <= seen[topic] and sound_ns is not None:
            if run and (log_ns != run[0][2] or len(run) == LONGEST_RUN):
                yield from _spread(run, sound_ns)
                sound_ns, run = run[0][2], []
            run.append((topic, message, log_ns))
            continue
        if run:
            yield from _spread(run, sound_ns)
            run = []
        sound_ns = message.time_ns
        yield topic, message, log_ns
    yield from _spread(run, sound_ns)


def _spread(run: list[Recorded], sound_ns: int | None) -> Iterator[Recorded]:
    for number, (topic, message, log_ns) in enumerate(run, start=1):
        begin = log_ns if sound_ns is None else min(sound_ns, log_ns)
        time_ns = begin + (log_ns - begin) * number // (len(run) + 1)
        yield topic, replace(message, time_ns=time_ns), log_ns
