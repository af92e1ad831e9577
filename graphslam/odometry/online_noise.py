"""How noisy odometry is, learnt while a log is read; after it, see `noise_estimation`.

Where nobody states it, tracking begins with the default. Wheels that slip may be many times as
noisy: gates would be too narrow, and what is noise would be explained by a wrong calibration.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from graphslam.core.arrays import BoolArray
from graphslam.core.geometry import Array
from graphslam.core.record import replace
from graphslam.core.records import Motion

#: motions by the noise that is stated, beside those that show it
PRIOR_MOTIONS = 20


class ShownNoise(NamedTuple):
    """What each of n motions shows, along each axis of its start: all (n, 3), m² and rad².

    ``squared``: squared error of odometry, as far as it is its noise. ``expected``: what that would
    be on average by the noise that is stated; ``stated``: the variance of this noise.
    """

    squared: Array
    expected: Array
    stated: Array

    @classmethod
    def of(
        cls, miss: Array, white: Array, by_calibration: Array, seen: Array, moved_cov: Array
    ) -> "ShownNoise":
        """From motions after tracking.

        One differs from odometry by P O (z - m), where landmarks alone put it to z and odometry to
        m. The square is on average P O (f Q + C + O⁻¹) O P where the noise is f times as stated.

        Args:
            miss: (n, 3) these differences.
            white: (n, 3, 3) the noise Q that is stated.
            by_calibration: (n, 3, 3) what the error of the calibration adds to it, C.
            seen: (n, 3, 3) information of landmarks about the motions, O.
            moved_cov: (n, 3, 3) covariances after tracking, P.
        """
        K = moved_cov @ seen
        explained = _diagonal(K @ (by_calibration @ K.mT + moved_cov))
        return cls(miss**2 - explained, _diagonal(K @ white @ K.mT), _diagonal(white))


@dataclass(frozen=True, slots=True, eq=False)
class NoiseEvidence:
    """Sums (3,) of `ShownNoise` over ``count`` motions."""

    squared: Array
    expected: Array
    stated: Array
    count: float

    @classmethod
    def none(cls) -> "NoiseEvidence":
        """Nothing is known."""
        return cls(np.zeros(3), np.zeros(3), np.zeros(3), 0.0)

    def with_motions(
        self, shown: ShownNoise, used: BoolArray, past: float = 1.0
    ) -> "NoiseEvidence":
        """The same with those motions that are ``used`` (n,); the ``past`` may weigh less."""
        return NoiseEvidence(
            past * self.squared + shown.squared[used].sum(axis=0),
            past * self.expected + shown.expected[used].sum(axis=0),
            past * self.stated + shown.stated[used].sum(axis=0),
            past * self.count + float(used.sum()),
        )

    @property
    def scale(self) -> Array:
        """How many times (3,) the stated variances those of odometry are; not less than one."""
        prior = PRIOR_MOTIONS / max(self.count, 1.0) * self.stated
        is_known = self.expected + prior > 0
        expected = np.where(is_known, self.expected + prior, 1.0)
        return np.asarray(np.maximum((self.squared + prior) / expected, 1.0))

    def applied(self, white: Array) -> Array:
        """Covariances (..., 3, 3) of noise that is as large as it was found to be."""
        return scaled(white, self.scale)


def scaled(white: Array, scale: Array) -> Array:
    """Covariances (..., 3, 3) whose variances along the axes are factors (3,) larger."""
    sigmas = np.sqrt(scale)
    return np.asarray(sigmas[:, None] * white * sigmas)


def noisier(motion: Motion, calibration_cov: Array, scale: Array) -> Motion:
    """A motion whose noise has variances that are factors (3,) larger.

    What the error of the calibration, of covariance (p, p), adds to its covariance stays.
    """
    D = motion.d_delta_d_calibration
    by_calibration = D @ calibration_cov @ D.T
    return replace(motion, cov=scaled(motion.cov - by_calibration, scale) + by_calibration)


def _diagonal(matrices: Array) -> Array:
    """Diagonals (n, 3) of matrices (n, 3, 3)."""
    return np.asarray(np.einsum("nii->ni", matrices))
