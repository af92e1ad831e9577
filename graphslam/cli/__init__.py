"""The command line: arguments, progress, exit codes, rendering. No computation."""

import gc
import os
from collections.abc import Sequence

#: what tells the libraries under numpy and scipy how many threads to use, when they are loaded
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
#: new objects before Python looks for cycles: a run makes millions of records, and hardly a cycle,
#: so that looking every 700 of them took a tenth of the time
COLLECT_EVERY = 100_000


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and leave with its exit code; the arguments are the process' own if None.

    Matrices here are small: a second thread takes a core and gains nothing, so there is one unless
    the environment says otherwise.

    Raises:
        SystemExit: always. 0 done, 1 an error that was told in one line, 2 wrong usage.
    """
    gc.set_threshold(COLLECT_EVERY, *gc.get_threshold()[1:])
    for name in THREADS:
        os.environ.setdefault(name, "1")
    from graphslam.cli.commands import app  # noqa: PLC0415
    from graphslam.core.worker import allow_fork  # noqa: PLC0415 (numpy is loaded from here on)

    allow_fork()
    app(args=arguments, prog_name="graphslam")
