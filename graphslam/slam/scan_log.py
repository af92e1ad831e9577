"""Logs of scans, solved as one batch: `scan_tracking`, then `batch_optimisation`."""

from functools import partial

from graphslam.core.config import Config
from graphslam.core.errors import LogError
from graphslam.core.records import RelativePose, Sighting
from graphslam.core.worker import Future
from graphslam.logs import LogSet
from graphslam.mapping.loop_closure import Tamper
from graphslam.slam.batch_optimisation import optimise_scan_log
from graphslam.slam.causal import causal_trajectories
from graphslam.slam.log_pass import PriorKnowledge, Progress, timed
from graphslam.slam.passes import Findings, FinishedPass
from graphslam.slam.scan_tracking import ScanLog


def is_scan_log(log: LogSet, config: Config) -> bool:
    """Whether a log is tracked and solved as one batch: scans and odometry of one robot.

    Several robots are estimated together while the log is read: they find each other in scans.
    """
    records = {topic.record for topic in log.topics}
    return (
        config.backend.name == "batch"
        and config.backend.reoptimise
        and config.keyframe.mode != "all"
        and config.front_end.name != "none"
        and not records & {Sighting, RelativePose}
        and len(log.robots) == 1
        and log.has_scans(log.robots[0])
    )


def solve_scan_log(
    log: LogSet,
    config: Config,
    known: PriorKnowledge,
    progress: Progress,
    tamper: Tamper | None,
) -> FinishedPass:
    """A log of scans as one batch.

    Raises:
        LogError: no message of the log could be used.
        EstimationError: the estimate is indeterminate, or a robot's start is unknown.
    """
    causal = (
        Future(partial(causal_trajectories, log, config, known)) if config.backend.causal else None
    )
    scan_log = ScanLog(log, config, known)
    scan_log.run(progress)
    if not scan_log.steps:
        raise LogError(f"{log.files[0].path}: nothing in it could be used; see `graphslam info`")
    with timed(scan_log.seconds, "final optimisation"):
        estimate = optimise_scan_log(scan_log, tamper)
    found = {} if causal is None else causal.result()
    return FinishedPass(scan_log, estimate, Findings({}, {}, found))
