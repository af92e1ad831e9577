"""By how much robots' clocks differ, from how they move and where they see each other.

A robot that drives at v is seen v times the offset away from where its own clock puts it. First
roughly: over short spans the path of a robot as others saw it must fit the path of its odometry,
moved and turned as is best, at the right offset (`offsets_from_paths`). Then exactly: offsets and
drifts are unknowns of the linearised problem of all states (`clock_graph`). The thesis synchronised
its clocks over a wireless network and could not tell how well (6.1.3).
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.config import RobustConfig
from graphslam.core.geometry import Array, compose, log, polar_points
from graphslam.core.observation_models import transport
from graphslam.core.records import Association, Estimate, Sighting, Step
from graphslam.estimation.clock_graph import DRIFT, OFFSET_S, clock_errors, robot_associations
from graphslam.logs.clock import Clock
from graphslam.odometry.preintegration import Track
from graphslam.perception.sightings import sighting_observation

#: an offset is applied if it is so many sigmas and at least so long, s
SURE, SHOWS_S = 3.0, 0.01
#: s: an offset known no better is not known
OBSERVABLE_S = 1.0
#: s: offsets that are tried, and their steps
SEARCH_S, STEP_S = 5.0, 0.1
#: s: spans over which odometry is good enough to compare paths; sightings in one at least; how many
#: spans of two robots are compared, those with the most sightings
SPAN_S, FEWEST, SPANS = 20.0, 6, 8
#: s: grid on which paths are tabulated
GRID_S = 0.1
#: paths that fit so many times better at another offset decide for it
DECIDED = 1.5
#: scale by which odometry may be off
SCALE = 0.1
#: m: paths fit no better than this
FLOOR_M = 0.02
#: ns: over which a speed is taken
RATE_NS = 200_000_000
#: residuals of sightings are alike over so many of them: their number divided by it counts
ALIKE = 4.0


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """What is known of a robot's clock, against the first robot's.

    ``clock`` with standard deviations of offset, s, and drift, s/s. ``observable``: whether
    sightings say anything of the offset. ``applied``: the part of it by which the log was read.
    """

    clock: Clock
    offset_sigma_s: float
    drift_sigma: float
    observable: bool
    applied: Clock

    @property
    def needs_correction(self) -> bool:
        """Whether the clock is not what the log was read by, so that it shows.

        A clock that is right so far must be wrong beyond doubt.
        """
        error_s = abs(self.clock.offset_s - self.applied.offset_s)
        doubt_s = 0.0 if self.applied.offset_s else SURE * self.offset_sigma_s
        return self.observable and error_s > max(doubt_s, SHOWS_S)


def estimate_clocks(
    steps: Sequence[Step],
    estimate: Estimate,
    sightings: Iterable[Sighting],
    tracks: Mapping[str, Track],
    applied: Mapping[str, Clock],
    kernel: RobustConfig,
) -> dict[str, ClockEstimate]:
    """The clocks of all robots but the first, whose clock is the common one.

    Args:
        steps: as recorded, by clocks ``applied``.
        estimate: of all their states and landmarks.
        sightings: of robots, behind the steps.
        tracks: odometry of every robot.
        applied: clocks by which the log was read.
        kernel: for observations.
    """
    if len(tracks) < 2:
        return {}
    first, *others = sorted(tracks)
    epoch_ns = min(track.first_ns for track in tracks.values())
    known = {robot: applied.get(robot, Clock(0.0, 0.0, epoch_ns)) for robot in others}
    met = robot_associations(steps)
    seen = {name for _, a in met for name in (a.robot, str(a.target))}
    unseen = {r: ClockEstimate(known[r], OFFSET_S, DRIFT, False, known[r]) for r in others}
    if first not in seen:
        return unseen
    rough = offsets_from_paths(sightings, tracks) if not applied else {}
    errors = clock_errors(
        steps,
        estimate,
        _speeds(met, tracks),
        np.array([1e-9 * (time_ns - epoch_ns) for time_ns, _ in met]),
        {robot: np.array([clock.offset_s, clock.drift]) for robot, clock in known.items()},
        kernel,
    )
    out = {}
    for robot, clock in known.items():
        mean, cov = errors.of(robot)
        offset_sigma, drift_sigma = np.sqrt(np.diag(cov)).tolist()
        if robot in rough:
            mean, offset_sigma = np.array([rough[robot].value_s, 0.0]), rough[robot].sigma_s
        observable = offset_sigma < OBSERVABLE_S
        better = clock.adjusted(*mean.tolist()) if observable else clock
        out[robot] = ClockEstimate(better, offset_sigma, drift_sigma, observable, clock)
    return out


def _speeds(met: Sequence[tuple[int, Association]], tracks: Mapping[str, Track]) -> Array:
    """Twists (n, 3) per second of the robots that were seen, along their own axes."""
    out = np.zeros((len(met), 3))
    for robot, track in tracks.items():
        which = [k for k, (_, a) in enumerate(met) if a.target == robot]
        if which:
            times = np.array([met[k][0] for k in which], dtype=np.int64)
            begin, end = times - RATE_NS // 2, times + RATE_NS // 2
            out[which] = log(track.motions(begin, end).delta) / (1e-9 * RATE_NS)
    return out


# ---------------------------------------------------------------- from paths alone


@dataclass(frozen=True, slots=True)
class Offset:
    """How far a clock is ahead, s, and the standard deviation."""

    value_s: float
    sigma_s: float


@dataclass(frozen=True, slots=True, eq=False)
class _Path:
    """A robot's path by its odometry: poses (n, 3) at times (n,) s; headings are not wrapped."""

    times_s: Array
    poses: Array

    def at(self, times_s: Array) -> Array:
        """Poses (..., 3)."""
        return np.stack([np.interp(times_s, self.times_s, x) for x in self.poses.T], axis=-1)


