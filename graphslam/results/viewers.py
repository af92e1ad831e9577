"""The files for viewers, by their kind."""

from collections.abc import Callable
from pathlib import Path

from graphslam.results.viewer_mcap import write_result_mcap
from graphslam.results.viewer_rrd import write_result_rrd

#: kind -> what writes it
VIEWERS: dict[str, Callable[..., list[str]]] = {"mcap": write_result_mcap, "rrd": write_result_rrd}


def write_viewer(directory: Path, kind: str, target: Path, *, force: bool = False) -> list[str]:
    """Write what a result folder shows in a viewer into ``target``; the names of the files.

    Raises:
        OutputError: it is no result folder, a file exists, the disk refuses, or what is needed is
            not installed; no partial file is left.
        ValueError: an unknown kind.
    """
    if kind not in VIEWERS:
        raise ValueError(f"{kind!r} is not one of {', '.join(VIEWERS)}")
    return VIEWERS[kind](directory, target, force=force)
