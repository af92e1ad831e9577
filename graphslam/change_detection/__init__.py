"""Change detection between two visits of a place, with probabilities (thesis chapter 5, extended).

`changes_between` compares two result folders, `detect_changes` two visits in memory.
`thesis_changes_between` and `thesis_changes` do it as printed, for comparison. See
docs/change-detection.md.
"""

from graphslam.change_detection.detect import ChangeResult, detect_changes
from graphslam.change_detection.folder import changes_between, save_changes
from graphslam.change_detection.objects import Change
from graphslam.change_detection.report import render_changes
from graphslam.change_detection.thesis_changes import ThesisChanges, thesis_changes
from graphslam.change_detection.thesis_folder import thesis_changes_between, write_thesis_changes
from graphslam.change_detection.visit import Visit, load_visit, visit_from_scans

__all__ = [
    "Change",
    "ChangeResult",
    "ThesisChanges",
    "Visit",
    "changes_between",
    "detect_changes",
    "load_visit",
    "render_changes",
    "save_changes",
    "thesis_changes",
    "thesis_changes_between",
    "visit_from_scans",
    "write_thesis_changes",
]
