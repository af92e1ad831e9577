"""What the records of the final landmarks have beside the estimate."""

import numpy as np
import pytest

from graphslam.mapping.landmark_map import Entry
from graphslam.mapping.landmark_records import ALONG, make_landmark

BIAS_M = 0.01


@pytest.mark.parametrize("length", [1.0, 8.0])
def test_a_wall_has_the_bias_of_its_surface(length):
    """Across it, and by the difference between its ends in direction: less for a longer wall."""
    mean, cov = np.array([2.0, 1.0, 0.6]), np.diag([0.04, 1e-6, 1e-8])
    entry = Entry(1, "line", mean.copy(), cov, np.array([-length / 2, length / 2]), 0, 9, None)
    found = make_landmark(entry, mean, cov, BIAS_M).cov - cov
    across = np.array([-np.sin(0.6), np.cos(0.6)])
    np.testing.assert_allclose(found[:2, :2], BIAS_M**2 * np.outer(across, across), atol=1e-18)
    assert found[2, 2] == pytest.approx((ALONG * BIAS_M / length) ** 2)


def test_a_point_has_none():
    mean, cov = np.array([2.0, 1.0]), np.diag([1e-4, 1e-6])
    entry = Entry(1, "point", np.array([2.0, 1.0, 0.0]), cov, np.zeros(2), 0, 9, None)
    np.testing.assert_array_equal(make_landmark(entry, mean, cov, BIAS_M).cov, cov)
