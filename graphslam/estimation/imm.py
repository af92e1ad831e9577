"""Interacting multiple models: the extended Kalman filter of robots whose wheels sometimes slip.

A robot's motion is either `normal`, with the noise that odometry states, or `slipping`, with more
of it; which one is a Markov chain from motion to motion. The filter keeps a Gaussian of the whole
state per mode. Before a motion they are mixed by the probabilities of the chain's transitions,
afterwards each is weighted by the likelihood of the innovations under it, and what is asked for is
the mean and covariance of their mixture (H. Blom, Y. Bar-Shalom, IEEE TAC 33(8), 1988,
https://doi.org/10.1109/9.1299).

Modes of several robots would be combined: 2^m Gaussians for m of them. Here the modes of one robot
at a time are apart, the one that moved last. When another one moves, its two Gaussians become one
with their mean and covariance, and of its mode only the probabilities are kept. For that a robot's
observations of a step come before the motion of the next, except those of robots that have not
moved yet. So any number of robots costs twice what `EkfBackend` does.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from graphslam.core.config import Config, RobustConfig
from graphslam.core.errors import ConfigError
from graphslam.core.gaussian import JointGaussian
from graphslam.core.geometry import Array, wrap
from graphslam.core.observation_models import ObservationModel
from graphslam.core.records import Association, Motion, Start, Step
from graphslam.estimation.ekf import EkfBackend
from graphslam.estimation.filter_base import Member

#: rows of the transition matrix and elements of probabilities
NORMAL, SLIPPING = 0, 1


class ImmBackend(EkfBackend):
    """The filter; its errors are additive along world axes, whatever `ekf.error`.

    ``_modes`` are the Gaussians of robot ``_robot``'s modes, with their probabilities in
    ``_probability``; one Gaussian before anything has moved. ``_gaussian`` is their mixture's mean
    and covariance, from which queries are answered; during a step, whichever is being worked on.
    """

    def __init__(self, config: Config) -> None:
        """Raise ConfigError unless both modes can begin and go on, and slipping has its noise."""
        imm = config.imm
        slip, grip = imm.slip_probability, imm.grip_probability
        if not (0 < slip < 1 and 0 < grip < 1):
            raise ConfigError("imm.slip_probability, imm.grip_probability: give some inside 0 to 1")
        if not imm.slip_scale > 0:
            raise ConfigError("imm.slip_scale: give a number above 0")
        super().__init__(replace(config, ekf=replace(config.ekf, error="world")))
        self._transition = np.array([[1 - slip, slip], [grip, 1 - grip]])
        self._stretch = (1.0, imm.slip_scale**2)  # of a motion's covariance, by mode
        self._modes: list[JointGaussian[Member]] = [self._gaussian]
        self._robot: str | None = None
        self._probability: dict[str | None, Array] = {None: np.ones(1)}
        self._log_likelihood = 0.0  # of the innovation that was used last, but for a constant

    def slipping(self, robot: str) -> float:
        """Probability that the robot's latest motion was slipping; before the first: of any."""
        return float(self._probability.get(robot, self._any_motion())[SLIPPING])

    def _any_motion(self) -> Array:
        """Stationary probabilities (2,) of the chain."""
        slip, grip = self._transition[NORMAL, SLIPPING], self._transition[SLIPPING, NORMAL]
        return np.array([grip / (slip + grip), slip / (slip + grip)])

    def _advance(self, step: Step) -> None:
        """See `FilterBackend`; each robot's observations before the next one's motion."""
        waiting, rest = set(step.motions), list(step.associations)
        for robot, motion in step.motions.items():
            self._move_to(robot, step.time_ns, motion)
            waiting.discard(robot)
            ready = [seen for seen in rest if not waiting & {seen.robot, seen.target}]
            rest = [seen for seen in rest if waiting & {seen.robot, seen.target}]
            self._observe_step(Step(step.time_ns, associations=tuple(ready)))
        self._observe_step(Step(step.time_ns, {}, {}, tuple(rest), step.closures))
        self._gaussian = mixture(self._modes, self._probability[self._robot])

    def _start(self, robot: str, start: Start) -> None:
        for mode in self._modes:
            self._gaussian = mode
            super()._start(robot, start)

    def remove(self, landmark: int) -> None:
        """See `EkfBackend`."""
        merged = self._gaussian
        for one in (*(mode for mode in self._modes if mode is not merged), merged):
            self._gaussian = one
            super().remove(landmark)

    def _move(self, robot: str, motion: Motion) -> None:
        """Mix the modes and move each with its own noise."""
        before = self._probability.get(robot, self._any_motion())
        now = before @ self._transition
        if robot == self._robot:
            given = self._transition * before[:, None] / now  # of the mode before, by the mode now
            self._modes = [mixture(self._modes, column) for column in given.T]
        else:
            merged = mixture(self._modes, self._probability[self._robot])
            self._modes = [merged, merged.copied()]
        self._robot, self._probability[robot] = robot, now
        for mode, stretch in zip(self._modes, self._stretch, strict=True):
            self._gaussian = mode
            super()._move(robot, replace(motion, cov=stretch * motion.cov))

    def _augment(self, seen: Association, source: Member) -> None:
        for mode in self._modes:
            self._gaussian = mode
            super()._augment(seen, source)

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
        """Update every mode, and the modes' probabilities."""
        error, dof, errors, log_likelihoods = self._twice_error, self._dof, [], []
        for mode in self._modes:
            self._gaussian = mode
            super()._update(source, target, model, z, cov, what, kernel)
            errors.append(self._twice_error - error)
            log_likelihoods.append(self._log_likelihood)
            self._twice_error = error
        weights = np.exp(np.array(log_likelihoods) - max(log_likelihoods))
        weights *= self._probability[self._robot]
        self._probability[self._robot] = weights / weights.sum()
        self._twice_error += float(self._probability[self._robot] @ errors)
        self._dof = dof + model.rows

    def _use(self, d2: float, S: Array) -> None:
        super()._use(d2, S)
        self._log_likelihood = -0.5 * (d2 + float(np.linalg.slogdet(S)[1]))


def mixture(gaussians: Sequence[JointGaussian[Member]], weights: Array) -> JointGaussian[Member]:
    """A new Gaussian with the mean and covariance of a mixture, errors additive along world axes.

    Args:
        gaussians: r of them, of the same members in the same order; those of size 3 are poses.
        weights: (r,), which sum to 1.
    """
    first = gaussians[0]
    apart = np.array([one.x - first.x for one in gaussians])
    headings = first.blocks(3)[:, 2]
    apart[:, headings] = wrap(apart[:, headings])
    mean = weights @ apart
    spread = apart - mean
    made = first.copied()
    made.x[:] += mean
    made.x[headings] = wrap(made.x[headings])
    P = np.einsum("r,rn,rm->nm", weights, spread, spread)
    for weight, one in zip(weights, gaussians, strict=True):
        P += weight * one.P
    made.P[:] = P
    return made
