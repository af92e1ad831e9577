"""A second process that answers one question after another; see `worker`."""

import gc
import os
import pickle
import signal
from collections.abc import Callable
from contextlib import suppress
from typing import Generic, Self, TypeVar

from graphslam.core.worker import allow_fork, can_fork

_S = TypeVar("_S")
_T = TypeVar("_T")


class Companion(Generic[_S, _T]):
    """A second process that applies a function, again and again, beside this one.

    It has this process' memory as it is now, and keeps what it computes for later calls. Without a
    second process the function is called here. To be used as a context, which ends the process.
    """

    def __init__(self, function: Callable[[_S], _T]) -> None:
        """Begin. Arguments and results must be picklable."""
        self._function = function
        self.forked = can_fork() and self._fork()

    def _fork(self) -> bool:
        questions, ask = os.pipe()
        answers, answer = os.pipe()
        try:
            self._pid = os.fork()
        except OSError:  # no memory or no process available
            for end in (questions, ask, answers, answer):
                os.close(end)
            return False
        if self._pid:
            os.close(questions)
            os.close(answer)
            self._ask, self._answers = os.fdopen(ask, "wb"), os.fdopen(answers, "rb")
            return True
        done = 1
        try:
            os.close(ask)
            os.close(answers)
            allow_fork(second=False)
            gc.freeze()  # see `Prefetch`
            with os.fdopen(questions, "rb") as asked, os.fdopen(answer, "wb") as answered:
                while True:
                    pickle.dump(self._function(pickle.load(asked)), answered)
                    answered.flush()
        except EOFError:  # no more questions
            done = 0
        finally:
            os._exit(done)  # nothing else of the forked program may run here

    def both(self, here: _S, there: _S) -> tuple[_T, _T]:
        """Results for two arguments, the second one from the second process."""
        if not self.forked:
            return self._function(here), self._function(there)
        try:
            pickle.dump(there, self._ask, pickle.HIGHEST_PROTOCOL)
            self._ask.flush()
        except OSError:
            self.close()
            return self._function(here), self._function(there)
        mine = self._function(here)
        try:
            return mine, pickle.load(self._answers)
        except (EOFError, pickle.UnpicklingError):  # it ended, maybe by an error: raised here
            self.close()
            return mine, self._function(there)

    def close(self) -> None:
        """End the second process; from now on the function is called here."""
        if self.forked:
            self.forked = False
            os.kill(self._pid, signal.SIGKILL)
            os.waitpid(self._pid, 0)
            self._answers.close()
            with suppress(OSError):  # what was not sent is not wanted any more
                self._ask.close()

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the second process."""
        self.close()
