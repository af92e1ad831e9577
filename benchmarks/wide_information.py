"""Pose graphs whose stated information spans ten decades: is GTSAM's optimum reached?

Laps through a ring of corridors with turns on the spot and steps of almost nothing, 1228 poses by
default, and closures between places near each other. The noise that is drawn is the noise that is
stated. Information: as anybody would state it ("plain"), of steps as of an odometry whose error
grows with the motion (1e2 to 3e12), of each step ("whole") or of each axis by itself anywhere from
1e1 to 3e12, the axes of the file or turned anyhow. Besides a walk on a grid (like M3500). Our
result with default settings is evaluated with the relative poses of the file. Beside it is the best
of GTSAM's own solutions by QR: from the file's vertices, the true poses, and our result.

Run: python benchmarks/wide_information.py [--poses N] [--seeds N]
"""

import tempfile
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import gtsam
import numpy as np
from common import parser, pose_graph_values, smooth_log
from speed_logs import grid_pose_graph

from graphslam.core.geometry import Array, between, compose, exp, log, rotate_cov, wrap
from graphslam.importers import IMPORTERS

#: m: radius of the ring
RING_M = 12.0
#: log10 of the smallest and the largest sigma of steps, and of closures, m and rad
STEP_SIGMAS, CLOSURE_SIGMAS = (-6.2, -0.5), (-3.0, -0.5)
PLAIN_SIGMAS = np.array([0.05, 0.05, 0.02])
KINDS = ("plain", "motion", "whole", "axes", "turned")
#: m, rad: sigma of the first pose
START_SIGMA = 1e-3
#: information of a pose, by the upper triangle's indices
UPPER = np.triu_indices(3)


def ring_path(poses: int, rng: np.random.Generator) -> Array:
    """Poses (n, 3) on laps around a ring, with turns on the spot and steps of almost nothing."""
    path = [np.array([RING_M, 0.0, np.pi / 2])]
    while len(path) < poses:
        x, y, heading = path[-1]
        kind = rng.random()
        if kind < 0.15:
            step = np.array([0.0, 0.0, rng.choice([-1, 1]) * rng.uniform(0.05, 0.6)])
        elif kind < 0.2:
            step = np.array([1e-4, 1e-5, 1e-5]) * rng.normal(size=3)
        else:
            ahead = np.arctan2(y, x) + np.pi / 2
            ahead += 0.3 * np.clip(np.hypot(x, y) - RING_M, -2, 2)
            turn = 0.4 * float(wrap(ahead - heading)) + 0.02 * rng.normal()
            step = np.array([rng.uniform(0.1, 0.7), 0.0, turn])
        path.append(compose(path[-1], step))
    return np.array(path)


def closed_pairs(path: Array, rng: np.random.Generator) -> Iterator[tuple[int, int]]:
    """A fifth of the poses, each with an earlier one near it that is 40 steps ago or more."""
    for k in range(40, len(path)):
        near = np.flatnonzero(np.hypot(*(path[: k - 40] - path[k])[:, :2].T) < 1.5)
        if len(near) and rng.random() < 0.2:
            yield int(rng.choice(near)), k


def noise(kind: str, delta: Array, is_step: bool, rng: np.random.Generator) -> Array:
    """Square root S (3, 3) of a covariance S Sᵀ, along the axes of the end of an edge."""
    if kind == "plain" or (kind == "motion" and not is_step):
        return np.diag(PLAIN_SIGMAS)
    if kind == "motion":
        along, turned = abs(delta[0]), abs(delta[2])
        sigmas = np.array([0.1 * along, 0.1 * along, 0.1 * turned + 0.02 * along]) + 6e-7
        return np.asarray(np.linalg.cholesky(rotate_cov(np.diag(sigmas**2), -delta[2])))
    low, high = STEP_SIGMAS if is_step else CLOSURE_SIGMAS
    if kind == "whole":
        return np.asarray(10 ** rng.uniform(low, high) * np.eye(3))
    sigmas = 10 ** rng.uniform(low, high, 3)
    turn = np.eye(3) if kind == "axes" else np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return np.asarray(turn * sigmas)


