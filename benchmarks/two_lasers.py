"""Are two lasers of half a turn, front and rear, as good as the better of them, and found?

`two-lasers`: the office floor; the log's mounts are 2 cm and 1 degree off, the rear laser scans at
another rate and stamps 20 ms late. The same log with each laser alone, and the drive with one laser
of a whole turn in the place of the front one. Errors of the base, final, m, aligned as a whole;
mounts: what is found less what is true. Exit code 1 if a bar is not held.

Run: python benchmarks/two_lasers.py [--seeds 20]
"""

import sys
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common import parser, smooth_log

from graphslam.core.config_io import load_config
from graphslam.core.geometry import Array, wrap
from graphslam.evaluation.ground_truth import truth_of_logs
from graphslam.evaluation.metrics import evaluate
from graphslam.logs import open_logs
from graphslam.simulation import load_scenario, simulate
from graphslam.simulation.laser import laser_mount
from graphslam.simulation.scenario import Laser, Scenario

ROBOT = "vehicle"
#: two lasers against the better one; m and degrees of any mount
MOST_RATIO, MOST_M, MOST_DEG = 1.02, 0.005, 0.2


def whole_turn(scenario: Scenario) -> Scenario:
    """The same drive with one laser that sees all around."""
    robot = scenario.robots[ROBOT]
    laser = replace(robot.lasers["front"], field_deg=359.0)
    return replace(scenario, robots={ROBOT: replace(robot, laser=laser, lasers={})})


def run(path: Path, laser: str = "") -> tuple[float, Mapping[str, Any]]:
    """Aligned position error, m, and summary; of one of the lasers alone, if it is named."""
    names = ("odom", "truth", f"scan_{laser}")
    topics = ", ".join(f'"/{ROBOT}/{name}" = "{ROBOT}"' for name in names)
    settings = [f"logs.topics={{{topics}}}"] if laser else []
    config = load_config(overrides=["start.from_truth=true", *settings])
    known = truth_of_logs(open_logs([path], config))
    result = smooth_log(path, config)
    found = evaluate(result, known.trajectories, known.landmarks)
    return found["robots"][ROBOT]["final"]["ate_aligned_rmse_m"], result.summary


def mount_error(summary: Mapping[str, Any], lasers: Mapping[str, Laser]) -> dict[str, Array]:
    """Laser -> x, y of its mount, m, its direction, rad, and its latency, s, less the true ones."""
    errors = {}
    for entry in summary["lasers"][ROBOT]:
        laser = lasers[entry["topic"].removeprefix(f"/{ROBOT}/scan_")]
        off = np.array(entry["mount"]) - laser_mount(laser)
        off[2] = wrap(off[2])
        errors[entry["topic"]] = np.append(off, entry["latency_s"] - laser.latency_s)
    return errors


def main() -> int:
    """Print the table; the exit code."""
    options = parser(__doc__)
    options.add_argument("--seeds", type=int, default=20)
    seeds = range(options.parse_args().seeds)
    scenario = load_scenario("two-lasers")
    lasers = scenario.robots[ROBOT].lasers
    found: dict[str, list[float]] = {"both": [], **{name: [] for name in lasers}, "whole": []}
    mounts: list[Array] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.mcap"
        for seed in seeds:
            simulate(scenario, path, seed)
            for name in ("both", *lasers):
                error, summary = run(path, "" if name == "both" else name)
                found[name].append(error)
                if name == "both":
                    mounts += mount_error(summary, lasers).values()
            simulate(whole_turn(scenario), path, seed)
            found["whole"].append(run(path)[0])
            worst = np.abs(mounts[-len(lasers) :]).max(axis=0)
            row = " ".join(f"{name} {1e3 * errors[-1]:.2f} mm" for name, errors in found.items())
            print(
                f"{seed:3} {row}  mounts {1e3 * worst[:2].max():.1f} mm "
                f"{np.degrees(worst[2]):.3f} deg {1e3 * worst[3]:.1f} ms", flush=True,
            )  # fmt: skip
    means = {name: float(np.mean(errors)) for name, errors in found.items()}
    print("mean", " ".join(f"{name} {1e3 * mean:.2f} mm" for name, mean in means.items()))
    worst = np.abs(mounts).max(axis=0)
    ratio = means["both"] / min(means[name] for name in lasers)
    at_most = worst[:2].max(), np.degrees(worst[2])
    print(
        f"both / better: {ratio:.3f} (at most {MOST_RATIO}); largest errors of a mount "
        f"{1e3 * at_most[0]:.1f} mm (5) {at_most[1]:.3f} deg ({MOST_DEG}), latency "
        f"{1e3 * worst[3]:.1f} ms"
    )
    return int(ratio > MOST_RATIO or at_most[0] > MOST_M or at_most[1] > MOST_DEG)


if __name__ == "__main__":
    sys.exit(main())
