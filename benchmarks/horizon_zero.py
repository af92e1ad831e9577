"""Is horizon 0 the extended Kalman filter? Both on the same recorded steps, number by number.

`isam2` with horizon 0 (GTSAM factors, square root information) and `ekf` with body-frame errors
(covariances, NumPy) get the steps of one recording each. Compared are, at every step, the latest
pose of every robot that moved, and at the end all landmarks: the largest difference of a mean over
the standard deviation of that coordinate, and the largest relative difference of a standard
deviation. Then the CPU time of a whole replay, the better of three each, in turn.

With --isam2 instead the same filter inside `gtsam.ISAM2`: every factor is linearised at the
estimate of its own time, enters as a LinearContainerFactor, and nothing is linearised again. It has
no robust kernel, which would need marginals between factors, so horizon 0 has none here either.

Run: python benchmarks/horizon_zero.py [lab corridor two-robots forest intel] [--seconds 600]
     [--isam2]
"""

import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np
from common import FREIBURG_LOGS, START_FROM_TRUTH, import_freiburg, parser, simulated_log

from graphslam.core.config import Config, RobustConfig
from graphslam.core.config_io import load_config, with_settings
from graphslam.core.geometry import Array, wrap
from graphslam.core.records import Step
from graphslam.estimation import factors
from graphslam.estimation.backends import BACKENDS
from graphslam.estimation.factor_ekf import FactorEkfBackend, correct, linear
from graphslam.estimation.factor_graph import GraphBuilder
from graphslam.estimation.replay import Replay, replay
from graphslam.evaluation.recorded_steps import record_steps
from graphslam.logs import open_logs

LOGS = ("lab", "corridor", "two-robots", "forest", "intel")
KALMAN = {"backend.name": "ekf", "ekf.error": "body"}
HORIZON_0 = {"backend.name": "isam2", "backend.horizon_s": 0.0}


@dataclass(frozen=True)
class Apart:
    """The largest differences: of means, in sigmas, and of sigmas, relative."""

    mean: float
    sigma: float

    def and_(self, other: "Apart") -> "Apart":
        """The larger ones of both."""
        return Apart(max(self.mean, other.mean), max(self.sigma, other.sigma))


def apart(mean: Array, cov: Array, other: Array, other_cov: Array) -> Apart:
    """Of Gaussians: means (n, d), covariances (n, d, d); the third entry is an angle."""
    off = mean - other
    if off.shape[-1] == 3:
        off[..., 2] = wrap(off[..., 2])
    sigma, theirs = (np.sqrt(np.diagonal(c, axis1=-2, axis2=-1)) for c in (cov, other_cov))
    return Apart(float(np.abs(off / sigma).max()), float(np.abs(theirs / sigma - 1).max()))


def compared(one: Replay, other: Replay) -> tuple[Apart, Apart]:
    """Of all poses when they are new, and of all landmarks at the end."""
    poses = Apart(0.0, 0.0)
    for robot, a in one.causal.items():
        b = other.causal[robot]
        poses = poses.and_(apart(a.poses, a.covs, b.poses, b.covs))
    marks = Apart(0.0, 0.0)
    for number, (mean, cov) in one.estimate.landmarks.items():
        theirs = other.estimate.landmarks[number]
        marks = marks.and_(apart(mean[None], cov[None], theirs[0][None], theirs[1][None]))
    return poses, marks


def cpu_ms(steps: Sequence[Step], config: Config) -> float:
    """CPU time per step of a replay, ms, covariances of the states included."""
    began = time.process_time()
    replay(steps, BACKENDS[config.backend.name](config))
    return 1e3 * (time.process_time() - began) / len(steps)


def jacobian_factor(A: Array, b: Array, dims: Mapping[int, int]) -> gtsam.JacobianFactor:
    """Whitened rows A (k, D) z = b (k,) of one or two variables with their dimensions, in order."""
    unit = gtsam.noiseModel.Unit.Create(len(b))
    first, *second = dims
    dim = dims[first]
    if not second:
        return gtsam.JacobianFactor(first, A, b, unit)
    return gtsam.JacobianFactor(first, A[:, :dim], second[0], A[:, dim:], b, unit)


