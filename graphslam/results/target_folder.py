"""The folder that a command is to make: checked before the work, written whole at its end.

Commands check before they import what the work needs, so little is imported here.
"""

import json
import os
from collections.abc import Callable, Iterable
from pathlib import Path

from graphslam.core.errors import OutputError
from graphslam.core.output_folder import (
    Identity,
    atomic_folder,
    check_nothing_else_in,
    identity,
    unfinished,
)


def check_target(
    directory: Path,
    *,
    force: bool,
    replaceable: Callable[[Path], bool] | None = None,
    known_map: str = "",
) -> Identity:
    """Check before a long computation that a folder may be written at ``directory``.

    Args:
        directory: the folder to be written.
        force: replace an existing one.
        replaceable: whether ``force`` may replace a given existing folder; default: result
            folders. An empty folder is always replaced.
        known_map: a folder that the work needs, and later work too; empty if there is none.

    Returns:
        What stands there; if it is something else when the folder is written, another process
        wrote it.

    Raises:
        OutputError: it exists and ``force`` is not given, it exists and may not be replaced, it
            is or holds the known map, or holds recordings or folders of others, or its parent is
            not writable.
    """
    parent = directory.absolute().parent
    while not parent.exists():
        parent = parent.parent
    if not (parent.is_dir() and os.access(parent, os.W_OK | os.X_OK)):
        raise OutputError(f"{directory}: cannot be written: {parent} is no folder to write to")
    unfinished(directory)  # a folder that a dead process had moved away stands there again
    before = identity(directory)
    if before is None:
        return None
    if known_map and Path(known_map).resolve().is_relative_to(directory.resolve()):
        raise OutputError(
            f"{directory}: has the known map in it ({known_map}), which is never replaced; choose "
            "another name"
        )
    if not force:
        raise OutputError(f"{directory}: already exists; give --force to replace it")
    empty = directory.is_dir() and not any(directory.iterdir())
    if directory.is_symlink() or not (empty or (replaceable or is_result)(directory)):
        raise OutputError(
            f"{directory}: is not a result folder of graphslam, so it is not replaced; "
            "choose another name"
        )
    check_nothing_else_in(directory)
    return before


def write_folder(
    directory: Path, files: Iterable[tuple[str, str | bytes]], before: Identity
) -> None:
    """Write files (name, content) as a folder that appears whole or not at all.

    ``before``: what `check_target` found there.

    Raises:
        OutputError: the disk cannot be written; no partial output is left.
    """
    with atomic_folder(directory, before) as part:
        for name, content in files:
            path = part / name
            path.parent.mkdir(exist_ok=True)
            if isinstance(content, bytes):
                path.write_bytes(content)
            else:
                # names of files need not be text: what is not is written as its escape
                path.write_text(content, encoding="utf-8", errors="backslashreplace")


def is_result(directory: Path) -> bool:
    """Whether a folder has our summary.json and trajectories/; nothing else is ever replaced."""
    try:
        summary = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return (
        isinstance(summary, dict) and "format" in summary and (directory / "trajectories").is_dir()
    )
