"""Loops of two recorded closures between the same robots, and of the odometry between their ends.

Two closures agree if their loop closes within its uncertainty.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, adjoint, compose, inverse, log, rotate_cov
from graphslam.core.records import Motion, RelativePose
from graphslam.odometry.given_increments import consecutive_motions
from graphslam.odometry.preintegration import Track

#: probability up to which two closures agree; against all others together it is
#: `core.consistency.FIT_PROBABILITY`, so that true closures are rarely lost (false ones miss by far
#: more)
AGREE = 0.99
_UPPER = np.triu_indices(3)
#: the unit matrix by its upper triangle; precision of sums of covariances
UNIT, ROUNDING = np.eye(3)[_UPPER], 1e-15


@dataclass(frozen=True, slots=True, eq=False)
class OdometryChain:
    """A robot's odometry at the ends of closures: times (n,), poses (n, 3) from its first reading.

    ``spread`` (n, 3, 3) is the covariance of the odometry up to there, in the left tangent space of
    SE(2) at the first pose, so that the covariance of a stretch is the difference of its ends'.
    """

    times_ns: np.ndarray[tuple[int], np.dtype[np.int64]]
    poses: Array
    spread: Array
    motions: tuple[Motion, ...]

    def at(self, times_ns: Iterable[int]) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        """Indices (k,) of times in the chain."""
        return np.searchsorted(self.times_ns, np.array(list(times_ns), dtype=np.int64))


def odometry_chains(
    messages: Iterable[RelativePose], tracks: Mapping[str, Track]
) -> dict[str, OdometryChain]:
    """Robot -> its odometry between the ends of closures, beginning with its first reading."""
    times: dict[str, set[int]] = defaultdict(set)
    for m in messages:
        times[m.robot] |= {tracks[m.robot].first_ns, m.time_ns}
        times[m.other] |= {tracks[m.other].first_ns, m.start_ns}
    chains = {}
    for robot, needed in sorted(times.items()):
        at = np.array(sorted(needed), dtype=np.int64)
        moved = consecutive_motions(tracks[robot], at)
        poses = np.zeros((len(at), 3))
        for k, delta in enumerate(moved.delta):
            poses[k + 1] = compose(poses[k], delta)
        A = adjoint(poses[1:])
        steps = A @ rotate_cov(moved.cov, -moved.delta[:, 2]) @ A.mT
        spread = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(steps, axis=0)])
        motions = tuple(moved.one(k, int(a), int(b)) for k, (a, b) in enumerate(pairwise(at)))
        chains[robot] = OdometryChain(at, poses, spread, motions)
    return chains


def compared_loops(
    messages: Sequence[RelativePose], odometry: Mapping[str, OdometryChain]
) -> tuple[Array, Array]:
    """Closures between the same two robots, compared in pairs.

    Closure a sees the first pose of its robot's odometry at E_a in the frame of the other's. The
    loop of two is E_a E_b⁻¹; its errors are those of both closures and of the odometry between
    their ends, all in the tangent space at the first pose of the other robot.

    Returns:
        E (n, 3), and which agree (n, n) bool.
    """
    other, own = odometry[messages[0].other], odometry[messages[0].robot]
    i, j = other.at(m.start_ns for m in messages), own.at(m.time_ns for m in messages)
    z = np.array([m.delta for m in messages])
    seen = compose(other.poses[i], z)
    back = inverse(own.poses[j])
    E = compose(seen, back)
    R = rotate_cov(np.array([m.cov for m in messages]), -z[:, 2])
    at_other, at_own = adjoint(seen), adjoint(inverse(back))
    R_other, R_own = at_other @ R @ at_other.mT, at_own @ R @ at_own.mT
    A = _congruence(adjoint(E))
    # symmetric matrices by their upper triangles, so that taking them from frame to frame is linear
    there, here, R_other, R_own = (
        M[:, *_UPPER] for M in (other.spread[i], own.spread[j], R_other, R_own)
    )
    # differences of the sums along the path are not more accurate than this
    rounding = ROUNDING * max(np.abs(there).max(), np.abs(here).max()) * UNIT
    gate = chi2_quantile(AGREE, 3)
    agree = np.zeros((len(z), len(z)), dtype=bool)
    first = inverse(E)
    for a in range(len(z)):  # row by row: a matrix of 3 x 3 blocks would not fit
        r = log(compose(E[a], first))
        S = rounding + R_other[a] + np.sign(i - i[a])[:, None] * (there - there[a])
        S += (np.sign(j - j[a])[:, None] * (here - here[a]) + R_own) @ A[a].T
        agree[a] = _squared_distances(r, S) <= gate
    agree &= agree.T
    np.fill_diagonal(agree, False)
    return E, agree


def _congruence(A: Array) -> Array:
    """Matrices (n, 6, 6) that take the upper triangle of M to that of A M Aᵀ, for A (n, 3, 3)."""
    i, j = _UPPER
    out = A[:, i[:, None], i] * A[:, j[:, None], j]
    swapped = A[:, i[:, None], j] * A[:, j[:, None], i]
    return np.asarray(out + np.where(i == j, 0.0, swapped))


def _squared_distances(r: Array, S: Array) -> Array:
    """Squared Mahalanobis distances (n,) of r (n, 3) for covariances by upper triangle (n, 6).

    The square root is written out: NumPy's solution of small systems takes ten times as long.
    """
    (x, y, turn), (xx, xy, xt, yy, yt, tt) = r.T, S.T
    a, b = xy / xx, xt / xx
    y, yy, yt = y - a * x, yy - a * xy, yt - a * xt
    c = yt / yy
    turn, tt = turn - b * x - c * y, tt - b * xt - c * yt
    return np.asarray(x * x / xx + y * y / yy + turn * turn / tt)
