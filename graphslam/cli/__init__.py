"""The command line: arguments, progress, exit codes, rendering. No computation."""

import gc
from collections.abc import Sequence

from graphslam.cli.commands import app

#: new objects before Python looks for cycles: a run makes millions of records, and hardly a cycle,
#: so that looking every 700 of them took a tenth of the time
COLLECT_EVERY = 100_000


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and leave with its exit code; the arguments are the process' own if None.

    Raises:
        SystemExit: always. 0 done, 1 an error that was told in one line, 2 wrong usage.
    """
    gc.set_threshold(COLLECT_EVERY, *gc.get_threshold()[1:])
    app(args=arguments, prog_name="graphslam")
