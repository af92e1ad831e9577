"""Sensors of sightings that are mounted turned, or whose ranges are too long: found and corrected.

An error is applied if it is clearly there, as a latency is (`sensor_latency`): each costs accuracy
where the log hardly tells it. The solution without them tells which are, see
`estimation.sensor_errors`. Then the sightings are corrected and all is solved again, the noise of
the log anew: what an error does looks like noise of motions, or like errors that sightings share.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import OdometryConfig, RobustConfig
from graphslam.core.geometry import Array, wrap
from graphslam.core.motion_models import Calibration
from graphslam.core.records import Estimate, Sighting
from graphslam.estimation.sensor_errors import ERRORS, ShownErrors, shown_errors
from graphslam.pipeline.log_pass import LogPass
from graphslam.sighting_smoothing.state_at_every_sighting import FineSolution

#: an error is applied if it is so many of its sigmas
APPLIED_SIGMAS = 4.0
#: with all others unknown too, and if the data leave at most so much of the sigma before
TOLD = 0.5
#: sightings are corrected again if an error moves by more of its sigma, so many times at most
SETTLED_SIGMAS, MAX_ROUNDS = 0.5, 3
#: relative: ranges that may be off by more are worth a warning
WORTH_SAYING = 0.01
#: sensors of a robot that are told apart by their mounts; of more, the mount is a moving one
MOST_SENSORS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Sensors:
    """The n sensors of sightings: ``names``, of their robots and which of these it is, and mounts.

    ``of``: `Association.source` -> number of its sensor.
    """

    names: tuple[str, ...]
    mounts: tuple[Array, ...]
    of: Mapping[int, int]

    @classmethod
    def behind(cls, sources: Sequence[Sighting]) -> "Sensors":
        """Those of sightings."""
        mounts: dict[str, dict[tuple[float, ...], Array]] = {}
        for sighting in sources:
            own = mounts.setdefault(sighting.robot, {})
            own.setdefault(tuple(sighting.mount.tolist()), sighting.mount)
        numbers: dict[tuple[str, tuple[float, ...]], int] = {}
        names, chosen = [], []
        for robot, own in sorted(mounts.items()):
            for k, (key, mount) in enumerate(own.items()):
                if not k or len(own) <= MOST_SENSORS:
                    names.append(f"{robot}.{k + 1}" if k else robot)
                    chosen.append(mount)
                numbers[robot, key] = len(names) - 1
        of = {n: numbers[s.robot, tuple(s.mount.tolist())] for n, s in enumerate(sources)}
        return cls(tuple(names), tuple(chosen), of)

    def corrected(self, sources: Sequence[Sighting], errors: Array) -> list[Sighting]:
        """Sightings as sensors without ``errors`` (k,), rad and relative, would have made them."""
        return [
            _corrected(s, *errors[2 * self.of[k] : 2 * self.of[k] + 2].tolist())
            for k, s in enumerate(sources)
        ]


def _corrected(sighting: Sighting, yaw: float, scale: float) -> Sighting:
    if not (yaw or scale):
        return sighting
    z, factor = sighting.z.copy(), np.ones(len(sighting.z))
    z[0] = wrap(z[0] - yaw)
    z[2:] = wrap(z[2:] - yaw)
    factor[1] = 1.0 / (1.0 + scale)
    return replace(sighting, z=z * factor, cov=sighting.cov * np.outer(factor, factor))


@dataclass(frozen=True, slots=True, eq=False)
class FoundErrors:
    """Errors (k,) of sensors, and which (a,) are applied; all others are zero.

    ``cov`` (a, a) of those. ``sigmas`` (k,): of all of them, were they all applied. ``open``
    (k, m): independent errors that are left.
    """

    errors: Array
    applied: IntArray
    cov: Array
    sigmas: Array
    open: Array


def find_errors(shown: ShownErrors, corrected: Array, prior: Array) -> FoundErrors:
    """Which errors are clearly there, and how large they are.

    Where the odometry's scale is unknown too, the log tells only the ratio of the two. What the
    odometry's calibration clearly takes up there could as well be such an error, by its share in
    the variance of both before any data. It is not applied. But with both variances in proportion
    to those, and as large together as what is seen asks for, that of the error is its share times
    the square of what is seen.

    Args:
        shown: by a solution of sightings that are ``corrected`` (k,).
        corrected: the errors that are taken out of the sightings.
        prior: (k,) sigmas; an error with none is held.
    """
    S, pull = shown.information, shown.gradient + shown.information @ corrected

    def posterior(use: IntArray) -> tuple[Array, Array]:
        """Errors and their covariance if all others are zero."""
        own, known = np.ix_(use, use), np.diag(prior[use] ** -2.0)
        P = np.linalg.inv(S[own] + known)
        return P @ pull[use], P @ (shown.spread[own] + known) @ P

    free = np.flatnonzero(prior > 0.0)
    every, cov = posterior(free)
    sigmas = np.zeros(len(prior))
    sigmas[free] = np.sqrt(np.diag(cov))
    is_told = sigmas[free] < TOLD * prior[free]
    use = free[is_told & (np.abs(every) > APPLIED_SIGMAS * sigmas[free])]
    errors = np.zeros(len(prior))
    errors[use], cov = posterior(use)
    left = np.zeros((len(prior), len(use) + 1))
    left[free, -1] = _taken_up(shown, free, prior) * ~np.isin(free, use)
    if len(use):
        left[use, :-1] = np.linalg.cholesky(cov)
        own = S[np.ix_(use, use)] + np.diag(prior[use] ** -2.0)
        left[use, -1] = -np.linalg.solve(own, S[use] @ left[:, -1])
    return FoundErrors(errors, use, cov, sigmas, left)


def _taken_up(shown: ShownErrors, free: IntArray, prior: Array) -> Array:
    """Sigmas, with signs, of those ``free`` errors that a calibration may have taken up, else 0."""
    own = np.ix_(free, free)
    P = np.linalg.inv(shown.information[own] + np.diag(prior[free] ** -2.0))
    found, cov = P @ shown.taken[free], P @ shown.taken_cov[own] @ P
    share = np.maximum(1.0 - np.diag(P) / prior[free] ** 2, 1e-6)
    is_clear = np.abs(found) > APPLIED_SIGMAS * np.sqrt(np.diag(cov))
    return np.where(is_clear, found / np.sqrt(share), 0.0)


def solved_with_sensors(
    one: LogPass, start: Estimate, solve: Callable[[Estimate], FineSolution]
) -> FineSolution:
    """The final solution of a pass, with sensors that are what the log shows them to be.

    Args:
        one: the pass; its sightings are corrected.
        start: an estimate of its steps.
        solve: finds the solution from an estimate.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    before = PassSettings.of(one)
    solution = solve(start)
    sensors, told = Sensors.behind(one.sources), one.sources
    prior = np.tile(prior_sigmas(one.config.odometry), len(sensors.names))
    if not prior.any():
        return solution
    corrected = np.zeros(len(prior))
    for k in range(MAX_ROUNDS + 1):
        shown = shown_errors(
            solution.solved.graph, solution.made, sensors.of, sensors.mounts, solution.shared
        )
        found = find_errors(shown, corrected, prior)
        moved = np.abs(found.errors - corrected)
        limit = np.zeros(len(prior))
        limit[found.applied] = SETTLED_SIGMAS * np.sqrt(np.diag(found.cov))
        if k == MAX_ROUNDS or not (moved > limit).any():
            break
        corrected = found.errors
        one.sources = sensors.corrected(told, corrected)
        before.restore(one)
        solution = solve(solution.estimate)
    hidden = np.abs(found.open[:, -1])
    hidden[found.applied] = 0.0
    is_told = (prior > 0.0) & (found.sigmas < TOLD * prior) & (hidden == 0.0)
    sigmas = np.where(hidden > 0.0, hidden, found.sigmas)
    names = [(sensor, error) for sensor in sensors.names for error in ERRORS]
    for (sensor, error), *entry in zip(
        names, corrected.tolist(), sigmas.tolist(), is_told.tolist(), strict=True
    ):
        one.sensor_errors[f"{sensor}.{error}"] = (entry[0], entry[1], entry[2])
    one.sensor_warnings = [
        *_corrections(names, corrected, sigmas),
        *(
            f"{sensor}: its odometry and the ranges of its sightings have different scales, and "
            f"the log does not tell which is right: the ranges may be {100 * sigma:.1f} % off"
            for (sensor, error), sigma in zip(names, hidden.tolist(), strict=True)
            if error == ERRORS[1] and sigma > WORTH_SAYING
        ),
    ]
    return replace(solution, estimate=shown.with_errors(solution.estimate, found.open))