def isam2_filter(steps: Sequence[Step]) -> dict[str, list[Array]]:
    """The filter inside ISAM2: every state's pose (3,) as its own step left it, of each robot.

    A factor moves all variables, and the next one is linearised where they are then: so the
    corrections of the whole tree are read after every factor.
    """
    builder = GraphBuilder(RobustConfig("none"), wide=False)
    settings, search = gtsam.ISAM2Params(), gtsam.ISAM2GaussNewtonParams()
    search.setWildfireThreshold(0.0)
    settings.setOptimizationParams(search)
    settings.enableRelinearization = False
    tree = gtsam.ISAM2(settings)
    values: dict[int, Array] = {}
    first: dict[int, Array] = {}  # where ISAM2 linearises: at a variable's first value
    z: dict[int, Array] = {}
    causal: dict[str, list[Array]] = {}
    for step in steps:
        for group in builder.factor_groups(step, lambda key, _dim: values[key]):
            new = gtsam.Values()
            if group.new is not None:
                key, value = group.new
                values[key] = first[key] = value
                z[key] = np.zeros(len(value))
                factors.write(new, key, value)
            graph = gtsam.NonlinearFactorGraph()
            for factor in group.factors:
                rows, at = linear(factor, values, z.__getitem__), gtsam.Values()
                for key in rows.dims:
                    factors.write(at, key, first[key])
                made = jacobian_factor(rows.A, rows.b, rows.dims)
                graph.add(gtsam.LinearContainerFactor(made, at))
            tree.update(graph, new)
            if group.new is None:  # else nothing moves
                tree.calculateBestEstimate()  # corrections of all variables, to the last digit
                delta = tree.getDelta()
                now = {key: delta.at(key).copy() for key in z}
                correct(values, {key: (now[key] - z[key])[:, None] for key in z})
                z = now
        for robot in {**step.starts, **step.motions}:
            causal.setdefault(robot, []).append(values[builder.latest_key(robot)].copy())
    return causal


def isam2_row(name: str, steps: Sequence[Step]) -> str:
    """A line on the filter inside ISAM2: its difference from horizon 0 and its time."""
    config = with_settings(Config(), {**HORIZON_0, "robust.kernel": "none"})
    began = time.process_time()
    inside = isam2_filter(steps)
    ms = 1e3 * (time.process_time() - began) / len(steps)
    ours = replay(steps, FactorEkfBackend(config)).causal
    worst = max(apart(a.poses, a.covs, np.array(inside[n]), a.covs).mean for n, a in ours.items())
    return f"| {name} | {len(steps)} | {worst:.1e} | {cpu_ms(steps, config):.2f} | {ms:.2f} |"


def steps_of(name: str, seconds: float, folder: Path) -> tuple[Step, ...]:
    """Steps recorded by the smoother; of a real log those of the first seconds."""
    if name in FREIBURG_LOGS:
        config = load_config()
        steps = record_steps(open_logs([import_freiburg(name, folder)], config), config).steps
        end_ns = steps[0].time_ns + round(1e9 * seconds)
        return tuple(step for step in steps if step.time_ns <= end_ns)
    config = load_config(None, [START_FROM_TRUTH, "backend.name=isam2"])
    return record_steps(open_logs([simulated_log(name, 0, folder)], config), config).steps


def main() -> int:
    """Print the table; 1 if a difference exceeds a millionth of a sigma."""
    options = parser(__doc__)
    options.add_argument("names", nargs="*", default=LOGS, metavar="NAME")
    options.add_argument("--seconds", type=float, default=600.0, help="of a real log")
    options.add_argument("--isam2", action="store_true", help="the filter inside gtsam.ISAM2")
    given = options.parse_args()
    if given.isam2:
        print("| log | steps | poses, sigma | horizon 0, ms/step | inside ISAM2, ms/step |")
        print("|---|---|---|---|---|")
        with tempfile.TemporaryDirectory() as folder:
            for name in given.names:
                print(isam2_row(name, steps_of(name, given.seconds, Path(folder))), flush=True)
        return 0
    print("| log | steps | landmarks | poses, sigma | landmarks, sigma | sigmas, relative "
          "| EKF, ms/step | horizon 0, ms/step | ratio |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|---|")
    failed = False
    ekf, zero = (with_settings(Config(), settings) for settings in (KALMAN, HORIZON_0))
    with tempfile.TemporaryDirectory() as folder:
        for name in given.names:
            steps = steps_of(name, given.seconds, Path(folder))
            one, other = (replay(steps, BACKENDS[c.backend.name](c)) for c in (ekf, zero))
            poses, marks = compared(one, other)
            worst = poses.and_(marks)
            failed |= max(worst.mean, worst.sigma) > 1e-6
            times = [(cpu_ms(steps, ekf), cpu_ms(steps, zero)) for _ in range(3)]
            a, b = (min(column) for column in zip(*times, strict=True))
            print(
                f"| {name} | {len(steps)} | {len(one.estimate.landmarks)} | {poses.mean:.1e} "
                f"| {marks.mean:.1e} | {worst.sigma:.1e} | {a:.2f} | {b:.2f} | {b / a:.2f} |",
                flush=True,
            )
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main())
