"""The commands. Each checks its arguments, calls the package, and shows what it got.

What takes long to import is imported by the command that needs it, so that help and errors in
arguments appear at once.
"""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

import graphslam
from graphslam.cli import show
from graphslam.cli.arguments import (
    Backend,
    Backends,
    ComparisonMode,
    ConfigFile,
    Debug,
    Experiment,
    ExperimentFolder,
    Force,
    ForceOrResume,
    Format,
    FrontEnd,
    Horizon,
    Jobs,
    Json,
    LaterFolder,
    Logs,
    OutputFolder,
    OutputLog,
    OutputLogOrFolder,
    ReferenceFolder,
    Relations,
    ResultFolder,
    Runs,
    Scenario,
    Seed,
    Settings,
    Source,
    Span,
    Starts,
    TruthFiles,
    span_of,
)
from graphslam.cli.terminal import errors_in_one_line, progress_bar
from graphslam.core.config_io import load_config
from graphslam.core.errors import ConfigError, EstimationError, OutputError
from graphslam.logs import IMPORTERS, inspect_logs
from graphslam.results.file_formats import to_json

app = typer.Typer(
    help="Logs of wheeled robots in; trajectories, a landmark map and their covariances out.",
    context_settings={"help_option_names": ["-h", "--help"]},
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(graphslam.__version__)
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Logs of wheeled robots in; trajectories, a landmark map and their covariances out."""


def _print(name: str, content: Any, json: bool, for_people: Callable[[], None]) -> None:
    """Print ``content`` as one JSON object, or what ``for_people`` prints of it."""
    if json:
        typer.echo(to_json(content, name), nl=False)
    else:
        for_people()


@app.command("info")
def info_command(
    logs: Logs,
    config: ConfigFile = None,
    settings: Settings = None,
    json: Json = False,
    debug: Debug = False,
) -> None:
    """Say what is in a log, what is usable, what is odd."""
    with errors_in_one_line(debug):
        info = inspect_logs(logs, load_config(config, settings or ()))
        _print("info", info.to_dict(), json, lambda: show.log_info(info))


@app.command("import")
def import_command(
    format_name: Format,
    source: Source,
    output: OutputLog,
    json: Json = False,
    force: Force = False,
    debug: Debug = False,
) -> None:
    """Convert SOURCE to an MCAP log.

    True poses and landmarks, where SOURCE has any, go in too.
    """
    with errors_in_one_line(debug):
        if os.path.lexists(output) and not force:
            raise OutputError(f"{output}: already exists; give --force to replace it")
        done = IMPORTERS[format_name](source, output)
        content = {"log": str(output), "counts": done.counts, "warnings": done.warnings}
        _print("import", content, json, lambda: show.imported(done))


@app.command("simulate")
def simulate_command(
    scenario: Scenario,
    output: OutputLogOrFolder,
    seed: Seed = 0,
    json: Json = False,
    force: Force = False,
    debug: Debug = False,
) -> None:
    """Simulate a recording, with its truth.

    Equal scenarios and seeds give equal bytes.
    """
    with errors_in_one_line(debug):
        done = graphslam.simulate(scenario, output, seed=seed, force=force)
        _print("simulation", show.simulation(done), json, lambda: show.simulated(done))


@app.command("smooth")
def smooth_command(
    logs: Logs,
    output: ResultFolder,
    backend: Backend = None,
    horizon: Horizon = None,
    front_end: FrontEnd = None,
    start: Starts = None,
    config: ConfigFile = None,
    settings: Settings = None,
    json: Json = False,
    force: Force = False,
    debug: Debug = False,
) -> None:
    """Find the best trajectories and a landmark map.

    Writes a folder with trajectories, landmarks, covariances, the factor graph and report.html.
    """
    with errors_in_one_line(debug):
        options = [f"backend.name={backend}"] if backend else []
        options += [] if horizon is None else [f"backend.horizon_s={horizon}"]
        options += [f"front_end.name={front_end}"] if front_end else []
        tree = load_config(config, [*options, *(start or ()), *(settings or ())])
        if horizon is not None and tree.backend.name != "isam2":
            raise ConfigError(f"--horizon: only isam2 has one, not {tree.backend.name}; leave it")
        with progress_bar("smoothing") as progress:
            result = graphslam.smooth(
                logs, config=tree, output=output, force=force, progress=progress
            )
        _print("summary", result.summary, json, lambda: show.smoothed(result, output))


@app.command("evaluate")
def evaluate_command(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Result folder of smooth.")],
    truth: TruthFiles = None,
    relations: Relations = None,
    json: Json = False,
    debug: Debug = False,
) -> None:
    """Compare a result with the truth.

    That is true poses and landmarks, or reference relations between the scans.
    """
    with errors_in_one_line(debug):
        errors = graphslam.evaluate(directory, truth=truth or None, relations=relations)
        _print("evaluation", errors, json, lambda: show.evaluation(errors))


@app.command("compare")
def compare_command(
    logs: Logs,
    output: OutputFolder,
    backends: Backends = "ekf,isam2:0,isam2,batch",
    mode: ComparisonMode = "replay",
    truth: TruthFiles = None,
    relations: Relations = None,
    front_end: FrontEnd = None,
    start: Starts = None,
    config: ConfigFile = None,
    settings: Settings = None,
    json: Json = False,
    force: Force = False,
    debug: Debug = False,
) -> None:
    """Compare back ends on one log: errors, consistency, time, memory.

    Writes a folder with compare.json and report.html.
    """
    with errors_in_one_line(debug):
        options = [f"front_end.name={front_end}"] if front_end else []
        tree = load_config(config, [*options, *(start or ()), *(settings or ())])
        with progress_bar("associating") as progress:
            comparison = graphslam.compare(
                logs, [spec for spec in backends.split(",") if spec], mode=mode,
                truth=truth or None, relations=relations, config=tree, output=output, force=force,
                progress=progress, announce=show.stage,
            )  # fmt: skip
        found = comparison.found
        _print("comparison", found, json, lambda: show.comparison(found, output))
        failed = [f"{row['spec']}: {row['error']}" for row in found["rows"] if row["error"]]
        if failed:
            rows = len(found["rows"])
            raise EstimationError(f"{len(failed)} of {rows} back ends failed; {failed[0]}")


@app.command("changes")
def changes_command(
    reference: ReferenceFolder,
    later: LaterFolder,
    output: OutputFolder,
    reference_span: Span = None,
    later_span: Span = None,
    config: ConfigFile = None,
    settings: Settings = None,
    json: Json = False,
    force: Force = False,
    debug: Debug = False,
) -> None:
    """Find what is different since the last visit, and how sure.

    Writes changes.json, report.html, a map and an MCAP file of them. REFERENCE and LATER may be
    one folder with two spans.
    """
    with errors_in_one_line(debug):
        done = graphslam.changes_between(
            reference, later, reference_span_s=span_of(reference_span),
            later_span_s=span_of(later_span), config=load_config(config, settings or ()),
            output=output, force=force,
        )  # fmt: skip
        found = done.to_dict()
        _print("changes", found, json, lambda: show.changes(found, output))


@app.command("experiment")
def experiment_command(
    experiment: Experiment,
    output: ExperimentFolder,
    runs: Runs = None,
    jobs: Jobs = None,
    json: Json = False,
    force: ForceOrResume = False,
    debug: Debug = False,
) -> None:
    """Run a Monte Carlo experiment: many seeds, estimators and noise scales.

    Writes results.jsonl, a row per run as it ends, then summary.json, report.html and figures.
    Stopped, it goes on where it was when it is called again.
    """
    with errors_in_one_line(debug):
        from graphslam.evaluation.monte_carlo_campaign import jobs_of, run_campaign
        from graphslam.evaluation.monte_carlo_definition import load_definition
        from graphslam.evaluation.monte_carlo_folder import save_summary
        from graphslam.evaluation.monte_carlo_summary import summarise

        definition = load_definition(experiment)
        definition = replace(definition, runs=runs or definition.runs)
        total = len(jobs_of(definition))
        with progress_bar("running") as progress:
            rows = run_campaign(
                definition, output, jobs=jobs, force=force, progress=lambda n: progress(n, total)
            )
        summary = summarise(definition, rows)
        save_summary(summary, output)
        _print("experiment", summary, json, lambda: show.experiment(summary, output))
