"""Work in a second process, while this one goes on.

The second process is a fork: it begins with everything there is here, uncopied, and only what it
makes is sent back. A fork must be the program's own decision, and its only thread must be this one,
so nothing forks before `allow`; else, and wherever there is nothing to gain, the same work is done
here. Nor is anything lost when the second process dies: the rest is made here.
"""

import gc
import os
import pickle
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from itertools import islice, zip_longest
from pathlib import Path
from typing import Generic, TypeVar

_S = TypeVar("_S")
_T = TypeVar("_T")

#: one entry per thread of this process
THREADS = Path("/proc/self/task")
#: items sent at once
BATCH = 256

_allowed = ContextVar("allowed", default=False)


def allow_fork(*, second: bool = True) -> None:
    """Whether this process may fork from now on, where it can and has a second core."""
    _allowed.set(second and sys.platform == "linux" and len(os.sched_getaffinity(0)) > 1)


def can_fork() -> bool:
    """Whether work begun now is done in a second process.

    Not where a library runs threads of its own: a fork has none of them, but all of their locks.
    """
    return _allowed.get() and THREADS.is_dir() and sum(1 for _ in THREADS.iterdir()) == 1


class Prefetch(Generic[_T]):
    """What an iterator yields, made ahead of the one who takes it, as far as a pipe is long.

    To be iterated over once. ``make`` is called again where the second process came to an end
    before its work did, also because of an error, which is then raised here. ``forked``: whether
    there is a second process.
    """

    def __init__(self, make: Callable[[], Iterator[_T]]) -> None:
        """Begin."""
        self._make = make
        self.forked = can_fork() and self._fork()

    def _fork(self) -> bool:
        self._source, sink = os.pipe()
        try:
            self._pid = os.fork()
        except OSError:  # no memory, or no process, to be had
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
            gc.freeze()  # or looking for cycles would copy what is shared
            with os.fdopen(sink, "wb") as stream:
                items = self._make()
                while batch := list(islice(items, BATCH)):
                    pickle.dump(batch, stream, pickle.HIGHEST_PROTOCOL)
                pickle.dump([], stream)
            done = 0
        finally:
            os._exit(done)  # nothing of the program that was forked may run on here

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
                pass  # it came to an end too early
            finally:
                os.kill(self._pid, signal.SIGKILL)
                os.waitpid(self._pid, 0)
        yield from islice(self._make(), taken, None)


class Future(Generic[_T]):
    """A task that is begun, and its result; ``done`` where there is nothing to wait for.

    Where there is no second process it is done at once, so that it always finds things as they
    are when it begins; only if that process dies is it done by `result`, and finds them as they
    are then. Its result must be picklable.
    """

    def __init__(self, task: Callable[[], _T]) -> None:
        """Begin."""
        self._made = Prefetch(lambda: iter([task()]))
        self.done = not self._made.forked
        if self.done:
            self._result = next(iter(self._made))

    def result(self) -> _T:
        """What it returned; raises what it raised."""
        if not self.done:
            (self._result,) = self._made
            self.done = True
        return self._result


def parallel_map(
    function: Callable[[_S], _T], arguments: Sequence[_S], *, fewest: int = 2
) -> list[_T]:
    """Results of a function for each argument, every other one found by a second process.

    ``fewest`` arguments are worth one.
    """
    if len(arguments) < fewest or not can_fork():
        return [function(a) for a in arguments]
    others = Future(lambda: [function(a) for a in arguments[1::2]])
    found = [function(a) for a in arguments[::2]]
    return [one for pair in zip_longest(found, others.result()) for one in pair][: len(arguments)]
