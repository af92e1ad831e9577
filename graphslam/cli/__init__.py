"""The command line: arguments, progress, exit codes, rendering. No computation."""

import gc
import os
import sys
from collections.abc import Sequence

#: environment variables by which the libraries under numpy and scipy choose their threads
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
#: new objects between two garbage collections: a run makes millions of records and hardly any
#: reference cycle, and with the default of 700 collecting took a tenth of the time
COLLECTION_INTERVAL = 100_000


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and exit with its code; ``arguments`` None means those of the process.

    The matrices are small and gain nothing from a second thread, so libraries use one unless the
    environment says otherwise.

    Raises:
        SystemExit: 0 done, 1 an error, reported in one line, 2 wrong usage. Always where
            ``arguments`` are given; a process that runs its own ends here.
    """
    gc.set_threshold(COLLECTION_INTERVAL, *gc.get_threshold()[1:])
    for name in THREADS:
        os.environ.setdefault(name, "1")
    from graphslam.cli.commands import app
    from graphslam.core.worker import allow_fork

    allow_fork()
    try:
        app(args=arguments, prog_name="graphslam")
    except SystemExit as done:
        if arguments is None and isinstance(done.code, int):
            _end_process(done.code)
        raise


def _end_process(code: int) -> None:
    """Leave everything else to the system: freeing a log's records one by one took 0.2 s."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:  # the other end of a pipe was closed: the usual way says so
            return
    os._exit(code)
