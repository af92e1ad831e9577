"""What all ways to solve a log are given."""

from dataclasses import dataclass

from graphslam.core.config import Config
from graphslam.logs import LogSet
from graphslam.mapping.loop_closure import Tamper
from graphslam.pipeline.checkpoint import NOTHING_KEPT, Checkpoint
from graphslam.pipeline.progress import Progress


@dataclass(frozen=True, slots=True, eq=False)
class SmoothingJob:
    """A log, how it is to be solved, and where that is watched and kept.

    Attributes:
        log: opened logs.
        config: settings.
        progress: called with the number of messages read so far.
        tamper: for tests, see `graphslam.mapping.loop_closure.Tamper`.
        kept: where stages are kept, and those of an earlier run.
    """

    log: LogSet
    config: Config
    progress: Progress = lambda _count: None
    tamper: Tamper | None = None
    kept: Checkpoint = NOTHING_KEPT
