"""Start poses of the robots: what is known of a log before its first pass.

Robots whose start is not given are placed relative to others by what they have observed in common.
That takes a pass over the log in which every robot is estimated in a separate frame. Afterwards
frames are related by landmarks with an identity, by robots detected in each other's scans, and else
by scans and points without identities.
"""

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from graphslam.core.config import BackendConfig, Config
from graphslam.core.geometry import Array
from graphslam.core.records import Estimate, Scan, Sighting, Start, Trajectory
from graphslam.estimation.isam2 import Isam2Backend
from graphslam.logs import LogSet
from graphslam.mapping.submaps import build_submaps
from graphslam.multi_robot.anonymous_map import AnonymousMap, relate_anonymous_maps
from graphslam.multi_robot.frame_tree import FrameAssignment, build_frame_tree
from graphslam.multi_robot.frames import logged_identity
from graphslam.multi_robot.mutual_detection import (
    MutualDetections,
    ScanBuffer,
    find_robots_in_scans,
)
from graphslam.multi_robot.place_recognition import PlaceMap
from graphslam.multi_robot.relative_frames import RelativeFrame, RobotEstimate
from graphslam.pipeline.log_pass import PriorKnowledge
from graphslam.pipeline.pipeline import CLOCK_OFFSET_SIGMA_S, Pipeline
from graphslam.pipeline.recorded_closures import RecordedClosures, judge_recorded_closures
from graphslam.pipeline.robot_settings import outlines
from graphslam.pipeline.start_priors import origin, start_poses
from graphslam.sighting_smoothing.sighting_pass import SightingPass, can_solve_at_once
from graphslam.sighting_smoothing.sighting_solution import solve_robots_apart

#: relative frames found without identities, and robot -> why it has none
Found = tuple[Sequence[RelativeFrame], Mapping[str, str]]


def initialise(log: LogSet, config: Config) -> PriorKnowledge:
    """What is known of a log before its first pass: starts, frames, recorded closures.

    Raises:
        EstimationError: truth was asked for and a robot has none, or a given pose is malformed.
    """
    starts = start_poses(log, config)
    recorded = judge_recorded_closures(log, config, starts)
    frames, alone = estimate_start_poses(log, config, {}, starts, recorded)
    return PriorKnowledge(frames, recorded, alone=alone)


def with_identities(
    known: PriorKnowledge, log: LogSet, config: Config, identities: Mapping[str, str]
) -> PriorKnowledge:
    """What is known with the right identities, as robots may have been placed by false ones."""
    starts = start_poses(log, config)
    frames, alone = estimate_start_poses(log, config, identities, starts, known.recorded)
    return replace(known, identities=identities, frame_assignment=frames, alone=alone)


