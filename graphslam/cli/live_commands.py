"""Commands about drives that go on."""

from pathlib import Path
from typing import Annotated, Any

import typer

import graphslam
from graphslam.cli import terminal
from graphslam.cli.arguments import (
    ConfigFile,
    Force,
    FrontEnd,
    OutputFolder,
    Preset,
    Settings,
    Starts,
    check_horizon,
)
from graphslam.cli.registry import Output, command
from graphslam.cli.smoothing_options import smoothing_settings
from graphslam.core.config_io import load_config

GrowingRecording = Annotated[
    Path, typer.Argument(metavar="RECORDING", help="MCAP file that is being written.")
]
LiveHorizon = Annotated[
    float | None,
    typer.Option(
        "--horizon",
        metavar="S",
        callback=check_horizon,
        help="Poses older than this are not improved any more; default live.horizon_s.",
    ),
]
LivePriorMap = Annotated[
    Path | None,
    typer.Option(
        "--prior-map",
        metavar="DIR",
        help="Localise the robots in the map of an earlier result; --start says where in it they "
        "begin.",
    ),
]


@command("follow")
def follow(
    recording: GrowingRecording,
    output: OutputFolder,
    horizon: LiveHorizon = None,
    front_end: FrontEnd = None,
    start: Starts = None,
    prior_map: LivePriorMap = None,
    preset: Preset = None,
    config: ConfigFile = None,
    settings: Settings = None,
    force: Force = False,
) -> Output:
    """Estimate a recording while it is written.

    Keeps a result folder current: causal trajectories, landmarks, a grid map and report.html. Ends
    when the recorder closes the file, when the file has not grown for live.wait_s, or with Ctrl-C.
    """
    chosen = smoothing_settings(
        None, front_end, start, settings, prior_map=prior_map, horizon=horizon
    )
    if horizon is not None:
        chosen = ["backend.name=isam2", *chosen]
    tree = load_config(config, chosen, preset)
    told = graphslam.follow(recording, output, config=tree, force=force, announce=_say, warn=_warn)
    return Output(told, lambda: _followed(told, output))


def _say(text: str) -> None:
    if terminal.output.verbose:
        typer.echo(text, err=True)


def _warn(text: str) -> None:
    terminal.note(f"warning: {text}")


def _followed(told: dict[str, Any], output: Path) -> None:
    """A line on what was followed and how it ended, and where the page is."""
    live, counts = told["live"], told["counts"]
    typer.echo(
        f"{live['recorded_s']:.0f} s, {live['estimates']} estimates, {counts['keyframes']} "
        f"keyframes, {counts['landmarks']} landmarks; largest jump {live['largest_jump_m']:.2f} m"
    )
    for reason, count in told["dropped"].items():
        typer.echo(f"dropped: {count} x {reason}")
    for warning in told["warnings"]:
        typer.echo(f"warning: {warning}")
    typer.echo(f"recording: {live['state']}; for the best trajectories run smooth on it")
    typer.echo(f"report: {output / 'report.html'}")
