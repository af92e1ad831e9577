"""The command line: arguments, progress, exit codes, rendering. No computation."""

import gc
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import FrameType

from graphslam.cli.interrupts import is_interrupt

#: environment variables by which the libraries under numpy and scipy choose their threads
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
#: new objects between two garbage collections: a run makes millions of records and hardly any
#: reference cycle, and with the default of 700 collecting took a tenth of the time
COLLECTION_INTERVAL = 1_000_000
#: exit code of a program that a signal ended, without the signal's number; a convention of shells
BY_SIGNAL = 128


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and exit with its code; ``arguments`` None means those of the process.

    The matrices are small and gain nothing from a second thread, so libraries use one unless the
    environment says otherwise.

    Raises:
        SystemExit: 0 done, 1 an error, reported in one line, 2 wrong usage, 3 done but doubtful
            (with --strict), 128 and the number of the signal that ended it. Always where
            ``arguments`` are given; a process that runs its own ends here.
    """
    gc.set_threshold(COLLECTION_INTERVAL, *gc.get_threshold()[1:])
    for name in THREADS:
        os.environ.setdefault(name, "1")
    try:
        if arguments is None:
            _prepare_process()
        from graphslam.cli.commands import app
        from graphslam.core.allocation import keep_freed_memory
        from graphslam.core.worker import allow_fork

        keep_freed_memory()
        allow_fork()
        app(args=arguments, prog_name="graphslam")
    except SystemExit as done:
        if arguments is None and isinstance(done.code, int):
            _end_process(done.code)
        raise
    except (KeyboardInterrupt, Exception) as error:
        if not is_interrupt(error):
            raise
        if arguments is None:
            _end_process(BY_SIGNAL + signal.SIGINT)
        raise SystemExit(BY_SIGNAL + signal.SIGINT) from None


def _prepare_process() -> None:
    """Make the process' signals and streams ready for whatever there is."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        with suppress(ValueError):  # not the main thread: its signals are another's
            signal.signal(number, _leave)
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:  # closed by who started the process
            setattr(sys, name, Path(os.devnull).open(mode, encoding="utf-8"))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        # a terminal that lacks a character shows its escape
        stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]


def _leave(number: int, _frame: FrameType | None) -> None:
    """End as if by an error, so that what is unfinished is removed; a second signal ends at once.

    Raises:
        SystemExit: with the code for the signal.
    """
    signal.signal(number, signal.SIG_DFL)
    raise SystemExit(BY_SIGNAL + number)


def _end_process(code: int) -> None:
    """Leave everything else to the system: freeing a log's records one by one took 0.2 s."""
    from graphslam.core.output_folder import remove_unfinished

    remove_unfinished()
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:  # the other end of a pipe was closed: the usual way says so
            return
    os._exit(code)
