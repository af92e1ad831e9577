"""Opens what a command wrote. `OPENERS` is where other viewers are added."""

import subprocess
import sys
import webbrowser
from collections.abc import Callable
from functools import partial
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


def viewer_file(directory: Path, kind: str) -> Path:
    """The file for a viewer in a result folder; it is written if it is not there yet.

    Raises:
        OutputError: see `graphslam.results.viewers.write_viewer`.
    """
    from graphslam.results.viewers import write_viewer

    path = directory / f"result.{kind}"
    if not path.is_file():
        write_viewer(directory, kind, directory)
    return path


def open_rerun(directory: Path) -> Path:
    """Open result.rrd in the Rerun viewer, which goes on by itself; it is written if missing.

    Raises:
        OutputError: see `viewer_file`.
    """
    path = viewer_file(directory, "rrd")
    command = [sys.executable, "-m", "rerun", str(path)]
    subprocess.Popen(command, start_new_session=True, stderr=subprocess.DEVNULL)
    return path


#: name -> what opens the folder with it
OPENERS: dict[str, Callable[[Path], Path]] = {
    "report": open_report,
    "mcap": partial(viewer_file, kind="mcap"),
    "rrd": open_rerun,
}
