"""A log of sightings with a state wherever a robot saw something or was seen.

Where the noise of sightings is white, every one of them counts: it enters from a state at its own
time, and what it shares with others by odometry is in the motions between the states.
"""

import itertools
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, between, compose, inverse
from graphslam.core.motion_models import HELD_SIGMA
from graphslam.core.observation_models import transport
from graphslam.core.record import replace
from graphslam.core.records import (
    Association,
    Closure,
    Estimate,
    Motion,
    Sighting,
    Start,
    Step,
    Trajectory,
)
from graphslam.estimation.batch_calibration import uncovered_covs
from graphslam.estimation.motion_noise import MIN_SIGMA
from graphslam.odometry.calibration_jacobian import along_estimated_path
from graphslam.odometry.increment_sums import Motions
from graphslam.odometry.interpolation import final_at
from graphslam.odometry.preintegration import Track, preintegrate_batch
from graphslam.perception.sightings import sighting_observation
from graphslam.pipeline.sighting_batches import transport_batch

#: m of `Track.effort`: where nothing is seen, states are at most so far from each other
MAX_SPACING_M = 0.5


def steps_at_sightings(
    steps: Sequence[Step],
    sources: Sequence[Sighting],
    late_ns: Mapping[str, int],
    dropped: Counter[str],
) -> tuple[Step, ...]:
    """Steps at the times of the sightings behind the associations of ``steps``.

    Args:
        steps: with the robots' starts.
        sources: `Association.source` is an index into them.
        late_ns: robot -> how much later than its odometry its sightings are stamped. Its start is
            where it was when the odometry began; what it saw before that is left out.
        dropped: counts what was left out, by reason.

    Returns:
        Steps whose motions have times alone, and whose associations are as measured. There are
        states at the ends of closures too.
    """
    starts: dict[int, dict[str, Start]] = defaultdict(dict)
    seen: dict[int, list[Association]] = defaultdict(list)
    ends: dict[int, set[str]] = defaultdict(set)
    closures: dict[int, list[Closure]] = defaultdict(list)
    for step in steps:
        for closure in step.closures:
            for robot, time_ns in closure.pair:
                ends[time_ns].add(robot)
            closures[max(closure.time_ns, closure.other_time_ns)].append(closure)
        for robot, start in step.starts.items():
            starts[step.time_ns + max(0, late_ns.get(robot, 0))][robot] = start
        for a in step.associations:
            if a.source is not None:
                sighting = sources[a.source]
                z, cov = measured_from_base(sighting)
                seen[sighting.time_ns].append(replace(a, time_ns=sighting.time_ns, z=z, cov=cov))
    latest: dict[str, int] = {}
    begun: dict[str, int] = {}
    made: list[Step] = []
    known = steps[0].known if steps else None
    for time_ns in sorted({*starts, *seen, *ends}):
        if time_ns in starts:
            latest.update(dict.fromkeys(starts[time_ns], time_ns))
            begun.update(dict.fromkeys(starts[time_ns], time_ns))
            made.append(Step(time_ns, dict(starts[time_ns]), known=None if made else known))
        own = [a for a in seen.get(time_ns, []) if _robots(a) <= latest.keys()]
        dropped["sighting: no odometry near it"] += len(seen.get(time_ns, [])) - len(own)
        related = closures.get(time_ns, [])
        closed = [c for c in related if _has_begun(c, begun)]
        dropped["relative pose: no odometry near it"] += len(related) - len(closed)
        motions = {}
        here = (ends.get(time_ns, set()) & latest.keys()).union(*map(_robots, own))
        for robot in sorted(here):
            if latest[robot] < time_ns:
                motions[robot] = timed_motion(latest[robot], time_ns)
                latest[robot] = time_ns
        if own or motions or closed:
            made.append(Step(time_ns, {}, motions, tuple(own), tuple(closed)))
    return tuple(made)


