"""Linear Kalman updates, and a joint Gaussian with blocks that can be added and removed.

`move_block` and `update` are the linear filter (thesis 3.1-3.8) on plain arrays. An extended filter
(`graphslam.estimation.ekf`) keeps a `JointGaussian`: the same algebra where a measurement touches
two members of hundreds, so nothing is multiplied that is known to be zero. What an error is, and
how it corrects a mean, is up to the caller: poses and points are treated alike here.
"""

from collections.abc import Hashable, Iterator, Mapping, Sequence
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dgesv
from scipy.special import chdtri

from graphslam.core.geometry import Array

Name = TypeVar("Name", bound=Hashable)


def chi2_quantile(probability: ArrayLike, dof: ArrayLike) -> Array:
    """Quantile (...,) of the chi-square distribution with ``dof`` degrees of freedom.

    `scipy.special` has it without the second that importing `scipy.stats` takes.
    """
    return np.asarray(chdtri(dof, 1.0 - np.asarray(probability)))


def mahalanobis_squared(r: Array, S: Array) -> Array:
    """Squared Mahalanobis distances (...,) of innovations (..., n), covariances S (..., n, n)."""
    return np.asarray((r * np.linalg.solve(S, r[..., None])[..., 0]).sum(axis=-1))


def move_block(P: Array, block: slice, F: Array, Q: Array) -> None:
    """System update in place of one block of a covariance (n, n), thesis 3.4 and 3.12.

    The block's error e becomes F e + noise of covariance Q (d, d); only its rows and columns
    change.
    """
    own = symmetric(F @ P[block, block] @ F.T + Q)
    P[block] = F @ P[block]
    P[:, block] = P[block].T
    P[block, block] = own


def update(
    x: Array, P: Array, H: Array, R: Array, innovation: Array
) -> tuple[Array, Array, Array, Array]:
    """Measurement update of the linear filter, thesis 3.5-3.8, of any number of Gaussians.

    Args:
        x: means (..., n).
        P: covariances (..., n, n).
        H: measurement matrices (..., k, n).
        R: covariances (..., k, k) of the measurements.
        innovation: measured minus expected, (..., k).

    Returns:
        Means, covariances, squared normalised innovations (...,) and the log determinants (...,)
        of the innovations' covariances.

    Raises:
        numpy.linalg.LinAlgError: an innovation's covariance is not positive definite.
    """
    L = np.linalg.cholesky(H @ P @ H.mT + R)
    solved = np.linalg.solve(L, np.concatenate([H @ P, innovation[..., None]], axis=-1))
    B, w = solved[..., :-1], solved[..., -1:]
    log_det = 2 * np.log(np.diagonal(L, axis1=-2, axis2=-1)).sum(axis=-1)
    d2 = np.square(w[..., 0]).sum(axis=-1)
    return x + (B.mT @ w)[..., 0], P - B.mT @ B, d2, log_det


def whiten(PHt: Array, S: Array, innovation: Array) -> tuple[Array, Array, float]:
    """The parts of a measurement update, without inverting S: with S = L Lᵀ and K = P Hᵀ S⁻¹,
    the mean moves by K ν = Bᵀ w and the covariance loses K S Kᵀ = Bᵀ B.

    Args:
        PHt: covariance (n, k) between the state and the expected measurement.
        S: covariance (k, k) of the innovation, thesis 3.7.
        innovation: measured minus expected, (k,).

    Returns:
        B = L⁻¹ H P (k, n), w = L⁻¹ ν (k,), and the squared normalised innovation νᵀ S⁻¹ ν.

    Raises:
        numpy.linalg.LinAlgError: S is not positive definite.
    """  # noqa: D205
    L = np.linalg.cholesky(S)
    n = len(PHt)
    both = np.empty((n + 1, len(S)))
    both[:n], both[n] = PHt, innovation
    # BLAS knows that L is triangular, and wants columns: a third to a sixth of the time of `solve`
    solved = dtrsm(1.0, L.T, both.T, trans_a=1, overwrite_b=1)
    B, w = solved[:, :n], solved[:, n]
    return B, w, float(w @ w)


