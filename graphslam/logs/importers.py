"""Converters of other formats to MCAP: one row of `IMPORTERS` per format."""

from collections.abc import Callable
from pathlib import Path

from graphslam.logs.import_carmen import import_carmen
from graphslam.logs.import_mrclam import import_mrclam
from graphslam.logs.import_pose_graph import import_pose_graph
from graphslam.logs.import_summary import ImportSummary
from graphslam.logs.import_tinyslam import import_tinyslam

#: from the source's path and the MCAP file to be written
IMPORTERS: dict[str, Callable[[Path, Path], ImportSummary]] = {
    "carmen": import_carmen,
    "g2o": import_pose_graph,
    "isam": import_pose_graph,
    "mrclam": import_mrclam,
    "tinyslam": import_tinyslam,
}