def _has_begun(closure: Closure, begun: Mapping[str, int]) -> bool:
    """Whether there are states at both ends of a closure; ``begun``: robot -> its first."""
    return all(robot in begun and begun[robot] <= time_ns for robot, time_ns in closure.pair)


def _robots(a: Association) -> set[str]:
    """The robot that saw something, and the one that it saw."""
    return {a.robot, a.target} if isinstance(a.target, str) else {a.robot}


def measured_from_base(sighting: Sighting) -> tuple[Array, Array]:
    """A sighting as measured from its robot's base: z (k,) and its covariance (k, k)."""
    if len(sighting.z) == 2 and not sighting.mount.any():
        return sighting.z, sighting.cov
    o = sighting_observation(sighting)
    if not sighting.mount.any():
        return o.z, o.cov
    return transport(o.z, o.cov, sighting.mount, np.zeros((3, 3)))


def measured_from_bases(sightings: Sequence[Sighting]) -> tuple[Array, Array]:
    """`measured_from_base` of n sightings of one kind: z (n, k) and covariances (n, k, k)."""
    mounts = np.array([s.mount for s in sightings])
    if len(sightings[0].z) == 2:
        z, cov = np.array([s.z for s in sightings]), np.array([s.cov for s in sightings])
        return transport_batch(z, cov, mounts, np.zeros((3, 3))) if mounts.any() else (z, cov)
    each = [measured_from_base(s) for s in sightings]
    return np.array([z for z, _ in each]), np.array([cov for _, cov in each])


def with_states_between(steps: Sequence[Step], tracks: Mapping[str, Track]) -> tuple[Step, ...]:
    """Steps with more states where robots drove for `MAX_SPACING_M` without a sighting.

    A path of metres between two states is not told by these and the odometry alone: where its
    heading was off decides how far off the places on the way are. Only states there know that.

    Args:
        steps: whose motions have times alone, see `steps_at_sightings`.
        tracks: odometry of every robot.
    """
    own: dict[str, list[tuple[int, Motion]]] = defaultdict(list)
    for n, step in enumerate(steps):
        for robot, motion in step.motions.items():
            own[robot].append((n, motion))
    made, between_states = list(steps), []
    for robot, motions in own.items():
        track = tracks[robot]
        ends = np.array([(m.start_ns, m.end_ns) for _, m in motions], dtype=np.int64)
        begin, end = track.effort(ends).T
        for k in np.flatnonzero(end - begin > MAX_SPACING_M).tolist():
            parts = int(np.ceil((end[k] - begin[k]) / MAX_SPACING_M))
            levels = np.linspace(begin[k], end[k], parts + 1)[1:-1]
            inner = np.unique(track.times_of_effort(levels))
            first, last = ends[k].tolist()
            times = [first, *inner[(inner > first) & (inner < last)].tolist(), last]
            *passed, final = itertools.pairwise(times)
            between_states += [Step(b, {}, {robot: timed_motion(a, b)}) for a, b in passed]
            n = motions[k][0]
            made[n] = replace(made[n], motions={**made[n].motions, robot: timed_motion(*final)})
    return tuple(sorted([*made, *between_states], key=lambda step: step.time_ns))


def timed_motion(start_ns: int, end_ns: int) -> Motion:
    """A motion of which only the times are known yet."""
    unknown = np.full(3, np.nan)
    return Motion(start_ns, end_ns, unknown, np.full((3, 3), np.nan), np.zeros((3, 0)), 0.0)


def state_times(steps: Sequence[Step]) -> dict[str, IntArray]:
    """Robot -> times (n,) of its states."""
    times: dict[str, list[int]] = defaultdict(list)
    for step in steps:
        for robot in (*step.starts, *step.motions):
            times[robot].append(step.time_ns)
    return {robot: np.array(own, dtype=np.int64) for robot, own in times.items()}


