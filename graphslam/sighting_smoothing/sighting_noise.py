"""How noisy the sightings and the odometry of a log are, by a stretch of the log itself.

A part of the log is solved with a state wherever something was seen, its noise is measured from
the residuals, and it is solved again until the noise no longer changes. Two things are told apart:
noise that is new in every sighting, and errors that sightings of one target share for seconds.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.config import Config
from graphslam.core.geometry import Array
from graphslam.core.record import replace
from graphslam.core.records import Association, Estimate, Sighting, Start, Step
from graphslam.estimation.calibration_graph import CalibrationGraph
from graphslam.estimation.log_noise import MOTION, LogNoise, has_state_at_every_sighting, is_white
from graphslam.estimation.motion_noise import (
    BEGIN_SIGMA,
    NoiseFit,
    fit_odometry_noise,
    measured_motion_noise,
    stated_robots,
)
from graphslam.estimation.posterior_residuals import Posterior
from graphslam.estimation.recorded_graph import ObservationNoise, Source
from graphslam.estimation.residual_distribution import fit_distribution, shared_variance
from graphslam.odometry.noise_estimation import with_fit_uncertainty, without_floors
from graphslam.odometry.preintegration import Track
from graphslam.pipeline.log_pass import LogPass
from graphslam.sighting_smoothing.sensor_latency import hold_insignificant_latency
from graphslam.sighting_smoothing.sighting_states import (
    at_states,
    state_times,
    steps_at_sightings,
    with_motions,
)
from graphslam.sighting_smoothing.unstated_noise import (
    MIN_MEASUREMENTS,
    MIN_VARIANCE,
    likelier_ranges,
    sigmas_of,
    unstated_sources,
    with_range_noise,
)

#: sightings in the stretch, about
MAX_SIGHTINGS = 5000
#: m or rad: a robot moves if it has driven or turned by so much since the image before. Where more
#: than this share are of standing robots, these are left out, if so many others are left
MOVED, MOST_STANDING, FEWEST_MOVING = 1e-3, 0.5, 300
#: rounds at most; the noise has converged when no variance changes by a larger share
MAX_ROUNDS, CONVERGED_SHARE = 8, 0.1
#: where odometry is taken for less noisy than it is, errors seem to be shared: this is looked at
#: again if its variance changes by a larger share
UNSETTLED_SHARE = 1.0
#: relative decrease of the error at which optimisation ends: variances are known to some per cent
CONVERGED_ERROR = 5e-4
#: rad: a bearing that is stated to be less certain was not measured
UNKNOWN_BEARING_RAD = 1.0


def estimate_noise(
    steps: Sequence[Step],
    sources: Sequence[Sighting],
    estimate: Estimate,
    tracks: Mapping[str, Track],
    config: Config,
    rounds: int = MAX_ROUNDS,
) -> LogNoise:
    """The noise of a log of sightings.

    Args:
        steps: of the log.
        sources: `Association.source` is an index into them.
        estimate: of the states and landmarks of ``steps``.
        tracks: odometry of every robot; they get the calibration that is found on the way.
        config: settings.
        rounds: at most. Errors that are shared show in the first, which is the last then, unless
            the odometry is much noisier than it was taken for. Where noise is not stated, one more
            round before these finds its size.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    chosen = _chosen(steps, sources, tracks)
    sample = steps_at_sightings(chosen, sources, {}, Counter())
    tracks = {name: tracks[name] for name in state_times(sample)}
    estimate = at_states(estimate, sample, tracks)
    before = {name: track.config for name, track in tracks.items()}
    seen = {(a.robot, a.model) for step in sample for a in step.associations}
    # of the whole log: a source that states its noise elsewhere is one that does
    unstated = {k: own for k, own in unstated_sources(steps, sources).items() if k in seen}
    try:
        noise, last = _estimated(sample, estimate, tracks, config, rounds, unstated)
        sigmas = {
            source: sigmas_of(numbers, sources, noise.measured[source])
            for source, numbers in unstated.items()
        }
        noise = replace(noise, unstated=sigmas, ranges=likelier_ranges(last, sources, unstated))
        if len(chosen) > len(steps):  # with the starts apart
            noise = replace(noise, of_whole_log=True)
        if noise.of_whole_log or not has_state_at_every_sighting(noise.sightings):
            for track in tracks.values():  # else a solution of the whole log decides
                hold_insignificant_latency(track)
        return noise
    finally:
        for name, track in tracks.items():
            track.config = before[name]


