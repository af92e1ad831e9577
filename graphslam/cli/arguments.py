"""The arguments and options of the commands, each defined once, and their checks (exit code 2)."""

import typing
from collections.abc import Iterable
from importlib.util import find_spec
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from graphslam.core.config import BackendConfig, FrontEndConfig
from graphslam.core.presets import PRESETS
from graphslam.core.suggestions import did_you_mean
from graphslam.importers import IMPORTERS
from graphslam.simulation import SCENARIOS

if TYPE_CHECKING:
    from graphslam.campaigns.tasks import Workers


def _choices(section: Any) -> list[str]:
    """The values that ``section.name`` may have in the configuration."""
    return list(typing.get_args(typing.get_type_hints(section)["name"]))


def _one_of(value: str | None, values: list[str]) -> str | None:
    if value is not None and value not in values:
        hint = did_you_mean(value, values)
        raise typer.BadParameter(f"{value!r} is not one of {', '.join(values)}{hint}")
    return value


def _completion(values: Iterable[str]) -> Any:
    """What a shell offers for an argument."""
    return lambda incomplete: [value for value in values if value.startswith(incomplete)]


def check_start(values: list[str] | None) -> list[str]:
    """Settings for starts: ``truth`` -> start.from_truth, ``ROBOT=x,y,phi`` -> start.poses.ROBOT.

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
    """``A:B`` in seconds; None stays None.

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


def check_viewer(value: str | None) -> str | None:
    """A kind of viewer whose files can be written here.

    Raises:
        typer.BadParameter: it is no such kind, or what it needs is not installed.
    """
    check_rerun(_one_of(value, VIEWERS) == "rrd")
    return value


def check_rerun(wanted: bool) -> bool:
    """Whether Rerun is wanted.

    Raises:
        typer.BadParameter: it is, and it is not installed.
    """
    if wanted and find_spec("rerun") is None:
        raise typer.BadParameter('needs rerun-sdk: pip install "coop-graphslam[viewer]"')
    return wanted


def check_scheduler(value: str | None) -> str | None:
    """The address of a scheduler.

    Raises:
        typer.BadParameter: what is needed to reach it is not installed.
    """
    if value is not None and find_spec("distributed") is None:
        raise typer.BadParameter('needs Dask: pip install "coop-graphslam[cluster]"')
    return value


def workers_of(jobs: int | None, scheduler: str | None, memory_mb: float | None) -> "Workers":
    """Who works, by these options.

    Raises:
        typer.BadParameter: both processes and a cluster are wanted.
    """
    from graphslam.campaigns.tasks import Workers

    if jobs is not None and scheduler is not None:
        raise typer.BadParameter("give --jobs or --scheduler, not both", param_hint="'--jobs'")
    return Workers(jobs, scheduler, memory_mb)


def check_resolution(value: float | None) -> float | None:
    """The edge of a cell in metres.

    Raises:
        typer.BadParameter: it is no length of a millimetre or more.
    """
    if value is not None and not 0.001 <= value < float("inf"):
        raise typer.BadParameter(f"{value} is not a length in metres, at least 0.001")
    return value


BACKENDS = _choices(BackendConfig)
FRONT_ENDS = _choices(FrontEndConfig)
MODES = ["replay", "associate"]
VIEWERS = ["mcap", "rrd"]
MAP_MODES = ["trinary", "scale"]


def _choice(values: list[str], text: str, *flags: str) -> Any:
    """An option that takes one of ``values``."""
    return typer.Option(
        *flags,
        metavar="|".join(values),
        callback=lambda value: _one_of(value, values),
        autocompletion=_completion(values),
        help=text,
    )


def _output(metavar: str, text: str) -> Any:
    """The option that says where the output goes."""
    return typer.Option("-o", "--output", metavar=metavar, help=text)


# ---------------------------------------------------------------- what goes in

