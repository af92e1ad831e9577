"""Change detection between two visits of a place, with probabilities (thesis chapter 5, extended).

`changes_between` compares two result folders, `detect_changes` two visits in memory.
`thesis_method` is the method as printed, for comparison. See docs/change-detection.md.
"""

from graphslam.change_detection.detect import ChangeResult, detect_changes
from graphslam.change_detection.folder import changes_between, save_changes
from graphslam.change_detection.objects import Change
from graphslam.change_detection.report import render_changes
from graphslam.change_detection.visit import Visit, load_visit, visit_from_scans

__all__ = [
    "Change",
    "ChangeResult",
    "Visit",
    "changes_between",
    "detect_changes",
    "load_visit",
    "render_changes",
    "save_changes",
    "visit_from_scans",
]
