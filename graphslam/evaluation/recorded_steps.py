"""The steps of one run over a log, and a result from what a back end makes of them."""

import time
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.config import Config
from graphslam.core.errors import EstimationError, LogError
from graphslam.core.geometry import Array
from graphslam.core.records import Step
from graphslam.core.suggestions import start_option
from graphslam.estimation.replay import Replay
from graphslam.logs import LogSet
from graphslam.mapping.landmark_map import LandmarkMap
from graphslam.mapping.landmark_records import make_landmarks
from graphslam.odometry.interpolation import FrameTransforms
from graphslam.pipeline.log_pass import Progress
from graphslam.pipeline.pipeline import Pipeline
from graphslam.pipeline.robot_settings import check_robots
from graphslam.pipeline.robot_state import RobotState
from graphslam.results.folder import SavedResult, SavedRobot
from graphslam.results.joint_file import joint_scans
from graphslam.slam.initialisation import initialise


@dataclass(frozen=True, slots=True, eq=False)
class RecordedSteps:
    """The steps of one run over a log, and what is needed to make a result of their estimate.

    ``start`` (3,) is where the prior put the robot that defines the world frame, ``worlds`` what
    takes estimates there; ``seconds`` the wall time of the run.
    """

    steps: tuple[Step, ...]
    runs: Mapping[str, RobotState]
    start: Array
    worlds: FrameTransforms
    landmarks: LandmarkMap
    seconds: float

    @property
    def associations(self) -> int:
        """Number of associations in all steps, late ones included."""
        return sum(len(step.associations) for step in self.steps)

    def growth(self) -> tuple[Array, Array]:
        """Landmarks in the map (n,) and path driven by all robots (n,), m, after each step."""
        known: set[int | str] = set()
        counts, driven = [], []
        for step in self.steps:
            known |= {seen.target for seen in step.associations if isinstance(seen.target, int)}
            counts.append(float(len(known)))
            driven.append(sum(motion.length_m for motion in step.motions.values()))
        return np.array(counts), np.cumsum(driven)

    def with_recorded_odometry(self) -> "RecordedSteps":
        """The same with motions as the robots recorded them: uncalibrated, corrected by no scan."""
        runs = {}
        steps = [dict(step.motions) for step in self.steps]
        for robot, run in self.runs.items():
            track = deepcopy(run.track)
            track.calibration = track.prior
            known = [track.used_calibration] * len(run.times)
            runs[robot] = replace(run, track=track, calibrations=known)
            own = [motions for motions in steps if robot in motions]
            ends = [(motions[robot].start_ns, motions[robot].end_ns) for motions in own]
            made = track.motions(*np.array(ends, dtype=np.int64).reshape(-1, 2).T)
            for n, motions in enumerate(own):
                motions[robot] = made.one(n, *ends[n])
        made_steps = (replace(step, motions=m) for step, m in zip(self.steps, steps, strict=True))
        return replace(self, runs=runs, steps=tuple(made_steps))

    def result(self, done: Replay, config: Config) -> SavedResult:
        """Trajectories and map of a replay, as `smooth` makes them.

        The odometry between the states, the calibration and the mounts are those of the recording.
        """
        estimate = self.worlds.estimate(done.estimate)
        runs = {
            name: replace(
                run,
                causal_poses=list(done.causal[name].poses),
                causal_covs=list(done.causal[name].covs),
            )
            for name, run in self.runs.items()
        }
        causal_only = all(run.is_causal(done.estimate.states[name]) for name, run in runs.items())
        found = {
            name: run.result(estimate.states[name], run.causal(self.start), causal_only=causal_only)
            for name, run in runs.items()
        }
        robots = {
            name: SavedRobot(own.final, own.causal, own.scan_final, own.scan_causal)
            for name, own in found.items()
        }
        moved = self.landmarks.transformed(self.worlds.landmarks)
        landmarks = make_landmarks(moved, estimate)
        return SavedResult(robots, landmarks, {}, config, joint_scans(estimate, found))


def record_steps(
    log: LogSet, config: Config, progress: Progress = lambda _count: None
) -> RecordedSteps:
    """Run over the log with the back end of ``config`` and keep the steps, without optimising.

    Raises:
        LogError: no message of the log could be used.
        ConfigError: a setting is about a robot that is not in the log.
        EstimationError: the estimate is indeterminate, or a robot's start is unknown.
    """
    check_robots(log, config)
    began = time.perf_counter()
    # batch steps change the motions of all steps by what is known of the calibration later, which
    # no back end that replays them knows then
    pipeline = Pipeline(log, config, initialise(log, config), batch_steps=False)
    pipeline.run(progress)
    if not pipeline.steps:
        raise LogError(f"{log.files[0].path}: nothing in it could be used; see `graphslam info`")
    apart = pipeline.frames.away
    if apart:
        raise EstimationError(
            f"robot {min(apart)}: its start is unknown and cannot be found from the log; "
            f"back ends are compared in one frame: give {start_option(min(apart))}"
        )
    runs = {name: run for name, run in sorted(pipeline.runs.items()) if run.started}
    return RecordedSteps(
        tuple(pipeline.steps),
        runs,
        pipeline.starts[pipeline.frames.world].pose,
        pipeline.transforms(),
        pipeline.landmarks,
        time.perf_counter() - began,
    )
