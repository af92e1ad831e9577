"""Data association of all observations of walls again, by the solved estimate.

While the log was read, an observation was associated with the map of that time: of a wall that was
estimated elsewhere, or twice, it may have been associated with the wrong one. Each observation now
goes to the wall that it fits best; one that fits none is dropped.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.geometry import Array, compose, wrap
from graphslam.core.records import Association, Estimate, Step
from graphslam.mapping.landmark_map import Entry, observed_from, retarget

#: m across, rad: typical residuals of an observation at its own wall, the unit of the distance
SIGMA_M, SIGMA_RAD = 0.03, 0.02
#: squared distance by which another wall must fit better than the present one
BETTER = 4.0
#: observations compared with all walls at once
CHUNK = 2000


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
) -> Reassociated:
    """Associate observations of lines and segments with the walls that they fit best.

    ``entries`` are the landmarks as estimated. The middle of an observation may lie ``gate_m`` off
    a wall and ``beyond_m`` beyond its ends, and its direction may differ by ``gate_rad``.
    """
    walls = [e for i, e in entries.items() if i in estimate.landmarks and e.kind != "point"]
    place = {e.id: k for k, e in enumerate(walls)}
    seen = [a for step in steps for a in step.associations if a.target in place]
    if not seen:
        return Reassociated(tuple(steps), 0, 0)
    world = compose(observed_from(seen, estimate), np.array([a.z for a in seen]))
    own = np.array([place[a.target] for a in seen if isinstance(a.target, int)])
    best = np.concatenate([
        _best(world[k : k + CHUNK], own[k : k + CHUNK], walls, gate_m, gate_rad, beyond_m)
        for k in range(0, len(seen), CHUNK)
    ])  # fmt: skip
    best = _exclusive(seen, own, best)
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
        made.append(replace(step, associations=tuple(kept)))
    moved, dropped = (best != own) & (best >= 0), best < 0
    return Reassociated(tuple(made), int(moved.sum()), int(dropped.sum()))


def _best(
    seen: Array, own: Array, walls: Sequence[Entry], gate_m: float, gate_rad: float, beyond_m: float
) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Index of the wall that fits each observed pose (n, 3; world frame) best; -1 for none."""
    means, extents = np.array([e.mean for e in walls]), np.array([e.extent for e in walls])
    c, s = np.cos(means[:, 2]), np.sin(means[:, 2])
    dx, dy = seen[:, None, 0] - means[:, 0], seen[:, None, 1] - means[:, 1]
    along, across = c * dx + s * dy, c * dy - s * dx
    turn = wrap(seen[:, None, 2] - means[:, 2])
    fits = (
        (np.abs(across) <= gate_m)
        & (np.abs(turn) <= gate_rad)
        & (along >= extents[:, 0] - beyond_m)
        & (along <= extents[:, 1] + beyond_m)
    )
    d2 = np.where(fits, (across / SIGMA_M) ** 2 + (turn / SIGMA_RAD) ** 2, np.inf)
    rows = np.arange(len(seen))
    best = d2.argmin(axis=1)
    stays = ~(d2[rows, best] + BETTER < d2[rows, own])
    best = np.where(stays, own, best)
    return np.where(np.isfinite(d2[rows, best]), best, -1)


def _exclusive(seen: Sequence[Association], own: Array, best: Array) -> Array:
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
