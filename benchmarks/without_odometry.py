"""Scenarios with and without their odometry: how much does scan matching in its place cost?

Starts are drawn from their prior (1 cm, 0.01 rad), so that covariances can be judged. Final
trajectories: error aligned as a whole and not, m; NEES per degree of freedom; share of the ellipses
that 95 % should be in.

Run: python benchmarks/without_odometry.py [SCENARIO[:LASER] ...] [--seeds 6]
Of several lasers the named one alone is used, for example two-lasers:rear.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import parser, simulated_log, smooth_log

from graphslam.core.config import Config
from graphslam.core.config_io import load_config
from graphslam.core.records import OdometryPose, Scan
from graphslam.evaluation.ground_truth import truth_of_logs
from graphslam.evaluation.metrics import evaluate
from graphslam.evaluation.monte_carlo_log_run import drawn_starts
from graphslam.logs import open_logs

KEYS = ("ate_aligned_rmse_m", "ate_rmse_m", "nees_per_dof", "coverage")


def settings(path: Path, laser: str, *, odometry: bool) -> Config:
    """Settings that leave out the odometry of a log, or lasers of other names."""
    log = open_logs([path], load_config())
    (robot,) = log.robots
    left_out = {Scan} if odometry else {Scan, OdometryPose}
    kept = {t.name: t.robot for t in log.topics if t.robot and t.record not in left_out}
    kept |= {name: robot for name in log.sensors(robot) if name.endswith(laser)}
    config = load_config()
    return replace(config, logs=replace(config.logs, topics=kept))


def errors(path: Path, config: Config, seed: int) -> list[float]:
    """`KEYS` of the robot of a log."""
    log = open_logs([path], config)
    start = drawn_starts(log, config.start, seed)
    result = smooth_log(path, replace(config, start=start))
    known = truth_of_logs(log)
    found = evaluate(result, known.trajectories, known.landmarks)
    (robot,) = found["robots"].values()
    return [robot["final"][key] for key in KEYS]


def main() -> None:
    """Print the table."""
    options = parser(__doc__)
    options.add_argument("scenarios", nargs="*", default=["office-loop"])
    options.add_argument("--seeds", type=int, default=6)
    arguments = options.parse_args()
    print(f"{'':34}{'aligned':>9}{'ATE':>9}{'NEES':>8}{'inside':>8}")
    with tempfile.TemporaryDirectory() as folder:
        for scenario in arguments.scenarios:
            rows: dict[str, list[list[float]]] = {"with": [], "without": []}
            for seed in range(1, arguments.seeds + 1):
                name, _, laser = scenario.partition(":")
                path = simulated_log(name, seed, Path(folder))
                for row, found in rows.items():
                    config = settings(path, laser, odometry=row == "with")
                    found.append(errors(path, config, seed))
                path.unlink()
            for name, found in rows.items():
                mean = np.mean(found, axis=0)
                print(
                    f"{scenario + ', ' + name + ' odometry':34}{mean[0]:9.4f}{mean[1]:9.3f}"
                    f"{mean[2]:8.2f}{mean[3]:8.3f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
