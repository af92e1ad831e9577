"""Runs that are killed at random moments, and what is left of them.

- *SIGKILL and --resume*: `smooth --resume` is killed once to three times at random moments, then
  ends. Its trajectories, covariances, landmarks and graph are compared, byte by byte, with those of
  a run that nobody killed, and nothing may be left beside the result.
- *Signals*: a run without --resume gets SIGINT, SIGTERM or SIGHUP at a random moment; nothing may
  be left.
- *Two processes, one target*, started at random moments: one result, whole; the other is refused.

Logs are those of the repository, and of GRAPHSLAM_DATA if they are there.

Run: python benchmarks/kills.py [--kills 50] [--signals 30] [--pairs 20] [--log NAME]...
exit code 1 if anything differs or is left.
"""

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from common import ROOT, parser

#: files of a result that a killed run must have to the byte; times are in summary.json and report
COMPARED = ("trajectories/*", "landmarks.json", "graph.g2o", "graph_ids.csv", "*.npz")
LOGS = ("lab", "corridor", "two-robots", "robots-in-scans", "forest")
#: s: longer takes no run
LONGEST_S = 300
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Job:
    """One run of `smooth` as a process of its own group."""

    def __init__(self, log: Path, target: Path, *options: str) -> None:
        words = [sys.executable, "-m", "graphslam", "smooth", str(log), "-o", str(target)]
        self.process = subprocess.Popen(
            [*words, "--quiet", *options],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )

    def wait(self) -> tuple[int, str]:
        """Exit code and what was said on stderr."""
        said = self.process.communicate(timeout=LONGEST_S)[1]
        return self.process.returncode, said

    def end(self, which: int, after_s: float) -> bool:
        """Send a signal after a time; whether the process was still there."""
        try:
            self.process.wait(after_s)
        except subprocess.TimeoutExpired:
            self.process.send_signal(which)
            self.wait()
            return True
        self.wait()
        return False


def content(result: Path) -> dict[str, bytes]:
    """What is compared of a result."""
    found = [path for pattern in COMPARED for path in sorted(result.glob(pattern))]
    return {str(path.relative_to(result)): path.read_bytes() for path in found}


def left(folder: Path, *expected: str) -> list[str]:
    """What stands in a folder besides what should."""
    return sorted({path.name for path in folder.iterdir()} - set(expected))


class Campaign:
    """One log, and how long a run over it takes that nobody kills."""

    def __init__(self, log: Path, folder: Path, rng: random.Random) -> None:
        self.log, self.folder, self._rng = log, folder, rng
        self.failures: list[str] = []
        began = time.monotonic()
        code, said = Job(log, folder / "whole").wait()
        self.seconds = time.monotonic() - began
        if code:
            raise SystemExit(f"{log}: {said}")
        self.whole = content(folder / "whole")

    def moment(self) -> float:
        """A time within a run, s."""
        return self._rng.uniform(0.0, self.seconds)

    def killed(self) -> int:
        """Kills of one result, which is compared."""
        target, kills = self.folder / "result", 0
        for _ in range(self._rng.randint(1, 3)):
            if not Job(self.log, target, "--resume").end(signal.SIGKILL, self.moment()):
                break
            kills += 1
        if not target.exists():
            code, said = Job(self.log, target, "--resume").wait()
            self._check(code == 0, f"exit code {code}: {said}")
        if target.exists():
            found = content(target)
            same = {name for name in self.whole if found.get(name) == self.whole[name]}
            missing = {*self.whole} ^ same
            self._check(found.keys() == self.whole.keys() and not missing, f"other: {missing}")
        self._clear(target)
        return kills

    def signalled(self, which: signal.Signals) -> bool:
        """Whether a signal met a run; nothing may be left."""
        target = self.folder / "result"
        met = Job(self.log, target).end(which, self.moment())
        self._clear(target)
        return met

    def paired(self) -> None:
        """Two processes and one target."""
        target = self.folder / "result"
        first = Job(self.log, target)
        time.sleep(self._rng.choice([0.0, 0.1, self.moment()]))
        ends = [first.wait(), Job(self.log, target).wait()] if self._rng.random() < 0.2 else None
        if ends is None:
            second = Job(self.log, target)
            ends = [first.wait(), second.wait()]
        codes = sorted(code for code, _ in ends)
        refused = [said for code, said in ends if code == 1]
        self._check(codes == [0, 1], f"two processes: exit codes {codes}")
        self._check(all(said.count("\n") == 1 for said in refused), f"two processes: {refused}")
        self._check(content(target) == self.whole, "two processes: another result")
        self._clear(target)

    def _check(self, holds: bool, otherwise: str) -> None:
        if not holds:
            self.failures.append(f"{self.log.stem}: {otherwise}")
            print(self.failures[-1], flush=True)

    def _clear(self, target: Path) -> None:
        """Nothing but results may stand there; remove the one that was made."""
        more = left(self.folder, "whole", target.name)
        self._check(not more, f"left: {more}")
        for name in [*more, target.name]:
            subprocess.run(["rm", "-rf", str(self.folder / name)], check=True)


def logs(names: list[str]) -> list[Path]:
    """The logs of these names, or all that are there."""
    found = [
        ROOT / f"logs/{name}.mcap"
        for name in names or LOGS
        if (ROOT / "logs" / f"{name}.mcap").exists()
    ]
    found += [Path(name) for name in names if Path(name).suffix]
    return found


def main() -> int:
    options = parser(__doc__)
    options.add_argument("--kills", type=int, default=50)
    options.add_argument("--signals", type=int, default=30)
    options.add_argument("--pairs", type=int, default=20)
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--log", action="append", default=[], help="one of the logs, or a path")
    arguments = options.parse_args()
    rng = random.Random(arguments.seed)
    os.environ["PYTHONPATH"] = str(ROOT)
    with tempfile.TemporaryDirectory() as name:
        campaigns = []
        for k, log in enumerate(logs(arguments.log)):
            folder = Path(name) / str(k)
            folder.mkdir()
            campaigns.append(Campaign(log, folder, rng))
            print(f"{log.stem}: {campaigns[-1].seconds:.1f} s", flush=True)
        kills = results = signals = 0
        while kills < arguments.kills:
            kills += campaigns[results % len(campaigns)].killed()
            results += 1
        print(f"{kills} kills of {results} results", flush=True)
        for k in range(arguments.signals):
            signals += campaigns[k % len(campaigns)].signalled(SIGNALS[k % len(SIGNALS)])
        print(f"{signals} signals", flush=True)
        for k in range(arguments.pairs):
            campaigns[k % len(campaigns)].paired()
        failures = [failure for one in campaigns for failure in one.failures]
    print(
        "| what | tries | failed |\n|---|---|---|\n"
        f"| SIGKILL at a random moment, then --resume | {kills} kills of {results} results | "
        f"{sum('two' not in f and 'left' not in f for f in failures)} |\n"
        f"| SIGINT, SIGTERM, SIGHUP: something is left | {signals} | "
        f"{sum('left' in f for f in failures)} |\n"
        f"| two processes, one target | {arguments.pairs} | "
        f"{sum('two' in f for f in failures)} |"
    )
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
