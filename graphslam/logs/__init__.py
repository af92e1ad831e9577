"""Logs in and out: recordings to time-ordered records, and MCAP written.

No other package imports `mcap` or `rosbags`. See docs/logs.md.
"""

from typing import TYPE_CHECKING

from graphslam.core.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from graphslam.logs.containers import is_recording
    from graphslam.logs.findings import Finding
    from graphslam.logs.log_info import LogInfo, inspect_logs
    from graphslam.logs.log_set import LogFile, LogSet, open_logs
    from graphslam.logs.topic_info import RobotInfo, TopicInfo
    from graphslam.logs.truth import (
        GroundTruth,
        read_true_associations,
        read_truth,
        truth_from_recordings,
    )
    from graphslam.logs.writer import LogWriter

#: module -> the names that it defines
_NAMES = {
    "containers": ("is_recording",),
    "findings": ("Finding",),
    "log_info": ("LogInfo", "inspect_logs"),
    "log_set": ("LogFile", "LogSet", "open_logs"),
    "topic_info": ("RobotInfo", "TopicInfo"),
    "truth": ("GroundTruth", "read_true_associations", "read_truth", "truth_from_recordings"),
    "writer": ("LogWriter",),
}

__all__ = [
    "Finding",
    "GroundTruth",
    "LogFile",
    "LogInfo",
    "LogSet",
    "LogWriter",
    "RobotInfo",
    "TopicInfo",
    "inspect_logs",
    "is_recording",
    "open_logs",
    "read_true_associations",
    "read_truth",
    "truth_from_recordings",
]

if not TYPE_CHECKING:  # a type checker would take every name for defined
    __getattr__ = lazy_exports(__name__, _NAMES)
