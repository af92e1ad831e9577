"""Scans per second of the ray casting on one core, and what a whole simulation takes.

361 beams over 180°, 32 m, in a world of 200 walls each 1 to 6 m long in 40 x 40 m, from random
poses; beside it every scenario of the package. CPU time, best of five.

Run: OPENBLAS_NUM_THREADS=1 python benchmarks/simulate_speed.py
"""

import tempfile
import time
from pathlib import Path

import numpy as np
from common import best_cpu_s, parser

from graphslam.simulation import SCENARIOS, load_scenario, simulate
from graphslam.simulation.raycast import BeamFan, cast_beams
from graphslam.simulation.world import Shapes

SCANS, WALLS, SIDE_M = 2000, 200, 40.0
FAN = BeamFan(-np.pi / 2, np.pi / 360, 361)


def world(rng: np.random.Generator) -> Shapes:
    center = rng.uniform(0, SIDE_M, (WALLS, 2))
    angle, half = rng.uniform(-np.pi, np.pi, WALLS), rng.uniform(0.5, 3.0, WALLS)
    along = np.column_stack([np.cos(angle), np.sin(angle)]) * half[:, None]
    return Shapes(np.stack([center - along, center + along], axis=1), np.zeros((0, 3)))


def main() -> None:
    rng = np.random.default_rng(1)
    shapes = world(rng)
    poses = rng.uniform([0, 0, -np.pi], [SIDE_M, SIDE_M, np.pi], (SCANS, 3))
    parser(__doc__).parse_args()
    seconds = best_cpu_s(lambda: cast_beams(poses, FAN, shapes, 32.0))
    print(f"ray casting: {FAN.count} beams, {WALLS} walls: {SCANS / seconds:.0f} scans/s")
    with tempfile.TemporaryDirectory() as folder:
        for name in SCENARIOS:
            target = Path(folder) / (name if load_scenario(name).later else f"{name}.mcap")
            start = time.process_time()
            done = simulate(load_scenario(name), target)
            seconds = time.process_time() - start
            scans = sum(robot.scans for r in done.recordings for robot in r.robots.values())
            print(f"{name:14} {seconds:6.2f} s {scans:6} scans")


if __name__ == "__main__":
    main()
