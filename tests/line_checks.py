"""Observed lines against the walls that they were seen of."""

import numpy as np

from graphslam.core.geometry import rotate_cov, transform, wrap


def ends(observation):
    """End points (2, 2), first the one that the line's direction comes from."""
    along = np.stack([observation.extent, np.zeros(2)], axis=1)
    return transform(observation.z, along)


def near(observations, wall, tolerance=0.05):
    """The observations that lie on a wall (2, 2)."""
    a, b = np.asarray(wall, float)
    normal = np.array([a[1] - b[1], b[0] - a[0]]) / np.hypot(*(b - a))
    return [o for o in observations if np.all(np.abs((ends(o) - a) @ normal) < tolerance)]


def normal_error(observation, wall):
    """(offset along the observed line's left, direction) of an observation against a wall."""
    a, b = np.asarray(wall, float)
    truth = np.arctan2(b[1] - a[1], b[0] - a[0])
    left = np.array([-np.sin(truth), np.cos(truth)])
    return np.array([(observation.z[:2] - a) @ left, wrap(observation.z[2] - truth)])


def normal_cov(observation):
    """Covariance (2, 2) of (normal, direction) in the line's own frame."""
    return rotate_cov(observation.cov, -observation.z[2])[1:, 1:]