def _corrections(
    names: Sequence[tuple[str, str]], corrected: Array, sigmas: Array
) -> Iterator[str]:
    """What is corrected, a line for each; ``names``: sensor and error."""
    for (sensor, error), value, sigma in zip(
        names, corrected.tolist(), sigmas.tolist(), strict=True
    ):
        if value and error == ERRORS[0]:
            side = "left" if value > 0 else "right"
            angle = f"{np.degrees(abs(value)):.1f}° ± {np.degrees(sigma):.1f}°"
            yield f"{sensor}: the bearings of its sightings were {angle} too far to the {side}"
        elif value:
            size = f"{100 * abs(value):.1f} % ± {100 * sigma:.1f} %"
            way = "long" if value > 0 else "short"
            yield f"{sensor}: the ranges of its sightings were {size} too {way}"


def prior_sigmas(config: OdometryConfig) -> Array:
    """Of a sensor's `ERRORS` (2,), before any data; 0 of what is held."""
    sigmas = (config.sighting_sigma_rad, config.sighting_scale_sigma)
    pairs = zip(ERRORS, sigmas, strict=True)
    return np.array([0.0 if name in config.fixed_calibration else s for name, s in pairs])


@dataclass(frozen=True, slots=True, eq=False)
class PassSettings:
    """What a solution changes in its pass and another one is to begin with."""

    tracks: Mapping[str, tuple[OdometryConfig, Calibration]]
    kernel: RobustConfig
    dropped: Counter[str]

    @classmethod
    def of(cls, one: LogPass) -> "PassSettings":
        """Of a pass before it is solved."""
        tracks = {name: (run.track.config, run.track.prior) for name, run in one.started.items()}
        return cls(tracks, one.kernel, Counter(one.dropped))

    def restore(self, one: LogPass) -> None:
        """Set a pass back."""
        for name, (config, prior) in self.tracks.items():
            track = one.runs[name].track
            track.config, track.prior = config, prior
        one.kernel, one.dropped = self.kernel, Counter(self.dropped)
