"""One scan aligned with what the scans just before it saw: point to line, near a predicted pose.

The steps of the alignment are those of `graphslam.perception.scan_matching.align_pairs`, but for
one scan after the other in real order: each has a prediction, of which the covariance counts as
information. So directions that the scan does not determine (along a corridor) keep what was
predicted, and those that it determines hardly depend on it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from graphslam.core.config import ScanMatchingConfig
from graphslam.core.geometry import Array, inverse, rotation, transform, wrap
from graphslam.perception.ordered_scan import Mask
from graphslam.perception.point_to_line import (
    gauss_newton_step,
    normal_equations,
    point_terms,
    step_poses,
)
from graphslam.perception.scan_matching import (
    BEAMS,
    CORRELATED_POINTS,
    MIN_NEIGHBOURS,
    SAME_SIGMAS,
    beam_of,
    make_submap,
    match,
)

#: rad: noise of a surface's direction
SURFACE_SIGMA_RAD = 0.05
#: points of a scan that are aligned
ALIGNED_POINTS = 360
#: steps of an alignment at most; it has converged when nothing moves more than this, m and rad
ITERATIONS, CONVERGED = 12, 5e-4
#: where the predicted pose is good, a point's counterpart is as near as this share of the reach
PREDICTED_REACH = 0.5
#: share of points on others with which an alignment is beyond doubt; one with less, and with a
#: larger sigma (m) along its weakest direction, is compared with others along that direction:
#: walls alone look the same from many places, and the nearest points of two scans always attract
#: each other a little
CERTAIN_SHARE, CERTAIN_SIGMA_M = 0.97, 0.03
ALONG_M = np.array([-0.4, -0.3, -0.2, -0.1, 0.1, 0.2, 0.3, 0.4])
#: by so much more of the points must another pose lie on others, to be preferred
BETTER_SHARE = 0.04
#: share of points on others below which a pose is looked for elsewhere, and below which the scan
#: says nothing. As much of the points out of view counts as on others: what a laser that looks
#: back sees is new on either side, and would be on others if the robot had not moved on
USUAL_SHARE, LOST_SHARE = 0.8, 0.3
#: a direction is one of motion, not of turning, if this share of it is; steps of poses that are
#: only compared, and information (1/m², 1/rad²) that holds them
OPEN_SHARE, COMPARED_STEPS, HOLD = 0.7, 1, 100.0


@dataclass(frozen=True, slots=True, eq=False)
class AlignedScan:
    """Where a scan lies in a map: ``pose`` (3,), and the ``share`` of its points on others.

    ``agreement``: that share, as much of those out of view as usual included, which is what poses
    are compared by. ``information`` (3, 3) is that of the scan alone, without the prediction, by
    additive errors along the axes of the map; zero where the scan fits nowhere.
    """

    pose: Array
    information: Array
    share: float
    agreement: float


@dataclass(frozen=True, slots=True, eq=False)
class ScanMap:
    """Points (n, 2) m that some scans saw and their ``information`` (n, 2, 2), see `Submap`.

    The last scan was made at ``mount`` (3,); ``in_view`` (`BEAMS`,) says which degrees it saw.
    """

    points: Array
    information: Array
    tree: cKDTree
    mount: Array
    in_view: Mask
    config: ScanMatchingConfig

    def linearise(self, points: Array, poses: Array, reach_m: float) -> tuple[Array, Array, Array]:
        """Normal equations of points (m, 2), seen from each of n poses (n, 3), within reach.

        Returns:
            Information (n, 3, 3) and gradient (n, 3), in which `CORRELATED_POINTS` count as one,
            and how much (n, m) of each point is on others: all 0 with hardly any neighbours.
        """
        placed, arms = _placed(points, poses)
        distance, near = self.tree.query(placed, distance_upper_bound=reach_m)
        ok = distance < np.inf
        near = np.where(ok, near, 0)
        terms, squared = point_terms(placed - self.points[near], self.information[near], arms)
        w = ok / (1.0 + squared / 4.0)
        w[ok.sum(axis=1) < MIN_NEIGHBOURS] = 0.0
        A, g = normal_equations(np.einsum("knm,nm->kn", terms, w))
        return A / CORRELATED_POINTS, g / CORRELATED_POINTS, w

    def agreements(self, points: Array, poses: Array, on_others: Array) -> Array:
        """See `AlignedScan`: (n,) of points (m, 2) from n poses (n, 3), by `linearise`."""
        x, y = transform(inverse(self.mount), _placed(points, poses)[0].reshape(-1, 2)).T
        new = ~self.in_view[beam_of(x, y)].reshape(on_others.shape) & (on_others == 0.0)
        return np.asarray((on_others + USUAL_SHARE * new).mean(axis=1))


def _placed(points: Array, poses: Array) -> tuple[Array, Array]:
    """Points (m, 2) seen from each of n poses (n, 3), and their arms: (n, m, 2) each."""
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    x, y = points.T
    arms = np.stack([c * x - s * y, s * x + c * y], axis=-1)
    return arms + poses[:, None, :2], arms


def scan_map(
    scans: Sequence[tuple[Array, Array]], seen_last: Array, mount: Array, config: ScanMatchingConfig
) -> ScanMap:
    """A map of scans: the `scan_surfaces` of each, in one frame.

    The last of them was made by a laser at ``mount`` (3,), which saw points ``seen_last`` (n, 2).
    """
    points = np.concatenate([points for points, _ in scans])
    information = np.concatenate([information for _, information in scans])
    seen = np.zeros(BEAMS, dtype=np.bool_)
    seen[beam_of(*transform(inverse(mount), seen_last).T)] = True
    in_view = seen | np.roll(seen, 1) | np.roll(seen, -1)  # angles between beams may be larger
    return ScanMap(points, information, cKDTree(points), mount, in_view, config)


def moved_scan(scan: tuple[Array, Array], pose: Array) -> tuple[Array, Array]:
    """Points and their information in a frame in which their own is at ``pose`` (3,)."""
    R = rotation(float(pose[2]))
    return transform(pose, scan[0]), R @ scan[1] @ R.T


def align_scan(
    points: Array, shown: Mask, scans: ScanMap, guess: Array, cov: Array, before: Array,
    window: Array,
) -> AlignedScan:  # fmt: skip
    """Where a scan of points (n, 2) lies on the scans before it.

    Args:
        points: in the frame of its state.
        shown: (n,) which of them show a surface with those beside them. Others are so sparse that
            they lie on others by chance, most of all if the robot stands, since beams are the same.
        scans: the map.
        guess: (3,) predicted pose in the map.
        cov: (3, 3) of the prediction.
        before: (3,) pose of the scan before, another guess.
        window: (3,) m, m, rad: half of where it is looked for, if it does not fit there.

    Returns:
        The pose; that which was predicted, without a share, if the scan fits nowhere.
    """
    lost = AlignedScan(guess, np.zeros((3, 3)), 0.0, 0.0)
    if len(points) < MIN_NEIGHBOURS:
        return lost
    every = -(-len(points) // ALIGNED_POINTS)
    points, shown = points[::every], shown[::every]
    one = _Alignment(points, shown, scans, np.asarray(np.linalg.inv(cov), dtype=float))
    reach_m = scans.config.reach_m
    best = one.from_start(guess, guess, PREDICTED_REACH * reach_m)
    if best.share < CERTAIN_SHARE:
        best = one.better_along(best)
    if best.share < USUAL_SHARE:
        for start in (guess, before):
            best = _better(one.from_start(start, guess, reach_m), best)
    if best.share < USUAL_SHARE:
        best = one.searched(best, guess, window)
    if best.share < LOST_SHARE:
        return lost
    return replace(best, information=_trusted(best.information))


def _trusted(information: Array) -> Array:
    """Information (3, 3) without what noise of the surfaces' directions adds along them."""
    across = float(np.linalg.eigvalsh(information[:2, :2])[1])
    along = across * SURFACE_SIGMA_RAD**2
    values, axes = np.linalg.eigh(information - np.diag([along, along, 0.0]))
    return np.asarray((axes * np.maximum(values, 0.0)) @ axes.T, dtype=float)


