"""What a horizon costs and what it is worth: simulated logs through horizons from none to all.

Each scenario is simulated and smoothed once; the steps that this recorded go through every horizon
and through batch, so the table is about estimation alone. Causal: how far each state is from
batch's when it is new. Final: the same at the end of the run, when the horizon has done what it
can. Both are means over all states, in metres. The milliseconds are of whole steps, reading the new
poses included, their covariances not.

Run: python benchmarks/horizon.py [lab] [forest]     BLAS on one thread: OPENBLAS_NUM_THREADS=1
"""

import math
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import parser, simulated_log, smooth_log

from graphslam.core.config import Config
from graphslam.core.records import Step, Trajectory
from graphslam.estimation.backends import BACKENDS
from graphslam.estimation.replay import Replay, replay

SCENARIOS = ("lab", "forest")
HORIZONS_S = (0.0, 1.0, 5.0, 20.0, 60.0, math.inf)


def main() -> None:
    """Print one table per scenario."""
    options = parser(__doc__)
    options.add_argument("scenarios", nargs="*", default=SCENARIOS)
    for name in options.parse_args().scenarios:
        config = Config()
        steps = recorded(name, config)
        batch = replay(steps, BACKENDS["batch"](config)).estimate
        print(f"\n{name}: {len(steps)} steps, {len(batch.landmarks)} landmarks")
        print(f"{'horizon s':>9} {'causal m':>9} {'final m':>9} {'ms p50':>8} {'p99':>8} {'max':>8}"
              f" {'finish':>8}  skipped")  # fmt: skip
        for horizon in HORIZONS_S:
            chosen = replace(config, backend=replace(config.backend, horizon_s=horizon))
            backend = BACKENDS["isam2"](chosen)
            print(row(horizon, replay(steps, backend), batch.states), dict(backend.skipped))


def recorded(name: str, config: Config) -> tuple[Step, ...]:
    """The steps of one run of full smoothing over a simulated log."""
    with tempfile.TemporaryDirectory() as folder:
        return smooth_log(simulated_log(name, 0, Path(folder)), config).steps


def row(horizon_s: float, done: Replay, batch: Mapping[str, Trajectory]) -> str:
    """One line of the table."""
    p50, p99, top = np.percentile(done.step_ms, [50, 99, 100])
    causal, final = distance(done.causal, batch), distance(done.estimate.states, batch)
    return (
        f"{horizon_s:9.0f} {causal:9.4f} {final:9.4f} {p50:8.2f} {p99:8.2f} {top:8.2f}"
        f" {done.finish_ms:8.0f} "
    )


def distance(found: Mapping[str, Trajectory], batch: Mapping[str, Trajectory]) -> float:
    """Mean distance of positions to batch's, m."""
    apart = [
        np.hypot(*(found[robot].poses - states.poses)[:, :2].T) for robot, states in batch.items()
    ]
    return float(np.concatenate(apart).mean())


if __name__ == "__main__":
    main()
