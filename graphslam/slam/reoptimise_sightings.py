"""The last word on logs of sightings: calibration, noise and all states, from the whole log.

After the log went by, motions and sightings are made anew with the calibration found so far and
everything is solved together; what the residuals say about the noise of each robot's sightings is
taken in once (again and again it would collapse).
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from graphslam.core.config import Config
from graphslam.core.geometry import Array, between, wrap
from graphslam.core.motion_models import Calibration
from graphslam.core.observation_models import MODELS, transport
from graphslam.core.records import Estimate, Motion, Sighting, Step
from graphslam.estimation.calibration_graph import solve_calibrated
from graphslam.odometry.preintegration import Motions, Track, motions_of
from graphslam.odometry.readings import IntArray
from graphslam.perception.sightings import sighting_observation
from graphslam.slam.sighting_batches import transport_batch, transport_target

#: times that motions and sightings are made anew
ROUNDS = 2
#: ns: residuals of one target's sightings farther apart are taken as independent
WINDOW_NS = 10_000_000_000
#: residuals are cut at this many of their own sigmas when their noise is measured
CUT = 3.0
LARGEST = 20.0
#: smallest factor on a variance: what a log states is not doubted downwards beyond
SMALLEST = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class ReoptimisedSightingLog:
    """The estimate and the steps behind it; the tracks have their final calibration."""

    estimate: Estimate
    steps: tuple[Step, ...]


def reoptimise_sighting_log(
    steps: Sequence[Step],
    estimate: Estimate,
    tracks: Mapping[str, Track],
    sources: Sequence[Sighting],
    config: Config,
) -> ReoptimisedSightingLog:
    """Solve a log of sightings again, `ROUNDS` times.

    Args:
        steps: as recorded.
        estimate: of all their states and landmarks.
        tracks: odometry of every robot; their calibration is set to what is found.
        sources: recorded sightings; `Association.source` is an index into them.
        config: settings.
    """
    if not config.odometry.calibrate:
        return ReoptimisedSightingLog(estimate, tuple(steps))
    priors = {name: track.nominal for name, track in tracks.items()}
    made, seen = tuple(steps), sightings_of(steps, sources)
    for k in range(ROUNDS):
        now = {name: track.calibration for name, track in tracks.items()}
        for name, track in tracks.items():
            still = np.diag(np.full(len(now[name].mean), 1e-18))
            track.calibration = Calibration(now[name].names, now[name].mean, still)
        made = _remade(steps, estimate, tracks, seen)
        if k:
            wider = _on_covariances(variances(made, seen, estimate))
            looser = _on_covariances(motion_variances(made, estimate))
            made = tuple(_inflated(step, wider, looser) for step in made)
        solved = solve_calibrated(made, estimate, priors, now, config.robust, rough=k < ROUNDS - 1)
        estimate = solved.estimate
        for name, track in tracks.items():
            track.calibration = solved.calibrations[name]
    return ReoptimisedSightingLog(estimate, made)


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Sightings of one kind by one robot of one other robot, or of landmarks (``other`` None).

    ``where`` (n, 2): number of the step and of the association in it; times (n,) ns of the
    observer's state, of the sighting, and of the step; ``z`` (n, k) and ``cov`` (n, k, k) as
    measured, in the base frame; ``share`` (n,) how many of the step are of the same target, see
    `gathering.shared`.
    """

    robot: str
    other: str | None
    where: IntArray
    state_ns: IntArray
    seen_ns: IntArray
    step_ns: IntArray
    z: Array
    cov: Array
    share: Array


def sightings_of(steps: Sequence[Step], sources: Sequence[Sighting]) -> list[Seen]:
    """All sightings behind the associations of steps, in groups to be carried at once."""
    groups: dict[tuple[str, str | None, int], list[tuple[Any, ...]]] = defaultdict(list)
    for n, step in enumerate(steps):
        count = Counter((a.robot, a.target) for a in step.associations)
        for k, a in enumerate(step.associations):
            if a.source is None:
                continue
            sighting = sources[a.source]
            o = sighting_observation(sighting)
            z, cov = transport(o.z, o.cov, sighting.mount, np.zeros((3, 3)))
            other = a.target if isinstance(a.target, str) else None
            times = (a.time_ns, sighting.time_ns, step.time_ns)
            row = ((n, k), *times, z, cov, count[a.robot, a.target])
            groups[a.robot, other, len(z)].append(row)
    return [
        Seen(robot, other, *map(np.array, zip(*rows, strict=True)))
        for (robot, other, _), rows in groups.items()
    ]


def _remade(
    steps: Sequence[Step], estimate: Estimate, tracks: Mapping[str, Track], seen: Sequence[Seen]
) -> tuple[Step, ...]:
    """Steps with the tracks' calibration of now."""
    made = {
        robot: [(n, step.motions[robot]) for n, step in enumerate(steps) if robot in step.motions]
        for robot in tracks
    }
    asked = [
        (tracks[robot], _times(m.start_ns for _, m in new), _times(m.end_ns for _, m in new))
        for robot, new in made.items()
    ]
    asked += [(tracks[group.robot], group.state_ns, group.seen_ns) for group in seen]
    asked += [
        (tracks[group.other], group.step_ns, group.seen_ns)
        for group in seen
        if group.other is not None
    ]
    moved = iter(motions_of(asked))
    motions: list[dict[str, Motion]] = [{} for _ in steps]
    for robot, new in made.items():
        one = next(moved).one
        for i, (n, m) in enumerate(new):
            motions[n][robot] = one(i, m.start_ns, m.end_ns)
    observers = [next(moved) for _ in seen]
    others = [None if group.other is None else next(moved) for group in seen]
    associations = [list(step.associations) for step in steps]
    for group, observer, other in zip(seen, observers, others, strict=True):
        z, cov = _carried(group, estimate, observer, other)
        cov = cov * group.share[:, None, None]
        for (n, k), z_k, cov_k in zip(group.where.tolist(), z, cov, strict=True):
            associations[n][k] = associations[n][k].measured(z_k, cov_k)
    return tuple(
        # in the order of the step: it is the order of the states
        replace(step, motions={r: new[r] for r in step.motions}, associations=tuple(found))
        for step, new, found in zip(steps, motions, associations, strict=True)
    )


