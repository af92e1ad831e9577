"""One-to-one assignment at the least cost."""

import numpy as np
from scipy.sparse import coo_matrix
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
    # a column per row stands for "none", so that each row has one; SciPy's assignment of sparse
    # tables leaves impossible pairs out, and its module is one that is loaded anyway
    rows, columns = np.nonzero(np.isfinite(cost))
    each = np.arange(n)
    table = np.concatenate([cost[rows, columns], alone])
    table += 1.0 - table.min(initial=0.0)  # a weight of zero would be no edge
    ends = np.append(rows, each), np.append(columns, m + each)
    chosen = min_weight_full_bipartite_matching(coo_matrix((table, ends), shape=(n, m + n)).tocsr())
    is_pair = chosen[1] < m
    return chosen[0][is_pair], chosen[1][is_pair]
