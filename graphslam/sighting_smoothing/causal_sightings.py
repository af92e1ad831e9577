"""The causal trajectories of a `SightingPass`: its steps replayed into an incremental back end.

Nothing that enters a state's estimate is later than the state. The calibration is learnt on the
way, and applied to the motions and sightings of the next `BLOCK` steps, which are computed at once.
"""

import time
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.config import AssociationConfig, Config
from graphslam.core.gaussian import mahalanobis_squared
from graphslam.core.geometry import Array, between, compose, rotation3, wrap
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, Estimate, Motion, Step, Trajectory
from graphslam.estimation.compressed_filter import CompressedBackend
from graphslam.estimation.recorded_graph import Source
from graphslam.mapping.gating import gate_distance, gate_floor
from graphslam.mapping.robot_candidates import (
    RobotTarget,
    as_observation,
    predicted_joint,
    robot_distances,
    robots_in,
)
from graphslam.odometry.calibration_jacobian import CalibratedSource
from graphslam.odometry.online_calibration import observed_information
from graphslam.odometry.preintegration import Track
from graphslam.pipeline.robot_state import Causal, RobotState
from graphslam.sighting_smoothing.causal_noise import NoiseSoFar
from graphslam.sighting_smoothing.reoptimise_sightings import SightingGroup, recompute_steps
from graphslam.sighting_smoothing.sighting_pass import SightingPass

#: steps whose motions are computed at once, with the calibration known before the first of them
BLOCK = 16
#: how many times as long as usual the back end's interval between relinearisations is. Each one
#: rounds differently with what is there besides: causal poses of a log cut in half, which are to be
#: those of the whole one to 1e-9 m, differ by 2e-10 with the usual interval and by 8e-12 with twice
#: that. No decision depends on this estimate; of MRCLAM 6 its error stays as it is
INTERVAL = 2


@dataclass(frozen=True, slots=True, eq=False)
class CausalReplay:
    """Causal trajectories by robot, and the time of each step of the back end (n,), ms."""

    trajectories: dict[str, Causal]
    step_ms: Array


