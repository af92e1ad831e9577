"""A Rao-Blackwellised particle filter: sampled paths, everything else Gaussian in each particle.

Given the path, landmarks are independent of each other (K. Murphy, NIPS 1999), so a particle has a
small Kalman filter for each. As in FastSLAM 2.0 (M. Montemerlo et al., IJCAI 2003; S. Thrun et al.,
Probabilistic Robotics, 2005, chapter 13.8) a pose is sampled after the observations of the step
have corrected it, and only if there are any of landmarks. Until then it is a Gaussian in each
particle, over the latest poses of all robots together. So odometry alone costs no samples, and an
observation of a robot by another is an ordinary Kalman update.

All arrays have the N particles as their first axis; nothing loops over particles. There is no
robust kernel.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from graphslam.core.config import Config
from graphslam.core.gaussian import update
from graphslam.core.geometry import Array, compose, compose_jacobians, wrap
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, Motion, Start, Step
from graphslam.estimation.backend import JointMarginal, block_slices
from graphslam.estimation.factors import FILTER_GAUGE_SIGMA_M
from graphslam.estimation.filter_base import FilterBackend, unknown_landmark, with_sigma_along_line
from graphslam.estimation.input_checks import describe, errors_at

#: resample when the effective number of particles is below this share of them
RESAMPLE_BELOW = 0.5


def low_variance_sample(weights: Array, share: float) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Indices (N,) of the particles that survive: each N times its weight, rounded up or down.

    One random number for all, ``share``, uniform in [0, 1) (J. Carpenter et al., IEE Proc. Radar
    Sonar Navig. 146(1), 1999, https://doi.org/10.1049/ip-rsn:19990255).
    """
    n = len(weights)
    edges = np.cumsum(weights)
    inner = edges[:-1] / edges[-1]  # without the last edge, which rounding may put below 1
    return np.searchsorted(inner, (np.arange(n) + share) / n, side="right")


@dataclass(slots=True)
class _Landmark:
    """Means (N, d) and covariances (N, d, d)."""

    mean: Array
    cov: Array


