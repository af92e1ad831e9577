"""The joint covariance of the points of a log of sightings, for logs that come later.

A known map is a joint Gaussian of landmarks. Of scans it follows from the root of all states; of
sightings there may be a state at every one of them, so just that of the points is kept.
"""

from collections.abc import Sequence

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.information_root import InformationRoot
from graphslam.core.record import replace
from graphslam.core.records import Estimate
from graphslam.sighting_smoothing.state_at_every_sighting import FineSolution

#: points of a log at most: the time grows with their number times that of the states
MOST_POINTS = 400


def with_joint_landmarks(found: FineSolution) -> Estimate:
    """The estimate of a solution, with the root of what is known of its points alone.

    None is made of lines, and of more than `MOST_POINTS`.
    """
    estimate = found.estimate
    numbers = sorted(estimate.landmarks)
    is_of_points = all(len(mean) == 2 for mean, _ in estimate.landmarks.values())
    if not (is_of_points and 0 < len(numbers) <= MOST_POINTS):
        return estimate
    return replace(estimate, root=_dense_root(joint_covariance(found, numbers), numbers))


def joint_covariance(found: FineSolution, points: Sequence[int]) -> Array:
    """Covariance (2n, 2n) m² of n points of a solution, along world axes.

    Where sightings share errors, or sensors have some, points are known less well than the graph
    that was solved says. So its covariance is widened point by point.
    """
    cov = found.solved.joint(points, in_world=True).cov[3:, 3:]
    wider = np.zeros_like(cov)
    for k, point in enumerate(points):
        block = slice(2 * k, 2 * k + 2)
        half = np.linalg.cholesky(cov[block, block])
        own = np.linalg.cholesky(found.estimate.landmarks[point][1])
        wider[block, block] = own @ np.linalg.inv(half)
    return wider @ cov @ wider.T


def _dense_root(cov: Array, numbers: list[int]) -> InformationRoot:
    """One clique of points with this covariance (2n, 2n)."""
    rows = len(cov)
    R = np.linalg.cholesky(np.linalg.inv(cov)).T
    none = np.zeros(0, dtype=np.int64)
    one = np.ones(1, dtype=np.int64)
    landmarks = {number: 2 * k for k, number in enumerate(numbers)}
    return InformationRoot(-one, rows * one, 0 * one, none, R.ravel(), {}, landmarks)
