"""Which kind of log it is, as far as that decides how it is read."""

from graphslam.core.config import Config
from graphslam.core.records import RelativePose, Sighting
from graphslam.logs import LogSet


def is_scan_log(log: LogSet, config: Config) -> bool:
    """Whether a log is tracked and solved as one batch: scans and odometry of one robot.

    Several robots are estimated together while the log is read: they find each other in scans.
    """
    records = {topic.record for topic in log.topics}
    return (
        config.tracks_scans
        and not records & {Sighting, RelativePose}
        and len(log.robots) == 1
        and log.has_scans(log.robots[0])
    )


def is_session_log(log: LogSet, config: Config) -> bool:
    """Whether a log is of several sessions, for each of which alone `is_scan_log` holds."""
    records = {topic.record for topic in log.topics}
    return (
        config.logs.same_place
        and config.tracks_scans
        and not config.backend.causal
        and not records & {Sighting, RelativePose}
        and len(log.robots) == len(log.opened) > 1
        and all(log.has_scans(robot) for robot in log.robots)
        and all(len(log.recordings_of(robot)) == 1 for robot in log.robots)
    )
