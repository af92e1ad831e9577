"""Odometry much noisier than its default noise: are maps right, and calibrations too?

    python benchmarks/slipping_wheels.py [rounds|floor ...] [--seeds 3] [--slip 0.01 0.02]

`rounds`: two rounds of the simulated office. `floor`: 500 m round a floor of 160 x 90 m, its first
corner after 160 m, then 800 m along its corridors. The wheels of the robot differ by 2 and 4 %,
its axle is 4 % longer and 8 % shorter than configured, and of every metre each wheel slips by
1 and 2 cm (`--slip`, sigma per root of a metre): headings then have 7 and 27 times the noise that
the settings state. Per run: position error in the world and aligned (root mean square, m), NEES per
degree of freedom, verdict; scale of turning, turning per metre and latency of the laser as found,
with sigma and truth. No bars.
"""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import speed_logs
from common import parser

import graphslam
from graphslam.simulation import simulate
from graphslam.simulation.scenario import Encoders, Leg, Point, Scenario

#: slip, m per root of a metre -> radii of the left and the right wheel, axle: share by which larger
ERRORS = {0.01: (0.01, -0.01, 0.04), 0.02: (0.02, -0.02, -0.08)}
#: pitch of the corridors of the large floor, m, and length of the drive along them
PITCH_M, TOUR_M = (40.0, 30.0), 800.0
FOUND = ("rotation_scale", "drift_rad_per_m", "laser_latency_s")


def floor(seed: int) -> Scenario:
    """The large floor: a round along its outermost corridors, then a drive along all of them."""
    made = speed_logs.building(TOUR_M, seed=seed, pitch_m=PITCH_M)
    ring = [speed_logs.crossing(at, PITCH_M) for at in ((4, 0), (4, 3), (0, 3), (0, 0))]
    rng = np.random.default_rng(seed)
    tour: Sequence[Point] = ((0.0, 0.0),)
    while tour[0][0] == 0.0:  # where the round ends it does not turn back
        tour = tuple(speed_logs.tour(TOUR_M, rng, PITCH_M))
    vehicle = replace(made.robots["vehicle"], drive=(Leg(through_m=(*ring, *tour)),), speed_m_s=0.8)
    return replace(made, robots={"vehicle": vehicle})


LOGS = {"rounds": lambda _seed: speed_logs.rings(2), "floor": floor}


def slipping(scenario: Scenario, slip_m: float) -> tuple[Scenario, Encoders]:
    """The scenario with such wheels."""
    vehicle = scenario.robots["vehicle"]
    left, right, axle = ERRORS.get(slip_m, (0.0, 0.0, 0.0))
    wheels = replace(
        vehicle.encoders,
        radius_error_left=left,
        radius_error_right=right,
        axle_error=axle,
        slip_m=slip_m,
    )
    return replace(scenario, robots={"vehicle": replace(vehicle, encoders=wheels)}), wheels


def truth(wheels: Encoders) -> dict[str, float]:
    """What calibration should find."""
    axle_m = wheels.axle_m * (1.0 + wheels.axle_error)
    return {
        "rotation_scale": 1.0 / (1.0 + wheels.axle_error) - 1.0,
        "drift_rad_per_m": (wheels.radius_error_right - wheels.radius_error_left) / axle_m,
        "laser_latency_s": 0.0,
    }


def row(kind: str, slip_m: float, seed: int, folder: Path) -> str:
    """One line of the table."""
    scenario, wheels = slipping(LOGS[kind](seed), slip_m)
    log, out = folder / "log.mcap", folder / "out"
    simulate(scenario, log, seed)
    summary: dict[str, Any] = dict(
        graphslam.smooth(log, output=out, force=True, start={"from_truth": True}).summary
    )
    found, true = summary["calibration"], truth(wheels)
    final = graphslam.evaluate(out)["robots"]["vehicle"]["final"]
    calibrated = (
        f"{found[f'vehicle.{name}']['value']:8.3f} ± {found[f'vehicle.{name}']['sigma']:.3f}"
        f" ({true[name]:6.3f})"
        for name in FOUND
    )
    return (
        f"{kind:8}{slip_m:6.2f}{seed:5}{final['ate_rmse_m']:8.3f}{final['ate_aligned_rmse_m']:9.3f}"
        f"{final['nees_per_dof']:7.2f}  {summary['verdict']['verdict']:9}" + "".join(calibrated)
    )


def rows(kinds: Sequence[str], slips: Sequence[float], seeds: int, folder: Path) -> Iterator[str]:
    """All lines."""
    for kind in kinds:
        for slip_m in slips:
            for seed in range(1, 1 + seeds):
                yield row(kind, slip_m, seed, folder)


def main() -> None:
    """Print the table."""
    options = parser(__doc__)
    options.add_argument("logs", nargs="*", default=list(LOGS))
    options.add_argument("--seeds", type=int, default=3)
    options.add_argument("--slip", type=float, nargs="+", default=list(ERRORS))
    given = options.parse_args()
    if unknown := set(given.logs) - LOGS.keys():
        options.error(f"no such log: {', '.join(sorted(unknown))}")
    print(
        f"{'log':8}{'slip':>6}{'seed':>5}{'error':>8}{'aligned':>9}{'NEES':>7}  {'verdict':9}"
        + "".join(f"{name:>25}" for name in FOUND)
    )
    with tempfile.TemporaryDirectory() as folder:
        for line in rows(given.logs, given.slip, given.seeds, Path(folder)):
            print(line, flush=True)


if __name__ == "__main__":
    main()
