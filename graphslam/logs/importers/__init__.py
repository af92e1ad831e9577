"""Other formats to MCAP: a row of `IMPORTERS` per format."""

from graphslam.logs.importers.carmen import import_carmen
from graphslam.logs.importers.isam import import_isam, pose_stamp_ns
from graphslam.logs.importers.mrclam import import_mrclam
from graphslam.logs.importers.summary import Importer, ImportSummary
from graphslam.logs.importers.tinyslam import import_tinyslam

IMPORTERS: dict[str, Importer] = {
    "carmen": import_carmen,
    "g2o": import_isam,
    "isam": import_isam,
    "mrclam": import_mrclam,
    "tinyslam": import_tinyslam,
}

__all__ = ["IMPORTERS", "ImportSummary", "Importer", "pose_stamp_ns"]