class RbpfBackend(FilterBackend):
    """The filter. ``joint`` and ``finish`` return mean and covariance of the mixture.

    Final states are causal: the paths of the surviving particles could serve as a smoothed
    trajectory, but they soon share one ancestor, so its covariance would be zero.
    """

    error_frame: Literal["body", "world"] = "world"

    def __init__(self, config: Config) -> None:
        super().__init__()
        self._count, self._proposal = config.rbpf.particles, config.rbpf.proposal
        self._rng = np.random.default_rng(config.rbpf.seed)
        self._blocks: dict[str, slice] = {}  # of each robot in x and P
        self._x = np.zeros((self._count, 0))
        self._P = np.zeros((self._count, 0, 0))
        self._landmarks: dict[int, _Landmark] = {}
        self._log_weights = np.zeros(self._count)
        self._weights = np.full(self._count, 1 / self._count)

    def _start(self, robot: str, start: Start) -> None:
        n = self._x.shape[1]
        block = self._blocks[robot] = slice(n, n + 3)
        self._x = np.pad(self._x, ((0, 0), (0, 3)))
        self._P = np.pad(self._P, ((0, 0), (0, 3), (0, 3)))
        self._x[:, block], self._P[:, block, block] = start.pose, start.cov

    def _move(self, robot: str, motion: Motion) -> None:
        """Thesis 4.4-4.17 in each particle; of a sampled pose the covariance is zero."""
        block, P = self._blocks[robot], self._P
        F, W = compose_jacobians(self._x[:, block], motion.delta)
        P[:, block] = F @ P[:, block]
        P[:, :, block] = P[:, :, block] @ F.mT
        P[:, block, block] += W @ motion.cov @ W.mT
        self._x[:, block] = compose(self._x[:, block], motion.delta)

    def _observe_step(self, step: Step) -> None:
        """Relative poses of robots first, then the landmarks of one robot after the other."""
        associations = [s for s in step.associations if self._ends(s, step.time_ns)]
        closures = [c for c in step.closures if self._closure_ends(c)]
        if not associations and not closures:
            return
        for seen in associations:
            if isinstance(seen.target, str):
                with errors_at(describe(seen)):
                    self._update_poses(seen.robot, seen.target, seen.model, seen.z, seen.cov)
        for c in closures:
            with errors_at(describe(c)):
                self._update_poses(c.other, c.robot, "robot-pose", c.delta, c.cov)
        for robot in sorted({seen.robot for seen in associations}):
            own = [(s, s.target) for s in associations if s.robot == robot]
            to_landmarks = [(s, target) for s, target in own if isinstance(target, int)]
            if to_landmarks:
                self._observe_landmarks(robot, to_landmarks)
        self._normalise_weights()

    def _observe_landmarks(self, robot: str, seen: Sequence[tuple[Association, int]]) -> None:
        """Correct a robot's pose by landmarks, sample it, then correct the landmarks."""
        if self._proposal == "motion":
            self._sample_pose(robot)
        # a second observation of a landmark is independent only after the first corrected it
        first = {target: s for s, target in reversed(seen) if target in self._landmarks}
        for target, s in first.items():
            with errors_at(describe(s)):
                self._update_poses(robot, target, s.model, s.z, s.cov)
        if self._proposal == "observation":
            self._sample_pose(robot)
        for s, target in seen:
            with errors_at(describe(s)):
                if target in self._landmarks:
                    self._update_landmark(s, target, weigh=s is not first.get(target))
                else:
                    self._augment(s, target)

    def _update_poses(
        self, source: str, target: int | str, model: str, z: Array, cov: Array
    ) -> None:
        """Kalman update of the poses by an observation, and the weights by its likelihood.

        A landmark's uncertainty counts as measurement noise.
        """
        row, block = MODELS[model], self._blocks[source]
        z, R = self._each(z), self._each(cov)
        x = self._x[:, block]
        if isinstance(target, str):
            t = self._x[:, self._blocks[target]]
        else:
            t = self._landmarks[target].mean
        H_x, H_t = row.jacobians(z, x, t)
        H = np.zeros((self._count, row.rows, self._x.shape[1]))
        H[:, :, block] = H_x
        R = row.noise(z, R, x, t)
        np.linalg.cholesky(R[0])  # raises if it is no covariance, which is so in all or in none
        if isinstance(target, str):
            H[:, :, self._blocks[target]] = H_t
        else:
            R = R + H_t @ self._landmarks[target].cov @ H_t.mT
        innovation = -row.residual(z, x, t)
        self._x, self._P, d2, log_det = update(self._x, self._P, H, R, innovation)
        self._weigh(d2, log_det, row.rows)

    def _sample_pose(self, robot: str) -> None:
        """Sample the latest pose of a robot, and condition the poses of the others on it.

        Along axes without uncertainty (a robot that stood still) nothing is drawn.
        """
        block = self._blocks[robot]
        values, axes = np.linalg.eigh(self._P[:, block, block])
        sigmas = np.sqrt(np.maximum(values, 0.0))
        floor = 1e-9 * sigmas[:, -1:]  # a smaller sigma is rounding
        inverse = np.divide(1.0, sigmas, out=np.zeros_like(sigmas), where=sigmas > floor)
        shared = self._P[:, :, block] @ (axes * inverse[:, None])  # covariance with the draws
        normal = self._rng.standard_normal((self._count, 3, 1))
        self._x += (shared @ normal)[..., 0]
        self._P -= shared @ shared.mT
        self._P[:, block] = 0.0  # exactly, without rounding
        self._P[:, :, block] = 0.0

    def _augment(self, seen: Association, target: int) -> None:
        """A new landmark in each particle, 4.24-4.28 with the pose known."""
        row, cov = MODELS[seen.model], seen.cov
        if seen.model == "line":  # the origin's place along the line is a gauge
            cov = with_sigma_along_line(seen, FILTER_GAUGE_SIGMA_M)
        x, z = self._x[:, self._blocks[seen.robot]], self._each(seen.z)
        _, G = row.invert_jacobians(z, x)
        noise = G @ cov @ G.mT
        np.linalg.cholesky(noise)  # raises where the observation does not determine the landmark
        self._landmarks[target] = _Landmark(row.invert(z, x), noise)

    def _update_landmark(self, seen: Association, target: int, weigh: bool) -> None:
        """Kalman update of a landmark in each particle, with the pose known."""
        row, landmark = MODELS[seen.model], self._landmarks[target]
        x, z = self._x[:, self._blocks[seen.robot]], self._each(seen.z)
        _, H = row.jacobians(z, x, landmark.mean)
        R = row.noise(z, self._each(seen.cov), x, landmark.mean)
        np.linalg.cholesky(R[0])  # as in `_update_poses`
        innovation = -row.residual(z, x, landmark.mean)
        landmark.mean, landmark.cov, d2, log_det = update(
            landmark.mean, landmark.cov, H, R, innovation
        )
        if weigh:
            self._weigh(d2, log_det, row.rows)

    def _weigh(self, d2: Array, log_det: Array, rows: int) -> None:
        """Multiply each particle's weight by the likelihood of its innovation, see `update`."""
        self._log_weights -= 0.5 * (d2 + log_det)
        self._twice_error += float(self._weights @ d2)
        self._dof += rows

    def _normalise_weights(self) -> None:
        """Normalise the weights; resample if too few particles have them."""
        self._log_weights -= self._log_weights.max()
        weights = np.exp(self._log_weights)
        self._weights = weights / weights.sum()
        if 1 / np.sum(np.square(self._weights)) < RESAMPLE_BELOW * self._count:
            kept = low_variance_sample(self._weights, self._rng.random())
            self._x, self._P = self._x[kept], self._P[kept]
            for landmark in self._landmarks.values():
                landmark.mean, landmark.cov = landmark.mean[kept], landmark.cov[kept]
            self._log_weights = np.zeros(self._count)
            self._weights = np.full(self._count, 1 / self._count)

    def _each(self, value: Array) -> Array:
        """The same value for every particle, (N, ...)."""
        return np.broadcast_to(value, (self._count, *value.shape))

    def joint(
        self, robot: str, landmarks: Sequence[int], others: Sequence[str] = ()
    ) -> JointMarginal:
        """See `Backend`.

        Within one particle, landmarks are independent of each other and of all latest poses.

        Raises:
            EstimationError: a robot or a landmark is not in the filter.
        """
        robots = [robot, *others]
        parts = [self._poses(robot), *(self._landmark(i).mean for i in landmarks)]
        parts += [self._poses(other) for other in others]
        means, off = zip(*(self._moments(part) for part in parts), strict=True)
        slices = block_slices([len(mean) for mean in means[1:]])
        E = np.concatenate(off, axis=1)
        cov = (self._weights * E.T) @ E
        n = len(landmarks)
        for block, i in zip(slices, landmarks, strict=False):
            cov[block, block] += self._within(self._landmark(i).cov)
        index = np.concatenate([np.r_[self._blocks[name]] for name in robots])
        rows = np.concatenate([np.r_[block] for block in (slice(0, 3), *slices[n:])])
        cov[np.ix_(rows, rows)] += self._within(self._P[:, index[:, None], index])
        return JointMarginal.of(means, n, 0.5 * (cov + cov.T))

    def _poses(self, robot: str) -> Array:
        """The robot's latest poses (N, 3)."""
        self._states.latest(robot)  # raises if it has not started
        return self._x[:, self._blocks[robot]]

    def _landmark(self, landmark: int) -> _Landmark:
        if landmark not in self._landmarks:
            raise unknown_landmark(landmark)
        return self._landmarks[landmark]

    def _moments(self, values: Array) -> tuple[Array, Array]:
        """Weighted mean (d,) of values (N, d) and deviations (N, d); a third column is angles."""
        origin = values[np.argmax(self._weights)]
        off = values - origin
        off[:, 2:] = wrap(off[:, 2:])
        shift = self._weights @ off
        mean = origin + shift
        mean[2:] = wrap(mean[2:])
        return mean, off - shift

    def _within(self, covs: Array) -> Array:
        """Weighted mean (d, d) of the particles' own covariances (N, d, d)."""
        return np.asarray(np.tensordot(self._weights, covs, axes=1))

    def state_mean(self, robot: str) -> Array:
        """See `Backend`."""
        return self._moments(self._poses(robot))[0]

    def landmark_means(self, landmarks: Sequence[int]) -> list[Array]:
        """See `Backend`."""
        return [self._moments(self._landmark(i).mean)[0] for i in landmarks]

    def _landmark_marginals(self) -> dict[int, tuple[Array, Array]]:
        marginals = {}
        for i, landmark in self._landmarks.items():
            mean, off = self._moments(landmark.mean)
            cov = (self._weights * off.T) @ off + self._within(landmark.cov)
            marginals[i] = (mean, 0.5 * (cov + cov.T))
        return marginals
