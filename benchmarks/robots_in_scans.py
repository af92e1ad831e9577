"""Two robots, one found in the other's scans, their clocks 0.4 s apart: what cooperation is worth.

The scenario `robots-in-scans` is the thesis' experiment 6.1.3 without a sensor for robots: the
vehicle knows the Pioneer's outline and finds it in its laser's scans. Smoothed as it is, and
without the sightings (`association.robots=ignore`). Printed per seed: the Pioneer's position error,
root mean square over the drive (world frame, unaligned, starts known), its standard deviation, and
how far the clock's offset is from the truth, with its standard deviation; then all seeds together.

Run: python benchmarks/robots_in_scans.py [--seeds 20]
"""

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from graphslam.config import Config, load_config
from graphslam.evaluate import pair
from graphslam.logs import open_logs, read_truth
from graphslam.simulate import load_scenario, simulate
from graphslam.simulate.body import corners
from graphslam.slam import smooth

SCENARIO, OBSERVER, SEEN = "robots-in-scans", "vehicle", "pioneer"


@dataclass(frozen=True)
class Outcome:
    """One run: error and standard deviation of the robot that is seen, m, and the clock found."""

    error_m: float
    sigma_m: float
    clock: dict[str, float]


def settings(*more: str) -> Config:
    """Defaults, the outline of the robot that is seen, and known starts."""
    body = load_scenario(SCENARIO).robots[SEEN].body
    outline = f"robots.{SEEN}.outline={corners(body).tolist()}"
    return load_config(overrides=["start.from_truth=true", outline, *more])


def outcome(log: Path, *more: str) -> Outcome:
    """Smooth a log and hold it against the truth."""
    config = settings(*more)
    result = smooth(open_logs([log], config), config)
    found = result.robots[SEEN].final
    pairs = pair(found, read_truth([log], config).trajectories[SEEN])
    errors = pairs.estimate[:, :2] - pairs.truth[:, :2]
    covs = found.covs[np.isin(found.stamps_ns, pairs.stamps_ns)]
    return Outcome(
        float(np.sqrt(np.mean(np.sum(errors**2, axis=1)))),
        float(np.sqrt(np.mean(covs[:, 0, 0] + covs[:, 1, 1]))),
        result.summary["clocks"][OBSERVER],
    )


def true_offset_s(log_s: float) -> float:
    """How far the observer's clock is ahead of the other's at the beginning of the log."""
    ahead, other = (load_scenario(SCENARIO).robots[name].clock for name in (OBSERVER, SEEN))
    drift = 1e-6 * (ahead.drift_ppm - other.drift_ppm)
    return ahead.offset_s - other.offset_s + drift * log_s


def both(seed: int, folder: Path) -> tuple[Outcome, Outcome]:
    """Cooperating and alone."""
    log = folder / f"{seed}.mcap"
    simulate(load_scenario(SCENARIO), log, seed=seed)
    return outcome(log), outcome(log, "association.robots=ignore")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    count = parser.parse_args().seeds
    print("seed   error cm (alone)   sigma cm (alone)   offset off, ms   sigma, ms")
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        for seed in range(count):
            joint, alone = both(seed, Path(scratch))
            off_ms = 1e3 * (joint.clock["offset_s"] - true_offset_s(0.0))
            sigma_ms = 1e3 * joint.clock["offset_sigma_s"]
            row = (joint.error_m, alone.error_m, joint.sigma_m, alone.sigma_m, off_ms, sigma_ms)
            rows.append(row)
            cm = [100 * value for value in row[:4]]
            print(
                f"{seed:4} {cm[0]:9.2f} ({cm[1]:5.2f}) {cm[2]:11.2f} ({cm[3]:5.2f}) "
                f"{off_ms:14.1f} {sigma_ms:11.1f}",
                flush=True,
            )
    table = np.array(rows)
    rms = np.sqrt(np.mean(table**2, axis=0))
    print(f"error, cooperating of alone, pooled: {100 * rms[0] / rms[1]:.1f} % (bar 66.7 %)")
    print(f"standard deviation, of alone: {100 * rms[2] / rms[3]:.1f} %")
    print(
        f"offset: RMS {rms[4]:.1f} ms, worst {np.abs(table[:, 4]).max():.1f} ms (bar 20 ms), "
        f"RMS of its sigmas {np.sqrt(np.mean((table[:, 4] / table[:, 5]) ** 2)):.2f}"
    )


if __name__ == "__main__":
    main()
