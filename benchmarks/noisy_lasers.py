"""Lasers whose ranges are noisier than those of Intel: is their noise found, and used?

    python benchmarks/noisy_lasers.py [lab|office-loop|corridor ...] [--noise M:RATIO ...]
        [--seeds 3] [--first 1] [--as-set]

Every place with every noise: white, of so many metres and of such a share of the range (the root of
the sum of their squares). Per run: the noise as measured (`logs.laser_noise`), position error in
the world and aligned (root mean square, m), NEES per degree of freedom, and the verdict.
``--as-set``: with the default noise of the settings, whatever the log's is.

exit code 1 if a run is not good, an aligned error over 0.08 m, a NEES over 5, or a noise at 2 m off
by more than a fifth.
"""

import math
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from common import parser

import graphslam
from graphslam.simulation import load_scenario, simulate

NOISE = ("0.03:0", "0.05:0", "0.1:0", "0.015:0.01", "0.015:0.02", "0.03:0.03")
ALIGNED_M, NEES, AT_M, OFF = 0.08, 5.0, 2.0, 0.2
#: a setting that differs from its default by nothing that counts: noise is not measured
AS_SET: Mapping[str, Any] = {"front_end": {"range_sigma_m": 0.0200001}}


def run(place: str, noise: str, seed: int, folder: Path, settings: Mapping[str, Any]) -> bool:
    """Print one line; whether it is as it should be."""
    sigma_m, ratio = map(float, noise.split(":"))
    scenario = load_scenario(place)
    ((name, vehicle),) = scenario.robots.items()
    laser = replace(vehicle.laser, range_sigma_m=sigma_m, range_sigma_ratio=ratio)
    log, out = folder / "log.mcap", folder / "out"
    simulate(replace(scenario, robots={name: replace(vehicle, laser=laser)}), log, seed)
    start = {"from_truth": True}
    summary = graphslam.smooth(log, output=out, force=True, start=start, **settings).summary
    final = graphslam.evaluate(out)["robots"][name]["final"]
    (found,) = summary["lasers"][name]
    verdict = summary["verdict"]["verdict"]
    print(
        f"{place:13}{noise:>12}{seed:5}"
        f"{found['range_sigma_m']:8.3f} +{100 * found['range_sigma_ratio']:4.1f} %"
        f"{final['ate_rmse_m']:8.3f}{final['ate_aligned_rmse_m']:9.3f}{final['nees_per_dof']:7.2f}"
        f"  {verdict}",
        flush=True,
    )
    found_to_true = _at(found["range_sigma_m"], found["range_sigma_ratio"]) / _at(sigma_m, ratio)
    is_right = final["ate_aligned_rmse_m"] <= ALIGNED_M and final["nees_per_dof"] <= NEES
    return verdict == "good" and is_right and abs(found_to_true - 1) <= OFF


def _at(sigma_m: float, ratio: float) -> float:
    return math.hypot(sigma_m, AT_M * ratio)


def main() -> int:
    """Print the table."""
    options = parser(__doc__)
    options.add_argument("places", nargs="*", default=["lab", "office-loop", "corridor"])
    options.add_argument("--noise", nargs="+", default=list(NOISE), metavar="M:RATIO")
    options.add_argument("--seeds", type=int, default=3)
    options.add_argument("--first", type=int, default=1)
    options.add_argument("--as-set", action="store_true")
    given = options.parse_args()
    print(
        f"{'place':13}{'noise':>12}{'seed':>5}{'measured':>17}{'error':>6}{'aligned':>9}"
        f"{'NEES':>7}  verdict"
    )
    settings = AS_SET if given.as_set else {}
    good = True
    with tempfile.TemporaryDirectory() as folder:
        for place in given.places:
            for noise in given.noise:
                for seed in range(given.first, given.first + given.seeds):
                    good &= run(place, noise, seed, Path(folder), settings)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
