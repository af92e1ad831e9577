"""Steps of an optimiser along the paths of robots, which straight ones leave.

Where few loops hold a path, a small turn at its begin moves its end by metres. A Gauss-Newton step
that says so moves landmarks and states along straight lines instead of arcs: what was seen no
longer fits, the error rises, and damped steps creep. Here the same step is taken by poses relative
to the state before, and by landmarks relative to the state that saw them first. To first order it
is the same one. Relative poses as variables of a pose graph: Olson, Leonard and Teller, 2006,
doi:10.1109/ROBOT.2006.1642040.
"""

from collections import defaultdict

import gtsam
import numpy as np

from graphslam.core.geometry import Array, adjoint, between, compose, exp, inverse, unit_vectors
from graphslam.estimation import factors


class PathRetraction:
    """Moves the states of a graph and what they see along paths; other variables as GTSAM does."""

    def __init__(self, graph: gtsam.NonlinearFactorGraph) -> None:
        """Find the paths, and the first state that sees each landmark."""
        links = [graph.at(n).keys() for n in range(graph.size())]
        paths: dict[int | None, list[int]] = defaultdict(list)
        for key in sorted({key for keys in links for key in keys if factors.is_state(key)}):
            paths[factors.number_of(key)[0]].append(key)
        self._paths = list(paths.values())
        self._seen_from = _seen_from([tuple(sorted(keys)) for keys in links if len(keys) == 2])

    def __call__(self, values: gtsam.Values, step: gtsam.VectorValues) -> gtsam.Values:
        """The values moved by a step; see the module."""
        moved = values.retract(step)
        numbers: dict[int, int] = {}
        befores, steps, afters = [], [], []
        for keys in self._paths:
            numbers.update((key, len(numbers)) for key in keys)
            before = np.array([factors.read(values, key, 3) for key in keys])
            change = np.array([step.at(key) for key in keys])
            befores.append(before)
            steps.append(change)
            afters.append(_path(before, change))
            for key, pose in zip(keys, afters[-1], strict=True):
                factors.overwrite(moved, key, pose)
        if not self._seen_from:
            return moved
        before, change, after = map(np.vstack, (befores, steps, afters))
        keys = list(self._seen_from)
        first = np.array([numbers[self._seen_from[key]] for key in keys])
        dims = [len(step.at(key)) for key in keys]
        # a point is a pose that turns with the state
        own = np.zeros((len(keys), 3))
        own_step = np.zeros((len(keys), 3))
        own_step[:, 2] = change[first, 2]
        for k, (key, dim) in enumerate(zip(keys, dims, strict=True)):
            own[k, :dim] = factors.read(values, key, dim)
            own_step[k, :dim] = step.at(key)
        own = compose(after[first], _relative(before[first], change[first], own, own_step))
        for key, dim, value in zip(keys, dims, own, strict=True):
            factors.overwrite(moved, key, value[:dim])
        return moved


def _seen_from(links: list[tuple[int, ...]]) -> dict[int, int]:
    """Landmark -> the first state that it has a factor with, itself or by a point in its place.

    ``links``: pairs of keys, sorted; those of states are the largest.
    """
    first: dict[int, int] = {}
    for other, state in links:
        if factors.is_state(state) and not factors.is_state(other):
            first[other] = min(state, first.get(other, state))
    by_points: dict[int, int] = {}
    for one, other in links:
        if not factors.is_state(other):
            for a, b in ((one, other), (other, one)):
                if a not in first and b in first:
                    by_points[a] = min(first[b], by_points.get(a, first[b]))
    return first | by_points


def _relative(before: Array, change: Array, own: Array, own_change: Array) -> Array:
    """Poses (n, 3) relative to others (n, 3), moved by the relative part of body-frame steps."""
    relative = between(before, own)
    carried = (adjoint(inverse(relative)) @ change[:, :, None])[..., 0]
    return compose(relative, exp(own_change - carried))


def _path(before: Array, change: Array) -> Array:
    """States (n, 3) of one path, moved each relative to the one before."""
    relative = _relative(before[:-1], change[:-1], before[1:], change[1:])
    first = compose(before[0], exp(change[0]))
    heading = first[2] + np.concatenate([[0.0], np.cumsum(relative[:, 2])])
    ahead = unit_vectors(heading[:-1])
    aside = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    moves = relative[:, :1] * ahead + relative[:, 1:2] * aside
    positions = first[:2] + np.vstack([np.zeros(2), np.cumsum(moves, axis=0)])
    return np.column_stack([positions, heading])
