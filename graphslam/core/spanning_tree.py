"""Initial poses of a pose graph: each composed along its most accurate path from a known pose."""

import heapq
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphslam.core.geometry import Array, compose, inverse


@dataclass(frozen=True, slots=True, eq=False)
class RelativePoses:
    """Relative poses (n, 3) of nodes ``end`` (n,) in the frames of nodes ``start`` (n,).

    ``variance`` (n,) is what each adds to that of a path.
    """

    start: NDArray[np.int64]
    end: NDArray[np.int64]
    delta: Array
    variance: Array


def spanning_tree_poses(
    count: int, known: Mapping[int, tuple[Array, float]], edges: RelativePoses
) -> Array:
    """Poses (count, 3) of nodes along paths of least variance (E. Dijkstra, 1959).

    Odometry alone may be off by the whole map at the end of a log, too far for an optimiser that
    linearises. A path through loop closures is short. Nodes that no path reaches are NaN.

    Args:
        count: number of nodes.
        known: node -> its pose (3,), and the variance with which its paths begin.
        edges: to be followed in either direction.
    """
    following: list[list[tuple[int, float, Array]]] = [[] for _ in range(count)]
    ends = edges.start.tolist(), edges.end.tolist(), edges.variance.tolist()
    for a, b, variance, there, back in zip(*ends, edges.delta, inverse(edges.delta), strict=True):
        following[a].append((b, variance, there))
        following[b].append((a, variance, back))
    poses = np.full((count, 3), np.nan)
    found = [np.inf] * count
    reached = [False] * count
    queue: list[tuple[float, int]] = []
    for node, (pose, variance) in known.items():
        poses[node], found[node] = pose, variance
        queue.append((variance, node))
    heapq.heapify(queue)
    while queue:
        total, node = heapq.heappop(queue)
        if reached[node]:
            continue
        reached[node] = True
        for other, variance, delta in following[node]:
            if total + variance < found[other]:
                found[other] = total + variance
                poses[other] = compose(poses[node], delta)
                heapq.heappush(queue, (found[other], other))
    return poses
