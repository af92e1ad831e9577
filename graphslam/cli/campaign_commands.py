"""The commands that do many things with many workers: `batch` and `experiment`."""

from dataclasses import replace

from graphslam.cli.arguments import (
    Backend,
    BatchFolder,
    Causal,
    ConfigFile,
    Experiment,
    ExperimentFolder,
    ForceOrResume,
    FrontEnd,
    Jobs,
    LogsOrFolders,
    Memory,
    Preset,
    Retry,
    Runs,
    Scheduler,
    Settings,
    Starts,
    Strict,
    smoothing_settings,
    workers_of,
)
from graphslam.cli.registry import Output, command
from graphslam.cli.terminal import note, progress_bar
from graphslam.core.config_io import load_config


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
            logs, tree, output, workers, retry=retry, force=force, progress=progress, announce=note
        )
    counts = found["counts"]
    failed = [f"{row['name']}: {row['error']}" for row in found["logs"] if row["error"]]
    failure = f"{len(failed)} of {counts['logs']} logs failed; {failed[0]}" if failed else ""
    code = 3 if strict and counts["good"] < counts["logs"] else 0
    return Output(found, lambda: show_batch(found, output), failure, code)


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
    from graphslam.evaluation.monte_carlo_summary import summarise

    workers = workers_of(jobs, scheduler, memory)
    definition = load_definition(name)
    definition = replace(definition, runs=runs or definition.runs)
    total = len(list_jobs(definition))
    with progress_bar("running") as progress:
        rows = run_campaign(
            definition, output, workers, force=force, progress=lambda n: progress(n, total)
        )
    summary = summarise(definition, rows)
    save_summary(summary, output)
    return Output(summary, lambda: show.experiment(summary, output))
