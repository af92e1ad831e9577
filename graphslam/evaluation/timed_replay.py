"""Replay of recorded steps into one back end, with its time and memory."""

import signal
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from graphslam.core.allocation import peak_memory_mb
from graphslam.core.config import Config
from graphslam.core.errors import EstimationError
from graphslam.core.geometry import Array
from graphslam.core.records import Step
from graphslam.estimation.backends import BACKENDS
from graphslam.estimation.decentralised import exchanged_bytes
from graphslam.estimation.replay import Replay, replay

#: steps given to another instance first, so that libraries are loaded and caches filled
WARM_UP = 20
_DIED = (
    "its process died; perhaps it ran out of memory, or the script that called this does not do so "
    'under `if __name__ == "__main__":`'
)


@dataclass(frozen=True, slots=True, eq=False)
class TimedReplay:
    """A replay, and the peak memory of the process, MB, before and after it.

    ``skipped`` counts by reason what the back end could not use of the steps. ``exchanged``: bytes
    that each robot sent, and bytes that it measured; None for a back end with one joint estimate.
    """

    replay: Replay
    error_frame: str
    skipped: Mapping[str, int]
    before_mb: float
    peak_mb: float
    exchanged: tuple[Mapping[str, int], Mapping[str, int]] | None = None


def timed_replay(steps: Sequence[Step], config: Config) -> TimedReplay:
    """Replay ``steps`` into the back end of ``config``, in this process.

    Raises:
        EstimationError: the steps make the estimate indeterminate.
    """
    warm = BACKENDS[config.backend.name](config)
    for step in steps[:WARM_UP]:
        warm.add(step)
    before = _peak_mb()
    backend = BACKENDS[config.backend.name](config)
    done = replay(steps, backend)
    exchanged, skipped = exchanged_bytes(backend), dict(backend.skipped)
    return TimedReplay(done, backend.error_frame, skipped, before, _peak_mb(), exchanged)


def timed_replay_in_process(steps: Sequence[Step], config: Config) -> TimedReplay:
    """`timed_replay` in a new process, so that memory and time are of this back end alone.

    The process is spawned: a script that calls this needs ``if __name__ == "__main__":``.

    Raises:
        EstimationError: the steps make the estimate indeterminate, or the process died.
    """
    # with the default handler Ctrl-C ends the child silently; this process reports it
    with ProcessPoolExecutor(
        1,
        mp_context=get_context("spawn"),
        initializer=signal.signal,
        initargs=(signal.SIGINT, signal.SIG_DFL),
    ) as pool:
        try:
            return pool.submit(timed_replay, steps, config).result()
        except BrokenProcessPool as error:
            raise EstimationError(_DIED) from error


def _peak_mb() -> float:
    """Largest resident size of this process so far.

    From /proc where it exists: ru_maxrss of a spawned process starts at that of its parent.
    """
    try:
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
        return next(float(line.split()[1]) for line in lines if line.startswith("VmHWM:")) / 1e3
    except (OSError, StopIteration):
        return peak_memory_mb()


def growth_exponent(size: Array, ms: Array) -> float | None:
    """Exponent b of ms ~ size^b, by a line through medians of bins on logarithmic axes.

    Args:
        size: (n,) landmarks in the map or m driven, at each step.
        ms: (n,) wall time of the step.

    Returns:
        None unless size grows by a factor of two over at least five bins of ten steps.
    """
    use = (size > 0) & (ms > 0)
    order = np.argsort(size[use], kind="stable")
    count = min(20, len(order) // 10)
    if count < 5:
        return None
    x, y = (
        np.array([np.median(part) for part in np.array_split(np.log(values[use][order]), count)])
        for values in (size, ms)
    )
    if x[-1] - x[0] < np.log(2.0):
        return None
    return float(np.polyfit(x, y, 1)[0])
