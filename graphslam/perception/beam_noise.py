"""White noise of ranges, by the range, and how far it lets a return be off its line."""

from dataclasses import replace

import numpy as np

from graphslam.core.config import FrontEndConfig
from graphslam.core.geometry import Array

#: sigmas of the range that a return of a line may be off: one in eighty is farther out
DEVIATION_SIGMAS = 2.5
#: variance of ranges, m², that `split_m` allows for
EXPECTED = FrontEndConfig.range_sigma_m**2


def range_variance(config: FrontEndConfig, square_ranges: Array) -> Array | float:
    """Variances (n,) of ranges, m², by their squares (n,), m²; one number if they are all equal."""
    variance = config.range_sigma_m**2
    if config.range_sigma_ratio == 0.0:
        return variance
    return np.asarray(variance + config.range_sigma_ratio**2 * square_ranges)


def largest_deviation(config: FrontEndConfig, square_ranges: Array) -> Array | float:
    """How far returns (n,) may be off a line, m: ``split_m``, and what noise of the range adds.

    Args:
        config: of the front end.
        square_ranges: (n,) m², of the returns, or means of sets of them.
    """
    more = np.maximum(range_variance(config, square_ranges) - EXPECTED, 0.0)
    return np.asarray(np.sqrt(config.split_m**2 + DEVIATION_SIGMAS**2 * more))


def noisier(config: FrontEndConfig, factor: float) -> FrontEndConfig:
    """The settings with the noise of ranges larger by a factor."""
    return replace(
        config,
        range_sigma_m=factor * config.range_sigma_m,
        range_sigma_ratio=factor * config.range_sigma_ratio,
    )
