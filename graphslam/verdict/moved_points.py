"""Named points that are elsewhere later, within a log or since an earlier one.

A robust kernel leaves the smaller part of their sightings out. The path stays right, where enough
other points hold it, but the map has one place for the point, and nobody is told. So it is doubted:
the point was moved, or two bear its name. Of an earlier session or map both places are in the map.
"""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, polar_points, transform_each
from graphslam.verdict.doubts import MOVED_M, Fact, Reason, seconds
from graphslam.verdict.evidence import Evidence, Seen

#: sightings before and after, at least, and ns that they take: errors of the path last for a while
LEAST, LEAST_NS = 5, 2_000_000_000
#: how far apart the places are, in median distances of the sightings from their own place
APART = 5.0
#: points that a line names
MOST_NAMED = 8


def moved_doubts(evidence: Evidence) -> Iterator[Reason]:
    """Named points whose earlier and later sightings, of all robots, agree on different places."""
    parts: dict[str, list[tuple[IntArray, Array, Array]]] = defaultdict(list)
    for robot in evidence.robots:
        for name, part in _by_name(robot.seen):
            parts[name].append(part)
    for name, own in sorted(parts.items()):
        times, at, weights = (np.concatenate(columns) for columns in zip(*own, strict=True))
        order = np.argsort(times, kind="stable")
        found = _moved(times[order], at[order], weights[order])
        if found is None:
            continue
        last, first = (seconds(time, evidence.begin_ns) for time in (found.last_ns, found.first_ns))
        text = (
            f"the point {name}: its sightings until {last} agree on one place, and those since "
            f"{first} on another, {found.distance_m:.2f} m away: it was moved, or two bear its name"
        )
        yield Reason("doubtful", "moved", name, text)


def moved_facts(evidence: Evidence) -> Iterator[Fact]:
    """Points that stand elsewhere than in an earlier session, or in the known map."""
    moved = evidence.summary.get("moved_points", ())
    if not moved:
        return
    what = [
        f"{one['name'] or 'number ' + str(one['was'])} by {one['moved_m']:.2f} m" for one in moved
    ]
    more = f" and {len(what) - MOST_NAMED} more" if len(what) > MOST_NAMED else ""
    text = f"moved since it was seen before: {', '.join(what[:MOST_NAMED])}{more}"
    yield Fact("moved", "", None, text)


@dataclass(frozen=True, slots=True)
class _Move:
    """By how far, m, a point moved; when it was seen last where it was, and first where it is."""

    distance_m: float
    last_ns: int
    first_ns: int


def _by_name(seen: Seen) -> Iterator[tuple[str, tuple[IntArray, Array, Array]]]:
    """Each named point with times (n,) of its sightings, their places (n, 2), and weights (n,).

    Only of sightings that tell a place, whose sigmas are below the range, and a radian: where no
    range is measured, a robot that stands sees one place each time.
    """
    tells = (seen.sigmas[:, 1] < seen.z[:, 1]) & (seen.sigmas[:, 0] < 1.0)
    at = transform_each(seen.poses, polar_points(seen.z[:, 1], seen.z[:, 0]))
    across = seen.z[:, 1] * seen.sigmas[:, 0]
    weights = 1.0 / (across**2 + seen.sigmas[:, 1] ** 2)
    order = np.argsort(seen.targets, kind="stable")
    edges = np.searchsorted(seen.targets[order], np.arange(len(seen.names) + 1))
    for name, begin, end in zip(seen.names, edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        own = order[begin:end]
        own = own[tells[own]]
        if name and len(own):
            yield name, (seen.times_ns[own], at[own], weights[own])


def _moved(times_ns: IntArray, at: Array, weights: Array) -> _Move | None:
    """Whether places (n, 2) sorted by time are of two, the one after the other."""
    first = max(LEAST, int(np.searchsorted(times_ns, times_ns[0] + LEAST_NS)))
    end = min(len(at) - LEAST, int(np.searchsorted(times_ns, times_ns[-1] - LEAST_NS)))
    if first > end:
        return None
    w, sums = np.cumsum(weights), np.cumsum(weights[:, None] * at, axis=0)
    k = np.arange(first, end + 1) - 1
    before, after = sums[k] / w[k, None], (sums[-1] - sums[k]) / (w[-1] - w[k])[:, None]
    gain = w[k] * (w[-1] - w[k]) * np.sum((before - after) ** 2, axis=1)
    split = int(k[np.argmax(gain)]) + 1
    parts = at[:split], at[split:]
    places = [np.median(part, axis=0) for part in parts]
    spread = max(
        float(np.median(np.hypot(*(part - place).T)))
        for part, place in zip(parts, places, strict=True)
    )
    distance_m = float(np.hypot(*(places[1] - places[0])))
    if distance_m < max(MOVED_M, APART * spread):
        return None
    return _Move(distance_m, int(times_ns[split - 1]), int(times_ns[split]))
