"""Submaps along the paths: the scans of a few metres of path, as one set of points."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import Config
from graphslam.core.geometry import (
    Array,
    adjoint,
    between,
    compose,
    inverse,
    path_length,
    transform,
    wrap,
)
from graphslam.core.records import KeyframeScan, Trajectory
from graphslam.perception.scan_matching import Submap, make_submap

#: m of path and rad turned between the scans of a submap: nearer ones show the same
SCAN_M, SCAN_RAD = 0.5, 0.4
#: points of a scan, at least
MIN_POINTS = 20
#: submaps of a robot's path, at most; a longer path has them farther apart
MAX_SUBMAPS = 400
#: m, m, rad per root of a metre: unmodelled drift of an estimate
DRIFT = np.array([0.02, 0.02, 0.01])

#: state of a robot: its name and time
State = tuple[str, int]


@dataclass(frozen=True, slots=True, eq=False)
class SubmapPose:
    """A submap with the state in whose frame it is.

    ``pose`` (3,) is the estimate of that state, ``path_m`` how far its robot had driven there,
    ``span_ns`` the times of the submap's first and last scan.
    """

    state: State
    pose: Array
    path_m: float
    span_ns: tuple[int, int]
    submap: Submap


def build_submaps(
    states: Mapping[str, Trajectory], keyframe_scans: Iterable[KeyframeScan], config: Config
) -> list[SubmapPose]:
    """Submaps along every robot's path, of the scan points in ``keyframe_scans``.

    Of ``config`` it uses ``loop_closure``, the spacing and reach of submaps, and ``scan_matching``.
    """
    clouds = _clouds(keyframe_scans)
    found = []
    for robot, states_of in states.items():
        seen = np.array([(robot, int(t)) in clouds for t in states_of.stamps_ns], dtype=bool)
        poses, stamps = states_of.poses[seen], states_of.stamps_ns[seen]
        if len(poses) < 2:
            continue
        path = path_length(poses)
        spacing = max(config.loop_closure.submap_spacing_m, path[-1] / MAX_SUBMAPS)
        middles = np.unique(np.searchsorted(path, np.arange(0.0, path[-1], spacing)))
        found += submaps_around(robot, poses, stamps, middles, clouds, config)
    return found


def submaps_at(
    middles: Mapping[str, IntArray],
    states: Mapping[str, Trajectory],
    keyframe_scans: Iterable[KeyframeScan],
    config: Config,
) -> tuple[list[SubmapPose], IntArray]:
    """Submaps whose middles are given states of each robot.

    Args:
        middles: robot -> (k,) numbers of states; those without scans have no submap.
        states: robot -> its states.
        keyframe_scans: scan points seen from the states.
        config: see `build_submaps`.

    Returns:
        The submaps, and (n,) which of all middles, robot after robot, each belongs to.
    """
    clouds = _clouds(keyframe_scans)
    found: list[SubmapPose] = []
    numbers: list[int] = []
    first = 0
    for robot, states_of in states.items():
        seen = np.array([(robot, int(t)) in clouds for t in states_of.stamps_ns], dtype=bool)
        own = np.asarray(middles[robot])
        has_scan = seen[own]
        poses, stamps = states_of.poses[seen], states_of.stamps_ns[seen]
        place = (np.cumsum(seen) - 1)[own[has_scan]]
        found += submaps_around(robot, poses, stamps, place, clouds, config)
        numbers += (first + np.flatnonzero(has_scan)).tolist()
        first += len(own)
    return found, np.array(numbers, dtype=np.int64)


def _clouds(keyframe_scans: Iterable[KeyframeScan]) -> dict[State, KeyframeScan]:
    """State -> its scan, if it has points enough."""
    return {(p.robot, p.time_ns): p for p in keyframe_scans if len(p.points) >= MIN_POINTS}


def submaps_around(
    robot: str,
    poses: Array,
    stamps: IntArray,
    middles: IntArray,
    clouds: Mapping[State, KeyframeScan],
    config: Config,
) -> list[SubmapPose]:
    """Submaps of one robot around the ``middles`` (k,) among its states with scans."""
    found = []
    path = path_length(poses)
    turned = np.concatenate([[0.0], np.cumsum(np.abs(wrap(np.diff(poses[:, 2]))))])
    reach = config.loop_closure.submap_reach_m
    for middle in middles:
        used: list[int] = []
        first, last = np.searchsorted(path, [path[middle] - reach, path[middle] + reach + 1e-9])
        for k in range(first, last):
            if (
                not used
                or path[k] - path[used[-1]] >= SCAN_M
                or turned[k] - turned[used[-1]] >= SCAN_RAD
            ):
                used.append(int(k))
        seen_there = [clouds[robot, int(stamps[k])] for k in used]
        sensors = np.array([p.sensor for p in seen_there])
        submap = make_submap(
            compose(between(poses[middle], poses[used]), sensors),
            [transform(inverse(p.sensor), p.points.astype(float)) for p in seen_there],
            config.scan_matching,
        )
        state = robot, int(stamps[middle])
        span = int(stamps[used[0]]), int(stamps[used[-1]])
        found.append(SubmapPose(state, poses[middle], float(path[middle]), span, submap))
    return found


def with_poses_from(
    found: Sequence[SubmapPose], states: Mapping[str, Trajectory]
) -> list[SubmapPose]:
    """The same submaps with their poses from another estimate; their points stay as they are."""
    return [
        replace(p, pose=states[robot].at(time_ns)) for p in found for robot, time_ns in [p.state]
    ]


def drift_covariance(found: Sequence[SubmapPose]) -> Array:
    """Joint covariance (3n, 3n) of submap poses by drift that the estimate does not know of.

    A wall taken for its parallel neighbour bends the path there, and everything after it follows:
    modelled as a random walk along each robot's path. Errors are along each pose's own axes.
    """
    n = len(found)
    poses, path = np.array([p.pose for p in found]), np.array([p.path_m for p in found])
    robots = np.array([p.state[0] for p in found])
    D = np.zeros((n, n, 3, 3))
    for robot in np.unique(robots):
        own = np.flatnonzero(robots == robot)
        own = own[np.argsort(path[own], kind="stable")]
        k, steps = len(own), np.diff(path[own], prepend=path[own[0]])
        # how an error that arises at one place (second axis) moves a later one (first axis)
        G = adjoint(between(poses[own][:, None], poses[own])) * np.tri(k)[:, :, None, None]
        G = (G * np.sqrt(steps)[:, None, None] * DRIFT).transpose(0, 2, 1, 3).reshape(3 * k, -1)
        D[np.ix_(own, own)] = (G @ G.T).reshape(k, 3, k, 3).transpose(0, 2, 1, 3)
    return D.transpose(0, 2, 1, 3).reshape(3 * n, 3 * n)
