"""Workers that are processes of this machine: the standard library's pool.

A pool breaks when one of its processes dies. The tasks that it had in hand then are done again, one
at a time, so that the one that kills its process is found and the others go on.
"""

import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import (
    active_children,
    connection,
    get_context,
    parent_process,
    resource_tracker,
)
from typing import Any

from graphslam.campaigns.tasks import (
    THREADS,
    Outcome,
    Task,
    WorkerLostError,
    Workers,
    execute,
    memory_per_worker,
)
from graphslam.core.worker import core_count

#: tasks in hand for each process: one that it does and one that waits for it
AHEAD = 2
#: how often a task whose process died is done again, alone
TRIES_ALONE = 2


def process_count(workers: Workers, tasks: int) -> int:
    """How many processes work on so many tasks."""
    return max(1, min(workers.jobs or core_count(), tasks))


def run_in_processes(
    tasks: Sequence[Task], workers: Workers, announce: Callable[[str], None]
) -> Iterator[Outcome]:
    """Outcomes of all tasks as they end; see `graphslam.campaigns.engine.run_tasks`."""
    waiting = deque(tasks)
    count = process_count(workers, len(tasks))
    memory_mb = memory_per_worker(workers, count)
    announce(f"{count} process{'es' * (count > 1)}, {1e-3 * memory_mb:.1f} GB each")
    while waiting:
        suspects = yield from _run(waiting, count, memory_mb)
        for task in suspects:
            for _ in range(TRIES_ALONE):
                if not (yield from _run(deque([task]), 1, memory_mb)):
                    break
            else:
                said = f"{task.label}: its process died, alone as well; did it run out of memory?"
                yield Outcome(task, error=WorkerLostError(said))


def _run(
    waiting: deque[Task], count: int, memory_mb: float
) -> Generator[Outcome, None, list[Task]]:
    """Outcomes, until nothing waits or a process dies; returns what was in hand then."""
    others = set(active_children())
    running: dict[Future[Any], Task] = {}
    with _one_thread_each():
        pool = ProcessPoolExecutor(count, get_context("spawn"), initializer=_end_with_parent)
        try:
            while waiting or running:
                try:
                    while waiting and len(running) < AHEAD * count:
                        with _without_ctrl_c():  # a process may be started
                            future = pool.submit(execute, waiting[0], memory_mb)
                        running[future] = waiting.popleft()
                except BrokenProcessPool:  # and so is everything in hand
                    wait(running)
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                ended = [f for f in done if not isinstance(f.exception(), BrokenProcessPool)]
                for future in ended:
                    task, error = running.pop(future), future.exception()
                    yield Outcome(task, None if error else future.result(), error)
                if len(ended) < len(done):
                    return list(running.values())
        finally:
            if running:  # nobody waits for them any more
                for process in set(active_children()) - others:
                    process.kill()
            pool.shutdown(wait=True, cancel_futures=True)
    return []


def _end_with_parent() -> None:
    """Let this worker die with who started it, however that ended."""
    parent = parent_process()
    assert parent is not None  # only called in child processes

    def watch() -> None:
        connection.wait([parent.sentinel])
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """Processes started inside ignore Ctrl-C, which a terminal sends to all of its processes.

    Only the parent acts on it, as soon as the block ends: children inherit the signal mask.
    """
    resource_tracker.ensure_running()  # its start would lift the mask
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes started inside use one thread each in linear algebra."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
