"""Landmarks that are first seen under a false name are where they are mostly seen."""

import numpy as np
import pytest

from graphslam.core.config import RobustConfig
from graphslam.core.records import Association, Estimate, Step, Trajectory
from graphslam.sighting_smoothing.misplaced_landmarks import with_landmarks_placed_again

S = 1_000_000_000
COV = np.diag([1e-4, 9e-4])
TRUE, FALSE = np.array([2.0, 1.0]), np.array([-1.0, 3.0])


def seen_from(poses, places):
    """A step for each pose (n, 3), from which one landmark is seen at a place (n, 2)."""
    steps = []
    for k, (pose, place) in enumerate(zip(poses, places, strict=True)):
        x, y = place - pose[:2]
        z = np.array([np.arctan2(y, x) - pose[2], np.hypot(x, y)])
        one = Association("tom", k * S, 0, "point", z, COV, source=k)
        steps.append(Step(k * S, {}, {}, (one,)))
    return tuple(steps)


def placed(number_false, at, kernel="cauchy", n=20):
    """Where the landmark is that was at ``at``, with some sightings of another one first."""
    poses = np.column_stack([np.linspace(-1, 1, n), np.zeros((n, 2))])
    places = np.where(np.arange(n)[:, None] < number_false, FALSE, TRUE)
    states = {"tom": Trajectory(np.arange(n) * S, poses, np.zeros((n, 3, 3)))}
    estimate = Estimate(states, {0: (at, np.eye(2))}, 0.0, 0)
    kernel = RobustConfig(kernel)
    found = with_landmarks_placed_again(seen_from(poses, places), estimate, kernel)
    return found.landmarks[0][0]


def test_a_landmark_goes_where_most_of_its_sightings_are():
    assert placed(3, FALSE) == pytest.approx(TRUE)


@pytest.mark.parametrize("off_m", [0.0, 0.02])
def test_a_landmark_that_is_where_it_is_seen_stays(off_m):
    """To the bit, as do the results of logs without gross errors."""
    at = TRUE + off_m
    assert np.array_equal(placed(3, at), at)


def test_without_a_kernel_landmarks_stay():
    """The estimate is a mean then, and the solution that follows is the same from anywhere."""
    assert np.array_equal(placed(3, FALSE, "none"), FALSE)
