"""Who is told which stage of a job runs, without passing a function through every call.

A stage is announced where its time is taken; what listens, such as the progress bar of the
commands, is set for the duration of a block.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

Listener = Callable[[str], None]

_LISTENER: ContextVar[Listener | None] = ContextVar("listener", default=None)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Calls ``listener`` with the name of every stage that begins within the block.

    Not of stages in forks of this process: what a fork has to say is not seen in its memory, and
    two would write to one terminal.
    """
    process = os.getpid()

    def heard(stage: str) -> None:
        if os.getpid() == process:
            listener(stage)

    token = _LISTENER.set(heard)
    try:
        yield
    finally:
        _LISTENER.reset(token)


def announce(stage: str) -> None:
    """Says that a stage begins."""
    listener = _LISTENER.get()
    if listener is not None:
        listener(stage)
