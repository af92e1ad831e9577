"""Whether covariances between scans are true, near and far: NEES of relative poses in simulation.

For pairs of keyframes that are so many apart: the squared error of the final pose of the laser at
the second, seen from the first, in units of the stated covariance between both, per degree of
freedom. It is 1 if covariances are true. Nothing is aligned, and starts do not matter. Means over
seeds, with the standard deviation over them.

Run: python benchmarks/relative_covariances.py [--seeds N] [lab office-loop corridor]
"""

import tempfile
from pathlib import Path

import numpy as np
from common import parser

import graphslam
from graphslam.core.geometry import Array, between, compose, exp, log
from graphslam.core.records import Trajectory
from graphslam.evaluation.relation_covariances import relative_covariances
from graphslam.logs import read_truth
from graphslam.results.joint_file import joint_scans
from graphslam.simulation import load_scenario, simulate
from graphslam.simulation.scenario import Scenario

#: keyframes between the ends of pairs
APART = (1, 5, 20, 80)


def main() -> None:
    """Print a line for each scenario."""
    options = parser(__doc__)
    options.add_argument("scenarios", nargs="*", default=("lab", "office-loop", "corridor"))
    options.add_argument("--seeds", type=int, default=20)
    chosen = options.parse_args()
    print("keyframes apart: " + ", ".join(map(str, APART)))
    with tempfile.TemporaryDirectory() as folder:
        for name in chosen.scenarios:
            scenario, path = load_scenario(name), Path(folder) / "log.mcap"
            found = []
            for seed in range(chosen.seeds):
                path.unlink(missing_ok=True)
                simulate(scenario, path, seed)
                found.append(nees_by_distance(path, scenario))
            mean, spread = np.nanmean(found, axis=0), np.nanstd(found, axis=0)
            numbers = ", ".join(f"{m:.2f} ± {s:.2f}" for m, s in zip(mean, spread, strict=True))
            print(f"{name}, {chosen.seeds} seeds: NEES/dof {numbers}", flush=True)


def nees_by_distance(path: Path, scenario: Scenario) -> Array:
    """Mean NEES per degree of freedom for each of `APART`; NaN where a log is too short."""
    result = graphslam.smooth(path)
    joint = joint_scans(result.estimate, result.robots)
    assert joint is not None
    ((name, robot),) = result.robots.items()
    (simulated,) = scenario.robots.values()
    assert simulated.laser is not None and robot.scan_final is not None
    mount = np.array([*simulated.laser.mount_m, np.radians(simulated.laser.mount_deg)])
    truth = read_truth([path], graphslam.load_config()).trajectories[name]
    scans = robot.scan_final
    true = compose(interpolated(truth, scans.stamps_ns), mount)
    states = np.searchsorted(scans.stamps_ns, joint.states[name].stamps_ns)
    out = np.full(len(APART), np.nan)
    for k, apart in enumerate(APART):
        pairs = np.column_stack([states[:-apart], states[apart:]])
        if len(pairs):
            covs = relative_covariances(joint, name, scans, pairs)
            error = log(between(between(*true[pairs.T]), between(*scans.poses[pairs.T])))
            out[k] = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covs), error).mean() / 3
    return out


def interpolated(path: Trajectory, stamps_ns: np.ndarray) -> Array:
    """Poses (n, 3) at stamps (n,) along the path."""
    after = np.clip(np.searchsorted(path.stamps_ns, stamps_ns), 1, len(path.stamps_ns) - 1)
    begin, end = path.stamps_ns[after - 1], path.stamps_ns[after]
    share = ((stamps_ns - begin) / (end - begin))[:, None]
    first = path.poses[after - 1]
    return compose(first, exp(share * log(between(first, path.poses[after]))))


if __name__ == "__main__":
    main()
