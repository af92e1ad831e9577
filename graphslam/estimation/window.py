"""The nonlinear window of a fixed-lag smoother: variables, factors, prior, and its solution.

Every variable is its linearisation point corrected by z, in the tangent space there; all rows are
in terms of z. A factor is linearised anew where one of its variables has moved since, and the
points of variables that the prior involves stay (see `fixed_lag`). GTSAM linearises factors one by
one; the window is solved as one dense matrix, which for a few hundred rows is quickest.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dpotrf

from graphslam.core.config import RobustConfig
from graphslam.core.geometry import Array
from graphslam.core.records import Association
from graphslam.estimation import factors
from graphslam.estimation.m_estimators import WEIGHTS
from graphslam.estimation.square_root import Rows, column_slices, stacked

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

    def optimise(self) -> None:
        """Gauss-Newton on all factors and the prior, from the current estimate.

        Raises:
            IndeterminateWindowError: they do not determine all variables.
        """
        prior = self.prior.dims
        dims = {**prior, **{key: d for key, d in self.dims.items() if key not in prior}}
        self.slices = column_slices(dims)
        columns = self._columns()
        z = np.concatenate([self.z[key] for key in dims])
        prior_A = np.zeros((len(self.prior.b), len(z) + 1))
        prior_A[:, : self.prior.A.shape[1]], prior_A[:, -1] = self.prior.A, self.prior.b
        prior_H = prior_A.T @ prior_A
        size = math.inf
        for _ in range(MAX_ITERATIONS):
            rows = self._linearised(columns, z)
            weighted = np.sqrt(self._weights(rows, columns, z))[:, None, None] * rows
            H = _normal_equations(weighted, columns, len(z))
            H += prior_H
            root = _cholesky(H[:-1, :-1])
            if root is None:
                root = self._qr(weighted, columns, prior_A)
            new = dtrsm(1.0, root, dtrsm(1.0, root, H[:-1, -1:], trans_a=1))[:, 0]
            size = float(np.linalg.norm(new - z))
            if not math.isfinite(size):
                raise IndeterminateWindowError(None)
            z, self.root = new, root
            self._move_to(z)
            if size < CONVERGED:
                break

    def _columns(self) -> IndexArray:
        """Columns (m, 7) of each factor's rows; behind the right side is one for empty places."""
        n = sum(self.dims.values())
        places = {key: list(range(at.start, at.stop)) for key, at in self.slices.items()}
        out = []
        for each in self.factors:
            own = [column for key in each.keys for column in places[key]]
            out.append(own + [n + 1] * (_WIDTH - 1 - len(own)) + [n])
        return np.array(out, dtype=np.int64).reshape(-1, _WIDTH)

    def _linearised(self, columns: IndexArray, z: Array) -> Array:
        """Rows (m, 3, 7) of all factors; ``z`` is changed where linearisation points are."""
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
        outdated = np.asarray(moved[columns[:, :-1]].any(axis=1))
        for n, each in enumerate(self.factors):
            if outdated[n] or each.rows is None:
                each.rows = self._linearise(each)
        return np.array([each.rows for each in self.factors]).reshape(-1, 3, _WIDTH)

    def _moved(self, distance: Array) -> list[int]:
        """Variables that moved, by the distances (n,) of their coordinates."""
        far = np.flatnonzero(distance > RELINEARISE)
        if not len(far):
            return []
        keys, starts = list(self.slices), [at.start for at in self.slices.values()]
        return [keys[n] for n in np.unique(np.searchsorted(starts, far, side="right") - 1)]

    def _linearise(self, each: WindowFactor) -> Array:
        """Rows (3, 7) with the residual at the estimate, Jacobians at the linearisation points."""
        A = each.factor.linearize(self._points).jacobian()[0]
        b = each.factor.linearize(self.values).jacobian()[1]
        rows = np.zeros((3, _WIDTH))
        rows[: len(b), : A.shape[1]] = A
        rows[: len(b), -1] = b + A @ np.concatenate([self.z[key] for key in each.keys])
        return rows

    def _weights(self, rows: Array, columns: IndexArray, z: Array) -> Array:
        """Weight (m,) of each factor under the kernel."""
        weights = np.ones(len(rows))
        if self._kernel.kernel == "none":
            return weights
        robust = np.flatnonzero([each.robust for each in self.factors])
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
            self.z[key] = z[at].copy()
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
        out = []
        for each in chosen:
            if each.rows is None:
                each.rows = self._linearise(each)
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
