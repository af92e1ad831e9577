"""Runs tasks: a row of `EXECUTORS` for each kind of workers."""

from collections.abc import Callable, Iterator, Sequence
from typing import TypeAlias

from graphslam.campaigns import dask_cluster, process_pool
from graphslam.campaigns.tasks import Outcome, Task, Workers

Announce: TypeAlias = Callable[[str], None]
Executor: TypeAlias = Callable[[Sequence[Task], Workers, Announce], Iterator[Outcome]]

#: kind of workers -> what has tasks done by them
EXECUTORS: dict[str, Executor] = {
    "processes": process_pool.run_in_processes,
    "dask": dask_cluster.run_on_cluster,
}


def run_tasks(
    tasks: Sequence[Task], workers: Workers, announce: Announce = lambda _text: None
) -> Iterator[Outcome]:
    """The outcome of every task, once, in the order in which they end.

    Tasks begin in their order. What a lost worker had in hand is done again. Who stops iterating,
    also by Ctrl-C, cancels what has not begun. ``announce`` is called with a line on who works, and
    with how much memory each.

    Raises:
        OutputError: the cluster cannot be reached, or cannot do this work.
    """
    if not tasks:
        return
    kind = "processes" if workers.scheduler is None else "dask"
    yield from EXECUTORS[kind](tasks, workers, announce)
