"""A path estimated from all pairs of neighbouring scans at once (scan network).

Scan matching one scan after another drifts: by a degree over a room, and differently from every
start. Here all poses are estimated together (doi:10.1023/A:1008854305733). The returns of each scan
should lie on those of its neighbours: on the line through them where they are straight, else on the
nearest point. The motion of the smoothed path constrains what the scans leave open. Neighbours are
scans close in time, scans close in space after the robot has come back, and where several paths
lead through one place the nearest scans of each other path.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, permutations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from graphslam.change_detection.elastic_path import motion_terms
from graphslam.change_detection.visit import Bools, Ints
from graphslam.core.geometry import Array, between, rotation3
from graphslam.core.worker import core_count
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
#: scans of each other path that a scan is matched to, at most, as far away as revisits
_NEAREST = 4
#: information (1/m², 1/rad²) that holds the first pose of a path, and that with which it stays
#: where it is in a round if scans of another path are near: these may turn out to tell nothing
_HELD, _PLACED = 1e12, 1.0
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
    poses: Sequence[Array],
    clouds: Sequence[Cloud],
    motions: Sequence[Array],
    sigmas: Array,
    doubted: float,
) -> list[Array]:
    """The poses (s, 3) of each path at which all scans agree best; the first one of all is fixed.

    The initial ``poses`` (s, 3) of each path, all in one frame, are right to a few decimetres among
    neighbours. Each path has its ``clouds`` and ``motions`` (s - 1, 3) from each pose to the next;
    their ``sigmas`` and robust scale ``doubted`` are those of `motion_terms`. A path that no other
    comes near is refined alone, where it is.
    """
    bounds = np.cumsum([0, *(len(path) for path in poses)]).tolist()
    cloud, placed = _joined(clouds, bounds), np.concatenate(poses)
    tree = cKDTree(np.column_stack([cloud.points, _PLANE_SPACING_M * cloud.scan]))
    chosen, weight = _thin(cloud.scan, len(placed))
    for gate in _GATES_M:
        right = np.zeros_like(placed)
        late, early = _pairs(placed, bounds, weight > 0)
        firsts = np.array(bounds[:-1])
        held = np.where(_near_earlier(late, early, firsts), _PLACED, _HELD)
        blocks = [(firsts, firsts, held[:, None, None] * np.eye(3))]
        for (low, high), motion in zip(pairwise(bounds), motions, strict=True):
            scans = np.arange(low, high)
            diagonal, above, right[low:high] = motion_terms(
                placed[low:high], motion, sigmas, doubted
            )
            blocks += [
                (scans, scans, diagonal),
                (scans[:-1], scans[1:], above),
                (scans[1:], scans[:-1], above.mT),
            ]
        for low in range(0, len(late), _PAIRS):
            pair = late[low : low + _PAIRS], early[low : low + _PAIRS]
            A, g, F = _match_pairs(placed, cloud, tree, pair, chosen, weight, gate)
            for rows, F_row in zip(pair, F, strict=True):
                np.add.at(right, rows, -(F_row.mT @ g[..., None])[..., 0])
                for columns, F_column in zip(pair, F, strict=True):
                    blocks.append((rows, columns, F_row.mT @ A @ F_column))
        placed = step_poses(placed, _solve(blocks, right))
    return np.split(placed, bounds[1:-1])


def _joined(clouds: Sequence[Cloud], bounds: Sequence[int]) -> Cloud:
    """One cloud of all paths, whose scans follow each other from ``bounds`` on."""
    scan = [cloud.scan + first for cloud, first in zip(clouds, bounds, strict=False)]
    return Cloud(
        np.concatenate(scan),
        np.concatenate([cloud.points for cloud in clouds]),
        np.concatenate([cloud.metrics for cloud in clouds]),
    )


def _thin(scan: Ints, scans: int) -> tuple[Ints, Array]:
    """Rows (s, p) of the returns that stand for each scan, and the weight (s,) of one of them."""
    bounds = np.searchsorted(scan, np.arange(scans + 1))
    low, high = bounds[:-1], bounds[1:]
    share = np.arange(_POINTS) / _POINTS
    chosen = low[:, None] + np.floor(share * (high - low)[:, None]).astype(np.int64)
    return np.minimum(chosen, len(scan) - 1), np.minimum((high - low) / _POINTS, 1.0)


def _pairs(poses: Array, bounds: Sequence[int], with_returns: Bools) -> tuple[Ints, Ints]:
    """Pairs (k,) of scans that are matched: the one whose returns are taken, and its neighbour."""
    paths = [(low, poses[low:high]) for low, high in pairwise(bounds)]
    found = [_neighbours(path) + low for low, path in paths]
    found += [
        _nearest(path, other) + np.array([low, first])
        for (low, path), (first, other) in permutations(paths, 2)
    ]
    one, neighbour = np.concatenate(found).T
    usable = with_returns[one] & with_returns[neighbour]
    return one[usable], neighbour[usable]


def _near_earlier(one: Ints, neighbour: Ints, firsts: Ints) -> Bools:
    """Which paths, by their first scans, have pairs (k,) of scans with a path before them."""
    paths = np.searchsorted(firsts, np.array([one, neighbour]), side="right") - 1
    return np.isin(np.arange(len(firsts)), paths.max(axis=0)[paths[0] != paths[1]])


def _neighbours(poses: Array) -> Ints:
    """Pairs (k, 2) of neighbouring scans of one path, the later and the earlier one."""
    scans = np.arange(len(poses))
    in_time = np.column_stack(
        [
            np.repeat(scans, len(_BEFORE)),
            np.repeat(scans, len(_BEFORE)) - np.tile(_BEFORE, len(scans)),
        ]
    )
    some = scans[::_EVERY]
    revisits = cKDTree(poses[some, :2]).query_pairs(_REVISIT_M, output_type="ndarray")
    revisits = some[np.sort(revisits, axis=1)[:, ::-1]]
    revisits = revisits[revisits[:, 0] - revisits[:, 1] >= _REVISIT_SCANS]
    return np.concatenate([in_time[in_time[:, 1] >= 0], revisits])


def _nearest(poses: Array, others: Array) -> Ints:
    """Pairs (k, 2) of scans of one path and those of another that were made nearest to them."""
    away, near = cKDTree(others[:, :2]).query(
        poses[:, :2], k=np.arange(1, _NEAREST + 1), distance_upper_bound=_REVISIT_M
    )
    row, column = np.nonzero(np.isfinite(away))
    return np.column_stack([row, near[row, column]])


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
    sought = np.concatenate([there, planes], axis=2)
    away, near = tree.query(sought, distance_upper_bound=gate_m, workers=core_count())
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
    # symmetric and positive definite: an order for such matrices, and no pivots
    factors = splu(
        A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
    return np.asarray(factors.solve(right.ravel())).reshape(right.shape)
