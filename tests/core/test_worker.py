"""Work in a second process: the same results as without, whatever happens to it.

Forking needs a process with one thread, which a test runner's is not, so each test is a program.
"""

import json
import os
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from paths import ROOT

from graphslam.logs import LogWriter

pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or len(os.sched_getaffinity(0)) < 2,
    reason="a second process is only used on Linux with two cores",
)

BEGIN = """
import os, sys, time
from graphslam.core import worker
from graphslam.core.worker import Future, Prefetch, parallel_map
worker.allow_fork()
here = os.getpid()
"""


def printed(program: str, *arguments: str) -> list[str]:
    """Lines that a program prints."""
    text = BEGIN + textwrap.dedent(program)
    one = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", text, *arguments],
        check=False,
        capture_output=True,
        text=True,
        env={**os.environ, **one},
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_items_come_from_another_process_in_their_order():
    """More than a pipe holds, and more than one batch."""
    lines = printed("""
        def make():
            for k in range(3000):
                yield k, os.getpid(), bytes(200)
        items = list(Prefetch(make))
        print([k for k, _, _ in items] == list(range(3000)), {p for _, p, _ in items} == {here})
    """)
    assert lines == ["True False"]


def test_an_error_is_raised_here_after_the_items_before_it():
    lines = printed("""
        def make():
            yield from range(300)
            raise LookupError("the 301st")
        taken = []
        try:
            for item in Prefetch(make):
                taken.append(item)
        except LookupError as error:
            print(error, taken == list(range(300)))
    """)
    assert lines == ["the 301st True"]


@pytest.mark.parametrize("end", ["os._exit(0)", "os.kill(os.getpid(), 9)"])
def test_nothing_is_lost_or_comes_twice_when_the_second_process_dies(end):
    """It dies amid the third batch; the rest is made here."""
    lines = printed(f"""
        def make():
            for k in range(1000):
                if k == 600 and os.getpid() != here:
                    {end}
                yield k
        print(list(Prefetch(make)) == list(range(1000)))
    """)
    assert lines == ["True"]


def test_who_leaves_early_leaves_no_process_behind():
    lines = printed("""
        def make():
            while True:
                yield bytes(1000)
        for item in Prefetch(make):
            break
        try:
            os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            print("none")
    """)
    assert lines == ["none"]


def test_a_task_finds_things_as_they_were_when_it_began():
    """Forked or not: what is changed here afterwards is not in its result."""
    lines = printed("""
        for second in (True, False):
            worker.allow_fork(second=second)
            things = [1]
            task = Future(lambda: (list(things), os.getpid() == here))
            things.append(2)
            print(task.done, *task.result(), *task.result())
    """)
    assert lines == ["False [1] False [1] False", "True [1] True [1] True"]


def test_the_error_of_a_task_is_raised_whenever_its_result_is_asked_for():
    """The number of the process that is gone may be that of another one by then."""
    lines = printed("""
        def task():
            raise LookupError("why")
        one = Future(task)
        for _ in range(2):
            try:
                one.result()
            except LookupError as error:
                print(error)
    """)
    assert lines == ["why", "why"]


def test_shared_results_are_in_the_order_of_the_arguments():
    lines = printed("""
        for n in (0, 1, 2, 7):
            found = parallel_map(lambda k: (10 * k, os.getpid() == here), list(range(n)))
            print([v for v, _ in found] == [10 * k for k in range(n)], [own for _, own in found])
    """)
    both = [True, False] * 3
    assert lines == ["True []", "True [True]", f"True {both[:2]}", f"True {[*both, True]}"]


def test_both_processes_get_about_the_same_effort():
    """The longest task alone weighs as much as the others; results stay in their order."""
    lines = printed("""
        task = lambda k: (10 * k, os.getpid() == here)
        found = parallel_map(task, list(range(4)), efforts=[1.0, 2.0, 6.0, 3.0])
        print([v for v, _ in found], [own for _, own in found])
    """)
    assert lines == ["[0, 10, 20, 30] [False, False, True, False]"]