def solve(A: Array, B: Array) -> Array:
    """A⁻¹ B for one small matrix (n, n) and B (n,) or (n, k), in a third of NumPy's time.

    Raises:
        numpy.linalg.LinAlgError: A is singular.
    """
    _, _, X, info = dgesv(A, B)
    if info:
        raise np.linalg.LinAlgError("Singular matrix")
    return np.asarray(X)


class JointGaussian(Generic[Name]):
    """Named members with one mean and one covariance, both growing.

    Storage grows by doubling, so adding a member costs O(n) on average. Blocks are contiguous, also
    after a removal. The covariance is always exactly symmetric.
    """

    def __init__(self, room: int = 64) -> None:
        self._x = np.zeros(room)
        self._P = np.zeros((room, room))
        self._slots: dict[Name, slice] = {}
        self._blocks: dict[int, np.ndarray[tuple[int, int], np.dtype[np.int64]]] = {}
        self._size = 0

    @classmethod
    def of(cls, sizes: Mapping[Name, int], x: Array, P: Array) -> "JointGaussian[Name]":
        """Members of these ``sizes``, in order, with mean x (n,) and covariance P (n, n)."""
        made = cls(room=max(2 * len(x), 1))
        made._size = len(x)
        made.x[:], made.P[:] = x, symmetric(P)
        ends = np.cumsum(list(sizes.values()), dtype=int).tolist()
        made._slots = {
            name: slice(end - size, end)
            for (name, size), end in zip(sizes.items(), ends, strict=True)
        }
        return made

    def copied(self) -> "JointGaussian[Name]":
        """Another one with the same members, mean and covariance."""
        made = type(self)(room=0)
        made._x, made._P, made._slots = self._x.copy(), self._P.copy(), self._slots.copy()
        made._blocks, made._size = self._blocks.copy(), self._size
        return made

    def __len__(self) -> int:
        """Size n of the state."""
        return self._size

    def __contains__(self, name: object) -> bool:
        """Whether there is a member of that name."""
        return name in self._slots

    def __iter__(self) -> Iterator[Name]:
        """Names, in the order of their blocks."""
        return iter(self._slots)

    @property
    def x(self) -> Array:
        """The mean (n,), a view of it."""
        return self._x[: self._size]

    @property
    def P(self) -> Array:  # noqa: N802
        """The covariance (n, n), a view of it."""
        return self._P[: self._size, : self._size]

    def slot(self, name: Name) -> slice:
        """Where a member's block lies."""
        return self._slots[name]

    def blocks(self, dim: int) -> np.ndarray[tuple[int, int], np.dtype[np.int64]]:
        """Where all members of size ``dim`` lie: indices (m, dim)."""
        if dim not in self._blocks:
            slots = self._slots.values()
            starts = [slot.start for slot in slots if slot.stop - slot.start == dim]
            self._blocks[dim] = np.array(starts, dtype=np.int64)[:, None] + np.arange(dim)
        return self._blocks[dim]

    def marginal(self, names: Sequence[Name]) -> Array:
        """Joint covariance (d, d) of some members, in the order asked for."""
        if len(names) == 1:  # the rule: a pose
            (own,) = (self._slots[name] for name in names)
            return self._P[own, own].copy()
        index = np.concatenate([np.r_[self._slots[name]] for name in names])
        return np.asarray(self._P[np.ix_(index, index)])

    def add(
        self, name: Name, mean: Array, cov: Array, given: Mapping[Name, Array] | None = None
    ) -> None:
        """A new member, thesis 4.24-4.28: its error is Σ G_i e_i + fresh noise.

        Args:
            name: of the new member.
            mean: (d,).
            cov: covariance (d, d) of its fresh noise.
            given: member i -> G_i (d, d_i); None: it is independent of all others.
        """
        n, d = self._size, len(cov)
        self._make_room(d)
        given = {} if given is None else given
        PGt, GPGt = self.project(given, d)
        block = slice(n, n + d)
        self._P[:n, block], self._P[block, :n] = PGt, PGt.T
        self._P[block, block] = symmetric(GPGt + cov)
        self._x[block] = mean
        self._slots[name] = block
        self._size += d
        self._blocks.clear()

    def add_each(
        self, names: Sequence[Name], sources: Sequence[Name], means: Array, covs: Array, G: Array
    ) -> None:
        """New members, the error of each is G_i times that of one other and fresh noise, as `add`.

        Args:
            names: of the m new members.
            sources: the member that each comes from.
            means: (m, d).
            covs: covariances (m, d, d) of their fresh noise, independent of each other.
            G: (m, d, d).
        """
        n, (m, d) = self._size, means.shape
        self._make_room(m * d)
        starts = np.array([self._slots[source].start for source in sources])
        of = (starts[:, None] + np.arange(d)).ravel()
        PGt = self.P[:, of].reshape(n, m, d).swapaxes(0, 1) @ G.mT
        PGt = PGt.swapaxes(0, 1).reshape(n, m * d)
        GPGt = (G @ PGt[of].reshape(m, d, m * d)).reshape(m, d, m, d)
        each = np.arange(m)
        GPGt[each, :, each] += covs
        new = slice(n, n + m * d)
        self._P[:n, new], self._P[new, :n] = PGt, PGt.T
        self._P[new, new] = symmetric(GPGt.reshape(m * d, m * d))
        self._x[new] = means.ravel()
        for k, name in enumerate(names):
            self._slots[name] = slice(n + k * d, n + (k + 1) * d)
        self._size += m * d
        self._blocks.clear()

    def _make_room(self, d: int) -> None:
        n = self._size
        if n + d > len(self._P):
            grown = np.zeros((2 * (n + d),) * 2)
            grown[:n, :n] = self.P
            self._x, self._P = np.append(self.x, np.zeros(n + 2 * d)), grown

    def copy(self, name: Name, source: Name) -> None:
        """A member becomes ``source`` as it is now, of the same size: the same mean, no own noise.

        A copy that stays behind when its source moves on is a past state (S. Roumeliotis,
        J. Burdick, ICRA 2002, https://doi.org/10.1109/ROBOT.2002.1014801).
        """
        to, of, x, P = self._slots[name], self._slots[source], self.x, self.P
        x[to] = x[of]
        P[to] = P[of]
        P[:, to] = P[:, of]

    def remove(self, *names: Name) -> None:
        """Forget members: the others keep their joint marginal."""
        kept = np.ones(self._size, dtype=bool)
        for name in names:
            kept[self._slots.pop(name)] = False
        keep = np.flatnonzero(kept)
        n = len(keep)
        self._x[:n] = self._x[keep]
        self._P[:n, :n] = self._P[keep[:, None], keep]
        self._size = n
        self._blocks.clear()
        end = 0
        for other, slot in self._slots.items():  # in the order of their blocks
            begin, end = end, end + slot.stop - slot.start
            self._slots[other] = slice(begin, end)

    def move(self, name: Name, F: Array, Q: Array) -> None:
        """System update of one member, thesis 3.12: e becomes F e + noise of covariance Q (d, d).

        Only its own rows and columns change.
        """
        move_block(self.P, self._slots[name], F, Q)

    def project(self, H: Mapping[Name, Array], rows: int) -> tuple[Array, Array]:
        """``P Hᵀ`` (n, rows) and ``H P Hᵀ`` (rows, rows) for H given by its blocks."""
        P = self.P
        PHt, HPHt = np.zeros((self._size, rows)), np.zeros((rows, rows))
        for name, block in H.items():
            PHt += P[:, self._slots[name]] @ block.T
        for name, block in H.items():
            HPHt += block @ PHt[self._slots[name]]
        return PHt, HPHt

    def condition(self, B: Array) -> None:
        """Measurement update of the covariance: P - Bᵀ B, see `whiten`, with B (k, n).

        NumPy computes Bᵀ B as a symmetric product and mirrors it, so P stays symmetric to the
        digit. The Joseph form costs a hundred times as much at 900 states; what it protects against
        (a gain that is not optimal) cannot happen here.
        """
        P = self.P
        P -= B.T @ B


def symmetric(P: Array) -> Array:
    """The symmetric part (n, n) of a matrix that rounding made asymmetric."""
    return np.asarray(0.5 * (P + P.T))
