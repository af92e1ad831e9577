"""Two robots, one detected in the other's scans, clocks 0.4 s apart: the value of cooperation.

The scenario `robots-in-scans` is the thesis' experiment 6.1.3 without a sensor for robots: the
vehicle knows the Pioneer's outline and finds it in its laser's scans. Smoothed as it is, and
without the sightings (`association.robot_sightings=ignore`). Printed per seed: the Pioneer's
position error, root mean square over the drive (world frame, unaligned, starts known), its standard
deviation, and the error of the clock offset with its standard deviation; then all seeds together.

Then with the start of one of them unknown: it must be detected in the scans of the other, or
localise itself by what it sees. Printed are the same error, the error of the estimated start, and
its standard deviation.

Run: python benchmarks/robots_in_scans.py [--seeds 20] [--unknown 10]
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import START_FROM_TRUTH, parser, simulated_log, smooth_log

from graphslam.core.config import Config
from graphslam.core.config_io import load_config
from graphslam.core.geometry import Array, wrap
from graphslam.evaluation.metrics import evaluate
from graphslam.evaluation.trajectory_metrics import pair_poses
from graphslam.logs import open_logs, read_truth
from graphslam.pipeline.start_priors import first_truth
from graphslam.simulation import load_scenario
from graphslam.simulation.robot_shapes import corners

SCENARIO, OBSERVER, SEEN = "robots-in-scans", "vehicle", "pioneer"


@dataclass(frozen=True)
class Outcome:
    """One run: error and standard deviation of the robot that is seen, m, and the clock found.

    ``aligned_m`` is the error of both robots after one common alignment: that of their relative
    poses.
    """

    error_m: float
    aligned_m: float
    sigma_m: float
    clock: dict[str, float]
    starts: dict[str, dict[str, float]]


def settings(*more: str) -> Config:
    """Defaults, the outline of the robot that is seen, and known starts."""
    body = load_scenario(SCENARIO).robots[SEEN].body
    outline = f"robots.{SEEN}.outline={corners(body).tolist()}"
    return load_config(overrides=[START_FROM_TRUTH, outline, *more])


def outcome(log: Path, *more: str) -> Outcome:
    """Smooth a log and hold it against the truth."""
    config = settings(*more)
    result = smooth_log(log, config)
    found = result.robots[SEEN].final
    truth = read_truth([log], config).trajectories
    pairs = pair_poses(found, truth[SEEN])
    errors = pairs.estimate[:, :2] - pairs.truth[:, :2]
    covs = found.covs[np.isin(found.stamps_ns, pairs.stamps_ns)]
    return Outcome(
        float(np.sqrt(np.mean(np.sum(errors**2, axis=1)))),
        evaluate(result, truth)["joint"]["final"]["ate_aligned_rmse_m"],
        float(np.sqrt(np.mean(covs[:, 0, 0] + covs[:, 1, 1]))),
        result.summary["clocks"][OBSERVER],
        result.summary["starts_found"],
    )


def true_offset_s(log_s: float) -> float:
    """How far the observer's clock is ahead of the other's at the beginning of the log."""
    ahead, other = (load_scenario(SCENARIO).robots[name].clock for name in (OBSERVER, SEEN))
    drift = 1e-6 * (ahead.drift_ppm - other.drift_ppm)
    return ahead.offset_s - other.offset_s + drift * log_s


def both(seed: int, folder: Path) -> tuple[Outcome, Outcome]:
    """Cooperating and alone."""
    log = simulated_log(SCENARIO, seed, folder)
    return outcome(log), outcome(log, "association.robot_sightings=ignore")


def unknown(seed: int, other: str, folder: Path) -> tuple[Outcome, Outcome, Array, Array]:
    """All starts known, and but one: that of ``other``, whose error and sigmas (3,) are found."""
    log = simulated_log(SCENARIO, seed, folder)
    config = settings()
    true = first_truth(open_logs([log], config))
    (known,) = {OBSERVER, SEEN} - {other}
    given = [
        "start.from_truth=false",
        f"start.poses.{known}={true[known].tolist()}",
        f"start.given_sigma_m={config.start.truth_sigma_m}",
        f"start.given_sigma_rad={config.start.truth_sigma_rad}",
    ]
    found = outcome(log, *given)
    start = found.starts[other]
    off = np.array([start["x"], start["y"], start["phi"]]) - true[other]
    off[2] = wrap(off[2])
    sigmas = np.array([start["sigma_m"], start["sigma_m"], start["sigma_rad"]])
    return outcome(log), found, off, sigmas


def print_unknown(count: int, other: str) -> None:
    """The table of one robot whose start is unknown."""
    print(f"\nstart of {other} unknown")
    print("seed   error cm (known)   aligned cm (known)   start cm (sigma)   heading mrad (sigma)")
    errors, starts = [], []
    with tempfile.TemporaryDirectory() as scratch:
        for seed in range(count):
            known, found, off, sigmas = unknown(seed, other, Path(scratch))
            errors.append((found.error_m, known.error_m, found.aligned_m, known.aligned_m))
            starts.append(off / sigmas)
            cm = [100 * value for value in errors[-1]]
            print(
                f"{seed:4} {cm[0]:9.2f} ({cm[1]:5.2f}) {cm[2]:13.2f} ({cm[3]:5.2f}) "
                f"{100 * np.hypot(*off[:2]):13.2f} ({100 * np.hypot(*sigmas[:2]):5.2f}) "
                f"{1e3 * off[2]:13.1f} ({1e3 * sigmas[2]:5.1f})",
                flush=True,
            )
    rms = 100 * np.sqrt(np.mean(np.square(errors), axis=0))
    for what, (found_cm, known_cm) in (("error", rms[:2]), ("aligned", rms[2:])):
        ratio = 100 * found_cm / known_cm
        print(f"{what}, pooled: {found_cm:.2f} cm, known {known_cm:.2f} cm, {ratio:.1f} %")
    print(f"squared errors of starts in sigmas, mean: {np.mean(np.square(starts)):.2f}")


def main() -> None:
    """Print the tables."""
    options = parser(__doc__)
    options.add_argument("--seeds", type=int, default=20)
    options.add_argument("--unknown", type=int, default=10)
    arguments = options.parse_args()
    if arguments.seeds:
        print_known(arguments.seeds)
    for other in (SEEN, OBSERVER) if arguments.unknown else ():
        print_unknown(arguments.unknown, other)


def print_known(count: int) -> None:
    """The table of cooperating and alone."""
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
