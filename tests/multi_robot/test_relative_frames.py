"""How two frames relate: what agrees in pairs, and the rigid move that it determines."""

import numpy as np

from graphslam.core.consistency import fit_rigid_transform, greedy_max_clique
from graphslam.core.geometry import transform


def test_a_rigid_move_is_recovered_and_its_covariance_is_honest():
    """Over many draws: normalised errors have the variance of chi-square with 3 dof."""
    rng = np.random.default_rng(0)
    true, sigma, d2 = np.array([1.0, -2.0, 2.5]), 0.05, []
    q = rng.uniform(-3, 3, (6, 2))
    variance = sigma**2 * np.array([1.0, 4.0, 1.0, 1.0, 9.0, 1.0])
    exact, _ = fit_rigid_transform(transform(true, q), q, variance)
    np.testing.assert_allclose(exact, true, atol=1e-12)
    for _ in range(300):
        p = transform(true, q) + np.sqrt(variance)[:, None] * rng.normal(size=q.shape)
        found, cov = fit_rigid_transform(p, q, variance)
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
        np.testing.assert_array_equal(greedy_max_clique(agree, np.ones(60)), hidden)


def test_the_largest_set_that_agrees_in_pairs():
    """Of two sets the larger one, though what has most links leads to the other."""
    agree = np.zeros((11, 11), dtype=bool)
    agree[:4, :4] = agree[4:10, 4:10] = True
    agree[10, :7] = agree[:7, 10] = True
    np.fill_diagonal(agree, False)
    np.testing.assert_array_equal(greedy_max_clique(agree, np.ones(11)), range(4, 10))
    assert greedy_max_clique(np.zeros((0, 0), dtype=bool), np.ones(0)).shape == (0,)


def test_of_two_sets_that_agree_the_one_that_is_worth_more_is_taken():
    """Two landmarks seen again and again, against three sightings."""
    agree = np.zeros((5, 5), dtype=bool)
    agree[:2, :2] = agree[2:, 2:] = True
    np.fill_diagonal(agree, False)
    np.testing.assert_array_equal(
        greedy_max_clique(agree, np.array([2.0, 2.0, 1.0, 1.0, 1.0])), [0, 1]
    )
