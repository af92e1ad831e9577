"""How noisy the motions of a log are, as its estimate shows them.

The same for logs of scans and logs of sightings. While an estimate is rough: the median of
normalised residuals, axis by axis. A few motions that are wrong (slip, jumps) do not move it; they
are left to the solution. With the covariances of a solution: the settings of the odometry's noise
themselves, each residual divided by what the solution leaves of its variance.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, between, wrap
from graphslam.core.motion_models import Increments
from graphslam.core.record import replace
from graphslam.core.records import Estimate, Motion, Start, Step, Trajectory
from graphslam.estimation.log_noise import MOTION, LogNoise
from graphslam.estimation.posterior_residuals import Posterior, spans
from graphslam.odometry.increment_sums import IncrementSums
from graphslam.odometry.integration_windows import Asked
from graphslam.odometry.noise_estimation import (
    fit_noise,
    is_stated,
    motion_variances,
    variance_sigma,
    variances_by_rate,
    with_fit_uncertainty,
    without_noise,
)
from graphslam.odometry.preintegration import Track

#: motions of a robot from which their noise is estimated at least
MIN_MOTIONS = 50
#: and with a prior (`fit_noise`): fewer hardly tell more than it
FEW_MOTIONS = 8
#: m, rad: sigmas of the pose at which a robot's part of a log begins
BEGIN_SIGMA = 0.01
#: m, rad: least sigma of a motion, in any direction
MIN_SIGMA = 1e-4
#: factor on stated sigmas from which a log contradicts them
UNDERSTATED = 2.0
#: median of the absolute value of a standard normal variable
MEDIAN_OF_NORMAL = 0.6745
#: of the sigma of a variance: smaller changes of it do not matter
NEGLIGIBLE = 0.5


def noise_scales(
    steps: Sequence[Step], estimate: Estimate, window_ns: int | None = None
) -> dict[str, Array]:
    """Robot -> factor (3,) on the sigmas of its motions; 1 where they are as noisy as stated.

    Stated noise is never reduced. Robots with fewer than `MIN_MOTIONS` motions have none.

    Args:
        steps: with motions as computed.
        estimate: of all their states.
        window_ns: residuals within such a window are added up, which shows correlated errors too;
            None judges each motion by itself.
    """
    scales = {}
    for robot, states in estimate.states.items():
        motions = [step.motions[robot] for step in steps if robot in step.motions]
        if len(motions) < MIN_MOTIONS:
            continue
        first, last = (
            states.at([getattr(m, name) for m in motions]) for name in ("start_ns", "end_ns")
        )
        residuals = between(first, last) - np.array([m.delta for m in motions])
        residuals[:, 2] = wrap(residuals[:, 2])
        normalised = residuals / np.sqrt([np.diag(m.cov) for m in motions])
        if window_ns is not None:
            moving = np.array([m.length_m != 0 or m.delta[2] != 0 for m in motions])
            if not moving.any():
                continue
            windows = np.array([m.end_ns // window_ns for m in motions])[moving]
            _, index, count = np.unique(windows, return_inverse=True, return_counts=True)
            sums = np.zeros((len(count), 3))
            np.add.at(sums, index, normalised[moving])
            normalised = sums / np.sqrt(count)[:, None]
        scales[robot] = np.maximum(1.0, np.median(np.abs(normalised), axis=0) / MEDIAN_OF_NORMAL)
    return scales


def understated_noise(steps: Sequence[Step], estimate: Estimate) -> list[str]:
    """Warnings about robots whose motions are noisier than stated; see `noise_scales`."""
    scales = noise_scales(steps, estimate)
    names = ("along", "across", "in heading")
    return [
        f"{robot}: its odometry is {scale.max():.1f} times as noisy {names[int(scale.argmax())]} "
        "as the log states; what is stated was used"
        for robot, scale in sorted(scales.items())
        if scale.max() > UNDERSTATED
    ]


def scale_motion_noise(steps: Sequence[Step], scales: Mapping[str, Array]) -> tuple[Step, ...]:
    """Steps with the sigmas of each robot's motions times its scales (3,)."""
    return tuple(
        replace(
            step,
            motions={
                robot: replace(m, cov=scales[robot][:, None] * m.cov * scales[robot])
                if robot in scales
                else m
                for robot, m in step.motions.items()
            },
        )
        for step in steps
    )


