"""Sensors of landmarks as they are sold, with noise stated or not, and odometry that is far off.

    python benchmarks/usual_cameras.py [SENSOR ...] [--odometry LENGTH,TURNING ...]
        [--noise NAME ...] [--seeds 2] [--seconds 120]

One robot on changing arcs among 17 points, odometry as poses (1 cm and 1.1 deg per root of a metre,
1.1 deg per root of a radian).

tags        a camera and markers with names: 69 deg, 0.3 to 4 m, 0.5 deg, 5 mm and 3 % of the range
depth       a depth camera, no names: 86 deg, 0.4 to 5 m, 0.3 deg, 5 mm and 0.3 % of the range
            squared
reflectors  a laser, no names: all around, up to 9 m, 0.3 deg, 2 cm
beacons     radios with names, twice a second: all around, up to 9 m, 3 deg, 10 cm

The noise is `stated` as it is, `guessed` (2 deg, 5 cm), or stated as unknown (`none`). ODOMETRY:
by how much it is longer and turns more than the robot. Per run: position error in the world (root
mean square, m, not aligned), NEES per degree of freedom, landmarks (and how many points were seen),
scales of odometry as found, CPU seconds, and the verdict.

exit code 1 if a run is not good, or has more than 1.5 times the error that noise stated and right
odometry leave, or other landmarks than points, give or take one.
"""

import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from common import parser
from full_information import PERIOD_S, POINTS, START, T0, Drive, Log, S, drive, judged

from graphslam.core.config_io import load_config
from graphslam.core.geometry import Array, between, compose, exp, log, wrap
from graphslam.logs import LogWriter, open_logs
from graphslam.slam.smooth import smooth


class Sensor(NamedTuple):
    """Half of the field, rad; ranges, m; every so many readings; sigmas; whether it tells names."""

    field_rad: float
    near_m: float
    far_m: float
    every: int
    sigma_rad: float
    sigma_m: Callable[[float], float]
    named: bool


SENSORS: Mapping[str, Sensor] = {
    "tags": Sensor(0.6, 0.3, 4.0, 1, np.deg2rad(0.5), lambda r: 0.005 + 0.03 * r, True),
    "depth": Sensor(0.75, 0.4, 5.0, 1, np.deg2rad(0.3), lambda r: 0.005 + 0.003 * r * r, False),
    "reflectors": Sensor(np.pi, 0.2, 9.0, 1, np.deg2rad(0.3), lambda _: 0.02, False),
    "beacons": Sensor(np.pi, 0.2, 9.0, 5, np.deg2rad(3.0), lambda _: 0.1, True),
}
GUESSED = np.array([np.deg2rad(2.0), 0.05])
NOISES: Mapping[str, Callable[[Array], Array]] = {
    "stated": lambda sigmas: np.diag(sigmas**2),
    "guessed": lambda _: np.diag(GUESSED**2),
    "none": lambda _: np.zeros((2, 2)),
}
#: of odometry: m and rad per root of a metre, rad per root of a radian
DRIFT_M, DRIFT_RAD, TURN_RAD = 0.01, 0.02, 0.02
#: share of what is in sight that is not seen
MISSED = 0.1
ODOMETRY = ((1.0, 1.0), (1.0, 0.6), (1.0, 1.5), (1.0, 2.0), (0.75, 1.0))
MOST_TIMES = 1.5


class Seen(NamedTuple):
    """A sighting: at which reading, of which point, bearing rad and range m, and their sigmas."""

    reading: int
    point: int
    z: Array
    sigmas: Array


