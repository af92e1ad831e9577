"""Which of a robot's landmarks are those that other robots named otherwise.

Robots that associate by themselves have names of their own for the same landmarks. Who receives
some compares them with its own, and with those of third robots, by the joint covariance of all of
them in its own estimate: the relative pose of the robots known so far is in it. Two are the same if
they are within the gate, and neither is near any other one that it could be instead: within the
second, higher quantile, the one of new landmarks (thesis section 4.6). What is between waits:
later messages, sightings of robots, and ties of others make the comparison sharper.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.config import AssociationConfig
from graphslam.core.gaussian import chi2_quantile, mahalanobis_squared
from graphslam.core.geometry import Array, rotation3, wrap
from graphslam.core.observation_models import MODELS

#: rows of the difference of two landmarks: of points along both axes, of walls offset and direction
ROWS = 2
#: rad: walls whose directions differ by more are not compared, however uncertain they are
MOST_RAD = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Named:
    """Landmarks in one robot's estimate, n of them, one for all that are tied to each other.

    ``keys``: of the variables. ``owners``: of each, the robots that have a name for it. ``means``:
    (2,) of a point, (3,) of a wall; ``cov`` (D, D) of all, errors in their body frames.
    """

    keys: Sequence[int]
    owners: Sequence[frozenset[int]]
    means: Sequence[Array]
    cov: Array


def surest_tie(named: Named, settings: AssociationConfig) -> tuple[int, int] | None:
    """The keys of two landmarks that are the same one beyond doubt, the most likely first."""
    pairs, distances, close = _compare(named, settings)
    if not len(pairs):
        return None
    gate, far = (
        float(chi2_quantile(p, ROWS))
        for p in (settings.gate_probability, settings.new_landmark_probability)
    )
    near = pairs[distances < far].tolist()
    alone = [
        n
        for n in np.flatnonzero((distances < gate) & close).tolist()
        if sum(_exclude(pairs[n].tolist(), other, named.owners) for other in near) == 1  # itself
    ]
    if not alone:
        return None
    a, b = pairs[alone[np.argmin(distances[alone])]].tolist()
    return named.keys[a], named.keys[b]


def _exclude(pair: Sequence[int], other: Sequence[int], owners: Sequence[frozenset[int]]) -> bool:
    """Whether both would give one landmark two names of the same robot, or are the same pair."""
    return any(
        a == c and bool(owners[b] & owners[d])
        for a, b in (pair, pair[::-1])
        for c, d in (other, other[::-1])
    )


def _compare(named: Named, settings: AssociationConfig) -> tuple[IntArray, Array, BoolArray]:
    """Pairs of landmarks of one kind of which no robot knows that they are two.

    Returns:
        Their indices (m, 2), squared Mahalanobis distances (m,), and whether (m,) they are within
        `association.max_distance_m` and `MOST_RAD`. What is not may be a doubt all the same.
    """
    ends = np.cumsum([len(mean) for mean in named.means])
    slots = [slice(end - len(mean), end) for mean, end in zip(named.means, ends, strict=True)]
    pairs, r, S, close = [], [], [], []
    floor = np.square([settings.floor_m, settings.floor_m])
    wall_floor = np.square([settings.floor_m, settings.floor_rad])
    for a, mean in enumerate(named.means):
        for b in range(a + 1, len(named.means)):
            other = named.means[b]
            if len(other) != len(mean) or named.owners[a] & named.owners[b]:
                continue
            if len(mean) == 2:
                found, H_a, H_b = other - mean, -np.eye(2), np.eye(2)
                off_m, off_rad = float(np.hypot(*found)), 0.0
            else:
                found, H_a, H_b = _wall_difference(mean, other)
                off_m, off_rad = np.abs(found).tolist()
            both = np.r_[slots[a], slots[b]]
            H = np.hstack([H_a, H_b])
            pairs.append((a, b))
            close.append(off_m < settings.max_distance_m and off_rad < MOST_RAD)
            r.append(found)
            noise = floor if len(mean) == 2 else wall_floor
            S.append(H @ named.cov[np.ix_(both, both)] @ H.T + np.diag(noise))
    if not pairs:
        return np.zeros((0, 2), dtype=np.int64), np.zeros(0), np.zeros(0, dtype=bool)
    return np.array(pairs), mahalanobis_squared(np.array(r), np.array(S)), np.array(close)


def _wall_difference(wall: Array, other: Array) -> tuple[Array, Array, Array]:
    """Offset and direction (2,) of ``other`` seen from ``wall``, and derivatives (2, 3) by both.

    Derivatives are by errors in the body frames. Where the origins lie along the walls is nothing.
    """
    model, z = MODELS["line"], np.zeros(3)
    H_wall, H_other = model.jacobians(z, wall, other)
    r = model.residual(z, wall, other)
    r[1] = wrap(r[1])
    return r, H_wall @ rotation3(wall[2]), H_other @ rotation3(other[2])


def tied(owners: Mapping[int, int], ties: Sequence[tuple[int, int]]) -> dict[int, frozenset[int]]:
    """One landmark of all that are tied to each other, also by ties of ties -> their owners.

    Args:
        owners: landmark -> the robot whose name it is.
        ties: pairs of landmarks that are the same.
    """
    groups = {key: {key} for key in owners}
    for a, b in ties:
        groups[a] |= groups[b]
        for key in groups[b]:
            groups[key] = groups[a]
    return {
        key: frozenset(owners[one] for one in group)
        for key, group in groups.items()
        if key == min(group)
    }
