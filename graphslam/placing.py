"""Where robots begin: what is known of a log before its pass proper.

Robots whose start is not given are put where what they have in common with others has them. That
takes a pass over the log in which every robot is estimated by itself: afterwards they are joined by
what bears a name, by how they show in each other's scans, and else by places and points without
names.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

from graphslam.config import BackendConfig, Config
from graphslam.joining import Joined, Relation, View, join
from graphslam.log_settings import outlines
from graphslam.logs import LogSet
from graphslam.meeting import Kept, Looked, meet
from graphslam.pipeline import CLOCK_DOUBT_S, Known, Pipeline
from graphslam.recorded import Recorded, recorded_in
from graphslam.records import Scan, Sighting, Start
from graphslam.starts import origin, start_poses
from graphslam.unnamed import related

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
    views, meetings, looked = pipeline.views(), pipeline.meetings, Looked((), {})
    if watchable(log, shapes, starts):
        scans = pipeline.kept.scans
        looked = meet(views, scans, shapes, tuple(starts), CLOCK_DOUBT_S, config.front_end)
    by_name = joined(views, meetings, (looked.relations, looked.undecided))
    if len(set(by_name.frames.values())) == 1:
        return by_name
    more, doubts = related(pipeline.surroundings(views), by_name.frames, config.association)
    found = (*looked.relations, *more), {**doubts, **looked.undecided}
    return joined(views, meetings, found)


def watchable(log: LogSet, outlines: Collection[str], placed: Collection[str]) -> bool:
    """Whether a robot has scans in which another may show that is not placed relative to it."""
    return any(
        log.has_scans(observer) and name != observer and not {name, observer} <= set(placed)
        for observer in log.robots
        for name in outlines
    )