def ring_pose_graph(kind: str, poses: int, seed: int) -> tuple[str, Array]:
    """A graph in g2o's text format, its vertices by odometry, and its true poses (n, 3)."""
    rng = np.random.default_rng(seed)
    path = ring_path(poses, rng)
    pairs = [*((k, k + 1) for k in range(poses - 1)), *closed_pairs(path, rng)]
    edges, guess = [], [np.zeros(3)]
    for a, b in pairs:
        delta = between(path[a], path[b])
        S = noise(kind, delta, b == a + 1, rng)
        measured = compose(delta, exp(S @ rng.normal(size=3)))
        if b == a + 1:
            guess.append(compose(guess[-1], measured))
        root = np.linalg.inv(S)
        upper = " ".join(map(repr, (root.T @ root)[UPPER].tolist()))
        edges.append(f"EDGE_SE2 {a} {b} {' '.join(map(repr, measured.tolist()))} {upper}")
    vertices = [
        f"VERTEX_SE2 {k} {' '.join(map(repr, pose.tolist()))}" for k, pose in enumerate(guess)
    ]
    return "\n".join([*vertices, *edges]) + "\n", between(path[0], path)


def by_qr(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    """GTSAM's solution by Levenberg-Marquardt and QR."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    parameters.setMaxIterations(100)
    parameters.setlambdaUpperBound(1e20)
    parameters.setRelativeErrorTol(1e-12)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()


def error_of(source: Path, values: gtsam.Values) -> float:
    """Half the weighted squared residuals of a file's edges, and of the prior of its first pose.

    Of GTSAM's factors, but for their rounding: its logarithm divides the cosine less one by a
    turn, which may be 1e-9 rad. That is 1e-8 m, where steps are known to 1e-6, and depends on the
    last digits of the poses and of the machine: up to a thousandth of the error of 300 poses.
    """
    poses = np.array([
        [pose.x(), pose.y(), pose.theta()]
        for pose in (values.atPose2(k) for k in range(values.size()))
    ])  # fmt: skip
    lines = source.read_text(encoding="utf-8").splitlines()
    rows = np.array([line.split()[1:] for line in lines if line.startswith("EDGE_SE2 ")], float)
    i, j = rows[:, :2].astype(int).T
    info = np.zeros((len(rows), 3, 3))
    info[:, *UPPER] = info[:, UPPER[1], UPPER[0]] = rows[:, 5:]
    r = log(between(rows[:, 2:5], between(poses[i], poses[j])))
    squared = np.einsum("ni,nij,nj", r, info, r) + np.square(log(poses[0]) / START_SIGMA).sum()
    return float(squared / 2)


def errors(source: Path, truth: Array | None) -> tuple[float, list[float], float]:
    """The error of the file at our result and at GTSAM's own, and our CPU time, s."""
    began = time.process_time()
    recording = source.with_suffix(".mcap")
    IMPORTERS["g2o"](source, recording)
    found = pose_graph_values(smooth_log(recording))
    took = time.process_time() - began
    graph, guess = gtsam.readG2o(str(source), False)
    prior = gtsam.noiseModel.Isotropic.Sigma(3, START_SIGMA)
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), prior))
    starts = [guess, found]
    if truth is not None:
        starts.append(gtsam.Values())
        for k, pose in enumerate(truth):
            starts[-1].insert(k, gtsam.Pose2(*pose))
    own = [error_of(source, by_qr(graph, values)) for values in starts]
    return error_of(source, found), own, took


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--poses", type=int, default=1228)
    options.add_argument("--seeds", type=int, default=3)
    given = options.parse_args()
    columns = ("graph", "seed", "our error", "best", "excess", "from vertices", "CPU s")
    print("".join(f"{column:>14}" for column in columns))
    with tempfile.TemporaryDirectory() as folder:
        for kind, seed in product((*KINDS, "grid"), range(given.seeds)):
            source, truth = Path(folder) / f"{kind}{seed}.g2o", None
            if kind == "grid":
                text = grid_pose_graph(given.poses, seed)
            else:
                text, truth = ring_pose_graph(kind, given.poses, seed)
            source.write_text(text, encoding="utf-8")
            ours, own, took = errors(source, truth)
            shown = f"{ours:14.4f}{min(own):14.4f}{ours / min(own) - 1:14.1e}{own[0]:14.6g}"
            print(f"{kind:>14}{seed:14}{shown}{took:14.1f}", flush=True)


if __name__ == "__main__":
    main()
