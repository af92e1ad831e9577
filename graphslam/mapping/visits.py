"""Landmarks are split by visit before loop closure and merged again after it.

Associations made with a large uncertainty may be wrong: one of two parallel walls is taken for the
other, which distorts the whole map. So loops are closed with separate landmarks for every visit.
Afterwards the parts of a landmark are merged again where their estimates agree.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import AssociationConfig
from graphslam.core.geometry import Array, between, path_length
from graphslam.core.records import Estimate, Step, Trajectory
from graphslam.mapping.duplicate_landmarks import (
    OVERLAP_SHARE,
    merged_steps,
    near_pairs,
)
from graphslam.mapping.landmark_map import Entry, LandmarkMap

#: m across, rad: walls of two visits that differ less, in a solution with closed loops, are one
TIE_M, TIE_RAD = 0.06, 0.03
#: m, rad: sigmas of the distance and the direction between two visits up to which that holds
CERTAIN_M, CERTAIN_RAD = 0.04, 0.02
#: m: parts of walls farther apart are not compared
NEAR_M = 0.9


#: see `tie_visits`
PairUncertainty = Callable[[IntArray, IntArray, Array, Array], Array]


@dataclass(frozen=True, slots=True, eq=False)
class SplitVisits:
    """Steps with separate landmarks per visit; ``original_id``: new landmark -> the one it was."""

    steps: tuple[Step, ...]
    original_id: Mapping[int, int]

    def start(self, estimate: Estimate) -> Estimate:
        """The estimate with every new landmark at the mean of the one it was."""
        landmarks = dict(estimate.landmarks)
        landmarks.update((new, landmarks[old]) for new, old in self.original_id.items())
        return replace(estimate, landmarks=landmarks)


def split_by_visit(
    steps: Sequence[Step],
    states: Mapping[str, Trajectory],
    landmarks: LandmarkMap,
    revisit_path_m: float,
) -> SplitVisits:
    """Steps in which every visit of every robot has its own landmarks.

    Another visit begins after a path of ``revisit_path_m`` without observing the landmark.
    Landmarks with an identity stay as they are.
    """
    named = set(landmarks.by_identity.values())
    seen = [
        (n, k, a.target, a)
        for n, step in enumerate(steps)
        for k, a in enumerate(step.associations)
        if isinstance(a.target, int) and a.target not in named
    ]
    if not seen:
        return SplitVisits(tuple(steps), {})
    robots = sorted(states)
    driven = {robot: path_length(states[robot].poses) for robot in robots}
    path = np.array([driven[a.robot][states[a.robot].index(a.time_ns)] for *_, a in seen])
    robot = np.array([robots.index(a.robot) for _, _, _, a in seen])
    target = np.array([t for _, _, t, _ in seen])
    order = np.lexsort((path, robot, target))
    known = np.diff(target[order]) == 0
    again = known & ((np.diff(robot[order]) != 0) | (np.diff(path[order]) > revisit_path_m))
    fresh = max(target.max(), max(landmarks.entries, default=0)) + 1
    number = np.concatenate([[0], np.cumsum(again)])  # of separations so far
    before = np.maximum.accumulate(np.where(np.append(True, ~known), number, 0))
    new = np.where(number > before, fresh + number - 1, target[order])
    changed: dict[int, dict[int, int]] = {}
    origin: dict[int, int] = {}
    for at, name in zip(order, new, strict=True):
        n, k, old, _ = seen[at]
        if name != old:
            changed.setdefault(n, {})[k] = int(name)
            origin[int(name)] = old
    made = list(steps)
    for n, renamed in changed.items():
        associations = list(steps[n].associations)
        for k, name in renamed.items():
            associations[k] = replace(associations[k], target=name)
        made[n] = replace(steps[n], associations=tuple(associations))
    return SplitVisits(tuple(made), origin)


def rejoin_visits(
    split: SplitVisits, estimate: Estimate, landmarks: LandmarkMap, config: AssociationConfig
) -> tuple[Step, ...]:
    """Steps in which landmarks of different visits that lie together are one again.

    ``estimate`` is that of the split steps, ``config`` says how far apart the landmarks of two
    visits may be. Landmarks that stay separate enter the map.
    """
    groups: dict[int, list[int]] = {}
    into: dict[int, int] = {}
    for new, old in sorted(split.original_id.items()):
        entry = landmarks.entries[old]
        mean = estimate.landmarks[new][0]
        for leader in groups.setdefault(old, [old]):
            if _is_same(estimate.landmarks[leader][0], mean, entry.kind, config):
                into[new] = leader
                break
        else:
            groups[old].append(new)
            landmarks.split(old, new)
            landmarks.entries[new].move(mean)
    kinds = {leader: landmarks.entries[leader].kind for leader in into.values()}
    return merged_steps(split.steps, into, kinds)


def _is_same(a: Array, b: Array, kind: str, config: AssociationConfig) -> bool:
    """Whether two means (2,) or (3,) are of one landmark; of lines, only the part across counts."""
    if kind == "point":
        return bool(np.hypot(*(b - a)) <= config.reassociation_gate_m)
    off = between(a, b)
    across = abs(off[1]) if kind == "line" else np.hypot(off[0], off[1])
    is_near = across <= config.reassociation_gate_m
    return bool(is_near and abs(off[2]) <= config.reassociation_gate_rad)


def tie_visits(
    landmarks: LandmarkMap, uncertainty: PairUncertainty, apart: Iterable[frozenset[int]]
) -> dict[int, int]:
    """Which landmarks of different visits are one, as they lie on each other.

    The map must be where a solution with closed loops puts it. Landmarks of visits whose relative
    pose is not known well enough to tell a wall from its neighbour stay apart. The work grows with
    the number of pairs of landmarks that are near each other.

    Args:
        landmarks: as estimated. Of a wall that one visit saw whole and another in part, the ends
            are not known: it becomes a line.
        uncertainty: (numbers (m,), numbers (m,), places (m, 2), normals (m, 2)) -> sigmas (m, 2) of
            the distance across and of the direction between two landmarks there.
        apart: pairs that one image showed as two things.

    Returns:
        Landmark -> the one into which it is to be merged.
    """
    entries = list(landmarks.entries.values())
    others: dict[int, set[int]] = {}
    for pair in apart:
        for number in pair:
            others.setdefault(number, set()).update(pair - {number})
    group = {e.id: {e.id} for e in entries}
    into: dict[int, int] = {}
    for i, j in _pairs_that_lie_together(entries, uncertainty):
        one, other = group[entries[i].id], group[entries[j].id]
        if one is other or any(not other.isdisjoint(others.get(a, ())) for a in one):
            continue
        one |= other
        for number in other:
            group[number] = one
    for members in group.values():
        leader = min(members)
        into.update((number, leader) for number in members if number != leader)
    for gone, leader in into.items():
        if landmarks.entries[gone].kind == "line":
            landmarks.entries[leader].kind = "line"
    return into


def _pairs_that_lie_together(
    entries: Sequence[Entry], uncertainty: PairUncertainty
) -> list[tuple[int, int]]:
    """Pairs of indices of landmarks that may be one by where they lie, the nearest first."""
    if len(entries) < 2:
        return []
    x = np.array([e.mean for e in entries])
    extents = np.array([e.extent for e in entries])
    point = np.array([e.kind == "point" for e in entries], dtype=bool)
    i, j = near_pairs(x, extents, point, NEAR_M)
    same = point[i] == point[j]
    i, j = i[same], j[same]
    off = between(x[i], x[j])
    apart = np.hypot(off[:, 0], off[:, 1])
    a, b = extents[i], extents[j] + off[:, :1]
    shared = np.minimum(a[:, 1], b[:, 1]) - np.maximum(a[:, 0], b[:, 0])
    shorter = np.minimum(a[:, 1] - a[:, 0], b[:, 1] - b[:, 0])
    middle = 0.5 * (np.maximum(a[:, 0], b[:, 0]) + np.minimum(a[:, 1], b[:, 1]))
    across = np.abs(off[:, 1] + (middle - off[:, 0]) * off[:, 2])
    walls = ~point[i]
    fits = np.where(
        walls,
        (across <= TIE_M) & (np.abs(off[:, 2]) <= TIE_RAD) & (shared >= OVERLAP_SHARE * shorter),
        apart <= TIE_M,
    )
    far = np.where(walls, np.hypot(across / TIE_M, off[:, 2] / TIE_RAD), apart / TIE_M)
    order = np.flatnonzero(fits)
    numbers = np.array([e.id for e in entries])
    c, s = np.cos(x[i, 2]), np.sin(x[i, 2])
    at = x[i, :2] + np.where(walls, middle, 0.0)[:, None] * np.column_stack([c, s])
    sigma = uncertainty(
        numbers[i[order]], numbers[j[order]], at[order], np.column_stack([-s, c])[order]
    )
    order = order[(sigma[:, 0] <= CERTAIN_M) & (sigma[:, 1] <= CERTAIN_RAD)]
    order = order[np.argsort(far[order], kind="stable")]
    return list(zip(i[order].tolist(), j[order].tolist(), strict=True))
