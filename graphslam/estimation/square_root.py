"""Square root information on stacked variables: whitened rows, and their elimination.

The eliminated variables are stacked, and so are the others, so that one dense factorisation (QR, by
GTSAM or LAPACK) does what one per variable would do, in a small part of the time.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg.lapack import dgeqrf, dtpmqrt, dtpqrt

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array

#: the order that eliminates the first of two stacked variables
_FIRST = gtsam.Ordering([0])
#: columns that LAPACK eliminates at a time
_PANEL = 16
#: columns per block of LAPACK's QR of a whole matrix
_QR_BLOCK = 32


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Rows A z = b + noise of unit covariance: A (m, D), b (m,).

    ``dims``: the dimension of each variable by its key, in the order of the columns.
    """

    dims: Mapping[int, int]
    A: Array
    b: Array


def column_slices(dims: Mapping[int, int]) -> dict[int, slice]:
    """Key -> its columns."""
    slices, end = {}, 0
    for key, dim in dims.items():
        slices[key] = slice(end, end + dim)
        end += dim
    return slices


def columns_of(keys: Iterable[int], slices: Mapping[int, slice]) -> IntArray:
    """Indices (d,) of the columns of ``keys``, in this order."""
    out: list[int] = []
    for key in keys:
        at = slices[key]
        out.extend(range(at.start, at.stop))
    return np.array(out, dtype=np.int64)


def stacked(parts: Sequence[Rows], dims: Mapping[int, int]) -> Rows:
    """All rows of all parts, with columns in the order of ``dims``, which has every variable."""
    slices = column_slices(dims)
    A = np.zeros((sum(len(part.b) for part in parts), sum(dims.values())))
    end = 0
    for part in parts:
        begin, end = end, end + len(part.b)
        A[begin:end, columns_of(part.dims, slices)] = part.A
    return Rows(dims, A, np.concatenate([part.b for part in parts]) if parts else np.zeros(0))


def triangular(A: Array, b: Array) -> tuple[Array, Array, float]:
    """R (n, n) upper triangular and d (n,): R z = d says of z what A z = b says.

    Also the length of what no z can make smaller.

    Raises:
        RuntimeError: there are fewer rows than columns.
    """
    m, n = A.shape
    if m < n:
        raise RuntimeError(f"{m} rows for {n} columns")
    both = np.empty((m, n + 1), order="F")
    both[:, :n], both[:, n] = A, b
    # GTSAM's EliminateQR gives the same R up to signs, in nearly twice the time
    made, *_ = dgeqrf(both, lwork=_QR_BLOCK * (n + 1), overwrite_a=1)
    d = made[:n, n].copy()
    return np.triu(made[:n, :n]), d, math.sqrt(max(float(b @ b - d @ d), 0.0))  # b keeps its length


def eliminate_columns(A: Array, b: Array, n: int) -> tuple[Array, Array, Array, Array, Array]:
    """A z = b in two parts, the first n columns and what is left when they are eliminated.

    Returns:
        R (n, n) upper triangular, S and d, of the first columns: R z₁ = d - S z₂.
        A and b of the others. The last row has no coefficients: what no z can make smaller.

    Raises:
        RuntimeError: there are too few rows to determine the first columns.
    """
    if n == A.shape[1]:
        R, d, lost = triangular(A, b)
        return R, np.zeros((n, 0)), d, np.zeros((1, 0)), np.array([lost])
    if n == 0:
        return np.zeros((0, 0)), A[:0], b[:0], A, b
    graph = gtsam.GaussianFactorGraph()
    unit = gtsam.noiseModel.Unit.Create(len(b))
    graph.push_back(gtsam.JacobianFactor(0, A[:, :n], 1, A[:, n:], b, unit))
    made, rest = gtsam.EliminateQR(graph, _FIRST)
    R, S, d = made.R().copy(), made.S().copy(), made.d().copy()
    left = np.zeros((1, S.shape[1])), np.zeros(1)
    if not rest.empty():
        A2, b2 = rest.jacobian()
        left = np.concatenate([A2, left[0]]), np.append(b2, 0.0)
    left[1][-1] = math.sqrt(max(float(b @ b - d @ d - left[1] @ left[1]), 0.0))
    return R, S, d, *left


def eliminate_below(A: Array, b: Array, n: int) -> tuple[Array, Array, Array, Array, Array]:
    """As `eliminate_columns` where the first n rows are triangular already, by LAPACK.

    The m - n other rows then cost what they are, not what all rows would. The rows that are left
    are as many, with what no z can make smaller in all of them.
    """
    right = np.asfortranarray(np.concatenate([A[:, n:], b[:, None]], axis=1))
    if len(b) == n:
        return A[:, :n], right[:, :-1], right[:, -1], right[n:, :-1], right[n:, -1]
    R, V, T, _ = dtpqrt(0, min(n, _PANEL), A[:n, :n], A[n:, :n])
    S, left, _ = dtpmqrt(0, V, T, right[:n], right[n:], trans="T")
    return np.triu(R), S[:, :-1], S[:, -1], left[:, :-1], left[:, -1]


def eliminate(rows: Rows, count: int) -> Rows:
    """The rows that are left when the first ``count`` variables are eliminated.

    Raises:
        RuntimeError: there are too few rows to determine them.
    """
    keys = list(rows.dims)
    n = sum(rows.dims[key] for key in keys[:count])
    *_, A, b = eliminate_columns(rows.A, rows.b, n)
    return Rows({key: rows.dims[key] for key in keys[count:]}, A, b)
