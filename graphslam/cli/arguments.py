"""The arguments and options that commands share, and what makes them wrong (exit code 2)."""

import typing
from math import isfinite
from pathlib import Path
from typing import Annotated, Any

import typer

from graphslam.core.config import BackendConfig, FrontEndConfig
from graphslam.logs import IMPORTERS
from graphslam.simulation import SCENARIOS


def _choices(section: Any) -> list[str]:
    """The values that ``section.name`` may have in the configuration."""
    return list(typing.get_args(typing.get_type_hints(section)["name"]))


def _one_of(value: str | None, known: list[str]) -> str | None:
    if value is not None and value not in known:
        raise typer.BadParameter(f"{value!r} is not one of {', '.join(known)}")
    return value


def check_start(values: list[str] | None) -> list[str]:
    """Starts as settings: ``truth`` -> start.from_truth, ``ROBOT=x,y,phi`` -> start.poses.ROBOT.

    Raises:
        typer.BadParameter: a value is neither.
    """
    settings = []
    for value in values or ():
        if value == "truth":
            settings.append("start.from_truth=true")
            continue
        robot, _, pose = value.partition("=")
        try:
            numbers = [float(number) for number in pose.split(",")]
        except ValueError:
            numbers = []
        if not robot or len(numbers) != 3 or not all(map(isfinite, numbers)):
            raise typer.BadParameter(f"{value!r} is neither `truth` nor ROBOT=x,y,phi (m, m, rad)")
        settings.append(f"start.poses.{robot}={numbers}")
    return settings


def span_of(value: str | None) -> tuple[float, float] | None:
    """``A:B`` as seconds; None as it is.

    Raises:
        typer.BadParameter: it is not two numbers in order.
    """
    if value is None:
        return None
    begin, _, end = value.partition(":")
    try:
        span = float(begin), float(end)
    except ValueError:
        span = (0.0, -1.0)
    if not 0 <= span[0] < span[1]:
        raise typer.BadParameter(f"{value!r} is not A:B, seconds since the first scan")
    return span


def _check_span(value: str | None) -> str | None:
    span_of(value)
    return value


def check_horizon(value: float | None) -> float | None:
    """A horizon in seconds, or infinity.

    Raises:
        typer.BadParameter: it is negative or no number.
    """
    if value is not None and not value >= 0:
        raise typer.BadParameter(f"{value} is not a time in seconds from 0 to inf")
    return value


BACKENDS = _choices(BackendConfig)
FRONT_ENDS = _choices(FrontEndConfig)
MODES = ["replay", "associate"]

Logs = Annotated[
    list[Path], typer.Argument(metavar="LOG", help="MCAP files; several are one recording.")
]
Backend = Annotated[
    str | None,
    typer.Option(
        metavar="|".join(BACKENDS),
        callback=lambda value: _one_of(value, BACKENDS),
        help="The estimator; backend.name in the configuration.",
    ),
]
Horizon = Annotated[
    float | None,
    typer.Option(
        "--horizon",
        metavar="S",
        callback=check_horizon,
        help="How long isam2 revises a past pose: seconds, 0 = a filter, inf = for ever (the "
        "default); backend.horizon_s in the configuration.",
    ),
]
FrontEnd = Annotated[
    str | None,
    typer.Option(
        metavar="|".join(FRONT_ENDS),
        callback=lambda value: _one_of(value, FRONT_ENDS),
        help="What finds landmarks in scans; front_end.name in the configuration.",
    ),
]
Starts = Annotated[
    list[str] | None,
    typer.Option(
        "--start",
        metavar="truth|ROBOT=x,y,phi",
        callback=check_start,
        help="Where a robot starts (m, m, rad), or one true pose per robot from the log; "
        "repeatable. Default: the first robot is the origin, others as their sightings have it.",
    ),
]
ConfigFile = Annotated[Path | None, typer.Option("--config", metavar="FILE.toml", help="Settings.")]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="One setting, over the file's; repeatable."),
]
Format = Annotated[
    str,
    typer.Argument(
        metavar="FORMAT",
        callback=lambda value: _one_of(value, sorted(IMPORTERS)),
        help=f"Format of SOURCE: {', '.join(sorted(IMPORTERS))}.",
    ),
]
Scenario = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO", help=f"A scenario file (TOML), or one of {', '.join(SCENARIOS)}."
    ),
]
Backends = Annotated[
    str,
    typer.Option(
        "--backends",
        metavar="SPEC,...",
        help="NAME[:HORIZON][+key=value...], NAME one of "
        f"{', '.join(BACKENDS)}: ekf, isam2:20, ekf+ekf.error=body.",
    ),
]
ComparisonMode = Annotated[
    str,
    typer.Option(
        "--mode",
        metavar="|".join(MODES),
        callback=lambda value: _one_of(value, MODES),
        help="The same recorded steps for all, or each associates for itself.",
    ),
]
Seed = Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Other noise.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Force = Annotated[bool, typer.Option("--force", help="Replace what is there.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]
ReferenceSpan = Annotated[
    str | None,
    typer.Option(metavar="A:B", callback=_check_span, help="Only scans of these seconds of it."),
]
LaterSpan = Annotated[
    str | None,
    typer.Option(metavar="A:B", callback=_check_span, help="Only scans of these seconds of it."),
]
