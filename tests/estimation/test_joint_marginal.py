"""Joint marginals of a few variables where Cholesky decomposition fails."""

import gtsam
import numpy as np
import pytest

from graphslam.estimation.optimisation import JointMarginals


def chain(prior_sigma, motion_sigma, n=40):
    """A straight chain of poses behind a prior."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Isotropic.Sigma
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), noise(3, prior_sigma)))
    for k in range(n):
        values.insert(k, gtsam.Pose2(float(k), 0.0, 0.0))
        if k:
            motion = gtsam.Pose2(1.0, 0.0, 0.0)
            graph.add(gtsam.BetweenFactorPose2(k - 1, k, motion, noise(3, motion_sigma)))
    return graph, values


def fails(*_):
    raise RuntimeError("Cholesky")


def test_it_is_that_of_cholesky_where_that_works(monkeypatch):
    graph, values = chain(0.1, 0.02)
    keys = [20, 7, 39]
    wanted = gtsam.Marginals(graph, values).jointMarginalCovariance(keys).fullMatrix()
    np.testing.assert_allclose(JointMarginals(graph, values).of(keys), wanted, rtol=1e-12)
    monkeypatch.setattr(gtsam, "Marginals", fails)
    np.testing.assert_allclose(JointMarginals(graph, values).of(keys), wanted, rtol=1e-8)


def test_it_is_right_where_cholesky_is_not():
    """The information of the motions has eighteen digits more than that of the prior."""
    graph, values = chain(1e3, 1e-6)
    with pytest.raises(RuntimeError):
        gtsam.Marginals(graph, values).marginalCovariance(39)
    found = JointMarginals(graph, values).of([39])
    # that of the prior, 39 m away from what it is of
    assert np.sqrt(found.diagonal()) == pytest.approx([1e3, 1e3 * np.hypot(1, 39), 1e3], rel=1e-3)


def test_what_nothing_tells_is_no_covariance():
    graph, values = chain(1.0, 1.0)
    graph.remove(0)
    with pytest.raises(RuntimeError):
        JointMarginals(graph, values).of([5])
