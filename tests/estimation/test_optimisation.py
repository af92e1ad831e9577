"""Optimisation under kernels: to the minimum in few steps, and by damping where steps fail."""

import gtsam
import numpy as np
import pytest

from graphslam.core.config import RobustConfig
from graphslam.core.records import Closure, Motion
from graphslam.estimation.optimisation import is_wide, optimise, reweighted

CAUCHY = RobustConfig("cauchy", 2.0)


def kernel_graph(seed, rounds=6, side=10):
    """Rounds of a square with closures, of which a fifth are wrong; the start is off by some dm."""
    rng = np.random.default_rng(seed)
    sigmas = np.array([0.05, 0.05, 0.02])
    plain = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY.scale)
    robust = gtsam.noiseModel.Robust.Create(kernel, plain)
    true = [gtsam.Pose2(0.0, 0.0, 0.0)]
    for k in range(1, 4 * side * rounds):
        turn = np.pi / 2 if k % side == 0 else 0.0
        true.append(true[-1].compose(gtsam.Pose2(1.0, 0.0, turn)))
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose2(0, true[0], plain))
    start.insert(0, true[0])
    for k in range(1, len(true)):
        start.insert(k, true[k].compose(gtsam.Pose2(*(4 * sigmas * rng.normal(size=3)))))
        for last, noise in ((k - 1, plain), (k - 4 * side, robust)):
            if last >= 0:
                wrong = 10.0 if noise is robust and rng.uniform() < 0.2 else 1.0
                error = gtsam.Pose2(*(wrong * sigmas * rng.normal(size=3)))
                z = true[last].between(true[k]).compose(error)
                graph.add(gtsam.BetweenFactorPose2(last, k, z, noise))
    return graph, start


def counted(graph):
    """The graph with a count of how often it was made linear."""

    class Counted:
        count = 0

        def linearize(self, values):
            self.count += 1
            return graph.linearize(values)

        def error(self, values):
            return graph.error(values)

    return Counted()


def test_extrapolated_steps_end_nearer_to_the_minimum_after_fewer_of_them():
    """Weights converge linearly: undamped steps need more, and stop farther away. Without
    extrapolation both are equal; extrapolated too far, the error would be larger."""
    for seed in range(3):
        graph, start = kernel_graph(seed)
        parameters = gtsam.GaussNewtonParams()
        parameters.setRelativeErrorTol(1e-6)
        parameters.setAbsoluteErrorTol(1e-9)
        plain = gtsam.GaussNewtonOptimizer(graph, start, parameters)
        walked, one = plain.optimize(), counted(graph)
        found, _, is_done = reweighted(one, start, 1e-6)
        parameters.setRelativeErrorTol(1e-14)
        least = gtsam.GaussNewtonOptimizer(graph, found, parameters).optimize()
        assert is_done
        assert one.count < plain.iterations()
        assert graph.error(least) <= graph.error(found) <= graph.error(walked)
        assert least.localCoordinates(found).norm() < least.localCoordinates(walked).norm()


def test_a_step_that_cholesky_loses_is_found_by_qr():
    """A stiff path that little holds: its information spans 14 decades, more than Cholesky has."""
    graph, start, rng = gtsam.NonlinearFactorGraph(), gtsam.Values(), np.random.default_rng(0)
    stiff, loose = (gtsam.noiseModel.Isotropic.Sigma(3, sigma) for sigma in (1e-6, 10.0))
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), loose))
    for k in range(40):
        start.insert(k, gtsam.Pose2(k + rng.normal(0, 0.1), *rng.normal(0, 0.1, 2)))
        if k:
            graph.add(gtsam.BetweenFactorPose2(k - 1, k, gtsam.Pose2(1.0, 0.0, 0.0), stiff))
    with pytest.raises(RuntimeError):
        graph.linearize(start).optimize()
    found, _, is_done = reweighted(graph, start, 1e-6)
    assert is_done
    assert graph.error(found) < 1e-6  # of 1e12 at first


def test_a_step_that_raises_the_error_is_not_taken():
    """From far off a Gauss-Newton step leads astray: the values so far come back, not converged,
    and `optimise` goes on with damping."""
    graph, _ = kernel_graph(0)
    rng, far = np.random.default_rng(1), gtsam.Values()
    for k in range(240):
        far.insert(k, gtsam.Pose2(*(np.array([30.0, 30.0, 3.0]) * rng.normal(size=3))))
    found, _, is_done = reweighted(graph, far, 1e-6)
    assert not is_done
    assert graph.error(found) <= graph.error(far)
    assert graph.error(optimise(graph, far, CAUCHY)) < graph.error(found)


def test_a_direction_that_a_closure_leaves_open_does_not_make_information_wide():
    """The motions determine its states as well. A motion that is so uncertain does, and so does a
    closure that is weak in every direction."""

    def moved(variances):
        return Motion(0, 1, np.zeros(3), np.diag(variances), np.zeros((3, 0)), 0.0)

    def closed(variances):
        return Closure("a", 1, "a", 0, np.zeros(3), np.diag(variances))

    sure, opened, weak = [1e-8, 1e-6, 1e-8], [25.0, 1e-4, 1e-4], [25.0, 25.0, 25.0]
    assert not is_wide([moved(sure)], [closed(opened)])
    assert is_wide([moved(sure), moved(opened)], [])
    assert is_wide([moved(sure)], [closed(weak)])
    assert not is_wide([], [])
