"""Steps into the back end, and what is recorded of them: states, calibration, covariances."""

import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

from graphslam.core.config import Config
from graphslam.core.errors import EstimationError
from graphslam.core.geometry import Array, rotate_cov, rotation3
from graphslam.core.records import Motion, Start, Step
from graphslam.estimation.backends import BACKENDS
from graphslam.logs import LogSet
from graphslam.logs.clock import Clock
from graphslam.mapping.data_association import Associator
from graphslam.multi_robot.frame_tree import FrameAssignment
from graphslam.multi_robot.frames import RobotFrames
from graphslam.multi_robot.relative_frames import RobotEstimate
from graphslam.odometry.interpolation import FrameTransforms
from graphslam.odometry.online_calibration import observed_information
from graphslam.slam.recorded_closures import RecordedClosures
from graphslam.slam.robot_settings import make_tracks, noted
from graphslam.slam.robot_state import RobotState


@dataclass(frozen=True, slots=True, eq=False)
class PriorKnowledge:
    """What is known before a log is read: what was given, and what earlier passes found.

    ``frame_assignment``: start poses and frames of the robots. ``recorded``: which relative poses
    of the log are accepted. ``identities``: false identity -> right one, of what is sighted.
    ``clocks``: of robots whose clock is not that of the first. ``alone``: estimates of robots by
    themselves, from which their relative poses were found.
    """

    frame_assignment: FrameAssignment
    recorded: RecordedClosures
    identities: Mapping[str, str] = field(default_factory=dict)
    clocks: Mapping[str, Clock] = field(default_factory=dict)
    alone: Mapping[str, RobotEstimate] = field(default_factory=dict)


@contextmanager
def timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Adds the wall time of its body to a stage's."""
    began = time.perf_counter()
    yield
    seconds[stage] += time.perf_counter() - began


class StepRecorder:
    """The back end, the landmark map and the robots of one pass; all change step by step."""

    def __init__(self, log: LogSet, config: Config, known: PriorKnowledge) -> None:
        """Without states; keyframe settings noted in the log replace defaults of ``config``."""
        self.given_config = config
        config = replace(config, keyframe=noted(config.keyframe, "keyframe", log.notes))
        self.log, self.config, self.known = log, config, known
        self.backend = BACKENDS[config.backend.name](config)
        self.associator = Associator(config.association, self.backend)
        self.runs = {
            name: RobotState(track, clock=known.clocks.get(name, Clock()))
            for name, track in make_tracks(log, config).items()
        }
        self.starts = known.frame_assignment.starts
        self.frames = RobotFrames(known.frame_assignment)
        self.steps: list[Step] = []
        self.counts: Counter[str] = Counter()
        self.seconds: dict[str, float] = defaultdict(float)
        self.first_ns, self.last_ns = 1 << 63, 0

    @property
    def started(self) -> dict[str, RobotState]:
        """The robots that have a state, sorted by name."""
        return {name: run for name, run in sorted(self.runs.items()) if run.started}

    def prior(self, robot: str) -> Start:
        """The prior of a robot's first state.

        Raises:
            EstimationError: it is not known where the robot starts.
        """
        if robot not in self.starts:
            raise EstimationError(
                f"robot {robot}: its start is unknown; give --start {robot}=x,y,phi (m, rad) or "
                "--start truth"
            )
        start = self.frames.offset_start(robot, self.starts[robot])
        if robot != self.frames.of[robot]:
            # priors are on the base, states on the sensor: where it sits is not known yet, nor is
            # where that of the first robot sits, to which the world is fixed
            cov = start.cov + rotate_cov(2 * self.runs[robot].track.mount_cov, start.pose[2])
            start = replace(start, cov=cov)
        return start

    def start(self, robot: str, time_ns: int) -> None:
        """Give a robot its first state.

        Raises:
            EstimationError: it is not known where.
        """
        step = Step(time_ns, starts={robot: self.prior(robot)})
        self.record_covariances()
        self.backend.add(step)
        self.steps.append(step)
        self.record_state(robot, time_ns, self.backend.state_mean(robot))

    def start_if_needed(self, robot: str, time_ns: int) -> None:
        """Give a robot its first state, at ``time_ns`` or where its odometry begins, if earlier."""
        run = self.runs[robot]
        if not run.started:
            self.start(robot, min(run.track.first_ns, time_ns))

    def has_started(self, robot: str, time_ns: int) -> bool:
        """Whether a robot has a state at ``time_ns``, given one if its start pose is known."""
        run = self.runs[robot]
        if robot in self.starts and len(run.track):
            self.start_if_needed(robot, time_ns)
        return run.started

    def motion_since_state(self, robot: str, time_ns: int) -> Motion | None:
        """Motion since the robot's last state; None when it is at that very time."""
        run = self.runs[robot]
        if time_ns <= run.state_ns:
            return None
        return run.track.motion(run.state_ns, time_ns)

    def add_step(self, step: Step, known: set[int]) -> None:
        """Give a step to the back end and learn from it; ``known`` landmarks were there before."""
        if not (step.motions or step.associations or step.closures):
            return
        with timed(self.seconds, "back end"):
            self.backend.add(step)
            self.associator.settle()
            self.steps.append(step)
            poses = {name: self.backend.state_mean(name) for name in step.motions}
            if self.config.odometry.calibrate:
                self.learn(step, poses, known)
            for name, pose in poses.items():
                self.record_state(name, step.time_ns, pose)

    def learn(self, step: Step, poses: Mapping[str, Array], known: set[int]) -> None:
        """Improve robots' calibration from a step.

        Args:
            step: as the back end has it.
            poses: (3,) estimates of the states that it made.
            known: landmarks that were there before it.
        """
        seen = [
            a
            for a in step.associations
            if a.robot in poses and a.time_ns == step.time_ns and a.target in known
        ]
        landmarks = self.backend.landmark_means([a.target for a in seen if a.target in known])
        observed = observed_information(seen, poses, landmarks)
        for robot, pose in poses.items():
            turn = rotation3(-float(self.runs[robot].causal_poses[-1][2]))
            self.runs[robot].learn(step.motions[robot], pose, turn @ observed[robot] @ turn.T)

    def record_time(self, time_ns: int) -> None:
        """Extend the span of the log by a time."""
        self.first_ns, self.last_ns = min(self.first_ns, time_ns), max(self.last_ns, time_ns)

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

    def transforms(self) -> FrameTransforms:
        """What takes every robot and landmark from where it was estimated into its frame."""
        tracks = {name: run.track for name, run in self.runs.items()}
        return self.frames.transforms(tracks, self.associator.map.entries.values())
