"""Where robots that sight named points begin in a known map.

The map is to them what another robot is whose frame is the world: points of one name are one, and
those whose distances agree tell where a robot's own map lies in it
(`multi_robot.relative_frames`). Robots that see few of its points are placed by the others.
"""

from collections.abc import Mapping

import numpy as np

from graphslam.core.config import BackendConfig, Config
from graphslam.core.errors import EstimationError, LogError
from graphslam.core.frame_forest import PRIOR_INFLATION
from graphslam.core.gaussian import chi2_quantile, mahalanobis_squared
from graphslam.core.geometry import Array, between, moved_by_world, transform, wrap
from graphslam.core.record import replace
from graphslam.core.records import Start, Trajectory
from graphslam.core.suggestions import start_option
from graphslam.logs import LogSet
from graphslam.mapping.known_map import MAP_ROBOT, KnownMap
from graphslam.multi_robot.common_points import FLOOR_M, GATE, LEAST_COMMON
from graphslam.multi_robot.frame_tree import FrameAssignment, build_frame_tree
from graphslam.multi_robot.relative_frames import RobotEstimate
from graphslam.pipeline.log_pass import PriorKnowledge
from graphslam.pipeline.recorded_closures import RecordedClosures
from graphslam.pipeline.start_priors import origin, start_poses
from graphslam.sighting_smoothing.sighting_pass import SightingPass
from graphslam.sighting_smoothing.sighting_solution import solve_robots_apart
from graphslam.slam.initialisation import separate_estimates

#: chi-square of three degrees of freedom at 99.9 %
START_GATE = float(chi2_quantile(0.999, 3))
#: the world of a log in a map: the map is certain where it is
_HERE = Start(np.zeros(3), np.zeros((3, 3)))
#: where nothing tells, though a start was told
NOT_RECOGNISED = "nothing in it is recognised"


def starts_in_map(log: LogSet, config: Config, known_map: KnownMap) -> PriorKnowledge:
    """The starts of all robots of a log of named sightings in a map.

    Where both are known, the start that the map tells is used: a start that was told some
    decimetres off would move the map. If it contradicts that, `PriorKnowledge.map_doubt` says so.

    Raises:
        LogError: some of what is sighted has no name.
        EstimationError: a start is neither told nor found, or points of the map's names lie
            otherwise than there.
    """
    own = origin(config)
    names = set(log.robots)
    nowhere = RecordedClosures({}, dict.fromkeys(names, ""), frozenset(), {})
    apart = PriorKnowledge(FrameAssignment.separate_frames(names, own), nowhere)
    together = SightingPass(log, replace(config, backend=BackendConfig()), apart)
    together.run(lambda _count: None)
    if not together.all_named:
        raise LogError(
            f"{log.files[0].path}: has sightings without names, which are not localised in a known "
            "map"
        )
    views = separate_estimates(together, solve_robots_apart(together)) if together.steps else {}
    before = _as_robot(known_map, views) if views else None
    tree = build_frame_tree(
        [*log.robots, MAP_ROBOT],
        views if before is None else {**views, MAP_ROBOT: before},
        together.unrelated_sightings,
        {MAP_ROBOT: _HERE},
        config,
        own,
    )
    told = _told(log, config)
    starts, doubts = dict[str, Start](), []
    for robot in log.robots:
        is_found = tree.frames[robot] == MAP_ROBOT
        if not is_found:
            _check_told(robot, told.get(robot), views.get(robot), before, known_map.name, tree)
        start = tree.starts[robot] if is_found else told[robot]
        starts[robot] = _in_world(start, known_map.known.pose_covariance())
        if robot in told:
            cov = tree.found[robot].cov if is_found else None
            said = tree.undecided.get(robot, "").replace(MAP_ROBOT, "the map")
            doubts.append(_doubt(told[robot], start.pose, cov, said))
    world = min(log.robots)
    frames = FrameAssignment(
        starts, dict.fromkeys(log.robots, world), world,
        {robot: one for robot, one in tree.found.items() if robot in starts},
    )  # fmt: skip
    said = "; ".join(dict.fromkeys(filter(None, doubts)))
    recorded = RecordedClosures({}, frames.frames, frozenset(), {})
    return PriorKnowledge(frames, recorded, alone=views, map_doubt=said)


