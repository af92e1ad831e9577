"""Motions of long logs, integrated window by window: those of one piece, and bounded sums."""

import numpy as np
import pytest

from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.geometry import compose
from graphslam.core.motion_models import with_rates
from graphslam.core.records import OdometryPose
from graphslam.odometry import integration_windows, path_sums, readings
from graphslam.odometry.noise_estimation import variances_by_rate
from graphslam.odometry.preintegration import Track, preintegrate_batch

S = 1_000_000_000


def track(seed):
    rng = np.random.default_rng(seed)
    one, pose = Track(OdometryConfig(), RobotConfig(), mounted=True), np.zeros(3)
    for k in range(3000):
        pose = compose(pose, [0.01, 0.0, rng.normal(0, 0.01)])
        one.add(OdometryPose(f"robot{seed}", k * S // 100, k * S // 100, pose))
    return one


@pytest.fixture(scope="module")
def asked():
    """Motions of half a second, some backwards, of two tracks, in no order."""
    rng = np.random.default_rng(0)
    out = []
    for seed in (1, 2):
        begin = rng.permutation(np.arange(1, 28 * S, S // 7))
        end = begin + S // 2
        back = rng.random(len(begin)) < 0.3
        out.append((track(seed), np.where(back, end, begin), np.where(back, begin, end)))
    return out


def sums_of(function, monkeypatch):
    """What a function gives, and the largest number of increments that were summed at once."""
    most, whole = [0], path_sums.IncrementSums

    def counted(increments, first):
        most.append(len(increments.delta))
        return whole(increments, first)

    with monkeypatch.context() as patch:
        patch.setattr(path_sums, "IncrementSums", counted)
        return function(), max(most)


def test_windows_change_nothing_but_what_is_summed_at_once(asked, monkeypatch):
    whole, most = sums_of(lambda: preintegrate_batch(asked), monkeypatch)
    monkeypatch.setattr(integration_windows, "MOST_READINGS", 1000)
    parts, few = sums_of(lambda: preintegrate_batch(asked), monkeypatch)
    assert most > 5000 and few < 1500
    for one, other in zip(whole, parts, strict=True):
        for name in ("delta", "cov", "d_cal", "length_m"):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-12)


def test_tracks_with_other_rates_of_noise_are_summed_together_as_by_themselves(asked, monkeypatch):
    """Each keeps its own rates; by those of the first the other's noise is off by a factor."""
    (one, *first), (other, *second) = asked
    with monkeypatch.context() as patch:
        patch.setattr(other, "config", with_rates(other.config, np.linspace(1e-4, 2e-3, 9)))
        both = [(one, *first), (other, *second)]
        together, most = sums_of(lambda: preintegrate_batch(both), monkeypatch)
        alone = [preintegrate_batch([each])[0] for each in both]
    assert most > 5000  # both at once
    for found, expected in zip(together, alone, strict=True):
        # rounding of sums that begin elsewhere; the noise of a motion is 1e-5 and more
        np.testing.assert_allclose(found.cov, expected.cov, atol=1e-12)


def test_motions_that_all_reach_to_the_end_are_not_cut_into_windows(asked, monkeypatch):
    """Each window would sum up all that comes after it, again."""
    monkeypatch.setattr(integration_windows, "MOST_READINGS", 1000)
    one, begin, end = asked[0]
    assert integration_windows.windows([(one, begin, np.full_like(end, 29 * S))]) is None
    assert integration_windows.windows([(one, begin[:0], end[:0])]) is None


def test_variances_by_rate_hold_few_readings_at_once(asked, monkeypatch):
    one = asked[0][0]
    begin = np.arange(1, 28 * S, S // 7)
    whole = variances_by_rate(one, begin, begin + S // 2)
    monkeypatch.setattr("graphslam.odometry.noise_estimation.READINGS", 500)
    parts, few = sums_of(lambda: variances_by_rate(one, begin, begin + S // 2), monkeypatch)
    assert few < 700
    np.testing.assert_allclose(whole, parts, atol=1e-10)


def test_readings_do_not_wait_without_end(monkeypatch):
    whole = track(3)
    monkeypatch.setattr(readings, "MOST_PENDING", 100)
    parts = track(3)
    assert len(parts._pending) < 100
    np.testing.assert_allclose(whole.pose(whole.times), parts.pose(parts.times), atol=1e-12)
