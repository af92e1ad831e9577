"""A path estimated from all pairs of neighbouring scans at once (scan network).

Scan matching one scan after another drifts: by a degree over a room, and differently from every
start. Here all poses are estimated together (doi:10.1023/A:1008854305733). The returns of each scan
should lie on those of its neighbours: on the line through them where they are straight, else on the
nearest point. The motion of the smoothed path constrains what the scans leave open. Neighbours are
scans close in time, and scans close in space after the robot has come back.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from graphslam.change_detection.elastic_path import motion_terms
from graphslam.change_detection.visit import Bools, Ints
from graphslam.core.geometry import Array, between, rotation3
from graphslam.perception.point_to_line import (
    normal_equations,
    point_terms,
    redescending,
    step_poses,
)

#: neighbours in time: how many scans before
_BEFORE = (1, 2, 4, 7, 11, 16, 22, 29)
#: neighbours in space: fewest scans between two, their largest distance in m, and of how many scans
#: one is taken
_REVISIT_SCANS, _REVISIT_M, _EVERY = 60, 1.5, 3
#: returns of a scan that are matched, and pairs of scans at a time, which bounds the memory
_POINTS, _PAIRS = 60, 2000
#: m, one per iteration: the wide ones let the ends of a loop find each other, and several rounds of
#: them are needed to pull the ends together
_GATES_M = (0.5, 0.5, 0.5, 0.4, 0.4, 0.3, 0.3, 0.2, 0.2, 0.15, 0.15, 0.1, 0.1, 0.1)
#: m: sigma of a return's distance. Neighbouring returns share errors, so more than their noise
_SIGMA_M = 0.04
#: m: one tree holds all scans, each in a plane of its own. No gate reaches from one to the next.
_PLANE_SPACING_M = 2 * max(_GATES_M)


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Returns of all scans: ``scan`` (n,) sorted, ``points`` (n, 2) m in the laser's frame.

    ``metrics`` (n, 2, 2) are n nᵀ of the normal where the surface is straight, else the identity.
    """

    scan: Ints
    points: Array
    metrics: Array


def relax_scan_network(
    poses: Array, cloud: Cloud, motion: Array, sigmas: Array, doubted: float
) -> Array:
    """The poses (s, 3) at which all scans agree best; the first one is fixed.

    The initial ``poses`` are right to a few decimetres among neighbours. ``motion`` (s - 1, 3) from
    each to the next, its ``sigmas`` and robust scale ``doubted`` are those of `motion_terms`.
    """
    tree = cKDTree(np.column_stack([cloud.points, _PLANE_SPACING_M * cloud.scan]))
    chosen, weight = _thin(cloud.scan, len(poses))
    anchor = np.zeros((len(poses), 3, 3))
    anchor[0] = 1e12 * np.eye(3)
    scans = np.arange(len(poses))
    for gate in _GATES_M:
        diagonal, above, right = motion_terms(poses, motion, sigmas, doubted)
        blocks = [
            (scans, scans, diagonal + anchor),
            (scans[:-1], scans[1:], above),
            (scans[1:], scans[:-1], above.mT),
        ]
        late, early = _neighbours(poses, weight > 0)
        for low in range(0, len(late), _PAIRS):
            pair = late[low : low + _PAIRS], early[low : low + _PAIRS]
            A, g, F = _match_pairs(poses, cloud, tree, pair, chosen, weight, gate)
            for rows, F_row in zip(pair, F, strict=True):
                np.add.at(right, rows, -(F_row.mT @ g[..., None])[..., 0])
                for columns, F_column in zip(pair, F, strict=True):
                    blocks.append((rows, columns, F_row.mT @ A @ F_column))
        poses = step_poses(poses, _solve(blocks, right))
    return poses


def _thin(scan: Ints, scans: int) -> tuple[Ints, Array]:
    """Rows (s, p) of the returns that stand for each scan, and the weight (s,) of one of them."""
    bounds = np.searchsorted(scan, np.arange(scans + 1))
    low, high = bounds[:-1], bounds[1:]
    share = np.arange(_POINTS) / _POINTS
    chosen = low[:, None] + np.floor(share * (high - low)[:, None]).astype(np.int64)
    return np.minimum(chosen, len(scan) - 1), np.minimum((high - low) / _POINTS, 1.0)


def _neighbours(poses: Array, with_returns: Bools) -> tuple[Ints, Ints]:
    """Pairs (k,) of scans that are matched, the later and the earlier ones."""
    scans = np.arange(len(poses))
    late = np.repeat(scans, len(_BEFORE))
    early = late - np.tile(_BEFORE, len(scans))
    some = scans[::_EVERY]
    revisits = cKDTree(poses[some, :2]).query_pairs(_REVISIT_M, output_type="ndarray")
    revisits = some[np.sort(revisits, axis=1)[:, ::-1]]
    revisits = revisits[revisits[:, 0] - revisits[:, 1] >= _REVISIT_SCANS]
    late, early = np.concatenate([late, revisits[:, 0]]), np.concatenate([early, revisits[:, 1]])
    usable = (early >= 0) & with_returns[late] & with_returns[early]
    return late[usable], early[usable]


def _match_pairs(
    poses: Array,
    cloud: Cloud,
    tree: cKDTree,
    pair: tuple[Ints, Ints],
    chosen: Ints,
    weight: Array,
    gate_m: float,
) -> tuple[Array, Array, tuple[Array, Array]]:
    """What the returns of one scan tell about its pose X in the frame of another, for k pairs.

    Returns:
        Information (k, 3, 3) and gradient (k, 3) of additive errors of X, and its derivatives
        (k, 3, 3) by the poses of both scans.
    """
    late, early = pair
    X = between(poses[early], poses[late])
    arms = cloud.points[chosen[late]] @ rotation3(X[:, 2])[:, :2, :2].mT
    there = arms + X[:, None, :2]
    planes = np.broadcast_to((_PLANE_SPACING_M * early)[:, None, None], (*there.shape[:2], 1))
    away, near = tree.query(np.concatenate([there, planes], axis=2), distance_upper_bound=gate_m)
    found = np.isfinite(away)
    near = np.where(found, near, 0)
    d = np.where(found[..., None], there - cloud.points[near], 0.0)
    terms, squared = point_terms(d, cloud.metrics[near], arms)
    w = found * weight[late, None] * _SIGMA_M**-2.0 * redescending(squared, gate_m)
    A, g = normal_equations((terms * w).sum(axis=-1))
    by_late = rotation3(-poses[early, 2])
    by_early = -by_late
    by_early[:, 0, 2], by_early[:, 1, 2] = X[:, 1], -X[:, 0]
    return A, g, (by_late, by_early)


def _solve(blocks: list[tuple[Ints, Ints, Array]], right: Array) -> Array:
    """Solution (s, 3) of a sparse system of 3 x 3 blocks, given with their rows and columns."""
    three = np.arange(3)
    parts = []
    for rows, columns, values in blocks:
        r = np.broadcast_to(3 * rows[:, None, None] + three[:, None], values.shape)
        c = np.broadcast_to(3 * columns[:, None, None] + three, values.shape)
        parts.append((r.ravel(), c.ravel(), values.ravel()))
    r, c, v = (np.concatenate(part) for part in zip(*parts, strict=True))
    A = coo_array((v, (r, c)), shape=(right.size, right.size)).tocsc()
    return np.asarray(spsolve(A, right.ravel())).reshape(right.shape)
