"""Progress of a job of several stages, with the time that is left to its end.

Only reading can be counted. The other stages are announced when they begin, and take the shares of
the whole that they usually take; within a stage the time that is left runs down with the clock.
"""

import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from graphslam.cli import terminal
from graphslam.core.stages import listening

#: what is done by the begin of a stage, as a share of the whole: rough, as of logs of scans with
#: default settings; of other jobs the time left is less true. Stages that alternate with reading
#: are not among them
BEGINS = {
    "opening": 0.0,
    "final optimisation": 0.42,
    "final": 0.61,
    "causal": 0.86,
    "trajectories": 0.88,
    "report": 0.95,
}
#: shares between which messages are read
READING = (0.08, BEGINS["final optimisation"])
#: stages that are shown under other words
WORDS = {"final": "covariances", "report": "writing"}
#: a share below which nothing can be said about the end
_KNOWN = 0.1
_TICK_S = 0.5


class Stages:
    """How far a job is, from the messages read and the stages announced; all times in s."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._began = self._since = clock()
        self.stage, self.share, self.ends = "opening", 0.0, READING[0]

    def read(self, done: int, total: int) -> None:
        """``done`` of ``total`` messages are read."""
        first, last = READING
        self._enter("reading", first + (last - first) * min(done / max(total, 1), 1.0), last)

    def announced(self, stage: str) -> None:
        """A stage begins; those that are no stage of the whole job are passed over."""
        if stage in BEGINS:
            begins = BEGINS[stage]
            ends = min([share for share in BEGINS.values() if share > begins], default=1.0)
            self._enter(stage, begins, ends)

    def _enter(self, stage: str, share: float, ends: float) -> None:
        if share < self.share:
            return  # the job is never less done than before: a log read twice, a stage repeated
        self.stage, self.share, self.ends, self._since = stage, share, ends, self._clock()

    @property
    def done(self) -> float:
        """Share of the whole that is done, within the present stage by the clock."""
        now = self._clock()
        if self.share < _KNOWN:
            return self.share
        speed = self.share / max(self._since - self._began, 1e-3)
        return min(self.share + speed * (now - self._since), self.ends)

    @property
    def left_s(self) -> float | None:
        """Time that is left to the end, s; None while that is not known."""
        done = self.done
        if done < _KNOWN:
            return None
        return (self._clock() - self._began) * (1.0 - done) / done


@contextmanager
def stage_bar() -> Iterator[Callable[[int, int], None]]:
    """A function of the messages read, of how many; draws on a terminal until the block ends.

    With ``--verbose`` every stage is a line on stderr instead, with the time since the start.
    """
    stages = Stages()
    if terminal.output.verbose:
        heard = _lines()
        with listening(heard):
            yield lambda _done, _total: heard("reading")
    elif terminal.output.quiet or not sys.stderr.isatty():
        yield lambda _done, _total: None
    else:
        with _drawn(stages) as read:
            yield read


def _lines() -> Callable[[str], None]:
    """What writes a line on stderr at the begin of every stage."""
    began = time.monotonic()
    said = set()

    def heard(stage: str) -> None:
        if stage not in said and (stage in BEGINS or stage == "reading"):
            said.add(stage)
            print(f"{time.monotonic() - began:7.1f} s  {WORDS.get(stage, stage)}", file=sys.stderr)

    heard("opening")
    return heard


@contextmanager
def _drawn(stages: Stages) -> Iterator[Callable[[int, int], None]]:
    from rich import progress as bars
    from rich.console import Console

    columns = (
        bars.TextColumn("{task.description:<18}"),
        bars.BarColumn(),
        bars.TaskProgressColumn(),
        bars.TextColumn("{task.fields[left]}"),
    )
    # without a drawing thread: a process with threads does not fork, see `core.worker`
    bar = bars.Progress(*columns, console=Console(stderr=True), transient=True, auto_refresh=False)
    drawn_s = 0.0

    def draw() -> None:
        nonlocal drawn_s
        drawn_s = time.monotonic()
        left = stages.left_s
        text = "" if left is None else f"about {_duration(left)} left"
        name = WORDS.get(stages.stage, stages.stage)
        bar.update(task, completed=stages.done, description=name, left=text, refresh=True)

    def now_and_then() -> None:
        if time.monotonic() - drawn_s > terminal.DRAW_INTERVAL_S:
            draw()

    def read(done: int, total: int) -> None:
        stages.read(done, total)
        now_and_then()

    def heard(stage: str) -> None:
        stages.announced(stage)
        now_and_then()

    def tick(_number: int, _frame: FrameType | None) -> None:
        now_and_then()

    with bar:
        task = bar.add_task("opening", total=1.0, left="")
        with _ticking(tick), listening(heard):
            yield read


@contextmanager
def _ticking(tick: Callable[[int, FrameType | None], Any]) -> Iterator[None]:
    """Calls ``tick`` twice a second, between two steps of the interpreter: no thread is needed."""
    if not hasattr(signal, "setitimer"):
        yield
        return
    before = signal.signal(signal.SIGALRM, tick)
    signal.setitimer(signal.ITIMER_REAL, _TICK_S, _TICK_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min"
