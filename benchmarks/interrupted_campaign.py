"""Does an experiment that is interrupted at random and resumed end with the same rows?

    python benchmarks/interrupted_campaign.py [--seeds 200] [--times 5] [--jobs 2]

200 seeds of an experiment on the bench run once without interruption, by one process. Then they run
again by two, and are interrupted five times at random moments, by Ctrl-C or by a kill without a
word, and resumed. Exit code 1 unless results.jsonl has the same rows in the same order, apart from
the time that runs took.
"""

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from common import parser

DEFINITION = """
runs = {seeds}
noise_scales = [1.0]
settings = ["robust.kernel=none"]
[variants]
ekf = ["backend.name=ekf"]
batch = ["backend.name=batch"]
[bench]
meet_every = 5
points_m = [[2.0, 1.0], [3.0, -1.0], [6.0, 2.0]]
walls_m = [[[0.0, 3.0], [9.0, 3.0]]]
sigma = {{ start_m = 0.1, start_deg = 3.0, along_m = 0.05, across_m = 0.02, turn_deg = 2.0, \
bearing_deg = 2.0, range_m = 0.1, line_m = 0.05, line_deg = 2.0 }}
[bench.robots.a]
start_m = [0.0, 0.0]
path = [{{ steps = 20, forward_m = 0.3, turn_deg = 5.0 }}]
[bench.robots.b]
start_m = [0.0, 1.0]
path = [{{ steps = 20, forward_m = 0.3 }}]
"""


def start(definition: Path, folder: Path, jobs: int) -> "subprocess.Popen[bytes]":
    command = [sys.executable, "-m", "graphslam", "experiment", str(definition), "-o", str(folder)]
    # background jobs of a shell ignore Ctrl-C, and so would what they start
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    process = subprocess.Popen([*command, "--jobs", str(jobs), "--quiet"], start_new_session=True)
    signal.signal(signal.SIGINT, before)
    return process


def rows(folder: Path) -> list[dict[str, object]]:
    """The rows without their time; incomplete lines are left out."""
    path = folder / "results.jsonl"
    text = path.read_text() if path.exists() else ""
    whole = text[: text.rfind("\n") + 1].splitlines()
    return [{**json.loads(line), "seconds": None} for line in whole]


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--seeds", type=int, default=200)
    options.add_argument("--times", type=int, default=5)
    options.add_argument("--jobs", type=int, default=2)
    arguments = options.parse_args()
    chance = random.Random(7)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        definition = folder / "definition.toml"
        definition.write_text(DEFINITION.format(seeds=arguments.seeds))
        if start(definition, folder / "once", 1).wait():
            sys.exit("the run without interruption failed")
        wanted = rows(folder / "once")
        print(f"without interruption: {len(wanted)} rows")
        for number in range(arguments.times):
            process = start(definition, folder / "often", arguments.jobs)
            before = len(rows(folder / "often"))
            # between a few rows and all that one interruption should see
            more = chance.randint(1, 2 * len(wanted) // (arguments.times + 2))
            while process.poll() is None and len(rows(folder / "often")) < before + more:
                time.sleep(0.01)
            time.sleep(chance.uniform(0.0, 0.05))
            how = signal.SIGINT if number % 2 else signal.SIGKILL
            os.killpg(process.pid, how) if how == signal.SIGINT else process.kill()
            code = process.wait()
            there = len(rows(folder / "often"))
            print(f"interrupted by {how.name}, exit code {code}: {there} rows")
        if start(definition, folder / "often", arguments.jobs).wait():
            sys.exit("the last run failed")
        same = rows(folder / "often") == wanted
    print("the same rows in the same order" if same else "OTHER ROWS")
    sys.exit(0 if same else 1)


if __name__ == "__main__":
    main()
