"""Assignment at the least cost, against all assignments that there are."""

import itertools

import numpy as np
import pytest

from graphslam.core.assignment import cheapest_assignment


def cheapest_of_all(cost, alone):
    """The least sum: each row takes a column that no other takes, or none."""
    n, m = cost.shape
    return min(
        sum(alone[i] if j is None else cost[i, j] for i, j in enumerate(columns))
        for columns in itertools.product([None, *range(m)], repeat=n)
        if len({j for j in columns if j is not None}) == sum(j is not None for j in columns)
    )


@pytest.mark.parametrize("n, m", [(1, 1), (2, 3), (4, 2), (4, 4)])
def test_no_assignment_costs_less(n, m):
    """Also with pairs that are impossible, cost less than nothing, or more than none."""
    rng = np.random.default_rng(10 * n + m)
    for _ in range(50):
        cost = rng.choice([0.0, -0.5, *rng.uniform(0.0, 2.0, 4), np.inf], (n, m))
        alone = rng.uniform(0.0, 1.5, n)
        rows, columns = cheapest_assignment(cost, alone)
        assert rows.tolist() == sorted(set(rows.tolist()))
        assert len(set(columns.tolist())) == len(columns)
        without = np.setdiff1d(np.arange(n), rows)
        found = cost[rows, columns].sum() + alone[without].sum()
        # rounding of sums of up to four numbers of the order of 1
        assert found == pytest.approx(cheapest_of_all(cost, alone), abs=1e-12)


@pytest.mark.parametrize("shape", [(0, 0), (0, 3), (3, 0)])
def test_nothing_goes_with_nothing(shape):
    rows, columns = cheapest_assignment(np.zeros(shape), np.ones(shape[0]))
    assert len(rows) == len(columns) == 0


def test_rows_without_a_possible_pair_stay_alone():
    rows, columns = cheapest_assignment(
        np.array([[np.inf, np.inf], [1.0, np.inf]]), np.full(2, 9.0)
    )
    assert (rows.tolist(), columns.tolist()) == ([1], [0])
