"""The thesis' centralised extended Kalman filter: robots and landmarks in one Gaussian.

It uses the same rows of `MODELS` and the same noise as the smoother, so a comparison is one of
estimators. Its state holds copies of each robot's last few poses (`EkfConfig.past_states`), for
observations from before a landmark's promotion. The thesis adds a landmark when it is first seen;
here it must be confirmed first, and a filter that could not use the observations from before would
lose what ties the first landmarks to the start, and nine tenths of its accuracy
(docs/ekf-versus-smoothing.md).

The error of a pose has two definitions, rows of `ERRORS`. Jacobians of the models are by additive
errors along world axes; the chain rule turns them into Jacobians by either error.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from graphslam.core.config import Config, RobustConfig
from graphslam.core.gaussian import JointGaussian, whiten
from graphslam.core.geometry import (
    Array,
    compose,
    compose_jacobians,
    exp,
    exp_jacobian,
    rotation3,
)
from graphslam.core.observation_models import MODELS, ObservationModel
from graphslam.core.records import Association, Motion, Start, Step
from graphslam.estimation import factors
from graphslam.estimation.backend import JointMarginal
from graphslam.estimation.filter_base import (
    FilterBackend,
    Member,
    unknown_landmark,
    with_sigma_along_line,
)
from graphslam.estimation.input_checks import check_positive, describe, indeterminate
from graphslam.estimation.m_estimators import robust_weight
from graphslam.perception.point_to_line import step_poses


@dataclass(frozen=True)
class PoseError:
    """A definition of the error of a pose.

    ``retract`` applies errors (..., 3) to poses (..., 3); ``jacobian`` is the derivative (3, 3) of
    the corrected pose, additive along world axes, by the error, at a pose (3,) and an error (3,).
    """

    retract: Callable[[Array, Array], Array]
    jacobian: Callable[[Array, Array], Array]


#: name -> definition: `world` adds errors as the thesis does, `body` is that of GTSAM's Pose2
ERRORS: dict[str, PoseError] = {
    "world": PoseError(step_poses, lambda _pose, _error: np.eye(3)),
    "body": PoseError(
        lambda pose, error: compose(pose, exp(error)),
        lambda pose, error: rotation3(pose[2]) @ exp_jacobian(error),
    ),
}


class EkfBackend(FilterBackend):
    """The filter; state and equations as in thesis chapters 3.2 and 4.

    The members of `FilterBackend` are those of one Gaussian. Observations enter one at a time, each
    linearised at the estimate that the ones before left (section 4.1).
    """

    def __init__(self, config: Config) -> None:
        super().__init__(config.ekf.past_states)
        self._settings, self._robust = config.ekf, config.robust
        self._error = ERRORS[config.ekf.error]
        self._gaussian: JointGaussian[Member] = JointGaussian()
        self.error_frame: Literal["body", "world"] = config.ekf.error

    def remove(self, landmark: int) -> None:
        """Delete a landmark (thesis section 4.6); the joint marginal of the rest stays as it is.

        Raises:
            EstimationError: there is no such landmark.
        """
        self._landmark_mean(landmark)
        self._gaussian.remove(landmark)

    def _start(self, robot: str, start: Start) -> None:
        T = self._to_error(start.pose)
        self._gaussian.add(robot, start.pose, T @ start.cov @ T.T)

    def _move(self, robot: str, motion: Motion) -> None:
        """System update 3.11-3.14, 4.4-4.17: only the robot's own rows and columns."""
        if self._past_states:
            self._copy_pose(robot, self._states.latest(robot) - 1)
        x = self._mean(robot)
        moved = compose(x, motion.delta)
        F, W = compose_jacobians(x, motion.delta)
        T = self._to_error(moved)
        F, W = T @ F @ self._to_world(x), T @ W
        self._gaussian.move(robot, F, W @ motion.cov @ W.T)
        self._mean(robot)[:] = moved

    def _copy_pose(self, robot: str, number: int) -> None:
        """Copy the robot's pose, state ``number``, over the oldest copy."""
        name = robot, number % self._past_states
        if name not in self._gaussian:
            self._gaussian.add(name, self._mean(robot), np.zeros((3, 3)), {robot: np.eye(3)})
        self._gaussian.copy(name, robot)

    def _observe_step(self, step: Step) -> None:
        for seen in step.associations:
            ends = self._ends(seen, step.time_ns)
            if ends is not None:
                self._observe(seen, *ends)
        for closure in step.closures:
            ends = self._closure_ends(closure)
            if ends is not None:  # as if the one robot had been seen from the other
                kernel = RobustConfig("none") if closure.verified else self._robust
                model, what = MODELS["robot-pose"], describe(closure)
                self._update(*ends, model, closure.delta, closure.cov, what, kernel)

    def _observe(self, seen: Association, source: Member, target: Member) -> None:
        """One observation of ``target`` from ``source``: an update, or a new landmark."""
        if target in self._gaussian:
            model, cov = self._model_and_cov(seen)
            what = describe(seen)
            self._update(source, target, model, seen.z, cov, what, self._robust)
        else:
            self._augment(seen, source)

    def _model_and_cov(self, seen: Association) -> tuple[ObservationModel, Array]:
        """Model and covariance of an observation; see `EkfConfig.lines`."""
        if seen.model == "line" and self._settings.lines == "thesis":
            # 4.33-4.34: its middle as a pose, poorly known along the line
            return MODELS["segment"], with_sigma_along_line(seen, self._settings.along_sigma_m)
        return MODELS[seen.model], seen.cov

    def _augment(self, seen: Association, source: Member) -> None:
        """Add the landmark that was observed from ``source``, 4.24-4.28."""
        model, cov = self._model_and_cov(seen)
        if model is MODELS["line"]:  # the origin's place along the line is a gauge
            cov = with_sigma_along_line(seen, factors.FILTER_GAUGE_SIGMA_M)
        x = self._mean(source)
        mean = model.invert(seen.z, x)
        G_x, G_z = model.invert_jacobians(seen.z, x)
        T = self._to_error(mean)
        G_x, G_z = T @ G_x @ self._to_world(x), T @ G_z
        noise = G_z @ cov @ G_z.T
        check_positive(noise, describe(seen))
        self._gaussian.add(seen.target, mean, noise, {source: G_x})

    def _update(
        self,
        source: Member,
        target: Member,
        model: ObservationModel,
        z: Array,
        cov: Array,
        what: str,
        kernel: RobustConfig,
    ) -> None:
        """Measurement update 3.15-3.20 of ``target`` seen from ``source`` as z, with covariance.

        More than one iteration is the iterated filter: Gauss-Newton on this one observation and the
        prior (Bell and Cathey 1993, https://doi.org/10.1109/9.250476). The innovation is then that
        of the prior mean under the model linearised at the iterate.
        """
        gaussian, error = self._gaussian, self._error
        blocks = {name: gaussian.slot(name) for name in (source, target)}
        d = np.zeros(len(gaussian))
        try:
            for _ in range(self._settings.iterations):
                x, t = (self._corrected(name, d[block]) for name, block in blocks.items())
                R = model.noise(z, cov, x, t)
                check_positive(R, what)
                H = {}
                for name, J in zip(blocks, model.jacobians(z, x, t), strict=True):
                    mean, e = self._mean(name), d[blocks[name]]
                    H[name] = J @ error.jacobian(mean, e) if len(mean) == 3 else J
                innovation = -model.residual(z, x, t)
                innovation += sum(H[name] @ d[block] for name, block in blocks.items())
                PHt, HPHt = gaussian.project(H, model.rows)
                R = R / robust_weight(innovation, HPHt, R, kernel)
                B, w, d2 = whiten(PHt, HPHt + R, innovation)
                d = w @ B
        except np.linalg.LinAlgError:
            raise indeterminate(what) from None
        if not np.isfinite(d2):
            raise indeterminate(what)
        gaussian.condition(B)
        self._apply_correction(d)
        self._use(d2, HPHt + R)

    def _use(self, d2: float, S: Array) -> None:
        """Count an innovation: its square d2, normalised by its covariance S (k, k)."""
        self._twice_error += d2
        self._dof += len(S)

    def _mean(self, name: Member) -> Array:
        """Mean of one member, a view of it."""
        return self._gaussian.x[self._gaussian.slot(name)]

    def _corrected(self, name: Member, error: Array) -> Array:
        """The mean of one member, corrected by an error."""
        mean = self._mean(name)
        return self._error.retract(mean, error) if len(mean) == 3 else mean + error

    def _apply_correction(self, d: Array) -> None:
        """Apply errors (n,) to all means."""
        x, points, poses = self._gaussian.x, self._gaussian.blocks(2), self._gaussian.blocks(3)
        x[points] += d[points]
        x[poses] = self._error.retract(x[poses], d[poses])

    def _to_world(self, mean: Array) -> Array:
        """Derivative (d, d) of a mean, additive along world axes, by its error."""
        return self._error.jacobian(mean, np.zeros(3)) if len(mean) == 3 else np.eye(2)

    def _to_error(self, mean: Array) -> Array:
        """The inverse (d, d) of that; both are rotations, or the identity."""
        return self._to_world(mean).T

    def _landmark_mean(self, landmark: int) -> Array:
        """Mean of a landmark, a view of it."""
        if landmark not in self._gaussian:
            raise unknown_landmark(landmark)
        return self._mean(landmark)

    def joint(
        self, robot: str, landmarks: Sequence[int], others: Sequence[str] = ()
    ) -> JointMarginal:
        """See `Backend`.

        Raises:
            EstimationError: a robot or a landmark is not in the filter.
        """
        means = [self.state_mean(robot), *self.landmark_means(landmarks)]
        means += [self.state_mean(other) for other in others]
        cov = self._gaussian.marginal([robot, *landmarks, *others])
        joint = JointMarginal.of(means, len(landmarks), cov)
        for block, mean in zip((slice(0, 3), *joint.slices), means, strict=True):
            T = self._to_world(mean)
            cov[block] = T @ cov[block]
            cov[:, block] = cov[:, block] @ T.T
        return joint

    def state_mean(self, robot: str) -> Array:
        """See `Backend`."""
        self._states.latest(robot)  # raises if it has not started
        return self._mean(robot).copy()

    def landmark_means(self, landmarks: Sequence[int]) -> list[Array]:
        """See `Backend`."""
        return [self._landmark_mean(landmark).copy() for landmark in landmarks]

    def _landmark_marginals(self) -> dict[int, tuple[Array, Array]]:
        marginals = {}
        for name in self._gaussian:
            if isinstance(name, int):
                T = self._to_world(self._mean(name))
                cov = T @ self._gaussian.marginal([name]) @ T.T
                marginals[name] = (self._mean(name).copy(), cov)
        return marginals
