"""One log of a batch: smoothed by a worker into a folder that appears whole, with its row.

Workers may share nothing with each other but the folder of the batch, and one log may be in the
hands of two of them, if the first one was taken for lost. So each makes its result under a name of
its own and renames it; the second one finds it done.
"""

import hashlib
import json
import os
import shutil
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from graphslam import __version__
from graphslam.campaigns.tasks import code_version
from graphslam.core.config import Config
from graphslam.core.config_io import dump_config
from graphslam.core.errors import LogError, OutputError
from graphslam.core.geometry import path_length
from graphslam.core.records import Result

Row = dict[str, Any]

#: in the folder of a batch: result folders, and what is not whole yet
RESULTS, UNFINISHED = "results", ".unfinished"
#: beside the files of a result: what the overview says of it
ROW, MAP = "row.json", "map.svg"


@dataclass(frozen=True)
class LogTask:
    """A recording at ``path``, to be smoothed into ``results/NAME`` of ``directory``.

    ``again``: also if that is done already.
    """

    name: str
    path: str
    directory: str
    config: Config
    again: bool = False

    @property
    def target(self) -> Path:
        """The folder of the result."""
        return Path(self.directory) / RESULTS / self.name


def identify(task: LogTask) -> Row:
    """The keys of a row that say what was asked, and of which files; without their contents.

    Raises:
        LogError: the files cannot be looked at.
    """
    settings = hashlib.sha256(dump_config(task.config).encode()).hexdigest()
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


def smooth_log(task: LogTask) -> Row:
    """Smooth a log and write its result folder, unless that was done with the same contents.

    Returns the row of the overview.

    Raises:
        GraphSlamError: the log cannot be read or smoothed, or nothing can be written.
    """
    # what a worker needs for logs only
    from graphslam.evaluation.ground_truth import errors_of_run, truth_of_logs  # noqa: PLC0415
    from graphslam.logs import open_logs  # noqa: PLC0415
    from graphslam.results.folder import save  # noqa: PLC0415
    from graphslam.results.report import render  # noqa: PLC0415
    from graphslam.results.small_map import small_map  # noqa: PLC0415
    from graphslam.slam.smooth import smooth  # noqa: PLC0415

    began = time.perf_counter()
    asked = identify(task)
    for file in asked["files"]:
        file["sha256"] = _sha256(Path(file["path"]))
    known = read_row(task.target)
    if known and not task.again and _is_done(known, asked):
        return put_row(task, {**known, "files": asked["files"]})
    log = open_logs([Path(task.path)], task.config)
    result = smooth(log, task.config)
    errors = errors_of_run(result, truth_of_logs(log, task.config))
    report = render(result, errors)
    with _Unfinished(task) as part:
        save(result, part.folder, force=False, report=lambda _result: report)
        (part.folder / MAP).write_text(small_map(result), encoding="utf-8")
        found = {**asked, "status": "done", "error": None, **_figures(result, errors)}
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
    """Whether the same contents were smoothed with these settings by this code."""
    if row.get("status") != "done" or row.get("config_sha256") != asked["config_sha256"]:
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


def _figures(result: Result, errors: Mapping[str, Any] | None) -> Row:
    """The numbers of the overview."""
    summary = result.summary
    states = result.estimate.states.values()
    spans = [p.stamps_ns[[0, -1]] for p in states if len(p.stamps_ns)]
    covs = np.concatenate([robot.final.covs[:, :2, :2] for robot in result.robots.values()])
    covs = covs[np.isfinite(covs).all(axis=(1, 2))]
    sigmas = np.sqrt(np.maximum(np.linalg.eigvalsh(covs)[:, -1], 0.0))
    final = ((errors or {}).get("joint") or {}).get("final") or {}
    return {
        "verdict": summary["verdict"]["verdict"],
        "reasons": [reason["text"] for reason in summary["verdict"]["reasons"]],
        "robots": sorted(result.robots),
        "length_m": round(sum(float(path_length(p.poses)[-1]) for p in states), 3),
        "duration_s": round(1e-9 * float(max(s[1] for s in spans) - min(s[0] for s in spans)), 3),
        "error_m": final.get("ate_aligned_rmse_m"),
        "sigma_m": float(np.median(sigmas)) if len(sigmas) else None,
        "loops": summary["counts"]["loop_closures"],
        "warnings": list(summary["warnings"]),
        "messages": summary["counts"]["messages"],
        "scans": summary["counts"]["scans"],
        "landmarks": len(result.landmarks),
        "memory_mb": summary["peak_memory_mb"],
    }


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
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}; check the file") from error


def _json(row: Row) -> str:
    return json.dumps(row, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
