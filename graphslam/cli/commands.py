"""The commands. Each checks, calls the package, and shows what it got.

What takes long to import is imported by the command that needs it, so that help and complaints
about arguments come at once.
"""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from graphslam import __version__
from graphslam.cli import show
from graphslam.cli.arguments import (
    Backend,
    Backends,
    ComparisonMode,
    ConfigFile,
    Debug,
    Force,
    Format,
    FrontEnd,
    Horizon,
    Json,
    LaterSpan,
    Logs,
    ReferenceSpan,
    Scenario,
    Seed,
    Settings,
    Starts,
    span_of,
)
from graphslam.cli.terminal import errors_in_one_line, progress_bar
from graphslam.core.config import Config
from graphslam.core.config_io import load_config
from graphslam.core.errors import ConfigError, EstimationError, OutputError
from graphslam.core.records import Result, TrueLandmark, Truth
from graphslam.core.worker import Future
from graphslam.logs import IMPORTERS, GroundTruth, inspect_logs, open_logs
from graphslam.results.file_formats import to_json
from graphslam.results.folder import check_target, load, save

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
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def graphslam(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Logs of wheeled robots in; trajectories, a landmark map and their covariances out."""


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
        found = inspect_logs(logs, load_config(config, settings or ()))
        if json:
            typer.echo(to_json(found.to_dict(), "info"), nl=False)
        else:
            show.log_info(found)


@app.command("import")
def import_command(
    format_name: Format,
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="Plain, .gz, .bz2 or .xz.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="LOG.mcap", help="The log.")],
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
        if json:
            found = {"log": str(output), "counts": done.counts, "warnings": done.warnings}
            typer.echo(to_json(found, "import"), nl=False)
        else:
            show.imported(done)


@app.command("simulate")
def simulate_command(
    scenario: Scenario,
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            metavar="LOG.mcap|DIR",
            help="The log; of a scenario with two visits, the folder for both.",
        ),
    ],
    seed: Seed = 0,
    json: Json = False,
    force: Force = False,
    debug: Debug = False,
) -> None:
    """Simulate a recording, with its truth.

    Equal scenarios and seeds give equal bytes.
    """
    with errors_in_one_line(debug):
        from graphslam.simulation import load_scenario, simulate

        wanted = load_scenario(scenario)
        if os.path.lexists(output) and not force:
            raise OutputError(f"{output}: already exists; give --force to replace it")
        done = simulate(wanted, output, seed)
        if json:
            typer.echo(to_json(show.simulation(done), "simulation"), nl=False)
        else:
            show.simulated(done)


@app.command("smooth")
def smooth_command(
    logs: Logs,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="The result folder to make.")
    ],
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
        check_target(output, force=force)
        result = _smooth(logs, tree, output, force)
        if json:
            typer.echo(to_json(result.summary, "summary"), nl=False)
        else:
            show.smoothed(result, output)


def _smooth(logs: Sequence[Path], tree: Config, output: Path, force: bool) -> Result:
    """Run the pipeline and write the folder."""
    opening = Future(lambda: open_logs(logs, tree))
    from graphslam.evaluation.ground_truth import truth_of_logs
    from graphslam.results.report import render
    from graphslam.slam.smooth import smooth

    log = opening.result()
    truth = Future(lambda: truth_of_logs(log, tree))
    with progress_bar(log.count((Truth, TrueLandmark))) as progress:
        result = smooth(log, tree, progress)
    quality = _quality(result, truth.result())
    report = Future(lambda: render(result, quality))
    save(result, output, force=force, report=lambda _: report.result())
    return result


def _quality(result: Result, known: GroundTruth) -> dict[str, Any] | None:
    """What the truth in the logs says about the result; None without truth."""
    if not known:
        return None
    from graphslam.evaluation.metrics import evaluate

    try:
        return evaluate(result, known.trajectories, known.landmarks)
    except OutputError as error:
        # the truth is of another time: no reason to lose the run, but one to say so
        result.summary["warnings"].append(f"not evaluated: {error}")
        return None


@app.command("evaluate")
def evaluate_command(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Result folder of smooth.")],
    truth: Annotated[
        list[str] | None,
        typer.Option(
            metavar="LOG.mcap|[ROBOT=]FILE.tum",
            help="True poses of the base; repeatable. Default: those in the logs of the run.",
        ),
    ] = None,
    relations: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Reference relations between scans: t1 t2 x y z r p y."),
    ] = None,
    json: Json = False,
    debug: Debug = False,
) -> None:
    """Compare a result with the truth.

    That is true poses and landmarks, or reference relations between the scans.
    """
    with errors_in_one_line(debug):
        from graphslam.evaluation.ground_truth import truth_of_files, truth_of_run
        from graphslam.evaluation.metrics import evaluate
        from graphslam.evaluation.relation_metrics import read_relations

        saved = load(directory)
        for warning in saved.config.warnings:
            typer.echo(f"warning: {directory / 'config.toml'}: {warning}", err=True)
        reference = read_relations(relations) if relations else None
        if truth:
            known = truth_of_files(truth, list(saved.robots))
        else:
            known = GroundTruth({}, ()) if reference else truth_of_run(saved)
        found = evaluate(saved, known.trajectories, known.landmarks, reference)
        if json:
            typer.echo(to_json(found, "evaluation"), nl=False)
        else:
            show.evaluation(found)


@app.command("compare")
def compare_command(
    logs: Logs,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="The folder to make.")
    ],
    backends: Backends = "ekf,isam2:0,isam2,batch",
    mode: ComparisonMode = "replay",
    truth: Annotated[
        list[str] | None,
        typer.Option(
            metavar="LOG.mcap|[ROBOT=]FILE.tum",
            help="True poses of the base; repeatable. Default: those in the logs.",
        ),
    ] = None,
    relations: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Reference relations between scans: t1 t2 x y z r p y."),
    ] = None,
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
        from graphslam.evaluation.compare_folder import is_comparison, save_comparison
        from graphslam.evaluation.compare_rows import compare
        from graphslam.evaluation.compare_variants import variants
        from graphslam.evaluation.ground_truth import truth_of_files, truth_of_logs
        from graphslam.evaluation.relation_metrics import read_relations

        options = [f"front_end.name={front_end}"] if front_end else []
        options += [*(start or ()), *(settings or ())]
        tree = load_config(config, options)
        rows = variants([spec for spec in backends.split(",") if spec], config, options)
        check_target(output, force=force, replaceable=is_comparison)
        log = open_logs(logs, tree)
        known = truth_of_files(truth, log.robots) if truth else truth_of_logs(log, tree)
        reference = read_relations(relations) if relations else None
        with progress_bar(log.count((Truth, TrueLandmark)), "associating") as progress:
            found = compare(
                log, tree, rows, mode, truth=known, relations=reference, progress=progress,
                say=show.stage,
            )  # fmt: skip
        save_comparison(found, tree, output, force=force)
        if json:
            typer.echo(to_json(found.found, "comparison"), nl=False)
        else:
            show.comparison(found.found, output)
        failed = [f"{row['spec']}: {row['error']}" for row in found.found["rows"] if row["error"]]
        if failed:
            raise EstimationError(f"{len(failed)} of {len(rows)} back ends failed; {failed[0]}")


@app.command("changes")
def changes_command(
    reference: Annotated[
        Path, typer.Argument(metavar="REFERENCE", help="Result folder of the earlier visit.")
    ],
    later: Annotated[
        Path, typer.Argument(metavar="LATER", help="Result folder of the later visit.")
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="The folder to make.")
    ],
    reference_span: ReferenceSpan = None,
    later_span: LaterSpan = None,
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
        from graphslam.change_detection import changes_between, render_changes, save_changes
        from graphslam.change_detection.folder import check_changes_target

        tree = load_config(config, settings or ())
        check_changes_target(output, force=force)
        spans = (span_of(reference_span), span_of(later_span))
        found = changes_between(reference, later, tree.changes, *spans)
        found = replace(found, warnings=(*tree.warnings, *found.warnings))
        names = (reference.name, later.name)
        save_changes(
            found,
            output,
            force=force,
            report=lambda done: render_changes(done, tree.changes, names),
        )
        if json:
            typer.echo(to_json(found.to_dict(), "changes"), nl=False)
        else:
            show.changes(found.to_dict(), output)


@app.command("experiment")
def experiment_command(
    experiment: Annotated[
        str,
        typer.Argument(
            metavar="NAME|FILE.toml",
            help="An experiment file, or ekf-versus-smoothing, filters or thesis.",
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="The experiment's folder.")
    ],
    runs: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Seeds, instead of the file's.")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Processes; one per core.")
    ] = None,
    json: Json = False,
    force: Annotated[
        bool,
        typer.Option(
            "--force/--resume", help="Throw away what is in DIR, or run only what is missing."
        ),
    ] = False,
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

        wanted = load_definition(experiment)
        wanted = replace(wanted, runs=runs or wanted.runs)
        with progress_bar(len(jobs_of(wanted)), "running") as progress:
            rows = run_campaign(wanted, output, jobs=jobs, force=force, progress=progress)
        found = summarise(wanted, rows)
        save_summary(found, output)
        if json:
            typer.echo(to_json(found, "experiment"), nl=False)
        else:
            show.experiment(found, output)