def replay_causally(one: SightingPass) -> CausalReplay:
    """Replay the steps of a pass; the pass is as before afterwards.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    tracks = one.tracks
    before = {name: track.calibration for name, track in tracks.items()}
    for track in tracks.values():
        track.calibration = track.prior
    try:
        return _replay(one, tracks)
    finally:
        for name, track in tracks.items():
            track.calibration = before[name]


def _replay(one: SightingPass, tracks: Mapping[str, Track]) -> CausalReplay:
    backend = CompressedBackend(_config(one))
    runs = {
        name: RobotState(track, clock=one.runs[name].clock, has_scans=False)
        for name, track in tracks.items()
    }
    known: set[int | str] = set()
    step_ms: list[float] = []
    latest: dict[str, Array] = {}  # estimates of the latest states
    rejected: set[int] = set()  # sources of sightings
    noise = NoiseSoFar(one.steps, one.groups, one.sources, one.config)
    for first in range(0, len(one.steps), BLOCK):
        block = range(first, min(first + BLOCK, len(one.steps)))
        used = {name: CalibratedSource.of(run.track) for name, run in runs.items()}
        if noise.is_due(first):
            found = backend.current_estimate()
            if noise.measure(first, found, tracks):
                backend = _weighed_anew(one, first, found, noise, rejected)
                latest = {name: backend.state_mean(name) for name in latest}
        for recorded in _computed(one.steps[first : block.stop], noise.groups, block, runs):
            began = time.perf_counter()
            false = _not_there(recorded, backend, one.clock_sigma_s, one.config.association)
            rejected |= false
            step = _used(recorded, false, noise.known)
            backend.add(step)
            poses = {name: backend.state_mean(name) for name in (*step.starts, *step.motions)}
            if one.config.odometry.calibrate and step.motions:
                _learn(step, poses, latest, runs, used, known, backend)
            latest |= poses
            step_ms.append(1e3 * (time.perf_counter() - began))
            known.update(a.target for a in step.associations)
            covs = backend.pose_covariances(list(poses))
            for (name, pose), cov in zip(poses.items(), covs, strict=True):
                runs[name].append(step.time_ns, pose)
                runs[name].causal_covs.append(cov)
    frames = one.frames
    trajectories = {
        name: run.causal(one.starts[frame].pose, frames.away.get(frame, 0.0))
        for name, run in runs.items()
        for frame in [frames.of[name]]
    }
    return CausalReplay(trajectories, np.array(step_ms))


def _weighed_anew(
    one: SightingPass, number: int, estimate: Estimate, noise: NoiseSoFar, rejected: Collection[int]
) -> CompressedBackend:
    """A back end with the first steps of a pass, by the noise and the calibrations known by then.

    Args:
        one: the pass.
        number: of the steps.
        estimate: of their states and landmarks.
        noise: of the sightings.
        rejected: sources of those that are left out, see `_not_there`.
    """
    first = range(number)
    tracks = {name: one.tracks[name] for name in estimate.states}
    groups = [part for group in noise.groups if len((part := group.of_steps(first)).where)]
    steps = recompute_steps(one.steps[:number], estimate, tracks, groups)
    used = [_used(step, rejected, noise.known) for step in steps]
    return CompressedBackend.at_estimate(_config(one), used, estimate)


def _used(step: Step, rejected: Collection[int], known: Collection[Source]) -> Step:
    """A step as the back end gets it: without ``rejected`` sources, see `_counted`, `_merged`."""
    return _merged(_counted(step, _without(step, rejected), known), known)


def _without(step: Step, rejected: Collection[int]) -> Step:
    """A step without the sightings of these sources."""
    kept = tuple(a for a in step.associations if a.source not in rejected)
    return step if len(kept) == len(step.associations) else replace(step, associations=kept)


def _config(one: SightingPass) -> Config:
    """The settings of the back end."""
    settings = one.config.backend
    settings = replace(settings, relinearize_every=INTERVAL * settings.relinearize_every)
    return replace(one.config, backend=settings)


def _computed(
    steps: Sequence[Step],
    groups: Sequence[SightingGroup],
    numbers: range,
    runs: Mapping[str, RobotState],
) -> tuple[Step, ...]:
    """Consecutive steps by their ``numbers``, computed with the calibration known before them."""
    states = {}
    for name, run in runs.items():
        starts = [step for step in steps if name in step.starts]
        if not run.started and not starts:
            continue
        begin_ns = run.state_ns if run.started else starts[0].time_ns
        pose = run.latest_pose if run.started else starts[0].starts[name].pose
        ends = [step.motions[name].end_ns for step in steps if name in step.motions]
        times = np.array([begin_ns, *ends], dtype=np.int64)
        path = run.track.mounted_pose(times)
        predicted = compose(pose, between(path[0], path))
        states[name] = Trajectory(times, predicted, np.full((len(times), 3, 3), np.nan))
    tracks = {name: runs[name].track for name in states}
    own = [part for group in groups if len((part := group.of_steps(numbers)).where)]
    return recompute_steps(steps, Estimate(states, {}, 0.0, 0), tracks, own)


def _not_there(
    step: Step,
    backend: CompressedBackend,
    clock_sigma_s: float,
    config: AssociationConfig,
) -> set[int]:
    """Sources of sightings of robots that are not where the back end expects these."""
    of_robots: dict[str, list[Association]] = defaultdict(list)
    floor = gate_floor(config)
    for a in _doubtful(step, backend, floor, config):
        of_robots[a.robot].append(a)
    false: set[int] = set()
    for robot, own in of_robots.items():
        seen = [as_observation(a) for a in own]
        others = [
            RobotTarget(name, motion, _clock_shift(motion, clock_sigma_s))
            for name in robots_in(seen)
            for motion in [step.motions.get(name)]
        ]
        joint = backend.joint(robot, [], [other.name for other in others])
        joint = predicted_joint(joint, step.motions.get(robot), others)
        _, found = robot_distances(seen, others, joint, floor)
        gate = gate_distance(config.gate_probability, found.dof)
        far = zip(own, found.d2 >= gate, strict=True)
        false |= {a.source for a, is_far in far if is_far and a.source is not None}
    return false


def _counted(step: Step, kept: Step, known: Collection[Source]) -> Step:
    """What is ``kept`` of a step; n sightings of one target count as one, see `inflate_repeated`.

    Where some are left out, n is smaller. The covariances of ``known`` sources are by another rule.
    """
    if kept is step:
        return step
    before, left = (
        Counter((a.robot, a.target) for a in some.associations) for some in (step, kept)
    )
    share = {pair: n / before[pair] for pair, n in left.items()}
    weighed = (
        a
        if (a.robot, a.model) in known
        else a.with_measurement(a.z, a.cov * share[a.robot, a.target])
        for a in kept.associations
    )
    return replace(kept, associations=tuple(weighed))


def _merged(step: Step, known: Collection[Source]) -> Step:
    """A step with one bearing and range, their mean by information, for several of one target.

    Of ``known`` sources, whose errors are shared: it tells as much, for less work.
    """
    if not known:
        return step
    groups: dict[tuple[str, int, int | str], list[Association]] = defaultdict(list)
    for a in step.associations:
        if (a.robot, a.model) in known:
            groups[a.robot, a.time_ns, a.target].append(a)
    several = [own for own in groups.values() if len(own) > 1]
    if not several:
        return step
    seen = [a for own in several for a in own]
    counts = [len(own) for own in several]
    firsts = np.cumsum([0, *counts[:-1]])
    z, information = np.array([a.z for a in seen]), np.linalg.inv([a.cov for a in seen])
    off = z - np.repeat(z[firsts], counts, axis=0)
    off[:, 0] = wrap(off[:, 0])
    covs = np.linalg.inv(np.add.reduceat(information, firsts))
    sums = np.add.reduceat(information @ off[:, :, None], firsts)
    means = z[firsts] + (covs @ sums)[:, :, 0]
    means[:, 0] = wrap(means[:, 0])
    found = zip(several, means, covs, strict=True)
    one = [own[0].with_measurement(mean, cov) for own, mean, cov in found]
    merged = set(map(id, seen))
    rest = (a for a in step.associations if id(a) not in merged)
    return replace(step, associations=(*rest, *one))


def _doubtful(
    step: Step, backend: CompressedBackend, floor: Mapping[str, Array], config: AssociationConfig
) -> Iterator[Association]:
    """Sightings of robots that are not in the gate by their own noise alone.

    The covariance of the estimate makes the gate wider: the others need none, which is expensive.
    """
    by_model: dict[str, list[Association]] = defaultdict(list)
    for a in step.associations:
        if isinstance(a.target, str):
            by_model[a.model].append(a)
    poses: dict[str, Array] = {}
    for robot in {str(r) for own in by_model.values() for a in own for r in (a.robot, a.target)}:
        pose, motion = backend.state_mean(robot), step.motions.get(robot)
        poses[robot] = pose if motion is None else compose(pose, motion.delta)
    for name, own in by_model.items():
        model = MODELS[name]
        x, t = np.array([[poses[a.robot], poses[str(a.target)]] for a in own]).transpose(1, 0, 2)
        z, cov = np.array([a.z for a in own]), np.array([a.cov for a in own])
        r, R = model.residual(z, x, t), model.noise(z, cov, x, t) + floor[name]
        inside = mahalanobis_squared(r, R) < gate_distance(config.gate_probability, model.rows)
        yield from (a for a, is_in in zip(own, inside, strict=True) if not is_in)


def _clock_shift(motion: Motion | None, clock_sigma_s: float) -> Array:
    """`RobotTarget.clock_shift` by the robot's last motion; none for one that stands."""
    if motion is None or not clock_sigma_s:
        return np.zeros(2)
    return np.asarray(motion.delta[:2] * (1e9 * clock_sigma_s / (motion.end_ns - motion.start_ns)))


