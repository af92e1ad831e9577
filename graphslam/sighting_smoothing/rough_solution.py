"""The rough solution of named sightings, from states by odometry.

Odometry drifts by metres. A kernel wide enough not to reject what the drift puts far off leads to
the neighbourhood of the solution (graduated optimisation, e.g. H. Yang et al., Graduated
non-convexity for robust spatial perception, RA-L 2020, DOI 10.1109/LRA.2020.2965893). Where the
drift is too large for that, the solution grows from the beginning of the log.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.config import Config, RobustConfig
from graphslam.core.geometry import Array, between, compose
from graphslam.core.records import Estimate, Step, Trajectory
from graphslam.estimation.batch_calibration import calibrate_roughly
from graphslam.mapping.landmark_map import observed_from
from graphslam.odometry.preintegration import Track
from graphslam.sighting_smoothing.misplaced_landmarks import (
    seen_at,
    with_landmarks_placed_again,
)
from graphslam.sighting_smoothing.reoptimise_sightings import SightingGroup, recompute_steps

#: how much wider the kernel is in the beginning
WIDE = 10.0
#: rounds of the rough solution, after which the latency of odometry no longer changes much
ROUNDS = 3
#: steps of the first of the beginnings that an estimate grows from, and beginnings at most
FIRST_STEPS, MOST_BEGINNINGS = 100, 20
#: a beginning fits that is so many times as far from what is stated as the first one, at most
WORSE = 1.5
#: number of a landmark -> mean and covariance
Landmarks = Mapping[int, tuple[Array, Array]]


@dataclass(frozen=True, slots=True, eq=False)
class RoughProblem:
    """Steps as recorded, odometry of the robots in them, and the sightings behind them."""

    steps: Sequence[Step]
    tracks: Mapping[str, Track]
    groups: Sequence[SightingGroup]
    config: Config

    def beginning(self, length: int) -> "RoughProblem":
        """That of the first steps."""
        steps = self.steps[:length]
        tracks = {name: self.tracks[name] for step in steps for name in step.starts}
        groups = [group.of_steps(range(length)) for group in self.groups]
        return RoughProblem(steps, tracks, [g for g in groups if len(g.where)], self.config)


def solve_rough_problem(problem: RoughProblem) -> Estimate:
    """A rough estimate; it sets the calibration of the tracks.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    states = {n: states_by_odometry(problem.steps, n, t) for n, t in problem.tracks.items()}
    estimate = _solved(problem, states, {})
    return _better_grown(problem, estimate) if is_misfit(estimate) else estimate


def is_misfit(rough: Estimate) -> bool:
    """Whether residuals are twice as large as stated."""
    return rough.error > rough.dof


def _better_grown(problem: RoughProblem, estimate: Estimate) -> Estimate:
    """A rough estimate of ever longer beginnings of a log, unless ``estimate`` fits better.

    Where odometry drifts by more than the kernel is wide, what is seen later is not where its
    landmark is. So each beginning starts from the one before it, half as long, whose landmarks are
    known; where it does not fit about as well, it gets shorter. Noise may be more than stated, so
    the first one tells how well that is; if it is hardly better than the whole, as where names are
    wrong, that is not for drift. In all it takes some times as long as one solution,
    `MOST_BEGINNINGS` times at most.
    """
    before = {name: track.calibration for name, track in problem.tracks.items()}
    for track in problem.tracks.values():
        track.calibration = track.prior
    count = len(problem.steps)
    more = min(FIRST_STEPS, count)
    found, length = _longer(problem.beginning(more), Estimate({}, {}, 0.0, 0)), more
    fits = max(1.0, WORSE * _misfit(found))
    for _ in range(MOST_BEGINNINGS):
        if length == count or WORSE * _misfit(found) > _misfit(estimate):
            break
        more = min(more, count - length)
        longer = _longer(problem.beginning(length + more), found)
        if _misfit(longer) <= fits or more <= FIRST_STEPS:
            found, length = longer, length + more
            more = length
        else:
            more //= 2
    if length == count and found.error < estimate.error:
        return found
    for name, track in problem.tracks.items():
        track.calibration = before[name]
    return estimate


def _misfit(estimate: Estimate) -> float:
    """The squared residuals, half of their sum, for each that is not needed."""
    return estimate.error / max(estimate.dof, 1)


def _longer(problem: RoughProblem, known: Estimate) -> Estimate:
    """A rough estimate from that of the beginning of its steps, whose landmarks are known.

    It sets the calibration of the tracks.
    """
    states = {}
    for name, track in problem.tracks.items():
        track.calibration = replace(track.prior, mean=track.calibration.mean)
        by_odometry = states_by_odometry(problem.steps, name, track)
        states[name] = _continued(known.states.get(name), by_odometry)
    return _solved(problem, states, known.landmarks)


def _continued(known: Trajectory | None, by_odometry: Trajectory) -> Trajectory:
    """States that are ``known`` to some time, and from there by odometry."""
    if known is None:
        return by_odometry
    poses, n = by_odometry.poses, len(known.poses)
    after = compose(known.poses[-1], between(poses[n - 1], poses[n:]))
    return replace(by_odometry, poses=np.concatenate([known.poses, after]))


def states_by_odometry(steps: Sequence[Step], robot: str, track: Track) -> Trajectory:
    """A robot's states by odometry alone, from its start, with unknown covariances."""
    begin = next(step for step in steps if robot in step.starts)
    ends = [step.motions[robot].end_ns for step in steps if robot in step.motions]
    times = np.array([begin.time_ns, *ends], dtype=np.int64)
    path = track.mounted_pose(times)
    poses = compose(begin.starts[robot].pose, between(path[0], path))
    return Trajectory(times, poses, np.full((len(times), 3, 3), np.nan))


def with_landmarks(
    problem: RoughProblem, states: Mapping[str, Trajectory], known: Landmarks
) -> tuple[Estimate, tuple[Step, ...]]:
    """States with landmarks where most sightings from there lie, and the steps computed there.

    ``known``: landmarks that are where they are.
    """
    estimate = Estimate(states, {}, 0.0, 0)
    made = recompute_steps(problem.steps, estimate, problem.tracks, problem.groups)
    seen = [a for step in made for a in step.associations if isinstance(a.target, int)]
    x = observed_from(seen, estimate.states)
    number = np.array([a.target for a in seen])
    landmarks = {**_of_map(problem.steps), **known}
    for landmark in sorted(set(number.tolist()) - landmarks.keys()):
        own = np.flatnonzero(number == landmark)
        mean = seen_at([seen[k] for k in own], x[own])
        landmarks[landmark] = (mean, np.full((len(mean),) * 2, np.nan))
    return Estimate(states, landmarks, 0.0, 0), made


def _of_map(steps: Sequence[Step]) -> Landmarks:
    """Landmarks of a known map, where it has them."""
    before = steps[0].known if steps else None
    means = {} if before is None else before.means
    return {n: (mean, np.full((len(mean),) * 2, np.nan)) for n, mean in means.items()}


def _solved(problem: RoughProblem, states: Mapping[str, Trajectory], known: Landmarks) -> Estimate:
    """A rough estimate from initial ``states``, and landmarks where they are ``known``."""
    start, made = with_landmarks(problem, states, known)
    kernel = widened_kernel(problem.config.robust)
    estimate = calibrate_roughly(made, start, problem.tracks, kernel, ROUNDS)
    return with_landmarks_placed_again(made, estimate, kernel)


def widened_kernel(kernel: RobustConfig) -> RobustConfig:
    """The kernel of the rough solution."""
    return replace(kernel, scale=WIDE * kernel.scale)
