"""Prefix sums over consecutive increments of motion: pose, covariance, calibration derivative.

With P the pose at the end of an interval, an additive error e of increment k in it moves P by
T(P) F_k e: F_k (3, 3) is its effect as if the interval ended at the path's origin, T(P) adds the
lever arm from there to P. F_k does not depend on the interval. So the sums of F_k C_k F_kᵀ and
F_k D_k up to both ends of an interval give its covariance and its derivative by the calibration.
C_k may be several covariances (..., 3, 3), by several models of the noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, between, rotation3
from graphslam.core.motion_models import Increments
from graphslam.core.records import Motion


@dataclass(frozen=True, slots=True, eq=False)
class Motions:
    """Many motions: ``delta`` (n, 3), ``cov`` (n, 3, 3), ``d_cal`` (n, 3, p), ``length_m`` (n,)."""

    delta: Array
    cov: Array
    d_cal: Array
    length_m: Array

    def one(self, k: int, start_ns: int, end_ns: int) -> Motion:
        """The k-th motion, which is between these times."""
        length_m = float(self.length_m[k])
        return Motion(start_ns, end_ns, self.delta[k], self.cov[k], self.d_cal[k], length_m)

    def part(self, i: int, j: int) -> "Motions":
        """The motions from the i-th up to the j-th, which is left out."""
        which = slice(i, j)
        return Motions(self.delta[which], self.cov[which], self.d_cal[which], self.length_m[which])

    @classmethod
    def joined(cls, parts: Sequence["Motions"], places: Sequence[IntArray]) -> "Motions":
        """Motions of which each of ``parts`` has those at ``places``, (m,) indices."""
        order = np.argsort(np.concatenate(places), kind="stable")
        values = ((p.delta, p.cov, p.d_cal, p.length_m) for p in parts)
        return cls(*(np.concatenate(each)[order] for each in zip(*values, strict=True)))


@dataclass(frozen=True, slots=True, eq=False)
class PathSums:
    """Sums up to n points of paths; see `IncrementSums`.

    ``pose`` (n, 3) is seen from the path's origin; ``cov`` (n, 3, 3) and ``d_cal`` (n, 3, p) are
    the sums of F_k C_k F_kᵀ and F_k D_k; ``length_m`` (n,). ``whole_cov`` (n, 3, 3) is the part of
    ``cov`` before the increment in which a point lies, of number ``index`` (n,), that ends at
    ``index_end`` (n, 3); ``part_cov`` (n, 3, 3) what the increment adds up to the point, along the
    origin's axes.
    """

    pose: Array
    cov: Array
    d_cal: Array
    length_m: Array
    whole_cov: Array
    part_cov: Array
    index: IntArray
    index_end: Array

    def motions(self) -> Motions:
        """The motions from the origins to the points; covariances along the origins' axes."""
        T = _lever(self.pose)
        return Motions(self.pose, T @ self.cov @ T.mT, T @ self.d_cal, self.length_m)

    def motions_between(self, start: IntArray, end: IntArray) -> Motions:
        """The motions (m) from points to later points of the same path, by their indices (m,).

        Noise of an increment acts where the motion leaves it. What an increment has added before
        the start is taken from there too: with another lever more may be taken away than is there,
        and the rest is no covariance.
        """
        a, b = self.pose[start], self.pose[end]
        same = self.index[start] == self.index[end]
        left = _lever(-np.where(same[:, None], b, self.index_end[start]))
        before = self.whole_cov[start] + transformed(self.part_cov[start], left)
        T = rotation3(-a[:, 2]) @ _lever(b)
        cov = transformed(self.cov[end] - before, T)
        d_cal = T @ (self.d_cal[end] - self.d_cal[start])
        return Motions(between(a, b), cov, d_cal, self.length_m[end] - self.length_m[start])


class IncrementSums:
    """Prefix sums over the increments of one or several paths."""

    def __init__(self, increments: Increments, first: IntArray) -> None:
        """Sum up the increments.

        Args:
            increments: w of them, path after path.
            first: (w,) index of the first increment of each one's path.
        """
        heading = _prefix(increments.delta[:, 2])
        step = rotation3(heading[:-1] - heading[first]) @ increments.delta[:, :, None]
        self._poses = np.column_stack([_prefix(step[:, :2, 0]), heading])
        starts = self._poses[:-1] - self._poses[first]
        _, cov, d_cal, length_m, _ = _effects(starts, increments)
        self._cov, self._d_cal, self._length_m = _prefix(cov), _prefix(d_cal), _prefix(length_m)

    def query(self, index: IntArray, first: IntArray, part: Increments) -> PathSums:
        """Sums up to n points: whole increments, and then ``part`` (n) of the next.

        Args:
            index: (n,) of the first increment that is not passed as a whole.
            first: (n,) index of the first increment of the point's path.
            part: what of the increment at ``index`` has been passed.
        """
        ends, cov, d_cal, length_m = (
            sums[index] - sums[first]
            for sums in (self._poses, self._cov, self._d_cal, self._length_m)
        )
        ends, added, part_d_cal, part_m, part_cov = _effects(ends, part)
        # of the last increment of a path, which is not known as a whole, no motion leaves
        index_end = self._poses[np.minimum(index + 1, len(self._poses) - 1)] - self._poses[first]
        return PathSums(
            ends, cov + added, d_cal + part_d_cal, length_m + part_m,
            cov, part_cov, index, index_end,
        )  # fmt: skip

    def poses(self, index: IntArray, first: IntArray, delta: Array) -> Array:
        """`PathSums.pose` (n, 3) alone; ``delta`` (n, 3) is that of the parts."""
        return _ends(self._poses[index] - self._poses[first], delta)


def transformed(covs: Array, T: Array) -> Array:
    """T C Tᵀ of covariances (n, ..., 3, 3), any number of them for each T (n, 3, 3)."""
    if covs.ndim == T.ndim:
        return np.asarray(T @ covs @ T.mT)
    # those of one T side by side: products of so small matrices cost by their number
    right = (covs.reshape(len(T), -1, 3) @ T.mT).reshape(covs.shape).mT
    return np.asarray((right.reshape(len(T), -1, 3) @ T.mT).reshape(covs.shape).mT)


def _effects(starts: Array, increments: Increments) -> tuple[Array, Array, Array, Array, Array]:
    """Ends (n, 3) of increments that begin at poses (n, 3), F C Fᵀ, F D, lengths (n,), turned C."""
    ends, axes = _ends(starts, increments.delta), rotation3(starts[:, 2])
    lever = _lever(-ends)
    length_m = np.hypot(increments.delta[:, 0], increments.delta[:, 1])
    turned = transformed(increments.cov, axes)
    return ends, transformed(turned, lever), (lever @ axes) @ increments.d_cal, length_m, turned


def _ends(starts: Array, delta: Array) -> Array:
    return np.asarray(starts + (rotation3(starts[:, 2]) @ delta[:, :, None])[:, :, 0])


def _prefix(each: Array) -> Array:
    """Sums (w + 1, ...) of the first k of w values."""
    return np.concatenate([np.zeros((1, *each.shape[1:])), np.cumsum(each, axis=0)])


def _lever(poses: Array) -> Array:
    """(n, 3, 3): what an error of a pose at the origin does at rigidly connected poses (n, 3)."""
    T = np.tile(np.eye(3), (len(poses), 1, 1))
    T[:, 0, 2], T[:, 1, 2] = -poses[:, 1], poses[:, 0]
    return T
