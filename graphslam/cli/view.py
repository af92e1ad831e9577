"""Opens what a command wrote. `OPENERS` is where other viewers are added."""

import webbrowser
from collections.abc import Callable
from pathlib import Path

from graphslam.core.errors import OutputError


def open_report(directory: Path) -> Path:
    """Open the report of a folder in the browser, and return its path.

    Raises:
        OutputError: the folder has no report, or there is no browser to open it.
    """
    report = directory / "report.html"
    if not report.is_file():
        raise OutputError(f"{directory}: has no report.html; give a folder that a command wrote")
    if not webbrowser.open(report.resolve().as_uri()):
        raise OutputError(f"{report}: no browser was found; open this file in one")
    return report


#: name -> what opens the folder with it
OPENERS: dict[str, Callable[[Path], Path]] = {"report": open_report}
