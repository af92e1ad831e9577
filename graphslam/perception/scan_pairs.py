"""Consecutive scans compared where odometry puts them, many pairs at once.

Most motions are right, and all that is needed is to see that. This is `scan_matching.fits` for the
single scans of a block: one tree holds all points, each scan far from the next, and surfaces come
from the neighbours along the beams instead of those in space.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from graphslam.core.arrays import IntArray
from graphslam.core.config import ScanMatchingConfig
from graphslam.core.geometry import Array, transform_each
from graphslam.perception.point_to_line import normal_equations, point_terms
from graphslam.perception.scan_matching import (
    CORRELATED_POINTS,
    MIN_NEIGHBOURS,
    NEIGHBOURHOOD_CELLS,
    REGULAR,
    SAME_SIGMAS,
    UNKNOWN_VAR,
    information_from_scatter,
)

#: m between two scans in the tree: far beyond the range of any laser
APART_M = 1e4
#: returns on either side of one that show the surface there
BESIDE = 4


@dataclass(frozen=True, slots=True, eq=False)
class PairFits:
    """How well scans lie on the ones before, see `scan_matching.fits`.

    ``share`` (n,) of points on others, ``step`` (n, 3) of the pose, ``cov`` (n, 3, 3) after it.
    """

    share: Array
    step: Array
    cov: Array


def fit_pairs(
    clouds: Sequence[Array], target: IntArray, source: IntArray, pose: Array,
    config: ScanMatchingConfig,
) -> PairFits:  # fmt: skip
    """Fit n pairs of scans.

    Args:
        clouds: points (k, 2) m of each scan in the order of its beams, in the frame of its state.
        target: (n,) the scan before, by number.
        source: (n,) the later scan.
        pose: (n, 3) of the later state in the frame of the earlier one.
        config: noise and reach.
    """
    count = np.array([len(c) for c in clouds])
    points = np.concatenate(clouds)
    scan = np.repeat(np.arange(len(clouds)), count)
    first = np.cumsum(count) - count
    information = surface_information(points, scan, config)
    apart = np.column_stack([APART_M * np.arange(len(clouds)), np.zeros(len(clouds))])
    tree = cKDTree(points + apart[scan])
    pair = np.repeat(np.arange(len(source)), count[source])
    ends = np.cumsum(count[source])
    rows = np.arange(len(pair)) - np.repeat(ends - count[source], count[source])
    rows += np.repeat(first[source], count[source])
    placed = transform_each(pose[pair], points[rows])
    reach = SAME_SIGMAS * config.point_sigma_m
    distance, near = tree.query(placed + apart[target[pair]], distance_upper_bound=reach)
    ok = np.isfinite(distance)
    pair, placed, near = pair[ok], placed[ok], near[ok]
    terms, squared = point_terms(placed - points[near], information[near], placed - pose[pair, :2])
    w = 1.0 / (1.0 + squared / 4.0)
    n = len(source)
    sums = np.array([np.bincount(pair, row * w, minlength=n) for row in terms])
    weight = np.bincount(pair, w, minlength=n)
    A, g = normal_equations(sums)
    A = A + REGULAR * np.eye(3)
    known = np.bincount(pair, minlength=n) >= MIN_NEIGHBOURS
    step = -np.linalg.solve(A, g[:, :, None])[:, :, 0]
    floor = np.diag([config.floor_m**2, config.floor_m**2, config.floor_rad**2])
    cov = CORRELATED_POINTS * np.linalg.inv(A) + floor
    return PairFits(
        np.where(known, weight / np.maximum(count[source], 1), 0.0),
        np.where(known[:, None], step, 0.0),
        np.where(known[:, None, None], cov, UNKNOWN_VAR * np.eye(3)),
    )


def surface_information(points: Array, scan: IntArray, config: ScanMatchingConfig) -> Array:
    """Information (n, 2, 2) of points (n, 2) across the surface that neighbouring returns show.

    ``scan`` (n,) is the scan of each point, see `surface_scatter`; for what it is, see
    `Submap.information`.
    """
    near_m = np.full(len(points), NEIGHBOURHOOD_CELLS * config.cell_m)
    count, _, (xx, xy, yy) = surface_scatter(points, scan, near_m, BESIDE)
    return information_from_scatter(count, xx, xy, yy, config)


def surface_scatter(
    points: Array, scan: IntArray, near_m: Array, beside: int
) -> tuple[Array, Array, tuple[Array, Array, Array]]:
    """How the returns beside each point scatter.

    Args:
        points: (n, 2) m; those of a scan follow each other in the order of the beams.
        scan: (n,) which scan each point is of.
        near_m: (n,) how far neighbours are from a point at most.
        beside: so many returns on either side are looked at.

    Returns:
        Number (n,) of neighbours, the point included; their mean (n, 2) m, less the point; and
        their second central moments (n,) m²: xx, xy, yy.
    """
    n = len(points)
    sums = np.zeros((6, n))
    sums[0] = 1.0
    limit = near_m**2
    for k in range(1, beside + 1):
        d = points[k:] - points[:-k]
        near = (scan[k:] == scan[:-k]) & ((d**2).sum(axis=1) <= np.minimum(limit[k:], limit[:-k]))
        d = d * near[:, None]
        x, y = d.T
        each = np.array([near.astype(float), x, y, x * x, x * y, y * y])
        sums[:, :-k] += each
        # seen from the later point, the earlier one is on the other side
        sums[:, k:] += each * np.array([1.0, -1.0, -1.0, 1.0, 1.0, 1.0])[:, None]
    count = sums[0]
    x, y, xx, xy, yy = sums[1:] / count
    return count, np.column_stack([x, y]), (xx - x * x, xy - x * y, yy - y * y)
