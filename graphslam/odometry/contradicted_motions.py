"""Motions by odometry that scans contradict: what they are evidence of, and which of them stay.

One such motion is a slip. Many may be a calibration that is far from its prior, see
`far_calibration`; it explains them, and then they are no contradictions.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.arrays import BoolArray
from graphslam.core.config import OdometryConfig
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, wrap
from graphslam.core.motion_models import of_odometry, several_lasers
from graphslam.core.record import replace
from graphslam.core.records import Contradiction, Step
from graphslam.odometry.calibration_jacobian import CalibratedSource, at_estimated_motion
from graphslam.odometry.online_noise import scaled
from graphslam.odometry.preintegration import Track

#: squared Mahalanobis distance (99.9 %, 3 dof) up to which a calibration explains a motion
EXPLAINED_D2 = float(chi2_quantile(0.999, 3))
#: motions that are kept, the latest
MOST_KEPT = 500


def calibration_floor(config: OdometryConfig) -> Array:
    """Covariance (3, 3) of what is wrong with an estimated motion that odometry cannot tell."""
    sigmas = [config.calibration_floor_m] * 2 + [config.calibration_floor_rad]
    return np.diag(np.square(sigmas))


@dataclass(frozen=True, slots=True, eq=False)
class ContradictedMotions:
    """Motions (n) that scans contradict, as measurements of p calibration parameters.

    ``miss`` (n, 3): the motion by scans minus that of odometry with parameters of zero; ``d_cal``
    (n, 3, p) its derivative at the motion by scans, by the p parameters of the odometry itself;
    ``information`` (n, 3, 3) about it, without calibration.
    """

    miss: Array
    d_cal: Array
    information: Array

    @classmethod
    def none(cls) -> "ContradictedMotions":
        """No motion."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3, 0)), np.zeros((0, 3, 3)))

    def with_motions(
        self, found: Sequence[Contradiction], source: CalibratedSource, scale: Array
    ) -> "ContradictedMotions":
        """The same with further ones; of a robot with several lasers none are kept.

        Args:
            found: by odometry with the calibration of a source.
            source: of the odometry.
            scale: (3,) by how much variances of the noise of odometry are larger than stated.
        """
        if not found or several_lasers(source.calibration):
            return self
        known = source.calibration
        own = of_odometry(known)
        D = np.array([one.odometry.d_delta_d_calibration for one in found])
        delta = np.array([one.odometry.delta for one in found])
        stated = np.array([one.odometry.cov for one in found]) - D @ known.cov @ D.mT
        pose = np.array([one.pose for one in found])
        plain = replace(source, calibration=replace(known, mean=np.where(own, 0.0, known.mean)))
        delta = delta - D[:, :, own] @ known.mean[own]
        miss = pose - delta
        miss[:, 2] = wrap(miss[:, 2])
        W = _weights(
            np.array([one.information for one in found]),
            scaled(stated, scale) + calibration_floor(source.config),
        )
        D = at_estimated_motion(plain, delta, D, pose)[:, :, own]
        more = ContradictedMotions(miss, D, W)
        if len(self.miss):
            pairs = zip(self._arrays, more._arrays, strict=True)
            more = ContradictedMotions(*(np.concatenate(pair) for pair in pairs))
        return more.those(slice(-MOST_KEPT, None))

    @property
    def _arrays(self) -> tuple[Array, Array, Array]:
        return self.miss, self.d_cal, self.information

    def those(self, which: BoolArray | slice) -> "ContradictedMotions":
        """Some of them."""
        return ContradictedMotions(*(values[which] for values in self._arrays))


def without_explained(steps: Iterable[Step], robot: str, track: Track, scale: Array) -> list[Step]:
    """Steps in which motions of a robot are no contradictions that its calibration explains.

    These are by odometry again as soon as they are computed anew.

    Args:
        steps: in the order of time.
        robot: whose motions.
        track: its odometry, with the calibration that was found.
        scale: (3,) by how much variances of the noise of odometry are larger than stated.
    """
    taken = list(steps)
    found = [
        (k, motion, motion.contradiction)
        for k, step in enumerate(taken)
        if (motion := step.motions.get(robot)) is not None and motion.contradiction is not None
    ]
    if not found:
        return taken
    begin, end = np.array([(motion.start_ns, motion.end_ns) for _, motion, _ in found]).T
    made = track.motions(begin, end)
    D, known = made.d_cal, track.calibration
    by_calibration = D @ known.cov @ D.mT
    noise = scaled(made.cov - by_calibration, scale) + calibration_floor(track.config)
    seen = np.array([one.information for _, _, one in found])
    miss = np.array([one.pose for _, _, one in found]) - made.delta
    miss[:, 2] = wrap(miss[:, 2])
    noise += by_calibration
    is_explained = quadratic(miss, _weights(seen, noise)) <= EXPLAINED_D2
    for (k, motion, _), explained in zip(found, is_explained.tolist(), strict=True):
        if explained:
            plain = replace(motion, from_scans=False, contradiction=None)
            taken[k] = replace(taken[k], motions={**taken[k].motions, robot: plain})
    return taken


def quadratic(off: Array, information: Array) -> Array:
    """Squares (..., n) of off (..., n, 3), weighted by information (n, 3, 3)."""
    return np.asarray(np.einsum("...ni,nij,...nj->...n", off, information, off))


def _weights(seen: Array, noise: Array) -> Array:
    """Information (n, 3, 3) with further noise (n, 3, 3): (noise + seen⁻¹)⁻¹, also singular."""
    return np.asarray(np.linalg.solve(np.eye(3) + seen @ noise, seen), dtype=np.float64)
