"""The commands. Each checks its arguments, calls the package, and shows what it got.

What takes long to import is imported by the command that needs it, so that help and errors in
arguments appear at once.
"""

import inspect
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer

import graphslam
from graphslam.cli import terminal
from graphslam.cli.arguments import (
    AsMcap,
    AsRerun,
    Backend,
    Backends,
    Causal,
    ChangeMethod,
    ComparisonMode,
    ConfigFile,
    Debug,
    EvaluatedFolder,
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
    MapFolder,
    MapMode,
    OutputFolder,
    OutputLog,
    OutputLogOrFolder,
    Plan,
    Preset,
    Quiet,
    ReferenceFolder,
    Relations,
    Resolution,
    ResultFolder,
    Runs,
    Scenario,
    Seed,
    Settings,
    Source,
    Span,
    Starts,
    Strict,
    TruthFiles,
    Verbose,
    ViewedFolder,
    Viewer,
    WithMap,
    span_of,
)
from graphslam.cli.stage_bar import stage_bar
from graphslam.cli.terminal import errors_in_one_line, progress_bar
from graphslam.core.config import Config
from graphslam.core.config_io import load_config, named_backend
from graphslam.core.errors import ConfigError, EstimationError, OutputError
from graphslam.logs import IMPORTERS

app = typer.Typer(
    help="Logs of wheeled robots in; trajectories, a landmark map and their covariances out.",
    context_settings={"help_option_names": ["-h", "--help"]},
    no_args_is_help=True,
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


#: command -> lines at the end of its help
EXAMPLES = {
    "info": ("graphslam info drive.mcap",),
    "import": ("graphslam import carmen intel.clf -o intel.mcap",),
    "simulate": ("graphslam simulate lab -o lab.mcap --seed 3",),
    "smooth": (
        "graphslam smooth drive.mcap -o result",
        "graphslam smooth drive.mcap -o result --backend isam2 --horizon 20",
        "graphslam smooth drive.mcap -o result --set keyframe.distance_m=0.5 --force",
    ),
    "view": ("graphslam view result",),
    "evaluate": ("graphslam evaluate result --truth robot=truth.tum",),
    "compare": ("graphslam compare drive.mcap --backends ekf,isam2:20,batch -o comparison",),
    "changes": ("graphslam changes morning evening -o changes",),
    "experiment": ("graphslam experiment ekf-versus-smoothing --runs 20 -o experiment",),
    "config": ("graphslam config > settings.toml",),
}


@dataclass(frozen=True)
class Output:
    """What a command prints: ``content`` with --json, else what ``show`` prints for people.

    ``failure``: an error to report after that, for work that was done in part; ``code``: the exit
    code where there is none.
    """

    content: Any
    show: Callable[[], None]
    failure: str = ""
    code: int = 0


def command(name: str) -> Callable[[Callable[..., Output]], None]:
    """Register a function as a command, with the options that all have and its examples."""

    def register(function: Callable[..., Output]) -> None:
        def run(
            *,
            json: Json = False,
            quiet: Quiet = False,
            verbose: Verbose = False,
            debug: Debug = False,
            **arguments: Any,
        ) -> None:
            from graphslam.results.file_formats import to_json

            terminal.output.quiet, terminal.output.verbose = quiet, verbose
            with errors_in_one_line(debug):
                output = function(**arguments)
                if json:
                    typer.echo(to_json(output.content, name), nl=False)
                elif not quiet:
                    output.show()
                if output.failure:
                    raise EstimationError(output.failure)
                if output.code:
                    raise typer.Exit(output.code)

        # typer reads the options from the signature
        common = list(inspect.signature(run).parameters.values())[:4]
        own = inspect.signature(function)
        signature = own.replace(parameters=[*own.parameters.values(), *common])
        run.__dict__["__signature__"] = signature
        run.__annotations__ = function.__annotations__ | {
            "json": Json,
            "quiet": Quiet,
            "verbose": Verbose,
            "debug": Debug,
        }
        shown = "\n".join(f"  {line}" for line in EXAMPLES.get(name, ()))
        run.__doc__ = (
            f"{inspect.getdoc(function)}\n\n\b\nExamples:\n{shown}" if shown else function.__doc__
        )
        app.command(name)(run)

    return register


@command("info")
def info(
    logs: Logs, strict: Strict = False, config: ConfigFile = None, settings: Settings = None
) -> Output:
    """Say what is in a log, what is usable, what is odd, and what mends it.

    Exit code 0: usable, 1: not usable, with --strict 3: usable, with doubts.
    """
    return _described(logs, load_config(config, settings or ()), strict)


def _described(logs: Sequence[Path], config: Config, strict: bool) -> Output:
    """What `info` and `smooth --plan` tell about logs."""
    from graphslam.cli import show
    from graphslam.logs import inspect_logs

    found = inspect_logs(logs, config)
    code = (3 if strict and found.doubtful else 0) if found.usable else 1
    return Output(found.to_dict(), lambda: show.log_info(found), code=code)


@command("import")
def import_log(
    format_name: Format, source: Source, output: OutputLog, force: Force = False
) -> Output:
    """Convert SOURCE to an MCAP log.

    True poses and landmarks, where SOURCE has any, go in too.
    """
    from graphslam.cli import show

    if os.path.lexists(output) and not force:
        raise OutputError(f"{output}: already exists; give --force to replace it")
    done = IMPORTERS[format_name](source, output)
    content = {"log": str(output), "counts": done.counts, "warnings": done.warnings}
    return Output(content, lambda: show.imported(done))


@command("simulate")
def simulate(
    scenario: Scenario, output: OutputLogOrFolder, seed: Seed = 0, force: Force = False
) -> Output:
    """Simulate a recording, with its truth.

    Equal scenarios and seeds give equal bytes.
    """
    from graphslam.cli import show

    done = graphslam.simulate(scenario, output, seed=seed, force=force)
    return Output(show.simulation(done), lambda: show.simulated(done))


@command("smooth")
def smooth(
    logs: Logs,
    output: ResultFolder = None,
    backend: Backend = None,
    horizon: Horizon = None,
    front_end: FrontEnd = None,
    start: Starts = None,
    causal: Causal = False,
    with_map: WithMap = False,
    viewer: Viewer = None,
    preset: Preset = None,
    config: ConfigFile = None,
    settings: Settings = None,
    force: Force = False,
    plan: Plan = False,
    strict: Strict = False,
) -> Output:
    """Find the best trajectories and a landmark map.

    Writes a folder with trajectories, landmarks, covariances, the factor graph and report.html.
    With --strict the exit code is 3 if the verdict is doubtful or bad; the result is written.
    """
    from graphslam.cli import show

    named = backend or named_backend(config, settings or (), preset)
    if horizon is not None and named not in (None, "isam2"):
        raise ConfigError(f"only isam2 supports --horizon, not {named}; omit it")
    if horizon is not None:
        backend = "isam2"
    options = [f"backend.name={backend}"] if backend else []
    if causal:
        options.append("backend.causal=true")
    options += [] if horizon is None else [f"backend.horizon_s={horizon}"]
    options += [f"front_end.name={front_end}"] if front_end else []
    tree = load_config(config, [*options, *(start or ()), *(settings or ())], preset)
    if plan:
        return _described(logs, tree, strict)
    if output is None:
        raise typer.BadParameter("missing: the result folder to make", param_hint="'-o'")
    with stage_bar() as progress:
        result = graphslam.smooth(logs, config=tree, output=output, force=force, progress=progress)
    if with_map:
        graphslam.make_map(output)
    if viewer:
        graphslam.write_viewer(output, viewer)
    code = 3 if strict and result.summary["verdict"]["verdict"] != "good" else 0
    return Output(result.summary, lambda: show.smoothed(result, output), code=code)


@command("map")
def map_command(
    directory: EvaluatedFolder,
    output: MapFolder = None,
    resolution: Resolution = None,
    mode: MapMode = "trinary",
    force: Force = False,
) -> Output:
    """Make maps for other tools of a result.

    A grid map for nav2's map_server (map.yaml with its image), the line map as SVG, DXF and
    GeoJSON, landmarks and trajectories as CSV.
    """
    from graphslam.cli import show

    made = graphslam.make_map(
        directory, output=output, resolution_m=resolution, mode=mode, force=force
    ).to_dict()
    return Output(made, lambda: show.mapped(made, output or directory))


@command("view")
def view(directory: ViewedFolder, mcap: AsMcap = False, rrd: AsRerun = False) -> Output:
    """Open the report of a folder in the browser, or a result in a viewer.

    --mcap only writes result.mcap and its layout, where they are missing: the viewers of such
    files open them.
    """
    from graphslam.cli.view import OPENERS

    opened = OPENERS["mcap" if mcap else "rrd" if rrd else "report"](directory)
    verb = "open it in Foxglove, Lichtblick or RViz" if mcap else "opened"
    return Output({"opened": str(opened)}, lambda: typer.echo(f"{verb}: {opened}"))


@command("evaluate")
def evaluate(
    directory: EvaluatedFolder, truth: TruthFiles = None, relations: Relations = None
) -> Output:
    """Compare a result with the truth.

    That is true poses and landmarks, or reference relations between the scans.
    """
    from graphslam.cli import show

    errors = graphslam.evaluate(directory, truth=truth or None, relations=relations)
    return Output(errors, lambda: show.evaluation(errors))


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
) -> Output:
    """Compare back ends on one log: errors, consistency, time, memory.

    Writes a folder with compare.json and report.html.
    """
    from graphslam.cli import show

    options = [f"front_end.name={front_end}"] if front_end else []
    tree = load_config(config, [*options, *(start or ()), *(settings or ())], preset)
    with progress_bar("associating") as progress:
        comparison = graphslam.compare(
            logs, [spec for spec in backends.split(",") if spec], mode=mode, truth=truth or None,
            relations=relations, config=tree, output=output, force=force, progress=progress,
            announce=show.stage,
        )  # fmt: skip
    found = comparison.summary
    failed = [f"{row['spec']}: {row['error']}" for row in found["rows"] if row["error"]]
    failure = f"{len(failed)} of {len(found['rows'])} back ends failed; " if failed else ""
    return Output(found, lambda: show.comparison(found, output), failure + "".join(failed[:1]))


