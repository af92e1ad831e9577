"""Square root information on stacked variables: whitened rows, and their elimination by GTSAM.

GTSAM's QR is given two variables, the eliminated ones stacked and the others stacked, so that one
dense factorisation does what one per variable would do, in a small part of the time.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from graphslam.core.geometry import Array

IntArray = np.ndarray[tuple[int], np.dtype[np.int64]]
#: a coefficient below this part of the largest one of its rows is rounding
NEGLIGIBLE = 1e-13
#: the order that eliminates the first of two stacked variables
_FIRST = gtsam.Ordering([0])


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Rows A z = b + noise of unit covariance: A (m, D), b (m,).

    ``dims``: the dimension of each variable by its key, in the order of the columns.
    """

    dims: Mapping[int, int]
    A: Array
    b: Array


@dataclass(frozen=True, slots=True, eq=False)
class Conditional:
    """R z = d - S y + noise of unit covariance: variables z given others y.

    R (n, n) is upper triangular, S (n, p). ``dims`` and ``given``: dimensions by key, in order.
    """

    dims: Mapping[int, int]
    given: Mapping[int, int]
    R: Array
    S: Array
    d: Array

    def rows(self) -> Rows:
        """The same as rows of all its variables."""
        return Rows({**self.dims, **self.given}, np.hstack([self.R, self.S]), self.d)


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
    graph = gtsam.GaussianFactorGraph()
    graph.push_back(gtsam.JacobianFactor(0, A, b, gtsam.noiseModel.Unit.Create(len(b))))
    made, _ = gtsam.EliminateQR(graph, _FIRST)
    R, d = made.R().copy(), made.d().copy()  # views of what `made` owns
    return R, d, math.sqrt(max(b @ b - d @ d, 0.0))  # QR keeps the length of b


def eliminate(rows: Rows, count: int) -> tuple[Conditional, Rows]:
    """Eliminate the first ``count`` variables: what determines them given the others, and the rest.

    The rest ends in a row without coefficients: what no estimate can make smaller.

    Raises:
        RuntimeError: there are too few rows to determine them.
    """
    keys = list(rows.dims)
    dims = {key: rows.dims[key] for key in keys[:count]}
    given = {key: rows.dims[key] for key in keys[count:]}
    if not given:
        R, d, lost = triangular(rows.A, rows.b)
        nothing = Rows({}, np.zeros((1, 0)), np.array([lost]))
        return Conditional(dims, given, R, np.zeros((len(R), 0)), d), nothing
    n, unit = sum(dims.values()), gtsam.noiseModel.Unit.Create(len(rows.b))
    graph = gtsam.GaussianFactorGraph()
    graph.push_back(gtsam.JacobianFactor(0, rows.A[:, :n], 1, rows.A[:, n:], rows.b, unit))
    made, rest = gtsam.EliminateQR(graph, _FIRST)
    R, S, d = made.R().copy(), made.S().copy(), made.d().copy()
    A, b = np.zeros((1, S.shape[1])), np.zeros(1)
    if not rest.empty():
        left, of = rest.jacobian()
        A, b = np.vstack([left, A]), np.append(of, b)
    b[-1] = math.sqrt(max(rows.b @ rows.b - d @ d - b @ b, 0.0))
    return Conditional(dims, given, R, S, d), Rows(given, A, b)


def pruned(conditional: Conditional) -> Conditional:
    """Without the variables that it depends on by rounding only."""
    if not conditional.given:
        return conditional
    limit = NEGLIGIBLE * np.abs(conditional.R).max()
    starts = [at.start for at in column_slices(conditional.given).values()]
    largest = np.maximum.reduceat(np.abs(conditional.S).max(axis=0), starts)
    keys = list(conditional.given)
    given = {keys[n]: conditional.given[keys[n]] for n in np.flatnonzero(largest > limit)}
    if len(given) == len(keys):
        return conditional
    kept = columns_of(given, column_slices(conditional.given))
    return Conditional(
        conditional.dims, given, conditional.R, conditional.S[:, kept], conditional.d
    )
