"""Landmarks are split by visit before loop closure and merged again after it.

Associations made with a large uncertainty may be wrong: one of two parallel walls is taken for the
other, which distorts the whole map. So loops are closed with separate landmarks for every visit.
Afterwards the parts of a landmark are merged again where their estimates agree.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.config import AssociationConfig
from graphslam.core.geometry import Array, between, path_length
from graphslam.core.records import Estimate, Step, Trajectory
from graphslam.mapping.duplicate_landmarks import merged_steps
from graphslam.mapping.landmark_map import LandmarkMap


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
