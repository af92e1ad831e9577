"""The noise of a log, as its solution uses it and as summary.json reports it."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np

from graphslam.core.config import OdometryConfig, RobustConfig
from graphslam.core.geometry import Array
from graphslam.core.motion_models import RATES
from graphslam.core.records import Association, Step
from graphslam.estimation.range_noise import RangeNoise
from graphslam.estimation.recorded_graph import SHARED_NS, ObservationNoise, Source
from graphslam.estimation.sandwich_covariance import weighing_variance

#: name of the odometry among the sources of `LogNoise.measured`
MOTION = "motion"


@dataclass(frozen=True, slots=True)
class LogNoise:
    """The noise of a log.

    ``sightings``: that of bearings and ranges by source; ``odometry``: robot -> its settings,
    without floors; ``measured``: source -> factors (2,) on the stated variances, shared errors
    included, that the log shows, and likewise (3,) of motions whose covariances are stated.
    ``lines``: robot -> factors (2,) on the stated variances of normal offsets and directions of
    its lines, by which covariances are computed. ``of_whole_log``: found in all of it.
    ``unstated``: source that states no noise -> the sigmas (3,) that the log shows: of bearings,
    rad, of ranges, m, and as a share of these; its factors are on what it began with. ``ranges``:
    how the noise of ranges grows, where that is likelier than what it began with.
    """

    sightings: Mapping[Source, ObservationNoise] = field(default_factory=dict)
    odometry: Mapping[str, OdometryConfig] = field(default_factory=dict)
    measured: Mapping[Source, Array] = field(default_factory=dict)
    lines: Mapping[str, Array] = field(default_factory=dict)
    of_whole_log: bool = False
    unstated: Mapping[Source, Array] = field(default_factory=dict)
    ranges: Mapping[Source, RangeNoise] = field(default_factory=dict)

    def motion_scales(self) -> dict[str, Array]:
        """Robot -> factor (3,) on the sigmas of its motions: the stated noise is never reduced."""
        return {
            robot: np.sqrt(np.maximum(1.0, factors))
            for (robot, model), factors in self.measured.items()
            if model == MOTION
        }

    @property
    def is_white(self) -> bool:
        """Whether the errors of sightings are independent: then every one of them counts."""
        return is_white(self.sightings)

    @property
    def shared_errors(self) -> Mapping[Source, ObservationNoise] | None:
        """The noise of sightings where some share errors; else None."""
        return None if self.is_white else self.sightings

    def to_summary(self) -> dict[str, Any]:
        """Key `noise` of summary.json."""
        quantities = {MOTION: ("motion along x", "motion along y", "turning")}
        out: dict[str, Any] = {}
        for (robot, model), factors in sorted(self.measured.items()):
            names = quantities.get(model, ("bearings", "ranges"))
            entry: dict[str, Any] = {"measured": dict(zip(names, factors.tolist(), strict=True))}
            noise = self.sightings.get((robot, model))
            if noise is not None:
                entry |= {"white": noise.white.tolist(), "shared": noise.shared.tolist()}
            sigmas = self.unstated.get((robot, model))
            if sigmas is not None:
                names = ("bearing_rad", "range_m", "range_share")
                entry |= {"stated": False, "sigmas": dict(zip(names, sigmas.tolist(), strict=True))}
            out[f"{robot} {model}"] = entry
        for robot, factors in self.lines.items():
            names = ("normal offsets", "directions")
            # stated by the front end, not by the log: no warning is due
            out[f"{robot} lines"] = {"variances": dict(zip(names, factors.tolist(), strict=True))}
        for robot, config in self.odometry.items():
            out[f"{robot} odometry"] = {name: getattr(config, name) for name in RATES}
        return out

    def kernel(self, given: RobustConfig) -> RobustConfig:
        """The kernel as wide as the tails of white noise allow; as ``given`` for any other."""
        if not (self.is_white and self.sightings):
            return given
        return replace(given, scale=min(noise.kernel_scale for noise in self.sightings.values()))


def with_own_noise(steps: Sequence[Step], noise: LogNoise) -> tuple[Step, ...]:
    """Steps whose sightings have the noise of a log that each has by itself, shared or not."""
    return _widened(steps, noise, lambda _: 1)


def weighed(steps: Sequence[Step], noise: LogNoise) -> tuple[Step, ...]:
    """Steps whose sightings have the weights that the noise of a log gives them.

    White noise has its own, for errors that are shared see `weighing_variance`.
    """
    spans = Counter(_span(a) for step in steps for a in step.associations)
    return _widened(steps, noise, lambda a: spans[_span(a)])


def _widened(
    steps: Sequence[Step], noise: LogNoise, count: Callable[[Association], int]
) -> tuple[Step, ...]:
    """Steps with the variances of sightings of which ``count`` share an error."""

    @cache
    def scale(robot: str, model: str, sharing: int) -> Array | None:
        own = noise.sightings.get((robot, model))
        if own is None:
            return None
        (sigma,) = np.sqrt(weighing_variance(own, np.array([sharing])))
        return np.outer(sigma, sigma)

    def widened(a: Association) -> Association:
        factors = scale(a.robot, a.model, count(a))
        return a if factors is None else a.with_measurement(a.z, a.cov * factors)

    return tuple(replace(s, associations=tuple(map(widened, s.associations))) for s in steps)


def _span(a: Association) -> tuple[str, int | str, int]:
    """Sightings with an equal one may share an error."""
    return a.robot, a.target, a.time_ns // SHARED_NS


def is_white(noise: Mapping[Source, ObservationNoise]) -> bool:
    """Whether the errors of all sources are independent."""
    return not any(found.shared.any() for found in noise.values())


def has_state_at_every_sighting(noise: Mapping[Source, ObservationNoise]) -> bool:
    """Whether the final solution has a state at every sighting instead of one per step.

    Otherwise odometry carries sightings to the state, and its noise hides what they tell of the
    motion meanwhile. Where robots see each other those that are seen would need states too. That
    takes twice as long and gains little if errors are shared: 0.073 m instead of 0.076 in MRCLAM 6.
    """
    return is_white(noise) or all(model == "point" for _, model in noise)
