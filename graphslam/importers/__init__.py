"""Logs of other formats, converted to MCAP: one module and one row of `formats.IMPORTERS` each.

See docs/logs.md.
"""

from typing import TYPE_CHECKING

from graphslam.core.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from graphslam.importers.formats import IMPORTERS
    from graphslam.importers.import_pose_graph import pose_stamp_ns
    from graphslam.importers.import_summary import ImportSummary

#: module -> the names that it defines
_NAMES = {
    "formats": ("IMPORTERS",),
    "import_pose_graph": ("pose_stamp_ns",),
    "import_summary": ("ImportSummary",),
}

__all__ = ["IMPORTERS", "ImportSummary", "pose_stamp_ns"]

if not TYPE_CHECKING:  # a type checker would take every name for defined
    __getattr__ = lazy_exports(__name__, _NAMES)
