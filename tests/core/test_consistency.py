"""Consistent sets, rivals, rigid fits and least squares with correlated errors."""

import numpy as np
import pytest

from graphslam.core.consistency import (
    distances_from_others,
    fit_rigid_transform,
    generalised_least_squares,
    greedy_max_clique,
    has_rival,
    leave_one_out,
    leave_one_out_distances,
)
from graphslam.core.errors import EstimationError
from graphslam.core.frame_forest import grow_frame_forest
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


@pytest.mark.filterwarnings("error")
def test_coincident_points_tell_where_something_is_and_no_direction():
    """All points at one place up to rounding, where the inverse of their spread overflows: the
    heading is unknown, and nothing but that is said."""
    q = np.full((3, 2), 2.0) + 1e-160 * np.arange(6).reshape(3, 2)
    for points in (q, np.array([[1e-160, 0.0], [0.0, 0.0], [0.0, 1e-160]])):
        pose, cov = fit_rigid_transform(points + 1.0, points, np.full(3, 0.01))
        assert np.isfinite(pose).all()
        assert np.isinf(cov[2, 2])


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


def test_leave_one_out_distances_are_those_of_the_conditional_gaussian():
    """Each of five correlated residuals against what the other four say of it."""
    rng = np.random.default_rng(1)
    L, r = rng.normal(size=(15, 15)), rng.normal(size=(5, 3))
    S = L @ L.T
    found = leave_one_out_distances(np.linalg.inv(S), r)
    for k in range(5):
        own, rest = np.arange(3 * k, 3 * k + 3), np.delete(np.arange(15), range(3 * k, 3 * k + 3))
        gain = np.linalg.solve(S[np.ix_(rest, rest)], S[np.ix_(rest, own)]).T
        innovation = r[k] - gain @ r.ravel()[rest]
        cov = S[np.ix_(own, own)] - gain @ S[np.ix_(rest, own)]
        np.testing.assert_allclose(found[k], innovation @ np.linalg.solve(cov, innovation))


def test_distances_from_others_are_those_of_the_solution_without_each():
    """Of a least-squares solution of measurements of unequal leverage; against solving it again
    without each of them, which is exact to rounding. Residuals alone hide what has leverage."""
    rng = np.random.default_rng(3)
    n, d, inflation = 6, 3, 16.0
    H = rng.normal(size=(n, d, 4))
    H[0, :, 3] += 30.0  # the others hardly tell the last unknown
    root = rng.normal(size=(n, d, d)) + 2.0 * np.eye(d)
    R = 0.01 * root @ root.mT
    z = rng.normal(size=(n, d))
    prior = 1e-2 * np.eye(4)

    def solved(which):
        N = prior + sum(H[k].T @ np.linalg.solve(R[k], H[k]) for k in which)
        y = sum(H[k].T @ np.linalg.solve(R[k], z[k]) for k in which)
        return np.linalg.solve(N, y), np.linalg.inv(N)

    x, P = solved(range(n))
    found = distances_from_others(H @ x - z, R, H @ P @ H.mT, inflation)
    for k in range(n):
        x, P = solved([m for m in range(n) if m != k])
        off, S = H[k] @ x - z[k], inflation * H[k] @ P @ H[k].T + R[k]
        assert found[k] == pytest.approx(off @ np.linalg.solve(S, off), rel=1e-9)


def test_where_others_say_nothing_nothing_contradicts_a_measurement():
    """A start alone: the solution lies on it, to rounding, and is as well known as it says."""
    R = np.diag([4.0, 1e-4, 1e-6])[None]
    assert distances_from_others(np.full((1, 3), 1e-9), R, R * (1 + 1e-12))[0] == 0.0


@pytest.mark.parametrize("of", ["innovation", "covariance"])
def test_measurements_that_are_not_numbers_are_an_error(of, monkeypatch):
    """None of them is the worst, so none would ever be removed. Three can be removed twice."""
    r, S, calls = np.zeros((3, 3)), np.eye(9), []

    def ends(*given):
        calls.append(given)
        assert len(calls) < 3, "it does not end"
        return leave_one_out_distances(*given)

    monkeypatch.setattr("graphslam.core.consistency.leave_one_out_distances", ends)
    if of == "innovation":
        r[1, 2] = np.nan
    else:
        S[0, 5] = S[5, 0] = np.nan
    with pytest.raises(EstimationError, match="3 measurements cannot be compared"):
        leave_one_out(np.arange(3), r, S, 0.99)


def test_least_squares_with_correlated_rows_and_a_prior():
    """The prior does what the same rows would, and the covariance grows with the residuals."""
    rng = np.random.default_rng(2)
    A, x, L = rng.normal(size=(8, 3)), rng.normal(size=3), rng.normal(size=(8, 8))
    S = L @ L.T
    exact = generalised_least_squares(A, A @ x, S)
    np.testing.assert_allclose(exact.x, x)
    assert exact.scale == 1.0
    b, prior = A @ x + 3.0 * L @ rng.normal(size=8), np.diag([4.0, 1.0, 0.25])
    fit = generalised_least_squares(A, b, S, prior, prior @ x)
    rows = np.vstack([A, np.eye(3)])
    both = np.block([[S, np.zeros((8, 3))], [np.zeros((3, 8)), np.linalg.inv(prior)]])
    np.testing.assert_allclose(fit.x, generalised_least_squares(rows, np.append(b, x), both).x)
    assert fit.scale > 1.0
    np.testing.assert_allclose(
        fit.cov / fit.scale, np.linalg.inv(A.T @ np.linalg.solve(S, A) + prior)
    )


def test_a_rival_has_more_than_its_share_of_the_support():
    assert has_rival(10.0, [1.0, 5.1])
    assert not has_rival(10.0, [5.0])
    assert not has_rival(10.0, [5.1], 0.7)
    assert not has_rival(10.0, [])


def test_robots_are_placed_along_relations_and_else_in_frames_of_their_own():
    """d hangs on c, which nothing relates to a and b: the frame is c's."""
    edges = {"b": ("a", 2.0), "d": ("c", 5.0)}

    def next_edge(placed):
        return next(
            (
                (robot, parent, placed[parent] + step)
                for robot, (parent, step) in edges.items()
                if robot not in placed and parent in placed
            ),
            None,
        )

    placed, frames = grow_frame_forest("abcd", {"a": 1.0}, "a", 0.0, next_edge)
    assert placed == {"a": 1.0, "b": 3.0, "c": 0.0, "d": 5.0}
    assert frames == {"a": "a", "b": "a", "c": "c", "d": "c"}
