"""The solution of a `SightingPass`: all its robots together, or every robot by itself.

The initial values are those of odometry, which drifts by metres. A kernel wide enough not to reject
what the drift puts far off leads to the neighbourhood of the solution; from there on the kernel is
the configured one (graduated optimisation, e.g. H. Yang et al., Graduated non-convexity for robust
spatial perception, RA-L 2020, DOI 10.1109/LRA.2020.2965893). Motions are with the uncertainty of
their calibration until then.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain

import numpy as np

from graphslam.core.config import Config, RobustConfig
from graphslam.core.geometry import Array, between, compose
from graphslam.core.motion_models import Calibration
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Estimate, Step, Trajectory
from graphslam.core.worker import parallel_map
from graphslam.estimation.batch_calibration import calibrate, calibrate_roughly
from graphslam.mapping.landmark_map import observed_from
from graphslam.mapping.robot_candidates import NOT_THERE
from graphslam.multi_robot.relative_frames import RobotEstimate
from graphslam.odometry.preintegration import Track
from graphslam.slam.reoptimise_sightings import (
    SightingGroup,
    group_sightings,
    recompute_steps,
    solve_sighting_log,
)
from graphslam.slam.robot_gating import RobotOffers
from graphslam.slam.sighting_noise import estimate_noise
from graphslam.slam.sighting_pass import SightingPass
from graphslam.slam.state_per_step import sighting_problem

#: how much wider the kernel is in the beginning
WIDE = 10.0
#: rounds of deciding which sightings of robots are used, and share of them that may still change:
#: the solution that follows is hardly moved by it
GATING_ROUNDS, FEW = 3, 0.01
#: rounds of the rough solution, after which the latency of odometry no longer changes much
ROUNDS = 3


def solve_roughly(one: SightingPass) -> tuple[Estimate, tuple[Step, ...]]:
    """An estimate near that of all robots together, and the steps behind it.

    It sets the calibration of their tracks.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    states, kernel = _initial_states(one), _wide(one.config.robust)
    if set(one.tracks) <= set(one.known.alone):  # what calibrations need is known: once is enough
        with _held(one.tracks):
            start, made = _with_landmarks(states, one.steps, one.tracks, one.groups)
        return calibrate(lambda *_: made, start, one.tracks, kernel, 1, rough=True)
    estimate = _rough(states, one.steps, one.tracks, one.groups, one.config)
    with _held(one.tracks):
        return estimate, recompute_steps(one.steps, estimate, one.tracks, one.groups)


@contextmanager
def _held(tracks: Mapping[str, Track]) -> Iterator[None]:
    """Let motions leave out the errors of the calibration."""
    known = {name: track.calibration for name, track in tracks.items()}
    for track in tracks.values():
        track.calibration = track.calibration.held()
    yield
    for name, track in tracks.items():
        track.calibration = known[name]


def solve_without_contradiction(one: SightingPass) -> Estimate:
    """An estimate by those sightings that agree with most others, leaving out the rest.

    It may be far off, but unlike that of a wide kernel it is not bent by sightings under a false
    identity. The calibration of the tracks is as before afterwards.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    before = {name: track.calibration for name, track in one.tracks.items()}
    states = _initial_states(one)
    start, made = _with_landmarks(states, one.steps, one.tracks, one.groups)
    estimate = calibrate_roughly(made, start, one.tracks, one.config.robust, 0)
    for name, track in one.tracks.items():
        track.calibration = before[name]
    return estimate


def _initial_states(one: SightingPass) -> dict[str, Trajectory]:
    """States before any sighting of a robot is used; sets the calibration of the tracks."""
    states, alone = {}, one.known.alone
    for robot, track in one.tracks.items():
        track.calibration = track.prior
        states[robot] = states_by_odometry(one.steps, robot, track)
        if set(one.tracks) <= set(alone):
            states[robot] = _moved(alone[robot], states[robot])
            track.calibration = alone[robot].track.calibration
    return states


def solve_finely(one: SightingPass, rough: Estimate) -> tuple[Estimate, tuple[Step, ...]]:
    """The estimate of all robots together, from a rough one, and the steps behind it.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    noise = estimate_noise(one.steps, one.sources, rough, one.tracks, one.config)
    one.noise = noise.to_summary()
    problem, start = sighting_problem(one, rough, noise, one.groups)
    return problem.finish(one, problem.steps, start)


