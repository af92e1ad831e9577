"""The noise of sightings that state none: how it grows with the range, and how large it is.

They begin with what sensors commonly have (`Sighting.stated`). `sighting_noise` measures by what
factors that is off; here the shape of the noise of ranges is made to follow their residuals.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.record import replace
from graphslam.core.records import Sighting, Step
from graphslam.estimation.posterior_residuals import Posterior
from graphslam.estimation.range_noise import RangeNoise, likelier_range_noise
from graphslam.estimation.recorded_graph import Source

#: sightings without which nothing is said about a source
MIN_MEASUREMENTS = 100
#: smallest factor on a variance: residuals of logs without noise, or of sightings that are rounded
#: and repeated, vanish
MIN_VARIANCE = 1e-4


def unstated_sources(steps: Sequence[Step], sources: Sequence[Sighting]) -> dict[Source, list[int]]:
    """Those of whose sightings in ``steps`` none states its noise -> numbers of its sightings.

    ``sources``: `Association.source` is an index into them.
    """
    numbers: dict[Source, list[int]] = {}
    stated = set()
    for step in steps:
        for a in step.associations:
            if a.source is None or sources[a.source].stated:
                stated.add((a.robot, a.model))
            elif len(a.z) == 2:
                numbers.setdefault((a.robot, a.model), []).append(a.source)
    return {source: own for source, own in numbers.items() if source not in stated}


def sigmas_of(numbers: Sequence[int], sources: Sequence[Sighting], factors: Array) -> Array:
    """Sigmas (3,) of sightings: bearing rad, range m, and its share of the range.

    ``factors`` (2,) on the variances of bearings and ranges.
    """
    own = [sources[k] for k in numbers]
    ranges = np.array([s.z[1] for s in own])
    bearing = float(np.median([s.cov[0, 0] for s in own]))
    noise = RangeNoise.behind(ranges, np.array([s.cov[1, 1] for s in own]))
    return np.asarray(np.sqrt(np.array([bearing, *noise]) * factors[[0, 1, 1]]))


def likelier_ranges(
    posterior: Posterior, sources: Sequence[Sighting], unstated: Mapping[Source, Sequence[int]]
) -> dict[Source, RangeNoise]:
    """How the noise of ranges grows with the range, where the residuals contradict what it is."""
    models = {}
    for source in unstated:
        seen = posterior.builder.bearings_and_ranges.get(source, ())
        if len(seen) < MIN_MEASUREMENTS:
            continue
        # all of them are sightings
        own = [sources[a.source] for _, _, a in seen if a.source is not None]
        ranges, present = (
            np.array(column) for column in zip(*((s.z[1], s.cov[1, 1]) for s in own), strict=True)
        )
        normalised = posterior.sightings(source).normalised[:, 1]
        model = likelier_range_noise(ranges, normalised * np.sqrt(present), present)
        if model is not None and (model.variance(ranges) >= MIN_VARIANCE * present).all():
            models[source] = model
    return models


def with_range_noise(
    sources: Sequence[Sighting],
    unstated: Mapping[Source, Sequence[int]],
    models: Mapping[Source, RangeNoise],
) -> list[Sighting]:
    """The same sightings; ranges of those with a model have the noise that it says."""
    made = list(sources)
    for source, noise in models.items():
        for k in unstated[source]:
            made[k] = _with_range_variance(made[k], noise)
    return made


def _with_range_variance(sighting: Sighting, noise: RangeNoise) -> Sighting:
    cov = sighting.cov.copy()
    cov[1, 1] = float(noise.variance(sighting.z[1:2])[0])
    return replace(sighting, cov=cov)
