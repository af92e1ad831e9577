"""What an earlier map says of its landmarks."""

import numpy as np

from graphslam.core.geometry import compose, exp
from graphslam.core.known_landmarks import KnownLandmarks
from graphslam.core.sparse_gaussian import sparse_root


def test_a_landmark_given_the_others_is_that_of_the_joint_gaussian():
    """Of two walls and a point, by the formula for conditional Gaussians in a dense covariance."""
    rng = np.random.default_rng(1)
    means = {4: np.array([1.0, 2.0, 0.3]), 9: np.array([3.0, -1.0]), 2: np.array([0.0, 1.0, 2.0])}
    slices = {4: slice(0, 3), 9: slice(3, 5), 2: slice(5, 8)}
    A = 0.1 * rng.normal(size=(8, 8))
    cov = A @ A.T + 1e-3 * np.eye(8)
    # with all parents nothing is left out
    known = KnownLandmarks(means, tuple(means), sparse_root(cov, [3, 2, 3]))
    error = 0.05 * rng.normal(size=8)
    placed = {
        n: (m + error[slices[n]] if len(m) == 2 else compose(m, exp(error[slices[n]])), np.eye(2))
        for n, m in means.items()
    }
    for n, (off, own) in known.given_the_others(placed).items():
        i = np.arange(8)[slices[n]]
        others = np.setdiff1d(np.arange(8), i)
        gain = cov[np.ix_(i, others)] @ np.linalg.inv(cov[np.ix_(others, others)])
        np.testing.assert_allclose(off, gain @ error[others] - error[i], rtol=0, atol=1e-9)
        left = cov[np.ix_(i, i)] - gain @ cov[np.ix_(others, i)]
        np.testing.assert_allclose(own, known.root.widening * left, rtol=1e-6)
