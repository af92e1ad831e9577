"""Where robots begin: what is known of a log before its pass proper.

Robots whose start is not given are put where what they have in common with others has them. That
takes a pass over the log in which every robot is estimated by itself: afterwards they are joined by
what bears a name, by how they show in each other's scans, and else by places and points without
names.
"""

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from graphslam.backends.isam2 import Isam2Backend
from graphslam.closing import places
from graphslam.config import BackendConfig, Config
from graphslam.frames import without_mark
from graphslam.geometry import Array
from graphslam.joining import Joined, join
from graphslam.log_settings import outlines
from graphslam.logs import LogSet
from graphslam.meeting import Kept, Looked, meet
from graphslam.pipeline import CLOCK_DOUBT_S, Known, Pipeline
from graphslam.recorded import Recorded, recorded_in
from graphslam.records import Scan, Sighting, Start, Trajectory
from graphslam.relating import Relation, View
from graphslam.starts import origin, start_poses
from graphslam.unnamed import Surroundings, related

#: relations between robots found without names, and robot -> why there is none
Found = tuple[Sequence[Relation], Mapping[str, str]]


def beforehand(log: LogSet, config: Config) -> Known:
    """What is known of a log before its first pass proper: starts, frames, recorded closures.

    Raises:
        EstimationError: truth was asked for and a robot has none, or a given pose is malformed.
    """
    starts = start_poses(log, config)
    recorded = recorded_in(log, config, starts)
    return Known(placed(log, config, {}, starts, recorded), recorded)


def with_names(known: Known, log: LogSet, config: Config, names: Mapping[str, str]) -> Known:
    """What is known by the right names: robots may have been placed by what bore false ones."""
    starts = start_poses(log, config)
    joined = placed(log, config, names, starts, known.recorded)
    return replace(known, names=names, joined=joined)


def placed(
    log: LogSet,
    config: Config,
    names: Mapping[str, str],
    starts: Mapping[str, Start],
    recorded: Recorded,
) -> Joined:
    """Where all robots start, of which the ``starts`` of some are known.

    The others are put where what they see in common has them. That takes a pass over the log in
    which every robot is estimated by itself.

    Args:
        log: opened logs.
        config: settings.
        names: see `Known`.
        starts: those that are known.
        recorded: what follows from the log's relative poses.

    Raises:
        EstimationError: the estimate of a robot by itself is indeterminate.
    """
    every = {**starts, **recorded.starts}
    if set(log.robots) <= set(every):
        return Joined(every, recorded.frames, min(starts, default=""))
    starts = {r: s for r, s in every.items() if recorded.frames[r] == recorded.frames[min(starts)]}
    own = origin(config)

    def joined(views: Mapping[str, View], meetings: Sequence[Sighting], found: Found) -> Joined:
        return join(log.robots, views, meetings, starts, config.association, own, *found)

    if not any(topic.record in (Sighting, Scan) for topic in log.topics):
        return joined({}, (), ((), {}))
    apart = Known(Joined.apart(log.robots, own), recorded, names)
    pipeline = Pipeline(log, replace(config, backend=BackendConfig()), apart)
    shapes = outlines(log, config) if config.association.robots != "ignore" else {}
    pipeline.kept = Kept({name: run.track for name, run in pipeline.runs.items()}, shapes)
    pipeline.run(lambda _count: None)
    if not pipeline.steps:
        return joined({}, (), ((), {}))
    views, meetings, looked = views_after(pipeline), pipeline.meetings, Looked((), {})
    if watchable(log, shapes, starts):
        scans = pipeline.kept.scans
        looked = meet(views, scans, shapes, tuple(starts), CLOCK_DOUBT_S, config.front_end)
    by_name = joined(views, meetings, (looked.relations, looked.undecided))
    if len(set(by_name.frames.values())) == 1:
        return by_name
    more, doubts = related(surroundings(pipeline, views), by_name.frames, config.association)
    found = (*looked.relations, *more), {**doubts, **looked.undecided}
    return joined(views, meetings, found)


def views_after(run: Pipeline) -> dict[str, View]:
    """What each robot knows by itself, after a pass in which each had a frame of its own."""
    estimate, entries = run.backend.finish(), run.associator.map.entries
    moved = run.worlds().estimate(estimate)
    frames = run.frames.of_landmarks(entries.values())
    marks: dict[str, dict[str, tuple[Array, Array]]] = defaultdict(dict)
    unnamed: dict[str, list[tuple[Array, Array]]] = defaultdict(list)
    for number, (mean, cov) in moved.landmarks.items():
        name = without_mark(entries[number].identity)
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
            views[robot] = View(states, own.track, marks[robot], points)
    return views


def surroundings(run: Pipeline, views: Mapping[str, View]) -> dict[str, Surroundings]:
    """What each robot saw that bears no name, in its own frame, after the pass of ``views``."""
    assert isinstance(run.backend, Isam2Backend)
    found = places({robot: view.states for robot, view in views.items()}, run.pictures)
    seen = {}
    for robot, view in views.items():
        own = [place for place in found if place.state[0] == robot]
        states = [place.state for place in own]
        cov = run.backend.state_covariance(states) if own else np.zeros((0, 0))
        seen[robot] = Surroundings(own, cov, view.unnamed)
    return seen


def watchable(log: LogSet, outlines: Collection[str], placed: Collection[str]) -> bool:
    """Whether a robot has scans in which another may show that is not placed relative to it."""
    return any(
        log.has_scans(observer) and name != observer and not {name, observer} <= set(placed)
        for observer in log.robots
        for name in outlines
    )
