"""Five robots on sixteen rounds among posts, their starts told: does drift tear the map?

The robots of `speed.py`, whose odometry drifts by a radian on the way; they see posts, which have
names, and each other. Errors are in the world, not aligned, final poses, root mean square; NEES is
per degree of freedom. Printed is the worst robot of each log; exit code 1 if one is more than
0.1 m off, ten times what such logs end with.

Run: python benchmarks/drifting_odometry.py [--seeds N] [--first SEED]
"""

import sys
import tempfile
from pathlib import Path

from common import parser
from speed_logs import robots

import graphslam
from graphslam.simulation import simulate

ROUNDS, TORN_M = 16, 0.1


def main() -> int:
    """Print a line for each log; 1 if a map is torn."""
    options = parser(__doc__)
    options.add_argument("--seeds", type=int, default=4)
    options.add_argument("--first", type=int, default=0)
    chosen = options.parse_args()
    scenario, torn = robots(ROUNDS), 0
    with tempfile.TemporaryDirectory() as name:
        for seed in range(chosen.first, chosen.first + chosen.seeds):
            log = Path(name) / f"{seed}.mcap"
            simulate(scenario, log, seed)
            result = graphslam.smooth(log, **{"start.from_truth": True})
            found = [one["final"] for one in graphslam.evaluate(result)["robots"].values()]
            worst = max(one["ate_rmse_m"] for one in found)
            torn += worst > TORN_M
            print(
                f"seed {seed}: error {worst:.4f} m, NEES/dof "
                f"{max(one['nees_per_dof'] for one in found):.2f}, verdict "
                f"{result.summary['verdict']['verdict']}",
                flush=True,
            )
    return int(torn > 0)


if __name__ == "__main__":
    sys.exit(main())
