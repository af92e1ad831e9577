"""Many logs, each smoothed or compared by itself: a folder of results and one overview of them.

The folder holds results/NAME of each log (a folder as of `smooth` or `compare`, with row.json and
map.svg), overview.json and report.html. Nothing else is kept: what is done is known by the rows.
"""

import os
import shutil
import socket
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from graphslam import __version__
from graphslam.campaigns.engine import run_tasks
from graphslam.campaigns.one_log import (
    MAP,
    RESULTS,
    UNFINISHED,
    LogTask,
    Row,
    failed_row,
    has_failed,
    identify,
    is_same_work,
    read_row,
)
from graphslam.campaigns.tasks import Outcome, Task, Workers, code_version
from graphslam.core.config import Config
from graphslam.core.errors import ConfigError, LogError, OutputError, described
from graphslam.logs.find_recordings import find_recordings
from graphslam.results.file_formats import read_json, to_json
from graphslam.results.report_batch import batch_page
from graphslam.results.report_comparisons import comparisons_page

FORMAT = "graphslam-batch-1"
OVERVIEW, PAGE, LOCK = "overview.json", "report.html", ".lock"
#: what is done with each log -> the page of all
PAGES = {"smooth": batch_page, "compare": comparisons_page}
#: s; the overview is not written more often while logs are done
WRITE_INTERVAL_S = 20.0
#: the line of a log for which memory was short
NO_MEMORY = "there is not enough memory; have fewer workers with more memory each"


def run_batch(
    places: Sequence[Path],
    config: Config,
    directory: Path,
    workers: Workers,
    *,
    backends: Sequence[str] = (),
    mode: str = "replay",
    retry: bool = False,
    force: bool = False,
    progress: Callable[[int, int], None] = lambda _done, _all: None,
    announce: Callable[[str], None] = lambda _text: None,
    detail: Callable[[str], None] = lambda _text: None,
) -> dict[str, Any]:
    """Smooth every recording in ``places`` that is not done, or compare; returns the overview.

    A log that fails has its error in its row, and the others go on. What is done stays, however
    this ends.

    Args:
        places: recordings, or folders of them.
        config: settings, the same for all.
        directory: the folder of the batch, made if necessary.
        workers: who does it.
        backends: to be compared on each log, see `parse_variants`; none: logs are smoothed.
        mode: of the comparison.
        retry: do again what failed.
        force: do everything again.
        progress: called with the number of logs that are done, and of all.
        announce: called with a line about a log that failed.
        detail: called with a line on who works, and with how much memory.

    Raises:
        LogError: there is no recording.
        ConfigError: a back end is unknown, or back ends are to be compared in a known map.
        OutputError: the folder holds something else, another process works on it, or it cannot be
            written; the known map cannot be read; also see `run_tasks`.
    """
    began = time.perf_counter()
    found = find_recordings(places, without=directory)
    root = os.fspath(directory.resolve())
    if backends:  # a wrong one is said before any work
        from graphslam.evaluation.compare_variants import parse_variants  # noqa: PLC0415

        parse_variants(backends, config)
    config, known_map = _with_known_map(config, backends)
    specs, mode = tuple(backends), mode if backends else ""
    tasks = [
        LogTask(name, os.fspath(path), root, config, force, specs, mode, known_map)
        for name, path in found.recordings
    ]
    with _locked(directory, "compare" if backends else "smooth"):
        rows = {} if force else {task.name: row for task in tasks if (row := _kept(task, retry))}
        missing = [task for task in tasks if task.name not in rows]
        missing.sort(key=_size, reverse=True)  # the longest first: none is left over at the end
        overview = _Overview(directory, tasks, rows, found.others, began)
        overview.write()
        progress(len(rows), len(tasks))
        by_label = {task.name: task for task in missing}
        try:
            jobs = [Task(task.name, make_result, (task,)) for task in missing]
            for outcome in run_tasks(jobs, workers, overview.noting_workers(detail)):
                row = _row(by_label[outcome.task.label], outcome)
                overview.add(row)
                progress(len(rows), len(tasks))
                if has_failed(row):
                    announce(f"{row['name']}: {row['error']}")
        finally:
            content = overview.write()
    return content


def _with_known_map(config: Config, backends: Sequence[str]) -> tuple[Config, str]:
    """The settings with a known map, if any, where workers find it, and its SHA-256.

    It can be read; without one the latter is empty.
    """
    if not config.known_map.directory:
        return config, ""
    if backends:
        raise ConfigError("known_map.directory: back ends are compared without a known map")
    from graphslam.results.known_map_file import known_map_of  # noqa: PLC0415

    known = known_map_of(config)
    directory = os.fspath(Path(config.known_map.directory).resolve())
    config = replace(config, known_map=replace(config.known_map, directory=directory))
    return config, known.sha256 if known else ""


def make_result(task: LogTask) -> Row:
    """See `work_on_log`; a worker imports what it needs for that, who asks for it does not."""
    from graphslam.campaigns.log_results import work_on_log  # noqa: PLC0415

    return work_on_log(task)


def kind_of(directory: Path) -> str | None:
    """What a batch does that a folder is of, ``smooth`` or ``compare``; None for other folders."""
    try:
        found = read_json(directory / OVERVIEW)
    except OutputError:
        return None
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        return None
    return str(found.get("kind"))


