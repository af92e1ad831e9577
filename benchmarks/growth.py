"""How memory grows with the number of landmarks and with the length of the log.

- *Landmarks*: one robot goes to and fro over a field of named points, 1 to every 4 m2, and sees
  those within 4 m: a log of n landmarks has n / 2 m of path and sees each some eight times.
- *Length*: rounds of the office ring (laser), and of a field with 40 named points.

Memory is the peak of one process (and of its second one) over all of `graphslam smooth`; exponents
are those of the largest two of each row, of what is above an empty command.

Run: python benchmarks/growth.py [--landmarks 1000 2000 ...] [--rounds 1 2 4 8] [DIR]
exit code 1 if an exponent is over 1.1, or 10 000 landmarks would take over 1.5 GB.
"""

import math
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from common import parser
from speed_logs import rings, simulated

from graphslam.core.geometry import Array, between, compose
from graphslam.logs import LogWriter

S = 1_000_000_000
LANDMARKS, ROUNDS = (1000, 2000, 4000, 8000, 16_000), (1, 2, 4, 8)
#: bars: of exponents, and MB for 10 000 landmarks
STEEPEST, MOST_MB = 1.1, 1500.0
#: m2 of each landmark, m that the robot sees, m between its rows, m/s
AREA_M2, REACH_M, ROW_M, SPEED = 4.0, 4.0, 8.0, 1.0
ODOMETRY_HZ, SIGHTING_HZ = 5, 1


def field(target: Path, landmarks: int, rounds: int = 1, seed: int = 1) -> Path:
    """A robot that goes to and fro over a square field of named points, several times."""
    rng = np.random.default_rng(seed)
    side = math.sqrt(AREA_M2 * landmarks)
    points = rng.uniform(0, side, (landmarks, 2))
    rows = max(round(side / ROW_M), 1)
    corners = [
        (x, ROW_M * (k + 0.5))
        for k in range(rows)
        for x in ((0.0, side) if k % 2 == 0 else (side, 0.0))
    ]
    way = np.array([p for k in range(rounds) for p in (corners if k % 2 == 0 else corners[::-1])])
    poses = drive(way)
    odometry = np.zeros(3)
    with LogWriter(target) as log:
        for k, pose in enumerate(poses):
            stamp = (k + 1) * S // ODOMETRY_HZ
            if k:
                moved = between(poses[k - 1], pose)
                noise = rng.normal(0, [0.02, 0.005, 0.01]) * np.sqrt(np.hypot(*moved[:2]))
                odometry = compose(odometry, moved + noise)
            log.odometry("robot", stamp, odometry)
            if k % (ODOMETRY_HZ // SIGHTING_HZ) == 0:
                see(log, stamp, pose, points, rng)
    return target


def see(log: LogWriter, stamp: int, pose: Array, points: Array, rng: np.random.Generator) -> None:
    """What is seen from a pose (3,) of points (n, 2)."""
    away = points - pose[:2]
    distances = np.hypot(*away.T)
    for n in np.flatnonzero(distances < REACH_M).tolist():
        bearing = math.atan2(away[n, 1], away[n, 0]) - pose[2] + rng.normal(0, 0.01)
        z = np.array([math.remainder(bearing, 2 * math.pi), distances[n] + rng.normal(0, 0.03)])
        log.sighting("robot", stamp, z, np.diag([1e-4, 9e-4]), identity=f"p{n}")


def drive(way: Array) -> Array:
    """Poses (n, 3) along straight lines through points, turning at 0.5 rad/s on the spot."""
    step, poses = SPEED / ODOMETRY_HZ, [np.array([*way[0], 0.0])]
    for goal in way[1:]:
        here = poses[-1]
        d = goal - here[:2]
        if not d.any():
            continue
        turn = math.remainder(math.atan2(d[1], d[0]) - here[2], 2 * math.pi)
        count = math.ceil(abs(turn) / (0.5 / ODOMETRY_HZ))
        poses += [here + [0, 0, turn * (k + 1) / count] for k in range(count)]
        here = poses[-1]
        count = math.ceil(np.hypot(*d) / step)
        poses += [here + [*(d * (k + 1) / count), 0] for k in range(count)]
    return np.array(poses)


if __name__ == "__main__":
    field(Path(sys.argv[1]), int(sys.argv[2]))