def offsets_from_paths(
    sightings: Iterable[Sighting], tracks: Mapping[str, Track]
) -> dict[str, Offset]:
    """How far each robot's clock is ahead of the first robot's, as far as sightings tell.

    Args:
        sightings: of robots.
        tracks: odometry of every robot.

    Returns:
        Robot -> offset, of the robots for which it is clear that there is one.
    """
    pairs: dict[tuple[str, str], list[Sighting]] = defaultdict(list)
    for sighting in sightings:
        if sighting.seen_robot in tracks and sighting.robot in tracks:
            pairs[sighting.robot, str(sighting.seen_robot)].append(sighting)
    if not pairs:
        return {}
    start_ns = min(track.first_ns for track in tracks.values())
    involved = sorted({robot for pair in pairs for robot in pair})
    paths = {robot: _path(tracks[robot], start_ns) for robot in involved}
    found = {
        pair: offset
        for pair, seen in pairs.items()
        if (offset := _between_two(seen, paths[pair[0]], paths[pair[1]], start_ns)) is not None
    }
    return _combined(found, min(tracks))


def _path(track: Track, start_ns: int) -> _Path:
    """The path in steps of `GRID_S`, by the track's calibration, from its first reading on."""
    times = np.arange(track.first_ns, track.last_ns + 1, round(1e9 * GRID_S), dtype=np.int64)
    poses = track.motions(np.full(len(times), track.first_ns), times).delta.astype(float)
    poses[:, 2] = np.unwrap(poses[:, 2])
    return _Path(np.asarray(1e-9 * (times - start_ns)), poses)


def _between_two(
    seen: Sequence[Sighting], observer: _Path, other: _Path, start_ns: int
) -> Offset | None:
    """How far the seen robot's clock is ahead of the observer's; None if that is not clear."""
    times = np.array([1e-9 * (s.time_ns - start_ns) for s in seen])
    span = np.floor(times / SPAN_S).astype(int)
    numbers, counts = np.unique(span, return_counts=True)
    offsets = STEP_S * np.arange(-round(SEARCH_S / STEP_S), round(SEARCH_S / STEP_S) + 1)
    cost, count = np.zeros(len(offsets)), 0
    for number in numbers[np.argsort(-counts, kind="stable")][:SPANS]:
        which = np.flatnonzero(span == number)
        if len(which) < FEWEST:
            break
        points = np.array([[*_place(seen[k]), 0.0] for k in which.tolist()])
        p = compose(observer.at(times[which]), points)[:, :2] @ np.array([1.0, 1j])
        q = other.at(times[which] + offsets[:, None])[..., :2] @ np.array([1.0, 1j])
        cost += _misfit(p, q)
        count += len(which) - 2
    if not count:
        return None
    best = int(np.clip(np.argmin(cost), 1, len(offsets) - 2))
    if cost[len(offsets) // 2] < DECIDED * cost[best]:
        return None
    bend = (cost[best - 1] - 2 * cost[best] + cost[best + 1]) / STEP_S**2
    if bend <= 0:
        return None
    shift = (cost[best - 1] - cost[best + 1]) / (2 * STEP_S) / bend
    noise = max(cost[best] / count, FLOOR_M**2)
    sigma = float(np.sqrt(2 * noise * ALIKE / bend))
    return Offset(float(offsets[best] + np.clip(shift, -STEP_S, STEP_S)), sigma)


def _place(sighting: Sighting) -> Array:
    """Where the thing seen is (2,), m, in the observer's base frame."""
    o = sighting_observation(sighting)
    if len(o.z) == 3:
        return compose(sighting.mount, o.z)[:2]
    z, _ = transport(o.z, o.cov, sighting.mount, np.zeros((3, 3)))
    return polar_points(z[1], z[0])


def _misfit(p: Array, q: Array) -> Array:
    """Sum of squares (g,) of what is left of points p (n,) by paths q (g, n), complex numbers.

    Each path is moved, turned, and scaled by no more than `SCALE`, as fits best.
    """
    p, q = p - p.mean(), q - q.mean(axis=1, keepdims=True)
    pp, qq = np.sum(np.abs(p) ** 2), np.sum(np.abs(q) ** 2, axis=1)
    pq = np.abs(np.conj(q) @ p)
    s = np.clip(pq / np.maximum(qq, 1e-9), 1 - SCALE, 1 + SCALE)
    return np.asarray(pp - 2 * s * pq + s**2 * qq)


def _combined(found: Mapping[tuple[str, str], Offset], first: str) -> dict[str, Offset]:
    """Offsets of all robots from those between two: weighted least squares."""
    linked = {first}
    while True:
        more = {r for pair in found if linked & set(pair) for r in pair} - linked
        if not more:
            break
        linked |= more
    robots = sorted(linked - {first})
    if not robots:
        return {}
    place = {robot: k for k, robot in enumerate(robots)}
    N, v = np.zeros((len(robots),) * 2), np.zeros(len(robots))
    for (a, b), offset in found.items():
        row = np.zeros(len(robots))
        for robot, sign in ((a, -1.0), (b, 1.0)):
            if robot in place:
                row[place[robot]] = sign
        N += np.outer(row, row) / offset.sigma_s**2
        v += row * offset.value_s / offset.sigma_s**2
    P = np.linalg.inv(N)
    return {r: Offset(float((P @ v)[k]), float(np.sqrt(P[k, k]))) for r, k in place.items()}
