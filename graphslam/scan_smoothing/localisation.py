"""Where a log begins in a known map, and its path put there.

The start is searched for in the whole map by what relates two robots of unknown start: submaps that
match in several places and imply one relative pose, without a rival (`multi_robot`). A log that
does not tell is refused.
"""

from collections.abc import Sequence

import numpy as np

from graphslam.core.config import Config
from graphslam.core.consistency import distances_from_others
from graphslam.core.errors import EstimationError
from graphslam.core.frame_forest import PRIOR_INFLATION
from graphslam.core.gaussian import chi2_quantile, mahalanobis_squared, symmetric
from graphslam.core.geometry import (
    Array,
    between,
    compose,
    compose_cov,
    inverse,
    moved_by_world,
    wrap,
)
from graphslam.core.record import replace
from graphslam.core.records import Start
from graphslam.core.suggestions import start_option
from graphslam.mapping.known_map import KnownMap
from graphslam.mapping.loop_closure import Tamper
from graphslam.mapping.submaps import SubmapPose, submaps_at, with_poses_from
from graphslam.multi_robot.better_starts import better_alignment
from graphslam.multi_robot.hypothesis_choice import best_explanation, contradiction, doubt
from graphslam.multi_robot.map_localisation import Support, hypotheses, support
from graphslam.multi_robot.place_recognition import PlaceMap, seen_extent
from graphslam.multi_robot.place_search import DISTINCT_M, DISTINCT_RAD
from graphslam.pipeline.log_pass import timed
from graphslam.scan_smoothing.path_closing import PLACE_COV, ClosedPaths, close_paths
from graphslam.scan_smoothing.scan_tracking import ScanLog, TrackedLog

#: chi-square of three degrees of freedom at 99.9 %
START_GATE = float(chi2_quantile(0.999, 3))
#: m², m², rad²: of a start that was found on a grid of cells
CELL_COV = np.diag([0.3, 0.3, 0.05]) ** 2


def localise(scan_log: ScanLog, known_map: KnownMap, tamper: Tamper | None = None) -> ClosedPaths:
    """Put the tracked path of a log into a known map, whose landmarks are then those of the log.

    Returns:
        The path closed with the map's places: what was compared with all of the map. Its start is
        not known as well as that to the estimate, and from a wide one the loops of a corridor may
        be closed a door too far.

    Raises:
        EstimationError: the log does not tell where it begins.
    """
    (robot,) = scan_log.started
    config = scan_log.config
    with timed(scan_log.seconds, "localisation"):
        if is_start_given(config, robot):
            start, laid = start_as_given(scan_log, robot, known_map, tamper)
        else:
            start, laid = found_start(scan_log, robot, known_map, tamper)
    place_path(scan_log, robot, start)
    scan_log.steps[0] = replace(scan_log.steps[0], known=known_map.known)
    scan_log.landmarks.add_known(known_map.entries(robot))
    return laid


def is_start_given(config: Config, robot: str) -> bool:
    """Whether the start need not be found."""
    return config.start.from_truth or robot in config.start.poses


def given_start(scan_log: TrackedLog, robot: str) -> Start:
    """Of the first state, which is the sensor's; given is that of the base."""
    told = scan_log.known.frame_assignment.starts[robot]
    track = scan_log.runs[robot].track
    cov = compose_cov(told.pose, told.cov, track.mount, track.mount_cov)
    return Start(compose(told.pose, track.mount), cov)


