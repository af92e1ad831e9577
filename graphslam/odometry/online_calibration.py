"""Online calibration: odometry and mount parameters by recursive least squares.

A wrong wheel radius is one constant of the whole run. If it is not modelled, part of it leaks into
the heading whenever tracking passes from landmarks to new ones, and the map bends. So after every
state the estimated motion is compared with that of odometry, and a recursive least-squares filter
estimates the parameters that explain the difference (thesis 4.8-4.13 has the derivatives, but
treats the errors as white). The estimated motion itself is biased towards odometry by some per
cent; since the parameters are applied to the next motions, that bias decays geometrically.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from graphslam.core.config import OdometryConfig
from graphslam.core.gaussian import chi2_quantile, mahalanobis_squared, solve
from graphslam.core.geometry import Array, compose, wrap
from graphslam.core.motion_models import (
    HELD_SIGMA,
    MOUNT_NAMES,
    Calibration,
    several_lasers,
)
from graphslam.core.observation_models import MODELS
from graphslam.core.record import replace
from graphslam.core.records import Association, Contradiction, Motion
from graphslam.odometry.calibration_jacobian import CalibratedSource, at_estimated_motion
from graphslam.odometry.contradicted_motions import ContradictedMotions, calibration_floor
from graphslam.odometry.far_calibration import explain, widened
from graphslam.odometry.online_noise import NoiseEvidence, ShownNoise, scaled

#: weight of the past per state: the memory is about 1 / (1 - FORGETTING_FACTOR) states, so that
#: parameters may change slowly (tyres warm up)
FORGETTING_FACTOR = 0.995
#: share of the prior sigma that always remains in a motion's covariance, as parameters may change
MIN_SIGMA_SHARE = 0.5
#: squared Mahalanobis distance beyond which a difference is no calibration error but a jump of the
#: estimate (a loop closure) or a slip
OUTLIER_D2 = float(chi2_quantile(0.999, 3))
#: times that a calibration and the width of its prior are found in turn
WIDENINGS = 4
#: contradicted motions that are kept until a calibration explains them
MOST_CONTRADICTED = 50
#: times that motions are left out as outliers, by the noise that the others show
GATINGS = 2
#: no laser's mount is told
NOTHING_TOLD: Mapping[str, Array] = MappingProxyType({})


class Calibrator:
    """Recursive least squares over one robot's motions.

    ``wider``: prior of the calibration, see `widened`, if motions that scans contradict tell that
    it is far from the one before any data.
    """

    def __init__(self, config: OdometryConfig, *, is_noise_known: bool = False) -> None:
        """Nothing learnt yet.

        ``is_noise_known``: odometry is as noisy as motions say; derivatives are as measured.
        """
        self._floor, self._noise = calibration_floor(config), NoiseEvidence.none()
        self._is_noise_known = is_noise_known
        self._before: Calibration | None = None
        self._info: Array = np.zeros((0, 0))
        self._prior_info: Array = np.zeros((0, 0))
        self._vector = np.zeros(0)
        self._contradicted = ContradictedMotions.none()
        self.wider: Calibration | None = None

    @property
    def noise_scale(self) -> Array:
        """By how much (3,) variances of the noise of odometry are larger than stated."""
        return self._noise.scale

    def update(
        self, source: CalibratedSource, motion: Motion, moved: Array, observed: Array
    ) -> Calibration:
        """The calibration after one more motion.

        Args:
            source: what ``motion`` was made with.
            motion: according to odometry.
            moved: (3,) the same motion according to the estimate, in the frame of its start.
            observed: (3, 3) information about the motion's end that came from landmarks, along the
                axes of its start. Without any, the estimate equals the odometry and the
                calibration is not updated.

        Returns:
            Mean, and the covariance to be used for coming motions.
        """
        D, current = motion.d_delta_d_calibration, source.calibration
        if motion.contradiction is not None and current.names:
            return self._with_contradiction(source, motion.contradiction)
        if motion.from_scans or not D.shape[1] or (motion.length_m == 0 and motion.delta[2] == 0):
            return current
        before = self._begin(current)
        miss = moved - motion.delta
        miss[2] = wrap(miss[2])
        white = motion.cov - D @ current.cov @ D.T
        total = self._noise.applied(white) + D @ before.cov @ D.T + self._floor
        if miss @ solve(total, miss) > OUTLIER_D2 or not observed.any():
            return current
        if not self._is_noise_known:
            self._learn_noise(miss, white, motion.cov, observed)
            D = self._derivative_at_likeliest(source, motion, miss, white)
        # (noise + observed⁻¹)⁻¹, for an information matrix that may be singular
        noise = self._noise.applied(white) + self._floor
        W = solve(np.eye(3) + observed @ noise, observed)
        weighted = D.T @ W
        # relative to nominal values: the remaining error plus the present correction
        past = FORGETTING_FACTOR
        self._info = past * self._info + (1 - past) * self._prior_info + weighted @ D
        self._vector = past * self._vector + weighted @ (miss + D @ current.mean)
        return self._solved(before)

    def _begin(self, before: Calibration) -> Calibration:
        """Take a calibration as that before any data, if there is none yet; the one there is."""
        if self._before is None:
            self._before = replace(before, mean=np.zeros(len(before.mean)))
            self._prior_info = np.asarray(np.linalg.inv(before.cov), dtype=np.float64)
            self._info, self._vector = self._prior_info, np.zeros(len(before.mean))
            self._contradicted = ContradictedMotions.none()
        return self._before

    def _solved(self, before: Calibration) -> Calibration:
        """The calibration by all that is known, and the covariance to be used for motions."""
        found = self._found(before)
        return replace(found, cov=found.cov + MIN_SIGMA_SHARE**2 * before.cov)

    def _found(self, before: Calibration) -> Calibration:
        cov = solve(self._info, np.eye(len(self._info)))
        return Calibration(before.names, cov @ self._vector, cov)

    def _with_contradiction(self, source: CalibratedSource, found: Contradiction) -> Calibration:
        """The calibration, with a motion that scans contradict, if one explains it and others."""
        before = self._begin(source.calibration)
        known = self._contradicted.with_motions([found], source, self._noise.scale)
        told = explain(known, self._info, self._found(before).mean, before)
        if told is None:
            self._contradicted = known.those(slice(-MOST_CONTRADICTED, None))
            return source.calibration
        self._contradicted = known.those(~told.used)
        self._info, self._vector = self._info + told.information, self._vector + told.vector
        self.wider = widened(before, self._found(before))
        information = np.asarray(np.linalg.inv(self.wider.cov), dtype=np.float64)
        self._info = self._info + information - self._prior_info
        self._prior_info = information
        return self._solved(before)

    def _learn_noise(self, miss: Array, white: Array, cov: Array, observed: Array) -> None:
        """Take in how noisy one motion shows odometry to be."""
        moved_cov = solve(np.eye(3) + cov @ observed, cov)
        each = (one[None] for one in (miss, white, cov - white, observed, moved_cov))
        used = np.ones(1, dtype=np.bool_)
        self._noise = self._noise.with_motions(ShownNoise.of(*each), used, FORGETTING_FACTOR)

    def _derivative_at_likeliest(
        self, source: CalibratedSource, motion: Motion, miss: Array, white: Array
    ) -> Array:
        """Derivative (3, p) at the likeliest motion: the estimate is not without error either."""
        cov = self._noise.applied(white) + motion.cov - white
        likeliest = motion.delta + cov @ solve(cov + self._floor, miss)
        delta, d_cal = motion.delta[None], motion.d_delta_d_calibration[None]
        return np.asarray(at_estimated_motion(source, delta, d_cal, likeliest[None])[0])

    def restart(self, prior: Calibration, found: Calibration) -> Calibration:
        """Go on from a calibration that was estimated together with all states so far.

        Args:
            prior: before any data.
            found: with its own covariance.

        Returns:
            See `update`.
        """
        self._before = None
        self._begin(prior)
        self._info = np.asarray(np.linalg.inv(found.cov), dtype=np.float64)
        self._vector = self._info @ found.mean
        return replace(found, cov=found.cov + MIN_SIGMA_SHARE**2 * prior.cov)

    def summary(
        self, told: Mapping[str, Array] = NOTHING_TOLD
    ) -> dict[str, tuple[float, float, bool]]:
        """The estimate from the data so far, see `to_summary`.

        The sigma refers to the memory of the filter, and to what `restart` was given.
        """
        if self._before is None:
            return {}
        return to_summary(self._found(self._before), self._before.cov, told)


@dataclass(frozen=True, slots=True, eq=False)
class Learnt:
    """What a drive so far tells: the calibration, and a factor (3,) on variances of odometry.

    ``prior``: of the calibration; ``is_far``: it is wider than stated, see `widened`.
    """

    calibration: Calibration
    noise_scale: Array
    prior: Calibration
    is_far: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class TrackedMotions:
    """Motions (n) of one robot according to odometry and after tracking.

    ``delta`` (n, 3) and ``cov`` (n, 3, 3) are those of odometry by the calibration of a ``source``,
    whose covariance is part of ``cov``; ``d_cal`` (n, 3, p) is the derivative by its p parameters.
    ``moved`` (n, 3) and ``moved_cov`` (n, 3, 3) are the estimates from odometry and landmarks
    together. All along the axes of each start. ``noise_scale`` (3,): by how much the variances of
    the noise in ``cov`` are larger than stated.
    """

    delta: Array
    cov: Array
    d_cal: Array
    source: CalibratedSource
    noise_scale: Array
    moved: Array
    moved_cov: Array


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationEvidence:
    """What motions tell about the p parameters: information (p, p), and that times the mean (p,).

    Both are sums over motions. ``noise``: what the same motions tell of the noise of odometry.
    ``contradicted``: motions that scans contradict, which count if a calibration explains them.
    """

    information: Array
    vector: Array
    noise: NoiseEvidence
    contradicted: ContradictedMotions

    @classmethod
    def none(cls, parameters: int) -> "CalibrationEvidence":
        """Nothing is known."""
        nothing = np.zeros(parameters)
        return cls(np.diag(nothing), nothing, NoiseEvidence.none(), ContradictedMotions.none())

    def with_contradictions(
        self, found: Sequence[Contradiction], source: CalibratedSource
    ) -> "CalibrationEvidence":
        """The same with motions that scans contradict, made by the calibration of a source."""
        contradicted = self.contradicted.with_motions(found, source, self.noise.scale)
        return replace(self, contradicted=contradicted)

    def with_motions(self, found: TrackedMotions, config: OdometryConfig) -> "CalibrationEvidence":
        """The same with further tracked motions, by how they differ from those of odometry.

        What landmarks alone say about a motion is what the estimate knows beyond odometry:
        information O = P⁻¹ - Q⁻¹ for covariances P after tracking and Q of odometry, and
        O (z - m) = P⁻¹ (moved - m) for its own measurement z. Motions that are far off (slip) do
        not count.

        Where odometry is noisier than stated, motions after tracking follow its noise, which a
        scale of -1 would explain. So the noise is measured first, and the derivatives are those at
        the likeliest motion by it.
        """
        miss = found.moved - found.delta
        miss[:, 2] = wrap(miss[:, 2])
        D, calibration, floor = found.d_cal, found.source.calibration, calibration_floor(config)
        after = np.linalg.inv(found.moved_cov)
        seen = after - np.linalg.inv(found.cov)
        values, axes = np.linalg.eigh(0.5 * (seen + seen.mT))
        seen = (axes * np.maximum(values, 0.0)[:, None]) @ axes.mT
        by_calibration = D @ calibration.cov @ D.mT
        white = scaled(found.cov - by_calibration, 1.0 / found.noise_scale)
        shown = ShownNoise.of(miss, white, by_calibration, seen, found.moved_cov)
        noise = self.noise
        for _ in range(GATINGS):
            cov = noise.applied(white) + by_calibration + floor
            used = mahalanobis_squared(miss, cov) <= OUTLIER_D2
            noise = self.noise.with_motions(shown, used)
        white = noise.applied(white)
        told = after @ miss[:, :, None]  # O (z - m)
        # both for landmarks that are off by the floor
        less = np.linalg.inv(np.eye(3) + seen @ floor)
        likeliest = np.linalg.inv(less @ seen + np.linalg.inv(white + by_calibration))
        moved = found.delta + (likeliest @ (less @ told))[:, :, 0]
        D = at_estimated_motion(found.source, found.delta, D, moved)[used]
        gain = np.linalg.inv(np.eye(3) + seen @ (white + floor))[used]
        W, weighted = gain @ seen[used], gain @ told[used]
        vector = D.mT @ (weighted + W @ (D @ calibration.mean)[:, :, None])
        return CalibrationEvidence(
            self.information + (D.mT @ W @ D).sum(axis=0),
            self.vector + vector.sum(axis=0)[:, 0],
            noise,
            self.contradicted,
        )


def learnt_from_evidence(known: CalibrationEvidence, prior: Calibration) -> Learnt:
    """The calibration that explains best what motions tell, by least squares.

    Its covariance is the one to be used for motions, see `MIN_SIGMA_SHARE`.
    """
    free = np.flatnonzero(np.diag(prior.cov) > HELD_SIGMA**2)
    if not len(free):
        return Learnt(prior, known.noise.scale, prior)
    block = np.ix_(free, free)
    held = np.setdiff1d(np.arange(len(prior.mean)), free)
    told = known.vector[free] - known.information[np.ix_(free, held)] @ prior.mean[held]
    wider = prior
    for _ in range(WIDENINGS):
        before = np.linalg.inv(wider.cov[block])
        information, vector = before + known.information[block], before @ prior.mean[free] + told
        mean, about, cov = prior.mean.copy(), np.zeros_like(prior.cov), np.linalg.inv(information)
        mean[free], about[block] = cov @ vector, information
        also = explain(known.contradicted, about, mean, prior)
        if also is None:
            wider = prior
            break
        cov = np.linalg.inv(information + also.information[block])
        mean[free] = cov @ (vector + also.vector[free])
        wider = widened(prior, replace(prior, mean=mean))
    all_cov = prior.cov.copy()
    # between states of two lasers the mounts' covariance enters every motion, as if it were fresh
    rigid = [several_lasers(prior) and "laser_" in prior.names[k] for k in free]
    share = np.where(rigid, 0.0, MIN_SIGMA_SHARE)
    all_cov[block] = cov + share[:, None] * prior.cov[block] * share
    found = Calibration(prior.names, mean, all_cov)
    return Learnt(found, known.noise.scale, wider, wider is not prior)


def to_summary(
    known: Calibration, prior: Array, told: Mapping[str, Array] = NOTHING_TOLD
) -> dict[str, tuple[float, float, bool]]:
    """Parameter -> (value, sigma, observable); ``prior`` (p, p) is the covariance before data.

    Observable: the data at least halve the prior's sigma. A parameter that is held has sigma 0.
    ``told``: laser ("" the first) -> its mount (3,) according to the log. The mount that is found
    is then told plus value, also where the yaw is off: see `_deviations`.
    """
    held = np.sqrt(np.diag(prior)) < HELD_SIGMA
    J, known = _deviations(known, held, told)
    known = replace(known, cov=J @ known.cov @ J.T)
    sigmas, before = (np.sqrt(np.diag(cov)) for cov in (known.cov, J @ prior @ J.T))
    sigmas[held] = 0.0
    seen = ~held & (sigmas < 0.5 * before)
    return {
        name: (float(value), float(sigma), bool(observable))
        for name, value, sigma, observable in zip(
            known.names, np.where(held, 0.0, known.mean), sigmas, seen, strict=True
        )
    }


def _deviations(
    known: Calibration, held: np.ndarray[Any, np.dtype[np.bool_]], told: Mapping[str, Array]
) -> tuple[Array, Calibration]:
    """A calibration whose mounts are deviations from those told, and its derivative by the former.

    The error of a mount is estimated as a pose in the base, in front of what the log says: a yaw
    turns the laser about the base's origin. Where the yaw is estimated and x or y is held, it stays
    so: otherwise the held one would move.
    """
    J, mean = np.eye(len(known.mean)), known.mean.copy()
    for sensor, mount in told.items():
        names = [f"{sensor}.{name}" if sensor else name for name in MOUNT_NAMES]
        if not set(names) <= set(known.names):
            continue
        at = [known.names.index(name) for name in names]
        if held[at[:2]].any() and not held[at[2]]:
            continue
        found = compose(known.mean[at], mount)
        mean[at[:2]] = (found - mount)[:2]
        lever = found - known.mean[at]  # which the yaw turns
        J[at[:2], at[2]] = -lever[1], lever[0]
    return J, replace(known, mean=mean)


def observed_information(
    seen: Sequence[Association], poses: Mapping[str, Array], landmarks: Sequence[Array]
) -> dict[str, Array]:
    """Information (3, 3) about robots' poses in observations of landmarks, along world axes.

    Args:
        seen: observations from these poses.
        poses: robot -> (3,), world frame.
        landmarks: targets of ``seen``, world frame, taken as exact.
    """
    info = {robot: np.zeros((3, 3)) for robot in poses}
    for name in sorted({association.model for association in seen}):  # sums in one order
        model = MODELS[name]
        group = [k for k, association in enumerate(seen) if association.model == name]
        z, cov = (np.array([getattr(seen[k], what) for k in group]) for what in ("z", "cov"))
        x = np.array([poses[seen[k].robot] for k in group])
        targets = np.array([landmarks[k] for k in group])
        H, _ = model.jacobians(z, x, targets)
        R = model.noise(z, cov, x, targets)
        found = H.mT @ np.linalg.solve(R, H)
        robots = np.array([seen[k].robot for k in group])
        for robot in set(robots.tolist()):
            info[robot] += found[robots == robot].sum(axis=0)
    return info