def _better(other: AlignedScan, one: AlignedScan) -> AlignedScan:
    return other if other.agreement > one.agreement + BETTER_SHARE else one


@dataclass(frozen=True, slots=True, eq=False)
class _Alignment:
    """Points (n, 2) of a scan, the map, and the information (3, 3) of the prediction.

    ``shown`` (n,): see `align_scan`.
    """

    points: Array
    shown: Mask
    scans: ScanMap
    information: Array

    @property
    def near_m(self) -> float:
        """How near its counterpart a point is in the end."""
        return SAME_SIGMAS * self.scans.config.point_sigma_m

    def from_start(self, start: Array, guess: Array, reach_m: float) -> AlignedScan:
        """The alignment from a start (3,), given a guess (3,)."""
        x = at = start[None].copy()
        for _ in range(ITERATIONS):
            A, g, on_others = self.scans.linearise(self.points, x, reach_m)
            off = x[0] - guess
            off[2] = wrap(off[2])
            seen, at = A[0], x
            step = gauss_newton_step(seen + self.information, g[0] + self.information @ off)
            x = step_poses(x, step)
            if reach_m <= self.near_m and np.abs(step).max() < CONVERGED:
                break
            reach_m = max(self.near_m, 0.5 * reach_m)
        agreement = self.scans.agreements(self.points, at, on_others)
        return AlignedScan(x[0], seen, float(on_others.mean()), float(agreement[0]))

    def better_along(self, best: AlignedScan) -> AlignedScan:
        """The best of poses along the direction in which the scan says least, if that is open."""
        variances, axes = np.linalg.eigh(np.linalg.inv(best.information + self.information))
        weakest = axes[:, 2]
        if variances[2] < CERTAIN_SIGMA_M**2 or np.hypot(weakest[0], weakest[1]) < OPEN_SHARE:
            return best
        x = best.pose + ALONG_M[:, None] * weakest
        for _ in range(COMPARED_STEPS):
            A, g, _ = self.scans.linearise(self.points, x, self.near_m)
            x = step_poses(x, gauss_newton_step(A + HOLD * np.eye(3), g))
        agreements = self.agreements_shown(x)
        top = int(agreements.argmax())
        least = self.agreements_shown(best.pose[None])[0] + BETTER_SHARE
        if agreements[top] <= least:
            return best
        other = self.from_start(x[top], x[top], self.near_m)
        return other if self.agreements_shown(other.pose[None])[0] > least else best

    def agreements_shown(self, poses: Array) -> Array:
        """Agreements (n,) of points that show surfaces, from poses (n, 3)."""
        points = self.points[self.shown]
        if len(points) < MIN_NEIGHBOURS:
            return np.zeros(len(poses))
        on_others = self.scans.linearise(points, poses, self.near_m)[2]
        return self.scans.agreements(points, poses, on_others)

    def searched(self, best: AlignedScan, guess: Array, window: Array) -> AlignedScan:
        """The best of the poses that a search in a window finds."""
        own, others = (
            make_submap(np.zeros((1, 3)), [points], self.scans.config)
            for points in (self.points, self.scans.points)
        )
        for found in match(own, others, guess, window):
            best = _better(self.from_start(found.pose, found.pose, self.near_m), best)
        return best