def start_as_given(
    scan_log: ScanLog, robot: str, known_map: KnownMap, tamper: Tamper | None = None
) -> tuple[Start, ClosedPaths]:
    """The start by one that was given, and the path laid from there.

    Which of the places that look alike it is, the given one says. Where exactly, the map does, as
    for a start that is found: in the estimate a start that is told some decimetres off would rather
    move the whole map, which is hardly known in the world. If the map contradicts it by more than
    what both are known to, that is a doubt, and so it is if the path fits clearly better somewhere
    else. Only where no place of the map is recognised the start is as given.

    Raises:
        EstimationError: from there the log sees something else than the map.
    """
    given = given_start(scan_log, robot)
    laid = close_path_in_map(scan_log, robot, given, known_map, tamper)
    first = laid.states[robot].poses[0]
    is_wrong = is_contradicted(given, first, laid.start_covariance(robot), is_used=True)
    if is_wrong:  # pulled to what was told, the beginning of the path is torn
        laid = close_path_in_map(
            scan_log, robot, start_of_closed_path(laid, robot), known_map, tamper
        )
    placed, places = check_given(scan_log, robot, laid, known_map)
    said = doubt(placed, places, scan_log.config.loop_closure)
    if is_wrong:
        wrong = told_elsewhere(given, laid.states[robot].poses[0])
        said = f"{wrong}; {said}" if said else wrong
    if not placed.confirmed.any():
        said = "no place of it is recognised; the log is where its start was told to be"
    scan_log.map_doubt = said
    better = better_alignment(known_map.places, places, placed, scan_log.config.multi_robot)
    if better is not None:
        pose = compose(better, laid.states[robot].poses[0])
        there = close_path_in_map(scan_log, robot, Start(pose, CELL_COV), known_map, tamper)
        base = compose(there.states[robot].poses[0], inverse(scan_log.runs[robot].track.mount))
        assignment = replace(scan_log.known.frame_assignment, better={robot: base})
        scan_log.known = replace(scan_log.known, frame_assignment=assignment)
    if not placed.confirmed.any():
        return given, laid
    return in_world(start_of_closed_path(laid, robot), known_map.known.pose_covariance()), laid


def is_contradicted(given: Start, pose: Array, cov: Array, *, is_used: bool) -> bool:
    """Whether a solution contradicts a start that was given by more than both are known to.

    Args:
        given: the start.
        pose: (3,) where the path begins in the solution.
        cov: (3, 3) its covariance, along world axes, m and rad.
        is_used: whether the start is a prior in the solution; it is compared with all else then.
    """
    off = pose - given.pose
    off[2] = wrap(off[2])
    if is_used:
        d2 = distances_from_others(off[None], given.cov[None], cov[None])[0]
    else:
        d2 = mahalanobis_squared(off, given.cov + cov)
    return bool(d2 > START_GATE)


def told_elsewhere(given: Start, pose: Array) -> str:
    """What is to be said of a start that was given, but lies at a ``pose`` (3,)."""
    off = between(given.pose, pose)
    what = f"{np.hypot(off[0], off[1]):.2f} m and {np.degrees(abs(off[2])):.1f}°"
    return f"the start that was told is {what} from where the map has it, and was not used"


def check_given(
    scan_log: ScanLog, robot: str, laid: ClosedPaths, known_map: KnownMap
) -> tuple[Support, Sequence[SubmapPose]]:
    """How well a path that was ``laid`` from a given start explains its places, and these.

    Raises:
        EstimationError: from there the log sees something else than the map.
    """
    anchors = {robot: np.array(scan_log.paths[robot].anchors)}
    submaps, _ = submaps_at(anchors, laid.states, scan_log.keyframe_scans, scan_log.config)
    placed = support(known_map.places, submaps if known_map.places else ())
    why = contradiction(placed)
    if why:
        raise EstimationError(
            f"robot {robot}: does not begin in the map {known_map.name} where --start says: {why}; "
            "give another map or start, or none: then all of the map is searched"
        )
    return placed, submaps


