"""A joint Gaussian of many variables, kept as a sparse triangular root of its information.

Of the joint only the conditional of each variable given some of those before it is kept: with the
same sets of parents no sparse root is nearer to the joint (F. Schäfer, M. Katzfuss and H. Owhadi,
Sparse Cholesky factorization by Kullback-Leibler minimization, SIAM J. Sci. Comput. 43, 2021,
DOI 10.1137/20M1336254). What is left out could make it overconfident in some direction. So it is
widened as a whole, by the largest variance that any combination of its whitened residuals has under
the joint: its information is then nowhere larger than that of the joint.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import cholesky, eigh

from graphslam.core.geometry import Array
from graphslam.core.known_landmarks import SparseRoot

#: parents of a variable at first and at most, and by how much the whole may be widened before they
#: are doubled. What a map is widened by each day multiplies: that of ten days stays below 3
PARENTS, MOST_PARENTS, MAX_WIDENING = 16, 128, 1.1


def sparse_root(cov: Array, dims: Sequence[int]) -> SparseRoot:
    """A sparse root of a joint Gaussian, nowhere more certain than the joint.

    Args:
        cov: (D, D) joint covariance, positive definite.
        dims: of the n variables; the less neighbours in this order have in common with the rest
            given each other, the less is neglected.
    """
    if not len(dims):
        return SparseRoot((), (), 1.0)
    count = PARENTS
    while True:
        found = _root(cov, dims, count)
        if found.widening <= MAX_WIDENING or count >= min(len(dims) - 1, MOST_PARENTS):
            return found
        count *= 2


def _root(cov: Array, dims: Sequence[int], count: int) -> SparseRoot:
    ends = np.cumsum(dims)
    places = [np.arange(end - dim, end) for end, dim in zip(ends, dims, strict=True)]
    shared = _partial_correlations(cov, dims)
    parents: list[tuple[int, ...]] = []
    rows: list[Array] = []
    A = np.zeros(cov.shape)  # all rows, to see what is neglected
    for k, own in enumerate(places):
        chosen = tuple(np.argsort(-shared[k, :k], kind="stable")[:count].tolist())
        others = np.concatenate([np.zeros(0, dtype=np.int64), *(places[n] for n in chosen)])
        row = _conditional(cov, own, others)
        A[np.ix_(own, np.concatenate([own, others]))] = row
        parents.append(chosen)
        rows.append(row)
    neglected = A @ cov @ A.T
    last = len(cov) - 1
    neglected = 0.5 * (neglected + neglected.T)
    (widening,) = eigh(neglected, eigvals_only=True, subset_by_index=[last, last], driver="evx")
    widening = max(float(widening), 1.0)
    scaled = tuple(row / np.sqrt(widening) for row in rows)
    return SparseRoot(tuple(parents), scaled, widening)


def _conditional(cov: Array, own: Array, others: Array) -> Array:
    """Whitened rows of some variables (d of them) given others: (d, d + e)."""
    B = np.linalg.solve(cov[np.ix_(others, others)], cov[np.ix_(others, own)]).T
    D = cov[np.ix_(own, own)] - B @ cov[np.ix_(others, own)]
    # upper triangular R with R'R = D⁻¹
    R = cholesky(np.linalg.inv(0.5 * (D + D.T)))
    return np.asarray(np.hstack([R, -R @ B]))


def _partial_correlations(cov: Array, dims: Sequence[int]) -> Array:
    """How much a variable k tells about another one given all others before k: (n, n), squared.

    Not how much they tell of each other alone: in a map whose place in the world is known badly all
    landmarks do that, wherever they are.
    """
    ends = np.cumsum(dims)
    starts = ends - np.asarray(dims)
    # rows take each variable, given all before it, to white noise
    A = np.linalg.inv(np.linalg.cholesky(cov))
    scaled = A.copy()
    for start, end in zip(starts, ends, strict=True):
        block = A[:, start:end]
        scaled[:, start:end] = block @ np.linalg.cholesky(np.linalg.inv(block.T @ block))
    squared = scaled**2
    return np.asarray(np.add.reduceat(np.add.reduceat(squared, starts, axis=0), starts, axis=1))
