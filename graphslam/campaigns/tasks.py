"""What a worker is asked to do, what comes of it, and what it may use.

A task may be done twice, if its worker is lost on the way: it must then give the same again.
"""

import gc
import math
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from graphslam.core.allocation import give_back_freed_memory
from graphslam.core.errors import GraphSlamError, OutputError
from graphslam.core.memory_limit import limited_memory
from graphslam.core.source_digest import source_digest

#: variables by which linear algebra chooses its threads; one each, as there is a worker per core
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
#: share of the machine's memory that its workers have together
MEMORY_SHARE = 0.9
#: new objects between two garbage collections, as in commands
COLLECTION_INTERVAL = 100_000
#: s; garbage is collected after tasks that took longer: it takes a twentieth of a second
LONG_S = 5.0

_one_at_a_time = threading.Lock()


@dataclass(frozen=True)
class Task:
    """A call of a function of a module, with arguments that can be pickled.

    ``label`` names it for people, for example by its log; labels of one run differ.
    """

    label: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...] = ()


@dataclass(frozen=True)
class Outcome:
    """What a task returned, or the error that it ended with."""

    task: Task
    value: Any = None
    error: BaseException | None = None


@dataclass(frozen=True)
class Workers:
    """Who works: ``jobs`` processes of this machine (None: one per core), or a cluster.

    ``scheduler`` is the address of Dask's scheduler, or its scheduler file. ``memory_mb``: of each
    worker; None: its share of the machine, on a cluster what the worker was started with.
    """

    jobs: int | None = None
    scheduler: str | None = None
    memory_mb: float | None = None


class WorkerLostError(GraphSlamError):
    """Whoever did a task died, more than once: most likely it took too much memory."""


def execute(task: Task, memory_mb: float = math.inf, code: str | None = None) -> Any:
    """Do a task in this process, with at most ``memory_mb`` of data.

    ``code``: `code_version` of who asks; None: not compared.

    Raises:
        OutputError: this worker has another version of the package.
        GraphSlamError: the task needs more memory, or whatever it raises.
    """
    if code not in (None, code_version()):
        raise OutputError(
            "a worker has another version of graphslam than this command; "
            "install the same one everywhere"
        )
    gc.set_threshold(COLLECTION_INTERVAL, *gc.get_threshold()[1:])
    needed = (
        f"{task.label}: needs more memory than the {memory_mb:.0f} MB of a worker; "
        "have fewer workers with more memory each, or cut the log into pieces"
    )
    with _one_at_a_time:
        forget_peak_memory()
        began = time.perf_counter()
        try:
            with limited_memory(memory_mb, needed):
                return task.function(*task.arguments)
        finally:
            if time.perf_counter() - began > LONG_S:
                gc.collect()


def forget_peak_memory() -> None:
    """Let the peak memory of this process begin anew, where the system can: see proc(5)."""
    give_back_freed_memory()
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def memory_per_worker(workers: Workers, count: int) -> float:
    """Memory of each of ``count`` workers of this machine, MB."""
    if workers.memory_mb is not None:
        return workers.memory_mb
    return MEMORY_SHARE * machine_memory_mb() / count


def machine_memory_mb() -> float:
    """Memory of this machine, or of the container that this is, MB."""
    total = 1e-6 * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    with suppress(OSError, ValueError):
        # control groups, version 2; without a limit it says max
        limit = Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii")
        total = min(total, 1e-6 * float(limit))
    return total


def code_version() -> str:
    """First digits of `source_digest`."""
    return source_digest()[:12]