def found_start(
    scan_log: ScanLog, robot: str, known_map: KnownMap, tamper: Tamper | None = None
) -> tuple[Start, ClosedPaths]:
    """The start that the log and the map have in common, and the path laid from there.

    Its sigmas are wide: the scans by which it was found enter the estimate again.

    Raises:
        EstimationError: it is not found, or another one would do as well.
    """
    own = own_places(scan_log, robot)
    found, supports = [], []
    for start in possible_starts(scan_log, robot, known_map, own):
        laid = close_path_in_map(scan_log, robot, start, known_map, tamper)
        supports.append(support(known_map.places, with_poses_from(own.places, laid.states)))
        found.append((start_of_closed_path(laid, robot), laid))
    why = "no place in it is recognised"
    if supports:
        seen_m = seen_extent(known_map.places, own.places)
        best, refusal = best_explanation(supports, own.places, scan_log.config.multi_robot, seen_m)
        if refusal is None:
            scan_log.map_doubt = doubt(supports[best], own.places, scan_log.config.loop_closure)
            start, laid = found[best]
            return in_world(start, known_map.known.pose_covariance()), laid
        why = refusal.text
    raise EstimationError(
        f"robot {robot}: where it begins in the map {known_map.name} is not known: {why}; give "
        f"another map, or {start_option(robot)} (m, rad)"
    )


def own_places(scan_log: ScanLog, robot: str) -> PlaceMap:
    """The submaps of a log by itself, its loops closed."""
    config = scan_log.config
    closed = close_paths(scan_log, match=config.backend.close_loops)
    anchors = {robot: np.array(scan_log.paths[robot].anchors)}
    submaps, nodes = submaps_at(anchors, closed.states, scan_log.keyframe_scans, config)
    return PlaceMap(submaps, closed.graph.covariance(nodes) if submaps else np.zeros((0, 0)))


def possible_starts(
    scan_log: ScanLog, robot: str, known_map: KnownMap, own: PlaceMap
) -> list[Start]:
    """Where a log with ``own`` places may begin in a map, the best supported start first."""
    places = PlaceMap(known_map.places, np.kron(np.eye(len(known_map.places)), PLACE_COV))
    first = scan_log.steps[0].starts[robot].pose
    return [
        Start(compose(one.pose, first), PRIOR_INFLATION**2 * one.cov)
        for one in hypotheses(places, own, scan_log.config.multi_robot)
    ]


def close_path_in_map(
    scan_log: ScanLog,
    robot: str,
    start: Start,
    known_map: KnownMap,
    tamper: Tamper | None = None,
) -> ClosedPaths:
    """The path closed with the places of a known map, if it begins at ``start``."""
    before, first = scan_log.paths[robot].poses, scan_log.steps[0]
    try:
        place_path(scan_log, robot, start)
        match = scan_log.config.backend.close_loops
        return close_paths(scan_log, tamper, match=match, known_map=known_map)
    finally:
        scan_log.paths[robot].poses, scan_log.steps[0] = before, first


def start_of_closed_path(laid: ClosedPaths, robot: str) -> Start:
    """Where a log begins whose whole path was ``laid`` into a map.

    The path as laid was compared with the map, so its loops must not be looked for far from there:
    it is `PRIOR_INFLATION` times as uncertain as the submaps say, wide enough for their scans to
    enter the estimate again, and by no more than what was told apart.
    """
    pose = laid.states[robot].poses[0]
    told_apart = np.diag(np.array([DISTINCT_M, DISTINCT_M, DISTINCT_RAD]) ** -2.0)
    cov = PRIOR_INFLATION**2 * laid.start_covariance(robot)
    return Start(pose, symmetric(np.asarray(np.linalg.inv(np.linalg.inv(cov) + told_apart))))


def in_world(start: Start, map_cov: Array) -> Start:
    """A start that is known relative to a map, with its covariance in the world.

    Where the map lies in the world is known to ``map_cov`` (3, 3), of the twist that moves it. The
    start must not tell that again, each day or session anew: `PRIOR_INFLATION` times as uncertain,
    it tells next to nothing of it.
    """
    J = PRIOR_INFLATION * moved_by_world(start.pose)
    return replace(start, world_cov=symmetric(start.cov + J @ map_cov @ J.T))


def place_path(scan_log: ScanLog, robot: str, start: Start) -> None:
    """The tracked path begins at ``start``."""
    path = scan_log.paths[robot]
    world = compose(start.pose, inverse(path.poses[0]))
    path.poses = list(compose(np.broadcast_to(world, (len(path.poses), 3)), np.array(path.poses)))
    scan_log.steps[0] = replace(scan_log.steps[0], starts={robot: start})
