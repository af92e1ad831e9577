"""The command line's app, and how commands are registered: their common options, what they print.

The commands are in `commands`, `live_commands` and `campaign_commands`.
"""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import typer

import graphslam
from graphslam.cli import terminal
from graphslam.cli.arguments import Debug, Json, Quiet, Verbose
from graphslam.cli.terminal import errors_in_one_line
from graphslam.core.errors import EstimationError

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
        "graphslam smooth tuesday.mcap --prior-map monday -o tuesday",
        "graphslam smooth drive.mcap -o result --set keyframe.distance_m=0.5 --force",
    ),
    "view": ("graphslam view result",),
    "map": (
        "graphslam map result",
        "graphslam map result --resolution 0.02 -o fine",
    ),
    "follow": ("graphslam follow recording.mcap -o now",),
    "evaluate": ("graphslam evaluate result --truth robot=truth.tum",),
    "compare": (
        "graphslam compare drive.mcap --backends ekf,isam2:20,batch -o comparison",
        "graphslam compare recordings --each --backends ekf,batch -o comparisons --jobs 2",
    ),
    "changes": ("graphslam changes morning evening -o changes",),
    "batch": ("graphslam batch recordings -o results --jobs 2",),
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
            terminal.output.quiet, terminal.output.verbose = quiet, verbose
            with errors_in_one_line(debug):
                output = function(**arguments)
                if json:
                    from graphslam.results.file_formats import to_json

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
