"""What `speed.py` runs in a process of its own and is no graphslam command; prints a JSON object.

Run: python benchmarks/speed_runs.py steps LOG [key=value ...]   cost of each keyframe
     python benchmarks/speed_runs.py gtsam-lm|gtsam-isam2|g2o-lm GRAPH.g2o   bare loops of others

The bare loops read a pose graph and solve it, nothing else: no log, no front end, no covariances.
"""

import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # as the command line has it; read when NumPy is imported

import json
import sys
from collections.abc import Callable
from pathlib import Path

import gtsam
import numpy as np

#: iterations of a batch solver, at most
ITERATIONS = 50


def steps(log: str, *settings: str) -> dict[str, float]:
    """Milliseconds per keyframe of a run, by the public interface; means of its fifths."""
    import graphslam  # noqa: PLC0415 - the bare loops do without

    chosen = dict(setting.split("=") for setting in settings)
    result = graphslam.smooth(log, **{key: _value(text) for key, text in chosen.items()})
    return step_statistics(result.step_ms)


def _value(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def step_statistics(step_ms: np.ndarray) -> dict[str, float]:
    """Number, quantiles and means, ms, of the costs (n,) of keyframes."""
    p50, p99 = np.quantile(step_ms, [0.5, 0.99]).tolist()
    fifth = max(1, len(step_ms) // 5)
    return {
        "keyframes": len(step_ms),
        "p50_ms": p50,
        "p99_ms": p99,
        "max_ms": float(step_ms.max()),
        "mean_ms": float(step_ms.mean()),
        "first_fifth_ms": float(step_ms[:fifth].mean()),
        "last_fifth_ms": float(step_ms[-fifth:].mean()),
    }


def gtsam_lm(path: str) -> dict[str, float]:
    """Levenberg-Marquardt from the vertices of the file."""
    graph, guess = _read(path)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(ITERATIONS)
    found = gtsam.LevenbergMarquardtOptimizer(graph, guess, parameters).optimize()
    return {"vertices": found.size(), "factors": graph.size(), "error": graph.error(found)}


def gtsam_isam2(path: str) -> dict[str, float]:
    """One update for each pose with its factors, in the order of the file, its estimate read."""
    graph, guess = _read(path)
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")  # Cholesky calls some good graphs indeterminate
    isam = gtsam.ISAM2(parameters)
    poses = 0
    news, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for factor in _by_pose(graph):
        keys = factor.keys()
        if poses in keys and news.size():  # a new pose: what came before is complete
            isam.update(news, values)
            news, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
            isam.calculateEstimatePose2(poses - 1)
        poses += poses in keys
        for key in keys:
            if not (isam.valueExists(key) or values.exists(key)):
                values.insert(key, _predicted(factor, key, isam, values, guess))
        news.push_back(factor)
    isam.update(news, values)
    found = isam.calculateEstimate()
    return {"vertices": found.size(), "factors": graph.size(), "error": graph.error(found)}


def _by_pose(graph: gtsam.NonlinearFactorGraph) -> list[gtsam.NonlinearFactor]:
    """Factors in the order of the newest pose in each; landmarks are numbered after all poses."""
    factors = [graph.at(i) for i in range(graph.size())]
    chain = {tuple(factor.keys()) for factor in factors}
    poses = 1
    while (poses - 1, poses) in chain:
        poses += 1

    def newest(factor: gtsam.NonlinearFactor) -> tuple[int, int]:
        keys = list(factor.keys())
        return max(key for key in keys if key < poses), max(keys)

    return sorted(factors, key=newest)


def _predicted(
    factor: gtsam.NonlinearFactor,
    key: int,
    isam: gtsam.ISAM2,
    values: gtsam.Values,
    guess: gtsam.Values,
) -> gtsam.Pose2:
    """A new vertex by its first measurement; the first one of all by the file."""
    if not isinstance(factor, gtsam.BetweenFactorPose2):
        return guess.atPose2(key)
    first, second = factor.keys()
    other = second if key == first else first
    known = values.atPose2(other) if values.exists(other) else isam.calculateEstimatePose2(other)
    measured = factor.measured()
    return known.compose(measured if key == second else measured.inverse())


def _read(path: str) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """A g2o file, its first vertex held."""
    graph, guess = gtsam.readG2o(path, False)
    first = guess.keys()[0]
    held = gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)
    graph.push_back(gtsam.PriorFactorPose2(first, guess.atPose2(first), held))
    return graph, guess


def g2o_lm(path: str) -> dict[str, float]:
    """Levenberg-Marquardt of g2o from the vertices of the file."""
    import g2opy as g2o  # noqa: PLC0415 - only where it is installed

    optimizer = g2o.SparseOptimizer()
    solver = g2o.BlockSolverSE2(g2o.LinearSolverEigenSE2())
    optimizer.set_algorithm(g2o.OptimizationAlgorithmLevenberg(solver))
    for words in map(str.split, Path(path).read_text(encoding="utf-8").splitlines()):
        if not words or words[0].startswith("#"):
            continue
        values = [float(word) for word in words[-9 if words[0] == "EDGE_SE2" else -3 :]]
        if words[0] == "VERTEX_SE2":
            vertex = g2o.VertexSE2()
            vertex.set_id(int(words[1]))
            vertex.set_estimate(g2o.SE2(*values))
            vertex.set_fixed(not len(optimizer.vertices()))
            optimizer.add_vertex(vertex)
        elif words[0] == "EDGE_SE2":
            edge = g2o.EdgeSE2()
            for end in (0, 1):
                edge.set_vertex(end, optimizer.vertex(int(words[1 + end])))
            edge.set_measurement(g2o.SE2(*values[:3]))
            information = np.zeros((3, 3))
            information[np.triu_indices(3)] = values[3:]
            edge.set_information(information + np.triu(information, 1).T)
            optimizer.add_edge(edge)
    optimizer.initialize_optimization()
    optimizer.optimize(ITERATIONS)
    return {
        "vertices": len(optimizer.vertices()),
        "factors": len(optimizer.edges()),
        "error": optimizer.active_chi2() / 2,
    }


RUNS: dict[str, Callable[..., dict[str, float]]] = {
    "steps": steps,
    "gtsam-lm": gtsam_lm,
    "gtsam-isam2": gtsam_isam2,
    "g2o-lm": g2o_lm,
}

if __name__ == "__main__":
    name, *arguments = sys.argv[1:]
    sys.stdout.write(json.dumps(RUNS[name](*arguments)))
