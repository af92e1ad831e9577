"""Workers of a cluster: Dask distributed, whose scheduler knows who does what.

Only calls go over the network: logs are read where they lie, in a folder that all see. A lost
worker's tasks are given to others by the scheduler; a task whose worker dies again and again (the
scheduler's setting ``allowed-failures``) is given up. The scheduler counts this against all that a
worker had in hand, also those that only waited behind the one that killed it: when several are
given up, they are tried once more with none behind another. See docs/clusters.md.
"""

import logging
import math
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import closing
from typing import Any
from uuid import uuid4

from graphslam.campaigns.tasks import (
    Outcome,
    Task,
    WorkerLostError,
    Workers,
    code_version,
    execute,
)
from graphslam.core.errors import OutputError

#: s; a scheduler that does not answer within it is not there
CONNECT_S = 20.0
_MB = 1e6


def run_on_cluster(
    tasks: Sequence[Task], workers: Workers, announce: Callable[[str], None]
) -> Iterator[Outcome]:
    """Outcomes of all tasks as they end; see `graphslam.campaigns.engine.run_tasks`.

    Raises:
        OutputError: the scheduler cannot be reached or is gone, or its workers cannot do this.
    """
    import distributed  # noqa: PLC0415 -- of an extra, and takes long

    assert workers.scheduler is not None  # else it is another row of `EXECUTORS`
    # it warns of lost workers, whose tasks are done again
    logging.getLogger("distributed").setLevel(logging.ERROR)
    client = _connect(workers.scheduler)
    try:
        announce(_checked(client, workers))
        given_up: list[Outcome] = []
        with closing(_ended(client, tasks, workers.memory_mb)) as ended:
            for outcome in ended:
                if isinstance(outcome.error, WorkerLostError):
                    given_up.append(outcome)
                else:
                    yield outcome
        if len(given_up) < 2:  # nobody else can have killed its workers
            yield from given_up
            return
        while given_up:
            at_once = max(len(client.scheduler_info(n_workers=-1)["workers"]), 1)
            again = [outcome.task for outcome in given_up[:at_once]]
            del given_up[:at_once]
            yield from _ended(client, again, workers.memory_mb)
    except (CancelledError, distributed.comm.CommClosedError) as error:
        raise OutputError(
            f"{workers.scheduler}: the scheduler is gone; what is done is kept, run it again"
        ) from error
    finally:
        client.close()


def _ended(client: Any, tasks: Sequence[Task], memory_mb: float | None) -> Generator[Outcome]:
    """Outcomes as they end; what has not ended when the caller stops is cancelled."""
    import distributed  # noqa: PLC0415 -- of an extra, and takes long

    futures: dict[Any, Task] = {}
    try:
        # the key is what the dashboard shows; its last part makes it unlike that of an earlier run
        run = uuid4().hex[:8]
        for task in tasks:
            key = f"{task.function.__name__}-{task.label}-{run}"
            asked = (task, memory_mb, code_version())
            futures[client.submit(execute_on_worker, *asked, key=key, pure=False)] = task
        # values are fetched as soon as they are there: those that a worker still holds die with it
        ended = distributed.as_completed(
            list(futures), loop=client.loop, with_results=True, raise_errors=False
        )
        for future, value in ended:
            task = futures.pop(future)
            yield _outcome(task, future, value, distributed.KilledWorker)
            future.release()
    finally:
        if futures and client.status == "running":
            client.cancel(list(futures), force=True)


def execute_on_worker(task: Task, memory_mb: float | None, code: str) -> Any:
    """`execute` in a worker of Dask, with the memory that it was started with.

    Raises:
        GraphSlamError: see `execute`.
    """
    import distributed  # noqa: PLC0415 -- of an extra

    own = getattr(distributed.get_worker().memory_manager, "memory_limit", None)
    limits = [own / _MB if own else math.inf, memory_mb or math.inf]
    return execute(task, min(limits), code)


def _connect(address: str) -> Any:
    """A client of the scheduler at an address, or of the one that wrote a scheduler file."""
    import distributed  # noqa: PLC0415 -- of an extra, and takes long

    given = {"scheduler_file": address} if address.endswith(".json") else {"address": address}
    try:
        return distributed.Client(
            **given, timeout=CONNECT_S, name="graphslam", set_as_default=False
        )
    except (OSError, TimeoutError, ValueError) as error:
        why = " ".join(str(error).split()) or type(error).__name__
        raise OutputError(
            f"{address}: no scheduler answers ({why}); start one with: dask scheduler"
        ) from error


def _checked(client: Any, workers: Workers) -> str:
    """Who works, in words; there may be nobody yet.

    Raises:
        OutputError: a worker has several threads, or another version of the package.
    """
    there: Mapping[str, Mapping[str, Any]] = client.scheduler_info(n_workers=-1)["workers"]
    for address, worker in there.items():
        if worker["nthreads"] != 1:
            raise OutputError(
                f"{address}: this worker has {worker['nthreads']} threads; start workers with "
                "--nthreads 1, as many as there are cores"
            )
    for address, code in client.run(code_version, on_error="return").items():
        if code != code_version():
            why = f": {code!r}" if isinstance(code, BaseException) else ", but another version"
            raise OutputError(
                f"{address}: this worker has not the graphslam of this command{why}; install the "
                "same one, and start the worker again"
            )
    limits = {worker["memory_limit"] or math.inf for worker in there.values()}
    least = min([*(limit / _MB for limit in limits), workers.memory_mb or math.inf])
    each = f", {1e-3 * least:.1f} GB each" if math.isfinite(least) else ", memory without a limit"
    if not there:
        return f"nobody yet at {workers.scheduler}; it begins when a worker comes"
    return f"{len(there)} worker{'s' * (len(there) > 1)} of {workers.scheduler}{each}"


def _outcome(task: Task, future: Any, value: Any, killed: type[Exception]) -> Outcome:
    if future.status == "cancelled":
        raise CancelledError
    error = future.exception() if future.status == "error" else None
    if isinstance(error, killed):
        said = f"{task.label}: every worker that had it died; did they run out of memory?"
        error = WorkerLostError(said)
    return Outcome(task, None if error else value, error)
