"""A second process that works beside this one and exchanges values with it; see `worker`.

`Companion` answers one question after another; `Exchange` is a generator that works ahead.
"""

import gc
import os
import pickle
import signal
from collections.abc import Callable, Generator, Sequence
from contextlib import suppress
from typing import Any, Generic, Self, TypeVar

from graphslam.core.worker import allow_fork, can_fork, wide_pipe

_S = TypeVar("_S")
_T = TypeVar("_T")

#: what ends the work with a process that died, maybe by an error: its work is done here
DIED = (EOFError, OSError, pickle.UnpicklingError)


class _Partner:
    """A fork of this process, with a pipe in either direction; ``forked``: whether there is one.

    It has this process' memory as it was at the start. To be used as a context, which ends it.
    """

    forked = False

    def _fork(self, serve: Callable[[Callable[[], Any], Callable[[Any], None]], None]) -> None:
        """Begin, if this process may: ``serve`` gets functions that receive and send a value."""
        if not can_fork():
            return
        theirs, ours = os.pipe()
        back, forth = wide_pipe()
        try:
            self._pid = os.fork()
        except OSError:  # no memory or no process available
            for end in (theirs, ours, back, forth):
                os.close(end)
            return
        if self._pid:
            os.close(theirs)
            os.close(forth)
            self._sink, self._source = os.fdopen(ours, "wb"), os.fdopen(back, "rb")
            self.forked = True
            return
        done = 1
        try:
            os.close(ours)
            os.close(back)
            allow_fork(second=False)
            gc.freeze()  # else the search for cycles would copy shared memory
            with os.fdopen(theirs, "rb") as source, os.fdopen(forth, "wb") as sink:

                def send(value: Any) -> None:
                    pickle.dump(value, sink, pickle.HIGHEST_PROTOCOL)
                    sink.flush()

                serve(lambda: pickle.load(source), send)
            done = 0
        except EOFError:  # nothing more is asked
            done = 0
        finally:
            os._exit(done)  # nothing else of the forked program may run here

    def _send(self, value: Any) -> None:
        pickle.dump(value, self._sink, pickle.HIGHEST_PROTOCOL)
        self._sink.flush()

    def _receive(self) -> Any:
        return pickle.load(self._source)

    def close(self) -> None:
        """End the second process; from now on its work is done here."""
        if self.forked:
            self.forked = False
            os.kill(self._pid, signal.SIGKILL)
            os.waitpid(self._pid, 0)
            self._source.close()
            with suppress(OSError):  # what was not sent is not wanted any more
                self._sink.close()

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the second process."""
        self.close()


class Companion(_Partner, Generic[_S, _T]):
    """A second process that applies a function, again and again, beside this one.

    It keeps what it computes for later calls. Without a second process the function is called here.
    """

    def __init__(self, function: Callable[[_S], _T]) -> None:
        """Begin. Arguments and results must be picklable."""
        self._function = function

        def serve(receive: Callable[[], _S], send: Callable[[_T], None]) -> None:
            while True:
                send(function(receive()))

        self._fork(serve)

    def both(self, here: _S, there: _S) -> tuple[_T, _T]:
        """Results for two arguments, the second one from the second process."""
        if self.forked:
            try:
                self._send(there)
            except DIED:
                self.close()
        mine = self._function(here)
        if self.forked:
            try:
                return mine, self._receive()
            except DIED:
                self.close()
        return mine, self._function(there)


class Exchange(_Partner, Generic[_S, _T]):
    """A generator that works ahead: the items that it yields, and values sent to it meanwhile.

    After each item the generator gets a value: those that were sent, in their order, and None where
    none was sent before the next item is asked for. The generator works on while there are values
    that it has not got: as many items ahead as values were sent ahead. Without a second process, or
    if that one dies, ``make`` is called here and gets the same values, so that the items are the
    same.
    """

    def __init__(
        self, make: Callable[[], Generator[_T, _S | None, None]], first: Sequence[_S | None] = ()
    ) -> None:
        """Begin with the first item. Items and values must be picklable.

        ``first`` are the values after the first items, which the generator need not wait for.
        """
        self._make = make
        self._values: list[_S | None] = []
        self._taken = self._made = 0
        self._ended = False
        self._generator: Generator[_T, _S | None, None] | None = None

        def serve(receive: Callable[[], _S | None], send: Callable[[tuple[_T, ...]], None]) -> None:
            generator, value = make(), None
            with suppress(StopIteration):
                while True:
                    send((generator.send(value),))
                    value = receive()
            send(())
            while True:  # values that it did not wait for
                receive()

        self._fork(serve)
        for value in first:
            self.send(value)

    def send(self, value: _S | None) -> None:
        """What the generator gets after the first item for which there is no value yet."""
        self._values.append(value)
        if self.forked:
            try:
                self._send(value)
            except DIED:
                self.close()

    def receive(self) -> _T | None:
        """The next item; None after the last."""
        if self._ended:
            return None
        if len(self._values) < self._taken:
            self.send(None)
        if self.forked:
            try:
                item: tuple[_T, ...] = self._receive()
            except DIED:
                self.close()
            else:
                if item:
                    self._taken += 1
                    return item[0]
                self._ended = True
                self.close()
                return None
        return self._made_here()

    def _made_here(self) -> _T | None:
        if self._generator is None:
            self._generator = self._make()
        while True:
            try:
                item = self._generator.send(self._values[self._made - 1] if self._made else None)
            except StopIteration:
                return None
            self._made += 1
            if self._made > self._taken:
                self._taken += 1
                return item
