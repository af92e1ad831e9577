"""A start that was found, once the whole drive was laid into the map from it."""

import numpy as np
import pytest

from graphslam.core.records import Start
from graphslam.multi_robot.place_search import DISTINCT_M, DISTINCT_RAD
from graphslam.slam.localisation import laid_start

LAID = np.array([20.0, 6.0, 0.1])


@pytest.mark.parametrize("sigmas", [(4.0, 8.6, 0.77), (1e3, 1e3, 3.0)])
def test_it_is_known_to_what_other_hypotheses_are_told_from(sigmas):
    """By the few places that were recognised it was known to 8 m: loops were then looked for, and
    found, 13 m off in a building of equal rooms, though the path as laid fitted where it was."""
    wide = Start(np.array([21.0, 7.0, 0.0]), np.diag(np.square(sigmas)))
    found = laid_start(LAID, wide)
    np.testing.assert_array_equal(found.pose, LAID)
    largest = np.sqrt(np.diag(found.cov))
    assert (largest <= [DISTINCT_M, DISTINCT_M, DISTINCT_RAD]).all()
    assert (largest > np.multiply([DISTINCT_M, DISTINCT_M, DISTINCT_RAD], 0.7)).all()


def test_what_is_known_better_stays():
    """To a twentieth: sigmas of a decimetre are not made smaller."""
    cov = np.diag([0.1, 0.1, 0.02]) ** 2
    np.testing.assert_allclose(laid_start(LAID, Start(LAID, cov)).cov, cov, rtol=0.05, atol=1e-9)
