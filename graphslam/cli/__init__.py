"""The command line: arguments, progress, exit codes, rendering. No computation."""

from collections.abc import Sequence

from graphslam.cli.commands import app


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and leave with its exit code; the arguments are the process' own if None.

    Raises:
        SystemExit: always. 0 done, 1 an error that was told in one line, 2 wrong usage.
    """
    app(args=arguments, prog_name="graphslam")
