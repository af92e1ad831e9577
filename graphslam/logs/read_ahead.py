"""A queue of items whose work is done by threads ahead of its turn; results come in order.

For work that does not hold Python's lock, such as unpacking bz2. Memory holds `MOST_BYTES` of work
that is not taken yet, at most; a larger piece is done when it is its turn. At the end no thread is
left: a program with threads must not fork.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Generic, TypeVar

from graphslam.core.worker import THREADS, core_count

_T = TypeVar("_T")

#: held of work that is done ahead, with what it is made of
MOST_BYTES = 16 << 20
#: threads at most; s to wait until those that have ended are gone
MOST_THREADS, GONE_S = 4, 1.0


class ReadAhead(Generic[_T]):
    """The queue; a context manager."""

    def __init__(self) -> None:
        """Empty."""
        self._waiting: deque[tuple[_T, Callable[[], bytes], int]] = deque()
        self._held = 0
        self._threads: list[int] = []
        self._pool = ThreadPoolExecutor(
            min(MOST_THREADS, core_count()),
            initializer=lambda: self._threads.append(threading.get_native_id()),
        )

    def __enter__(self) -> "ReadAhead[_T]":
        return self

    def __exit__(self, *error: object) -> None:
        """Wait for the threads; what they have not begun is not done."""
        self._pool.shutdown(cancel_futures=True)
        # the system lists a thread for a moment after it has ended
        until = time.monotonic() + GONE_S
        while any((THREADS / str(n)).exists() for n in self._threads) and time.monotonic() < until:
            time.sleep(1e-4)

    def put(
        self, item: _T, work: Callable[[], bytes], size: int
    ) -> Iterator[tuple[_T, Callable[[], bytes]]]:
        """Begin the work of an item, which holds ``size`` bytes, its result included.

        Returns:
            Items that leave the queue first, to make room, each with what gives the result of its
            work or raises its error. To be exhausted.
        """
        while self._waiting and self._held + size > MOST_BYTES:
            yield self._take()
        if size > MOST_BYTES:
            yield item, work
            return
        self._waiting.append((item, self._pool.submit(work).result, size))
        self._held += size

    def take_all(self) -> Iterator[tuple[_T, Callable[[], bytes]]]:
        """All items, as `put` returns them."""
        while self._waiting:
            yield self._take()

    def _take(self) -> tuple[_T, Callable[[], bytes]]:
        item, result, size = self._waiting.popleft()
        self._held -= size
        return item, result
