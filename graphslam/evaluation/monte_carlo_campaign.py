"""All runs of an experiment, in parallel processes; an interrupted experiment can be resumed.

The folder of an experiment holds definition.json (what it is) and results.jsonl (a row per run).
A run is random by its seed alone, so neither the number of processes nor the order in which runs
end changes a row.
"""

import hashlib
import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cache
from multiprocessing import get_context, resource_tracker
from pathlib import Path
from typing import Any

import numpy as np

from graphslam import __version__
from graphslam.core.errors import OutputError
from graphslam.evaluation.monte_carlo_bench import draw_run, run_seed
from graphslam.evaluation.monte_carlo_bench_run import run_bench
from graphslam.evaluation.monte_carlo_definition import Definition
from graphslam.evaluation.monte_carlo_log_run import run_log, scratch_folder
from graphslam.evaluation.thesis_experiments import EXPERIMENTS

Row = dict[str, Any]

ROWS, DEFINITION = "results.jsonl", "definition.json"


@dataclass(frozen=True)
class Job:
    """Identifies a run. ``scenario`` and ``front_end`` are empty on the bench."""

    scenario: str
    front_end: str
    scale: float
    variant: str
    run: int


def list_jobs(definition: Definition) -> list[Job]:
    """Every run of an experiment; all variants of a run are neighbours."""
    if definition.chapter is not None:
        chapter = definition.chapter
        sources = [(name, f) for name in chapter.experiments for f in chapter.front_ends]
    elif definition.logs is None:
        sources = [("", "")]
    else:
        sources = [(s, f) for s in definition.logs.scenarios for f in definition.logs.front_ends]
    return [
        Job(scenario, front_end, scale, variant, run)
        for run in range(definition.runs)
        for scenario, front_end in sources
        for scale in definition.noise_scales
        for variant in definition.variants
    ]


def run_job(definition: Definition, job: Job) -> Row:
    """The results of a run, as a row without its identification.

    Raises:
        GraphSlamError: the run failed.
    """
    sequence = run_seed(definition.seed, job.scale, job.run)
    if definition.bench is not None:
        rng = np.random.default_rng(sequence)
        slip = definition.bench.slip
        told = slip is not None and job.variant in slip.told
        run = draw_run(definition.bench, job.scale, rng, told=told)
        # other messages are lost in every run
        return run_bench(run, definition.config(job.variant, f"network.seed={job.run}"))
    config = definition.config(job.variant, f"front_end.name={job.front_end}")
    if definition.chapter is not None:
        with scratch_folder() as folder:
            experiment = EXPERIMENTS[job.scenario]
            return {"values": experiment(definition.seed + job.run, folder, config)}
    drawn = definition.logs is not None and definition.logs.draw_starts
    seed = int(sequence.generate_state(1)[0])
    return run_log(job.scenario, job.scale, seed, config, draw_starts=drawn)


def run_campaign(
    definition: Definition,
    directory: Path,
    *,
    jobs: int | None = None,
    force: bool = False,
    progress: Callable[[int], None] = lambda _done: None,
) -> list[Row]:
    """Run what is not in ``directory`` yet; returns all rows, in the order of `list_jobs`.

    A run that fails is a row with its error. Rows are appended whole, one at a time; after an
    interruption another call runs the rest.

    Args:
        definition: the experiment.
        directory: its folder, made if necessary.
        jobs: processes; None = one per core.
        force: delete existing rows instead of resuming.
        progress: called with the number of runs that are done.

    Raises:
        OutputError: the folder holds something else, cannot be written, or a process died.
    """
    wanted = list_jobs(definition)
    try:
        _prepare(definition, directory, force)
        found = {key: row for key, row in _read(directory / ROWS) if key in set(wanted)}
        progress(len(found))
        with (directory / ROWS).open("a", encoding="utf-8") as file:
            missing = [job for job in wanted if job not in found]
            for job, row in _run(definition, missing, jobs):
                file.write(json.dumps(row, allow_nan=False) + "\n")
                file.flush()
                found[job] = row
                progress(len(found))
    except OSError as error:
        raise OutputError(f"{directory}: cannot be written: {error.strerror}") from error
    return [found[job] for job in wanted]


def _run(
    definition: Definition, missing: list[Job], processes: int | None
) -> Iterator[tuple[Job, Row]]:
    if not missing:
        return
    with _one_thread_each():
        pool = ProcessPoolExecutor(
            min(processes or os.cpu_count() or 1, len(missing)), get_context("spawn")
        )
        with _without_ctrl_c():  # processes start when runs are submitted
            futures = {pool.submit(_timed, definition, job): job for job in missing}
        try:
            for future in as_completed(futures):
                yield futures[future], _row(definition, futures[future], future)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _timed(definition: Definition, job: Job) -> Row:
    began = time.perf_counter()
    row = run_job(definition, job)
    return {"seconds": round(time.perf_counter() - began, 4), **row}


def _row(definition: Definition, job: Job, future: "Future[Row]") -> Row:
    """A complete row: which run, by which code, and its results or its error."""
    error = future.exception()
    if isinstance(error, BrokenProcessPool):
        raise OutputError(
            "a process of the experiment died (out of memory?); run it again with fewer --jobs: "
            "it continues where it stopped"
        ) from error
    row: Row = {
        **asdict(job),
        "seed": [definition.seed, *run_seed(definition.seed, job.scale, job.run).spawn_key],
        "settings": [*definition.settings, *definition.variants[job.variant]],
        "version": __version__,
        "code": code_version(),
        "error": None if error is None else f"{type(error).__name__}: {error}",
    }
    return row if error is not None else {**row, **_finite(future.result())}


def _finite(value: Any) -> Any:
    """Plain JSON: seven digits, and null where a number is not finite."""
    if isinstance(value, dict):
        return {key: _finite(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, float):
        return float(f"{value:.7g}") if np.isfinite(value) else None
    return value


@contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """Processes started inside ignore Ctrl-C, which a terminal sends to all of its processes.

    Only the parent acts on it, as soon as the block ends: children inherit the signal mask.
    """
    resource_tracker.ensure_running()  # its start would lift the mask
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Child processes use one thread each: there are as many of them as cores."""
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@cache
def code_version() -> str:
    """First digits of the SHA-256 of the package's sources, to identify the code of a row."""
    root = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


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


def _identity(definition: Definition) -> str:
    """What identifies a definition: all that the rows depend on but the number of runs."""
    tree = {
        key: value
        for key, value in asdict(definition).items()
        if key not in ("runs", "description", "name")
    }
    if tree["logs"]:
        del tree["logs"]["diverged_m"]  # of the summary only
    return json.dumps(tree, indent=1, sort_keys=True) + "\n"


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
