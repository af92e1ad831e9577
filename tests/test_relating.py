"""How two frames relate: what agrees in pairs, and the rigid move that it determines."""

import numpy as np

from graphslam.geometry import transform
from graphslam.relating import largest, registered


def test_a_rigid_move_is_recovered_and_its_covariance_is_honest():
    """Over many draws: normalised errors have the variance of chi-square with 3 dof."""
    rng = np.random.default_rng(0)
    true, sigma, d2 = np.array([1.0, -2.0, 2.5]), 0.05, []
    q = rng.uniform(-3, 3, (6, 2))
    variance = sigma**2 * np.array([1.0, 4.0, 1.0, 1.0, 9.0, 1.0])
    exact, _ = registered(transform(true, q), q, variance)
    np.testing.assert_allclose(exact, true, atol=1e-12)
    for _ in range(300):
        p = transform(true, q) + np.sqrt(variance)[:, None] * rng.normal(size=q.shape)
        found, cov = registered(p, q, variance)
        off = found - true
        d2.append(off @ np.linalg.solve(cov, off))
    # scaled up where residuals are large by chance: below 3, and not far below
    assert 2.0 < np.mean(d2) < 3.3


def test_the_largest_set_is_found_among_pairs_that_agree_by_chance():
    """Twelve that all agree, hidden among sixty with a third of all pairs."""
    rng = np.random.default_rng(0)
    for _ in range(5):
        agree = np.triu(rng.random((60, 60)) < 0.33, 1)
        hidden = np.sort(rng.choice(60, 12, replace=False))
        agree |= agree.T
        agree[np.ix_(hidden, hidden)] = True
        np.fill_diagonal(agree, False)
        np.testing.assert_array_equal(largest(agree, np.ones(60)), hidden)
