"""Covariances of sightings that their messages do not fill in."""

import numpy as np
import pytest

from graphslam.core.config import Config
from graphslam.core.records import Sighting
from graphslam.logs import LogWriter, open_logs
from graphslam.logs.sighting_covariances import (
    BEARING_RAD,
    DIRECTION_RAD,
    RANGE_M,
    RANGE_SHARE,
    states_none,
)

S = 1_000_000_000


def read(path, z, cov):
    """What comes of one sighting, and why it was dropped if it was."""
    with LogWriter(path) as log:
        for k in range(3):
            log.odometry("r", S + k * S, np.array([0.1 * k, 0.0, 0.0]))
        log.sighting("r", 2 * S, z, cov, identity="p")
    logs = open_logs([path], Config())
    return [m for m in logs.messages() if isinstance(m, Sighting)], logs.dropped


@pytest.mark.parametrize("unknown", [0.0, np.nan])
@pytest.mark.parametrize("size", [2, 3])
def test_what_is_not_filled_in_is_what_sensors_commonly_have(tmp_path, unknown, size):
    """Breaks if sightings of drivers that do not know their noise are dropped."""
    z = np.array([0.3, 4.0, -1.0])[:size]
    (found,), dropped = read(tmp_path / "log.mcap", z, np.full((size, size), unknown))
    assert not dropped and not found.stated
    sigmas = [BEARING_RAD, np.hypot(RANGE_M, 4.0 * RANGE_SHARE), DIRECTION_RAD][:size]
    np.testing.assert_allclose(found.cov, np.diag(np.square(sigmas)), rtol=1e-12)


def test_what_is_filled_in_is_stated(tmp_path):
    (found,), _ = read(tmp_path / "log.mcap", np.array([0.3, 4.0]), np.diag([1e-4, 0.01]))
    assert found.stated and found.cov[1, 1] == 0.01


@pytest.mark.parametrize("diagonal", [(0.0, 0.01), (1e-4, 0.0), (1e-4, np.nan), (-1.0, 0.01)])
def test_what_is_filled_in_by_half_is_an_error(tmp_path, diagonal):
    """Breaks if a variance that somebody forgot is taken for one that is unknown."""
    found, dropped = read(tmp_path / "log.mcap", np.array([0.3, 4.0]), np.diag(diagonal))
    assert not found and sum(dropped.values()) == 1


def test_a_direction_counts_only_where_it_is_measured():
    measured = np.array([[0.1, 2.0, np.nan], [0.1, 2.0, 0.5]])
    covs = np.zeros((2, 9))
    covs[:, 8] = 0.01
    assert states_none(measured, covs).tolist() == [True, False]