def _check_told(
    robot: str,
    told: Start | None,
    own: RobotEstimate | None,
    before: RobotEstimate | None,
    name: str,
    tree: FrameAssignment,
) -> None:
    """Whether a start that was not found was told, and is not contradicted by the points there.

    ``own`` is the robot's estimate in a frame of its own, ``before`` the map, of this ``name``.

    Raises:
        EstimationError: it was not, or is.
    """
    shared, there = 0, 0
    if own is not None and before is not None:
        both = sorted(own.landmarks.keys() & before.landmarks.keys())
        shared = len(both)
        if told is not None and both:
            p, P, q, Q = (
                np.array([one.landmarks[mark][k] for mark in both])
                for one, k in ((before, 0), (before, 1), (own, 0), (own, 1))
            )
            J = _of_start(told.pose, q)
            off = p - transform(told.pose, q)
            spread = P + Q + J @ told.cov @ J.mT + FLOOR_M**2 * np.eye(2)
            there = int((mahalanobis_squared(off, spread) <= GATE).sum())
    if told is not None and (shared < LEAST_COMMON or 2 * there > shared):
        return
    why = tree.undecided.get(robot, "").replace(MAP_ROBOT, "the map")
    why = why or f"it shares {shared} names of points with it"
    if told is not None:
        why += f"; of {shared} points {there} are where the start that was told has them"
    raise EstimationError(
        f"robot {robot}: where it begins in the map {name} is not known: {why}; give another map, "
        f"or {start_option(robot)} (m, rad)"
    )


def _of_start(pose: Array, q: Array) -> Array:
    """Derivatives (n, 2, 3) of points ``q`` (n, 2) of a robot in the world by its start (3,)."""
    off = transform(pose, q) - pose[:2]
    J = np.zeros((len(q), 2, 3))
    J[:, :, :2] = np.eye(2)
    J[:, 0, 2], J[:, 1, 2] = -off[:, 1], off[:, 0]
    return J


def _told(log: LogSet, config: Config) -> dict[str, Start]:
    """The starts that somebody told; nobody is at the origin of a map by default."""
    if not (config.start.poses or config.start.from_truth):
        return {}
    return start_poses(log, config)


def _as_robot(known_map: KnownMap, views: Mapping[str, RobotEstimate]) -> RobotEstimate:
    """The map as what a robot knows, which has never moved; odometry it has none of its own.

    Where the map lies in the world is hardly known, perhaps. Its points have the covariances of
    where they are in the map: without what is a motion of all of them.
    """
    named = [m for m in known_map.landmarks if m.identity is not None and m.kind == "point"]
    numbers = [mark.id for mark in named]
    cov = known_map.known.covariance(numbers) if numbers else np.zeros((0, 0))
    at = np.array([mark.position[:2] for mark in named]).reshape(-1, 2)
    off = at - at.mean(axis=0) if len(at) else at
    turned = np.column_stack([-off[:, 1], off[:, 0]]).reshape(-1, 1)
    moved = np.concatenate([np.tile(np.eye(2), (len(at), 1)), turned], axis=1)
    in_map = np.eye(len(cov)) - moved @ np.linalg.pinv(moved)
    cov = in_map @ cov @ in_map.T
    marks = {
        str(mark.identity): (place, cov[2 * k : 2 * k + 2, 2 * k : 2 * k + 2])
        for k, (mark, place) in enumerate(zip(named, at, strict=True))
    }
    nowhere = Trajectory(np.zeros(1, dtype=np.int64), np.zeros((1, 3)), np.zeros((1, 3, 3)))
    return RobotEstimate(nowhere, next(iter(views.values())).track, marks)


def _in_world(start: Start, map_cov: Array) -> Start:
    """A start relative to a map, whose place in the world is known to ``map_cov`` (3, 3).

    It must not tell that again: see `scan_smoothing.localisation.in_world`.
    """
    J = PRIOR_INFLATION * moved_by_world(start.pose)
    return replace(start, world_cov=start.cov + J @ map_cov @ J.T)


def _doubt(told: Start, found: Array, found_cov: Array | None, why: str) -> str:
    """What is to be said of a start that was told, where the map has it elsewhere, or not at all.

    ``found`` (3,), with ``found_cov`` (3, 3); None if it was not found, perhaps for a reason.
    """
    if found_cov is None:
        return f"{why or NOT_RECOGNISED}; the log is where its start was told to be"
    off = found - told.pose
    off[2] = wrap(off[2])
    if mahalanobis_squared(off, told.cov + found_cov) <= START_GATE:
        return ""
    apart = between(told.pose, found)
    return (
        f"the start that was told is {np.hypot(apart[0], apart[1]):.2f} m and "
        f"{np.degrees(abs(apart[2])):.1f}° from where the map has it, and was not used"
    )
