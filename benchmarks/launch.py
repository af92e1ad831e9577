"""Runs a command and writes what it used to a file: wall s, CPU s, peak memory (system's unit).

Linux counts the memory of whoever starts a process into that process' peak. So a benchmark, which
has libraries and results in memory, starts this small program, which starts the command.

Run: python -S launch.py FILE COMMAND...      exit code of the command
"""

import os
import sys
import time


def main() -> int:
    """Start the command and wait for it and what it waits for."""
    path, *command = sys.argv[1:]
    began = time.perf_counter()
    child = os.posix_spawnp(command[0], command, os.environ)
    _, status, used = os.wait4(child, 0)
    wall_s = time.perf_counter() - began
    with open(path, "w") as file:  # noqa: PTH123 - pathlib takes memory
        file.write(f"{wall_s} {used.ru_utime + used.ru_stime} {used.ru_maxrss}")
    return os.waitstatus_to_exitcode(status)


if __name__ == "__main__":
    sys.exit(main())
