"""What the benchmarks share: data paths, commands with their times and memory, logs, poses.

Logs that the repository does not hold are taken from GRAPHSLAM_DATA (default: ../shared/data
beside the repository).
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam

from graphslam.core.config import Config
from graphslam.core.config_io import load_config
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.records import Result
from graphslam.importers import pose_stamp_ns
from graphslam.logs import open_logs
from graphslam.simulation import load_scenario, simulate
from graphslam.slam.smooth import smooth

ROOT = Path(__file__).parents[1]
DATA = Path(os.environ.get("GRAPHSLAM_DATA", ROOT / "../shared/data"))
#: the Freiburg benchmark: logs NAME.clf.bz2, hand-made relations NAME.relations
FREIBURG = DATA / "freiburg"
FREIBURG_LOGS = ("intel", "aces")
FIGURES = ROOT / "docs/figures"
#: every robot begins at its true pose
START_FROM_TRUTH = "start.from_truth=true"


def parser(description: str | None) -> argparse.ArgumentParser:
    """A parser whose help is a script's docstring as it stands."""
    return argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def pooled_bounds(effective_poses: Sequence[float]) -> tuple[float, float]:
    """The 99 % bounds of the mean NEES per degree of freedom of independent runs.

    ``effective_poses``: of each run, see `nees_statistics`; they are much the same, so that the
    mean is about a chi-square of all their degrees of freedom.
    """
    dof = 3.0 * sum(effective_poses)
    low, high = (chi2_quantile((0.005, 0.995), dof) / dof).tolist()
    return low, high


@dataclass(frozen=True)
class Used:
    """What a command used: wall time and CPU time, s, and its peak memory, MB."""

    wall_s: float
    cpu_s: float
    peak_mb: float


def measured_process(
    arguments: Sequence[str], environment: Mapping[str, str] | None = None
) -> tuple[bytes, Used]:
    """What a command prints, and what it and the processes that it waited for used.

    ``environment``: variables beside those of this process.

    Raises:
        subprocess.CalledProcessError: its exit code is not 0.
    """
    with tempfile.NamedTemporaryFile("r") as report:
        launcher = [sys.executable, "-S", str(ROOT / "benchmarks/launch.py"), report.name]
        variables = {**os.environ, **(environment or {})}
        done = subprocess.run(
            [*launcher, *arguments], stdout=subprocess.PIPE, check=True, env=variables
        )
        wall_s, cpu_s, maxrss = map(float, report.read().split())
    return done.stdout, Used(wall_s, cpu_s, megabytes(maxrss))


def measured_command(*arguments: str) -> tuple[dict[str, Any], Used]:
    """What a graphslam command in a process of its own prints with --json, and what it used."""
    printed, used = measured_process([sys.executable, "-m", "graphslam", *arguments, "--json"])
    found: dict[str, Any] = json.loads(printed)
    return found, used


def command(*arguments: str) -> dict[str, Any]:
    """What a graphslam command prints with --json."""
    return measured_command(*arguments)[0]


def megabytes(maxrss: float) -> float:
    """A peak memory that the system reports, in its unit, in MB."""
    return maxrss / (1e6 if sys.platform == "darwin" else 1e3)


def peak_mb() -> float:
    """Peak memory of this process so far."""
    return megabytes(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


def best_cpu_s(function: Callable[[], object], repeats: int = 5) -> float:
    """CPU time of a call, s: the best of some."""
    took = []
    for _ in range(repeats):
        began = time.process_time()
        function()
        took.append(time.process_time() - began)
    return min(took)


def import_freiburg(name: str, folder: Path) -> Path:
    """The log of a Freiburg data set as MCAP; imported once per folder."""
    log = folder / f"{name}.mcap"
    if not log.exists():
        command("import", "carmen", str(FREIBURG / f"{name}.clf.bz2"), "-o", str(log))
    return log


def simulated_log(scenario: str, seed: int, folder: Path) -> Path:
    """The log of a scenario; simulated once per folder."""
    log = folder / f"{scenario}-{seed}.mcap"
    if not log.exists():
        simulate(load_scenario(scenario), log, seed)
    return log


def smooth_log(log: Path, config: Config | None = None) -> Result:
    """A log smooth_log, by default settings if none are given."""
    config = load_config() if config is None else config
    return smooth(open_logs([log], config), config)


def pose_graph_values(result: Result) -> gtsam.Values:
    """Every pose of an imported pose graph under its number in the file."""
    values = gtsam.Values()
    for robot in result.robots.values():
        for stamp, pose in zip(robot.final.stamps_ns, robot.final.poses, strict=True):
            number = int(stamp) // pose_stamp_ns(0) - 1
            if stamp == pose_stamp_ns(number):
                values.insert(number, gtsam.Pose2(*pose))
    return values
