"""A whole log of sightings solved again: calibration, noise and all states together.

Motions and sightings are computed again with the current calibration, and everything is solved
together. What the residuals say about the noise of each robot's motions and sightings is used in
the last round.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import Config
from graphslam.core.geometry import Array
from graphslam.core.observation_models import MODELS
from graphslam.core.record import replace
from graphslam.core.records import Estimate, Motion, Sighting, Step
from graphslam.estimation.batch_calibration import ROUNDS, calibrate
from graphslam.estimation.calibration_graph import CalibratedSolution
from graphslam.estimation.log_noise import LogNoise
from graphslam.estimation.motion_noise import noise_scales, scale_motion_noise
from graphslam.estimation.sandwich_covariance import shared_spans, weighing_variance
from graphslam.odometry.increment_sums import Motions
from graphslam.odometry.preintegration import Track, preintegrate_batch
from graphslam.pipeline.sighting_batches import transport_batch, transport_target
from graphslam.sighting_smoothing.sighting_states import measured_from_bases

#: ns: residuals of one target's sightings farther apart are taken as independent
WINDOW_NS = 10_000_000_000
#: ns: errors of motions, which are short here, are correlated over as long as this
MOTION_WINDOW_NS = 3_000_000_000
#: residuals are cut at this many of their own sigmas when their noise is measured
CLIP_SIGMAS = 3.0
#: smallest factor on a variance: what a log states is not doubted downwards beyond
MIN_VARIANCE_FACTOR = 1.0


def solve_sighting_log(
    steps: Sequence[Step],
    estimate: Estimate,
    tracks: Mapping[str, Track],
    groups: Sequence["SightingGroup"],
    config: Config,
    rounds: int = ROUNDS,
    noise: LogNoise | None = None,
    solved_once: Callable[[CalibratedSolution, Sequence[Step]], None] | None = None,
) -> tuple[Estimate, tuple[Step, ...]]:
    """Solve a log of sightings again: with the noise that it shows, and the calibration unknown.

    Args:
        steps: as recorded.
        estimate: of all their states and landmarks.
        tracks: odometry of every robot; their calibration is set to what is found.
        groups: the sightings of ``steps``.
        config: settings.
        rounds: how often.
        noise: of the log; None takes it from the residuals of the last round but one.
        solved_once: see `calibrate`.

    Returns:
        The estimate and the steps behind it.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    if noise is not None:
        groups = [with_shared_errors(group, noise) for group in groups]

    def rebuild(estimate: Estimate, last: bool) -> tuple[Step, ...]:
        # once only: estimated from its own result again and again, noise would collapse
        made = recompute_steps(steps, estimate, tracks, groups, widen=last and noise is None)
        if not last:
            return made
        if noise is not None:
            return scale_motion_noise(made, noise.motion_scales())
        return scale_motion_noise(made, noise_scales(made, estimate, MOTION_WINDOW_NS))

    shared = None if noise is None else noise.shared_errors
    return calibrate(
        rebuild, estimate, tracks, config.robust, rounds, shared=shared, solved_once=solved_once
    )


def with_shared_errors(group: "SightingGroup", noise: LogNoise) -> "SightingGroup":
    """Sightings with the noise of a log, weighed by how many of them share an error."""
    known = noise.sightings.get((group.robot, "point" if group.other is None else "robot-point"))
    if known is None or group.z.shape[1] != 2:
        return group
    _, count = shared_spans(group.landmarks, group.state_ns)
    sigma = np.sqrt(weighing_variance(known, count))
    cov = group.cov * sigma[:, :, None] * sigma[:, None, :]
    return replace(group, cov=cov, share=np.ones_like(group.share))


@dataclass(frozen=True, slots=True, eq=False)
class SightingGroup:
    """Sightings of one kind by one robot of one other robot, or of landmarks (``other`` None).

    ``where`` (n, 2): number of the step and of the association in it; ``landmarks`` (n,): their
    numbers, -1 for robots; times (n,) ns of the observer's state, of the sighting, and of the step;
    ``z`` (n, k) and ``cov`` (n, k, k) as measured, in the base frame; ``share`` (n,): how many
    sightings of the step are of the same target, see `sighting_batches.inflate_repeated`.
    """

    robot: str
    other: str | None
    where: IntArray
    landmarks: IntArray
    state_ns: IntArray
    seen_ns: IntArray
    step_ns: IntArray
    z: Array
    cov: Array
    share: Array

    def of_steps(self, numbers: range) -> "SightingGroup":
        """The sightings of consecutive steps, by their numbers; `where` counts from the first."""
        i, j = np.searchsorted(self.where[:, 0], [numbers.start, numbers.stop])
        own = slice(int(i), int(j))
        where = self.where[own] - np.array([numbers.start, 0])
        times = self.state_ns[own], self.seen_ns[own], self.step_ns[own]
        measured = self.z[own], self.cov[own], self.share[own]
        return SightingGroup(self.robot, self.other, where, self.landmarks[own], *times, *measured)


