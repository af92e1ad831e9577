"""Intel and ACES whole, with default settings: how good, how fast, how large.

Each log is imported, smoothed and evaluated by the commands that a user types, each in a process
of its own. The errors are those of Kümmerle et al. 2009 over hand-made relations between scans:
over all, over pairs at most 60 s apart (local), and farther apart (loops). Speed is the length of
the log over the wall time of the whole `smooth` command, report and all; memory its peak. "Inside"
are the shares of relations inside their stated 95 %, with the reference's own error.

Run: python benchmarks/real_logs.py [intel] [aces] [--figures DIR]
Exit code 1 if a bar is not held.
"""

import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import real_logs_figures
from common import (
    FREIBURG,
    FREIBURG_LOGS,
    Used,
    command,
    import_freiburg,
    measured_command,
    parser,
)


@dataclass(frozen=True)
class Bar:
    """A value must be at most ``limit``, or at least it."""

    name: str
    limit: float
    at_least: bool = False

    def held(self, value: float) -> bool:
        """Whether ``value`` is on the right side of the limit."""
        return value >= self.limit if self.at_least else value <= self.limit


EVERY = (
    Bar("wall s", 60.0),
    Bar("x real time", 20.0, at_least=True),
    Bar("peak memory MB", 1000.0),
    Bar("unmatched", 0),
    Bar("inside 95 %, at least", 0.85, at_least=True),
    Bar("inside 95 %, at most", 0.99),
)
#: what each log is held to; the errors are below those published for Cartographer
BARS = {
    "intel": (
        Bar("all, mean m", 0.020),
        Bar("all, mean deg", 0.7),
        Bar("local, mean m", 0.0185),
        Bar("loops, mean m", 0.030),
        *EVERY,
    ),
    "aces": (Bar("all, mean m", 0.040), Bar("loops, mean m", 0.060), *EVERY),
}


@dataclass(frozen=True)
class Run:
    """What one log gave."""

    relations: dict[str, Any]
    causal: dict[str, Any]
    summary: dict[str, Any]
    used: Used

    @property
    def times_real_time(self) -> float:
        """Length of the log over the wall time of the command."""
        stages = self.summary["stages"]
        return float(self.summary["real_time_factor"] * stages["all"] / self.used.wall_s)

    def values(self) -> dict[str, float]:
        """What the bars are about, by their names."""
        groups = self.relations
        return {
            "all, mean m": groups["all"]["trans_mean_m"],
            "all, mean deg": groups["all"]["rot_mean_deg"],
            "loops, mean m": groups["loops"]["trans_mean_m"],
            "wall s": self.used.wall_s,
            "local, mean m": groups["local"]["trans_mean_m"],
            "x real time": self.times_real_time,
            "peak memory MB": self.used.peak_mb,
            "unmatched": groups["all"]["unmatched"],
            "inside 95 %, at least": groups["all"]["trans_inside"],
            "inside 95 %, at most": groups["all"]["trans_inside"],
        }


def run(name: str, folder: Path) -> Run:
    """The measured command, and the same again with causal trajectories, which take longer."""
    log, relations = import_freiburg(name, folder), str(FREIBURG / f"{name}.relations")
    target = folder / name
    _, used = measured_command("smooth", str(log), "-o", str(target))
    found = command("evaluate", str(target), "--relations", relations)["relations"]
    command("smooth", str(log), "--causal", "-o", str(causal_folder(target)))
    causal = command("evaluate", str(causal_folder(target)), "--relations", relations)["relations"]
    summary = json.loads((target / "summary.json").read_text(encoding="utf-8"))
    return Run(found, causal["causal"], summary, used)


def causal_folder(target: Path) -> Path:
    """Where the result with causal trajectories is, beside the one without."""
    return target.with_name(f"{target.name}-causal")


def print_errors(name: str, done: Run) -> None:
    counts = done.summary["counts"]
    print(
        f"\n{name}: {counts['scans']} scans, {counts['keyframes']} keyframes,"
        f" {counts['landmarks']} landmarks, {counts['loop_closures']} loop closures"
    )
    heads = ("mean m", "median m", "std m", "mean °", "std °", "inside m", "inside °")
    print(f"{'':18}{'n':>6}{''.join(f'{head:>10}' for head in heads)}")
    for label, groups in (("final", done.relations), ("causal", done.causal)):
        for group in ("all", "local", "loops"):
            g = groups[group]
            numbers = [
                g[k] for k in ("trans_mean_m", "trans_median_m", "trans_std_m", "rot_mean_deg",
                               "rot_std_deg", "trans_inside", "rot_inside")
            ]  # fmt: skip
            row = "".join(f"{'-' if value is None else f'{value:.4f}':>10}" for value in numbers)
            print(f"{label:10}{group:8}{g['n']:6}{row}")
    print(
        f"{done.times_real_time:.1f} x real time ({done.used.wall_s:.1f} s wall),"
        f" peak {done.used.peak_mb:.0f} MB"
    )


def print_bars(name: str, done: Run) -> bool:
    """Whether all hold."""
    values = done.values()
    print(f"\n{name + ': bar':30}{'limit':>10}{'found':>10}")
    for bar in BARS[name]:
        value = values[bar.name]
        sign = ">=" if bar.at_least else "<="
        print(
            f"  {bar.name:26}{sign} {bar.limit:<9g}{value:10.4g}"
            f"  {'held' if bar.held(value) else 'NOT HELD'}"
        )
    return all(bar.held(values[bar.name]) for bar in BARS[name])


def main() -> int:
    """Print errors and bars."""
    options = parser(__doc__)
    options.add_argument("logs", nargs="*", default=list(FREIBURG_LOGS))
    options.add_argument("--figures", type=Path, help="folder for the figures of docs/real-logs.md")
    arguments = options.parse_args()
    for name in arguments.logs:
        if name not in FREIBURG_LOGS or not (FREIBURG / f"{name}.clf.bz2").exists():
            print(f"real_logs: error: {FREIBURG}/{name}.clf.bz2: no such log; set GRAPHSLAM_DATA")
            return 2
    good = True
    with tempfile.TemporaryDirectory() as folder:
        for name in arguments.logs:
            done = run(name, Path(folder))
            print_errors(name, done)
            good &= print_bars(name, done)
            if arguments.figures:
                relations = FREIBURG / f"{name}.relations"
                result = causal_folder(Path(folder, name))
                print(real_logs_figures.draw(name, result, relations, arguments.figures))
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
