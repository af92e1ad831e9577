"""The commands. Each checks its arguments, calls the package, and shows what it got.

What takes long to import is imported by the command that needs it, so that help and errors in
arguments appear at once.
"""

import os
from collections.abc import Sequence
from pathlib import Path

import typer

import graphslam
from graphslam.cli.arguments import (
    AsMcap,
    AsRerun,
    Backend,
    Causal,
    ChangeMethod,
    ConfigFile,
    EvaluatedFolder,
    Force,
    Format,
    FrontEnd,
    Horizon,
    LaterFolder,
    Logs,
    MapFolder,
    MapMode,
    OutputFolder,
    OutputLog,
    OutputLogOrFolder,
    Plan,
    Preset,
    PriorMap,
    ReferenceFolder,
    Relations,
    Resolution,
    ResultFolder,
    Resume,
    SamePlace,
    Scenario,
    Seed,
    Settings,
    Source,
    Span,
    Starts,
    Strict,
    TruthFiles,
    Update,
    ViewedFolder,
    Viewer,
    WithMap,
    span_of,
)
from graphslam.cli.registry import Output, app, command
from graphslam.cli.smoothing_options import smoothing_settings
from graphslam.cli.stage_bar import stage_bar
from graphslam.core.config import Config
from graphslam.core.config_io import load_config, named_backend
from graphslam.core.errors import ConfigError, OutputError
from graphslam.importers import IMPORTERS


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
    sessions = config.logs.same_place
    return Output(found.to_dict(), lambda: show.log_info(found, same_place=sessions), code=code)


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
    if os.path.realpath(output) == os.path.realpath(source):
        raise OutputError(f"{output}: is what is to be imported; choose another name")
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
    same_place: SamePlace = False,
    prior_map: PriorMap = None,
    update: Update = False,
    with_map: WithMap = False,
    viewer: Viewer = None,
    preset: Preset = None,
    config: ConfigFile = None,
    settings: Settings = None,
    force: Force = False,
    resume: Resume = False,
    plan: Plan = False,
    strict: Strict = False,
) -> Output:
    """Find the best trajectories and a landmark map.

    Writes a folder with trajectories, landmarks, covariances, the factor graph and report.html.
    With --strict the exit code is 3 if the verdict is doubtful or bad; the result is written.
    """
    named = backend or named_backend(config, settings or (), preset)
    if horizon is not None and named not in (None, "isam2"):
        raise ConfigError(f"only isam2 supports --horizon, not {named}; omit it")
    if horizon is not None:
        backend = "isam2"
    chosen = smoothing_settings(
        backend, front_end, start, settings,
        causal=causal, same_place=same_place, prior_map=prior_map, update=update, horizon=horizon,
    )  # fmt: skip
    tree = load_config(config, chosen, preset)
    if plan:
        return _described(logs, tree, strict)
    if output is None:
        raise typer.BadParameter("missing: the result folder to make", param_hint="'-o'")
    with stage_bar() as progress:
        result = graphslam.smooth(
            logs, config=tree, output=output, force=force, resume=resume, progress=progress
        )
    if with_map:
        graphslam.make_map(output)
    if viewer:
        graphslam.write_viewer(output, viewer)

    def shown() -> None:
        from graphslam.cli import show  # after the work, which begins the sooner; not with --json

        show.smoothed(result, output)

    code = 3 if strict and result.summary["verdict"]["verdict"] != "good" else 0
    return Output(result.summary, shown, code=code)


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


# the rest registers itself, after these
from graphslam.cli import campaign_commands, live_commands  # noqa: E402

__all__ = ["app", "campaign_commands", "live_commands"]