def test_nothing_forks_unless_it_may():
    """Neither before `allow_fork`, nor beside a thread, nor in what was forked, nor where nothing
    tells how many threads there are, nor without memory."""
    lines = printed("""
        import threading
        makes = lambda: Future(os.getpid).result() != here
        worker.allow_fork(second=False)
        print(makes())
        worker.allow_fork()
        ends = threading.Event()
        thread = threading.Thread(target=ends.wait)
        thread.start()
        print(makes())
        ends.set()
        thread.join()
        while not worker.can_fork():
            time.sleep(0.01)  # the system takes a moment to forget it
        print(makes(), Future(lambda: Future(os.getpid).done).result())
        threads, worker.THREADS = worker.THREADS, worker.Path("/nowhere")
        print(makes())
        worker.THREADS = threads
        def refuses():
            raise BlockingIOError
        os.fork = refuses
        print(makes())
    """)
    assert lines == ["False", "False", "True True", "False", "False"]


# ------------------------------------------------------------ where it is used


def test_a_log_read_ahead_tells_the_same(tmp_path):
    """Messages, and what is told of them at the end: a stamp that is late, a pose that is not."""
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        for k in range(12_000):
            stamp = 10_000_000 * k + (300_000_000 if k == 5000 else 0)
            pose = (np.nan if k == 7000 else 0.001 * k, 0.0, 0.0)
            log.odometry("robot", stamp, pose, log_time_ns=10_000_000 * k)
    lines = printed(
        """
        from pathlib import Path
        from graphslam.core.config import Config
        from graphslam.logs import open_logs, log_set
        logs = open_logs([Path(sys.argv[1])], Config())
        forks = []
        fork, os.fork = os.fork, lambda: forks.append(1) or fork()
        for ahead in (False, True):
            messages = logs.messages(prefetch=ahead)
            read = [(m.stamp_ns, m.time_ns, *m.pose.tolist()) for m in messages]
            print(hash(tuple(read)), len(read), logs.warnings, logs.dropped, logs.repaired)
        print(len(forks))
        """,
        str(path),
    )
    assert lines[0] == lines[1]
    assert "11999" in lines[0] and "stamp" in lines[0] and "not finite" in lines[0]
    assert lines[2] == "1"


def test_smooth_writes_the_same_with_and_without(tmp_path):
    """Two robots that see each other: logs, truth, clocks, marginals, results, report."""
    program = """
        from graphslam.cli import main
        if sys.argv.pop(1) == "one":
            os.sched_getaffinity = lambda _: {0}
        forks = []
        fork, os.fork = os.fork, lambda: forks.append(1) or fork()
        try:
            main(sys.argv[1:])
        finally:
            print(len(forks))
    """
    root = ROOT
    log = tmp_path / "log.mcap"
    subprocess.run(
        [sys.executable, "-m", "graphslam", "simulate", "two-robots", "-o", str(log)],
        check=True,
        cwd=root,
        capture_output=True,
    )
    forks = {}
    for name in ("one", "two"):
        lines = printed(
            program, name, "smooth", str(log), "--start", "truth", "-o", str(tmp_path / name)
        )
        forks[name] = int(lines[-1])
    assert forks["one"] == 0 < forks["two"]
    files = sorted(p.relative_to(tmp_path / "one") for p in (tmp_path / "one").rglob("*.*"))
    for file in files:
        if file.name not in ("summary.json", "report.html"):  # these tell how long it took
            one, two = ((tmp_path / name / file).read_bytes() for name in ("one", "two"))
            assert one == two, file
    one, two = (json.loads((tmp_path / n / "summary.json").read_text()) for n in ("one", "two"))
    for key in ("counts", "clocks", "calibration", "warnings", "graph"):
        assert one[key] == two[key], key


def test_small_work_does_not_fork():
    """A second process takes 40 ms of CPU time beside its work: what is known to take less than
    twice that runs here, what takes more or is not known does not."""
    lines = printed("""
        def own(_=None):
            return os.getpid() == here
        print(*(Future(own, about_ms=ms).result() for ms in (10.0, 100.0)))
        efforts = [5.0, 10.0, 6.0]
        print(*(parallel_map(own, efforts, efforts=efforts, unit_ms=ms) for ms in (1.0, 10.0)))
    """)
    assert lines == ["True False", "[True, True, True] [False, True, False]"]