@command("changes")
def changes(
    reference: ReferenceFolder,
    later: LaterFolder,
    output: OutputFolder,
    method: ChangeMethod = "evidence",
    reference_span: Span = None,
    later_span: Span = None,
    config: ConfigFile = None,
    settings: Settings = None,
    force: Force = False,
) -> Output:
    """Find what is different since the last visit, and with what probability.

    Writes changes.json, report.html, a map and an MCAP file of them; with --method thesis the maps
    of chapter 5 and its decisions. REFERENCE and LATER may be one folder with two spans.
    """
    from graphslam.cli import show

    tree, spans = (
        load_config(config, settings or ()),
        (span_of(reference_span), span_of(later_span)),
    )
    if method == "thesis":
        from graphslam.change_detection import write_thesis_changes

        found = write_thesis_changes(
            reference, later, tree.changes, *spans, directory=output, force=force
        ).to_dict()
    else:
        found = graphslam.changes_between(
            reference, later, reference_span_s=spans[0], later_span_s=spans[1], config=tree,
            output=output, force=force,
        ).to_dict()  # fmt: skip
    return Output(found, lambda: show.changes(found, output))


@command("experiment")
def experiment(
    name: Experiment,
    output: ExperimentFolder,
    runs: Runs = None,
    jobs: Jobs = None,
    force: ForceOrResume = False,
) -> Output:
    """Run a Monte Carlo experiment: many seeds, estimators and noise scales.

    Writes results.jsonl, a row per run as it ends, then summary.json, report.html and figures.
    An interrupted run is resumed when it is called again.
    """
    from graphslam.cli import show
    from graphslam.evaluation.monte_carlo_campaign import list_jobs, run_campaign
    from graphslam.evaluation.monte_carlo_definition import load_definition
    from graphslam.evaluation.monte_carlo_folder import save_summary
    from graphslam.evaluation.monte_carlo_summary import summarise

    definition = load_definition(name)
    definition = replace(definition, runs=runs or definition.runs)
    total = len(list_jobs(definition))
    with progress_bar("running") as progress:
        rows = run_campaign(
            definition, output, jobs=jobs, force=force, progress=lambda n: progress(n, total)
        )
    summary = summarise(definition, rows)
    save_summary(summary, output)
    return Output(summary, lambda: show.experiment(summary, output))


@command("config")
def config_command(preset: Preset = None) -> Output:
    """Print all settings with their defaults, units and meaning, as TOML, and the presets.

    With --preset only what that preset changes. Either can be saved and given to --config.
    """
    from graphslam.core.config_text import documented_settings, settings_tree
    from graphslam.core.presets import preset_settings, preset_text

    text = documented_settings() if preset is None else preset_text(preset)
    content = settings_tree() if preset is None else preset_settings(preset)
    return Output(content, lambda: typer.echo(text, nl=False))
