"""How far a job is, and how long its stages take."""

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

from graphslam.core.records import Message, TrueLandmark, Truth
from graphslam.core.stages import announce
from graphslam.logs import LogSet

#: messages between two reports of progress
REPORT_EVERY = 500

Progress = Callable[[int], None]


@contextmanager
def timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Announces a stage, and adds the wall time of its body to the stage's."""
    announce(stage)
    began = time.perf_counter()
    yield
    seconds[stage] += time.perf_counter() - began


def of_all(log: LogSet, progress: Callable[[int, int], None] | None) -> Progress:
    """``progress`` with the number of messages that are read altogether."""
    if progress is None:
        return lambda _done: None
    total = log.count((Truth, TrueLandmark)) + sum(t.count for t in log.further_lasers)
    return lambda done: progress(done, total)


def counted(
    messages: Iterable[Message], counts: Counter[str], progress: Progress
) -> Iterator[Message]:
    """The messages, counted; ``progress`` gets their number now and then."""
    for message in messages:
        counts["messages"] += 1
        if counts["messages"] % REPORT_EVERY == 0:
            progress(counts["messages"])
        yield message
