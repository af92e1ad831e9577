"""A path bent until all scans agree with those near them in time and in space.

Matched one after another, scans drift: by a degree over a room, and differently from every start.
Here all poses are found at once (doi:10.1023/A:1008854305733): each scan's returns lie on those of
its neighbours, on the line through them where they are straight, and the smoothed motion holds what
the scans leave open. Scans of places that were come back to are neighbours too.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from graphslam.change_detection.elastic_path import motion_terms
from graphslam.change_detection.visit import Bools, Ints
from graphslam.core.geometry import Array, wrap

#: neighbours in time, scans before; in space: fewest scans between, farthest, m, and every how many
_BEFORE = (1, 2, 4, 7, 11, 16, 22, 29)
_AGAIN, _NEAR_M, _EVERY = 60, 1.5, 3
#: returns of a scan that are enough, and pairs of scans at a time, which bounds the memory
_POINTS, _PAIRS = 60, 2000
#: the widest lets the ends of a loop find each other, and takes some rounds to pull them together
_GATES_M = (0.5, 0.5, 0.5, 0.4, 0.4, 0.3, 0.3, 0.2, 0.2, 0.15, 0.15, 0.1, 0.1, 0.1)
#: what returns lie off each other by, m: neighbours share errors, so more than their noise
_SIGMA_M = 0.04
#: farther apart than any two scans reach: layers of the tree, one per scan, m
_LAYER_M = 1000.0


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Returns of all scans: ``scan`` (n,) sorted, ``points`` (n, 2) m in the laser's frame.

    ``metrics`` (n, 2, 2) are projections: onto the normal where the surface is straight, else 1.
    """

    scan: Ints
    points: Array
    metrics: Array


def relax_scan_network(
    poses: Array, cloud: Cloud, motion: Array, sigmas: Array, doubted: float
) -> Array:
    """The poses (s, 3) with which all scans agree best; the first stays.

    Args:
        poses: (s, 3) to start from, right to a few decimetres among neighbours.
        cloud: returns.
        motion: (s - 1, 3) from each pose to the next.
        sigmas: (3,) of the motion, m, m, rad.
        doubted: distance of a motion, in sigmas, from which on it is doubted.
    """
    tree = cKDTree(np.column_stack([cloud.points, _LAYER_M * cloud.scan]))
    chosen, weight = _thinned(cloud.scan, len(poses))
    anchor = np.zeros((len(poses), 3, 3))
    anchor[0] = 1e12 * np.eye(3)
    for gate in _GATES_M:
        diagonal, beside, right = motion_terms(poses, motion, sigmas, doubted)
        late, early = _neighbours(poses, weight > 0)
        blocks = [(np.arange(len(poses)),) * 2 + (diagonal + anchor,)]
        blocks += [(np.arange(len(motion)), np.arange(1, len(poses)), beside)]
        blocks += [(np.arange(1, len(poses)), np.arange(len(motion)), beside.mT)]
        for low in range(0, len(late), _PAIRS):
            i, k = late[low : low + _PAIRS], early[low : low + _PAIRS]
            H, g = _agreements(poses, cloud, tree, (i, k), chosen[i], weight[i], gate)
            for a, rows in enumerate((i, k)):
                np.add.at(right, rows, -g[:, 3 * a : 3 * a + 3])
                for b, columns in enumerate((i, k)):
                    blocks.append((rows, columns, H[:, 3 * a : 3 * a + 3, 3 * b : 3 * b + 3]))
        poses = poses + _solved(blocks, right)
        poses[:, 2] = wrap(poses[:, 2])
    return poses


def _thinned(scan: Ints, scans: int) -> tuple[Ints, Array]:
    """Returns (s, p) that speak for each scan, and each scan's weight (s,) for one of them."""
    bounds = np.searchsorted(scan, np.arange(scans + 1))
    low, high = bounds[:-1], bounds[1:]
    share = np.arange(_POINTS) / _POINTS
    chosen = low[:, None] + np.floor(share * (high - low)[:, None]).astype(np.int64)
    return np.minimum(chosen, len(scan) - 1), np.minimum((high - low) / _POINTS, 1.0)


