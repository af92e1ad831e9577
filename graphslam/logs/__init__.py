"""Logs in and out: MCAP files to time-ordered records, other formats to MCAP.

`mcap` and `rosbags` are known to this package only. See docs/logs.md.
"""

from graphslam.logs.log_set import LogFile, LogSet, open_logs
from graphslam.logs.writer import LogWriter

__all__ = ["LogFile", "LogSet", "LogWriter", "open_logs"]
