"""What one pass over a log accumulates, whatever it does with the messages."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from graphslam.core.config import Config
from graphslam.core.errors import EstimationError
from graphslam.core.geometry import rotate_cov
from graphslam.core.motion_models import Calibration
from graphslam.core.records import Association, KeyframeScan, Sighting, Start, Step
from graphslam.core.suggestions import start_option
from graphslam.logs import LogSet
from graphslam.logs.clock import Clock
from graphslam.mapping.doubled_walls import Displacement
from graphslam.mapping.known_map import KnownMap
from graphslam.mapping.landmark_map import LandmarkMap
from graphslam.multi_robot.frame_tree import FrameAssignment
from graphslam.multi_robot.frames import RobotFrames
from graphslam.multi_robot.relative_frames import RobotEstimate
from graphslam.odometry.interpolation import FrameTransforms
from graphslam.pipeline.progress import Progress, counted, timed
from graphslam.pipeline.recorded_closures import RecordedClosures
from graphslam.pipeline.robot_settings import make_tracks, with_log_settings
from graphslam.pipeline.robot_state import RobotState
from graphslam.pipeline.scan_evidence import Parked
from graphslam.pipeline.scans_since_keyframe import ScansSinceKeyframe


@dataclass(frozen=True, slots=True, eq=False)
class PriorKnowledge:
    """What is known before a log is read: what was given, and what earlier passes found.

    ``frame_assignment``: start poses and frames of the robots. ``recorded``: which relative poses
    of the log are accepted. ``identities``: false identity -> right one, of what is sighted.
    ``clocks``: of robots whose clock is not that of the first. ``alone``: estimates of robots by
    themselves, from which their relative poses were found. ``known_map``: of an earlier result;
    ``map_doubt``: of where the log was placed in it.
    ``calibrations``: robot -> that which an earlier pass found far from its prior.
    """

    frame_assignment: FrameAssignment
    recorded: RecordedClosures
    identities: Mapping[str, str] = field(default_factory=dict)
    clocks: Mapping[str, Clock] = field(default_factory=dict)
    alone: Mapping[str, RobotEstimate] = field(default_factory=dict)
    known_map: KnownMap | None = None
    map_doubt: str = ""
    calibrations: Mapping[str, Calibration] = field(default_factory=dict)


class LogPass:
    """The robots, landmarks and steps of one pass over a log, and its counts and times.

    ``sources`` are the sightings that `Association.source` numbers (steps of several images only);
    ``robot_sightings`` those of robots at their own time, which it numbers otherwise; ``offers``:
    number of a step -> what its sightings of robots could be, used or not. ``rejected`` counts
    observations and ``removed_returns`` returns that were not used, by reason; ``innovations``:
    model -> (time, squared distance per degree of freedom) of accepted observations.
    ``parked``: when robots stood (`find_parked`), where that has been asked already.
    """

    def __init__(self, log: LogSet, config: Config, known: PriorKnowledge) -> None:
        """Without states; what the log says replaces defaults of ``config``."""
        self.given_config = config
        config = with_log_settings(log, config)
        self.log, self.config, self.known = log, config, known
        self.runs = {
            name: RobotState(
                track,
                clock=known.clocks.get(name, Clock()),
                has_scans=log.has_scans(name),
                since_keyframe=ScansSinceKeyframe.of_smoother(config, track),
            )
            for name, track in make_tracks(log, config).items()
        }
        self.kernel = config.robust  # of the final estimate
        self.noise: dict[str, Any] = {}  # of summary.json
        #: of sensors of sightings: name -> value, which is corrected, sigma, whether it is told
        self.sensor_errors: dict[str, tuple[float, float, bool]] = {}
        self.sensor_warnings: list[str] = []
        self.starts = known.frame_assignment.starts
        self.frames = RobotFrames(known.frame_assignment)
        scans = any(map(log.has_scans, log.robots))
        self.landmarks = LandmarkMap(
            config.front_end.floor_normal_m if scans else 0.0, config.limits.landmarks
        )
        self.steps: list[Step] = []
        self.sources: list[Sighting] = []
        self.robot_sightings: list[Sighting] = []
        self.offers: dict[int, tuple[Association, ...]] = {}
        self.keyframe_scans: list[KeyframeScan] = []
        self.map_doubt = known.map_doubt  # of where it was placed in a known map
        self.parked: Mapping[str, Sequence[Parked]] | None = None
        #: landmarks that were moved: number -> the landmark that they were before
        self.moved: Mapping[int, int] = {}
        #: of visits, from where their walls of the building were seen before
        self.displacements: Mapping[str, Displacement] = {}
        self.counts: Counter[str] = Counter()
        self.skipped_before: Mapping[str, int] = {}  # by the run that this one goes on with
        self.dropped: Counter[str] = Counter()
        self.rejected: Counter[str] = Counter()
        self.removed_returns: Counter[str] = Counter()
        self.innovations: dict[str, list[tuple[int, float]]] = {}
        self.seconds: dict[str, float] = defaultdict(float)
        self.step_ms: list[float] = []
        self.first_ns, self.last_ns = 1 << 63, 0

    @property
    def skipped(self) -> Mapping[str, int]:
        """Number of observations and closures that the back end could not use, by reason."""
        return self.skipped_before

    @property
    def started(self) -> dict[str, RobotState]:
        """The robots that have a state, sorted by name."""
        return {name: run for name, run in sorted(self.runs.items()) if run.started}

    def start_prior(self, robot: str) -> Start:
        """Prior of a robot's first state.

        Raises:
            EstimationError: it is not known where.
        """
        if robot not in self.starts:
            raise EstimationError(
                f"robot {robot}: its start is unknown; give {start_option(robot)} (m, rad) or "
                "--start truth"
            )
        start = self.frames.offset_start(robot, self.starts[robot])
        if not self.known.alone:  # nothing had to be found: the starts were told
            start = replace(start, base_cov=start.cov)
        if robot != self.frames.of[robot]:
            # priors are on the base, states on the sensor: where it sits is not known yet, nor is
            # where that of the first robot sits, to which the world is fixed
            cov = start.cov + rotate_cov(2 * self.runs[robot].track.mount_cov, start.pose[2])
            start = replace(start, cov=cov)
        return start

    def record_time(self, time_ns: int) -> None:
        """Extend the span of the log by a time."""
        self.first_ns, self.last_ns = min(self.first_ns, time_ns), max(self.last_ns, time_ns)

    def transforms(self) -> FrameTransforms:
        """What takes every robot and landmark from where it was estimated into its frame."""
        if self.known.known_map is not None:  # which says where the world is
            nowhere = np.zeros(3)
            entries = self.landmarks.entries
            return FrameTransforms(
                dict.fromkeys(self.runs, nowhere), dict.fromkeys(entries, nowhere)
            )
        tracks = {name: run.track for name, run in self.runs.items()}
        return self.frames.transforms(tracks, self.landmarks.entries.values())


__all__ = ["LogPass", "PriorKnowledge", "Progress", "counted", "timed"]
