"""Output of a running command: one line for an error, a progress bar on a terminal."""

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import typer

from graphslam.cli.interrupts import is_interrupt
from graphslam.core.errors import GraphSlamError

DRAW_INTERVAL_S = 0.1  # smooth to the eye, and drawing takes no noticeable time
INTERRUPTED = 130  # the exit code of a program that Ctrl-C ended, by convention of shells


@dataclass
class Verbosity:
    """What the options --quiet and --verbose ask for."""

    quiet: bool = False
    verbose: bool = False


output = Verbosity()


@contextmanager
def errors_in_one_line(debug: bool) -> Iterator[None]:
    """Turn any error into one line on stderr and exit code 1; with ``debug`` let it pass.

    Raises:
        typer.Exit: in place of the error; code 130 and no output for Ctrl-C.
        typer.BadParameter: the command line is wrong, which typer says, with code 2.
    """
    try:
        yield
    except KeyboardInterrupt:
        raise typer.Exit(INTERRUPTED) from None
    except (typer.Exit, typer.BadParameter, BrokenPipeError):  # the output is no longer read
        raise
    except Exception as error:
        if is_interrupt(error):
            raise typer.Exit(INTERRUPTED) from None
        if debug:
            raise
        typer.echo(f"graphslam: error: {_describe(error)}", err=True)
        raise typer.Exit(1) from None


def _describe(error: Exception) -> str:
    """One line that says what and where, and what to do about it."""
    if isinstance(error, GraphSlamError):
        text = str(error)
    elif isinstance(error, MemoryError):
        text = "there is not enough memory; cut the log into pieces, or see the settings limits.*"
    elif isinstance(error, OSError) and error.strerror:
        where = f"{error.filename}: " if error.filename else ""
        text = f"{where}{error.strerror}"
    else:
        text = (
            f"unexpected {type(error).__name__}: {error}; "
            "this is a defect of graphslam: please report it with what --debug prints"
        )
    return " ".join(text.splitlines())


@contextmanager
def progress_bar(doing: str) -> Iterator[Callable[[int, int], None]]:
    """A function of how much is done, of how much in all; it draws only on a terminal."""
    if output.quiet or not sys.stderr.isatty():
        yield lambda _done, _total: None
        return
    from rich import progress as bars
    from rich.console import Console

    columns = (
        bars.TextColumn(doing),
        bars.BarColumn(),
        bars.MofNCompleteColumn(),
        bars.TimeRemainingColumn(),
    )
    # without a drawing thread: a process with threads does not fork, see `core.worker`
    bar = bars.Progress(*columns, console=Console(stderr=True), transient=True, auto_refresh=False)
    drawn_s = -math.inf
    with bar as progress:
        task = progress.add_task("", total=None)

        def show(done: int, total: int) -> None:
            nonlocal drawn_s
            if time.monotonic() - drawn_s > DRAW_INTERVAL_S:
                drawn_s = time.monotonic()
                progress.update(task, completed=done, total=total, refresh=True)

        yield show


def note(text: str) -> None:
    """A line on stderr about what happens, unless nothing is to be said."""
    if not output.quiet:
        typer.echo(f"graphslam: {text}", err=True)


def detail(text: str) -> None:
    """A line on stderr that only --verbose wants."""
    if output.verbose:
        note(text)
