"""A laser that turns ten times a second on a robot that turns at 1.5 rad/s: is its sweep noticed?

The lab with a laser once around, 10 Hz, and turns on the spot at 1.5 rad/s. Errors of the laser at
its scans, final, m, aligned as a whole, and of its heading, rad: with all beams at once; one after
the other and undistorted; one after the other and taken as if at once (`logs.undistort=false`).

Run: python benchmarks/sweep_motion.py [--seeds 20]
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import parser, smooth_log

from graphslam.core.config_io import load_config
from graphslam.evaluation.ground_truth import truth_of_logs
from graphslam.evaluation.metrics import evaluate
from graphslam.logs import open_logs
from graphslam.simulation import load_scenario, simulate
from graphslam.simulation.scenario import Scenario

TURN_DEG_S, PERIOD_S = np.degrees(1.5), 0.1


def scenario(sweep_s: float) -> Scenario:
    """The lab with a fast robot."""
    lab = load_scenario("lab")
    ((name, robot),) = lab.robots.items()
    assert robot.laser is not None
    laser = replace(robot.laser, field_deg=359.0, step_deg=1.0, period_s=PERIOD_S, sweep_s=sweep_s)
    fast = replace(robot, laser=laser, turn_rate_deg_s=TURN_DEG_S, acceleration_m_s2=1.0)
    return replace(lab, robots={name: fast})


def errors(path: Path, *settings: str) -> tuple[float, float]:
    """Of the base: aligned position error, m, and heading error, rad."""
    config = load_config(overrides=["start.from_truth=true", *settings])
    known = truth_of_logs(open_logs([path], config))
    found = evaluate(smooth_log(path, config), known.trajectories, known.landmarks)
    (robot,) = found["robots"].values()
    return robot["final"]["ate_aligned_rmse_m"], robot["final"]["heading_rmse_rad"]


def main() -> None:
    """Print the table."""
    options = parser(__doc__)
    options.add_argument("--seeds", type=int, default=20)
    seeds = range(1, options.parse_args().seeds + 1)
    found: dict[str, list[tuple[float, float]]] = {"at once": [], "undistorted": [], "as is": []}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.mcap"
        for seed in seeds:
            simulate(scenario(0.0), path, seed)
            found["at once"].append(errors(path))
            simulate(scenario(PERIOD_S), path, seed)
            found["undistorted"].append(errors(path))
            found["as is"].append(errors(path, "logs.undistort=false"))
            print(seed, {name: np.round(rows[-1], 4).tolist() for name, rows in found.items()})
    for name, rows in found.items():
        mean, worst = np.mean(rows, axis=0), np.max(rows, axis=0)
        print(
            f"{name:14}{mean[0]:9.4f} m (worst {worst[0]:.4f}){mean[1]:9.4f} rad "
            f"(worst {worst[1]:.4f})"
        )


if __name__ == "__main__":
    main()
