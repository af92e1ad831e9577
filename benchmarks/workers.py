"""What does it cost to have tasks done by workers, and how much is done by two?

    python benchmarks/workers.py [--only overhead|throughput] [--jobs 2] [--logs 16]

Overhead: 100 tasks that sleep 2 s, by two workers, against the 100 s that they take; of the process
pool and, with the extra `cluster`, of a Dask cluster on this machine. At most 5 %.
Throughput: 16 simulated logs as one batch by two processes, against two shells that each run
`graphslam smooth` for half of them, one log after the other. At least 0.85 of what they reach.
Both want a machine that does nothing else. Exit code 1 if a bar is not held.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from importlib.util import find_spec
from pathlib import Path

from graphslam.campaigns.engine import run_tasks
from graphslam.campaigns.tasks import Task, Workers

TASKS, TASK_S, OVERHEAD, SHARE = 100, 2.0, 0.05, 0.85


@contextmanager
def local_cluster(jobs: int) -> Iterator[str]:
    """The address of a scheduler with workers on this machine."""
    from distributed import LocalCluster  # noqa: PLC0415 -- of an extra

    with LocalCluster(n_workers=jobs, threads_per_worker=1, dashboard_address=None) as cluster:
        yield cluster.scheduler_address


def overhead(jobs: int) -> bool:
    """Print and judge what the engines add."""
    held = True
    kinds = ["processes", *(["dask"] if find_spec("distributed") else [])]
    for kind in kinds:
        with nullcontext("") if kind == "processes" else local_cluster(jobs) as address:
            workers = Workers(scheduler=address) if address else Workers(jobs)
            tasks = [Task(f"{k}", time.sleep, (TASK_S,)) for k in range(TASKS)]
            began = time.perf_counter()
            done = sum(outcome.error is None for outcome in run_tasks(tasks, workers))
            took = time.perf_counter() - began
        least = TASKS * TASK_S / jobs
        share = took / least - 1
        print(f"{kind}: {done} tasks of {TASK_S} s by {jobs}: {took:.1f} s, {100 * share:.1f} %")
        held &= share <= OVERHEAD
    return held


def throughput(jobs: int, logs: int) -> bool:
    """Print and judge how much a batch gets done."""
    from graphslam.simulation import load_scenario, simulate  # noqa: PLC0415

    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        (folder / "logs").mkdir()
        names = ("lab", "office-loop", "forest", "corridor")
        paths = [folder / f"logs/{k:02d}.mcap" for k in range(logs)]
        for k, path in enumerate(paths):
            simulate(load_scenario(names[k % len(names)]), path, k)
        ours = [sys.executable, "-m", "graphslam"]

        def shells() -> float:
            began = time.perf_counter()
            loop = 'for log in "$@"; do taskset -c $core "$0" -m graphslam smooth "$log" '
            loop += '-o "$log.out" --force --quiet || exit 1; done'
            halves = [
                ["sh", "-c", f"core={core}; {loop}", sys.executable, *map(str, paths[core::jobs])]
                for core in range(jobs)
            ]
            running = [subprocess.Popen(half) for half in halves]
            if any(process.wait() for process in running):
                sys.exit("a run failed")
            return time.perf_counter() - began

        def batch() -> float:
            began = time.perf_counter()
            command = [*ours, "batch", folder / "logs", "-o", folder / "out", "--jobs", str(jobs)]
            subprocess.run([*map(str, command), "--force", "--quiet"], check=True)
            return time.perf_counter() - began

        took: dict[str, list[float]] = {"two shells": [], "batch": []}
        cores: dict[str, list[float]] = {"two shells": [], "batch": []}
        for _ in range(2):  # in turn, so that both meet the same machine
            for name, run in (("two shells", shells), ("batch", batch)):
                before = os.times()
                took[name].append(run())
                after = os.times()
                used = after.children_user + after.children_system
                cores[name].append(used - before.children_user - before.children_system)
    least = {name: min(times) for name, times in took.items()}
    for name, seconds in least.items():
        print(f"{name}: {logs} logs in {seconds:.1f} s, {min(cores[name]):.1f} core seconds")
    share = least["two shells"] / least["batch"]
    print(f"throughput of the batch: {share:.2f} of that of {jobs} independent processes")
    return share >= SHARE


def main() -> None:
    # every process that is started imports this module: nothing heavy at its beginning
    raw = argparse.RawDescriptionHelpFormatter
    options = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    options.add_argument("--only", choices=["overhead", "throughput"])
    options.add_argument("--jobs", type=int, default=2)
    options.add_argument("--logs", type=int, default=16)
    arguments = options.parse_args()
    held = True
    if arguments.only != "throughput":
        held &= overhead(arguments.jobs)
    if arguments.only != "overhead":
        held &= throughput(arguments.jobs, arguments.logs)
    sys.exit(0 if held else 1)


if __name__ == "__main__":
    main()
