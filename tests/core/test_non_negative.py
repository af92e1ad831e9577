"""Least squares with unknowns that are not negative."""

import numpy as np
import pytest
from scipy.optimize import nnls

from graphslam.core.non_negative import non_negative_least_squares


@pytest.mark.parametrize("seed", range(200))
def test_it_is_that_of_scipy(seed):
    """Square and tall, of either sign, some columns alike or zero: then x is not unique, but how
    well it fits is. Breaks if an unknown that becomes negative is not held, or is never freed."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 10))
    A = rng.normal(size=(n + int(rng.integers(0, 6)), n))
    A = np.abs(A) if seed % 2 else A
    if seed % 5 == 0:
        A[:, rng.integers(n)] = 0.0
    if seed % 7 == 0:
        A[:, -1] = A[:, 0]
    b = rng.normal(size=len(A))
    found = non_negative_least_squares(A, b)
    expected, left = nnls(A, b)
    assert (found >= 0.0).all()
    # of numbers about 1, by QR or by SVD
    assert np.linalg.norm(A @ found - b) == pytest.approx(left, abs=1e-10)
    if seed % 5 and seed % 7:
        np.testing.assert_allclose(found, expected, atol=1e-8)


def test_nothing_fits_better_than_zero():
    np.testing.assert_array_equal(non_negative_least_squares(np.eye(3), -np.ones(3)), 0.0)
