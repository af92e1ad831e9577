"""The solution of a `SightingPass`: all its robots together, or every robot by itself.

From the neighbourhood of the solution (`rough_solution`) on the kernel is the configured one.
Motions are with the uncertainty of their calibration until then.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain

from graphslam.core.geometry import between, compose
from graphslam.core.motion_models import Calibration
from graphslam.core.records import Estimate, Step, Trajectory
from graphslam.core.worker import parallel_map
from graphslam.estimation.batch_calibration import calibrate, calibrate_roughly
from graphslam.mapping.robot_candidates import NOT_THERE
from graphslam.mapping.robot_gating import RobotOffers
from graphslam.multi_robot.relative_frames import RobotEstimate
from graphslam.odometry.preintegration import Track
from graphslam.sighting_smoothing.joint_landmarks import with_joint_landmarks
from graphslam.sighting_smoothing.matched_sessions import with_sessions_matched
from graphslam.sighting_smoothing.reoptimise_sightings import (
    group_sightings,
    recompute_steps,
    solve_sighting_log,
)
from graphslam.sighting_smoothing.rough_solution import (
    RoughProblem,
    solve_rough_problem,
    states_by_odometry,
    widened_kernel,
    with_landmarks,
)
from graphslam.sighting_smoothing.sensor_calibration import solved_with_sensors
from graphslam.sighting_smoothing.sighting_noise import noise_of_pass
from graphslam.sighting_smoothing.sighting_pass import SightingPass
from graphslam.sighting_smoothing.state_at_every_sighting import FineSolution
from graphslam.sighting_smoothing.state_per_step import sighting_problem

#: rounds of deciding which sightings of robots are used, and share of them that may still change:
#: the solution that follows is hardly moved by it
GATING_ROUNDS, FEW = 3, 0.01


def solve_roughly(one: SightingPass) -> tuple[Estimate, tuple[Step, ...]]:
    """An estimate near that of all robots together, and the steps behind it.

    It sets the calibration of their tracks.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    problem = _rough_problem(one)
    if set(one.tracks) <= set(one.known.alone):  # what calibrations need is known: once is enough
        states = _initial_states(one)
        with _held(one.tracks):
            start, made = with_landmarks(problem, states, {})
        kernel = widened_kernel(one.config.robust)
        return calibrate(lambda *_: made, start, one.tracks, kernel, 1, rough=True)
    for track in one.tracks.values():
        track.calibration = track.prior
    estimate = solve_rough_problem(problem)
    with _held(one.tracks):
        return estimate, recompute_steps(one.steps, estimate, one.tracks, one.groups)


def _rough_problem(one: SightingPass) -> RoughProblem:
    return RoughProblem(one.steps, one.tracks, one.groups, one.config)


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
    start, made = with_landmarks(_rough_problem(one), states, {})
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
    rough = with_sessions_matched(one, rough) or rough
    one.keep_steps(one.steps)

    def solve(start: Estimate) -> FineSolution:
        noise = noise_of_pass(one, start)
        problem, start = sighting_problem(one, start, noise)
        return problem.finish(one, problem.steps, start)

    found = solved_with_sensors(one, rough, solve)
    return with_joint_landmarks(found), found.steps


def with_gated_robots(one: SightingPass, rough: Estimate, made: tuple[Step, ...]) -> Estimate:
    """An estimate without sightings of robots that contradict all else; their steps lose them.

    Args:
        one: the pass.
        rough: the estimate with them.
        made: the steps behind it.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    recorded, groups, kernel = one.steps, one.groups, widened_kernel(one.config.robust)
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
        rough = solve_rough_problem(RoughProblem(steps, tracks, groups, one.config))
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


def _moved(alone: RobotEstimate, states: Trajectory) -> Trajectory:
    """A robot's ``states`` as estimated by itself, from where they begin."""
    poses, _ = alone.at(states.stamps_ns)
    return replace(states, poses=compose(states.poses[0], between(poses[0], poses)))
