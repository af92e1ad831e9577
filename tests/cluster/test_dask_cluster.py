"""A real cluster over loopback: a scheduler and workers in processes of their own.

Needs the extra ``cluster``; left out by `make test`, run by `make extras-test`.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import contextmanager, suppress
from types import SimpleNamespace

import campaign_tasks as do
import distributed
import pytest
from command_line import call, check_one_line
from paths import ROOT
from room_log import drive
from small_experiment import SMALL

from graphslam.campaigns import dask_cluster
from graphslam.campaigns.engine import run_tasks
from graphslam.campaigns.experiment import run_campaign
from graphslam.campaigns.tasks import Task, WorkerLostError, Workers
from graphslam.core.errors import OutputError
from graphslam.evaluation.monte_carlo_definition import load_definition

# of distributed itself, when connections end
pytestmark = pytest.mark.filterwarnings(
    "ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
)

ENVIRONMENT = {**os.environ, "PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}", "OMP_NUM_THREADS": "1"}
PATIENCE_S = 120


@contextmanager
def started(*arguments):
    """A process of Dask in a group of its own, which is killed at the end."""
    command = [sys.executable, "-m", *map(str, arguments)]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    process = subprocess.Popen(command, env=ENVIRONMENT, start_new_session=True, **quiet)
    try:
        yield process
    finally:
        kill(process)


def kill(process):
    """As when its machine fails: the worker and who watches over it, without a word."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def until(condition):
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


@contextmanager
def cluster(folder, workers, *options):
    """A scheduler (its file, its address) and so many worker processes."""
    file = folder / f"scheduler-{time.monotonic_ns()}.json"
    with started(
        "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", 0,
        "--dashboard-address", "127.0.0.1:0", "--scheduler-file", file,
    ) as scheduler:  # fmt: skip
        until(lambda: file.exists() and file.read_text().endswith("}"))
        address = json.loads(file.read_text())["address"]
        entered = [
            started(
                "distributed.cli.dask_worker", address, "--nthreads", 1, "--no-dashboard",
                "--local-directory", folder, *options,
            )
            for _ in range(workers)
        ]  # fmt: skip
        processes = [one.__enter__() for one in entered]
        try:
            with distributed.Client(address, set_as_default=False) as client:
                client.wait_for_workers(workers, timeout=PATIENCE_S)
            yield SimpleNamespace(
                address=address, file=file, workers=processes, scheduler=scheduler
            )
        finally:
            for one in entered:
                one.__exit__(None, None, None)


@pytest.fixture(scope="module")
def three(tmp_path_factory):
    """Three workers of 1 GB each, watched over by Dask's nannies, for tests that harm none."""
    with cluster(tmp_path_factory.mktemp("cluster"), 3, "--memory-limit", "1GB") as found:
        yield found