def estimate_start_poses(
    log: LogSet,
    config: Config,
    identities: Mapping[str, str],
    starts: Mapping[str, Start],
    recorded: RecordedClosures,
) -> tuple[FrameAssignment, Mapping[str, RobotEstimate]]:
    """Start poses and frames of all robots, of which the ``starts`` of some are known.

    The others are placed by what they observed in common. That takes a pass over the log in which
    every robot is estimated by itself.

    Args:
        log: opened logs.
        config: settings.
        identities: see `PriorKnowledge`.
        starts: known start poses.
        recorded: relative poses of the log, and starts that follow from them.

    Returns:
        The start poses, and the estimates by which they were found.

    Raises:
        EstimationError: the estimate of a robot by itself is indeterminate.
    """
    every = {**starts, **recorded.starts}
    if set(log.robots) <= set(every):
        return FrameAssignment(every, recorded.frames, min(starts, default="")), {}
    starts = {r: s for r, s in every.items() if recorded.frames[r] == recorded.frames[min(starts)]}
    own = origin(config)

    def joined(
        views: Mapping[str, RobotEstimate], meetings: Sequence[Sighting], found: Found
    ) -> FrameAssignment:
        told = bool(config.start.poses or config.start.from_truth or recorded.starts)
        return build_frame_tree(
            log.robots, views, meetings, starts, config, own, *found, nobody_told=not told
        )

    if not any(topic.record in (Sighting, Scan) for topic in log.topics):
        return joined({}, (), ((), {})), {}
    apart = PriorKnowledge(FrameAssignment.separate_frames(log.robots, own), recorded, identities)
    config_apart = replace(config, backend=BackendConfig())
    if can_solve_at_once(log, config):
        together = SightingPass(log, config_apart, apart)
        together.run(lambda _count: None)
        if together.all_named and together.steps:
            views = separate_estimates(together, solve_robots_apart(together))
            return joined(views, together.unrelated_sightings, ((), {})), views
    pipeline = Pipeline(log, config_apart, apart)
    shapes = outlines(log, config) if config.association.robot_sightings != "ignore" else {}
    tracks = {name: run.track for name, run in pipeline.runs.items()}
    pipeline.scan_buffer = ScanBuffer(tracks, shapes, config.multi_robot.sampling_m)
    pipeline.run(lambda _count: None)
    if not pipeline.steps:
        return joined({}, (), ((), {})), {}
    views = separate_estimates(pipeline, pipeline.backend.finish())
    meetings = pipeline.unrelated_sightings
    looked = MutualDetections((), {})
    if has_detectable_robots(log, shapes, starts):
        scans = pipeline.scan_buffer.scans
        looked = find_robots_in_scans(
            views, scans, shapes, tuple(starts), CLOCK_OFFSET_SIGMA_S, config
        )
    by_name = joined(views, meetings, (looked.relations, looked.undecided))
    if len(set(by_name.frames.values())) == 1:
        return by_name, views
    more, doubts = relate_anonymous_maps(anonymous_maps(pipeline, views), by_name.frames, config)
    found = (*looked.relations, *more), {**doubts, **looked.undecided}
    return joined(views, meetings, found), views


def separate_estimates(run: Pipeline, estimate: Estimate) -> dict[str, RobotEstimate]:
    """Every robot's own estimate, after a pass in which each had a separate frame."""
    entries = run.landmarks.entries
    moved = run.transforms().estimate(estimate)
    frames = run.frames.landmark_frames(entries.values())
    marks: dict[str, dict[str, tuple[Array, Array]]] = defaultdict(dict)
    unnamed: dict[str, list[tuple[Array, Array]]] = defaultdict(list)
    for number, (mean, cov) in moved.landmarks.items():
        name = logged_identity(entries[number].identity)
        if name is not None:
            marks[frames[number]][name] = (mean[:2], cov[:2, :2])
        elif entries[number].kind == "point":
            unnamed[frames[number]].append((mean, cov))
    views = {}
    for robot, own in run.runs.items():
        if len(own.track):
            start = run.starts[robot]
            first = np.array([own.track.first_ns], dtype=np.int64)
            unseeing = Trajectory(first, start.pose[None], start.cov[None])
            points = (
                np.array([mean for mean, _ in unnamed[robot]]).reshape(-1, 2),
                np.array([cov for _, cov in unnamed[robot]]).reshape(-1, 2, 2),
            )
            states = moved.states.get(robot, unseeing)
            sees = any(
                topic.robot == robot and topic.record in (Sighting, Scan)
                for topic in run.log.topics
            )
            views[robot] = RobotEstimate(states, own.track, marks[robot], points, sees)
    return views


def anonymous_maps(run: Pipeline, views: Mapping[str, RobotEstimate]) -> dict[str, AnonymousMap]:
    """Submaps and points without identity of each robot, after the pass that gave ``views``."""
    assert isinstance(run.backend, Isam2Backend)
    estimates = {robot: view.states for robot, view in views.items()}
    found = build_submaps(estimates, run.keyframe_scans, run.config)
    seen = {}
    for robot, view in views.items():
        own = [place for place in found if place.state[0] == robot]
        states = [place.state for place in own]
        cov = run.backend.state_covariance(states) if own else np.zeros((0, 0))
        seen[robot] = AnonymousMap(PlaceMap(own, cov), view.anonymous_points)
    return seen


def has_detectable_robots(log: LogSet, outlines: Collection[str], placed: Collection[str]) -> bool:
    """Whether some robot has scans that may show another one, not yet placed relative to it."""
    return any(
        log.has_scans(observer) and name != observer and not {name, observer} <= set(placed)
        for observer in log.robots
        for name in outlines
    )
