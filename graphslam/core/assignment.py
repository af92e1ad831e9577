"""One-to-one assignment at the least cost."""

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import min_weight_full_bipartite_matching

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array


def cheapest_assignment(cost: Array, alone: Array) -> tuple[IntArray, IntArray]:
    """Rows and columns that go together, each at most once, so that the sum of costs is least.

    Args:
        cost: (n, m) of pairs, inf where a pair is impossible.
        alone: (n,) finite, of rows that get no column.

    Returns:
        Numbers of the rows (k,), sorted, and of their columns (k,).
    """
    n, m = cost.shape
    if not n:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    # a column per row stands for "none", so that each row has one; SciPy's assignment of sparse
    # tables leaves out what is impossible, and loads in a tenth of the time of that of dense ones
    table = np.concatenate([cost, np.full((n, n), np.inf)], axis=1)
    table[np.arange(n), m + np.arange(n)] = alone
    possible = np.isfinite(table)
    columns = possible.nonzero()[1]
    weights = table[possible]
    weights += 1.0 - weights.min()  # one of zero would be no edge
    ends = np.concatenate([[0], possible.sum(axis=1).cumsum()])
    rows, chosen = min_weight_full_bipartite_matching(
        csr_matrix((weights, columns, ends), shape=table.shape)
    )
    is_pair = chosen < m
    return rows[is_pair], chosen[is_pair]