def _learn(
    step: Step,
    poses: Mapping[str, Array],
    latest: Mapping[str, Array],
    runs: Mapping[str, RobotState],
    used: Mapping[str, CalibratedSource],
    known: Collection[int | str],
    backend: CompressedBackend,
) -> None:
    """Improve robots' calibrations from a step.

    Args:
        step: as the back end has it.
        poses: (3,) estimates of the states that it made.
        latest: (3,) estimates of the states before these.
        runs: the robots, without these states.
        used: what its motions were computed with.
        known: landmarks that were there before it.
        backend: after the step.
    """
    seen = [
        a
        for a in step.associations
        if a.target in known and a.robot in step.motions and a.time_ns == step.time_ns
    ]
    seen = [a for a in seen if isinstance(a.target, int)]
    targets = list({int(a.target): None for a in seen})
    means = dict(zip(targets, backend.landmark_means(targets), strict=True))
    observed = observed_information(seen, poses, [means[int(a.target)] for a in seen])
    for name, motion in step.motions.items():
        run = runs[name]
        last = latest[name]
        turn = rotation3(-float(last[2]))
        better = run.calibrator.update(
            used[name], motion, between(last, poses[name]), turn @ observed[name] @ turn.T
        )
        if better is not used[name].calibration:
            run.track.calibration = better