def with_gated_robots(one: SightingPass, rough: Estimate, made: tuple[Step, ...]) -> Estimate:
    """An estimate without sightings of robots that contradict all else; their steps lose them.

    Args:
        one: the pass.
        rough: the estimate with them.
        made: the steps behind it.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    recorded, groups, kernel = one.steps, one.groups, _wide(one.config.robust)
    kept = every = _sources(recorded)
    used = made

    def rebuild(estimate: Estimate, _last: bool) -> tuple[Step, ...]:
        nonlocal made
        made = recompute_steps(recorded, estimate, one.tracks, groups)
        return _only(made, kept)

    for _ in range(GATING_ROUNDS):
        robots = RobotOffers.of(made, one.sources)
        before, kept = kept, _sources(robots.associated_again(used, rough, kernel, one.config))
        if len(kept ^ before) <= FEW * robots.count:
            break
        kernel = one.config.robust
        rough, used = calibrate(rebuild, rough, one.tracks, kernel, 1, rough=True)
    if len(kept) < len(every):
        one.keep_steps(_only(recorded, kept))
        one.rejected[NOT_THERE] = robots.unused(one.steps)
    return rough


def _wide(kernel: RobustConfig) -> RobustConfig:
    """The kernel of the rough solution."""
    return replace(kernel, scale=WIDE * kernel.scale)


def _sources(steps: Sequence[Step]) -> set[int | None]:
    """Numbers of the sightings behind the associations of steps."""
    return {a.source for step in steps for a in step.associations}


def _only(steps: Sequence[Step], sources: Collection[int | None]) -> tuple[Step, ...]:
    """Steps with the associations of some sightings."""
    return tuple(
        replace(step, associations=tuple(a for a in step.associations if a.source in sources))
        for step in steps
    )


def solve_robots_apart(one: SightingPass) -> Estimate:
    """The estimates of robots that have nothing in common, each in its own frame.

    It sets the calibration of their tracks.

    Raises:
        EstimationError: one is indeterminate.
    """

    def solve(robot: str) -> tuple[Estimate, Calibration]:
        track = one.runs[robot].track
        steps, tracks = steps_of_robot(one.steps, robot), {robot: track}
        groups = group_sightings(steps, one.sources)
        states = {robot: states_by_odometry(steps, robot, track)}
        rough = _rough(states, steps, tracks, groups, one.config)
        estimate, _ = solve_sighting_log(steps, rough, tracks, groups, one.config, 1)
        return estimate, track.calibration

    robots = list(one.started)
    seen = Counter(sighting.robot for sighting in one.sources)
    efforts = [len(one.runs[robot].times) + seen[robot] for robot in robots]
    solved = dict(zip(robots, parallel_map(solve, robots, efforts=efforts), strict=True))
    for robot, (_, calibration) in solved.items():
        one.runs[robot].track.calibration = calibration
    estimates = [estimate for estimate, _ in solved.values()]
    return Estimate(
        {robot: estimate.states[robot] for robot, (estimate, _) in solved.items()},
        dict(chain.from_iterable(estimate.landmarks.items() for estimate in estimates)),
        sum(estimate.error for estimate in estimates),
        sum(estimate.dof for estimate in estimates),
    )


def steps_of_robot(steps: Sequence[Step], robot: str) -> tuple[Step, ...]:
    """What of the steps is about one robot and its landmarks."""
    own = []
    for step in steps:
        seen = tuple(a for a in step.associations if a.robot == robot)
        starts = {robot: step.starts[robot]} if robot in step.starts else {}
        motions = {robot: step.motions[robot]} if robot in step.motions else {}
        if starts or motions or seen:
            own.append(Step(step.time_ns, starts, motions, seen))
    return tuple(own)


def states_by_odometry(steps: Sequence[Step], robot: str, track: Track) -> Trajectory:
    """A robot's states by odometry alone, from its start, with unknown covariances."""
    begin = next(step for step in steps if robot in step.starts)
    ends = [step.motions[robot].end_ns for step in steps if robot in step.motions]
    times = np.array([begin.time_ns, *ends], dtype=np.int64)
    path = track.mounted_pose(times)
    poses = compose(begin.starts[robot].pose, between(path[0], path))
    return Trajectory(times, poses, np.full((len(times), 3, 3), np.nan))


def _moved(alone: RobotEstimate, states: Trajectory) -> Trajectory:
    """A robot's ``states`` as estimated by itself, from where they begin."""
    poses, _ = alone.at(states.stamps_ns)
    return replace(states, poses=compose(states.poses[0], between(poses[0], poses)))


def _with_landmarks(
    states: Mapping[str, Trajectory],
    steps: Sequence[Step],
    tracks: Mapping[str, Track],
    groups: Sequence[SightingGroup],
) -> tuple[Estimate, tuple[Step, ...]]:
    """States with landmarks where most sightings from there lie, and the steps computed there."""
    estimate = Estimate(states, {}, 0.0, 0)
    made = recompute_steps(steps, estimate, tracks, groups)
    seen = [a for step in made for a in step.associations if isinstance(a.target, int)]
    x = observed_from(seen, estimate.states)
    number = np.array([a.target for a in seen])
    landmarks: dict[int, tuple[Array, Array]] = {}
    for landmark in np.unique(number).tolist():
        own = np.flatnonzero(number == landmark)
        model, z = MODELS[seen[own[0]].model], np.array([seen[k].z for k in own])
        found = model.invert(z, x[own])
        # the first one's direction: there is no median of angles
        mean = np.append(np.median(found[:, :2], axis=0), found[0, 2:])
        landmarks[landmark] = (mean, np.full((len(mean),) * 2, np.nan))
    return Estimate(states, landmarks, 0.0, 0), made


def _rough(
    states: Mapping[str, Trajectory],
    steps: Sequence[Step],
    tracks: Mapping[str, Track],
    groups: Sequence[SightingGroup],
    config: Config,
) -> Estimate:
    """A rough estimate from initial ``states``."""
    start, made = _with_landmarks(states, steps, tracks, groups)
    return calibrate_roughly(made, start, tracks, _wide(config.robust), ROUNDS)
