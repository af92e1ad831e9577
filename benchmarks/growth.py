"""How memory grows with the number of landmarks and with the length of the log.

- *Landmarks*: one robot goes to and fro over a field of named points, 1 to every 4 m2, and sees
  those within 4 m: a log of n landmarks has n / 2 m of path and sees each some eight times.
- *Without names*: the same points, to half of that number, whose sightings are associated.
- *Length*: rounds of the office ring (laser), and of a field with 40 named points.

Memory is the peak of one process (and of its second one) over all of `graphslam smooth`; exponents
are those of the largest two of each row, of what is above an empty command.

Run: python benchmarks/growth.py [--landmarks 1000 2000 ...] [--rounds 1 2 4 8] [DIR]
exit code 1 if an exponent is over 1.1, or 10 000 landmarks would take over 1.5 GB.
"""

import math
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from common import measured_command, parser
from speed_logs import rings, simulated

from graphslam.core.geometry import Array, between, compose
from graphslam.logs import LogWriter

S = 1_000_000_000
LANDMARKS, ROUNDS = (1000, 2000, 4000, 8000, 16_000), (1, 2, 4, 8)
#: of the landmarks, that are tried without names, too
UNNAMED_SHARE = 0.5
#: bars: of exponents, and MB for 10 000 landmarks
STEEPEST, MOST_MB = 1.1, 1500.0
#: m2 of each landmark, m that the robot sees, m between its rows, m/s
AREA_M2, REACH_M, ROW_M, SPEED = 4.0, 4.0, 8.0, 1.0
ODOMETRY_HZ, SIGHTING_HZ = 5, 1


def field(
    target: Path, landmarks: int, rounds: int = 1, seed: int = 1, *, named: bool = True
) -> Path:
    """A robot that goes to and fro over a square field of points, several times."""
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
                see(log, stamp, pose, points, rng, named)
    return target


def see(
    log: LogWriter,
    stamp: int,
    pose: Array,
    points: Array,
    rng: np.random.Generator,
    named: bool,
) -> None:
    """What is seen from a pose (3,) of points (n, 2)."""
    away = points - pose[:2]
    distances = np.hypot(*away.T)
    for n in np.flatnonzero(distances < REACH_M).tolist():
        bearing = math.atan2(away[n, 1], away[n, 0]) - pose[2] + rng.normal(0, 0.01)
        z = np.array([math.remainder(bearing, 2 * math.pi), distances[n] + rng.normal(0, 0.03)])
        identity = f"p{n}" if named else None
        log.sighting("robot", stamp, z, np.diag([1e-4, 9e-4]), identity=identity)


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
        poses += [here + np.array([0, 0, turn * (k + 1) / count]) for k in range(count)]
        here = poses[-1]
        count = math.ceil(np.hypot(*d) / step)
        poses += [here + np.append(d * (k + 1) / count, 0) for k in range(count)]
    return np.array(poses)


def rows(
    what: str, sizes: Sequence[int], log_of: Callable[[int], Path], folder: Path
) -> list[tuple[str, int, float, float]]:
    """Of each size: what, size, peak memory in MB and CPU time in s."""
    found = []
    for size in sizes:
        target = folder / f"{what.split(maxsplit=1)[0]}-{size}"
        _, used = measured_command("smooth", str(log_of(size)), "-o", str(target), "--force")
        found.append((what, size, used.peak_mb, used.cpu_s))
        print(f"| {what} | {size} | {used.peak_mb:.0f} | {used.cpu_s:.1f} |", flush=True)
    return found


def exponents(found: Sequence[tuple[str, int, float, float]], base_mb: float) -> dict[str, float]:
    """What is measured -> exponent of memory above ``base_mb`` between its largest two sizes."""
    out = {}
    for what in dict.fromkeys(row[0] for row in found):
        (_, a, before, _), (_, b, after, _) = [row for row in found if row[0] == what][-2:]
        out[what] = math.log((after - base_mb) / (before - base_mb)) / math.log(b / a)
    return out


def main() -> int:
    options = parser(__doc__)
    options.add_argument("folder", nargs="?", type=Path, help="where logs are made and kept")
    options.add_argument("--landmarks", nargs="*", type=int, default=LANDMARKS)
    options.add_argument("--rounds", nargs="*", type=int, default=ROUNDS)
    arguments = options.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = arguments.folder or Path(name)
        folder.mkdir(exist_ok=True)

        def marks(count: int) -> Path:
            log = folder / f"marks-{count}.mcap"
            return log if log.exists() else field(log, count)

        def unnamed(count: int) -> Path:
            log = folder / f"unnamed-{count}.mcap"
            return log if log.exists() else field(log, count, named=False)

        def again(count: int) -> Path:
            log = folder / f"again-{count}.mcap"
            return log if log.exists() else field(log, 40, 20 * count)

        print("| what | size | memory, MB | CPU, s |\n|---|---|---|---|")
        base_mb = rows("a short log", (20,), marks, folder)[0][2]
        found = []
        if arguments.landmarks:
            found = rows("landmarks", arguments.landmarks, marks, folder)
            fewer = [round(UNNAMED_SHARE * count) for count in arguments.landmarks]
            found += rows("unnamed landmarks", fewer, unnamed, folder)
        if arguments.rounds:
            found += rows("rounds of 40 landmarks", arguments.rounds, again, folder)
            found += rows(
                "office rings, laser",
                arguments.rounds,
                lambda count: simulated(rings(count), f"rings-{count}", folder),
                folder,
            )
    steep = exponents(found, base_mb)
    for what, exponent in steep.items():
        print(f"{what}: exponent {exponent:.2f}")
    too_much = [mb for what, size, mb, _ in found if what == "landmarks" and size <= 10_000]
    return 1 if max(steep.values()) > STEEPEST or max(too_much, default=0) > MOST_MB else 0


if __name__ == "__main__":
    sys.exit(main())
