"""Logs in and out: MCAP files to time-ordered records, other formats to MCAP.

No other package imports `mcap` or `rosbags`. See docs/logs.md.
"""

from graphslam.logs.import_pose_graph import pose_stamp_ns
from graphslam.logs.import_summary import ImportSummary
from graphslam.logs.importers import IMPORTERS
from graphslam.logs.log_info import LogInfo, RobotInfo, TopicInfo, inspect_logs
from graphslam.logs.log_set import LogFile, LogSet, open_logs
from graphslam.logs.truth import GroundTruth, read_true_associations, read_truth, truth_from_mcap
from graphslam.logs.writer import LogWriter

__all__ = [
    "IMPORTERS",
    "GroundTruth",
    "ImportSummary",
    "LogFile",
    "LogInfo",
    "LogSet",
    "LogWriter",
    "RobotInfo",
    "TopicInfo",
    "inspect_logs",
    "open_logs",
    "pose_stamp_ns",
    "read_true_associations",
    "read_truth",
    "truth_from_mcap",
]
