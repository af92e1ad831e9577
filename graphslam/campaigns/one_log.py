"""One log of a batch: a worker makes a folder of it that appears whole, with its row.

Workers may share nothing with each other but the folder of the batch, and one log may be in the
hands of two of them, if the first one was taken for lost. So each makes its result under a name of
its own and renames it; the second one finds it done.
"""

import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias
from uuid import uuid4

from graphslam import __version__
from graphslam.campaigns.tasks import code_version
from graphslam.core.config import Config
from graphslam.core.config_io import dump_config
from graphslam.core.errors import LogError, OutputError
from graphslam.core.memory_limit import limited_memory
from graphslam.logs.container_files import digest

Row = dict[str, Any]

#: in the folder of a batch: result folders, and what is not whole yet
RESULTS, UNFINISHED = "results", ".unfinished"
#: beside the files of a result: what the overview says of it, and its picture there
ROW, MAP = "row.json", "map.svg"

#: writes the files of a log's folder, and returns what else its row holds
Make: TypeAlias = Callable[["LogTask", Path], Row]


@dataclass(frozen=True)
class LogTask:
    """A recording at ``path``, of which ``results/NAME`` in ``directory`` is made.

    ``again``: also if that is done already. ``backends``: to be compared, see `parse_variants`;
    none: it is smoothed. ``mode``: of a comparison. ``known_map``: SHA-256 of the map that the
    settings name, of which they hold only the folder; empty without one.
    """

    name: str
    path: str
    directory: str
    config: Config
    again: bool = False
    backends: tuple[str, ...] = ()
    mode: str = ""
    known_map: str = ""

    @property
    def target(self) -> Path:
        """The folder of the result."""
        return Path(self.directory) / RESULTS / self.name


def identify(task: LogTask) -> Row:
    """The keys of a row that say what was asked, and of which files; without their contents.

    Raises:
        LogError: the files cannot be looked at.
    """
    compared = f"{task.backends} {task.mode}" if task.backends else ""
    asked = dump_config(task.config) + compared + task.known_map
    settings = hashlib.sha256(asked.encode()).hexdigest()
    return {
        "name": task.name,
        "path": task.path,
        "config_sha256": settings,
        "version": __version__,
        "code": code_version(),
        "files": _files(Path(task.path)),
    }


def is_same_work(row: Mapping[str, Any], asked: Mapping[str, Any]) -> bool:
    """Whether a row is of these settings, this code and a log that was not touched since.

    Of files the size and the time of change are compared, not the contents.
    """
    keys = ("config_sha256", "code", "path")
    if any(row.get(key) != asked[key] for key in keys):
        return False
    known = [{**file, "sha256": None} for file in row.get("files", ())]
    return known == [{**file, "sha256": None} for file in asked["files"]]


def do_log(task: LogTask, make: Make) -> Row:
    """Write the folder of a log, unless that was done with the same contents.

    Returns the row of the overview.

    Raises:
        GraphSlamError: the log cannot be read or used, or nothing can be written.
    """
    began = time.perf_counter()
    asked = identify(task)
    for file in asked["files"]:
        file["sha256"] = _sha256(Path(file["path"]))
    known = read_row(task.target)
    if known and not task.again and _is_done(known, asked):
        return put_row(task, {**known, "files": asked["files"]})
    with _Unfinished(task) as part, limited_memory(task.config.limits.memory_mb):
        found = {**asked, "status": "done", "error": None, **make(task, part.folder)}
        found["seconds"] = round(time.perf_counter() - began, 3)
        part.put_in_place(found)
    return found


def failed_row(task: LogTask, error: str) -> Row:
    """Row of a log that could not be smoothed; it takes the place of an earlier result.

    Raises:
        OutputError: it cannot be written.
    """
    try:
        asked = identify(task)
    except LogError:
        asked = {"name": task.name, "path": task.path, "files": []}
    row = {**asked, "status": "failed", "error": error.replace(f"{task.path}: ", "")}
    with _Unfinished(task) as part:
        part.folder.mkdir(parents=True)
        part.put_in_place(row)
    return row


def read_row(target: Path) -> Row | None:
    """The row in a result folder; None where there is none."""
    try:
        row = json.loads((target / ROW).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return row if isinstance(row, dict) else None


def has_failed(row: Mapping[str, Any]) -> bool:
    """Whether there is no result of a log, or one of a comparison in which a back end failed."""
    return row.get("error") is not None


def put_row(task: LogTask, row: Row) -> Row:
    """Replace the row of a result that stays.

    Raises:
        OutputError: it cannot be written.
    """
    part = task.target / f".{ROW}.{uuid4().hex}"
    try:
        part.write_text(_json(row), encoding="utf-8")
        part.replace(task.target / ROW)
    except OSError as error:
        raise OutputError(f"{task.target}: cannot be written: {error.strerror}") from error
    return row


def _is_done(row: Mapping[str, Any], asked: Mapping[str, Any]) -> bool:
    """Whether all was made of the same contents with these settings by this code."""
    if (
        row.get("status") != "done"
        or has_failed(row)
        or row.get("config_sha256") != asked["config_sha256"]
    ):
        return False
    contents = [[file["sha256"] for file in one["files"]] for one in (row, asked)]
    return row.get("code") == asked["code"] and contents[0] == contents[1]


class _Unfinished:
    """A folder under a name of this worker's own, as a context; it takes the result's place."""

    def __init__(self, task: LogTask) -> None:
        self._own = Path(task.directory) / UNFINISHED / uuid4().hex
        self._target = task.target
        self.folder = self._own / "result"

    def __enter__(self) -> "_Unfinished":
        return self

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self._own, ignore_errors=True)

    def put_in_place(self, row: Row) -> None:
        """Add the row, and rename; an earlier result is moved away first.

        Raises:
            OutputError: the disk refuses.
        """
        try:
            (self.folder / ROW).write_text(_json(row), encoding="utf-8")
            self._target.parent.mkdir(exist_ok=True)
            with suppress(FileNotFoundError):
                self._target.rename(self._own / "earlier")
            try:
                self.folder.rename(self._target)
            except OSError:
                # another worker with the same log was faster
                if read_row(self._target) is None:
                    raise
        except OSError as error:
            raise OutputError(f"{self._target}: cannot be written: {error.strerror}") from error


def _files(path: Path) -> list[Row]:
    """Every file of a recording with its size and time of change."""
    try:
        files = sorted(p for p in path.iterdir() if p.is_file()) if path.is_dir() else [path]
        found = [(file, file.stat()) for file in files]
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}; check the path") from error
    return [
        {"path": os.fspath(file), "bytes": stat.st_size, "mtime_ns": stat.st_mtime_ns}
        for file, stat in found
    ]


def _sha256(path: Path) -> str:
    try:
        return digest(path)
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}; check the file") from error


def _json(row: Row) -> str:
    return json.dumps(row, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
