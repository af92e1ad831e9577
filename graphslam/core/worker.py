"""Concurrent work in a second process.

The second process is a fork: it shares this process' memory (copy on write), and only its results
are sent back. Only a program that has a single thread may fork, so nothing forks before
`allow_fork`. Otherwise, and where nothing would be gained, the same work is done in this process.
If the second process dies, the remaining work is done here.
"""

import gc
import math
import os
import pickle
import select
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from contextvars import ContextVar
from itertools import islice
from pathlib import Path
from typing import Generic, TypeVar

_S = TypeVar("_S")
_T = TypeVar("_T")

#: one entry per thread of this process
THREADS = Path("/proc/self/task")
#: largest pipe, bytes
MOST_ROOM = Path("/proc/sys/fs/pipe-max-size")
#: items sent at once
BATCH = 256
#: ms of work for which a second process is worth it: twice the CPU time that it takes beside, in
#: both, for tables of pages and for copies of those that either writes (35 to 40 at 200 MB)
FORK_MS = 80.0
#: how nice a process is whose result is not waited for soon: it gets a tenth of a shared core
LOW_PRIORITY = 10

_allowed = ContextVar("allowed", default=False)


def allow_fork(*, second: bool = True) -> None:
    """Whether this process may fork from now on, where it can and has a second core."""
    _allowed.set(second and sys.platform == "linux" and core_count() > 1)


def core_count() -> int:
    """Cores that this process may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def can_fork() -> bool:
    """Whether work started now would run in a second process.

    Not where a library runs threads of its own: a fork has their locks but not these threads.
    """
    return _allowed.get() and THREADS.is_dir() and sum(1 for _ in THREADS.iterdir()) == 1


def wide_pipe() -> tuple[int, int]:
    """Ends of a pipe, to read and to write, with all the room that the system allows.

    Who writes works on while who reads is busy; a common pipe has room for some hundred records.
    """
    ends = os.pipe()
    if sys.platform == "linux":
        import fcntl  # noqa: PLC0415 (not on every system)

        with suppress(OSError, ValueError):  # other pipes of the user may have all there is
            fcntl.fcntl(ends[1], fcntl.F_SETPIPE_SZ, int(MOST_ROOM.read_text()))
    return ends


class Prefetch(Generic[_T]):
    """The items of an iterator, computed ahead of the consumer as far as the pipe has room.

    To be iterated over once. ``urgent``: nothing else of this program is more so; else the process
    lets others of the program have a core that both want. ``make`` is called again if the second
    process ended before its work was complete, also because of an error, which is then raised here.
    ``forked``: whether there is a second process.
    """

    def __init__(self, make: Callable[[], Iterator[_T]], *, urgent: bool = True) -> None:
        """Begin."""
        self._make, self._urgent = make, urgent
        self.forked = can_fork() and self._fork()

    def _fork(self) -> bool:
        self._source, sink = wide_pipe()
        try:
            self._pid = os.fork()
        except OSError:  # no memory or no process available
            os.close(self._source)
            os.close(sink)
            return False
        if self._pid:
            os.close(sink)
            return True
        done = 1
        try:
            os.close(self._source)
            allow_fork(second=False)
            gc.freeze()  # else the search for cycles would copy shared memory
            if not self._urgent:
                os.nice(LOW_PRIORITY)
            with os.fdopen(sink, "wb") as stream:
                items = self._make()
                while batch := list(islice(items, BATCH)):
                    pickle.dump(batch, stream, pickle.HIGHEST_PROTOCOL)
                pickle.dump([], stream)
            done = 0
        finally:
            os._exit(done)  # nothing else of the forked program may run here

    def __iter__(self) -> Iterator[_T]:
        """The items."""
        taken = 0
        if self.forked:
            try:
                with os.fdopen(self._source, "rb") as stream:
                    for batch in iter(lambda: pickle.load(stream), []):
                        yield from batch
                        taken += len(batch)
                return
            except (EOFError, pickle.UnpicklingError):
                pass  # it ended before its work was complete
            finally:
                self._end()
        yield from islice(self._make(), taken, None)

    def has_begun(self) -> bool:
        """Whether something of the second process can be read, or it has ended."""
        return not self.forked or bool(select.select([self._source], [], [], 0.0)[0])

    def cancel(self) -> None:
        """End the second process; there is nothing to iterate over any more."""
        if self.forked:
            os.close(self._source)
            self._end()

    def _end(self) -> None:
        self.forked = False  # its number may be that of another process from now on
        os.kill(self._pid, signal.SIGKILL)
        os.waitpid(self._pid, 0)


class Future(Generic[_T]):
    """A task running in a second process; ``done``: its result is available.

    Without a second process the task runs at once, so that it always uses the state of the program
    at its start; only if that process dies does it run in `result`, with the state at that time.
    Its result must be picklable.
    """

    def __init__(
        self, task: Callable[[], _T], *, urgent: bool = True, about_ms: float = math.inf
    ) -> None:
        """Begin; ``urgent``: see `Prefetch`.

        ``about_ms``: how long it takes, if that is known; with less than `FORK_MS` it runs at once.
        """
        self.done = about_ms < FORK_MS
        if self.done:
            self._result = task()
            return
        self._made = Prefetch(lambda: iter([task()]), urgent=urgent)
        self.done = not self._made.forked
        if self.done:
            self._result = next(iter(self._made))

    def is_ready(self) -> bool:
        """Whether `result` would not wait; a task whose result is small is then complete."""
        return self.done or self._made.has_begun()

    def cancel(self) -> None:
        """End the task; its result is not wanted any more."""
        if not self.done:
            self._made.cancel()

    def result(self) -> _T:
        """The task's return value; raises its exception."""
        if not self.done:
            (self._result,) = self._made
            self.done = True
        return self._result


def parallel_map(
    function: Callable[[_S], _T],
    arguments: Sequence[_S],
    *,
    fewest: int = 2,
    efforts: Sequence[float] | None = None,
    unit_ms: float = math.inf,
) -> list[_T]:
    """Results of a function for each argument, half of them from a second process.

    With less than ``fewest`` arguments there is no second process. ``efforts``: about how long each
    takes, in any unit; equally long without. ``unit_ms``: that unit, if it is known; where a second
    process would have less than `FORK_MS` to do there is none.
    """
    efforts = efforts or [1.0] * len(arguments)
    here, there = _shares(efforts)
    few = len(arguments) < fewest or sum(efforts[k] for k in there) * unit_ms < FORK_MS
    if few or not can_fork():
        return [function(a) for a in arguments]
    others = Future(lambda: [function(arguments[k]) for k in there])
    found = {k: function(arguments[k]) for k in here}
    found.update(zip(there, others.result(), strict=True))
    return [found[k] for k in range(len(arguments))]


def _shares(efforts: Sequence[float]) -> tuple[list[int], list[int]]:
    """Numbers of tasks for two processes: the longest first, each to who has less to do so far."""
    shares: tuple[list[int], list[int]] = [], []
    sums = [0.0, 0.0]
    for k in sorted(range(len(efforts)), key=lambda k: -efforts[k]):
        less = int(sums[1] < sums[0])
        shares[less].append(k)
        sums[less] += efforts[k]
    return shares
