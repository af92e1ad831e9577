"""Paths that leave that of their odometry and come back: sightings that were wrong for a while."""

import numpy as np
import pytest

from graphslam.core.geometry import compose
from graphslam.verdict.excursions import LEAVES_NS, largest_excursion

S = 1_000_000_000
RATE_HZ, SPEED_M_S, NOISE_M = 10, 0.3, 0.005


def driven(seed=0, slips=(), heading_slip=0.0):
    """Times (n,), poses by odometry and true ones (n, 3) of 100 s that wind about.

    ``slips``: (s, m) along the path that odometry does not see, over one second each, with
    ``heading_slip`` rad in all of them.
    """
    rng = np.random.default_rng(seed)
    n = 100 * RATE_HZ
    told = np.column_stack([np.full(n, SPEED_M_S), np.zeros(n), 0.4 * np.sin(np.arange(n) / 70)])
    told /= RATE_HZ
    own = told + rng.normal(0.0, (NOISE_M, NOISE_M, 0.002), (n, 3))
    for begin_s, slip_m in slips:
        own[begin_s * RATE_HZ : (begin_s + 1) * RATE_HZ] += (
            np.array([slip_m, 0.0, heading_slip]) / RATE_HZ
        )
    paths = [[np.zeros(3)], [np.zeros(3)]]
    for path, steps in zip(paths, (told, own), strict=True):
        for step in steps:
            path.append(compose(path[-1], step))
    return np.arange(n + 1) * S // RATE_HZ, *(np.array(path) for path in paths)


@pytest.mark.parametrize("away", [np.array([-1.0, 0.2, -0.1]), np.array([0.0, 0.6, 0.0])])
def test_an_estimate_that_is_off_for_five_seconds_is_found(away):
    """Breaks if what sightings that err alike do to a path goes unnoticed."""
    times, odometry, true = driven()
    estimate = true.copy()
    off = (times >= 40 * S) & (times < 45 * S)
    estimate[off] += away
    found = largest_excursion(times, odometry, estimate)
    assert found is not None
    # the window that sees it whole begins up to its own length before, and ends after
    assert 40 * S - LEAVES_NS <= found.begin_ns < 40 * S
    assert 45 * S - LEAVES_NS <= found.end_ns <= 45 * S + LEAVES_NS
    # noise of 2.5 s is 0.025 m
    assert found.away_m == pytest.approx(np.hypot(*away[:2]), abs=0.1)


@pytest.mark.parametrize("seed", range(20))
def test_noise_is_none(seed):
    """Breaks if the drift of odometry is taken for wrong sightings."""
    assert largest_excursion(*driven(seed)) is None


@pytest.mark.parametrize("scale", [0.7, 1.5])
def test_odometry_of_another_scale_is_none(scale):
    """Breaks if what a wrong wheel radius misses of fast motions counts."""
    times, odometry, true = driven()
    odometry[:, :2] *= scale
    assert largest_excursion(times, odometry, true) is None


@pytest.mark.parametrize("heading", [0.0, 1.0, -2.0])
@pytest.mark.parametrize("seed", range(5))
def test_slip_is_none(seed, heading):
    """Breaks if a robot whose wheels slipped, which sightings tell rightly, is doubted for it."""
    slips = [(20, -0.6), (60, 0.6)]
    assert largest_excursion(*driven(seed, slips, heading)) is None


def test_few_images_say_nothing():
    """Breaks if a median of a few counts."""
    times, odometry, true = driven()
    few = slice(None, None, 60)
    estimate = true.copy()
    estimate[300:330, 0] += 1.0
    assert largest_excursion(times[few], odometry[few], estimate[few]) is None
