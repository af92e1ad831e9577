"""Subjects that bear each other's names: two codes exchanged in the table of who bears which.

A camera knows a subject by its code, so a mistake in that table is consistent: everybody takes two
robots, or a robot and a landmark, for each other, all the time. It shows in where the sightings
lie: those called robot2 on the path of robot3, and those called robot3 on the path of robot2; or
those called robot2 all at one place, and those of a landmark on the path of robot2. Two landmarks
under exchanged names change nothing but the names; only a comparison with the truth can tell.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from graphslam.core.geometry import Array, compose
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Estimate, Sighting
from graphslam.odometry.preintegration import Track
from graphslam.odometry.readings import IntArray

#: sightings that a name must have to be judged
MIN_SIGHTINGS = 20
#: names are exchanged if sightings lie this many times nearer to where they then belong, both ways
MIN_DISTANCE_RATIO = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class _SightedPoints:
    """Where sightings of one name lie, (n, 2) m in the world frame, and when (n,) ns."""

    points: Array
    times_ns: IntArray


def find_swapped_identities(
    sightings: Iterable[Sighting], estimate: Estimate, tracks: Mapping[str, Track]
) -> list[tuple[str, str]]:
    """Pairs of names, at least one of them a robot's, that were given to each other's bearers.

    Medians decide, so the estimate may be as bad as false names have made it, and some sightings
    as wrong as they like.

    Args:
        sightings: those behind the estimate.
        estimate: of all states.
        tracks: odometry of every robot.
    """
    places = _sighted_points(sightings, estimate, tracks)
    robots = [name for name in sorted(places) if name in tracks]
    pairs = list(combinations(robots, 2))
    pairs += [(robot, name) for robot in robots for name in sorted(places) if name not in tracks]

    def off(name: str, bearer: str) -> float:
        """Median distance of what is called ``name`` from where ``bearer`` is, m."""
        found = places[name]
        if bearer not in tracks:  # a landmark is at one place
            at = np.median(found.points, axis=0)
        else:
            states = estimate.states[bearer]
            at = np.column_stack(
                [np.interp(found.times_ns, states.stamps_ns, states.poses[:, k]) for k in (0, 1)]
            )
        return float(np.median(np.hypot(*(found.points - at).T)))

    taken: set[str] = set()
    out = []
    for a, b in pairs:
        if a in taken or b in taken:
            continue
        ways = ((off(a, a), off(a, b)), (off(b, b), off(b, a)))
        if all(own > MIN_DISTANCE_RATIO * other for own, other in ways):
            out.append((a, b))
            taken |= {a, b}
    return out


def rename_identities(
    sighting: Sighting, names: Mapping[str, str], robots: Sequence[str]
) -> Sighting:
    """A sighting under its subject's right name; ``names`` is false name -> right name."""
    name = names.get(sighting.seen_robot or sighting.identity or "")
    if name is None:
        return sighting
    if name in robots:
        return replace(sighting, seen_robot=name, identity=None)
    return replace(sighting, seen_robot=None, identity=name)


def _sighted_points(
    sightings: Iterable[Sighting], estimate: Estimate, tracks: Mapping[str, Track]
) -> dict[str, _SightedPoints]:
    """Name -> where its sightings lie, of names with enough of them."""
    by_robot: dict[str, list[Sighting]] = defaultdict(list)
    for sighting in sightings:
        if sighting.seen_robot or sighting.identity:
            by_robot[sighting.robot].append(sighting)
    points: dict[str, list[Array]] = defaultdict(list)
    times: dict[str, list[int]] = defaultdict(list)
    for robot, found in by_robot.items():
        when = np.array([s.time_ns for s in found], dtype=np.int64)
        states = estimate.states[robot]
        # the last state before, carried on by odometry
        i = states.index_before(when)
        moved = tracks[robot].motions(states.stamps_ns[i], when)
        sensor = compose(compose(states.poses[i], moved.delta), np.array([s.mount for s in found]))
        z = np.array([s.z[:2] for s in found])
        seen = MODELS["point"].invert(z, sensor)
        for sighting, point in zip(found, seen, strict=True):
            name = sighting.seen_robot or str(sighting.identity)
            points[name].append(point)
            times[name].append(sighting.time_ns)
    return {
        name: _SightedPoints(np.array(points[name]), np.array(times[name], dtype=np.int64))
        for name in points
        if len(points[name]) >= MIN_SIGHTINGS
    }
