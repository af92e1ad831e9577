"""Logs of scans, solved as one batch: `scan_tracking`, then `batch_optimisation`."""

from functools import partial

from graphslam.core.config import Config
from graphslam.core.errors import LogError
from graphslam.core.worker import Future
from graphslam.logs import LogSet
from graphslam.mapping.loop_closure import Tamper
from graphslam.pipeline.checkpoint import NOTHING_KEPT, Checkpoint
from graphslam.pipeline.findings import Findings, FinishedPass
from graphslam.pipeline.log_pass import PriorKnowledge, Progress, timed
from graphslam.scan_smoothing.batch_optimisation import optimise_scan_log
from graphslam.scan_smoothing.causal import causal_trajectories
from graphslam.scan_smoothing.localisation import localise
from graphslam.scan_smoothing.log_reader import Reading
from graphslam.scan_smoothing.scan_tracking import ScanLog


def track_scan_log(
    log: LogSet,
    config: Config,
    known: PriorKnowledge,
    progress: Progress,
    ahead: Reading | None = None,
    kept: Checkpoint = NOTHING_KEPT,
    first: int = 0,
) -> ScanLog:
    """A log that is read and tracked, see `solve_scan_log`; ``first``: number of its landmarks."""
    scan_log = ScanLog(log, config, known, first)
    kept.read_pass(scan_log, partial(scan_log.run, progress, ahead))
    if scan_log.wrong_lasers:
        scan_log = ScanLog(log.without_lasers(scan_log.wrong_lasers), config, known, first)
        kept.read_pass(scan_log, partial(scan_log.run, progress))
    return scan_log


def solve_scan_log(
    log: LogSet,
    config: Config,
    known: PriorKnowledge,
    progress: Progress,
    tamper: Tamper | None,
    ahead: Reading | None = None,
    kept: Checkpoint = NOTHING_KEPT,
) -> FinishedPass:
    """A log of scans as one batch; ``ahead``: the keyframes, if they are read already.

    Where the scans of a further laser show that it is not where its mount says, all is done again
    without it.

    Raises:
        LogError: no message of the log could be used.
        EstimationError: the estimate is indeterminate, or a robot's start is unknown.
    """
    causal = (
        Future(partial(causal_trajectories, log, config, known)) if config.backend.causal else None
    )
    scan_log = track_scan_log(log, config, known, progress, ahead, kept)
    if not scan_log.steps:
        raise LogError(f"{log.files[0].path}: nothing in it could be used; see `graphslam info`")
    closed = None
    if known.known_map is not None:
        closed = localise(scan_log, known.known_map, tamper)
    with timed(scan_log.seconds, "final optimisation"):
        estimate = optimise_scan_log(scan_log, tamper, closed)
    found = {} if causal is None else kept.stage("causal", causal.result)
    return FinishedPass(scan_log, estimate, Findings({}, {}, found), is_settled=True)