def _kept(task: LogTask, retry: bool) -> Row | None:
    """The row of a log that need not be done."""
    row = read_row(task.target)
    if row is None or (retry and has_failed(row)):
        return None
    try:
        return row if is_same_work(row, identify(task)) else None
    except LogError:
        return None  # a worker says what is wrong with it


def _row(task: LogTask, outcome: Outcome) -> Row:
    if outcome.error is not None:
        return failed_row(task, described(outcome.error, NO_MEMORY))
    row: Row = outcome.value
    return row


def _size(task: LogTask) -> int:
    with suppress(LogError):
        return sum(int(file["bytes"]) for file in identify(task)["files"])
    return 0


class _Overview:
    """Collects the rows, and writes what is there."""

    def __init__(
        self,
        directory: Path,
        tasks: Sequence[LogTask],
        rows: dict[str, Row],
        others: Sequence[Path],
        began: float,
    ) -> None:
        self._directory, self._tasks, self._rows = directory, tasks, rows
        self._others, self._began = others, began
        self._workers: str | None = None
        self._new: set[str] = set()
        self._written = -WRITE_INTERVAL_S

    def noting_workers(self, then: Callable[[str], None]) -> Callable[[str], None]:
        """A function that keeps who works, in words, and passes it on."""

        def noted(text: str) -> None:
            self._workers = text
            then(text)

        return noted

    def add(self, row: Row) -> None:
        """A log is done, or failed."""
        self._rows[row["name"]] = row
        self._new.add(row["name"])
        if time.perf_counter() - self._written > WRITE_INTERVAL_S:
            self.write()

    def content(self) -> dict[str, Any]:
        """What overview.json holds."""
        logs = [
            self._rows.get(task.name)
            or {"name": task.name, "path": task.path, "status": "waiting", "error": None}
            for task in self._tasks
        ]
        done = [row for row in logs if row["status"] == "done"]
        verdicts = Counter(row.get("verdict") for row in done)
        return {
            "format": FORMAT,
            "kind": "compare" if self._tasks[0].backends else "smooth",
            "version": __version__,
            "code": code_version(),
            "counts": {
                "logs": len(logs),
                "done": sum(not has_failed(row) for row in done),
                "failed": sum(map(has_failed, logs)),
                "waiting": sum(row["status"] == "waiting" for row in logs),
                "done_now": len(self._new),
                **{name: verdicts[name] for name in ("good", "doubtful", "bad")},
            },
            "totals": {
                key: round(sum(row.get(key, 0.0) for row in done), 3)
                for key in ("length_m", "duration_s", "seconds")
            },
            "workers": self._workers,
            "seconds": round(time.perf_counter() - self._began, 3),
            "not_recordings": sorted(map(str, self._others)),
            "logs": logs,
        }

    def write(self) -> dict[str, Any]:
        """Write overview.json and report.html, each atomically; returns the former.

        Raises:
            OutputError: the disk refuses.
        """
        self._written = time.perf_counter()
        content = self.content()
        maps = {row["name"]: self._map(row["name"]) for row in content["logs"]}
        files = {OVERVIEW: to_json(content, OVERVIEW), PAGE: PAGES[content["kind"]](content, maps)}
        try:
            for name, text in files.items():
                part = self._directory / f".{name}.part"
                part.write_text(text, encoding="utf-8", errors="backslashreplace")
                part.replace(self._directory / name)
        except OSError as error:
            raise OutputError(f"{self._directory}: cannot be written: {error.strerror}") from error
        return content

    def _map(self, name: str) -> str:
        try:
            return (self._directory / RESULTS / name / MAP).read_text(encoding="utf-8")
        except OSError:
            return ""


@contextmanager
def _locked(directory: Path, kind: str) -> Iterator[None]:
    """Make the folder, or check that it is that of a batch; nobody else works on it meanwhile.

    What a killed process left unfinished is removed. ``kind``: as of `kind_of`.
    """
    if directory.exists() and not directory.is_dir():
        raise OutputError(f"{directory}: is not a folder")
    if directory.is_dir() and any(directory.iterdir()):
        # the lock alone: it was killed before it wrote anything
        there = {path.name for path in directory.iterdir()} - {LOCK, UNFINISHED}
        if there and kind_of(directory) != kind:
            raise OutputError(
                f"{directory}: is not the folder of such a batch; choose another name"
            )
    lock = directory / LOCK
    try:
        directory.mkdir(parents=True, exist_ok=True)
        _check_lock(lock)
        lock.write_text(f"{socket.gethostname()} {os.getpid()}\n", encoding="utf-8")
        shutil.rmtree(directory / UNFINISHED, ignore_errors=True)
        try:
            yield
        finally:
            shutil.rmtree(directory / UNFINISHED, ignore_errors=True)
            lock.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{directory}: cannot be written: {error.strerror}") from error


def _check_lock(lock: Path) -> None:
    """Raise an error if another process of this machine works on the folder."""
    try:
        host, _, number = lock.read_text(encoding="utf-8").strip().partition(" ")
        if host != socket.gethostname() or int(number) == os.getpid():
            return
        os.kill(int(number), 0)
    except (FileNotFoundError, ProcessLookupError, ValueError):
        return
    except PermissionError:
        pass
    raise OutputError(
        f"{lock.parent}: process {number} works on it; wait for it, or choose another folder"
    )
