"""The command as a process: closed streams, terminals without letters, signals, odd names."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from graphslam.logs import LogWriter

S = 1_000_000_000
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Odometry and sightings of two landmarks, in a file whose name is no text."""
    path = tmp_path_factory.mktemp("processes") / os.fsdecode(b"caf\xe9.mcap")
    with LogWriter(path) as log:
        for k in range(100):
            x = 0.1 * k
            log.odometry('tom "the" robot', k * S // 10 + S, (x, 0, 0))
            for name, (a, b) in {"a": (3.0, 2.0), "b": (8.0, -2.0)}.items():
                z = (np.arctan2(b, a - x), np.hypot(a - x, b))
                cov = np.diag([1e-4, 1e-3])
                log.sighting('tom "the" robot', k * S // 10 + S, z, cov, identity=name)
    return path


def started(*arguments, shell="", **variables):
    words = [sys.executable, "-m", "graphslam", *map(os.fspath, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **variables}
    if shell:
        words = ["/bin/sh", "-c", f'exec "$@" {shell}', "sh", *words]
    before = signal.getsignal(signal.SIGINT)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # jobs in the background ignore it
    try:
        return subprocess.Popen(
            words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment, text=True
        )
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("shell", [">&-", "2>&-", ">&- 2>&- <&-"])
def test_closed_streams_are_no_error(log, shell):
    done = started("info", log, shell=shell)
    out, err = done.communicate(timeout=60)
    assert done.returncode == 0 and "Traceback" not in out + err


def test_a_terminal_without_letters_shows_escapes(log):
    done = started("info", log, PYTHONIOENCODING="ascii", LC_ALL="C", MPLBACKEND="nonsense")
    out, err = done.communicate(timeout=60)
    assert done.returncode == 0 and "Traceback" not in err and "caf" in out


def test_names_that_are_no_text_and_names_with_quotes_come_back(log, tmp_path):
    """The result is not lost at the end, and its tables are still tables."""
    import csv

    target = tmp_path / "out"
    done = started("smooth", log, "-o", target)
    _, err = done.communicate(timeout=60)
    assert done.returncode == 0, err
    summary = json.loads((target / "summary.json").read_text())
    assert Path(summary["logs"][0]["path"]) == log
    with (target / "graph_ids.csv").open(newline="") as stream:
        robots = {row["robot"] for row in csv.DictReader(stream)}
    assert robots == {'tom "the" robot', ""}


def test_a_limit_of_landmarks_is_one_line_that_names_it(log, tmp_path):
    done = started("smooth", log, "-o", tmp_path / "out", "--set", "limits.landmarks=1")
    _, err = done.communicate(timeout=60)
    said = err.strip().splitlines()[-1]
    assert done.returncode == 1 and "Traceback" not in err
    assert said.startswith("graphslam: error:") and "limits.landmarks" in said
    assert not list(tmp_path.iterdir())


def test_a_log_that_the_system_does_not_open_is_one_line(tmp_path):
    done = started("info", tmp_path / ("n" * 300 + ".mcap"))
    _, err = done.communicate(timeout=60)
    assert done.returncode == 1 and len(err.splitlines()) == 1 and "cannot be read" in err


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_nothing_is_left_behind_after_a_signal(tmp_path, number):
    """Of a killed process: by the next one that writes the same file."""
    target = tmp_path / "log.mcap"
    running = started("simulate", "forest", "-o", target)
    part = tmp_path / f".log.mcap.{running.pid}.part"
    end = time.monotonic() + 60
    while not part.exists() and running.poll() is None and time.monotonic() < end:
        time.sleep(0.01)
    assert part.exists()
    running.send_signal(number)
    _, err = running.communicate(timeout=60)
    assert running.returncode in (-number, 128 + number) and "Traceback" not in err
    if number == signal.SIGKILL:
        with LogWriter(target) as log:
            log.odometry("robot", S, (0, 0, 0))
        target.unlink()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("module", ["gtsam", "numpy"])
def test_an_interrupt_while_a_library_is_imported_is_no_defect(log, tmp_path, module):
    """A C extension makes an ImportError of it, which was reported as a defect."""
    command = f"""
import os, signal, sys
from graphslam.cli import main

signal.signal(signal.SIGINT, signal.default_int_handler)
class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == "{module}":
            try:
                os.kill(os.getpid(), signal.SIGINT)
            except KeyboardInterrupt as interrupt:
                raise ImportError("initialization failed") from interrupt
sys.meta_path.insert(0, Interrupting())
main()
"""
    words = [sys.executable, "-c", command, "smooth", log, "-o", tmp_path / "out"]
    done = subprocess.run(words, check=False, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (128 + signal.SIGINT, "")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("when", ["__enter__", "__exit__"])
def test_a_signal_between_a_file_and_its_block_leaves_nothing(tmp_path, when):
    """A file was left when the signal came after its opening and before the block began."""
    command = f"""
import os, signal
from graphslam.cli import main
from graphslam.logs import LogWriter

before = LogWriter.{when}
def interrupted(self, *error):
    if "{when}" == "__enter__":
        before(self)
    os.kill(os.getpid(), signal.SIGTERM)
LogWriter.{when} = interrupted
main()
"""
    words = [sys.executable, "-c", command, "simulate", "forest", "-o", tmp_path / "log.mcap"]
    done = subprocess.run(words, check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 128 + signal.SIGTERM and "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())
