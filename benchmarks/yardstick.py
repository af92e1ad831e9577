"""A fixed job of a few seconds that tells how fast a machine is, in the mixture of a SLAM job.

Four parts: a loop of plain Python, NumPy on arrays of three, NumPy on large arrays, and GTSAM on a
pose graph (Levenberg-Marquardt and all marginals). They use nothing of graphslam and must not
change: `speed.py` states its times as multiples of this one's, and its baseline holds as long as
the yardstick is the same.

Run: python benchmarks/yardstick.py      prints one JSON object: seconds of each part, wall and CPU
"""

import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # one core; read when NumPy is imported

import json
import math
import time
from collections.abc import Callable

import gtsam
import numpy as np


def python_loop() -> float:
    """Arithmetic, a list and a dictionary."""
    cells: dict[int, list[float]] = {}
    for k in range(2_000_000):
        cells.setdefault(k * 7919 % 5003, []).append(math.sin(0.001 * k))
    return sum(math.fsum(values) for values in cells.values())


def small_arrays() -> float:
    """Poses composed, and innovations weighed, one at a time."""
    pose, cov = np.zeros(3), 1e-2 * np.eye(3)
    step, noise, total = np.array([0.1, 0.0, 0.02]), np.diag([1e-4, 1e-4, 1e-5]), 0.0
    for _ in range(36_000):
        c, s = math.cos(pose[2]), math.sin(pose[2])
        F = np.array([[1.0, 0.0, -0.1 * s], [0.0, 1.0, 0.1 * c], [0.0, 0.0, 1.0]])
        pose = pose + np.array([c * step[0], s * step[0], step[2]])
        cov = F @ cov @ F.T + noise
        gain = np.linalg.solve(cov + noise, cov)
        cov = cov - cov @ gain
        total += float(np.sqrt(step @ gain @ step))
    return total


def large_arrays() -> float:
    """Distances of all pairs, sorting, a histogram and a product of matrices."""
    rng = np.random.default_rng(1)
    total = 0.0
    for _ in range(4):
        points = rng.uniform(-10, 10, (1500, 2))
        apart = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1))
        nearest = np.sort(apart, axis=1)[:, 1]
        counts = np.bincount((10 * apart.ravel()).astype(int))
        product = apart[:500, :500] @ apart[:500, :500]
        total += float(nearest.sum() + counts[0] + product.trace())
    return total


def pose_graph() -> float:
    """Sixteen rounds of a square with closures to the round before; returns the error left."""
    rng = np.random.default_rng(1)
    sigmas = np.array([0.05, 0.05, 0.02])
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    side, rounds = 30, 16
    true = [gtsam.Pose2(0.0, 0.0, 0.0)]
    for k in range(1, 4 * side * rounds):
        turn = math.pi / 2 if k % side == 0 else 0.0
        true.append(true[-1].compose(gtsam.Pose2(1.0, 0.0, turn)))
    graph, guess = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose2(0, true[0], noise))
    guess.insert(0, true[0])

    def add(a: int, b: int) -> gtsam.Pose2:
        error = gtsam.Pose2(*(sigmas * rng.normal(size=3)))
        measured = true[a].between(true[b]).compose(error)
        graph.add(gtsam.BetweenFactorPose2(a, b, measured, noise))
        return measured

    for k in range(1, len(true)):
        guess.insert(k, guess.atPose2(k - 1).compose(add(k - 1, k)))
        if k >= 4 * side:
            add(k - 4 * side, k)
    found = gtsam.LevenbergMarquardtOptimizer(graph, guess).optimize()
    marginals = gtsam.Marginals(graph, found)
    sizes = sum(float(marginals.marginalCovariance(k).trace()) for k in range(len(true)))
    return float(graph.error(found)) + sizes


PARTS: dict[str, Callable[[], float]] = {
    "python": python_loop,
    "small arrays": small_arrays,
    "large arrays": large_arrays,
    "gtsam": pose_graph,
}


def measure() -> dict[str, dict[str, float]]:
    """Wall and CPU time of each part and of all, s."""
    parts: dict[str, dict[str, float]] = {"wall_s": {}, "cpu_s": {}}
    for name, part in PARTS.items():
        wall, cpu = time.perf_counter(), time.process_time()
        part()
        parts["wall_s"][name] = time.perf_counter() - wall
        parts["cpu_s"][name] = time.process_time() - cpu
    for found in parts.values():
        found["all"] = sum(found.values())
    return parts


if __name__ == "__main__":
    print(json.dumps(measure()))
