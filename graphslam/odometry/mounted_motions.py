"""Motions of a frame that is mounted on a moving body, with their errors."""

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, compose_jacobians, rotation3
from graphslam.core.motion_models import mounted_motion


def of_mount(
    delta: Array, cov: Array, d_cal: Array, mount: Array, by_latency: Array | None
) -> tuple[Array, Array, Array]:
    """Motion, covariance, derivative of a frame at ``mount`` (..., 3) in a body that so moves.

    Args:
        delta: (..., 3) motion of the body.
        cov: (..., 3, 3) its covariance.
        d_cal: (..., 3, p) its derivative by the calibration. It gains columns for the mount and,
            unless ``by_latency`` is None, for the latency.
        mount: pose (..., 3) of the frame in the body.
        by_latency: (..., 3) derivative of the body's motion, /s.
    """
    moved, d_mount = mounted_motion(delta, mount)
    late = [] if by_latency is None else [by_latency[..., None]]
    if mount.any():  # else there is no lever, as with most sensors
        lever = lever_to(delta, mount)
        cov, d_cal, late = lever @ cov @ lever.mT, lever @ d_cal, [lever @ d for d in late]
    return moved, cov, np.concatenate([d_cal, d_mount, *late], axis=-1)


def lever_to(delta: Array, mount: Array) -> Array:
    """Errors of a body's motion, as they move a frame mounted on it: (..., 3, 3), its lever arm."""
    return np.asarray(rotation3(-mount[..., 2]) @ compose_jacobians(delta, mount)[0])


def calibration_covs(d_cal: Array, known: Array, which: IntArray) -> Array:
    """Covariances (m, 3, 3) of motions by the errors of their calibrations.

    Args:
        d_cal: (m, 3, p) derivatives of the motions.
        known: (k, p, p) covariances of the calibrations.
        which: (m,) the calibration of each motion.
    """
    if len(known) == 1:  # one product of all rows, instead of many small ones
        rows = d_cal.reshape(3 * len(d_cal), d_cal.shape[2])
        weighed = (rows @ known[0]).reshape(d_cal.shape)
    else:
        weighed = d_cal @ known[which]
    return np.asarray(weighed @ d_cal.mT)
