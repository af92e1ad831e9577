"""Offsets and drifts of the robots' clocks, from odometry and observations of each other.

A robot that drives at v is seen v times the offset away from where its own clock puts it. First
coarsely: over short spans, the path of a robot as another observed it must fit the path of its
odometry, rigidly moved, at the right offset (`offsets_from_paths`). Then precisely: offsets and
drifts are variables of the linearised graph of all states (`clock_graph`). The thesis synchronised
its clocks over a wireless network and could not tell how well (6.1.3).
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.config import Config
from graphslam.core.geometry import Array, log, polar_points, transform_each
from graphslam.core.records import Association, Estimate, Sighting, Step
from graphslam.estimation.clock_graph import DRIFT, OFFSET_S, clock_errors, robot_associations
from graphslam.logs.clock import Clock
from graphslam.odometry.preintegration import Track

#: an offset is applied if it is so many sigmas and at least so long, s
SIGNIFICANT_SIGMAS, SIGNIFICANT_S = 4.0, 0.01
#: s: with a larger sigma an offset is unobservable
OBSERVABLE_S = 1.0
#: ns: a velocity is the motion over this time
VELOCITY_NS = 200_000_000


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """A robot's clock relative to the first robot's.

    ``clock`` with standard deviations of offset, s, and drift, s/s. ``observable``: whether the
    observations determine the offset. ``applied``: the clock that the log was read with.
    """

    clock: Clock
    offset_sigma_s: float
    drift_sigma: float
    observable: bool
    applied: Clock

    @property
    def needs_correction(self) -> bool:
        """Whether the log should be read again with this clock.

        A first correction must be significant; a later one only large enough to matter.
        """
        error_s = abs(self.clock.offset_s - self.applied.offset_s)
        limit_s = 0.0 if self.applied.offset_s else SIGNIFICANT_SIGMAS * self.offset_sigma_s
        return self.observable and error_s > max(limit_s, SIGNIFICANT_S)


def estimate_clocks(
    steps: Sequence[Step],
    estimate: Estimate,
    sightings: Iterable[Sighting],
    tracks: Mapping[str, Track],
    applied: Mapping[str, Clock],
    config: Config,
) -> dict[str, ClockEstimate]:
    """The clocks of all robots but the first, whose clock is the common one.

    Args:
        steps: as recorded with the clocks ``applied``.
        estimate: of all their states and landmarks.
        sightings: observations of robots in them, as read from the log, for clocks of which nothing
            is known; empty where `clocks_from_paths` has been tried.
        tracks: odometry of every robot.
        applied: clocks that the log was read with.
        config: settings.
    """
    if len(tracks) < 2:
        return {}
    first, *others = sorted(tracks)
    epoch_ns = min(track.first_ns for track in tracks.values())
    known = {robot: applied.get(robot, Clock(0.0, 0.0, epoch_ns)) for robot in others}
    observations = robot_associations(steps)
    if not any(first in (a.robot, a.target) for _, a in observations):
        return {r: ClockEstimate(known[r], OFFSET_S, DRIFT, False, known[r]) for r in others}
    max_offset_s = config.logs.max_clock_offset_s
    coarse = {} if applied else offsets_from_paths(sightings, tracks, max_offset_s)
    errors = clock_errors(
        steps,
        estimate,
        _velocities(observations, tracks),
        np.array([1e-9 * (time_ns - epoch_ns) for time_ns, _ in observations]),
        {robot: np.array([clock.offset_s, clock.drift]) for robot, clock in known.items()},
        config.robust,
    )
    out = {}
    for robot, clock in known.items():
        mean, cov = errors.of(robot)
        offset_sigma, drift_sigma = np.sqrt(np.diag(cov)).tolist()
        if robot in coarse:
            mean, offset_sigma = np.array([coarse[robot].value_s, 0.0]), coarse[robot].sigma_s
        observable = offset_sigma < OBSERVABLE_S
        better = clock.adjusted(*mean.tolist()) if observable else clock
        out[robot] = ClockEstimate(better, offset_sigma, drift_sigma, observable, clock)
    return out


def clocks_from_paths(
    sightings: Iterable[Sighting], tracks: Mapping[str, Track], config: Config
) -> dict[str, Clock]:
    """Clocks that are clearly wrong, without any estimate; empty if none is.

    The offsets are coarse, but a log that was read with them needs one correction at most.
    """
    epoch_ns = min(track.first_ns for track in tracks.values())
    at_first = Clock(0.0, 0.0, epoch_ns)
    coarse = offsets_from_paths(sightings, tracks, config.logs.max_clock_offset_s)
    found = {
        robot: ClockEstimate(
            at_first.adjusted(offset.value_s, 0.0), offset.sigma_s, DRIFT, True, at_first
        )
        for robot, offset in coarse.items()
    }
    if not any(clock.needs_correction for clock in found.values()):
        return {}
    others = sorted(tracks)[1:]
    return {robot: found[robot].clock if robot in found else at_first for robot in others}


def _velocities(
    observations: Sequence[tuple[int, Association]], tracks: Mapping[str, Track]
) -> Array:
    """Twists (n, 3) per second of the observed robots, along their own axes."""
    out = np.zeros((len(observations), 3))
    for robot, track in tracks.items():
        which = [k for k, (_, a) in enumerate(observations) if a.target == robot]
        if which:
            times = np.array([observations[k][0] for k in which], dtype=np.int64)
            begin, end = times - VELOCITY_NS // 2, times + VELOCITY_NS // 2
            out[which] = log(track.motions(begin, end).delta) / (1e-9 * VELOCITY_NS)
    return out


# ---------------------------------------------------------------- from paths alone

#: s: steps of the offsets tried, and of the tabulated paths
STEP_S = 0.1
#: s: spans over which odometry is accurate enough to compare paths
SPAN_S = 20.0
#: fewest observations in a span, and most spans compared for two robots, those with most first
MIN_OBSERVATIONS, MAX_SPANS = 6, 8
#: ratio of the costs at offset zero and at the best one from which the best one is taken
MIN_COST_RATIO = 1.5
#: relative error of odometry's scale at most, and accuracy, m, of paths however well they fit
MAX_SCALE_ERROR, FLOOR_M = 0.1, 0.02
#: so many consecutive residuals count as one independent residual
CORRELATED = 4.0


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """How far a clock is ahead, s, and its standard deviation."""

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
    sightings: Iterable[Sighting], tracks: Mapping[str, Track], max_offset_s: float
) -> dict[str, ClockOffset]:
    """How far each robot's clock is ahead of the first robot's, where that is clearly not zero.

    ``tracks`` is the odometry of every robot, ``max_offset_s`` the largest offset tried.
    """
    pairs: dict[tuple[str, str], list[Sighting]] = defaultdict(list)
    for sighting in sightings:
        if sighting.seen_robot in tracks and sighting.robot in tracks:
            pairs[sighting.robot, str(sighting.seen_robot)].append(sighting)
    if not pairs or max_offset_s < STEP_S:
        return {}
    start_ns = min(track.first_ns for track in tracks.values())
    involved = sorted({robot for pair in pairs for robot in pair})
    paths = {robot: _path(tracks[robot], start_ns) for robot in involved}
    steps = round(max_offset_s / STEP_S)
    tried = np.asarray(STEP_S * np.arange(-steps, steps + 1))
    offsets = {
        (a, b): _relative_offset(seen, paths[a], paths[b], start_ns, tried)
        for (a, b), seen in pairs.items()
    }
    clear = {pair: offset for pair, offset in offsets.items() if offset is not None}
    return _combined(clear, min(tracks))


def _path(track: Track, start_ns: int) -> _Path:
    """The path in steps of `STEP_S`, by the track's calibration, from its first reading on."""
    times = np.arange(track.first_ns, track.last_ns + 1, round(1e9 * STEP_S), dtype=np.int64)
    poses = track.motions(np.full(len(times), track.first_ns), times).delta.astype(float)
    poses[:, 2] = np.unwrap(poses[:, 2])
    return _Path(np.asarray(1e-9 * (times - start_ns)), poses)


