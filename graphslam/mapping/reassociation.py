"""Data association of all observations of walls again, by the solved estimate.

While the log was read, an observation was associated with the map of that time: of a wall that was
estimated elsewhere, or twice, it may have been associated with the wrong one. Each observation now
goes to the wall that it fits best; one that fits none is dropped.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import is_

import numpy as np
from scipy.spatial import cKDTree

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, compose, path_length, wrap
from graphslam.core.record import replace
from graphslam.core.records import Association, Estimate, Step
from graphslam.mapping.landmark_map import Entry, observed_from, retarget
from graphslam.mapping.wall_samples import sample_walls

#: m across, rad: typical residuals of an observation at its own wall, the unit of the distance
SIGMA_M, SIGMA_RAD = 0.03, 0.02
#: squared distance by which another wall must fit better than the present one
BETTER = 4.0
#: m: walls are sampled at this distance to find those near an observation
SAMPLE_M = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Reassociated:
    """Steps, and how many observations were moved to another wall or dropped."""

    steps: tuple[Step, ...]
    moved: int
    dropped: int


def reassociate(
    steps: Sequence[Step],
    estimate: Estimate,
    entries: Mapping[int, Entry],
    gate_m: float,
    gate_rad: float,
    beyond_m: float,
    within_m: float = math.inf,
) -> Reassociated:
    """Associate observations of lines and segments with the walls that they fit best.

    ``entries`` are the landmarks as estimated. The middle of an observation may lie ``gate_m`` off
    a wall and ``beyond_m`` beyond its ends, and its direction may differ by ``gate_rad``. The wall
    must have been seen by the same robot less than ``within_m`` of path before or after: where
    visits are not yet joined, an observation must not move to the wall of another visit. The work
    grows with the number of observations and of the walls near each.
    """
    walls = [e for i, e in entries.items() if i in estimate.landmarks and e.kind != "point"]
    place = {e.id: k for k, e in enumerate(walls)}
    seen = [a for step in steps for a in step.associations if a.target in place]
    if not seen:
        return Reassociated(tuple(steps), 0, 0)
    world = compose(observed_from(seen, estimate.states), np.array([a.z for a in seen]))
    own = np.array([place[a.target] for a in seen if isinstance(a.target, int)])
    pairs = _pairs_nearby(world, own, walls, gate_m, beyond_m)
    if math.isfinite(within_m):
        pairs = _on_one_stretch(pairs, seen, own, estimate, within_m)
    best = _exclusive(seen, own, _best(world, own, walls, pairs, gate_m, gate_rad, beyond_m))
    # `seen` goes through the steps in order, so one iterator pairs each with its result
    results = iter(best.tolist())
    made = []
    for step in steps:
        kept: list[Association] = []
        for a in step.associations:
            wall = next(results) if a.target in place else None
            if wall is None:
                kept.append(a)
            elif wall >= 0:
                kept.append(_moved(a, walls[wall]))
        same = len(kept) == len(step.associations) and all(map(is_, kept, step.associations))
        made.append(step if same else replace(step, associations=tuple(kept)))
    moved, dropped = (best != own) & (best >= 0), best < 0
    return Reassociated(tuple(made), int(moved.sum()), int(dropped.sum()))


def _on_one_stretch(
    pairs: tuple[IntArray, IntArray],
    seen: Sequence[Association],
    own: IntArray,
    estimate: Estimate,
    within_m: float,
) -> tuple[IntArray, IntArray]:
    """Those pairs whose wall the robot saw within so much path of the observation."""
    # one axis for all robots, each far from the next
    axis = np.zeros(len(seen))
    robots = np.array([a.robot for a in seen])
    times, begin = np.array([a.time_ns for a in seen]), 0.0
    for robot, states in estimate.states.items():
        mine = robots == robot
        path = path_length(states.poses)
        axis[mine] = begin + path[states.index(times[mine])]
        begin += float(path[-1]) + 3 * within_m
    i, j = pairs
    sightings = np.sort(own * begin + axis)  # wall by wall along the path
    low = np.searchsorted(sightings, j * begin + np.maximum(axis[i] - within_m, 0.0))
    high = np.searchsorted(sightings, j * begin + axis[i] + within_m, side="right")
    kept = high > low
    return i[kept], j[kept]


def _pairs_nearby(
    world: Array, own: IntArray, walls: Sequence[Entry], gate_m: float, beyond_m: float
) -> tuple[IntArray, IntArray]:
    """Pairs (p,), (p,) of observation and wall that are near each other, and its own wall of each.

    Walls are sampled; a tree finds the samples near each observation.
    """
    means, extents = np.array([e.mean for e in walls]), np.array([e.extent for e in walls])
    points, of = sample_walls(means, extents + np.array([-beyond_m, beyond_m]), SAMPLE_M)
    samples = cKDTree(points)
    reach = float(np.hypot(gate_m, SAMPLE_M / 2)) + 1e-9
    near = samples.query_ball_point(world[:, :2], reach)
    size = np.array([len(found) for found in near])
    i = np.repeat(np.arange(len(world)), size)
    j = of[np.fromiter(itertools.chain.from_iterable(near), dtype=np.int64, count=size.sum())]
    n = len(walls)
    pair = np.unique(np.concatenate([i * n + j, np.arange(len(world)) * n + own]))
    return pair // n, pair % n


def _best(
    world: Array,
    own: IntArray,
    walls: Sequence[Entry],
    pairs: tuple[IntArray, IntArray],
    gate_m: float,
    gate_rad: float,
    beyond_m: float,
) -> IntArray:
    """Index of the wall that fits each observed pose (world frame) best; -1 for none.

    ``pairs`` are those compared, sorted by observation, and hold every observation's own wall.
    """
    means, extents = np.array([e.mean for e in walls]), np.array([e.extent for e in walls])
    i, j = pairs
    c, s = np.cos(means[j, 2]), np.sin(means[j, 2])
    dx, dy = world[i, 0] - means[j, 0], world[i, 1] - means[j, 1]
    along, across = c * dx + s * dy, c * dy - s * dx
    turn = wrap(world[i, 2] - means[j, 2])
    fits = (
        (np.abs(across) <= gate_m)
        & (np.abs(turn) <= gate_rad)
        & (along >= extents[j, 0] - beyond_m)
        & (along <= extents[j, 1] + beyond_m)
    )
    d2 = np.where(fits, (across / SIGMA_M) ** 2 + (turn / SIGMA_RAD) ** 2, np.inf)
    first = np.flatnonzero(np.diff(i, prepend=-1))
    least = np.minimum.reduceat(d2, first)
    count = np.diff(first, append=len(i))
    is_least = np.flatnonzero(d2 == np.repeat(least, count))
    # of equals the first, as argmin does
    best = j[is_least[np.searchsorted(is_least, first)]]
    mine = own[i[first]]
    d2_own = d2[j == own[i]]
    stays = ~(least + BETTER < d2_own)
    best = np.where(stays, mine, best)
    return np.where(np.isfinite(np.where(stays, d2_own, least)), best, -1)


def _exclusive(seen: Sequence[Association], own: IntArray, best: IntArray) -> IntArray:
    """No wall twice in one image: an observation does not move to a wall that another one has.

    ``own`` (n,) are the walls that the observations were associated with, ``best`` (n,) those that
    they fit best, -1 for none.
    """
    taken: set[tuple[str, int, int]] = set()
    out = best.copy()
    for k in np.argsort(best != own, kind="stable"):  # those that stay choose first
        key = seen[k].robot, seen[k].time_ns, int(best[k])
        if key in taken and best[k] != own[k]:
            out[k] = own[k]
        if best[k] >= 0:
            taken.add(key)
    return out


def _moved(a: Association, wall: Entry) -> Association:
    return a if a.target == wall.id else replace(retarget(a, wall.id, wall.kind), late=False)
