"""Odometry alone: every landmark stays where it was first seen."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Literal

import numpy as np

from graphslam.core.config import Config
from graphslam.core.geometry import Array, compose, compose_cov
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Estimate, Step, Trajectory
from graphslam.estimation.backend import Joint, StateTable, block_slices
from graphslam.estimation.input_checks import check_finite, check_positive, sighting


class DeadReckoningBackend:
    """The baseline that uses no observation for the trajectory."""

    smooths = False
    error_frame: Literal["body", "world"] = "world"
    skipped: Mapping[str, int] = MappingProxyType({})  # leaving out is what it is for

    def __init__(self, _config: Config) -> None:
        self._states = StateTable()
        self._poses: dict[str, list[Array]] = {}
        self._covs: dict[str, list[Array]] = {}
        self._landmarks: dict[int, tuple[Array, Array]] = {}

    def add(self, step: Step) -> None:
        """See `Backend`."""
        for robot, start in step.starts.items():
            what = f"start of robot {robot} at {step.time_ns} ns"
            check_finite(what, start.pose, start.cov)
            self._append(robot, step.time_ns, start.pose, start.cov)
        for robot, motion in step.motions.items():
            last = self._states.latest(robot, step.time_ns)
            what = f"motion of robot {robot} to {step.time_ns} ns"
            check_finite(what, motion.delta, motion.cov)
            x, P = self._poses[robot][last], self._covs[robot][last]
            moved = compose(x, motion.delta)
            self._append(robot, step.time_ns, moved, compose_cov(x, P, motion.delta, motion.cov))
        for seen in step.associations:
            number = self._states.number(seen.robot, seen.time_ns)
            if isinstance(seen.target, int) and seen.target not in self._landmarks:
                check_finite(sighting(seen), seen.z, seen.cov)
                x, P = self._poses[seen.robot][number], self._covs[seen.robot][number]
                model = MODELS[seen.model]
                G_x, G_z = model.invert_jacobians(seen.z, x)
                fresh = G_z @ seen.cov @ G_z.T
                check_positive(fresh, sighting(seen))
                cov = G_x @ P @ G_x.T + fresh
                self._landmarks[seen.target] = (model.invert(seen.z, x), cov)

    def _append(self, robot: str, time_ns: int, pose: Array, cov: Array) -> None:
        self._states.append(robot, time_ns)
        self._poses.setdefault(robot, []).append(pose)
        self._covs.setdefault(robot, []).append(cov)

    def joint(self, robot: str, landmarks: Sequence[int], others: Sequence[str] = ()) -> Joint:
        """See `Backend`; poses and landmarks are taken as independent."""
        last = self._states.latest(robot)
        found = [self._landmarks[i] for i in landmarks]
        found += [(self._poses[name][-1], self._covs[name][-1]) for name in others]
        slices = block_slices([len(mean) for mean, _ in found])
        cov = np.zeros((slices[-1].stop if slices else 3,) * 2)
        cov[:3, :3] = self._covs[robot][last]
        for block, (_, landmark_cov) in zip(slices, found, strict=True):
            cov[block, block] = landmark_cov
        means, n = tuple(mean for mean, _ in found), len(landmarks)
        return Joint(self._poses[robot][last], means[:n], cov, slices, means[n:])

    def state_mean(self, robot: str) -> Array:
        """See `Backend`."""
        return self._poses[robot][self._states.latest(robot)]

    def landmark_means(self, landmarks: Sequence[int]) -> list[Array]:
        """See `Backend`."""
        return [self._landmarks[i][0] for i in landmarks]

    def finish(self) -> Estimate:
        """See `Backend`."""
        states = {
            robot: Trajectory(
                self._states.stamps(robot),
                np.array(self._poses[robot]),
                np.array(self._covs[robot]),
            )
            for robot in sorted(self._poses)
        }
        return Estimate(states, dict(self._landmarks), 0.0, 0)