def _relative_offset(
    seen: Sequence[Sighting], observer: _Path, target: _Path, start_ns: int, offsets: Array
) -> ClockOffset | None:
    """How far the target's clock is ahead of the observer's; None if that is not clear.

    ``start_ns`` is time zero of the paths; ``offsets`` (g,) are those to try, s, evenly spaced
    around zero.
    """
    times = np.array([1e-9 * (s.time_ns - start_ns) for s in seen])
    span = np.floor(times / SPAN_S).astype(int)
    numbers, counts = np.unique(span, return_counts=True)
    points, cost, count = _positions(seen), np.zeros(len(offsets)), 0
    for number in numbers[np.argsort(-counts, kind="stable")][:MAX_SPANS]:
        which = np.flatnonzero(span == number)
        if len(which) < MIN_OBSERVATIONS:
            break
        p = transform_each(observer.at(times[which]), points[which]) @ np.array([1.0, 1j])
        q = target.at(times[which] + offsets[:, None])[..., :2] @ np.array([1.0, 1j])
        cost += _residual(p, q)
        count += len(which) - 2
    if not count:
        return None
    best = int(np.clip(np.argmin(cost), 1, len(offsets) - 2))
    ratio = cost[len(offsets) // 2] / max(cost[best], 1e-12)
    # twice the gain in log-likelihood, of which the best of many offsets has a part by chance
    gain = 2 * count / CORRELATED * np.log(max(ratio, 1.0))
    if ratio < MIN_COST_RATIO or gain < SIGNIFICANT_SIGMAS**2 + 2 * np.log(len(offsets)):
        return None
    curvature = (cost[best - 1] - 2 * cost[best] + cost[best + 1]) / STEP_S**2
    if curvature <= 0:
        return None
    shift = (cost[best - 1] - cost[best + 1]) / (2 * STEP_S) / curvature
    noise = max(cost[best] / count, FLOOR_M**2)
    sigma = float(np.sqrt(2 * noise * CORRELATED / curvature))
    return ClockOffset(float(offsets[best] + np.clip(shift, -STEP_S, STEP_S)), sigma)


def _positions(seen: Sequence[Sighting]) -> Array:
    """Positions (n, 2) of what was seen, m, in the observer's base frame."""
    z, mounts = np.array([s.z[:2] for s in seen]), np.array([s.mount for s in seen])
    return transform_each(mounts, polar_points(z[:, 1], z[:, 0]))


def _residual(p: Array, q: Array) -> Array:
    """Sums of squares (g,) of points p (n,) minus the best fits of paths q (g, n), complex numbers.

    A fit moves, turns and scales, the scale limited by `MAX_SCALE_ERROR`. All paths at once, and
    without the fits themselves: `core.consistency.fit_rigid_transform` has neither.
    """
    p, q = p - p.mean(), q - q.mean(axis=1, keepdims=True)
    pp, qq = np.sum(np.abs(p) ** 2), np.sum(np.abs(q) ** 2, axis=1)
    pq = np.abs(np.conj(q) @ p)
    s = np.clip(pq / np.maximum(qq, 1e-9), 1 - MAX_SCALE_ERROR, 1 + MAX_SCALE_ERROR)
    return np.asarray(pp - 2 * s * pq + s**2 * qq)


def _combined(offsets: Mapping[tuple[str, str], ClockOffset], first: str) -> dict[str, ClockOffset]:
    """Offsets relative to ``first`` from those between pairs, by weighted least squares."""
    connected = {first}
    while more := {r for pair in offsets if connected & set(pair) for r in pair} - connected:
        connected |= more
    index = {robot: k for k, robot in enumerate(sorted(connected - {first}))}
    if not index:
        return {}
    N, v = np.zeros((len(index),) * 2), np.zeros(len(index))
    for (a, b), offset in offsets.items():
        row = np.zeros(len(index))
        for robot, sign in ((a, -1.0), (b, 1.0)):
            if robot in index:
                row[index[robot]] = sign
        N += np.outer(row, row) / offset.sigma_s**2
        v += row * offset.value_s / offset.sigma_s**2
    P = np.linalg.inv(N)
    return {r: ClockOffset(float((P @ v)[k]), float(np.sqrt(P[k, k]))) for r, k in index.items()}
