"""Odometry alone: no observation corrects a pose; a landmark stays where it was first seen."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Literal

from scipy.linalg import block_diag

from graphslam.core.config import Config
from graphslam.core.geometry import Array, compose, compose_cov
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Estimate, Step
from graphslam.estimation.backend import JointMarginal, StateTable, TrajectoryRecorder
from graphslam.estimation.input_checks import (
    check_finite,
    check_positive,
    describe,
    describe_motion,
    describe_start,
)


class DeadReckoningBackend:
    """The baseline that uses no observation for the trajectory."""

    error_frame: Literal["body", "world"] = "world"
    skipped: Mapping[str, int] = MappingProxyType({})  # it ignores observations on purpose

    def __init__(self, _config: Config) -> None:
        self._states = StateTable()
        self._track = TrajectoryRecorder()
        self._landmarks: dict[int, tuple[Array, Array]] = {}

    def add(self, step: Step) -> None:
        """See `Backend`."""
        for robot, start in step.starts.items():
            check_finite(describe_start(robot, step.time_ns), start.pose, start.cov)
            self._append(robot, step.time_ns, start.pose, start.cov)
        for robot, motion in step.motions.items():
            number = self._states.latest(robot, step.time_ns)
            check_finite(describe_motion(robot, step.time_ns), motion.delta, motion.cov)
            x, P = self._state(robot, number)
            cov = compose_cov(x, P, motion.delta, motion.cov)
            self._append(robot, step.time_ns, compose(x, motion.delta), cov)
        for seen in step.associations:
            number = self._states.number(seen.robot, seen.time_ns)
            if isinstance(seen.target, int) and seen.target not in self._landmarks:
                check_finite(describe(seen), seen.z, seen.cov)
                x, P = self._state(seen.robot, number)
                model = MODELS[seen.model]
                G_x, G_z = model.invert_jacobians(seen.z, x)
                noise = G_z @ seen.cov @ G_z.T
                check_positive(noise, describe(seen))
                self._landmarks[seen.target] = (model.invert(seen.z, x), G_x @ P @ G_x.T + noise)

    def _append(self, robot: str, time_ns: int, pose: Array, cov: Array) -> None:
        self._states.append(robot, time_ns)
        self._track.append(robot, time_ns, pose, cov)

    def _state(self, robot: str, number: int) -> tuple[Array, Array]:
        """Pose (3,) and covariance (3, 3) of a robot's state."""
        return self._track.poses[robot][number], self._track.covs[robot][number]

    def joint(
        self, robot: str, landmarks: Sequence[int], others: Sequence[str] = ()
    ) -> JointMarginal:
        """See `Backend`; poses and landmarks are taken as independent."""
        marginals = [self._state(robot, self._states.latest(robot))]
        marginals += [self._landmarks[i] for i in landmarks]
        marginals += [self._state(other, self._states.latest(other)) for other in others]
        means, covs = zip(*marginals, strict=True)
        return JointMarginal.of(means, len(landmarks), block_diag(*covs))

    def state_mean(self, robot: str) -> Array:
        """See `Backend`."""
        return self._track.poses[robot][self._states.latest(robot)]

    def landmark_means(self, landmarks: Sequence[int]) -> list[Array]:
        """See `Backend`."""
        return [self._landmarks[i][0] for i in landmarks]

    def finish(self) -> Estimate:
        """See `Backend`."""
        return Estimate(self._track.trajectories(), dict(self._landmarks), 0.0, 0)