def at_states(estimate: Estimate, steps: Sequence[Step], tracks: Mapping[str, Track]) -> Estimate:
    """An estimate with the states of other ``steps``, on the path between its own.

    Where covariances of its states are unknown, theirs are of the odometry in between alone.
    """
    states = {}
    for robot, times in state_times(steps).items():
        known = estimate.states[robot]
        if np.isnan(known.covs).any():
            known = replace(known, covs=np.zeros_like(known.covs))
        states[robot] = final_at(known, tracks[robot], times, times)
    return replace(estimate, states=states)


def with_motions(
    steps: Sequence[Step],
    tracks: Mapping[str, Track],
    estimate: Estimate,
    begun_ns: Mapping[str, int] | None = None,
) -> tuple[Step, ...]:
    """Steps with their motions by the tracks' present calibration and noise.

    What a calibration changes in them is computed from the ``estimate``. ``begun_ns``: robot ->
    time of its odometry at which its start holds; that of its first state otherwise.
    """
    motions: list[dict[str, Motion]] = [{} for _ in steps]
    where: dict[str, list[tuple[int, Motion]]] = defaultdict(list)
    for n, step in enumerate(steps):
        for robot, motion in step.motions.items():
            where[robot].append((n, motion))
    queries = [
        (
            tracks[robot],
            np.array([m.start_ns for _, m in own], dtype=np.int64),
            np.array([m.end_ns for _, m in own], dtype=np.int64),
        )
        for robot, own in where.items()
    ]
    for (robot, own), query, found in zip(
        where.items(), queries, preintegrate_batch(queries), strict=True
    ):
        d_cal = calibration_jacobian(*query, found, estimate.states[robot])
        cov = _at_least(found.cov, MIN_SIGMA**2) + uncovered_covs(*query)
        made = replace(found, d_cal=d_cal, cov=cov)
        for k, (n, m) in enumerate(own):
            motions[n][robot] = made.one(k, m.start_ns, m.end_ns)
    return tuple(
        replace(
            step,
            starts={
                robot: moved_start(tracks[robot], start, begun_ns[robot], step.time_ns)
                if begun_ns
                else start
                for robot, start in step.starts.items()
            },
            motions={robot: new[robot] for robot in step.motions},
        )
        for step, new in zip(steps, motions, strict=True)
    )


def moved_start(track: Track, start: Start, begun_ns: int, time_ns: int) -> Start:
    """The start of a robot at another time than that at which it holds, by its odometry.

    ``begun_ns`` is of the odometry, ``time_ns`` of what it saw: by how much that is late follows
    from the calibration. Before the odometry begins the robot is as fast as right after.
    """
    apart_ns = time_ns - track.reported_late_ns(track.calibration) - begun_ns
    step = between(track.pose(begun_ns), track.pose(begun_ns + abs(apart_ns)))
    return replace(start, pose=compose(start.pose, step if apart_ns > 0 else inverse(step)))


def _at_least(cov: Array, variance: float) -> Array:
    """Covariances (n, 3, 3) with variances of at least so much in every direction.

    Where two motions divide one increment, that of the second is a difference and may be negative.
    """
    values, axes = np.linalg.eigh(cov)
    low = values[:, 0] < variance
    clipped = (axes * np.maximum(values, variance)[:, None]) @ axes.mT
    return np.where(low[:, None, None], 0.5 * (clipped + clipped.mT), cov)


def calibration_jacobian(
    track: Track, start_ns: IntArray, end_ns: IntArray, found: Motions, states: Trajectory
) -> Array:
    """`along_estimated_path` of a robot whose states are those of its base: (n, 3, p).

    The derivative by the latency of a sensor that is mounted elsewhere stays as measured.
    """
    d_cal = along_estimated_path(track, start_ns, end_ns, found, states)
    if np.abs(track.mount).max() > HELD_SIGMA:  # where it is held solutions have rounding
        d_cal[:, :, -1] = found.d_cal[:, :, -1]
    return d_cal
