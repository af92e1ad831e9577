"""A start that was found, once the whole drive was laid into the map from it."""

from types import SimpleNamespace

import numpy as np
import pytest

from graphslam.core.frame_forest import PRIOR_INFLATION
from graphslam.core.records import Trajectory
from graphslam.multi_robot.place_search import DISTINCT_M, DISTINCT_RAD
from graphslam.scan_smoothing.localisation import start_of_closed_path

LAID = np.array([20.0, 6.0, 0.1])


def laid_with(sigmas):
    """A path that begins at `LAID`, known to ``sigmas`` there."""
    states = Trajectory(np.array([0]), LAID[None], np.full((1, 3, 3), np.nan))
    cov = np.diag(np.square(sigmas))
    return SimpleNamespace(states={"robot": states}, start_covariance=lambda robot: cov)


@pytest.mark.parametrize("sigmas", [(4.0, 8.6, 0.77), (1e3, 1e3, 3.0)])
def test_it_is_known_to_what_other_hypotheses_are_told_from(sigmas):
    """By the few places that were recognised it was known to 8 m: loops were then looked for, and
    found, 13 m off in a building of equal rooms, though the path as laid fitted where it was."""
    found = start_of_closed_path(laid_with(sigmas), "robot")
    np.testing.assert_array_equal(found.pose, LAID)
    largest = np.sqrt(np.diag(found.cov))
    assert (largest <= [DISTINCT_M, DISTINCT_M, DISTINCT_RAD]).all()
    assert (largest > np.multiply([DISTINCT_M, DISTINCT_M, DISTINCT_RAD], 0.7)).all()


def test_it_is_as_wide_as_its_scans_may_enter_again():
    """Loops are not looked for a door farther on, as by what the first places say, to a metre."""
    sigmas = np.array([0.02, 0.01, 0.003])
    found = start_of_closed_path(laid_with(sigmas), "robot")
    # what was told apart takes off a fiftieth at most
    np.testing.assert_allclose(np.sqrt(np.diag(found.cov)), PRIOR_INFLATION * sigmas, rtol=0.02)
