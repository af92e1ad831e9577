"""Swapped identities: two codes interchanged in the table of identities.

A camera recognises a subject by its code, so a mistake in that table is consistent: every sighting
of either of two robots, or of a robot and a landmark, has the other's identity. It shows in where
the sightings lie: those of robot2 on the path of robot3, and those of robot3 on the path of robot2;
or those of robot2 all at one place, and those of a landmark on the path of robot2. Two exchanged
landmarks change nothing but the names; only a comparison with the truth shows them.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, compose
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Estimate, Sighting
from graphslam.odometry.preintegration import Track

#: sightings of an identity that are needed to judge it
MIN_SIGHTINGS = 20
#: identities are exchanged if the sightings of both lie this many times nearer to the other
MIN_DISTANCE_RATIO = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class _SightedPoints:
    """Sightings of one identity.

    ``points`` (n, 2) m, world frame; ``times_ns`` (n,).
    """

    points: Array
    times_ns: IntArray


def find_swapped_identities(
    sightings: Iterable[Sighting], estimate: Estimate, tracks: Mapping[str, Track]
) -> list[tuple[str, str]]:
    """Pairs of exchanged identities, at least one of them a robot's.

    Medians decide, so the estimate may be as bad as false identities have made it, and there may be
    outliers.

    Args:
        sightings: those behind the estimate.
        estimate: of all states.
        tracks: odometry of every robot.
    """
    sighted = _sighted_points(sightings, estimate, tracks)
    robots = [name for name in sorted(sighted) if name in tracks]
    pairs = list(combinations(robots, 2))
    pairs += [(robot, name) for robot in robots for name in sorted(sighted) if name not in tracks]

    def distance_m(identity: str, subject: str) -> float:
        """Median distance of the sightings of an identity from a subject."""
        seen = sighted[identity]
        if subject not in tracks:  # a landmark is at one place
            position = np.median(seen.points, axis=0)
        else:
            states = estimate.states[subject]
            position = np.column_stack(
                [np.interp(seen.times_ns, states.stamps_ns, states.poses[:, k]) for k in (0, 1)]
            )
        return float(np.median(np.hypot(*(seen.points - position).T)))

    own_m = {name: distance_m(name, name) for name in {n for pair in pairs for n in pair}}

    def lies_nearer(identity: str, subject: str) -> bool:
        """Whether the sightings of an identity are much nearer to this subject."""
        return own_m[identity] > MIN_DISTANCE_RATIO * distance_m(identity, subject)

    swapped: list[tuple[str, str]] = []
    for a, b in pairs:
        if any(name in pair for pair in swapped for name in (a, b)):
            continue
        if lies_nearer(a, b) and lies_nearer(b, a):
            swapped.append((a, b))
    return swapped


def rename_identities(
    sighting: Sighting, names: Mapping[str, str], robots: Sequence[str]
) -> Sighting:
    """A sighting with the right identity; ``names`` is false identity -> right identity."""
    name = names.get(sighting.seen_robot or sighting.identity or "")
    if name is None:
        return sighting
    if name in robots:
        return replace(sighting, seen_robot=name, identity=None)
    return replace(sighting, seen_robot=None, identity=name)


def _sighted_points(
    sightings: Iterable[Sighting], estimate: Estimate, tracks: Mapping[str, Track]
) -> dict[str, _SightedPoints]:
    """Identity -> where its sightings lie, of identities with enough of them."""
    by_robot: dict[str, list[Sighting]] = defaultdict(list)
    for sighting in sightings:
        if sighting.seen_robot or sighting.identity:
            by_robot[sighting.robot].append(sighting)
    found: dict[str, list[_SightedPoints]] = defaultdict(list)
    for robot, seen in by_robot.items():
        times_ns = np.array([s.time_ns for s in seen], dtype=np.int64)
        states = estimate.states[robot]
        # the last state before, propagated by odometry
        i = states.index_before(times_ns)
        moved = tracks[robot].motions(states.stamps_ns[i], times_ns)
        sensor = compose(compose(states.poses[i], moved.delta), np.array([s.mount for s in seen]))
        points = MODELS["point"].invert(np.array([s.z[:2] for s in seen]), sensor)
        names = np.array([s.seen_robot or s.identity for s in seen])
        order = np.argsort(names, kind="stable")
        different, firsts = np.unique(names[order], return_index=True)
        for name, own in zip(different.tolist(), np.split(order, firsts[1:]), strict=True):
            found[name].append(_SightedPoints(points[own], times_ns[own]))
    return {
        name: _SightedPoints(
            np.concatenate([one.points for one in parts]),
            np.concatenate([one.times_ns for one in parts]),
        )
        for name, parts in found.items()
        if sum(len(one.times_ns) for one in parts) >= MIN_SIGHTINGS
    }
