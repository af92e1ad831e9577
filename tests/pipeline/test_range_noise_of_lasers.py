"""The noise of ranges that a run uses, by what is measured of a log's lasers."""

from types import SimpleNamespace

import pytest

from graphslam.core.config import FrontEndConfig
from graphslam.core.records import OdometryPose, Scan
from graphslam.logs.laser_noise import BeamNoise
from graphslam.pipeline.robot_settings import with_range_noise


def used(first, further=None):
    """Sigma and ratio that the settings have for a log of two lasers, of known noise or None."""
    noise = {"/scan": first, "/rear": further}
    log = SimpleNamespace(
        topics=[
            SimpleNamespace(name=n, record=r) for n, r in (("/scan", Scan), ("/odom", OdometryPose))
        ],
        further_lasers=[SimpleNamespace(name="/rear", record=Scan)],
        range_noise=noise.__getitem__,
    )
    found = with_range_noise(log, FrontEndConfig())
    return found.range_sigma_m, found.range_sigma_ratio


DEFAULT = FrontEndConfig().range_sigma_m, FrontEndConfig().range_sigma_ratio


@pytest.mark.parametrize("swapped", [False, True])
def test_the_noisiest_laser_counts_whether_it_is_the_first_or_a_further_one(swapped):
    lasers = [BeamNoise(0.01, 0.0, 8.0), BeamNoise(0.1, 0.0, 8.0)]
    assert used(*lasers[:: -1 if swapped else 1]) == (0.1, 0.0)


def test_lasers_are_compared_at_a_range_that_both_have():
    """One that sees farther is not noisier for that."""
    near, far = BeamNoise(0.06, 0.0, 4.0), BeamNoise(0.01, 0.005, 30.0)
    assert far.largest_m > near.largest_m
    assert used(near, far) == (0.06, 0.0)


def test_lasers_of_usual_or_unknown_noise_leave_the_settings_alone():
    assert used(BeamNoise(0.02, 0.0, 8.0)) == DEFAULT
    assert used(None, None) == DEFAULT
