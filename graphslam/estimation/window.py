"""The nonlinear window of a fixed-lag smoother: variables, factors, prior, and its solution.

Every variable is its linearisation point corrected by z, in the tangent space there; all rows are
in terms of z. A factor is linearised anew where one of its variables has moved since, and the
points of variables that the prior involves stay (see `fixed_lag`). GTSAM linearises all these
factors in two calls; the window is solved as one dense matrix, which for a few hundred rows is
quickest.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dpotrf

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.config import RobustConfig
from graphslam.core.geometry import Array
from graphslam.core.records import Association
from graphslam.estimation import factors
from graphslam.estimation.m_estimators import WEIGHTS
from graphslam.estimation.square_root import Rows, column_slices, columns_of, stacked

#: largest number of Gauss-Newton iterations per step, and the norm of the update (m, rad) that ends
#: them. A step starts where the last one ended, so two are the rule.
MAX_ITERATIONS, CONVERGED = 6, 1e-3
#: m, rad: a factor is linearised anew if one of its variables has moved by more. What that leaves
#: out is of second order: a few micrometres at 10 m
RELINEARISE = 1e-3
#: Cholesky is used while no variable's variance exceeds by more what it is given all others: it
#: loses as many digits, and QR half of them
WORST_RATIO = 1e10
IndexArray = np.ndarray[tuple[int, int], np.dtype[np.int64]]
#: columns of a factor's rows: two variables of three, and the right side
_WIDTH = 7


class IndeterminateWindowError(Exception):
    """``key`` is a variable that the window does not determine, if one can be named."""

    def __init__(self, key: int | None) -> None:
        super().__init__(key)
        self.key = key


@dataclass(slots=True, eq=False)
class WindowFactor:
    """A factor of the window and its keys.

    ``observed``: its association with both keys, if any; ``robust``: whether the kernel applies;
    ``rows`` (3, 7): its linearisation A z = b, without the kernel's weight, as [A b], empty places
    zero; None before it is first used.
    """

    factor: gtsam.NonlinearFactor
    keys: tuple[int, ...]
    observed: tuple[int, int, Association] | None = None
    robust: bool = False
    rows: Array | None = None


class Window:
    """Variables in use, the factors between them, and the prior that past states left.

    ``dims`` are the variables, ``values`` their estimates. ``root`` (n, n) is the upper triangular
    square root information of the window that was last optimised, ``slices`` its columns.
    """

    def __init__(self, kernel: RobustConfig) -> None:
        self.factors: list[WindowFactor] = []
        self.prior = Rows({}, np.zeros((0, 0)), np.zeros(0))
        self.dims: dict[int, int] = {}
        self.values = gtsam.Values()
        self.z: dict[int, Array] = {}
        self.root, self.slices = np.zeros((0, 0)), dict[int, slice]()
        self._kernel = kernel
        self._points = gtsam.Values()  # where z is zero
        self._read: dict[int, Array] = {}  # z for which factors were last linearised

    def insert(self, key: int, point: Array, z: Array | None = None) -> None:
        """Insert a variable with its linearisation point and its correction."""
        self.dims[key] = len(point)
        self.z[key] = np.zeros(len(point)) if z is None else z
        self._read[key] = self.z[key]
        factors.write(self._points, key, point)
        factors.write(self.values, key, factors.retracted(point, self.z[key]))

    def remove(self, keys: Iterable[int]) -> None:
        """Forget variables without factors."""
        for key in keys:
            self.values.erase(key)
            self._points.erase(key)
            del self.dims[key], self.z[key], self._read[key]

    def point(self, key: int) -> Array:
        """Linearisation point of a variable."""
        return factors.read(self._points, key, self.dims[key])

    def order(self) -> dict[int, int]:
        """Give all variables their columns, those of the prior first; the variables so ordered."""
        prior = self.prior.dims
        dims = {**prior, **{key: d for key, d in self.dims.items() if key not in prior}}
        self.slices = column_slices(dims)
        return dims

    def optimise(self) -> None:
        """Gauss-Newton on all factors and the prior, from the current estimate.

        Raises:
            IndeterminateWindowError: they do not determine all variables.
        """
        dims = self.order()
        columns = self._columns(self.factors)
        made = [each.rows for each in self.factors]
        rows = np.array([np.zeros((3, _WIDTH)) if each is None else each for each in made])
        rows = rows.reshape(-1, 3, _WIDTH)
        new = np.array([each is None for each in made], dtype=bool)
        robust = np.flatnonzero([each.robust for each in self.factors])
        z = np.concatenate([self.z[key] for key in dims])
        prior_A = np.zeros((len(self.prior.b), len(z) + 1))
        prior_A[:, : self.prior.A.shape[1]], prior_A[:, -1] = self.prior.A, self.prior.b
        prior_H = prior_A.T @ prior_A
        size = math.inf
        for _ in range(MAX_ITERATIONS):
            self._relinearise(rows, columns, z, new)
            weighted = np.sqrt(self._weights(rows, columns, z, robust))[:, None, None] * rows
            H = _normal_equations(weighted, columns, len(z))
            H += prior_H
            root = _cholesky(H[:-1, :-1])
            if root is None:
                root = self._qr(weighted, columns, prior_A)
            before, z = z, dtrsm(1.0, root, dtrsm(1.0, root, H[:-1, -1:], trans_a=1))[:, 0]
            size = float(np.linalg.norm(z - before))
            if not math.isfinite(size):
                raise IndeterminateWindowError(None)
            self.root = root
            self._move_to(z)
            if size < CONVERGED:
                break
        for each, own in zip(self.factors, rows, strict=True):
            each.rows = own

    def _columns(self, chosen: Sequence[WindowFactor]) -> IndexArray:
        """Columns (m, 7) of each factor's rows; behind the right side is one for empty places."""
        n = sum(self.dims.values())
        places = {key: range(at.start, at.stop) for key, at in self.slices.items()}
        out: list[int] = []
        for each in chosen:
            at = len(out)
            for key in each.keys:
                out += places[key]
            out += [n + 1] * (at + _WIDTH - 1 - len(out))
            out.append(n)
        return np.array(out, dtype=np.int64).reshape(-1, _WIDTH)

    def _relinearise(self, rows: Array, columns: IndexArray, z: Array, new: BoolArray) -> None:
        """Change the rows (m, 3, 7) of factors that are ``new`` (m,) or whose variables moved.

        ``z`` is changed where linearisation points are, and no factor is new any more.
        """
        read = np.concatenate([self._read[key] for key in self.slices])
        moved = np.zeros(len(z) + 2, dtype=bool)
        for key in self._moved(np.abs(z - read)):
            at = self.slices[key]
            moved[at] = True
            if key not in self.prior.dims:
                factors.overwrite(self._points, key, factors.read(self.values, key, self.dims[key]))
                z[at] = 0.0
                self.z[key] = z[at].copy()
            self._read[key] = self.z[key]
        outdated = np.flatnonzero(moved[columns[:, :-1]].any(axis=1) | new)
        new[:] = False
        if len(outdated):
            rows[outdated] = self._linearised(
                [self.factors[n] for n in outdated], columns[outdated], z
            )

    def _moved(self, distance: Array) -> list[int]:
        """Variables that moved, by the distances (n,) of their coordinates."""
        far = np.flatnonzero(distance > RELINEARISE)
        if not len(far):
            return []
        keys, starts = list(self.slices), [at.start for at in self.slices.values()]
        return [keys[n] for n in np.unique(np.searchsorted(starts, far, side="right") - 1)]

    def _linearised(self, chosen: Sequence[WindowFactor], columns: IndexArray, z: Array) -> Array:
        """Rows (m, 3, 7) with the residuals at ``z``, Jacobians at the linearisation points."""
        graph, involved = gtsam.NonlinearFactorGraph(), gtsam.Ordering()
        for each in chosen:
            graph.add(each.factor)
        keys = {key: None for each in chosen for key in each.keys}
        for key in keys:
            involved.push_back(key)
        A = graph.linearize(self._points).jacobian(involved)[0]
        b = graph.linearize(self.values).jacobian(involved)[1]
        # the last column and the last row are empty
        whole = np.zeros((len(b) + 1, A.shape[1] + 1))
        whole[:-1, :-1] = A
        place = np.full(len(z) + 2, -1)
        place[columns_of(keys, self.slices)] = np.arange(A.shape[1])
        size = np.array([each.factor.dim() for each in chosen])[:, None]
        line = np.arange(3) + (np.cumsum(size)[:, None] - size)
        line[np.arange(3) >= size] = -1
        rows = np.empty((len(chosen), 3, _WIDTH))
        rows[:, :, :-1] = whole[line[:, :, None], place[columns[:, None, :-1]]]
        here = np.append(z, [0.0, 0.0])[columns[:, :-1]]
        rows[:, :, -1] = np.append(b, 0.0)[line] + np.einsum("mij,mj->mi", rows[:, :, :-1], here)
        return rows

    def _weights(self, rows: Array, columns: IndexArray, z: Array, robust: IntArray) -> Array:
        """Weight (m,) of each factor under the kernel, which applies to some, ``robust``."""
        weights = np.ones(len(rows))
        if self._kernel.kernel == "none":
            return weights
        weight, scale = WEIGHTS[self._kernel.kernel], self._kernel.scale
        padded = np.append(z, [0.0, 0.0])
        at = padded[columns[robust, :-1]]
        b = rows[robust, :, -1] - (rows[robust, :, :-1] @ at[:, :, None])[:, :, 0]
        length = np.sqrt(np.square(b).sum(axis=1))
        weights[robust] = [weight(d, scale) for d in length.tolist()]
        return weights

    def _move_to(self, z: Array) -> None:
        """All estimates after an update."""
        delta = gtsam.VectorValues()
        for key, at in self.slices.items():
            self.z[key] = z[at]
            delta.insert(key, self.z[key])
        self.values = self._points.retract(delta)

    def _qr(self, rows: Array, columns: IndexArray, prior: Array) -> Array:
        """Square root information (n, n) by QR of all rows.

        Raises:
            IndeterminateWindowError: a variable is indeterminate.
        """
        n = prior.shape[1] - 1
        A = np.zeros((len(rows), 3, n + 2))
        np.put_along_axis(A, columns[:, None, :].repeat(3, axis=1), rows, axis=2)
        whole = np.vstack([A[:, :, :n].reshape(-1, n), prior[:, :n]])
        # the largest rows first: QR without pivoting is stable then
        whole = whole[np.argsort(-np.abs(whole).max(axis=1), kind="stable")]
        root = np.linalg.qr(whole, mode="r")
        diagonal = np.abs(np.diag(root))
        if len(diagonal) < n or not np.isfinite(root).all() or not diagonal.all():
            worst = int(np.argmin(np.nan_to_num(diagonal))) if len(diagonal) else 0
            named = [key for key, at in self.slices.items() if at.start <= worst < at.stop]
            raise IndeterminateWindowError(named[0] if named else None)
        return np.asarray(root)

    def weighted_rows(self, chosen: Sequence[WindowFactor]) -> list[Rows]:
        """Rows of factors at the estimate, weighted by the kernel."""
        z = np.concatenate([self.z[key] for key in self.slices])
        new = [each for each in chosen if each.rows is None]
        if new:
            for each, rows in zip(new, self._linearised(new, self._columns(new), z), strict=True):
                each.rows = rows
        out = []
        for each in chosen:
            assert each.rows is not None
            dims = {key: self.dims[key] for key in each.keys}
            n = sum(dims.values())
            A, b = each.rows[:, :n], each.rows[:, -1]
            root = 1.0
            if each.robust:
                left = b - A @ np.concatenate([self.z[key] for key in each.keys])
                weight = WEIGHTS[self._kernel.kernel](
                    float(np.linalg.norm(left)), self._kernel.scale
                )
                root = math.sqrt(weight)
            out.append(Rows(dims, root * A, root * b))
        return out

    def half_error(self) -> float:
        """Half the weighted squared residuals, including those in the prior."""
        z = [self.z[key] for key in self.prior.dims]
        left = self.prior.b - (self.prior.A @ np.concatenate(z) if z else 0.0)
        total = 0.5 * float(left @ left)
        for each in self.factors:
            if each.robust:
                b = each.factor.linearize(self.values).jacobian()[1]
                noise = factors.robust(gtsam.noiseModel.Unit.Create(len(b)), self._kernel)
                total += noise.loss(float(b @ b))
            else:
                total += each.factor.error(self.values)
        return total

    def absorb(self, parts: Sequence[Rows]) -> None:
        """Add rows to the prior."""
        dims = {key: d for part in (self.prior, *parts) for key, d in part.dims.items()}
        self.prior = stacked([self.prior, *parts], dims)


def _normal_equations(rows: Array, columns: IndexArray, n: int) -> Array:
    """[A b]ᵀ [A b] (n + 1, n + 1) of rows (m, 3, 7) with these columns (m, 7)."""
    products = rows.mT @ rows
    index = columns[:, :, None] * (n + 2) + columns[:, None, :]
    total = np.bincount(index.ravel(), products.ravel(), minlength=(n + 2) ** 2)
    return np.asarray(total, dtype=float).reshape(n + 2, n + 2)[: n + 1, : n + 1]


def _cholesky(H: Array) -> Array | None:
    """Upper triangular R (n, n) with Rᵀ R = H; None where it would be inaccurate."""
    root, info = dpotrf(H)
    if info:
        return None
    ratio = np.diag(H) / np.square(np.diag(root))
    return root if np.all(ratio < WORST_RATIO) else None