def test_two_of_three_workers_killed_in_a_run_of_sixty_tasks_cost_nothing(tmp_path):
    """Nothing lost, nothing twice: an outcome of each, as by one process. What the dead had in hand
    is done again by the third."""
    marks = tmp_path / "marks"
    marks.mkdir()
    tasks = [Task(f"task {k}", do.square, (marks, k, 0.2)) for k in range(60)]
    with cluster(tmp_path, 3, "--no-nanny", "--memory-limit", "1GB") as found:
        outcomes = []
        for outcome in run_tasks(tasks, Workers(scheduler=found.address)):
            outcomes.append(outcome)
            if len(outcomes) in (8, 16):
                kill(found.workers[len(outcomes) // 8 - 1])
    assert Counter(o.task.label for o in outcomes) == Counter(t.label for t in tasks)
    alone = {
        o.task.label: o.value
        for o in run_tasks(
            [Task(t.label, t.function, (*t.arguments[:2],)) for t in tasks], Workers(1)
        )
    }
    assert {o.task.label: o.value for o in outcomes} == alone
    # of each dead worker what it had done and not yet told, and what it was doing
    again = [k for k in range(60) if do.begun(marks, k) - 1 > 1]
    assert len(again) <= 10


def test_who_takes_too_much_memory_is_named_and_the_rest_goes_on(three, tmp_path):
    """Once by the limit that a worker has on itself, once by a system that kills it."""
    tasks = [
        *(Task(f"small {k}", do.take_memory, (tmp_path, f"small{k}", 50)) for k in range(4)),
        Task("large.mcap", do.take_memory, (tmp_path, "large", 3000)),
        Task("deadly.mcap", do.die, (tmp_path, "deadly", 99)),
    ]
    told = []
    found = {
        o.task.label: o for o in run_tasks(tasks, Workers(scheduler=three.address), told.append)
    }
    assert len(found) == 6
    assert told == [f"3 workers of {three.address}, 1.0 GB each"]
    small = [found[f"small {k}"] for k in range(4)]
    assert [(o.error, o.value) for o in small] == [(None, pytest.approx(50))] * 4
    assert str(found["large.mcap"].error).startswith(
        "large.mcap: needs more memory than the 1000 MB"
    )
    # it is not tried again; but a worker that `deadly` killed may have had it, and not told yet
    assert do.begun(tmp_path, "large") <= 2
    assert isinstance(found["deadly.mcap"].error, WorkerLostError)
    assert str(found["deadly.mcap"].error).startswith("deadly.mcap: every worker that had it died")


def test_who_waits_behind_a_task_that_kills_its_worker_is_not_given_up(tmp_path):
    """The scheduler counts deaths of a worker against all that it had in hand."""
    tasks = [
        Task("deadly.mcap", do.die, (tmp_path, "deadly", 99)),
        *(Task(f"small {k}", do.square, (tmp_path, k)) for k in range(3)),
    ]
    with cluster(tmp_path, 1, "--memory-limit", "1GB") as one:
        found = {o.task.label: o for o in run_tasks(tasks, Workers(scheduler=one.address))}
    assert isinstance(found.pop("deadly.mcap").error, WorkerLostError)
    assert {label: (o.value, o.error) for label, o in found.items()} == {
        f"small {k}": (k * k, None) for k in range(3)
    }


def test_workers_have_one_thread_in_linear_algebra(three, tmp_path):
    (found,) = run_tasks(
        [Task("a", do.environment, (tmp_path,))], Workers(scheduler=str(three.file))
    )
    assert set(found.value.values()) == {"1"}


def test_rows_of_an_experiment_are_those_of_one_process_also_if_workers_are_killed(tmp_path):
    """60 runs, in their order, apart from their time."""
    (tmp_path / "small.toml").write_text(SMALL.replace("runs = 2", "runs = 30"))
    definition = load_definition(tmp_path / "small.toml")
    alone = run_campaign(definition, tmp_path / "alone", Workers(1))
    with cluster(tmp_path, 3, "--no-nanny", "--memory-limit", "1GB") as found:

        def killing(done):
            if done in (8, 20):
                kill(found.workers[done // 8 - 1])

        workers = Workers(scheduler=found.address)
        run_campaign(definition, tmp_path / "cluster", workers, progress=killing)
        assert [process.poll() is None for process in found.workers] == [False, False, True]
    lines = (tmp_path / "cluster" / "results.jsonl").read_text().splitlines()
    rows = [{**json.loads(line), "seconds": None} for line in lines]
    assert rows == [{**row, "seconds": None} for row in alone]
    assert len(rows) == 60


def test_a_batch_on_a_cluster_is_that_of_processes(three, tmp_path):
    """The broken log is listed with its line."""
    (tmp_path / "logs").mkdir()
    for k in range(3):
        drive(tmp_path / "logs" / f"{k}.mcap", seconds=4 + k)
    (tmp_path / "logs" / "broken.mcap").write_bytes(b"no recording")
    rows = []
    for folder, who in (("cluster", ("--scheduler", three.address)), ("own", ("--jobs", "1"))):
        done = call("batch", tmp_path / "logs", "-o", tmp_path / folder, *who, "--json")
        assert done.code == 1 and "broken: is not an MCAP file" in done.err
        found = json.loads(done.out)
        rows.append([
            {k: v for k, v in row.items() if k not in ("seconds", "memory_mb")}
            for row in found["logs"]
        ])  # fmt: skip
    assert rows[0] == rows[1]
    # workers under a nanny may have no children, in which a comparison otherwise replays
    who = ("--each", "--backends", "ekf,batch", "--scheduler", three.address, "--json")
    done = call("compare", tmp_path / "logs" / "0.mcap", "-o", tmp_path / "compared", *who)
    ((row,),) = [json.loads(done.out)["logs"]]
    assert all(0 < one["error_m"] < 0.1 for one in row["backends"].values())


def test_who_stops_listening_cancels_what_waits(three, tmp_path):
    tasks = [Task(str(k), do.square, (tmp_path, k, 0.5)) for k in range(30)]
    outcomes = run_tasks(tasks, Workers(scheduler=three.address))
    next(outcomes)
    outcomes.close()
    time.sleep(1.5)
    assert len(list(tmp_path.iterdir())) < 12


def test_a_scheduler_that_is_not_there_or_goes_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(dask_cluster, "CONNECT_S", 2.0)
    gone = ("--scheduler", "tcp://127.0.0.1:9", "--quiet")
    said = check_one_line(call("experiment", "filters", "-o", tmp_path / "x", *gone))
    assert "no scheduler answers" in said and "dask scheduler" in said


def test_a_worker_with_several_threads_is_refused(tmp_path):
    """Tasks would share its memory, and GTSAM lets one of them work at a time."""
    task = Task("a", do.environment, (tmp_path,))
    with (
        cluster(tmp_path, 1, "--nthreads", 2) as found,
        pytest.raises(OutputError, match="has 2 threads; start workers with --nthreads 1"),
    ):
        list(run_tasks([task], Workers(scheduler=found.address)))


def test_a_scheduler_that_dies_leaves_what_is_done(tmp_path):
    tasks = [Task(str(k), do.square, (tmp_path, k, 0.2)) for k in range(60)]
    with cluster(tmp_path, 1, "--memory-limit", "1GB") as found:
        outcomes = run_tasks(tasks, Workers(scheduler=found.address))
        assert next(outcomes).error is None
        kill(found.scheduler)
        with pytest.raises(OutputError, match="the scheduler is gone; what is done is kept"):
            list(outcomes)