class NoiseFit(NamedTuple):
    """How far a fit of a track's noise has come.

    ``change``: the largest share by which the mean variance along x, or of turning, has changed, 0
    where that is `NEGLIGIBLE`; ``log_sigma`` (3,): see `variance_sigma`.
    """

    change: float
    log_sigma: Array


def fit_odometry_noise(
    tracks: Mapping[str, Track], posterior: Posterior, *, relax: bool
) -> dict[str, NoiseFit]:
    """Give tracks whose noise nobody states that of their motions in a solution.

    Motions that scans replaced, or of which readings miss a part, are left out. A robot of which
    there are too few motions keeps its noise, and has no fit.

    Args:
        tracks: robot -> its odometry, with the calibration that was found.
        posterior: a solution.
        relax: see `fit_noise`.
    """
    asked, shown = dict[str, Asked[Track]](), dict[str, tuple[Array, Array, Array]]()
    for robot, track in tracks.items():
        own = [step.motions[robot] for step in posterior.steps if robot in step.motions]
        times = _times(own)
        by_odometry = np.array([not motion.from_scans for motion in own], dtype=bool)
        by_odometry &= ~track.is_uncovered(*times)
        if by_odometry.sum() < FEW_MOTIONS:
            continue
        found = posterior.motions(robot, posterior.made[robot])
        asked[robot] = track, times[0][by_odometry], times[1][by_odometry]
        shown[robot] = (
            found.variance[by_odometry],
            found.normalised[by_odometry],
            found.redundancy[by_odometry],
        )
    every = list(asked.values())
    known = motion_variances(every, [without_noise(track.config) for track, _, _ in every])
    fits = {}
    for (robot, (track, begin, end)), without in zip(asked.items(), known, strict=True):
        gained = variances_by_rate(track, begin, end)
        variances, normalised, left = shown[robot]
        track.config, after = fit_noise(
            track.config, without, gained, variances, normalised, left, relax=relax
        )
        change = np.abs(np.mean(after / variances, axis=0) - 1.0)
        log_sigma = variance_sigma(left)
        change[change < NEGLIGIBLE * log_sigma] = 0.0
        fits[robot] = NoiseFit(float(change[[0, 2]].max()), log_sigma)
    return fits


