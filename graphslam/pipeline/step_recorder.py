"""Steps into the back end, and what is recorded of them: states, calibration, covariances."""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from graphslam.core.config import Config
from graphslam.core.errors import EstimationError
from graphslam.core.geometry import Array, rotation3
from graphslam.core.motion_models import HELD_SIGMA, of_odometry
from graphslam.core.records import Association, Estimate, Motion, Step
from graphslam.estimation.backends import BACKENDS
from graphslam.estimation.batch_calibration import calibrate_so_far, recompute_motions
from graphslam.estimation.compressed_filter import CompressedBackend
from graphslam.estimation.fixed_lag import FixedLagBackend
from graphslam.logs import LogSet
from graphslam.mapping.data_association import Associator
from graphslam.odometry.online_calibration import observed_information
from graphslam.odometry.preintegration import Track
from graphslam.pipeline.keyframes import KeyframeSelector
from graphslam.pipeline.log_pass import LogPass, PriorKnowledge, timed

#: the scans of one robot are solved as a whole after so many steps, and again whenever there are so
#: many times as many, so that all solutions together cost five times the last one. Without them
#: Intel's causal relations had half as much error again (before `perception.breaks`). From 20 steps
#: on, parts of 450 s gain (Intel 0.026 instead of 0.033 m), whole logs do not: docs/tried-live.md
FIRST_BATCH_STEP, BATCH_STEP_GROWTH = 100, 1.25
#: before so many steps, a solution is used if it knows the odometry's parameters to this share of
#: their sigmas before any data: a scale that is not known yet would move the robot and back
OBSERVED_SHARE = 0.5