def _neighbours(poses: Array, seeing: Bools) -> tuple[Ints, Ints]:
    """Pairs (k,) of scans, the later and the earlier, that should agree."""
    scans = np.arange(len(poses))
    late = np.repeat(scans, len(_BEFORE))
    early = late - np.tile(_BEFORE, len(scans))
    few = scans[::_EVERY]
    again = cKDTree(poses[few, :2]).query_pairs(_NEAR_M, output_type="ndarray")
    again = few[np.sort(again, axis=1)[:, ::-1]]
    again = again[again[:, 0] - again[:, 1] >= _AGAIN]
    late, early = np.concatenate([late, again[:, 0]]), np.concatenate([early, again[:, 1]])
    both = (early >= 0) & seeing[late] & seeing[early]
    return late[both], early[both]


def _agreements(
    poses: Array,
    cloud: Cloud,
    tree: cKDTree,
    pairs: tuple[Ints, Ints],
    chosen: Ints,
    weight: Array,
    gate_m: float,
) -> tuple[Array, Array]:
    """What pairs of scans (k,), (k,) want of their poses.

    Returns:
        Information (k, 6, 6) of both poses and gradient (k, 6).
    """
    i, k = pairs
    R, S = _rotations(poses[i, 2]), _rotations(poses[k, 2])
    arm = cloud.points[chosen] @ R.mT
    there = (arm + (poses[i, :2] - poses[k, :2])[:, None]) @ S
    layer = np.broadcast_to((_LAYER_M * k)[:, None, None], (*there.shape[:2], 1))
    away, near = tree.query(np.concatenate([there, layer], axis=2), distance_upper_bound=gate_m)
    found = np.isfinite(away)
    near = np.where(found, near, 0)
    # everything in the frame of the earlier scan turned into the world's directions
    M = S[:, None] @ cloud.metrics[near] @ S.mT[:, None]
    target = cloud.points[near] @ S.mT
    d = np.where(found[..., None], there @ S.mT - target, 0.0)
    e = np.einsum("...ij,...j->...i", M, d)
    w = found * weight[:, None] * _SIGMA_M**-2.0
    w = w / (1 + (e**2).sum(axis=-1) * (2 / gate_m) ** 2) ** 2
    J = np.zeros((*d.shape, 6))
    J[..., 0, 0] = J[..., 1, 1] = 1.0
    J[..., 0, 3] = J[..., 1, 4] = -1.0
    J[..., 0, 2], J[..., 1, 2] = -arm[..., 1], arm[..., 0]
    J[..., 0, 5], J[..., 1, 5] = target[..., 1], -target[..., 0]
    # M is a projection: M = M M
    rows = (np.sqrt(w)[..., None, None] * (M @ J)).reshape(len(i), -1, 6)
    left = (np.sqrt(w)[..., None] * e).reshape(len(i), -1)
    return rows.mT @ rows, np.einsum("kri,kr->ki", rows, left)


def _rotations(angle: Array) -> Array:
    """Matrices (k, 2, 2) of angles (k,) rad."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)


def _solved(blocks: list[tuple[Ints, Ints, Array]], right: Array) -> Array:
    """Solution (s, 3) of a system of 3 x 3 blocks, lists of them with rows and columns."""
    three = np.arange(3)
    parts = []
    for rows, columns, values in blocks:
        r = np.broadcast_to(3 * rows[:, None, None] + three[:, None], values.shape)
        c = np.broadcast_to(3 * columns[:, None, None] + three, values.shape)
        parts.append((r.ravel(), c.ravel(), values.ravel()))
    r, c, v = (np.concatenate(part) for part in zip(*parts, strict=True))
    A = coo_array((v, (r, c)), shape=(right.size, right.size)).tocsc()
    return np.asarray(spsolve(A, right.ravel())).reshape(right.shape)
