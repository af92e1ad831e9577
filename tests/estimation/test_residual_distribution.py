"""The size, the tails and the shared part of measurements' noise, from residuals alone."""

import numpy as np
import pytest

from graphslam.estimation.posterior_residuals import Residuals
from graphslam.estimation.residual_distribution import fit_distribution, shared_variance

N = 20_000


def effective_variance(residuals, found):
    """What a measurement counts for under its kernel, on average."""
    d2 = np.square(residuals / np.sqrt(found.variance)).sum(axis=1)
    return found.variance / np.mean(1 / (1 + d2 / found.kernel_scale**2))


def test_gaussian_noise_is_found_to_be_gaussian_and_of_its_size():
    """A kernel fitted to it hardly weights anything, so its variance is not misjudged either."""
    sigmas = np.array([0.5, 2.0])
    r = sigmas * np.random.default_rng(1).normal(size=(N, 2))
    found = fit_distribution(r)
    # a variance from 20 000 values has a sigma of 1 %
    np.testing.assert_allclose(effective_variance(r, found), sigmas**2, rtol=0.04)
    assert found.kernel_scale > 7.0


def information(residuals, found):
    """Ratio of the true information of an M-estimate of a mean to that of its weights."""
    normalised = residuals / np.sqrt(found.variance)
    d2 = np.square(normalised).sum(axis=1)
    c2 = found.kernel_scale**2
    w = 1 / (1 + d2 / c2)
    k = residuals.shape[1]
    slope = np.mean(w - 2 * w**2 * d2 / (c2 * k))
    spread = np.mean(w**2 * d2) / k
    return float(slope**2 / spread / np.mean(w))


@pytest.mark.parametrize("nu", [3, 5, 10])
def test_heavy_tails_get_a_narrow_kernel_and_an_honest_information(nu):
    """Weights alone would state up to a third more information than the estimate has."""
    r = np.random.default_rng(2).standard_t(nu, size=(N, 2))
    found = fit_distribution(r)
    assert 1.2 < found.kernel_scale < 5.0
    assert information(r, found) == pytest.approx(1.0, abs=0.02)


def test_one_gross_error_does_not_change_the_size():
    r = np.random.default_rng(3).normal(size=(N, 2))
    r[7] = 1e4
    np.testing.assert_allclose(effective_variance(r, fit_distribution(r)), 1.0, rtol=0.04)


def shared_residuals(true, prior, known, n=400, seed=4):
    """Errors of variance ``true``, estimated with a prior and measurements of variance known."""
    rng = np.random.default_rng(seed)
    errors = np.sqrt(true) * rng.normal(size=(n, 2))
    measured = errors + np.sqrt(known) * rng.normal(size=(n, 2))
    gain = prior / (prior + known)
    variance = np.full((n, 2), prior)
    return Residuals(gain * measured, variance, np.full((n, 2), prior * (1 - gain)))


@pytest.mark.parametrize("prior", [0.1, 1.0, 10.0])
def test_a_shared_error_is_found_whatever_was_assumed(prior):
    """In one go: estimated with its own prior again and again it would creep there."""
    found = shared_variance(shared_residuals(0.5, prior, 0.2)) * prior
    # 400 values of variance 0.7: a sigma of 0.05
    np.testing.assert_allclose(found, 0.5, atol=0.15)


def test_a_shared_error_that_is_not_there_is_not_found():
    """Sightings of one target would otherwise lose weight in every log of white noise."""
    for seed in range(20):
        found = shared_variance(shared_residuals(0.0, 1.0, 0.05, seed=seed))
        np.testing.assert_array_equal(found, 0.0)


def test_residuals_that_are_all_zero_have_a_finite_distribution():
    """Of a robot that stands, whose detector rounds: each sighting is the same."""
    for r in (np.zeros((200, 2)), np.column_stack([np.zeros(200), np.ones(200)])):
        found = fit_distribution(r)
        assert np.isfinite(found.variance).all() and np.isfinite(found.kernel_scale)
