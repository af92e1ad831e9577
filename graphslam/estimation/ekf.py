"""The thesis' centralised extended Kalman filter: robots and landmarks in one Gaussian.

The same rows of `MODELS` and the same noise as the smoother, so a comparison is one of estimators.
What a filter cannot do it leaves out and counts (`EkfBackend.skipped`): it has no past, but for the
last few poses that stay in its state as copies (`EkfConfig.past_states`). Those are for sightings
from before a landmark's promotion. The thesis adds a landmark where it is first seen; here it waits
until it is known to be one, and a filter that had to forget the sightings it waited for would lose
what ties the first landmarks to the start, and with it nine tenths of its accuracy
(docs/ekf-versus-smoothing.md).

Two definitions of the error of a pose, rows of `ERRORS`. A textbook Jacobian is by additive errors
along world axes; by the chain rule it becomes one by either error.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from graphslam.core.config import Config, RobustConfig
from graphslam.core.errors import EstimationError
from graphslam.core.gaussian import JointGaussian, whiten
from graphslam.core.geometry import (
    Array,
    compose,
    compose_jacobians,
    exp,
    exp_jacobian,
    rotate_cov,
    rotation3,
    wrap,
)
from graphslam.core.observation_models import MODELS, ObservationModel
from graphslam.core.records import Association, Closure, Estimate, Motion, Start, Step, Trajectory
from graphslam.estimation import factors
from graphslam.estimation.backend import Joint, StateTable, block_slices
from graphslam.estimation.input_checks import check_finite, check_positive, indeterminate, sighting

#: a robot's latest pose by its name, one of its past ones, or a landmark
Member = str | tuple[str, int] | int


@dataclass(frozen=True)
class PoseError:
    """What the error of a pose is.

    ``retract`` applies errors (..., 3) to poses (..., 3); ``jacobian`` is the derivative (3, 3) of
    the corrected pose, additive along world axes, by the error, at a pose (3,) and an error (3,).
    """

    retract: Callable[[Array, Array], Array]
    jacobian: Callable[[Array, Array], Array]


def _add(pose: Array, error: Array) -> Array:
    moved = pose + error
    moved[..., 2] = wrap(moved[..., 2])
    return moved


#: error -> how it works: `world` as the thesis adds them, `body` as GTSAM's Pose2
ERRORS: dict[str, PoseError] = {
    "world": PoseError(_add, lambda _pose, _error: np.eye(3)),
    "body": PoseError(
        lambda pose, error: compose(pose, exp(error)),
        lambda pose, error: rotation3(pose[2]) @ exp_jacobian(error),
    ),
}

#: kernel -> weight of an observation whose whitened residual has length d, for a scale k
WEIGHTS: dict[str, Callable[[float, float], float]] = {
    "none": lambda _d, _k: 1.0,
    "huber": lambda d, k: 1.0 if d <= k else k / d,
    "cauchy": lambda d, k: k * k / (k * k + d * d),
    "geman-mcclure": lambda d, k: (k * k / (k * k + d * d)) ** 2,
}
#: relative change of a weight at which it is settled; rounds at most (convergence is linear)
SETTLED, MAX_ROUNDS = 1e-4, 100


def robust_weight(innovation: Array, HPHt: Array, R: Array, robust: RobustConfig) -> float:
    """The weight that the smoother's M-estimator would give one observation.

    It weighs by the residual that is *left* after the update, not by the innovation: a far
    innovation is right where the prediction is poor. Noise R/w leaves the whitened residual
    ``u_j / (1 + w a_j)``, with a_j the eigenvalues of H P Hᵀ whitened by R and u the whitened
    innovation in their axes; w is the largest weight that agrees with what it leaves, reached from
    full weight downwards (each round of reweighting lowers it or leaves it).

    Args:
        innovation: (k,) measured minus expected.
        HPHt: (k, k) covariance of the expected measurement.
        R: (k, k) covariance of the measurement.
        robust: kernel and scale; `none` gives 1.
    """
    if robust.kernel == "none":
        return 1.0
    L = np.linalg.cholesky(R)
    a, U = np.linalg.eigh(np.linalg.solve(L, np.linalg.solve(L, HPHt).T))
    u = U.T @ np.linalg.solve(L, innovation)
    weight, w = WEIGHTS[robust.kernel], 1.0
    for _ in range(MAX_ROUNDS):
        before, w = w, weight(float(np.linalg.norm(u / (1 + w * np.maximum(a, 0.0)))), robust.scale)
        if before - w <= SETTLED * before:
            break
    return w


class EkfBackend:
    """The filter; state and equations as in thesis chapters 3.2 and 4.

    Each robot's latest pose, copies of its poses just before, as ``(robot, number modulo their
    count)``, and each landmark are members of one Gaussian. Observations enter one at a time, each
    linearised at what the ones before left (section 4.1). ``skipped`` counts what a filter cannot
    use, by reason.
    """

    def __init__(self, config: Config) -> None:
        self._settings, self._robust = config.ekf, config.robust
        self._error = ERRORS[config.ekf.error]
        self._states = StateTable()
        self._gaussian: JointGaussian[Member] = JointGaussian()
        self._track: dict[str, list[tuple[Array, Array]]] = {}  # causal pose and cov, world axes
        self._twice_error, self._dof = 0.0, 0
        self.skipped: Counter[str] = Counter()
        self.smooths = False
        self.error_frame: Literal["body", "world"] = config.ekf.error

    # ------------------------------------------------------------ evidence in

    def add(self, step: Step) -> None:
        """See `Backend`.

        Raises:
            EstimationError: a state that was never made, or noise without a valid covariance.
        """
        for robot, start in step.starts.items():
            self._start(robot, step.time_ns, start)
        for robot, motion in step.motions.items():
            self._move(robot, step.time_ns, motion)
        for seen in step.associations:
            self._observe(seen, step.time_ns)
        for closure in step.closures:
            self._close(closure)
        for robot in {**step.starts, **step.motions}:
            joint = self.joint(robot, ())
            self._track.setdefault(robot, []).append((joint.pose, joint.cov))

    def remove(self, landmark: int) -> None:
        """Delete a landmark (thesis section 4.6); the joint marginal of the rest stays as it is.

        Raises:
            EstimationError: there is no such landmark.
        """
        self._known(landmark)
        self._gaussian.remove(landmark)

    def _start(self, robot: str, time_ns: int, start: Start) -> None:
        self._states.append(robot, time_ns)
        check_finite(f"start of robot {robot} at {time_ns} ns", start.pose, start.cov)
        T = self._to_error(start.pose)
        self._gaussian.add(robot, start.pose, T @ start.cov @ T.T)

    def _move(self, robot: str, time_ns: int, motion: Motion) -> None:
        """System update 3.11-3.14, 4.4-4.17: only the robot's own rows and columns."""
        last = self._states.latest(robot, time_ns)
        self._states.append(robot, time_ns)
        check_finite(f"motion of robot {robot} to {time_ns} ns", motion.delta, motion.cov)
        self._keep(robot, last)
        x = self._mean(robot)
        moved = compose(x, motion.delta)
        F, W = compose_jacobians(x, motion.delta)
        T = self._to_error(moved)
        F, W = T @ F @ self._to_world(x), T @ W
        self._gaussian.move(robot, F, W @ motion.cov @ W.T)
        self._mean(robot)[:] = moved

    def _keep(self, robot: str, number: int) -> None:
        """A copy of the robot's latest pose, state ``number``, in the place of the oldest copy."""
        if self._settings.past_states:
            name = robot, number % self._settings.past_states
            if name not in self._gaussian:
                self._gaussian.add(name, self._mean(robot), np.zeros((3, 3)), {robot: np.eye(3)})
            self._gaussian.copy(name, robot)

    def _state(self, robot: str, time_ns: int) -> Member | None:
        """The member that is the robot's state at ``time_ns``; None if it is forgotten."""
        number, latest = self._states.number(robot, time_ns), self._states.latest(robot)
        if number == latest:
            return robot
        kept = self._settings.past_states
        return (robot, number % kept) if number >= latest - kept else None

    def _observe(self, seen: Association, time_ns: int) -> None:
        """One observation: update, or a new landmark."""
        source, target = self._state(seen.robot, seen.time_ns), self._target(seen, time_ns)
        if seen.late and not self._settings.past_states:
            self.skipped["late evidence"] += 1
        elif source is None or target is None:
            self.skipped["observation from a past state"] += 1
        else:
            check_finite(sighting(seen), seen.z, seen.cov)
            if target in self._gaussian:
                model, cov = self._measured(seen)
                self._update(source, target, model, seen.z, cov, sighting(seen), self._robust)
            else:
                self._augment(seen, source)

    def _target(self, seen: Association, time_ns: int) -> Member | None:
        """What was observed: a landmark, or a robot's state."""
        if isinstance(seen.target, str):
            return self._state(seen.target, time_ns)
        return seen.target

    def _measured(self, seen: Association) -> tuple[ObservationModel, Array]:
        """Model and covariance of an observation: of a line perhaps as the thesis has it."""
        if seen.model == "line" and self._settings.lines == "thesis":
            # 4.33-4.34: its middle as a point, poorly known along the line
            return MODELS["segment"], _along(seen, self._settings.along_sigma_m)
        return MODELS[seen.model], seen.cov

    def _augment(self, seen: Association, source: Member) -> None:
        """A new landmark where the observation from ``source`` puts it, 4.24-4.28."""
        model, cov = self._measured(seen)
        if model is MODELS["line"]:  # where on the line is a gauge
            cov = _along(seen, factors.FILTER_GAUGE_SIGMA_M)
        x = self._mean(source)
        mean = model.invert(seen.z, x)
        G_x, G_z = model.invert_jacobians(seen.z, x)
        T = self._to_error(mean)
        G_x, G_z = T @ G_x @ self._to_world(x), T @ G_z
        fresh = G_z @ cov @ G_z.T
        check_positive(fresh, sighting(seen))
        self._gaussian.add(seen.target, mean, fresh, {source: G_x})

    def _close(self, closure: Closure) -> None:
        """A measured relative pose, if both its ends are known: as a robot seen from the other."""
        robot = self._state(closure.robot, closure.time_ns)
        other = self._state(closure.other, closure.other_time_ns)
        if robot is None or other is None:
            self.skipped["closure to a past state"] += 1
            return
        what = f"closure of robot {closure.robot} at {closure.time_ns} ns"
        check_finite(what, closure.delta, closure.cov)
        model = MODELS["robot-pose"]
        kernel = RobustConfig("none") if closure.verified else self._robust
        self._update(other, robot, model, closure.delta, closure.cov, what, kernel)

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
        prior (Bell and Cathey 1993, https://doi.org/10.1109/9.250476). The innovation is then the
        one that the prior mean would have if the model were linear as it is at the iterate.
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
        self._correct(d)
        self._twice_error += d2
        self._dof += model.rows

    def _mean(self, name: Member) -> Array:
        """Mean of one member, a view of it."""
        return self._gaussian.x[self._gaussian.slot(name)]

    def _corrected(self, name: Member, error: Array) -> Array:
        """The mean of one member with an error applied."""
        mean = self._mean(name)
        return self._error.retract(mean, error) if len(mean) == 3 else mean + error

    def _correct(self, d: Array) -> None:
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

    def _known(self, landmark: int) -> Array:
        """Mean of a landmark."""
        if landmark not in self._gaussian:
            raise EstimationError(
                f"landmark {landmark} is not in the filter: it was deleted, or all that was seen "
                "of it belonged to the past"
            )
        return self._mean(landmark)

    # ------------------------------------------------------------ knowledge out

    def joint(self, robot: str, landmarks: Sequence[int], others: Sequence[str] = ()) -> Joint:
        """See `Backend`.

        Raises:
            EstimationError: it is not known.
        """
        means = [self.state_mean(robot), *self.landmark_means(landmarks)]
        means += [self.state_mean(other) for other in others]
        slices = block_slices([len(mean) for mean in means[1:]])
        cov = self._gaussian.marginal([robot, *landmarks, *others])
        for block, mean in zip((slice(0, 3), *slices), means, strict=True):
            T = self._to_world(mean)
            cov[block] = T @ cov[block]
            cov[:, block] = cov[:, block] @ T.T
        n = 1 + len(landmarks)
        return Joint(means[0], tuple(means[1:n]), cov, slices, tuple(means[n:]))

    def state_mean(self, robot: str) -> Array:
        """See `Backend`."""
        self._states.latest(robot)  # has it started?
        return self._mean(robot).copy()

    def landmark_means(self, landmarks: Sequence[int]) -> list[Array]:
        """See `Backend`."""
        return [self._known(landmark).copy() for landmark in landmarks]

    def finish(self) -> Estimate:
        """See `Backend`: a filter does not revise the past, so final states are the causal ones.

        The error is half the sum of the squared normalised innovations, which in a linear problem
        is the smoother's error; so are the degrees of freedom.
        """
        states = {
            robot: Trajectory(
                self._states.stamps(robot),
                np.array([pose for pose, _ in track]),
                np.array([cov for _, cov in track]),
            )
            for robot, track in sorted(self._track.items())
        }
        landmarks = {}
        for name in self._gaussian:
            if isinstance(name, int):
                T = self._to_world(self._mean(name))
                cov = T @ self._gaussian.marginal([name]) @ T.T
                landmarks[name] = (self._mean(name).copy(), cov)
        return Estimate(states, landmarks, 0.5 * self._twice_error, self._dof)


def _along(seen: Association, sigma_m: float) -> Array:
    """The covariance (3, 3) of a line's middle with ``sigma_m`` along the line: 4.33-4.34."""
    own = rotate_cov(seen.cov, -seen.z[2])
    own[0, :] = own[:, 0] = 0.0
    own[0, 0] = sigma_m**2
    return rotate_cov(own, seen.z[2])
