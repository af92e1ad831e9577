"""A log of sightings without identities, solved again once it is associated.

While the log is read, a filter associates: a landmark that it does not recognise is in the map
twice. Solved as a whole, with the noise that the log shows, the states are accurate enough to tell
which landmarks are one, and which of them each sighting is of.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from graphslam.core.records import Estimate, Step
from graphslam.mapping.landmark_map import LandmarkMap, mean_landmarks
from graphslam.mapping.point_reassociation import PointSightings, is_point, reassociated, retargeted
from graphslam.pipeline.log_pass import LogPass
from graphslam.sighting_smoothing.false_points import find_false_points
from graphslam.sighting_smoothing.joint_landmarks import with_joint_landmarks
from graphslam.sighting_smoothing.matched_sessions import with_sessions_matched
from graphslam.sighting_smoothing.misplaced_landmarks import with_landmarks_placed_again
from graphslam.sighting_smoothing.sensor_calibration import solved_with_sensors
from graphslam.sighting_smoothing.sighting_noise import noise_of_pass
from graphslam.sighting_smoothing.state_at_every_sighting import FineSolution, SightingProblem
from graphslam.sighting_smoothing.state_per_step import SteppedProblem, sighting_problem

#: rounds of solving and associating again: the third moves one sighting in a hundred at most
MAX_ROUNDS = 3
#: share of the sightings that still move, below which another round is not worth it
SETTLED_SHARE = 1e-3
#: why sightings of `false_points` are not used
HARDLY_EVER_SEEN = "a point that images hardly ever show where they should"


def solve_unnamed(one: LogPass, estimate: Estimate) -> tuple[Estimate, tuple[Step, ...]]:
    """A log of associated sightings solved again, and the steps behind it.

    Args:
        one: the pass that associated them; its landmarks, states and calibrations follow.
        estimate: of its steps.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    config, landmarks = one.config, one.landmarks
    if not config.odometry.calibrate:
        return estimate, tuple(one.steps)
    before = len(estimate.landmarks)
    estimate = with_landmarks_placed_again(one.steps, estimate, config.robust)
    matched = with_sessions_matched(one, estimate, partial(_associated_apart, one))
    estimate = matched or estimate

    def solve(start: Estimate) -> FineSolution:
        noise = noise_of_pass(one, start)
        problem, start = sighting_problem(one, start, noise)
        steps = problem.steps
        if matched is None:  # else each session has been associated by itself
            points = _unnamed_points(landmarks, start)
            steps, start = _settled_associations(one, problem, steps, start, [points])
        targets = {a.source: a.target for step in steps for a in step.associations}
        false = _false_points(one, problem, steps, start)
        if false:
            steps = _without_points(steps, false)
            problem = problem.of_steps(steps)
            left = {i: found for i, found in start.landmarks.items() if i not in false}
            start = replace(start, landmarks=left)
        found = problem.finish(one, steps, start)
        one.steps = list(_without_points(retargeted(one.steps, targets), false))
        return found

    found = solved_with_sensors(one, estimate, solve)
    estimate, solved = with_joint_landmarks(found), found.steps
    gone = before - len(estimate.landmarks)
    one.counts["landmarks_merged"] += gone - one.counts["landmarks_removed"]
    landmarks.update_from(solved, estimate)
    _count_sightings(landmarks, solved, _unnamed_points(landmarks, estimate))
    return estimate, solved


def _unnamed_points(landmarks: LandmarkMap, estimate: Estimate) -> set[int]:
    """Landmarks of an estimate that sightings may be associated with again."""
    entries = {i: landmarks.entries[i] for i in estimate.landmarks}
    return {i for i, one in entries.items() if one.identity is None and one.kind == "point"}


def _associated_apart(
    one: LogPass,
    problem: SightingProblem | SteppedProblem,
    steps: tuple[Step, ...],
    estimate: Estimate,
    sessions: Sequence[set[int]],
) -> tuple[tuple[Step, ...], Estimate]:
    """`_settled_associations` with the points that each session sees."""
    unnamed = _unnamed_points(one.landmarks, estimate)
    groups = [points & unnamed for points in sessions]
    return _settled_associations(one, problem, steps, estimate, groups)


def _settled_associations(
    one: LogPass,
    problem: SightingProblem | SteppedProblem,
    steps: tuple[Step, ...],
    estimate: Estimate,
    groups: Sequence[Collection[int]],
) -> tuple[tuple[Step, ...], Estimate]:
    """Steps with every sighting at the point of its group that it fits, and their estimate."""
    if not any(groups):
        return steps, estimate
    for _ in range(MAX_ROUNDS):
        estimate, _ = problem.solve(steps, estimate, rough=True)
        moved = count = 0
        for points in groups:
            steps, estimate, again, of = _associated_again(problem, steps, estimate, points)
            moved, count = moved + again, count + of
        one.counts["observations_reassociated"] += moved
        if moved <= SETTLED_SHARE * count:
            break
    return steps, estimate


def _associated_again(
    problem: SightingProblem | SteppedProblem,
    steps: tuple[Step, ...],
    estimate: Estimate,
    points: Collection[int],
) -> tuple[tuple[Step, ...], Estimate, int, int]:
    """Steps with every sighting of ``points`` at the one that it fits best; their estimate.

    Also how many sightings have moved, and of how many.
    """
    fine, there = problem.at_sightings(steps, estimate)
    points = {*points} & estimate.landmarks.keys()
    seen = PointSightings.of(fine, there, points)
    if not len(seen.target):
        return steps, estimate, 0, 0
    found = reassociated(seen, {i: estimate.landmarks[i][0] for i in points})
    sources = [a.source for step in fine for a in step.associations if is_point(a, points)]
    targets = dict(zip(sources, found.tolist(), strict=True))
    steps = retargeted(steps, targets)
    placed = mean_landmarks(retargeted(fine, targets), there.states)
    kept = {i: placed.get(i, found) for i, found in estimate.landmarks.items()}
    kept = {i: found for i, found in kept.items() if i in placed or i not in points}
    moved = int(np.count_nonzero(found != seen.target))
    return steps, replace(estimate, landmarks=kept), moved, len(found)


def _false_points(
    one: LogPass,
    problem: SightingProblem | SteppedProblem,
    steps: tuple[Step, ...],
    estimate: Estimate,
) -> set[int]:
    """Points of an estimate that images hardly ever show; their sightings are counted."""
    points = _unnamed_points(one.landmarks, estimate)
    if not points:
        return set()
    false = find_false_points(*problem.at_sightings(steps, estimate), points)
    if false:
        of_these = [a for step in steps for a in step.associations if is_point(a, false)]
        one.rejected[HARDLY_EVER_SEEN] += len(of_these)
        one.counts["landmarks_removed"] += len(false)
    return false


def _without_points(steps: Sequence[Step], points: Collection[int]) -> tuple[Step, ...]:
    """Steps without the sightings of some points."""
    return tuple(
        replace(step, associations=tuple(a for a in step.associations if not is_point(a, points)))
        for step in steps
    )


def _count_sightings(
    landmarks: LandmarkMap, steps: Sequence[Step], points: Collection[int]
) -> None:
    """Set how often and when ``points`` of the map were seen."""
    times: dict[int, list[int]] = {}
    for step in steps:
        for a in step.associations:
            if is_point(a, points):
                times.setdefault(int(a.target), []).append(a.time_ns)
    for number, seen in times.items():
        entry = landmarks.entries[number]
        entry.sightings, entry.first_ns, entry.last_ns = len(seen), min(seen), max(seen)
