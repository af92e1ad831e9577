"""How the noise of ranges grows with the range, by their residuals."""

import numpy as np
import pytest

from graphslam.estimation.range_noise import RangeNoise, likelier_range_noise

N = 2000


def residuals(seed, constant, share, outliers=0):
    """Ranges (n,) and errors (n,) of them."""
    rng = np.random.default_rng(seed)
    ranges = rng.uniform(0.5, 6.0, N)
    error = rng.normal(size=N) * np.hypot(constant, share * ranges)
    error[:outliers] = rng.uniform(-3, 3, outliers)
    return ranges, error


@pytest.mark.parametrize(
    ("constant", "share"), [(0.1, 0.0), (0.02, 0.0), (0.0, 0.05), (0.05, 0.01)]
)
@pytest.mark.parametrize("outliers", [0, 20])
@pytest.mark.parametrize("seed", range(3))
def test_the_growth_is_found(constant, share, outliers, seed):
    """Breaks if noise of a laser is weighted as that of a camera, or outliers make the model."""
    ranges, error = residuals(seed, constant, share, outliers)
    begun = RangeNoise(0.03**2, 0.03**2).variance(ranges)
    found = likelier_range_noise(ranges, error, begun)
    assert found is not None
    true = constant**2 + share**2 * ranges**2
    ratio = np.sqrt(found.variance(ranges) / true)
    # a Student distribution takes part of Gaussian noise for tails: 0.87; what counts is the shape,
    # known to a twentieth from 2000 residuals, and to a tenth at the shortest ranges
    assert np.median(ratio) == pytest.approx(0.88, abs=0.05)
    assert ratio.max() / ratio.min() < 1.35
    assert np.percentile(ratio, 95) / np.percentile(ratio, 5) < 1.2


@pytest.mark.parametrize("times", [0.1, 1.0, 10.0])
@pytest.mark.parametrize("seed", range(10))
def test_a_model_that_fits_stays(seed, times):
    """Breaks if chance changes the model: the sightings would be solved twice for nothing."""
    ranges, error = residuals(seed, 0.03, 0.03)
    begun = RangeNoise(0.03**2, 0.03**2).variance(ranges)
    assert likelier_range_noise(ranges, times * error, begun) is None


def test_the_model_behind_variances_is_exact():
    ranges = np.array([1.0, 2.0, 5.0])
    model = RangeNoise(0.01, 0.0004)
    assert RangeNoise.behind(ranges, model.variance(ranges)) == pytest.approx(model, rel=1e-9)