class StepRecorder(LogPass):
    """A pass that gives each step to a back end, and its observations to an associator.

    ``next_batch_step``: the number of steps at which there is the next `batch_step`;
    ``batch_is_due``: whether it is to be done, or goes on.
    """

    first_batch_step, batch_step_growth = FIRST_BATCH_STEP, BATCH_STEP_GROWTH

    def __init__(
        self, log: LogSet, config: Config, known: PriorKnowledge, *, batch_steps: bool = True
    ) -> None:
        """Without states, see `LogPass`; ``batch_steps``: whether `batch_step` is used."""
        super().__init__(log, config, known)
        self.backend = BACKENDS[self.config.backend.name](self.config)
        self.associator = Associator(self.config.association, self.backend, self.landmarks)
        self.rejected = self.associator.rejected
        self.innovations = self.associator.innovations
        # several robots' starts are told with the errors of the mounts, see `start_prior`: a mount
        # that is not told yet would move them. Sightings have passes of their own
        alone = len(log.robots) == 1 and log.has_scans(log.robots[0])
        wanted = batch_steps and alone and self.config.odometry.calibrate
        starts = known.recorded.start_times()
        # scans have states of their own nearby, each checked against the one before
        self._closure_starts = {r: deque(t) for r, t in starts.items() if not log.has_scans(r)}
        self.batch_is_due = False
        self.next_batch_step = self.first_batch_step if wanted and self.restarts() else math.inf

    def restarts(self) -> bool:
        """Whether the back end may go on from a solution of all steps: it has no horizon."""
        return isinstance(self.backend, CompressedBackend)

    @property
    def skipped(self) -> Mapping[str, int]:
        """See `LogPass`."""
        return {**self.skipped_before, **self.backend.skipped}

    def start(self, robot: str, time_ns: int) -> None:
        """Give a robot its first state.

        Raises:
            EstimationError: it is not known where.
        """
        if (known := self.known.calibrations.get(robot)) is not None:
            run = self.runs[robot]
            run.track.calibration = run.calibrator.restart(run.track.prior, known)
        step = self.start_step(robot, time_ns)
        self.record_covariances()
        self.backend.add(step)
        self.steps.append(step)
        self.record_state(robot, time_ns, self.backend.state_mean(robot))

    def start_step(self, robot: str, time_ns: int) -> Step:
        """The step that gives a robot its first state."""
        return Step(time_ns, starts={robot: self.start_prior(robot)})

    def start_if_needed(self, robot: str) -> None:
        """Give a robot its first state, where its odometry begins."""
        run = self.runs[robot]
        if not run.started:
            self.start(robot, run.track.first_ns)

    def has_started(self, robot: str, time_ns: int) -> bool:
        """Whether a robot has a state at ``time_ns``, given one if its start pose is known."""
        run = self.runs[robot]
        if robot in self.starts and len(run.track) and run.track.first_ns <= time_ns:
            self.start_if_needed(robot)
        return run.started

    def add_closure_starts(self, robot: str, now_ns: int, keyframes: KeyframeSelector) -> None:
        """Give a robot states where recorded closures start that will be used, up to now.

        Without one a closure would be carried to the last state before by odometry that the motions
        between states have in them already.
        """
        waiting, run = self._closure_starts.get(robot, deque()), self.runs[robot]
        while waiting and waiting[0] <= now_ns:
            start_ns = waiting.popleft()
            motion = self.motion_since_state(robot, start_ns)
            if motion is not None and keyframes.has_moved(run, run.state_ns, start_ns):
                run.path_m += motion.length_m
                self.record_covariances()
                self.add_step(Step(start_ns, {}, {robot: motion}))

    def motion_since_state(self, robot: str, time_ns: int) -> Motion | None:
        """Motion since the robot's last state; None when it is at that very time."""
        run = self.runs[robot]
        if time_ns <= run.state_ns:
            return None
        return run.track.motion(run.state_ns, time_ns)

    def add_step(self, step: Step, offers: Sequence[Association] = ()) -> None:
        """Give a step to the back end and learn from it.

        Args:
            step: what enters.
            offers: what the sightings of robots in it could be, see `LogPass`.
        """
        if not (step.motions or step.associations or step.closures):
            return
        step = replace(step, deleted=self.associator.take_deleted())
        admitted = self.associator.take_admitted()
        with timed(self.seconds, "back end"):
            self.backend.add(step)
            self.associator.settle()
            if offers:
                self.offers[len(self.steps)] = tuple(offers)
            self.steps.append(step)
            poses = {name: self.backend.state_mean(name) for name in step.motions}
            if self.config.odometry.calibrate:
                self.learn(step, poses, admitted)
            if len(self.steps) >= self.next_batch_step:
                self.next_batch_step = round(self.batch_step_growth * len(self.steps))
                self.batch_is_due = True
            if self.batch_is_due and self.batch_step():
                poses = {name: self.runs[name].latest_pose for name in poses}
            for name, pose in poses.items():
                self.record_state(name, step.time_ns, pose)

    def batch_step(self) -> bool:
        """Solve all steps so far with the calibrations; the back end goes on from there.

        Returns:
            Whether that was done, see `solve_steps`.
        """
        self.batch_is_due = False
        found = self.solve_steps()
        if found is None or not isinstance(self.backend, CompressedBackend):
            return False
        self.backend.restart(self.steps, found)
        for name in self.started:
            self.runs[name].latest_pose = self.backend.state_mean(name)
        return True

    def solve_steps(self) -> Estimate | None:
        """A solution of all steps so far with the calibrations, which go on from there.

        An incremental estimate lags behind its minimum: variables are linearised, and observations
        of lines slid along them, where they were believed to be. And what the calibration was taken
        for at first has bent the path, which the back end takes for independent errors of the
        motions. The periodic batch steps of M. Kaess et al., iSAM: Incremental Smoothing and
        Mapping, T-RO 24(6), 2008, DOI 10.1109/TRO.2008.2006706.

        Returns:
            None if there is nothing to calibrate, as without odometry, if the back end is of
            another kind, if the solution fails, or knows too little of the calibration yet.
        """
        tracks = {name: run.track for name, run in self.started.items()}
        held = all(track.prior.is_held for track in tracks.values())
        if held or not isinstance(self.backend, CompressedBackend | FixedLagBackend):
            return None
        before = {name: track.calibration for name, track in tracks.items()}
        try:
            found = calibrate_so_far(
                self.steps, self.backend.current_estimate(), tracks, self.config.robust
            )
        except EstimationError:  # the tree goes on with QR where this calls it indeterminate
            return None
        if len(self.steps) < FIRST_BATCH_STEP and not all(map(_is_observed, tracks.values())):
            for name, track in tracks.items():
                track.calibration = before[name]
            return None
        self.steps[:] = recompute_motions(self.steps, tracks)
        for name, track in tracks.items():
            calibrator = self.runs[name].calibrator
            track.calibration = calibrator.restart(track.prior, track.calibration)
        return found

    def learn(self, step: Step, poses: Mapping[str, Array], admitted: set[int]) -> None:
        """Improve robots' calibration from a step.

        Args:
            step: as the back end has it.
            poses: (3,) estimates of the states that it made.
            admitted: landmarks that were not there before it.
        """
        seen = [
            a
            for a in step.associations
            if a.robot in poses
            and a.time_ns == step.time_ns
            and isinstance(a.target, int)
            and a.target not in admitted
        ]
        landmarks = self.backend.landmark_means([int(a.target) for a in seen])
        observed = observed_information(seen, poses, landmarks)
        for robot, pose in poses.items():
            turn = rotation3(-float(self.runs[robot].latest_pose[2]))
            self.runs[robot].learn(step.motions[robot], pose, turn @ observed[robot] @ turn.T)

    def record_state(self, robot: str, time_ns: int, pose: Array) -> None:
        """Record a new state, whose estimate is ``pose`` (3,)."""
        self.runs[robot].append(time_ns, pose)
        self.counts["keyframes"] += 1

    def record_covariances(self) -> None:
        """Record the causal covariance of states that have none yet.

        Asked for as late as possible, just before the next step: by then association has needed
        the same marginal, and reading it from an incremental smoother is expensive.
        """
        for robot, run in self.runs.items():
            if len(run.causal_covs) < len(run.times):
                run.causal_covs.append(self.backend.joint(robot, []).cov)


def _is_observed(track: Track) -> bool:
    """Whether the calibration of a track's odometry is known much better than before any data."""
    own = of_odometry(track.prior)
    sigma, prior = (np.sqrt(np.diag(c.cov))[own] for c in (track.calibration, track.prior))
    return bool(((sigma < OBSERVED_SHARE * prior) | (prior <= HELD_SIGMA)).all())
