"""Robots as they are built: cheap lasers, and wheels that turn far less than their odometry says.

    python benchmarks/usual_robots.py [lab|office-loop ...] [--lasers NAME ...] [--axle SHARE ...]
        [--slip M] [--seeds 2]

Every laser (`LASERS`: fields, rates, ranges and noise like those of the data sheets, sweeps of
their rotation) with every error of the axle, by which it is longer than odometry takes it to be: a
robot that skids as it turns is like one whose axle is half again as long. Per run: position error
in the world and aligned (root mean square, m), NEES per degree of freedom, the scale of turning as
found, with its sigma and the truth, motions that scans contradict, and the verdict.

exit code 1 if a run is not good, or an aligned error is over 0.05 m, or a scale more than 5 sigmas
off.
"""

import sys
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from common import parser

import graphslam
from graphslam.simulation import load_scenario, simulate

#: what differs from a scenario's laser
LASERS: Mapping[str, Mapping[str, Any]] = {
    "LDS-01": {
        "period_s": 0.2, "sweep_s": 0.199, "field_deg": 359.0, "step_deg": 1.0,
        "range_min_m": 0.12, "range_max_m": 3.5, "range_sigma_m": 0.015, "dropout_share": 0.02,
    },
    "RPLIDAR-A1": {
        "period_s": 0.14, "sweep_s": 0.139, "field_deg": 359.0, "step_deg": 1.0,
        "range_min_m": 0.15, "range_max_m": 12.0, "range_sigma_m": 0.03, "dropout_share": 0.05,
        "resolution_m": 0.004,
    },
    "URG-04LX": {
        "period_s": 0.1, "sweep_s": 0.066, "field_deg": 240.0, "step_deg": 0.36,
        "range_min_m": 0.02, "range_max_m": 4.0, "range_sigma_m": 0.02, "dropout_share": 0.02,
        "bias_sigma_m": 0.02,
    },
    "UTM-30LX": {
        "period_s": 0.05, "sweep_s": 0.019, "field_deg": 270.0, "step_deg": 0.25,
        "range_min_m": 0.1, "range_max_m": 30.0, "range_sigma_m": 0.01, "dropout_share": 0.005,
    },
}  # fmt: skip
#: of all of them, unless they say else
OF_ALL = {"spurious_share": 0.001, "mixed_share": 0.5, "bias_sigma_m": 0.01, "resolution_m": 0.001}
AXLES = (0.0, -0.3, 0.5)
ALIGNED_M, SIGMAS = 0.05, 5.0


def run(place: str, laser: str, axle: float, slip_m: float, seed: int, folder: Path) -> bool:
    """Print one line; whether it is as it should be."""
    scenario = load_scenario(place)
    ((name, vehicle),) = scenario.robots.items()
    vehicle = replace(
        vehicle,
        laser=replace(vehicle.laser, **{**OF_ALL, **LASERS[laser]}),
        encoders=replace(vehicle.encoders, period_s=0.05, axle_error=axle, slip_m=slip_m),
    )
    log, out = folder / "log.mcap", folder / "out"
    simulate(replace(scenario, robots={name: vehicle}), log, seed)
    summary = graphslam.smooth(log, output=out, force=True, start={"from_truth": True}).summary
    final = graphslam.evaluate(out)["robots"][name]["final"]
    found, true = summary["calibration"][f"{name}.rotation_scale"], 1.0 / (1.0 + axle) - 1.0
    verdict = summary["verdict"]["verdict"]
    print(
        f"{place:12}{laser:12}{axle:6.2f}{seed:5}{final['ate_rmse_m']:8.3f}"
        f"{final['ate_aligned_rmse_m']:9.3f}{final['nees_per_dof']:7.2f}"
        f"{found['value']:9.3f} ± {found['sigma']:.3f} ({true:6.3f})"
        f"{summary['odometry'][name]['contradicted']:8}  {verdict}",
        flush=True,
    )
    is_near = abs(found["value"] - true) <= SIGMAS * found["sigma"]
    return verdict == "good" and final["ate_aligned_rmse_m"] <= ALIGNED_M and is_near


def main() -> int:
    """Print the table."""
    options = parser(__doc__)
    options.add_argument("places", nargs="*", default=["lab", "office-loop"])
    options.add_argument("--lasers", nargs="+", default=list(LASERS), choices=list(LASERS))
    options.add_argument("--axle", type=float, nargs="+", default=list(AXLES))
    options.add_argument("--slip", type=float, default=0.006, help="m per root of a metre")
    options.add_argument("--seeds", type=int, default=2)
    given = options.parse_args()
    print(
        f"{'place':12}{'laser':12}{'axle':>6}{'seed':>5}{'error':>8}{'aligned':>9}{'NEES':>7}"
        f"{'scale of turning':>26}{'against':>8}  verdict"
    )
    good = True
    with tempfile.TemporaryDirectory() as folder:
        for place in given.places:
            for laser in given.lasers:
                for axle in given.axle:
                    for seed in range(1, 1 + given.seeds):
                        good &= run(place, laser, axle, given.slip, seed, Path(folder))
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