def _times(times_ns: Iterable[int]) -> IntArray:
    return np.array(list(times_ns), dtype=np.int64)


def _carried(
    group: Seen, estimate: Estimate, observer: Motions, other: Motions | None
) -> tuple[Array, Array]:
    """Measurements (n, k) of a group between the states, and their covariances.

    Args:
        group: as measured.
        estimate: of all states.
        observer: motions (n) from its states to when it saw something.
        other: motions (n) of the robot that was seen, from its states to then.
    """
    apart = (group.state_ns != group.seen_ns)[:, None, None]
    z, cov = transport_batch(group.z, group.cov, observer.delta, observer.cov * apart)
    if group.other is None or other is None:
        return z, cov
    apart = (group.step_ns != group.seen_ns)[:, None, None]
    turn = (
        _poses(estimate, group.other, group.step_ns)[:, 2]
        - _poses(estimate, group.robot, group.state_ns)[:, 2]
    )
    return transport_target(z, cov, other.delta, other.cov * apart, turn)


def _poses(estimate: Estimate, robot: str, times_ns: IntArray) -> Array:
    """States (n, 3) of a robot at their times (n,)."""
    return estimate.states[robot].at(times_ns)


def variances(steps: Sequence[Step], seen: Sequence[Seen], estimate: Estimate) -> dict[str, Array]:
    """Robot -> factor (2,) on the variances of its bearings and ranges of points.

    The variance of sums of normalised residuals over windows, per residual: 1 for white noise of
    the stated size, larger where errors are larger or correlated, as several sightings then tell no
    more than one. (Batch means, e.g. G. S. Fishman, Discrete-Event Simulation, 2001, section 6.)
    """
    factors = {}
    for group in seen:
        if group.other is not None or group.z.shape[1] != 2:
            continue
        made = [steps[n].associations[k] for n, k in group.where]
        targets = np.array([a.target for a in made])
        x = _poses(estimate, group.robot, group.state_ns)
        t = np.array([estimate.landmarks[int(i)][0] for i in targets])
        r = MODELS["point"].residual(np.array([a.z for a in made]), x, t)
        r /= np.sqrt(np.array([np.diag(a.cov) for a in made]))
        cut = CUT * 1.4826 * np.median(np.abs(r), axis=0)
        windows = np.column_stack([targets, group.seen_ns // WINDOW_NS])
        _, window = np.unique(windows, axis=0, return_inverse=True)
        sums = np.zeros((window.max() + 1, 2))
        np.add.at(sums, window.ravel(), np.clip(r, -cut, cut))
        factors[group.robot] = np.maximum(np.square(sums).sum(axis=0) / len(r), SMALLEST)
    return factors


def motion_variances(steps: Sequence[Step], estimate: Estimate) -> dict[str, Array]:
    """Robot -> factor (3,) on the variances of its motions, as `variances` has it for sightings."""
    sums: dict[str, dict[int, Array]] = defaultdict(dict)
    counts: Counter[str] = Counter()
    for step in steps:
        for robot, motion in step.motions.items():
            if motion.length_m == 0 and motion.delta[2] == 0:
                continue
            states = estimate.states[robot]
            n = states.index(motion.end_ns)
            miss = between(states.poses[n - 1], states.poses[n]) - motion.delta
            miss[2] = wrap(miss[2])
            r = np.clip(miss / np.sqrt(np.diag(motion.cov)), -LARGEST, LARGEST)
            window = motion.end_ns // WINDOW_NS
            sums[robot][window] = sums[robot].get(window, 0.0) + r
            counts[robot] += 1
    factors = {}
    for robot, windows in sums.items():
        f = np.square(list(windows.values())).sum(axis=0) / counts[robot]
        f[:2] = max(f[0], f[1])
        factors[robot] = np.maximum(f, 1.0)
    return factors


def _inflated(step: Step, seen: Mapping[str, Array], moved: Mapping[str, Array]) -> Step:
    """A step with wider sightings of points, and wider motions.

    ``seen`` (2, 2) and ``moved`` (3, 3) are factors on the covariances of each robot's own.
    """
    motions = {
        robot: replace(m, cov=m.cov * moved[robot]) if robot in moved else m
        for robot, m in step.motions.items()
    }
    associations = tuple(
        a.measured(a.z, a.cov * seen[a.robot]) if a.robot in seen and len(a.z) == 2 else a
        for a in step.associations
    )
    return replace(step, motions=motions, associations=associations)


def _on_covariances(factors: Mapping[str, Array]) -> dict[str, Array]:
    """Robot -> factors (k, k) on covariances, from those (k,) on variances."""
    return {robot: np.sqrt(np.outer(f, f)) for robot, f in factors.items()}
