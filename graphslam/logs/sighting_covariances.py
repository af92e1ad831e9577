"""Covariances of sightings: those that messages state, and a beginning where they state none.

Drivers that do not know how good they are leave the covariance zero, which in ROS messages means
unknown. Such sightings begin with what cameras and lasers commonly have; what they are used with is
measured in the log (`sighting_smoothing.sighting_noise`).
"""

from collections.abc import Sequence

import numpy as np

from graphslam.core.arrays import BoolArray
from graphslam.core.geometry import Array, are_positive
from graphslam.logs import physical_limits as limits

#: rad, sigmas of bearing and of direction where none are stated
BEARING_RAD, DIRECTION_RAD = 0.03, 0.1
#: of range: m, and its share of the range
RANGE_M, RANGE_SHARE = 0.03, 0.03


def states_none(measured: Array, covs: Array) -> BoolArray:
    """Which of covariances (n, 9), as in messages, are not filled in: all zero, or all NaN.

    ``measured`` (n, 3): only what is measured counts; a direction that is not is NaN.
    """
    is_point = np.isnan(measured[:, 2])
    rest = np.isin(np.arange(9), (0, 1, 3, 4), invert=True)
    ignored = is_point[:, None] & rest
    zero, nan = (covs == 0.0) | ignored, np.isnan(covs) | ignored
    return np.asarray(zero.all(axis=1) | nan.all(axis=1))


def common_covariance(z: Array) -> Array:
    """Covariance (k, k) that a sighting ``z`` (k,) begins with: bearing, range, maybe direction."""
    sigmas = np.array([BEARING_RAD, np.hypot(RANGE_M, RANGE_SHARE * z[1]), DIRECTION_RAD])
    cov = np.diag(sigmas[: len(z)] ** 2)
    cov.flags.writeable = False
    return cov


def polar_covariances(measured: Array, covs: Array) -> tuple[Sequence[Array], list[bool]]:
    """Covariances (2, 2) of bearings and ranges, and which of the sightings can be used for sure.

    The conditions of `checked_covariance` and `check_sighting`, of all at once: most sightings
    hold them. Those two say what is wrong with the others, and judge those with a direction.
    ``measured`` (n, 3): bearing, range and maybe direction; ``covs`` (n, 9): what they state.
    """
    full = covs.reshape(-1, 3, 3)[:, :2, :2]
    full = (full + full.mT) / 2
    variances = np.diagonal(full, axis1=1, axis2=2)
    usable = (
        np.isnan(measured[:, 2])
        & np.isfinite(measured[:, 0])
        & (measured[:, 1] > 0)
        & (measured[:, 1] <= limits.MAX_SIGHTING_M)
        & are_positive(full)
        & (variances.min(axis=1) >= limits.MIN_VARIANCE)
        & (variances.max(axis=1) <= limits.MAX_SIGHTING_VARIANCE)
    )
    full.flags.writeable = False
    # sensors mostly state the same one, so messages share it
    shared = [full[0]] * len(full) if (full == full[0]).all() else list(full)
    return shared, usable.tolist()