def group_sightings(steps: Sequence[Step], sources: Sequence[Sighting]) -> list[SightingGroup]:
    """The sightings behind the associations of steps, grouped so that each is one array."""
    groups: dict[tuple[str, str | None, int], tuple[list[Sighting], list[int]]]
    groups = defaultdict(lambda: ([], []))
    for n, step in enumerate(steps):
        count = Counter((a.robot, a.target) for a in step.associations)
        for k, a in enumerate(step.associations):
            if a.source is None:
                continue
            sighting, target, share = sources[a.source], a.target, count[a.robot, a.target]
            other, landmark = (target, -1) if isinstance(target, str) else (None, target)
            seen, rows = groups[a.robot, other, len(sighting.z)]
            seen.append(sighting)
            rows += n, k, landmark, a.time_ns, sighting.time_ns, step.time_ns, share
    made = []
    for (robot, other, _), (seen, rows) in groups.items():
        # columns one after the other: what follows takes slices of them
        numbers = np.array(rows, dtype=np.int64).reshape(len(seen), -1)
        where, columns = numbers[:, :2].copy(), np.ascontiguousarray(numbers[:, 2:].T)
        landmarks, state_ns, seen_ns, step_ns, shares = columns
        z, cov = measured_from_bases(seen)
        made.append(
            SightingGroup(
                robot, other, where, landmarks, state_ns, seen_ns, step_ns, z, cov, shares
            )
        )
    return made


def recompute_steps(
    steps: Sequence[Step],
    estimate: Estimate,
    tracks: Mapping[str, Track],
    groups: Sequence[SightingGroup],
    *,
    widen: bool = False,
) -> tuple[Step, ...]:
    """Steps with motions and measurements computed with the tracks' present calibration.

    Args:
        steps: as recorded.
        estimate: of the states of robots that see each other; only their headings are used.
        tracks: odometry of every robot.
        groups: the sightings of ``steps``.
        widen: give measurements the variances that their residuals from ``estimate`` show, see
            `sighting_variances`; it must have all states and landmarks then.
    """
    recorded = {
        robot: [(n, step.motions[robot]) for n, step in enumerate(steps) if robot in step.motions]
        for robot in tracks
    }
    queries = [
        (tracks[robot], _times(m.start_ns for _, m in old), _times(m.end_ns for _, m in old))
        for robot, old in recorded.items()
    ]
    queries += [(tracks[group.robot], group.state_ns, group.seen_ns) for group in groups]
    queries += [
        (tracks[group.other], group.step_ns, group.seen_ns)
        for group in groups
        if group.other is not None
    ]
    results = iter(preintegrate_batch(queries))
    motions: list[dict[str, Motion]] = [{} for _ in steps]
    for robot, old in recorded.items():
        one = next(results).one
        for i, (n, m) in enumerate(old):
            motions[n][robot] = one(i, m.start_ns, m.end_ns)
    observers = [next(results) for _ in groups]
    others = [None if group.other is None else next(results) for group in groups]
    associations = [list(step.associations) for step in steps]
    measured = []
    for group, observer, other in zip(groups, observers, others, strict=True):
        z, cov = _at_states(group, estimate, observer, other)
        measured.append((z, cov * group.share[:, None, None]))
    factors = sighting_variances(groups, measured, estimate) if widen else {}
    for group, (z, cov) in zip(groups, measured, strict=True):
        sigmas = np.sqrt(factors.get(group.robot, np.ones(2))) if z.shape[1] == 2 else np.ones(3)
        wider = cov * np.outer(sigmas, sigmas)
        for (n, k), z_k, cov_k in zip(group.where.tolist(), z, wider, strict=True):
            associations[n][k] = associations[n][k].with_measurement(z_k, cov_k)
    return tuple(
        # in the order of the step: it is the order of the states
        replace(step, motions={r: new[r] for r in step.motions}, associations=tuple(found))
        for step, new, found in zip(steps, motions, associations, strict=True)
    )


def _times(times_ns: Iterable[int]) -> IntArray:
    return np.array(list(times_ns), dtype=np.int64)


def _at_states(
    group: SightingGroup, estimate: Estimate, observer: Motions, other: Motions | None
) -> tuple[Array, Array]:
    """Measurements (n, k) of a group as between the states, and their covariances.

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


def sighting_variances(
    groups: Sequence[SightingGroup], measured: Sequence[tuple[Array, Array]], estimate: Estimate
) -> dict[str, Array]:
    """Robot -> factor (2,) on the variances of its bearings and ranges of points.

    The variance of sums of normalised residuals over windows, per residual. It is 1 for white noise
    of the stated size, and larger where errors are larger or correlated, since several sightings
    then tell no more than one. (Batch means, e.g. G. S. Fishman, Discrete-Event Simulation, 2001,
    section 6.)

    Args:
        groups: of the sightings.
        measured: their measurements (n, k) and covariances as between the states, of each group.
        estimate: of all states and landmarks.
    """
    factors = {}
    for group, (z, cov) in zip(groups, measured, strict=True):
        if group.other is not None or z.shape[1] != 2:
            continue
        x = _poses(estimate, group.robot, group.state_ns)
        landmarks, number = np.unique(group.landmarks, return_inverse=True)
        t = np.array([estimate.landmarks[i][0] for i in landmarks.tolist()])[number]
        r = MODELS["point"].residual(z, x, t) / np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
        cut = CLIP_SIGMAS * 1.4826 * np.median(np.abs(r), axis=0)
        windows = np.column_stack([group.landmarks, group.seen_ns // WINDOW_NS])
        _, window = np.unique(windows, axis=0, return_inverse=True)
        sums = np.zeros((window.max() + 1, 2))
        np.add.at(sums, window.ravel(), np.clip(r, -cut, cut))
        factors[group.robot] = np.maximum(np.square(sums).sum(axis=0) / len(r), MIN_VARIANCE_FACTOR)
    return factors
