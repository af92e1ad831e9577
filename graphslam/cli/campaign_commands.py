"""The commands that may use many workers: `batch`, `experiment` and `compare`."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

import graphslam
from graphslam.cli.arguments import (
    Backend,
    Backends,
    BatchFolder,
    Causal,
    ComparisonMode,
    ConfigFile,
    Each,
    Experiment,
    ExperimentFolder,
    Force,
    ForceOrResume,
    FrontEnd,
    Jobs,
    Logs,
    LogsOrFolders,
    Memory,
    OutputFolder,
    Preset,
    Relations,
    Retry,
    Runs,
    Scheduler,
    Settings,
    Starts,
    Strict,
    TruthFiles,
    workers_of,
)
from graphslam.cli.registry import Output, command
from graphslam.cli.smoothing_options import smoothing_settings
from graphslam.cli.terminal import detail, note, progress_bar
from graphslam.core.config import Config
from graphslam.core.config_io import load_config

if TYPE_CHECKING:
    from graphslam.campaigns.tasks import Workers


@command("batch")
def batch(
    logs: LogsOrFolders,
    output: BatchFolder,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    memory: Memory = None,
    backend: Backend = None,
    front_end: FrontEnd = None,
    start: Starts = None,
    causal: Causal = False,
    preset: Preset = None,
    config: ConfigFile = None,
    settings: Settings = None,
    retry: Retry = False,
    force: ForceOrResume = False,
    strict: Strict = False,
) -> Output:
    """Smooth many logs, each by itself, and write one overview of all.

    Each becomes a folder DIR/results/NAME as of smooth; report.html and overview.json tell of all.
    Called again it does only what is new or changed; what failed is done again with --retry.
    """
    from graphslam.campaigns.batch import run_batch
    from graphslam.cli.show_campaigns import batch as show_batch

    workers = workers_of(jobs, scheduler, memory)
    chosen = smoothing_settings(backend, front_end, start, settings, causal=causal)
    tree = load_config(config, chosen, preset)
    with progress_bar("smoothing") as progress:
        found = run_batch(
            logs, tree, output, workers, retry=retry, force=force, progress=progress, announce=note,
            detail=detail,
        )  # fmt: skip
    counts = found["counts"]
    code = 3 if strict and counts["good"] < counts["logs"] else 0
    return Output(found, lambda: show_batch(found, output), _failure(found), code)


@command("experiment")
def experiment(
    name: Experiment,
    output: ExperimentFolder,
    runs: Runs = None,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    memory: Memory = None,
    force: ForceOrResume = False,
) -> Output:
    """Run a Monte Carlo experiment: many seeds, estimators and noise scales.

    Writes results.jsonl, a row per run as it ends, then summary.json, report.html and figures.
    An interrupted run is resumed when it is called again.
    """
    from graphslam.campaigns.experiment import run_campaign
    from graphslam.cli import show
    from graphslam.evaluation.monte_carlo_campaign import list_jobs
    from graphslam.evaluation.monte_carlo_definition import load_definition
    from graphslam.evaluation.monte_carlo_folder import save_summary
    from graphslam.evaluation.monte_carlo_paths import run_maps
    from graphslam.evaluation.monte_carlo_summary import summarise

    workers = workers_of(jobs, scheduler, memory)
    definition = load_definition(name)
    definition = replace(definition, runs=runs or definition.runs)
    total = len(list_jobs(definition))
    with progress_bar("running") as progress:
        rows = run_campaign(
            definition, output, workers, force=force, progress=lambda n: progress(n, total),
            announce=detail,
        )  # fmt: skip
    summary = summarise(definition, rows)
    save_summary(summary, output, run_maps(definition, rows))
    return Output(summary, lambda: show.experiment(summary, output))


@command("compare")
def compare(
    logs: Logs,
    output: OutputFolder,
    backends: Backends = "ekf,ekf+ekf.error=body,isam2:0,isam2,batch",
    mode: ComparisonMode = "replay",
    truth: TruthFiles = None,
    relations: Relations = None,
    front_end: FrontEnd = None,
    start: Starts = None,
    preset: Preset = None,
    config: ConfigFile = None,
    settings: Settings = None,
    force: Force = False,
    each: Each = False,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    memory: Memory = None,
    retry: Retry = False,
) -> Output:
    """Compare back ends on one log: errors, consistency, time, memory.

    Writes a folder with compare.json and report.html. With --each on every log of files and folders
    by itself, as batch does it, with one overview.
    """
    from graphslam.cli import show
    from graphslam.evaluation.compare_folder import failed_backends

    specs = [spec for spec in backends.split(",") if spec]
    tree = load_config(config, smoothing_settings(None, front_end, start, settings), preset)
    if each:
        if truth or relations is not None:
            raise typer.BadParameter("with --each the truth is that in each log")
        workers = workers_of(jobs, scheduler, memory)
        return _compare_each(logs, tree, output, workers, specs, mode, retry=retry, force=force)
    if retry or (jobs, scheduler, memory) != (None, None, None):
        raise typer.BadParameter("workers are for many logs: give --each")
    with progress_bar("associating") as progress:
        comparison = graphslam.compare(
            logs, specs, mode=mode, truth=truth or None, relations=relations, config=tree,
            output=output, force=force, progress=progress, announce=show.stage,
        )  # fmt: skip
    found = comparison.summary
    return Output(found, lambda: show.comparison(found, output), failed_backends(found))


def _compare_each(
    logs: Sequence[Path],
    config: Config,
    output: Path,
    workers: "Workers",
    backends: Sequence[str],
    mode: str,
    *,
    retry: bool,
    force: bool,
) -> Output:
    """What `compare` does with --each."""
    from graphslam.campaigns.batch import run_batch
    from graphslam.cli.show_campaigns import comparisons

    with progress_bar("comparing") as progress:
        found = run_batch(
            logs, config, output, workers, backends=backends, mode=mode, retry=retry, force=force,
            progress=progress, announce=note, detail=detail,
        )  # fmt: skip
    return Output(found, lambda: comparisons(found, output), _failure(found))


def _failure(found: Mapping[str, Any]) -> str:
    """How many logs failed, and the line of the first."""
    failed = [f"{row['name']}: {row['error']}" for row in found["logs"] if row["error"]]
    return f"{len(failed)} of {found['counts']['logs']} logs failed; {failed[0]}" if failed else ""