Logs = Annotated[
    list[Path],
    typer.Argument(
        metavar="LOG",
        help="MCAP, rosbag2 (folder or .db3), ROS 1 .bag; several are one recording.",
    ),
]
LogsOrFolders = Annotated[
    list[Path],
    typer.Argument(
        metavar="LOG|FOLDER",
        help="Recordings, each a log of its own, and folders that are searched for such.",
    ),
]
Format = Annotated[
    str,
    typer.Argument(
        metavar="FORMAT",
        callback=lambda value: _one_of(value, sorted(IMPORTERS)),
        autocompletion=_completion(sorted(IMPORTERS)),
        help=f"Format of SOURCE: {', '.join(sorted(IMPORTERS))}.",
    ),
]
Source = Annotated[Path, typer.Argument(metavar="SOURCE", help="Plain, .gz, .bz2 or .xz.")]
Scenario = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO",
        autocompletion=_completion(SCENARIOS),
        help=f"A scenario file (TOML), or one of {', '.join(SCENARIOS)}.",
    ),
]
Experiment = Annotated[
    str,
    typer.Argument(
        metavar="NAME|FILE.toml",
        help="An experiment file, or ekf-versus-smoothing, filters, slip, network, thesis, rooms, "
        "three-filters or consistency.",
    ),
]
EvaluatedFolder = Annotated[Path, typer.Argument(metavar="DIR", help="Result folder of smooth.")]
ReferenceFolder = Annotated[
    Path, typer.Argument(metavar="REFERENCE", help="Result folder of the earlier visit.")
]
LaterFolder = Annotated[
    Path, typer.Argument(metavar="LATER", help="Result folder of the later visit.")
]
Span = Annotated[
    str | None,
    typer.Option(
        metavar="A:B", callback=_check_span, help="Use only scans in [A, B] s after the first."
    ),
]
TruthFiles = Annotated[
    list[str] | None,
    typer.Option(
        metavar="LOG.mcap|[ROBOT=]FILE.tum",
        help="True poses of the base; repeatable. Default: those in the logs.",
    ),
]
Relations = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Reference relations between scans: t1 t2 x y z r p y."),
]

# ---------------------------------------------------------------- settings

