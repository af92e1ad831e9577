"""The command line: arguments, progress, exit codes, rendering. No computation."""

import gc
import os
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
        SystemExit: always. 0 done, 1 an error, reported in one line, 2 wrong usage.
    """
    gc.set_threshold(COLLECTION_INTERVAL, *gc.get_threshold()[1:])
    for name in THREADS:
        os.environ.setdefault(name, "1")
    from graphslam.cli.commands import app
    from graphslam.core.worker import allow_fork

    allow_fork()
    app(args=arguments, prog_name="graphslam")
