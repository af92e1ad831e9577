"""Noise of a robot's odometry, from the residuals of its motions in a solution.

The model is that of `model_error_cov`: variances that grow with path, turning and time in motion.
Its nine rates are fitted to the squared residuals, each divided by what the solution has left of
its variance (iterated almost unbiased estimation: S. D. Horn, R. A. Horn and D. B. Duncan,
Estimating heteroscedastic variances in linear models, JASA 70, 1975, DOI
10.1080/01621459.1975.10479891).
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import OdometryConfig
from graphslam.core.geometry import Array
from graphslam.core.motion_models import RATES, rates_of_config, with_rates
from graphslam.core.non_negative import non_negative_least_squares
from graphslam.odometry.increment_sums import transformed
from graphslam.odometry.integration_windows import Asked
from graphslam.odometry.mounted_motions import lever_to
from graphslam.odometry.path_sums import numbered_times, path_sums
from graphslam.odometry.preintegration import Track, preintegrate_batch

#: sigma of the logarithm of an unknown variance, before any data: a factor of ten
PRIOR_LOG_SIGMA = math.log(10.0)
#: m, rad: floors of short motions; that of positions is above what cutting readings leaves out
FLOOR_M, FLOOR_RAD = 5e-4, 1e-4
#: residuals are cut at so many of their own sigmas: slip is left to the solution
CLIP_SIGMAS = 3.0
#: motions whose variances by nine rates are computed at once, and readings in them, at most
BLOCK, READINGS = 1000, 20_000
#: a step beyond that of the residuals by themselves changes a variance by such a factor at most
FARTHEST = 4.0
#: a median of absolute values, as the sigma of a normal variable
SIGMA_OF_MEDIAN = 1.4826


def is_stated(track: Track) -> bool:
    """Whether the log or the settings say how noisy a track is."""
    default = OdometryConfig()
    return track.source == "given" or any(
        getattr(track.config, name) != getattr(default, name) for name in RATES
    )


def without_floors(config: OdometryConfig) -> OdometryConfig:
    """Settings by which the noise of an interval is that of its parts, however short they are."""
    return replace(config, floor_sigma_m=FLOOR_M, floor_sigma_rad=FLOOR_RAD)


def without_noise(config: OdometryConfig) -> OdometryConfig:
    """Settings without noise of odometry and without floors."""
    return without_floors(with_rates(config, np.zeros(len(RATES))))


def fit_noise(
    config: OdometryConfig,
    known: Array,
    gained: Array,
    variances: Array,
    normalised: Array,
    redundancy: Array,
    *,
    relax: bool,
) -> tuple[OdometryConfig, Array]:
    """Settings of a track with the noise that its motions show, without floors.

    Where this no longer changes them they have the largest restricted likelihood, with a prior: the
    mean variance along each axis is that of the default settings within `PRIOR_LOG_SIGMA`. Without
    it, where nothing contradicts the motions along an axis, the noise there would be what the last
    of many repetitions leaves of it.

    Args:
        config: of a track that does not state its noise.
        known: variances (n, 3) of the motions by `without_noise`.
        gained: (n, 3, 9) what they gain by each rate, see `variances_by_rate`.
        variances: (n, 3) of the noise by which the motions were solved.
        normalised: (n, 3) residuals by this noise, see `Residuals`.
        redundancy: (n, 3) see `Residuals`.
        relax: whether to go farther, as other fits follow until nothing changes.

    Returns:
        The settings, and the variances (n, 3) of the motions by them.
    """
    bare = without_noise(config)
    moved = gained.any(axis=(1, 2))
    if not moved.any():
        return bare, known
    C, R, least, left = gained[moved], variances[moved], known[moved], redundancy[moved]
    squared = clipped(normalised[moved]) ** 2  # expected: true variance / R
    default = least + C @ rates_of_config(OdometryConfig())
    # the logarithm of the variance, linear around R
    likely = 1.0 - np.mean(np.log(R / default), axis=0)
    prior = 2.0 / PRIOR_LOG_SIGMA**2
    weight = np.sqrt(np.concatenate([left, np.full(R.shape, prior / len(R))]))
    b = np.concatenate([squared - least / R, likely - least / R]) * weight
    A = np.concatenate([C / R[:, :, None]] * 2) * weight[:, :, None]
    x = _non_negative(A.reshape(-1, len(RATES)), b.ravel())
    if relax:
        before = np.maximum(np.mean(1.0 - least / R, axis=0), 1e-9)
        ratio = np.clip(np.mean(C @ x / R, axis=0) / before, 1.0 / FARTHEST, FARTHEST)
        x *= np.repeat(ratio ** _farther(left, prior), 3)
    return with_rates(bare, x), known + gained @ x


def _farther(left: Array, prior: float) -> Array:
    """Exponents (3,) of a step beyond that in which each residual tells of its own noise alone.

    With M the share of all measurements' errors in the residuals, Σ M_ij² over the motions of an
    axis is how much these tell of its noise, where the step counts Σ M_ii: at most that, and at
    least Σ M_ii². With a share c of it the step leaves 1 - c of the way, f times the step
    |1 - f c|: for any such c least with f = 2 / (1 + least c).
    """
    counted = left.sum(axis=0) + prior
    least = ((left**2).sum(axis=0) + prior) / counted
    return np.asarray((1.0 - least) / (1.0 + least))


def variance_sigma(redundancy: Array) -> Array:
    """Sigma (3,) of the logarithm of the mean variance along each axis: at least that.

    Args:
        redundancy: (n, 3) of the residuals that it is estimated from, see `_farther`.
    """
    return np.asarray(1.0 / np.sqrt(redundancy.sum(axis=0) / 2.0 + PRIOR_LOG_SIGMA**-2))


def with_fit_uncertainty(config: OdometryConfig, log_sigma: Array) -> OdometryConfig:
    """Settings with rates enlarged for the uncertainty of their fit, so that NEES is 1 on average.

    A variance that ν residuals show is too small as often as too large, and where it is too small
    errors are out of all proportion: divided by it, they are squared ν / (ν - 2) on average. With
    few residuals (ν is two over the squared sigma of the logarithm) that is far from 1. The
    exponential, the same to first order, stays finite. It counts as far as the variance is that of
    the residuals: where they tell nothing it is that of the default, which is as large as it is
    meant to be.

    Args:
        config: settings as fitted.
        log_sigma: (3,) of the mean variances along x, y and of turning, see `variance_sigma`.
    """
    rates = rates_of_config(config)
    by_residuals = 1.0 - (log_sigma / PRIOR_LOG_SIGMA) ** 2
    return with_rates(config, rates * np.repeat(np.exp(log_sigma**2 * by_residuals), 3))


def rates_of(twists: Array, seconds: Array, variances: Array) -> Array:
    """The rates (9,), in the order of `RATES`, by which motions have given variances.

    Args:
        twists: (n, 3) m and rad, all of robots in motion.
        seconds: (n,) that they take.
        variances: (n, 3) along x, y and of turning.
    """
    A = np.column_stack([np.hypot(twists[:, 0], twists[:, 1]), np.abs(twists[:, 2]), seconds])
    # relative errors count, so that each part of a log does
    each = [_non_negative(A / v[:, None], np.ones(len(v))) for v in variances.T]
    return np.concatenate(each)


def clipped(normalised: Array) -> Array:
    """Residuals (n, k) cut at `CLIP_SIGMAS` of the sigmas that their medians show."""
    cut = CLIP_SIGMAS * SIGMA_OF_MEDIAN * np.median(np.abs(normalised), axis=0)
    return np.asarray(np.clip(normalised, -cut, cut))


def motion_variances(
    asked: Sequence[Asked[Track]], configs: Sequence[OdometryConfig]
) -> list[Array]:
    """Variances (n, 3) of the motions of different tracks along their axes by other settings."""
    before = [(track.config, track.calibration) for track, _, _ in asked]
    try:
        for (track, _, _), config in zip(asked, configs, strict=True):
            track.config, track.calibration = config, track.calibration.held()
        covs = [motions.cov for motions in preintegrate_batch(asked)]
        return [np.diagonal(cov, axis1=1, axis2=2).copy() for cov in covs]
    finally:
        for (track, _, _), (config, calibration) in zip(asked, before, strict=True):
            track.config, track.calibration = config, calibration


def variances_by_rate(track: Track, start_ns: IntArray, end_ns: IntArray) -> Array:
    """What the variances (n, 3) of motions gain by each rate of `RATES`, (n, 3, 9).

    Args:
        track: odometry of two readings at least.
        start_ns: (n,) in ascending order.
        end_ns: (n,) later than these.
    """
    found = [np.zeros((0, 3, len(RATES)))]
    # nine covariances of every reading in between
    passed = np.searchsorted(track.times, start_ns)
    number = np.arange(len(start_ns)) // BLOCK + (passed - passed[:1]) // READINGS
    for block in np.split(np.arange(len(start_ns)), np.flatnonzero(np.diff(number)) + 1):
        start, end = start_ns[block], end_ns[block]
        start, end, mount = track.odometry_spans(start, end)
        times, *ends = numbered_times([start], [end])
        sums, _ = path_sums([track], times, by_rate=True)
        motions = sums.motions_between(*ends)
        covs = motions.cov
        if mount.any():
            covs = transformed(covs, lever_to(motions.delta, mount))
        found.append(np.diagonal(covs, axis1=2, axis2=3).mT)
    return np.concatenate(found)


def _non_negative(A: Array, b: Array) -> Array:
    """Least squares A x = b with x ≥ 0."""
    scale = np.linalg.norm(A, axis=0)
    scale[scale == 0] = 1.0
    # nine unknowns, tens of thousands of rows
    q, root = np.linalg.qr(A / scale)
    return np.asarray(non_negative_least_squares(root, q.T @ b) / scale)
