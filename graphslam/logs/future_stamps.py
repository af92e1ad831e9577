"""Repair of stamps that are later than the log time of their message.

A message cannot be stamped after it was recorded, so such a stamp is wrong: typically the logging
process fell behind and read its clock late. If all topics come from one process, the true time is
between those of the messages recorded before and after. Importers write such logs with ``log_time``
= the earliest stamp among a message and all messages after it in the source.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace

from graphslam.core.records import Message

#: ns by which a stamp may exceed the log time: the clock is read twice
TOLERANCE_NS = 1_000_000
#: Longest run of late stamps that is repaired at once; a logger does not fall behind for longer.
MAX_RUN = 64

#: topic, message and log time ns
Recorded = tuple[str, Message, int]


def repair_future_stamps(
    recorded: Iterable[Recorded], sampled: tuple[type, ...]
) -> Iterator[Recorded]:
    """Give messages that are stamped after their log time a ``time_ns`` that agrees with it.

    A run of them is spread evenly between the last message without this defect and their log
    time. If more than half of a topic is stamped after the log time, its clock differs from the
    recorder's; such a topic is not changed.

    Args:
        recorded: in the order of recording.
        sampled: types of message for which the order of recording is evidence of time.

    Yields:
        The same messages in the same order.
    """
    run: list[Recorded] = []
    valid_ns: int | None = None  # time of the last message with a valid stamp
    late: Counter[str] = Counter()
    total: Counter[str] = Counter()
    for topic, message, log_ns in recorded:
        is_late = message.stamp_ns > log_ns + TOLERANCE_NS and isinstance(message, sampled)
        total[topic] += 1
        late[topic] += is_late
        if is_late and 2 * late[topic] <= total[topic] and valid_ns is not None:
            if run and (log_ns != run[0][2] or len(run) == MAX_RUN):
                yield from _spread(run, valid_ns)
                valid_ns, run = run[0][2], []
            run.append((topic, message, log_ns))
            continue
        if run:
            yield from _spread(run, valid_ns)
            run = []
        valid_ns = message.time_ns
        yield topic, message, log_ns
    yield from _spread(run, valid_ns)


def _spread(run: list[Recorded], valid_ns: int | None) -> Iterator[Recorded]:
    """The messages with times spread evenly between ``valid_ns`` and their log time."""
    for number, (topic, message, log_ns) in enumerate(run, start=1):
        begin = log_ns if valid_ns is None else min(valid_ns, log_ns)
        time_ns = begin + (log_ns - begin) * number // (len(run) + 1)
        yield topic, replace(message, time_ns=time_ns), log_ns
