"""A log of sightings without identities, solved again once it is associated.

While the log is read, a filter associates: a landmark that it does not recognise is in the map
twice. Solved as a whole, with a state at every sighting and the noise that the log shows, the map
is accurate enough to tell which landmarks are one, and which of them each sighting is of.
"""

from dataclasses import replace

from graphslam.core.records import Estimate, Step
from graphslam.mapping.duplicate_landmarks import merged
from graphslam.mapping.point_reassociation import indistinguishable_points, reassociate_points
from graphslam.slam.log_pass import LogPass
from graphslam.slam.reoptimise_sightings import group_sightings, solve_sighting_log
from graphslam.slam.sighting_noise import estimate_noise
from graphslam.slam.state_at_every_sighting import state_at_every_sighting

#: rounds of merging landmarks and associating again: a third moves one sighting in a thousand
MAX_ROUNDS = 2
#: share of the sightings that still move, below which another round is not worth it
SETTLED_SHARE = 1e-3


def solve_unnamed(one: LogPass, estimate: Estimate) -> tuple[Estimate, tuple[Step, ...]]:
    """A log of associated sightings solved again, and the steps behind it.

    Args:
        one: the pass that associated them; its landmarks, states and calibrations follow.
        estimate: of its steps.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    config, landmarks = one.config, one.landmarks
    tracks = {name: run.track for name, run in one.started.items()}
    if not config.odometry.calibrate:
        return estimate, tuple(one.steps)
    noise = estimate_noise(one.steps, one.sources, estimate, tracks, config)
    one.noise = noise.to_summary()
    if not noise.is_white:
        groups = group_sightings(one.steps, one.sources)
        return solve_sighting_log(one.steps, estimate, tracks, groups, config, noise=noise)
    problem, estimate = state_at_every_sighting(one, estimate, noise)
    steps = problem.steps
    sightings = sum(len(step.associations) for step in steps)
    unnamed = any(entry.identity is None for entry in landmarks.entries.values())
    for _ in range(MAX_ROUNDS if unnamed else 0):
        estimate, _ = problem.solve(steps, estimate, rough=True)
        landmarks.update_from(steps, estimate)
        points = {
            i: found
            for i, found in estimate.landmarks.items()
            if landmarks.entries[i].identity is None
        }
        into = indistinguishable_points(steps, replace(estimate, landmarks=points))
        steps = merged(steps, into, landmarks)
        left = {i: found for i, found in points.items() if i not in into}
        steps, moved = reassociate_points(steps, replace(estimate, landmarks=left))
        one.counts["landmarks_merged"] += len(into)
        one.counts["observations_reassociated"] += moved
        if not into and moved <= SETTLED_SHARE * sightings:
            break
    estimate, solved = problem.finish(one, steps, estimate)
    landmarks.update_from(solved, estimate)
    return estimate, solved
