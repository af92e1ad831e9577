"""The commands. Each checks, calls the package, and shows what it got.

What takes long to import is imported by the command that needs it, so that help and complaints
about arguments come at once.
"""

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from graphslam import __version__
from graphslam.cli import show
from graphslam.cli.arguments import (
    Backend,
    ConfigFile,
    Debug,
    Force,
    Format,
    FrontEnd,
    Json,
    Logs,
    Scenario,
    Seed,
    Settings,
    Starts,
)
from graphslam.cli.terminal import errors_in_one_line, progress_bar
from graphslam.config import Config, load_config
from graphslam.errors import OutputError
from graphslam.logs import IMPORTERS, KnownTruth, LogSet, inspect_logs, open_logs
from graphslam.records import Result
from graphslam.results import check_target, load, save, to_json

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
        from graphslam.simulate import load_scenario, simulate

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
        options += [f"front_end.name={front_end}"] if front_end else []
        tree = load_config(config, [*options, *(start or ()), *(settings or ())])
        check_target(output, force=force)
        result = _smooth(open_logs(logs, tree), tree, output, force)
        if json:
            typer.echo(to_json(result.summary, "summary"), nl=False)
        else:
            show.smoothed(result, output)


def _smooth(log: LogSet, tree: Config, output: Path, force: bool) -> Result:
    """Run the pipeline and write the folder."""
    from graphslam.report import render
    from graphslam.slam import smooth

    with progress_bar(sum(topic.count for topic in log.topics)) as progress:
        result = smooth(log, tree, progress)
    quality = _quality(result, log, tree)
    save(result, tree, output, force=force, report=lambda found: render(found, quality, tree))
    return result


def _quality(result: Result, log: LogSet, tree: Config) -> dict[str, Any] | None:
    """What the truth in the logs says about the result; None without truth."""
    from graphslam.truth import truth_of_logs

    known = truth_of_logs(log, tree)
    if not known:
        return None
    from graphslam.evaluate import evaluate

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
        from graphslam.evaluate import evaluate, read_relations
        from graphslam.truth import truth_of_files, truth_of_run

        saved = load(directory)
        reference = read_relations(relations) if relations else None
        if truth:
            known = truth_of_files(truth, list(saved.robots))
        else:
            known = KnownTruth({}, ()) if reference else truth_of_run(saved)
        found = evaluate(saved, known.trajectories, known.landmarks, reference)
        if json:
            typer.echo(to_json(found, "evaluation"), nl=False)
        else:
            show.evaluation(found)
