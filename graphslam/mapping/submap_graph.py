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

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.errors import EstimationError
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

#: Gauss-Newton steps at most; m or rad: it has converged when nothing moves more than this
MAX_STEPS, CONVERGED = 10, 1e-5
#: times that a step which makes the error larger is halved
MAX_HALVINGS = 5
#: m or rad: after a smaller step the matrix is not factorised again
SMALL_STEP = 0.01
#: submaps whose columns of the covariance are computed at once
COLUMNS = 100


@dataclass(frozen=True, slots=True, eq=False)
class SubmapConstraints:
    """Measured poses (m, 3) of submaps ``end`` (m,) in the frames of submaps ``begin`` (m,).

    ``cov`` (m, 3, 3) is along the axes of the frames in which they are given.
    """

    begin: IntArray
    end: IntArray
    delta: Array
    cov: Array

    def and_also(self, other: "SubmapConstraints") -> "SubmapConstraints":
        """Both."""
        return SubmapConstraints(*(
            np.concatenate([getattr(self, name), getattr(other, name)])
            for name in ("begin", "end", "delta", "cov")
        ))  # fmt: skip

    def only(self, which: BoolArray) -> "SubmapConstraints":
        """Some of them."""
        return SubmapConstraints(
            self.begin[which], self.end[which], self.delta[which], self.cov[which]
        )


def relative_jacobian(h: Array) -> Array:
    """Jacobian (..., 3, 6) of relative poses h (..., 3) by both poses, along their own axes."""
    H = np.zeros((*h.shape[:-1], 3, 6))
    H[..., 0, 0] = H[..., 1, 1] = H[..., 2, 2] = -1.0
    H[..., 0, 2], H[..., 1, 2] = h[..., 1], -h[..., 0]
    H[..., 3:] = rotation3(h[..., 2])
    return H


