"""A start for the batch solution of relative poses: states along the most accurate paths."""

from collections import defaultdict
from collections.abc import Iterable, Sequence

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.records import Closure, Estimate, Step, Trajectory
from graphslam.core.spanning_tree import RelativePoses, spanning_tree_poses


def initial_estimate(steps: Iterable[Step], closures: Iterable[Closure]) -> Estimate:
    """States composed along motions and closures from the robots' starts; covariances are NaN.

    Args:
        steps: starts and motions of all states, in the order of time.
        closures: between these states, all of them true.
    """
    number: dict[tuple[str, int], int] = {}
    times: dict[str, list[int]] = defaultdict(list)
    known: dict[int, tuple[Array, float]] = {}
    edges: list[tuple[int, int, Array, Array]] = []
    for step in steps:
        for robot in (*step.starts, *step.motions):
            number[robot, step.time_ns] = len(number)
            times[robot].append(step.time_ns)
        for robot, start in step.starts.items():
            known[number[robot, step.time_ns]] = start.pose, float(np.trace(start.cov))
        for robot, motion in step.motions.items():
            ends = number[robot, times[robot][-2]], number[robot, step.time_ns]
            edges.append((*ends, motion.delta, motion.cov))
    for c in closures:
        ends = number[c.other, c.other_time_ns], number[c.robot, c.time_ns]
        edges.append((*ends, c.delta, c.cov))
    poses = spanning_tree_poses(len(number), known, _relative_poses(edges))
    states = {
        robot: Trajectory(
            np.array(stamps, dtype=np.int64),
            poses[[number[robot, t] for t in stamps]],
            np.full((len(stamps), 3, 3), np.nan),
        )
        for robot, stamps in times.items()
    }
    return Estimate(states, {}, np.nan, 0)


def _relative_poses(edges: Sequence[tuple[int, int, Array, Array]]) -> RelativePoses:
    """Edges (start, end, delta, cov) as arrays."""
    start, end = (np.array([edge[k] for edge in edges], dtype=np.int64) for k in (0, 1))
    delta = np.array([edge[2] for edge in edges]).reshape(-1, 3)
    cov = np.array([edge[3] for edge in edges]).reshape(-1, 3, 3)
    return RelativePoses(start, end, delta, np.trace(cov, axis1=1, axis2=2))
