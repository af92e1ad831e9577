"""What whole commands cost now and at an earlier commit, one after the other on the same machine.

    python benchmarks/speed_in_turn.py [COMMIT] [--jobs lab intel ...] [--repeats 5]

The gate of `speed.py` compares times over a yardstick with those of another day, and both the
machine and what it does to the yardstick differ from day to day. Here each repetition runs the
command of this checkout and that of the commit right after each other, in an order that alternates,
and the ratios now / then are those of the pairs: their median, and the least and largest. Both read
the same logs. By default the commit is the one at which the baseline of the gate was written.

exit code 1 if the median of a job's wall or CPU time, or its memory, is more than a fifth above
what it was then. Nothing else may run meanwhile.
"""

import io
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path

import numpy as np
from common import ROOT, Used, measured_process, parser
from speed_jobs import LOGS, OPTIONS, AbsentError, find_log

BASELINE = "benchmarks/speed_baseline.json"
JOBS = ("lab", "office-loop", "intel", "aces", "mrclam6")
#: ratio from which on a job is slower
MOST = 1.2


def baseline_commit() -> str:
    """The commit at which the baseline was written."""
    command = ["git", "-C", str(ROOT), "log", "-1", "--format=%h", "--", BASELINE]
    return subprocess.run(command, stdout=subprocess.PIPE, check=True, text=True).stdout.strip()


def checked_out(commit: str, folder: Path) -> None:
    """Write the package as it was at a commit into a folder.

    Raises:
        subprocess.CalledProcessError: there is no such commit.
    """
    command = ["git", "-C", str(ROOT), "archive", commit, "graphslam"]
    packed = subprocess.run(command, stdout=subprocess.PIPE, check=True).stdout
    with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
        archive.extractall(folder, filter="data")


def run(name: str, log: Path, packages: Mapping[str, Path], which: str, folder: Path) -> Used:
    """What a job costs with the package of this checkout (``now``) or with that of ``then``."""
    # -P: not the package in the working directory
    command = [sys.executable, "-P", "-m", "graphslam", "smooth", str(log)]
    command += ["-o", str(folder / f"{name}-{which}"), "--force", "--json", *OPTIONS.get(name, ())]
    return measured_process(command, {"PYTHONPATH": str(packages[which])})[1]


def compare(name: str, log: Path, packages: Mapping[str, Path], repeats: int, folder: Path) -> bool:
    """Print the ratios of a job; whether it is about as fast and large as it was."""
    for which in packages:  # compiles bytecode
        run(name, log, packages, which, folder)
    pairs: list[Mapping[str, Used]] = []
    for k in range(repeats):
        order = list(packages)[:: 1 if k % 2 else -1]
        pairs.append({which: run(name, log, packages, which, folder) for which in order})
    ratios = np.array([
        [getattr(pair["now"], one.name) / getattr(pair["then"], one.name) for one in fields(Used)]
        for pair in pairs
    ])  # fmt: skip
    middle = np.median(ratios, axis=0)
    told = "".join(
        f"{m:10.2f} ({low:.2f} to {high:.2f})"
        for m, low, high in zip(middle, ratios.min(axis=0), ratios.max(axis=0), strict=True)
    )
    print(f"{name:14}{told}", flush=True)
    return bool((middle <= MOST).all())


def main() -> int:
    """Print the table."""
    options = parser(__doc__)
    options.add_argument("commit", nargs="?", help="default: that of the baseline of the gate")
    options.add_argument("--jobs", nargs="+", choices=list(LOGS), default=list(JOBS))
    options.add_argument("--repeats", type=int, default=5)
    given = options.parse_args()
    holds = True
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        packages = {"now": ROOT, "then": folder / "then"}
        try:
            commit = given.commit or baseline_commit()
            checked_out(commit, packages["then"])
        except (OSError, subprocess.CalledProcessError) as error:
            print(f"the earlier package is not to be had: {error}")
            return 1
        print(f"now / {commit:8}{'wall time':>22}{'CPU time':>24}{'memory':>24}")
        for job in given.jobs:
            try:
                log = find_log(folder, job)
            except AbsentError as error:
                print(f"{job:14}{error}")
                continue
            holds &= compare(job, log, packages, given.repeats, folder)
    return 0 if holds else 1


if __name__ == "__main__":
    sys.exit(main())