class SubmapGraph:
    """``poses`` (n, 3) of submaps, by relative poses between consecutive ones and closures.

    It may be solved for the beginnings of the paths only: what follows hangs from them, and says
    nothing about them. Of submaps that are not in use nothing is known but where they were put:
    closures with them and their covariances are refused, with an EstimationError.
    """

    def __init__(
        self, poses: Array, chain: SubmapConstraints, first: Sequence[int], start_cov: Array
    ) -> None:
        """Begin at ``poses``; the ``chain`` joins the submaps of each path, in their order.

        ``first`` (k,) are the first submaps of the paths, in ascending order. Where they begin is
        known with covariances ``start_cov`` (k, 3, 3), along the axes of each one's pose.
        """
        self.poses = np.array(poses)
        self._all, self._first = chain, np.asarray(first)
        self._starts, self._start_info = self.poses[self._first], np.linalg.inv(start_cov)
        self._closures: SubmapConstraints | None = None
        self._set_used(np.ones(len(self.poses), dtype=bool))

    def _set_used(self, used: BoolArray) -> None:
        self._used, self._place = used, np.cumsum(used) - 1
        self._chain = self._all.only(used[self._all.end])
        self._factor: SuperLU | None = None

    def begin_with(self, last: IntArray | None) -> None:
        """Use the paths only up to submaps ``last`` (m,), which may be several of a path.

        None: all of them. What was left out so far is put where the chain says.
        """
        used = np.ones(len(self.poses), dtype=bool)
        if last is not None:
            ends = self._first - 1
            np.maximum.at(ends, np.searchsorted(self._first, last, side="right") - 1, last)
            path = np.searchsorted(self._first, np.arange(len(used)), side="right") - 1
            used = np.arange(len(used)) <= np.maximum(ends, self._first)[path]
        new = used & ~self._used
        for edge in np.flatnonzero(new[self._all.end]):
            begin, end = self._all.begin[edge], self._all.end[edge]
            self.poses[end] = compose(self.poses[begin], self._all.delta[edge])
        self._set_used(used)

    def solve(self, closures: SubmapConstraints | None = None) -> None:
        """Solve with these closures, beginning where the poses are."""
        if closures is not None:
            self._require_used(np.concatenate([closures.begin, closures.end]))
        self._closures = closures
        edges, information = self._measured()
        factor = self._factorised(edges, information)
        error = self._error(edges, information)
        for _ in range(MAX_STEPS):
            step = -factor.solve(self._gradient(edges, information)).reshape(-1, 3)
            before = self.poses[self._used]
            for _ in range(MAX_HALVINGS):
                self.poses[self._used] = compose(before, exp(step))
                after = self._error(edges, information)
                if after <= error or np.abs(step).max() < SMALL_STEP:
                    break
                step = step / 2  # a path that is bent far is beyond what is linear
            error, largest = after, np.abs(step).max()
            if largest < CONVERGED:
                break
            if largest > SMALL_STEP:  # else the matrix hardly changes
                factor = self._factorised(edges, information)
        self._factor = factor

    def covariance(self, which: IntArray) -> Array:
        """Joint covariance (3k, 3k) of submaps (k,), errors along each pose's own axes."""
        self._require_used(which)
        return symmetric(self._columns(which)[self._rows(which)])

    def relative(self, i: IntArray, j: IntArray) -> tuple[Array, Array]:
        """Poses (m, 3) of submaps i (m,) in the frames of submaps j (m,), covariances (m, 3, 3).

        Columns of the inverse are computed `COLUMNS` submaps at a time, so memory grows with the
        path only.
        """
        nodes = np.unique(np.concatenate([i, j]))
        self._require_used(nodes)
        h = between(self.poses[j], self.poses[i])
        own = np.zeros((len(self.poses), 3, 3))
        cross = np.zeros((len(i), 3, 3))
        for first in range(0, len(nodes), COLUMNS):
            some = nodes[first : first + COLUMNS]
            columns = self._columns(some).reshape(-1, 3, len(some), 3)
            at = np.arange(len(some))
            own[some] = columns[self._place[some], :, at]
            which = np.flatnonzero(np.isin(i, some))
            # the inverse is symmetric: column i holds the blocks (j, i)
            cross[which] = columns[self._place[j[which]], :, np.searchsorted(some, i[which])]
        H = relative_jacobian(h)
        both = np.block([[own[j], cross], [cross.mT, own[i]]])
        return h, H @ both @ H.mT

    def _require_used(self, which: IntArray) -> None:
        """Raise EstimationError if one of some submaps (k,) is not in use: it has no rows."""
        unused = np.unique(which[~self._used[which]])
        if len(unused):
            raise EstimationError(
                f"submaps {', '.join(map(str, unused[:5]))}: are not in use yet, their path is "
                "solved up to an earlier one; SubmapGraph.begin_with says how far"
            )

    def _rows(self, which: IntArray) -> IntArray:
        """Rows (3k,) of submaps (k,) in the normal equations."""
        return np.asarray((3 * self._place[which][:, None] + np.arange(3)).ravel())

    def _columns(self, which: IntArray) -> Array:
        """Columns (3u, 3k) of submaps (k,) of the covariance of all u poses in use."""
        if self._factor is None:
            self._factor = self._factorised(*self._measured())
        rows = self._rows(which)
        columns = np.zeros((self._factor.shape[0], len(rows)))
        columns[rows, np.arange(len(rows))] = 1.0
        return np.asarray(self._factor.solve(columns))

    def _measured(self) -> tuple[SubmapConstraints, Array]:
        """Chain and closures, and their information (m, 3, 3) along the axes of their ends."""
        edges = self._chain if self._closures is None else self._chain.and_also(self._closures)
        return edges, np.asarray(np.linalg.inv(rotate_cov(edges.cov, -edges.delta[:, 2])))

    def _error(self, edges: SubmapConstraints, information: Array) -> float:
        """Half of the squared error."""
        off = log(between(edges.delta, between(self.poses[edges.begin], self.poses[edges.end])))
        begun = log(between(self._starts, self.poses[self._first]))
        return 0.5 * float(
            np.einsum("ij,ijk,ik", off, information, off)
            + np.einsum("ij,ijk,ik", begun, self._start_info, begun)
        )

    def _gradient(self, edges: SubmapConstraints, information: Array) -> Array:
        """The gradient (3u,) at the u poses in use."""
        h = between(self.poses[edges.begin], self.poses[edges.end])
        pull = (information @ log(between(edges.delta, h))[:, :, None])[:, :, 0]
        gradient = np.zeros((len(self.poses), 3))
        # to first order in the residual, errors along the axes of each pose
        np.add.at(gradient, edges.begin, -(adjoint(inverse(h)).mT @ pull[:, :, None])[:, :, 0])
        np.add.at(gradient, edges.end, pull)
        off = log(between(self._starts, self.poses[self._first]))
        gradient[self._first] += (self._start_info @ off[:, :, None])[:, :, 0]
        return gradient[self._used].ravel()

    def _factorised(self, edges: SubmapConstraints, information: Array) -> SuperLU:
        """The matrix of the normal equations at the poses, factorised."""
        m = len(edges.begin)
        h = between(self.poses[edges.begin], self.poses[edges.end])
        J = np.stack([-adjoint(inverse(h)), np.broadcast_to(np.eye(3), (m, 3, 3))], axis=1)
        blocks = (J.mT @ information[:, None])[:, :, None] @ J[:, None]
        at = self._place[np.stack([edges.begin, edges.end], axis=1)]
        rows = np.broadcast_to(
            3 * at[:, :, None, None, None] + np.arange(3)[:, None], (m, 2, 2, 3, 3)
        )
        columns = np.broadcast_to(3 * at[:, None, :, None, None] + np.arange(3), (m, 2, 2, 3, 3))
        first = 3 * self._place[self._first][:, None, None]
        first_rows = np.broadcast_to(first + np.arange(3)[:, None], self._start_info.shape)
        first_columns = np.broadcast_to(first + np.arange(3), self._start_info.shape)
        size = 3 * int(self._used.sum())
        matrix = coo_matrix(
            (
                np.concatenate([blocks.ravel(), self._start_info.ravel()]),
                (
                    np.concatenate([rows.ravel(), first_rows.ravel()]),
                    np.concatenate([columns.ravel(), first_columns.ravel()]),
                ),
            ),
            shape=(size, size),
        )
        options = {"SymmetricMode": True}
        return splu(
            csc_matrix(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options
        )
