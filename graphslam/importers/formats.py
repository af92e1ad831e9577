"""Converters of other formats to MCAP: one row of `IMPORTERS` per format.

Each is imported when it is used.
"""

from collections.abc import Callable
from pathlib import Path

from graphslam.importers.import_summary import ImportSummary

# ruff: noqa: PLC0415


def _carmen(source: Path, target: Path) -> ImportSummary:
    from graphslam.importers.import_carmen import import_carmen

    return import_carmen(source, target)


def _csv(source: Path, target: Path) -> ImportSummary:
    from graphslam.importers.import_csv import import_csv

    return import_csv(source, target)


def _pose_graph(source: Path, target: Path) -> ImportSummary:
    from graphslam.importers.import_pose_graph import import_pose_graph

    return import_pose_graph(source, target)


def _mrclam(source: Path, target: Path) -> ImportSummary:
    from graphslam.importers.import_mrclam import import_mrclam

    return import_mrclam(source, target)


def _rawlog(source: Path, target: Path) -> ImportSummary:
    from graphslam.importers.import_rawlog import import_rawlog

    return import_rawlog(source, target)


def _rosbag(source: Path, target: Path) -> ImportSummary:
    from graphslam.importers.import_rosbag import import_rosbag

    return import_rosbag(source, target)


def _tinyslam(source: Path, target: Path) -> ImportSummary:
    from graphslam.importers.import_tinyslam import import_tinyslam

    return import_tinyslam(source, target)


#: from the source's path and the MCAP file to be written
IMPORTERS: dict[str, Callable[[Path, Path], ImportSummary]] = {
    "carmen": _carmen,
    "csv": _csv,
    "g2o": _pose_graph,
    "isam": _pose_graph,
    "mrclam": _mrclam,
    "rawlog": _rawlog,
    "rosbag": _rosbag,
    "tinyslam": _tinyslam,
}
