"""Which pairs of observations and landmarks are compared, and which are chosen."""

from collections.abc import Sequence

import numpy as np

from graphslam.core.arrays import BoolArray
from graphslam.core.config import AssociationConfig
from graphslam.core.geometry import Array
from graphslam.mapping.gating import PairDistances, Pairs, assign
from graphslam.mapping.landmark_map import Entry

#: landmarks per observation whose joint marginal is read, the nearest by crude distance: recently
#: seen ones, and old ones (more, as the pose may have drifted)
NEAREST_RECENT, NEAREST_OLD = 3, 4
#: old walls per observation that are compared where there are too few to close a loop
NEAREST_ALONE = 2
#: m, rad: an old wall is matched alone if it is known so well where it should be seen. Three times
#: that are association.reassociation_gate_m and reassociation_gate_rad
ALONE_M, ALONE_RAD = 0.1, 0.05


def worth_comparing(
    pairs: Pairs, entries: Sequence[Entry], recent: BoolArray, reacquire_min: int
) -> BoolArray:
    """Pairs (k,) that are compared by the joint marginal, which is expensive to read.

    All pairs with tentative landmarks, which need none; of the graph's landmarks the few nearest
    per observation; old ones if enough observations have some to close a loop, else a few walls.
    """
    in_graph = np.array([e.in_graph for e in entries], dtype=bool)
    keep = ~in_graph
    old = in_graph & ~recent
    few = len(set(pairs.observation[old].tolist())) < reacquire_min
    if few:
        old &= np.array([e.kind != "point" for e in entries], dtype=bool)
    most = NEAREST_ALONE if few else NEAREST_OLD
    for group, limit in ((in_graph & recent, NEAREST_RECENT), (old, most)):
        members = np.flatnonzero(group)
        members = members[np.lexsort((pairs.rough_distance[members], pairs.observation[members]))]
        rank = np.arange(len(members)) - np.searchsorted(
            pairs.observation[members], pairs.observation[members]
        )
        keep[members[rank < limit]] = True
    return keep


def assign_pairs(
    pairs: Pairs,
    d2: Array,
    gate: Array,
    which: BoolArray,
    n: int,
    config: AssociationConfig,
) -> dict[int, int]:
    """Observation -> pair among the pairs ``which`` (k,), by distances and gates (k,).

    One-to-one first. A line may be seen in several parts (a pillar hides its middle), so a line
    observation left over joins its nearest landmark even if that has an observation already.
    """
    use = np.flatnonzero(which & (d2 < gate))
    if not len(use):
        return {}
    columns = {int(j): c for c, j in enumerate(np.unique(pairs.landmark[use]))}
    cost = np.full((n, len(columns)), np.inf)
    limit = np.zeros_like(cost)
    number = np.full(cost.shape, -1, dtype=np.int64)
    for k in use:
        cell = int(pairs.observation[k]), columns[int(pairs.landmark[k])]
        cost[cell], limit[cell], number[cell] = d2[k], gate[k], k
    chosen = {i: int(number[i, c]) for i, c in assign(cost, limit, config.method)}
    if config.nearness == "middle":
        return chosen  # what shares no middle is no part of it
    for k in use[np.argsort(d2[use], kind="stable")]:
        i = int(pairs.observation[k])
        if i not in chosen and pairs.model[k] == "line":
            chosen[i] = int(k)
    return chosen


def known_alone(pairs: Pairs, compared: PairDistances) -> BoolArray:
    """Pairs (k,) with walls that a single observation tells, however long ago they were seen.

    Where the robot may have drifted, others must agree before an old wall is matched again. But a
    robot that went about a room, and never lost its other walls, knows to centimetres where the
    first should be; if it were not matched, each round would add it to the map once more.
    """
    limits = {"line": [ALONE_M, ALONE_RAD], "segment": [ALONE_M, ALONE_M, ALONE_RAD]}
    known = np.zeros(len(pairs.model), dtype=bool)
    for k, model in enumerate(pairs.model):
        if model in limits:
            variance = np.diagonal(compared.cov_without_floor[k])
            known[k] = bool((variance < np.square(limits[model])).all())
    return known
