"""Progress of a job of several stages, with the time that is left to its end.

Only reading can be counted. The other stages are announced when they begin, and take the shares of
the work that they usually take; within a stage the time that is left runs down with the clock.
Where nothing is known yet, nothing is said.
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

#: what is done by the begin of a stage, as a share of the work that follows the opening; measured
#: with default settings on Intel and ACES (scans), four days in the simulated office (sessions),
#: MRCLAM 6 (sightings) and Victoria Park (steps).
#: Stages that alternate with reading are not among them
PLANS = {
    "scans": {
        "reading": 0.0,
        "final optimisation": 0.4,
        "final": 0.56,
        "causal": 0.8,
        "trajectories": 0.81,
        "report": 0.91,
    },
    "sessions": {
        "reading": 0.0,
        "joining": 0.12,
        "final optimisation": 0.85,
        "final": 0.9,
        "trajectories": 0.97,
        "report": 0.98,
    },
    "sightings": {
        "reading": 0.0,
        "final optimisation": 0.4,
        "causal": 0.87,
        "trajectories": 0.875,
        "report": 0.94,
    },
    "steps": {
        "reading": 0.0,
        "final optimisation": 0.55,
        "trajectories": 0.86,
        "report": 0.92,
    },
}
#: stages by which a plan is recognised; before one is heard it is that of sightings
_TELLING = {"sessions": "sessions", "tracking": "scans", "front end": "steps"}
#: stages that are shown, and their words where these are others
SHOWN = {
    "opening": "opening",
    "reading": "reading",
    "joining": "joining sessions",
    "final optimisation": "final optimisation",
    "final": "covariances",
    "causal": "causal",
    "trajectories": "trajectories",
    "report": "writing",
}
#: share and s below which nothing can be said about the end
_KNOWN, _KNOWN_S = 0.1, 2.0
_TICK_S = 0.5


def _read_share(plan: str) -> float:
    """Share of the work that is done when all is read: the begin of the next stage."""
    return list(PLANS[plan].values())[1]


class Stages:
    """How far a job is, from the messages read and the stages announced; all times in s.

    What is left follows from how long the work took that is done, without the opening (libraries
    take as long for a short log). A log that is read anew, after a rough solution or with other
    clocks, is a plan of its own for what is left of the whole.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._plan, self._messages = "sightings", 0
        self._before = 0.0  # share of the whole that earlier plans did
        self._began: float | None = None
        self._since = clock()
        self.stage, self._share, self._ends = "opening", 0.0, 0.0

    def read(self, done: int, total: int) -> None:
        """``done`` of ``total`` messages are read."""
        if done < self._messages:
            self._again()
        self._messages = done
        read = min(done / max(total, 1), 1.0) if total else 0.0
        last = _read_share(self._plan)
        # sightings are read in no time, and what follows does not depend on how fast that was
        self._enter("reading", 0.0 if self._plan == "sightings" else last * read, last)

    def announced(self, stage: str) -> None:
        """A stage begins; those that are no stage of the whole job are passed over."""
        plan = _TELLING.get(stage)
        # each session is read and tracked as a log of scans is
        if plan and self._plan not in (plan, "sessions"):
            if self.stage not in ("opening", "reading"):
                self._again()
            self._plan = plan
            self._enter("reading", self._share, _read_share(plan))
        elif stage in PLANS[self._plan]:
            begins = PLANS[self._plan][stage]
            later = [share for share in PLANS[self._plan].values() if share > begins]
            self._enter(stage, begins, min(later, default=1.0))

    def _again(self) -> None:
        self._before = self.done
        self._began, self._share, self._messages = None, 0.0, 0

    def _enter(self, stage: str, share: float, ends: float) -> None:
        if self._began is None:
            self._began = self._clock()
        if share < self._share:
            return  # a stage that is repeated
        self.stage, self._share, self._ends, self._since = stage, share, ends, self._clock()

    def _done(self) -> float | None:
        """Share of the present plan that is done, within its stage by the clock."""
        took = self._since - self._began if self._began is not None else 0.0
        known = self._share >= _KNOWN and (self._plan == "scans" or took >= _KNOWN_S)
        if not known:
            return None
        speed = self._share / max(took, 1e-3)
        return min(self._share + speed * (self._clock() - self._since), self._ends)

    @property
    def done(self) -> float:
        """Share of the whole that is done."""
        done = self._done()
        return self._before + (1.0 - self._before) * (self._share if done is None else done)

    @property
    def left_s(self) -> float | None:
        """Time that is left to the end, s; None while that is not known."""
        done = self._done()
        if done is None or self._began is None:
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
        if stage not in said and stage in SHOWN:
            said.add(stage)
            print(f"{time.monotonic() - began:7.1f} s  {SHOWN[stage]}", file=sys.stderr)

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
        name = SHOWN[stages.stage]
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
