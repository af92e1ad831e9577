"""Scans per second of the front ends on one core.

Generated scans of a cluttered room (180 beams at 1°, 361 at 0.5°), and the Intel log if the data
are there. CPU time, best of five.
Then what one Hough table costs, and the next line after it, with the accumulator that is used and
with OpenCV's, which count anew for each line.

Run: python benchmarks/frontend_speed.py [--scans 500]
"""

import bz2
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from common import FREIBURG, best_cpu_s, parser

from graphslam.core.config import FrontEndConfig
from graphslam.core.records import Scan
from graphslam.perception.front_ends import FRONT_ENDS
from graphslam.perception.hough_votes import ThesisVotes
from graphslam.perception.ordered_scan import Sweep, make_sweep


def generated(beams: int, count: int) -> list[Scan]:
    """Scans of a room with things in it: 1 cm of noise and 3 % drop-outs."""
    rng = np.random.default_rng(1)
    angles = np.linspace(-np.pi / 2, np.pi / 2, beams)
    scans = []
    for _ in range(count):
        distance, normal = rng.uniform(1, 12, 12), rng.uniform(-np.pi, np.pi, 12)
        with np.errstate(divide="ignore"):
            to_wall = distance[:, None] / np.cos(angles - normal[:, None])
        to_wall[to_wall <= 0] = np.inf
        r = to_wall.min(axis=0)
        for _ in range(6):  # things that stand in front
            at, half = rng.uniform(-1.5, 1.5), rng.uniform(0.02, 0.15)
            r = np.where(np.abs(angles - at) < half, r * rng.uniform(0.4, 0.9), r)
        r = r + 0.01 * rng.normal(size=beams)
        r[rng.random(beams) < 0.03] = np.nan
        scans.append(Scan("r", 0, 0, r, angles[0], angles[1] - angles[0], np.zeros(3)))
    return scans


def intel(count: int) -> list[Scan]:
    """About so many scans, spread over the Intel log; none if it is not there."""
    path = FREIBURG / "intel.clf.bz2"
    if not path.exists():
        return []
    scans = []
    with bz2.open(path, "rt") as lines:
        for words in (line.split() for line in lines if line.startswith("FLASER")):
            r = np.array(words[2 : 2 + int(words[1])], dtype=float)
            r[r >= 81] = np.nan
            scans.append(Scan("r", 0, 0, r, -np.pi / 2, np.pi / 180, np.zeros(3)))
    return scans[:: -(-len(scans) // count)]


def report(label: str, scans: Sequence[Scan], config: FrontEndConfig) -> None:
    for name, front_end in FRONT_ENDS.items():
        found = sum(len(front_end(scan, config)) for scan in scans)
        seconds = best_cpu_s(lambda: [front_end(scan, config) for scan in scans])  # noqa: B023
        per_scan = seconds / len(scans)
        print(
            f"{label:22} {name:10} {1e3 * per_scan:7.3f} ms/scan {1 / per_scan:11.0f} scans/s"
            f" {found / len(scans):6.1f} lines/scan"
        )


def best_ms(what: Callable[[Sweep], object], sweeps: Sequence[Sweep]) -> float:
    """CPU time per sweep, ms, best of five."""
    return 1e3 * best_cpu_s(lambda: [what(sweep) for sweep in sweeps]) / len(sweeps)


def accumulators(scans: Sequence[Scan], config: FrontEndConfig) -> None:
    """One table of votes for d and γ of the settings, three ways."""
    sweeps = [make_sweep(scan, config.hough_d_max_m) for scan in scans]
    half_turn = config.hough_gamma_steps // 2
    d_max, cell = config.hough_d_max_m, config.hough_delta_d_m
    side = round(2 * d_max / cell)

    def table(sweep: Sweep) -> ThesisVotes:
        weights = sweep.ranges[sweep.beam] * sweep.step_rad
        return ThesisVotes(sweep.points, weights, np.ones(len(sweep.beam), dtype=np.bool_), config)

    def first(sweep: Sweep) -> object:
        return table(sweep).peak()

    def two(sweep: Sweep) -> object:
        votes = table(sweep)
        votes.remove(votes.peak())
        return votes.peak()

    def point_set(sweep: Sweep) -> object:
        points = sweep.points.astype(np.float32)[:, None]
        step = np.pi / half_turn
        return cv2.HoughLinesPointSet(points, 1, 3, -d_max, d_max, cell, 0, np.pi - step, step)

    def raster(sweep: Sweep) -> object:
        image = np.zeros((side, side), dtype=np.uint8)
        at = ((sweep.points + d_max) / cell).astype(np.intp).clip(0, side - 1)
        image[at[:, 1], at[:, 0]] = 255
        return cv2.HoughLines(image, 1, np.pi / half_turn, 3, use_edgeval=True)

    once = best_ms(first, sweeps)
    again = best_ms(two, sweeps) - once
    print(f"accumulator: first line {once:.3f} ms, the next {again:.3f} ms")
    for name, way in (("HoughLinesPointSet", point_set), ("HoughLines on a raster", raster)):
        print(f"cv2.{name}: each line {best_ms(way, sweeps):.3f} ms")


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--scans", type=int, default=500, help="of each kind")
    count = options.parse_args().scans
    cv2.setNumThreads(1)
    config = FrontEndConfig()
    report("generated, 180 beams", generated(180, count), config)
    report("generated, 361 beams", generated(361, count), config)
    accumulators(generated(180, min(count, 100)), config)
    if scans := intel(count):
        report("Intel, 180 beams", scans, config)


if __name__ == "__main__":
    main()
