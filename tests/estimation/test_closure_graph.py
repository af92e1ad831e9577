"""Covariances of the ends of candidate closures, in the solution or not."""

import tracemalloc

import gtsam
import numpy as np
import pytest

from graphslam.core.config import RobustConfig
from graphslam.core.geometry import between, compose
from graphslam.core.records import Closure, Motion, Start, Step
from graphslam.estimation.closure_graph import ClosureGraph
from graphslam.estimation.initial_estimate import initial_estimate

COV = np.diag([0.03, 0.03, 0.01]) ** 2


def drive(states, pairs, rng):
    """A robot that goes round and round, and closures of pairs of its states."""
    step = np.array([1.0, 0.0, 0.2])
    poses = [np.zeros(3)]
    steps = [Step(0, {"a": Start(poses[0], COV)})]
    for k in range(1, states):
        delta = step + rng.normal(0, [0.03, 0.03, 0.01])
        steps.append(Step(k, {}, {"a": Motion(k - 1, k, delta, COV, np.zeros((3, 0)), 1.0)}))
        poses.append(compose(poses[-1], step))
    closures = [Closure("a", b, "a", a, between(poses[a], poses[b]), COV) for a, b in pairs]
    start = initial_estimate(steps, closures)
    return steps, ClosureGraph(steps, start, closures, RobustConfig("none"))


@pytest.mark.parametrize("used", [(), (0, 3), range(8)])
def test_covariances_are_those_of_the_graph_without_what_is_not_used(used):
    """Against GTSAM's of the same graph, to rounding; a pair of states may be there twice."""
    rng = np.random.default_rng(4)
    pairs = [tuple(sorted(rng.choice(40, 2, replace=False).tolist())) for _ in range(7)]
    pairs.append(pairs[0])
    steps, graph = drive(40, pairs, rng)
    graph.solve(used, robust=False, rough=False)
    x, y, joint = graph.ends()
    poses = graph.estimate().states["a"].poses
    np.testing.assert_allclose(x, [poses[a] for a, _ in pairs], atol=1e-12)
    np.testing.assert_allclose(y, [poses[b] for _, b in pairs], atol=1e-12)
    noise, nonlinear = gtsam.noiseModel.Gaussian.Covariance(COV), gtsam.NonlinearFactorGraph()
    nonlinear.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), noise))
    for k, step in enumerate(steps[1:]):
        moved = gtsam.Pose2(*step.motions["a"].delta)
        nonlinear.add(gtsam.BetweenFactorPose2(k, k + 1, moved, noise))
    values = gtsam.Values()
    for k, pose in enumerate(poses):
        values.insert(k, gtsam.Pose2(*pose))
    for k in used:
        a, b = pairs[k]
        moved = values.atPose2(a).between(values.atPose2(b))
        nonlinear.add(gtsam.BetweenFactorPose2(a, b, moved, noise))
    marginals = gtsam.Marginals(nonlinear, values)
    for (a, b), found in zip(pairs, joint, strict=True):
        expected = marginals.jointMarginalCovariance([a, b]).fullMatrix()
        # the measured pose is that of the estimate here, and of the log there: 3 cm in 10 m
        np.testing.assert_allclose(found, expected, rtol=1e-2, atol=1e-2 * expected.max())


def test_candidates_that_are_not_used_do_not_fill_the_root():
    """Of 1500 states in a row, with 400 candidates of any two of them: a peak (tracemalloc) of 3
    MB. Breaks if they are made part of the pattern, whose cliques then grow with them: 17 MB."""
    rng = np.random.default_rng(5)
    pairs = [tuple(sorted(rng.choice(1500, 2, replace=False).tolist())) for _ in range(400)]
    _, graph = drive(1500, pairs, rng)
    graph.solve((), robust=False)
    tracemalloc.start()
    graph.ends()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 7e6
