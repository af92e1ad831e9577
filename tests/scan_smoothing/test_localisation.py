"""A start that was found, once the whole drive was laid into the map from it."""

from types import SimpleNamespace

import numpy as np
import pytest

from graphslam.core.frame_forest import PRIOR_INFLATION
from graphslam.core.records import Start, Trajectory
from graphslam.multi_robot.place_search import DISTINCT_M, DISTINCT_RAD
from graphslam.scan_smoothing.localisation import is_contradicted, start_of_closed_path

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


@pytest.mark.parametrize(("off_m", "is_wrong"), [(0.15, False), (0.5, True)])
@pytest.mark.parametrize("is_used", [True, False])
def test_a_told_start_is_contradicted_alike_whether_the_solution_has_it_or_not(
    off_m, is_wrong, is_used
):
    """0.1 m was told, and all else knows 0.05 m: chi-square of 16.27 at 99.9 % is reached 0.45 m
    off. A solution that has the start lies a fifth of the way to it, and is known better: taken for
    one that has not, half a metre would pass."""
    given = Start(LAID, np.diag([0.1, 0.1, 0.01]) ** 2)
    pose, cov = LAID + np.array([off_m, 0.0, 2 * np.pi]), np.diag([0.05, 0.05, 0.005]) ** 2
    if is_used:
        gain = cov @ np.linalg.inv(cov + given.cov)
        pose = pose + gain @ np.array([-off_m, 0.0, 0.0])
        cov = cov - gain @ cov
    assert is_contradicted(given, pose, cov, is_used=is_used) == is_wrong


def test_a_solution_that_knows_no_more_than_the_told_start_does_not_contradict_it():
    """Along a corridor the path begins where it is told to, but for rounding."""
    given = Start(LAID, np.diag([0.1, 0.1, 0.01]) ** 2)
    cov = given.cov * np.array([1 - 1e-9, 0.1, 0.1])
    assert not is_contradicted(given, LAID + np.array([1e-6, 0.0, 0.0]), cov, is_used=True)
