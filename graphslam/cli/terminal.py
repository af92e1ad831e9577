"""How a command talks while it works: one line for an error, a bar where someone is watching."""

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from graphslam.core.errors import GraphSlamError

DRAWN_EVERY_S = 0.1  # smoother than the eye needs, and drawing takes no time to speak of
INTERRUPTED = 130  # what shells give a program that Ctrl-C ended


@contextmanager
def errors_in_one_line(debug: bool) -> Iterator[None]:
    """Turn whatever goes wrong into one line on stderr and exit code 1; with ``debug`` let it pass.

    Raises:
        typer.Exit: in place of the error; code 130, without a word, for Ctrl-C.
    """
    try:
        yield
    except KeyboardInterrupt:
        raise typer.Exit(INTERRUPTED) from None
    except (typer.Exit, BrokenPipeError):  # the reader of our output left: nobody to tell
        raise
    except Exception as error:
        if debug:
            raise
        typer.echo(f"graphslam: error: {_describe(error)}", err=True)
        raise typer.Exit(1) from None


def _describe(error: Exception) -> str:
    """One line that says what and where, and what to do about it."""
    if isinstance(error, GraphSlamError):
        text = str(error)
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
def progress_bar(total: int, doing: str = "smoothing") -> Iterator[Callable[[int], None]]:
    """A function that takes the number of messages done; it draws only on a terminal."""
    if not sys.stderr.isatty():
        yield lambda _done: None
        return
    columns = TextColumn(doing), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    # a thread that draws would keep work from being done `beside`
    bar = Progress(*columns, console=Console(stderr=True), transient=True, auto_refresh=False)
    drawn_s = -math.inf
    with bar as progress:
        task = progress.add_task("", total=total)

        def show(done: int) -> None:
            nonlocal drawn_s
            if time.monotonic() - drawn_s > DRAWN_EVERY_S:
                drawn_s = time.monotonic()
                progress.update(task, completed=done, refresh=True)

        yield show
