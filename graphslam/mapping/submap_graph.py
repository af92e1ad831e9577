"""Pose graph of submaps: a few hundred poses that stand for the whole path while loops are closed.

The relative pose of consecutive submaps comes from tracking, closures from matching submaps. The
graph is solved by Gauss-Newton on sparse normal equations; one solution takes milliseconds, so
loops can be closed one place after another.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import SuperLU, splu

from graphslam.core.gaussian import symmetric
from graphslam.core.geometry import (
    Array,
    adjoint,
    between,
    compose,
    exp,
    inverse,
    log,
    rotate_cov,
    rotation3,
)
from graphslam.mapping.gating import IntArray

#: Gauss-Newton steps at most; m or rad: it has converged when nothing moves more than this
MAX_STEPS, CONVERGED = 10, 1e-5
#: submaps whose columns of the covariance are computed at once
COLUMNS = 100


@dataclass(frozen=True, slots=True, eq=False)
class RelativePoses:
    """Measured poses (m, 3) of submaps ``end`` (m,) in the frames of submaps ``begin`` (m,).

    ``cov`` (m, 3, 3) is along the axes of the frames in which they are given.
    """

    begin: IntArray
    end: IntArray
    delta: Array
    cov: Array

    def and_also(self, other: "RelativePoses") -> "RelativePoses":
        """Both."""
        return RelativePoses(*(
            np.concatenate([getattr(self, name), getattr(other, name)])
            for name in ("begin", "end", "delta", "cov")
        ))  # fmt: skip


def relative_jacobian(h: Array) -> Array:
    """Jacobian (..., 3, 6) of relative poses h (..., 3) by both poses, along their own axes."""
    H = np.zeros((*h.shape[:-1], 3, 6))
    H[..., 0, 0] = H[..., 1, 1] = H[..., 2, 2] = -1.0
    H[..., 0, 2], H[..., 1, 2] = h[..., 1], -h[..., 0]
    H[..., 3:] = rotation3(h[..., 2])
    return H


class SubmapGraph:
    """``poses`` (n, 3) of submaps, by relative poses between consecutive ones and closures."""

    def __init__(
        self, poses: Array, chain: RelativePoses, first: Sequence[int], start_cov: Array
    ) -> None:
        """Begin at ``poses``; the ``chain`` joins the submaps of each path.

        ``first`` (k,) are the first submaps of the paths. Where they begin is known with
        covariances ``start_cov`` (k, 3, 3), along the axes of each one's pose.
        """
        self.poses = np.array(poses)
        self._chain, self._first = chain, np.asarray(first)
        self._starts, self._start_info = self.poses[self._first], np.linalg.inv(start_cov)
        self._closures: RelativePoses | None = None
        self._factor: SuperLU | None = None

    def solve(self, closures: RelativePoses | None = None) -> None:
        """Solve with these closures, beginning where the poses are."""
        self._closures = closures
        for _ in range(MAX_STEPS):
            self._factor, gradient = self._factorised()
            step = -self._factor.solve(gradient).reshape(-1, 3)
            self.poses = compose(self.poses, exp(step))
            if np.abs(step).max() < CONVERGED:
                break

    def covariance(self, which: IntArray) -> Array:
        """Joint covariance (3k, 3k) of submaps (k,), errors along each pose's own axes."""
        rows = (3 * np.asarray(which)[:, None] + np.arange(3)).ravel()
        return symmetric(self._columns(which)[rows])

    def relative(self, i: IntArray, j: IntArray) -> tuple[Array, Array]:
        """Poses (m, 3) of submaps i (m,) in the frames of submaps j (m,), covariances (m, 3, 3).

        Columns of the inverse are computed `COLUMNS` submaps at a time, so memory grows with the
        path only.
        """
        h = between(self.poses[j], self.poses[i])
        nodes = np.unique(np.concatenate([i, j]))
        own = np.zeros((len(self.poses), 3, 3))
        cross = np.zeros((len(i), 3, 3))
        for first in range(0, len(nodes), COLUMNS):
            some = nodes[first : first + COLUMNS]
            columns = self._columns(some).reshape(len(self.poses), 3, len(some), 3)
            at = np.arange(len(some))
            own[some] = columns[some, :, at]
            which = np.flatnonzero(np.isin(i, some))
            # the inverse is symmetric: column i holds the blocks (j, i)
            cross[which] = columns[j[which], :, np.searchsorted(some, i[which])]
        H = relative_jacobian(h)
        both = np.block([[own[j], cross], [cross.mT, own[i]]])
        return h, H @ both @ H.mT

    def _columns(self, which: IntArray) -> Array:
        """Columns (3n, 3k) of the covariance of all poses that belong to submaps (k,)."""
        if self._factor is None:
            self._factor, _ = self._factorised()
        rows = (3 * np.asarray(which)[:, None] + np.arange(3)).ravel()
        columns = np.zeros((3 * len(self.poses), len(rows)))
        columns[rows, np.arange(len(rows))] = 1.0
        return np.asarray(self._factor.solve(columns))

    def _factorised(self) -> tuple[SuperLU, Array]:
        """The normal equations at the poses, factorised, and their gradient (3n,)."""
        edges = self._chain if self._closures is None else self._chain.and_also(self._closures)
        n, m = len(self.poses), len(edges.begin)
        h = between(self.poses[edges.begin], self.poses[edges.end])
        residual = log(between(edges.delta, h))
        information = np.linalg.inv(rotate_cov(edges.cov, -edges.delta[:, 2]))
        # to first order in the residual, errors along the axes of each pose
        J = np.stack([-adjoint(inverse(h)), np.broadcast_to(np.eye(3), (m, 3, 3))], axis=1)
        JtW = J.mT @ information[:, None]
        blocks = JtW[:, :, None] @ J[:, None]
        at = np.stack([edges.begin, edges.end], axis=1)
        gradient = np.zeros((n, 3))
        np.add.at(gradient, at, (JtW @ residual[:, None, :, None])[..., 0])
        rows = np.broadcast_to(
            3 * at[:, :, None, None, None] + np.arange(3)[:, None], (m, 2, 2, 3, 3)
        )
        columns = np.broadcast_to(3 * at[:, None, :, None, None] + np.arange(3), (m, 2, 2, 3, 3))
        off = log(between(self._starts, self.poses[self._first]))
        gradient[self._first] += (self._start_info @ off[:, :, None])[:, :, 0]
        first = 3 * self._first[:, None, None]
        first_rows = np.broadcast_to(first + np.arange(3)[:, None], self._start_info.shape)
        first_columns = np.broadcast_to(first + np.arange(3), self._start_info.shape)
        matrix = coo_matrix(
            (
                np.concatenate([blocks.ravel(), self._start_info.ravel()]),
                (
                    np.concatenate([rows.ravel(), first_rows.ravel()]),
                    np.concatenate([columns.ravel(), first_columns.ravel()]),
                ),
            ),
            shape=(3 * n, 3 * n),
        )
        options = {"SymmetricMode": True}
        factor = splu(
            csc_matrix(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options
        )
        return factor, gradient.ravel()
