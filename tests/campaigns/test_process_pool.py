"""Workers that are processes: every task once, also if some fail, die or take too much."""

import math
import os
import subprocess
import sys
import time
from multiprocessing import active_children

import campaign_tasks as do
import pytest
from paths import ROOT

from graphslam.campaigns.engine import run_tasks
from graphslam.campaigns.process_pool import AHEAD
from graphslam.campaigns.tasks import Task, WorkerLostError, Workers, execute
from graphslam.core.errors import LogError, OutputError


def test_every_task_has_one_outcome_whatever_becomes_of_the_others(tmp_path):
    """One raises, one wants more memory than a worker has, one kills its process whenever it is
    done, and one the first time only."""
    squares = [Task(f"square {k}", do.square, (tmp_path, k)) for k in range(6)]
    odd = [
        Task("fails", do.fail, (tmp_path, "fails")),
        Task("fits", do.take_memory, (tmp_path, "fits", 100)),
        Task("large", do.take_memory, (tmp_path, "large", 2000)),
        Task("deadly", do.die, (tmp_path, "deadly", 99)),
        Task("unlucky", do.die, (tmp_path, "unlucky", 1)),
        Task("threads", do.environment, (tmp_path,)),
    ]
    told = []
    workers = Workers(2, memory_mb=800.0)
    outcomes = list(run_tasks([*squares[:3], *odd, *squares[3:]], workers, told.append))
    by_label = {outcome.task.label: outcome for outcome in outcomes}
    assert len(outcomes) == len(by_label) == 12
    assert [by_label[f"square {k}"].value for k in range(6)] == [0, 1, 4, 9, 16, 25]
    assert by_label["unlucky"].value == "unlucky"
    assert by_label["fits"].value == pytest.approx(100)
    assert str(by_label["fails"].error) == "fails is wrong"
    assert isinstance(by_label["large"].error, LogError)
    assert str(by_label["large"].error).startswith("large: needs more memory than the 800 MB")
    assert isinstance(by_label["deadly"].error, WorkerLostError)
    assert str(by_label["deadly"].error).startswith("deadly: its process died")
    assert set(by_label["threads"].value.values()) == {"1"}
    assert told == ["2 processes, 0.8 GB each"]
    # what was in hand when a process died is done again, alone; what was done is not
    assert do.begun(tmp_path, "large") == do.begun(tmp_path, "fails") == 1
    assert do.begun(tmp_path, "deadly") in (2, 3) and do.begun(tmp_path, "unlucky") in (2, 3)
    assert all(do.begun(tmp_path, k) <= 2 for k in range(6))


def test_who_stops_listening_ends_the_processes_and_what_waits_never_begins(tmp_path):
    before = set(active_children())
    tasks = [Task(str(k), do.square, (tmp_path, k, 0.0 if k == 0 else 60.0)) for k in range(20)]
    outcomes = run_tasks(tasks, Workers(2))
    assert next(outcomes).value == 0
    outcomes.close()
    assert set(active_children()) == before
    assert len(list(tmp_path.iterdir())) <= 1 + AHEAD * 2


def test_workers_end_with_who_started_them(tmp_path):
    """Also if it is killed: nobody else would ever end them."""
    code = (
        "import sys, campaign_tasks as do\n"
        "from graphslam.campaigns.engine import run_tasks\n"
        "from graphslam.campaigns.tasks import Task, Workers\n"
        "if __name__ == '__main__':\n"
        "    list(run_tasks([Task('a', do.process_id, (sys.argv[1],))], Workers(1)))\n"
    )
    script = tmp_path / "script.py"
    script.write_text(code)
    (tmp_path / "marks").mkdir()
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}"}
    parent = subprocess.Popen(
        [sys.executable, str(script), str(tmp_path / "marks")], env=environment
    )
    until = time.monotonic() + 120
    while not (marks := list((tmp_path / "marks").iterdir())) and time.monotonic() < until:
        time.sleep(0.05)
    worker = int(marks[0].name.partition(".")[0])
    parent.kill()
    parent.wait()
    while _is_alive(worker) and time.monotonic() < until:
        time.sleep(0.05)
    assert not _is_alive(worker)


def _is_alive(number):
    """Whether a process runs; one that ended and that nobody waited for does not."""
    try:
        with open(f"/proc/{number}/stat") as file:  # noqa: PTH123
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="peak memory begins anew on Linux only")
def test_peak_memory_is_that_of_one_task(tmp_path):
    """A worker does many: a small log after a large one does not need what that one did."""
    from graphslam.core.allocation import peak_memory_mb

    execute(Task("large", do.take_memory, (tmp_path, "large", 600)))
    large = peak_memory_mb()
    execute(Task("small", do.take_memory, (tmp_path, "small", 1)))
    assert peak_memory_mb() < large - 500


def test_a_worker_with_other_code_refuses(tmp_path):
    task = Task("square", do.square, (tmp_path, 3))
    with pytest.raises(OutputError, match="another version of graphslam"):
        execute(task, math.inf, "0123456789ab")
    assert not list(tmp_path.iterdir())
