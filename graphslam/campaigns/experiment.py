"""All runs of an experiment, by many workers; an interrupted experiment can be resumed.

The folder of an experiment holds definition.json (what it is) and results.jsonl (a row per run).
A run is random by its seed alone, so neither the workers nor the order in which runs end change a
row.
"""

import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from graphslam import __version__
from graphslam.campaigns.engine import run_tasks
from graphslam.campaigns.tasks import Outcome, Task, WorkerLostError, Workers, code_version
from graphslam.core.errors import OutputError
from graphslam.evaluation.monte_carlo_bench import run_seed
from graphslam.evaluation.monte_carlo_campaign import Job, Row, list_jobs, run_job
from graphslam.evaluation.monte_carlo_definition import Definition
from graphslam.simulation import SCENARIOS, ScenarioError
from graphslam.simulation.scenario_files import scenario_sha256

ROWS, DEFINITION = "results.jsonl", "definition.json"


def run_campaign(
    definition: Definition,
    directory: Path,
    workers: Workers | None = None,
    *,
    force: bool = False,
    progress: Callable[[int], None] = lambda _done: None,
    announce: Callable[[str], None] = lambda _text: None,
) -> list[Row]:
    """Run what is not in ``directory`` yet; returns all rows, in the order of `list_jobs`.

    A run that fails is a row with its error. Rows are appended whole, one at a time; after an
    interruption another call runs the rest. At the end the file has them in their order.

    Args:
        definition: the experiment.
        directory: its folder, made if necessary.
        workers: who does it; None: a process per core.
        force: delete existing rows instead of resuming.
        progress: called with the number of runs that are done.
        announce: called with a line on who works, and with how much memory.

    Raises:
        OutputError: the folder holds something else, cannot be written, or workers died; also see
            `graphslam.campaigns.engine.run_tasks`.
    """
    wanted = list_jobs(definition)
    file = directory / ROWS
    lost: list[WorkerLostError] = []
    try:
        _prepare(definition, directory, force)
        found = {key: row for key, row in _read(file) if key in set(wanted)}
        progress(len(found))
        missing = [job for job in wanted if job not in found]
        try:
            with file.open("a", encoding="utf-8") as stream:
                for job, outcome in _run(definition, missing, workers or Workers(), announce):
                    if isinstance(outcome.error, WorkerLostError):
                        lost.append(outcome.error)  # no row: it may go well another time
                        continue
                    found[job] = _row(definition, job, outcome)
                    stream.write(_line(found[job]))
                    stream.flush()
                    progress(len(found))
        finally:
            _sort(file, wanted)
    except OSError as error:
        raise OutputError(f"{directory}: cannot be written: {error.strerror}") from error
    if lost:
        raise OutputError(
            f"{len(lost)} runs are missing, since their workers died ({lost[0]}); "
            "run it again with fewer workers: it continues where it stopped"
        )
    return [found[job] for job in wanted]


def _run(
    definition: Definition,
    missing: Sequence[Job],
    workers: Workers,
    announce: Callable[[str], None],
) -> Iterator[tuple[Job, Outcome]]:
    labelled = {"-".join(map(str, asdict(job).values())): job for job in missing}
    tasks = [Task(label, _timed, (definition, job)) for label, job in labelled.items()]
    for outcome in run_tasks(tasks, workers, announce):
        yield labelled[outcome.task.label], outcome


def _timed(definition: Definition, job: Job) -> Row:
    began = time.perf_counter()
    row = run_job(definition, job)
    return {"seconds": round(time.perf_counter() - began, 4), **row}


def _row(definition: Definition, job: Job, outcome: Outcome) -> Row:
    """A complete row: which run, by which code, and its results or its error."""
    error = outcome.error
    row: Row = {
        **asdict(job),
        "seed": [definition.seed, *run_seed(definition.seed, job.scale, job.run).spawn_key],
        "settings": [*definition.settings, *definition.variants[job.variant]],
        "version": __version__,
        "code": code_version(),
        "error": None if error is None else f"{type(error).__name__}: {error}",
    }
    return row if error is not None else {**row, **_finite(outcome.value)}


def _finite(value: Any) -> Any:
    """Plain JSON: seven digits, and null where a number is not finite."""
    if isinstance(value, dict):
        return {key: _finite(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, float):
        return float(f"{value:.7g}") if np.isfinite(value) else None
    return value


# ---------------------------------------------------------------- the folder


def _prepare(definition: Definition, directory: Path, force: bool) -> None:
    """Make the folder, or check that it belongs to this experiment."""
    text = _identity(definition)
    existing = directory / DEFINITION
    if directory.exists() and not directory.is_dir():
        raise OutputError(f"{directory}: is not a folder")
    if directory.is_dir() and any(directory.iterdir()):
        if not existing.is_file():
            raise OutputError(
                f"{directory}: is not the folder of an experiment; choose another name"
            )
        if not force and existing.read_text(encoding="utf-8") != text:
            raise OutputError(
                f"{directory}: holds another experiment or an earlier definition of this one; "
                "choose another folder, or give --force to delete its runs"
            )
        if force:
            (directory / ROWS).unlink(missing_ok=True)
    directory.mkdir(parents=True, exist_ok=True)
    existing.write_text(text, encoding="utf-8")


def _line(row: Row) -> str:
    return json.dumps(row, allow_nan=False) + "\n"


def _sort(path: Path, wanted: Sequence[Job]) -> None:
    """Put the rows of the file into their order; those of runs that are not wanted come last."""
    place = {job: number for number, job in enumerate(wanted)}
    rows = sorted(_read(path), key=lambda found: place.get(found[0], len(place)))
    part = path.with_name(f".{path.name}.part")
    part.write_text("".join(_line(row) for _, row in rows), encoding="utf-8")
    part.replace(path)


def _identity(definition: Definition) -> str:
    """What identifies a definition: all that the rows depend on but the number of runs."""
    tree = {
        key: value
        for key, value in asdict(definition).items()
        if key not in ("runs", "description", "name")
    }
    if tree["logs"]:
        del tree["logs"]["diverged_m"]  # of the summary only
        # files of the user's have only their names there; those of the package are of its version
        own = [name for name in tree["logs"]["scenarios"] if name not in SCENARIOS]
        if own:
            tree["logs"]["sha256"] = {name: _content(name) for name in own}
    return json.dumps(tree, indent=1, sort_keys=True) + "\n"


def _content(scenario: str) -> str | None:
    """What identifies a scenario's content; None of one that cannot be read, as its rows say."""
    try:
        return scenario_sha256(scenario)
    except ScenarioError:
        return None


def _read(path: Path) -> Iterator[tuple[Job, Row]]:
    """Existing rows. An incomplete last line, for example after a power cut, is removed."""
    if not path.is_file():
        return
    data = path.read_bytes()
    whole = data[: data.rfind(b"\n") + 1]
    if len(whole) < len(data):
        path.write_bytes(whole)
    for number, line in enumerate(whole.splitlines(), start=1):
        try:
            row = json.loads(line)
            key = Job(**{name: row[name] for name in Job.__dataclass_fields__})
        except (ValueError, KeyError, TypeError) as error:
            raise OutputError(f"{path}:{number}: is not a row of an experiment") from error
        yield key, row
