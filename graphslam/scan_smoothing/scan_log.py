"""Logs of scans, solved as one batch: `scan_tracking`, then `batch_optimisation`."""

from functools import partial

from graphslam.core.errors import LogError
from graphslam.core.worker import Future
from graphslam.pipeline.findings import Findings, FinishedPass
from graphslam.pipeline.log_pass import PriorKnowledge, timed
from graphslam.pipeline.smoothing_job import SmoothingJob
from graphslam.scan_smoothing.batch_optimisation import optimise_scan_log
from graphslam.scan_smoothing.causal import causal_trajectories
from graphslam.scan_smoothing.localisation import localise
from graphslam.scan_smoothing.log_reader import Reading
from graphslam.scan_smoothing.scan_tracking import ScanLog


def track_scan_log(
    job: SmoothingJob, known: PriorKnowledge, ahead: Reading | None = None, first: int = 0
) -> ScanLog:
    """A log that is read and tracked, see `solve_scan_log`; ``first``: number of its landmarks.

    Where odometry is far off, it is read once more: motions before that was known, and scans that
    were corrected for the motion during their sweeps, were wrong.
    """
    scan_log = ScanLog(job.log, job.config, known, first)
    job.kept.read_pass(scan_log, partial(scan_log.run, job.progress, ahead))
    if scan_log.wrong_lasers:
        used = job.log.without_lasers(scan_log.wrong_lasers)
        scan_log = ScanLog(used, job.config, known, first)
        job.kept.read_pass(scan_log, partial(scan_log.run, job.progress))
    if (learnt := scan_log.far) is not None:
        scan_log = ScanLog(scan_log.log, job.config, known, first)
        job.kept.read_pass(scan_log, partial(scan_log.run, job.progress, before=learnt))
    return scan_log


def solve_scan_log(
    job: SmoothingJob, known: PriorKnowledge, ahead: Reading | None = None
) -> FinishedPass:
    """A log of scans as one batch; ``ahead``: the keyframes, if they are read already.

    Where the scans of a further laser show that it is not where its mount says, all is done again
    without it.

    Raises:
        LogError: no message of the log could be used.
        EstimationError: the estimate is indeterminate, or a robot's start is unknown.
    """
    log, config = job.log, job.config
    causal = (
        Future(partial(causal_trajectories, log, config, known)) if config.backend.causal else None
    )
    scan_log = track_scan_log(job, known, ahead)
    if not scan_log.steps:
        raise LogError(f"{log.files[0].path}: nothing in it could be used; see `graphslam info`")
    closed = None
    if known.known_map is not None:
        closed = localise(scan_log, known.known_map, job.tamper)
    with timed(scan_log.seconds, "final optimisation"):
        estimate = optimise_scan_log(scan_log, job.tamper, closed)
    found = {} if causal is None else job.kept.stage("causal", causal.result)
    return FinishedPass(scan_log, estimate, Findings({}, {}, found), is_settled=True)