def noise_of_pass(one: LogPass, estimate: Estimate) -> LogNoise:
    """`estimate_noise` of a pass; where none is stated, its sightings get what is likelier.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    tracks = {name: run.track for name, run in one.started.items()}
    noise = estimate_noise(one.steps, one.sources, estimate, tracks, one.config)
    if noise.ranges:
        unstated = unstated_sources(one.steps, one.sources)
        one.sources = with_range_noise(one.sources, unstated, noise.ranges)
        noise = estimate_noise(one.steps, one.sources, estimate, tracks, one.config)
    one.noise = noise.to_summary()
    return noise


def _chosen(
    steps: Sequence[Step], sources: Sequence[Sighting], tracks: Mapping[str, Track]
) -> tuple[Step, ...]:
    """The `stretch` by which noise is measured: where robots move, if elsewhere they mostly stand.

    A robot that stands sees the same again and again, and what its detector rounds or repeats looks
    like no noise at all.
    """
    chosen, still = stretch(steps), _seen_standing(steps, sources, tracks)
    of_chosen, of_all = still[_numbers(chosen)], still[_numbers(steps)]
    if of_chosen.sum() <= MOST_STANDING * len(of_chosen) or (~of_all).sum() < FEWEST_MOVING:
        return chosen

    def moving(a: Association) -> bool:
        return a.source is None or not still[a.source]

    return stretch([replace(s, associations=tuple(filter(moving, s.associations))) for s in steps])


def _seen_standing(
    steps: Sequence[Step], sources: Sequence[Sighting], tracks: Mapping[str, Track]
) -> BoolArray:
    """Which of all sightings (n,) are of a robot that has not moved since its image before."""
    still, numbers = np.zeros(len(sources), dtype=np.bool_), _numbers(steps)
    times = np.array([sources[k].time_ns for k in numbers.tolist()], dtype=np.int64)
    robots = np.array([sources[k].robot for k in numbers.tolist()])
    for robot, track in tracks.items():
        own = np.flatnonzero(robots == robot)
        if not len(own):
            continue
        images, image = np.unique(times[own], return_inverse=True)
        way = np.abs(np.diff(track.driven(images), axis=0)).sum(axis=1).cumsum() // MOVED
        stood = np.append(False, np.diff(way, prepend=0.0) == 0.0)
        still[numbers[own]] = stood[image]
    return still


def _numbers(steps: Sequence[Step]) -> IntArray:
    """Of the sightings in steps (k,)."""
    own = [a.source for step in steps for a in step.associations if a.source is not None]
    return np.array(own, dtype=np.int64)


def stretch(steps: Sequence[Step]) -> tuple[Step, ...]:
    """Steps in the middle of a log with about so many sightings, starts of robots before them."""
    seen = np.cumsum([len(step.associations) for step in steps])
    spare = max(0, int(seen[-1]) - MAX_SIGHTINGS)
    first, last = np.searchsorted(seen, [spare // 2, spare // 2 + MAX_SIGHTINGS]).tolist()
    chosen = steps[first : last + 1]
    starts = {robot: start for step in steps[: last + 1] for robot, start in step.starts.items()}
    begin_ns = min((chosen[0].time_ns, *(s.time_ns for s in chosen if s.associations)))
    rest = tuple(Step(s.time_ns, {}, s.motions, s.associations) for s in chosen)
    return (Step(begin_ns, starts), *rest)


def _beginning_at(steps: Sequence[Step], estimate: Estimate) -> tuple[Step, ...]:
    """Steps whose robots start at the estimate."""
    cov = np.diag([BEGIN_SIGMA**2] * 3)

    def begun(robot: str, time_ns: int) -> Start:
        return Start(estimate.states[robot].at(time_ns), cov)

    return tuple(
        replace(step, starts={robot: begun(robot, step.time_ns) for robot in step.starts})
        for step in steps
    )


def _estimated(
    steps: Sequence[Step],
    estimate: Estimate,
    tracks: Mapping[str, Track],
    config: Config,
    rounds: int,
    unstated: Collection[Source],
) -> tuple[LogNoise, Posterior]:
    """`estimate_noise` of all ``steps``, and their last solution; changes the tracks."""
    priors = {name: track.prior for name, track in tracks.items()}
    one = np.ones(2)
    sources = {(a.robot, a.model) for s in steps for a in s.associations if len(a.z) == 2}
    noise = {source: ObservationNoise(one, one, config.robust.scale) for source in sources}
    stated = stated_robots(tracks)
    for name in stated:
        tracks[name].config = without_floors(tracks[name].config)
    measured: dict[Source, Array] = {}
    fits: dict[str, NoiseFit] = {}
    # noise that is not stated may be of any size: before that is known, errors that are larger than
    # it began with seem to be shared
    for k in range(-1 if unstated else 0, rounds):
        initial = {name: track.calibration for name, track in tracks.items()}
        for track in tracks.values():
            track.calibration = track.calibration.held()
        made = with_motions(_beginning_at(steps, estimate), tracks, estimate)
        graph = CalibrationGraph(
            made, estimate, priors, initial, config.robust, noise, calibrated=True
        )
        estimate, calibrations = graph.solve(CONVERGED_ERROR)
        posterior = graph.posterior(stated)
        new = _sighting_noise(posterior, noise)
        change = _largest_change(noise, new)
        noise = new if k >= 0 else new | _begun_again(new, unstated)
        covs = graph.calibration_covariances(posterior)
        for name, track in tracks.items():
            track.calibration = replace(calibrations[name], cov=covs[name])
            if name in stated:
                factors = measured_motion_noise(track, name, posterior)
                if factors is not None:
                    measured[name, MOTION] = factors
        open_ones = {name: track for name, track in tracks.items() if name not in stated}
        fits = fit_odometry_noise(open_ones, posterior, relax=is_white(noise))
        for track in open_ones.values():
            track.config = without_floors(track.config)
        odometry_change = max((fit.change for fit in fits.values()), default=0.0)
        if k < 0:
            continue
        if max(change, odometry_change) < CONVERGED_SHARE:
            break
        if not is_white(noise) and odometry_change < UNSETTLED_SHARE:
            break
    for name, fit in fits.items():
        tracks[name].config = with_fit_uncertainty(tracks[name].config, fit.log_sigma)
    for source, found in noise.items():
        measured[source] = found.white + found.shared
    final = {
        source: _own_kernel(found, config) if source in unstated else _cautious(found, config)
        for source, found in noise.items()
    }
    odometry = {name: track.config for name, track in tracks.items()}
    return LogNoise(final, odometry, measured), posterior


def _begun_again(
    noise: Mapping[Source, ObservationNoise], sources: Collection[Source]
) -> dict[Source, ObservationNoise]:
    """Noise of the size found, of which it is open again whether errors are shared."""
    own = {source: noise[source] for source in sources if source in noise}
    return {s: ObservationNoise(n.white, n.white, n.kernel_scale) for s, n in own.items()}


def _sighting_noise(
    posterior: Posterior, noise: Mapping[Source, ObservationNoise]
) -> dict[Source, ObservationNoise]:
    """The noise of each source by its residuals.

    A robot's sightings of robots are taken as noisy as those of landmarks, if it has these: the
    robots' paths can take up more of their errors.
    """
    new = {}
    for source, before in noise.items():
        robot, model = source
        if model != "point" and (robot, "point") in noise:
            continue
        residuals = posterior.sightings(source)
        if len(residuals.residual) < MIN_MEASUREMENTS:
            new[source] = ObservationNoise(np.ones(2), np.zeros(2), before.kernel_scale)
            continue
        found, shared = fit_distribution(residuals.normalised), posterior.shared(source)
        part = np.zeros(2) if shared is None else shared_variance(shared) * before.shared
        least = np.where(_is_measured(posterior, source), MIN_VARIANCE, 1.0)
        white = np.maximum(found.variance * before.white, least)
        new[source] = ObservationNoise(white, part, found.kernel_scale)
    for source in noise.keys() - new.keys():
        new[source] = new[source[0], "point"]
    return new


def _is_measured(posterior: Posterior, source: Source) -> Array:
    """Whether the bearings and the ranges (2,) of a source are stated to be measured at all.

    A sigma as large as the ranges themselves, or of a radian, says that they are not: a camera that
    sees bearings alone writes some constant as range. Its residuals are far below such a sigma, as
    the constant has about the right size, and tell nothing of a measurement.
    """
    z, cov = posterior.builder.polar[source]
    sigmas = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    return np.asarray(np.median(sigmas, axis=0) < [UNKNOWN_BEARING_RAD, np.median(z[:, 1])])


def _own_kernel(found: ObservationNoise, config: Config) -> ObservationNoise:
    """Noise as it was found; the width of a kernel is known where it is white."""
    return replace(found, kernel_scale=config.robust.scale) if found.shared.any() else found


def _cautious(found: ObservationNoise, config: Config) -> ObservationNoise:
    """Noise that is not less than what is stated.

    Of slow errors the robots' paths take up a part: where there are any, what is stated and does
    not show in the residuals is taken for slow. Where bearings or ranges show none, it is open
    whether they have such an error or have less noise than stated, and half of it is.
    """
    if not found.shared.any():
        return replace(found, white=np.maximum(found.white, 1.0))
    hidden = np.where(found.shared > 0.0, 1.0, 0.5) * (1.0 - found.white)
    return ObservationNoise(found.white, np.maximum(found.shared, hidden), config.robust.scale)


def _largest_change(
    before: Mapping[Source, ObservationNoise], after: Mapping[Source, ObservationNoise]
) -> float:
    """Largest share by which a white variance has changed."""
    return max(
        (float(np.abs(after[s].white / before[s].white - 1.0).max()) for s in after), default=0.0
    )
