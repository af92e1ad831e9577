"""What workers are asked to do in tests. Each leaves a mark in a folder when it begins."""

import os
import signal
import time
from pathlib import Path
from uuid import uuid4

import numpy as np


def begin(folder, name):
    """Mark that a task has begun; how often it has."""
    (Path(folder) / f"{name}.{uuid4().hex}").touch()
    return begun(folder, name)


def begun(folder, name):
    return len(list(Path(folder).glob(f"{name}.*")))


def square(folder, k, seconds=0.0):
    begin(folder, k)
    time.sleep(seconds)
    return k * k


def fail(folder, name):
    begin(folder, name)
    raise ValueError(f"{name} is wrong")


def die(folder, name, times):
    """Be killed, as by a system without memory, the first so many times."""
    if begin(folder, name) <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return name


def take_memory(folder, name, megabytes):
    """Have so much memory at once, and say how much that was."""
    begin(folder, name)
    return float(np.ones(round(megabytes * 1e6 / 8)).sum() * 8e-6)


def environment(_folder):
    return {name: os.environ.get(name) for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}


def process_id(folder):
    begin(folder, os.getpid())
    time.sleep(600)