Backend = Annotated[
    str | None, _choice(BACKENDS, "The estimator; backend.name in the configuration.")
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
SamePlace = Annotated[
    bool,
    typer.Option(
        "--same-place",
        help="The logs are visits to one place at different times: one map, a trajectory each.",
    ),
]
PriorMap = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="Localise the log in the map of an earlier result of the same building; the start is "
        "found; known_map.directory in the configuration.",
    ),
]
Update = Annotated[
    bool,
    typer.Option(
        "--update",
        help="With --prior-map: continue that map: what is new is added, what is gone is retired.",
    ),
]
Causal = Annotated[
    bool,
    typer.Option(
        "--causal",
        help="Estimate causal trajectories of a log of scans too: each pose from the data up to "
        "its time; backend.causal in the configuration.",
    ),
]
FrontEnd = Annotated[
    str | None,
    _choice(FRONT_ENDS, "What finds landmarks in scans; front_end.name in the configuration."),
]
Starts = Annotated[
    list[str] | None,
    typer.Option(
        "--start",
        metavar="truth|ROBOT=x,y,phi",
        callback=check_start,
        help="Where a robot starts (m, m, rad), or one true pose per robot from the log; "
        "repeatable. Default: the first robot is the origin, others are estimated.",
    ),
]
Backends = Annotated[
    str,
    typer.Option(
        "--backends",
        metavar="SPEC,...",
        help="NAME[:HORIZON][+key=value...], NAME a preset or one of "
        f"{', '.join(BACKENDS)}: ekf, isam2:20, ekf+ekf.error=body, thesis.",
    ),
]
ComparisonMode = Annotated[
    str,
    _choice(
        MODES,
        "The same recorded steps for all, or each back end does its own association.",
        "--mode",
    ),
]
Preset = Annotated[
    str | None,
    _choice(
        list(PRESETS), "Settings for a purpose, under --config and --set; see graphslam config."
    ),
]
ChangeMethod = Annotated[
    str,
    _choice(
        ["evidence", "thesis"],
        "Beams of all scans as evidence on surfaces, or chapter 5 of the thesis as printed.",
        "--method",
    ),
]
ConfigFile = Annotated[Path | None, typer.Option("--config", metavar="FILE.toml", help="Settings.")]
WithMap = Annotated[
    bool,
    typer.Option("--map", help="Write a grid map, drawings and tables too; see graphslam map."),
]
Viewer = Annotated[
    str | None,
    typer.Option(
        "--viewer",
        metavar="|".join(VIEWERS),
        callback=check_viewer,
        help="Write result.mcap for Foxglove, Lichtblick and RViz too, or result.rrd for Rerun.",
    ),
]
Resolution = Annotated[
    float | None,
    typer.Option(
        "--resolution",
        metavar="M",
        callback=check_resolution,
        help="Edge of a cell of the grid map, m; default: as fine as the scans allow.",
    ),
]
MapMode = Annotated[
    str,
    _choice(
        MAP_MODES,
        "Of map_server: occupied, free and unknown, or the probability (a PNG).",
        "--mode",
    ),
]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="One setting, over the file's; repeatable."),
]
Seed = Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Seed of the random noise.")]
Runs = Annotated[int | None, typer.Option(metavar="N", min=1, help="Seeds, instead of the file's.")]
Jobs = Annotated[int | None, typer.Option(metavar="N", min=1, help="Processes; one per core.")]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        callback=check_scheduler,
        help="A Dask scheduler whose workers do it, such as tcp://head:8786, or its file.",
    ),
]
Memory = Annotated[
    float | None,
    typer.Option(
        metavar="MB",
        min=1.0,
        help="Memory of a worker, MB; its share of the machine, or what Dask's workers have.",
    ),
]
Each = Annotated[
    bool,
    typer.Option("--each", help="Each recording is a log of its own; folders are searched."),
]
Retry = Annotated[bool, typer.Option("--retry", help="Do again what failed.")]

# ---------------------------------------------------------------- what comes out

ResultFolder = Annotated[
    Path | None, _output("DIR", "The result folder to make; required without --plan.")
]
MapFolder = Annotated[
    Path | None, _output("FOLDER", "The folder for the files; default: DIR itself.")
]
OutputFolder = Annotated[Path, _output("DIR", "The folder to make.")]
OutputLog = Annotated[Path, _output("LOG.mcap", "The log.")]
OutputLogOrFolder = Annotated[
    Path,
    _output("LOG.mcap|DIR", "The log; of a scenario with two visits, the folder for both."),
]
BatchFolder = Annotated[Path, _output("DIR", "The folder of the batch, made if missing.")]
ExperimentFolder = Annotated[Path, _output("DIR", "The experiment's folder.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Plan = Annotated[
    bool, typer.Option("--plan", help="Say what would be used, as info does, and write nothing.")
]
Strict = Annotated[bool, typer.Option("--strict", help="Exit with 3 if there is any doubt.")]
Force = Annotated[bool, typer.Option("--force", help="Replace what is there.")]
Resume = Annotated[
    bool,
    typer.Option(
        "--resume",
        help="Keep every stage beside DIR until it is written; go on where a killed run was.",
    ),
]
ForceOrResume = Annotated[
    bool,
    typer.Option(
        "--force/--resume", help="Throw away what is in DIR, or run only what is missing."
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")]
Verbose = Annotated[
    bool, typer.Option("--verbose", help="Print every stage on stderr when it begins.")
]
ViewedFolder = Annotated[
    Path,
    typer.Argument(metavar="DIR", help="Folder of smooth, batch, compare, changes or experiment."),
]
AsMcap = Annotated[
    bool,
    typer.Option("--mcap", help="Write result.mcap, for Foxglove, Lichtblick and RViz, instead."),
]
AsRerun = Annotated[
    bool, typer.Option("--rrd", callback=check_rerun, help="Open it in the Rerun viewer instead.")
]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]
