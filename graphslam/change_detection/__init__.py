"""What is different since the last visit, and how sure (thesis chapter 5, and beyond it).

`compare` takes two visits; `changes_between` reads them from result folders. `thesis` has the
method as printed, to compare with. See docs/change-detection.md.
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