def drawn(sensor: Sensor, seconds: float, seed: int) -> tuple[Drive, Array, list[Seen]]:
    """A drive with right odometry, the points (n, 2) and what was seen of them."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-5, -4], [5, 4], (POINTS, 2))
    n = round(seconds / PERIOD_S)
    own = drive(n, np.append(rng.uniform(-2, 2, 2), rng.uniform(-3, 3)), rng)
    true = log(between(own.poses[:-1], own.poses[1:]))
    length, turn = np.sqrt(np.abs(true[:, 0])), np.sqrt(np.abs(true[:, 2]))
    sigma = np.column_stack([DRIFT_M * length, 0.3 * DRIFT_M * length, DRIFT_RAD * length])
    sigma[:, 2] += TURN_RAD * turn
    seen = []
    for k in range(1, n + 1, sensor.every):
        x = own.poses[k]
        apart = points - x[:2]
        z = np.column_stack([wrap(np.arctan2(*apart.T[::-1]) - x[2]), np.hypot(*apart.T)])
        is_seen = (np.abs(z[:, 0]) < sensor.field_rad) & (rng.random(POINTS) > MISSED)
        is_seen &= (z[:, 1] > sensor.near_m) & (z[:, 1] < sensor.far_m)
        for i in np.flatnonzero(is_seen).tolist():
            sigmas = np.array([sensor.sigma_rad, sensor.sigma_m(float(z[i, 1]))])
            noisy = z[i] + sigmas * rng.normal(size=2)
            seen.append(Seen(k, i, np.append(wrap(noisy[0]), noisy[1]), sigmas))
    return replace(own, twists=true + sigma * rng.normal(size=true.shape)), points, seen


def write(
    path: Path, own: Drive, seen: Sequence[Seen], scales: Array, cov: Callable[[Array], Array],
    *, named: bool,
) -> None:  # fmt: skip
    """The log, by odometry that is longer and turns more by ``scales`` (2,)."""
    stamps = [T0 + k * round(PERIOD_S * S) for k in range(len(own.poses))]
    pose, rest = np.zeros(3), list(seen)[::-1]
    with LogWriter(path) as out:
        for k, stamp in enumerate(stamps):
            if k:
                pose = compose(pose, exp(own.twists[k - 1] * scales[[0, 0, 1]]))
            out.odometry("robot", stamp, pose)
            while rest and rest[-1].reading == k:
                one = rest.pop()
                name = f"p{one.point}" if named else None
                out.sighting("robot", stamp, one.z, cov(one.sigmas), identity=name)


class Row(NamedTuple):
    """A run; ``scales`` of odometry are corrections, of length and of turning."""

    error_m: float
    nees: float
    landmarks: int
    points: int
    scales: tuple[float, float]
    cpu_s: float
    verdict: str


def run(sensor: Sensor, seconds: float, seed: int, scales: Array, noise: str, at: Path) -> Row:
    own, points, seen = drawn(sensor, seconds, seed)
    write(at, own, seen, scales, NOISES[noise], named=sensor.named)
    config = load_config()
    start = replace(
        config.start,
        poses={"robot": tuple(own.poses[0] + own.start)},
        given_sigma_m=float(START[0]),
        given_sigma_rad=float(START[2]),
    )
    config = replace(config, start=start)
    began = time.process_time()
    result = smooth(open_logs([at], config), config)
    cpu_s = time.process_time() - began
    final = result.robots["robot"].final
    k = np.rint((final.stamps_ns - T0) / (PERIOD_S * S)).astype(int)
    true = Log({"robot": replace(own, poses=own.poses[k])}, points, [])
    error, nees = judged(true, {"robot": (final.poses, final.covs)})
    names = ("robot.translation_scale", "robot.rotation_scale")
    found = result.summary["calibration"]
    return Row(
        error, nees, len(result.landmarks), len({one.point for one in seen}),
        (found[names[0]]["value"], found[names[1]]["value"]), cpu_s,
        result.summary["verdict"]["verdict"],
    )  # fmt: skip


def is_right(row: Row, healthy: Row) -> bool:
    near = row.error_m <= MOST_TIMES * healthy.error_m
    return near and abs(row.landmarks - row.points) <= 1 and row.verdict == "good"


def main() -> int:
    """Print the table."""
    options = parser(__doc__)
    options.add_argument("sensors", nargs="*", default=list(SENSORS), metavar="SENSOR")
    options.add_argument("--odometry", nargs="+", default=[f"{a},{b}" for a, b in ODOMETRY])
    options.add_argument("--noise", nargs="+", default=list(NOISES), choices=list(NOISES))
    options.add_argument("--seeds", type=int, default=2)
    options.add_argument("--seconds", type=float, default=120.0)
    given = options.parse_args()
    print(
        f"{'sensor':12}{'odometry':>10}{'noise':>9}{'seed':>5}{'error':>8}{'times':>7}{'NEES':>7}"
        f"{'points':>8}{'scales':>16}{'CPU s':>7}  verdict"
    )
    good = True
    with tempfile.TemporaryDirectory() as folder:
        at = Path(folder) / "log.mcap"
        for name in given.sensors:
            for seed in range(1, 1 + given.seeds):
                healthy = run(SENSORS[name], given.seconds, seed, np.ones(2), "stated", at)
                for text in given.odometry:
                    scales = np.array([float(number) for number in text.split(",")])
                    for noise in given.noise:
                        row = run(SENSORS[name], given.seconds, seed, scales, noise, at)
                        print(
                            f"{name:12}{text:>10}{noise:>9}{seed:5}{row.error_m:8.4f}"
                            f"{row.error_m / healthy.error_m:7.2f}{row.nees:7.2f}"
                            f"{f'{row.landmarks}/{row.points}':>8}"
                            f"{row.scales[0]:8.3f}{row.scales[1]:8.3f}{row.cpu_s:7.1f}"
                            f"  {row.verdict}",
                            flush=True,
                        )
                        good &= is_right(row, healthy)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
