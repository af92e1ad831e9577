"""A log of sightings without identities, solved again once it is associated.

While the log is read, a filter associates: a landmark that it does not recognise is in the map
twice. Solved as a whole, with a state at every sighting and the noise that the log shows, the map
is accurate enough to tell which landmarks are one, and which of them each sighting is of.
"""

from dataclasses import replace

from graphslam.core.records import Estimate, Step
from graphslam.estimation.calibration_graph import solve_calibrated
from graphslam.mapping.duplicate_landmarks import merged
from graphslam.mapping.point_reassociation import indistinguishable_points, reassociate_points
from graphslam.slam.log_pass import LogPass
from graphslam.slam.reoptimise_sightings import group_sightings, solve_sighting_log
from graphslam.slam.sighting_noise import estimate_noise, with_noise
from graphslam.slam.sighting_solution import solve_at_sightings
from graphslam.slam.sighting_states import (
    at_states,
    state_times,
    steps_at_sightings,
    with_motions,
)

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
    one.kernel = noise.kernel(config.robust)
    for name, track in tracks.items():
        track.config = noise.odometry.get(name, track.config)
    begun_ns = {name: step.time_ns for step in one.steps for name in step.starts}
    late_ns = {name: t.reported_late_ns(t.calibration) for name, t in tracks.items()}
    plain = steps_at_sightings(one.steps, one.sources, late_ns, one.dropped)
    estimate = at_states(estimate, plain, tracks)
    steps = with_noise(plain, noise)
    priors = {name: track.prior for name, track in tracks.items()}
    sightings = sum(len(step.associations) for step in steps)
    unnamed = any(entry.identity is None for entry in landmarks.entries.values())
    for _ in range(MAX_ROUNDS if unnamed else 0):
        initial = {name: track.calibration for name, track in tracks.items()}
        for track in tracks.values():
            track.calibration = track.calibration.held()
        made = with_motions(steps, tracks, estimate, begun_ns)
        solution = solve_calibrated(made, estimate, priors, initial, one.kernel, rough=True)
        estimate = solution.estimate
        for name, track in tracks.items():
            track.calibration = solution.calibrations[name]
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
    one.counts["keyframes"] = sum(map(len, state_times(steps).values()))
    estimate, steps = solve_at_sightings(steps, estimate, tracks, noise, config, begun_ns)
    landmarks.update_from(steps, estimate)
    for name, times in state_times(steps).items():
        one.runs[name].times = times.tolist()
    return estimate, steps
