"""Hours of five robots with odometry at 100 Hz: time, memory, and what a message costs.

Five robots drive rounds in a hall of 40 named points, for two hours by default: 3.6 million
readings of odometry, a look around every second (the points within 6 m, and a robot within 4 m),
starts told. The log is made here; it is not part of what is measured.

Run: python benchmarks/long_run.py [DIR] [--minutes 120]
exit code 1 if it takes over 20 minutes of CPU time or 2 GB (of two hours; in proportion else).
"""

import math
import sys
import tempfile
from pathlib import Path

import numpy as np
from common import measured_command, parser

from graphslam.core.geometry import Array
from graphslam.logs import LogWriter

S = 1_000_000_000
ROBOTS, ODOMETRY_HZ, LANDMARKS, SIDE_M = 5, 100, 40, 40.0
REACH_M, ROBOT_REACH_M = 6.0, 4.0
#: s and MB for two hours
MOST_S, MOST_MB, HOURS = 1200.0, 2000.0, 2.0


def true_poses(robot: int, seconds: Array) -> Array:
    """Poses (n, 3) on a closed curve round the hall, another one for each robot, at 1 m/s or so."""
    a = seconds / 22 + 2 * np.pi * robot / ROBOTS
    r = 12 + 4 * np.sin((robot + 2) * a / 3)
    d_r = 4 * (robot + 2) / 3 * np.cos((robot + 2) * a / 3)
    x, y = SIDE_M / 2 + r * np.cos(a), SIDE_M / 2 + r * np.sin(a)
    heading = np.arctan2(d_r * np.sin(a) + r * np.cos(a), d_r * np.cos(a) - r * np.sin(a))
    return np.column_stack([x, y, heading])


def odometry(poses: Array, rng: np.random.Generator) -> Array:
    """The poses (n, 3) by wheels, from the origin: 2 % of scale, and noise of 1 cm / sqrt(m)."""
    d = np.diff(poses, axis=0)
    turn = np.arctan2(np.sin(d[:, 2]), np.cos(d[:, 2]))
    along = 1.02 * np.hypot(d[:, 0], d[:, 1])
    along += rng.normal(0, 0.01, len(d)) * np.sqrt(along)
    turn = turn + rng.normal(0, 0.01, len(d)) * np.sqrt(along.clip(0))
    heading = np.concatenate([[0.0], np.cumsum(turn)])
    middle = heading[:-1] + turn / 2
    steps = np.column_stack([along * np.cos(middle), along * np.sin(middle)])
    return np.column_stack([np.vstack([[0, 0], np.cumsum(steps, axis=0)]), heading])


def record(target: Path, seconds: int, seed: int = 1) -> Path:
    """The log."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, SIDE_M, (LANDMARKS, 2))
    times = np.arange(seconds * ODOMETRY_HZ + 1) / ODOMETRY_HZ
    truth = [true_poses(robot, times) for robot in range(ROBOTS)]
    wheels = [odometry(poses, rng) for poses in truth]
    with LogWriter(target) as log:
        for k in range(len(times)):
            stamp = S + k * (S // ODOMETRY_HZ)
            for robot in range(ROBOTS):
                log.odometry(f"robot{robot}", stamp, wheels[robot][k])
            if k % ODOMETRY_HZ == 0:
                here = np.array([poses[k] for poses in truth])
                for robot in range(ROBOTS):
                    look(log, stamp, robot, here, points, rng)
    return target


def look(
    log: LogWriter, stamp: int, robot: int, here: Array, points: Array, rng: np.random.Generator
) -> None:
    """What a robot sees of points (n, 2) and of the robots' poses (r, 3)."""
    cov = np.diag([1e-4, 9e-4])
    for targets, reach, name in ((points, REACH_M, "p"), (here[:, :2], ROBOT_REACH_M, "robot")):
        away = targets - here[robot, :2]
        distances = np.hypot(*away.T)
        for n in np.flatnonzero((distances < reach) & (distances > 0)).tolist():
            bearing = math.atan2(away[n, 1], away[n, 0]) - here[robot, 2] + rng.normal(0, 0.01)
            z = np.array([math.remainder(bearing, 2 * math.pi), distances[n] + rng.normal(0, 0.03)])
            what = {"identity" if name == "p" else "seen_robot": f"{name}{n}"}
            log.sighting(f"robot{robot}", stamp, z, cov, **what)


def main() -> int:
    options = parser(__doc__)
    options.add_argument("folder", nargs="?", type=Path, help="where the log is made and kept")
    options.add_argument("--minutes", type=int, default=120)
    arguments = options.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = arguments.folder or Path(name)
        folder.mkdir(exist_ok=True)
        log = folder / f"long-{arguments.minutes}.mcap"
        if not log.exists():
            record(log, 60 * arguments.minutes)
        starts = [
            f"start.poses.robot{k}={true_poses(k, np.zeros(1))[0].tolist()}" for k in range(ROBOTS)
        ]
        given = [word for start in starts for word in ("--set", start)]
        out = str(folder / "out")
        summary, used = measured_command("smooth", str(log), "-o", out, "--force", *given)
    counts, share = summary["counts"], arguments.minutes / 60 / HOURS
    print(
        "| messages | states | observations | CPU, s | wall, s | memory, MB | B per message |\n"
        f"|---|---|---|---|---|---|---|\n| {counts['messages']} | {counts['keyframes']} | "
        f"{counts['observations']} | {used.cpu_s:.0f} | {used.wall_s:.0f} | {used.peak_mb:.0f} | "
        f"{1e6 * used.peak_mb / counts['messages']:.0f} |"
    )
    print(summary["stages"])
    return 1 if used.cpu_s > share * MOST_S or used.peak_mb > MOST_MB else 0


if __name__ == "__main__":
    sys.exit(main())