def middle_of_paths(
    steps: Sequence[Step], estimate: Estimate, most: int
) -> tuple[tuple[Step, ...], Estimate]:
    """The middle of every robot's path, which begins at the estimate, and the estimate of that.

    Without closures, whose other ends may be elsewhere.

    Args:
        steps: of a log.
        estimate: of all their states.
        most: states in all, about, evenly shared among the robots.
    """
    own: dict[str, list[int]] = defaultdict(list)
    for n, step in enumerate(steps):
        for robot in (*step.starts, *step.motions):
            own[robot].append(n)
    share = max(2, most // max(1, len(own)))
    ranges = {}
    for robot, numbers in own.items():
        first = max(0, len(numbers) - share) // 2
        ranges[robot] = numbers[first], numbers[first : first + share][-1]
    cov = np.diag([BEGIN_SIGMA**2] * 3)
    begun_ns: dict[str, int] = {}
    made = []
    for n, step in enumerate(steps):
        inside = {robot for robot, (first, last) in ranges.items() if first <= n <= last}
        starts = {
            robot: Start(estimate.states[robot].at(step.time_ns), cov)
            for robot in inside
            if n == ranges[robot][0]
        }
        motions = {r: m for r, m in step.motions.items() if r in inside and r not in starts}
        begun_ns |= dict.fromkeys(starts, step.time_ns)
        # evidence from before a landmark's promotion may be of states before
        seen = tuple(
            a for a in step.associations if a.robot in inside and a.time_ns >= begun_ns[a.robot]
        )
        if starts or motions:
            made.append(Step(step.time_ns, starts, motions, seen))
    states = {}
    for robot, (first, last) in ranges.items():
        path = estimate.states[robot]
        part = slice(*path.stamps_ns.searchsorted([steps[first].time_ns, steps[last].time_ns + 1]))
        states[robot] = Trajectory(path.stamps_ns[part], path.poses[part], path.covs[part])
    return tuple(made), replace(estimate, states=states)


def measured_motion_noise(track: Track, robot: str, posterior: Posterior) -> Array | None:
    """Factors (3,) on a track's variances that its motions show over seconds; None if too few."""
    own = [step.motions[robot] for step in posterior.steps if robot in step.motions]
    if len(own) < MIN_MOTIONS:
        return None
    begin, end = _times(own)
    of = spans(np.append(begin[0], end))
    over = begin[of[:, 0]], end[of[:, 1] - 1]
    found = posterior.motions(robot, _joined(posterior.made[robot], of), over_spans=True)
    # every motion was solved with a least sigma, as where the robot stands
    least = MIN_SIGMA**2 * np.diff(of, axis=1)
    (by_settings,) = motion_variances([(track, *over)], [track.config])
    stated = np.maximum(by_settings, least)
    return found.variance_factor() * np.median(found.variance / stated, axis=0)


def stated_robots(tracks: Mapping[str, Track]) -> set[str]:
    """Robots whose noise is stated: it is measured over spans (`measured_motion_noise`)."""
    return {robot for robot, track in tracks.items() if is_stated(track)}


def fit_motion_noise(tracks: Mapping[str, Track], solutions: Iterable[Posterior]) -> LogNoise:
    """`fit_odometry_noise` of all tracks; of those whose noise is stated what is measured.

    Args:
        tracks: odometry of the robots.
        solutions: each made when it is asked for, by the noise that the tracks have then, with the
            spans of `stated_robots`. More than one come nearer to noise that is far from that of
            the first.
    """
    stated = stated_robots(tracks)
    measured: dict[tuple[str, str], Array] = {}
    fits: dict[str, NoiseFit] = {}
    for posterior in solutions:
        for robot in stated:
            found = measured_motion_noise(tracks[robot], robot, posterior)
            measured |= {} if found is None else {(robot, MOTION): found}
        open_ones = {robot: track for robot, track in tracks.items() if robot not in stated}
        fits |= fit_odometry_noise(open_ones, posterior, relax=False)
    for robot, fit in fits.items():
        tracks[robot].config = with_fit_uncertainty(tracks[robot].config, fit.log_sigma)
    used = {name: track.config for name, track in tracks.items() if (name, MOTION) not in measured}
    return LogNoise(odometry=used, measured=measured)


def _times(motions: Sequence[Motion]) -> tuple[IntArray, IntArray]:
    """When motions (n,) begin and end."""
    return (
        np.array([motion.start_ns for motion in motions], dtype=np.int64),
        np.array([motion.end_ns for motion in motions], dtype=np.int64),
    )


def _joined(motions: Increments, ends: IntArray) -> Increments:
    """Consecutive motions (n) over spans, by the indices (m, 2) of states at their ends."""
    none, first = np.zeros(len(motions.delta) + 1, dtype=np.int64), motions.part(0, 1)
    nothing = Increments(
        *(np.zeros_like(getattr(first, f))[none] for f in ("delta", "cov", "d_cal"))
    )
    points = IncrementSums(motions, none[1:]).query(np.arange(len(none)), none, nothing)
    over = points.motions_between(*ends.T)
    return Increments(over.delta, over.cov, over.d_cal)
