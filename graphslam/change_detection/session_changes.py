"""What changed from each session of a place to the next one, in the map that they share."""

from collections import defaultdict
from itertools import pairwise
from typing import Any

import numpy as np

from graphslam.change_detection.alignment import laser_warnings
from graphslam.change_detection.detect import detect_changes, identity_registration
from graphslam.change_detection.visit import Visit, visit_from_scans
from graphslam.core.errors import OutputError
from graphslam.core.geometry import Array, between, compose, moved_by_world
from graphslam.core.record import replace
from graphslam.core.records import KeyframeScan, Result, Trajectory
from graphslam.core.thinning import evenly_thinned

#: scans of a session that are compared, at most: the comparison takes a few per cent of the time
MOST_SCANS = 400
#: m, m, rad: sigmas of a pose in the map, at least
LEAST_SIGMAS = np.array([0.002, 0.002, 0.0005])


def with_session_changes(result: Result) -> Result:
    """The result with the key ``sessions.changes`` in its summary, if there are sessions.

    Each session is compared with the one before it in its frame: the time grows with their number.
    """
    summary = result.summary
    if "sessions" not in summary:
        return result
    states, frames = result.estimate.states, summary["frames"]
    names: dict[str, list[str]] = defaultdict(list)
    for name in sorted(states, key=lambda name: (int(states[name].stamps_ns[0]), name)):
        names[frames.get(name, name)].append(name)
    found = [
        _changes(result, before, later)
        for together in names.values()
        for before, later in pairwise(together)
    ]
    sessions = summary["sessions"] | {"changes": [one for one in found if one is not None]}
    return replace(result, summary={**summary, "sessions": sessions})


def _changes(result: Result, before: str, later: str) -> dict[str, Any] | None:
    """The entry of two sessions; None if they have no scans or no covariances."""
    origin = result.estimate.states[result.summary["frames"].get(later, later)]
    visits = [_visit(result, name, origin) for name in (before, later)]
    a, b = visits
    if a is None or b is None:
        return None
    entry = {"session": later, "since": before}
    try:
        found = detect_changes(a, b, result.config.changes, identity_registration(a), one_map=True)
    except OutputError as error:
        return entry | {"changes": [], "warnings": [str(error)]}
    # keyframes have their returns only: how many they are does not tell two lasers apart
    warnings = [text for text in found.warnings if text not in laser_warnings(a, b)]
    return entry | {
        "changes": [change.to_dict() for change in found.changes],
        "warnings": warnings,
    }


def _visit(result: Result, name: str, origin: Trajectory) -> Visit | None:
    """The scans of a session, as sure of their poses as the map is: the world does not matter."""
    states, config = result.estimate.states[name], result.config.changes
    by_time = {s.time_ns: s for s in result.keyframe_scans if s.robot == name and len(s.points)}
    if not by_time or not np.isfinite(states.covs).all():
        return None
    times = evenly_thinned(np.array(sorted(by_time), dtype=np.int64), MOST_SCANS)
    scans = [by_time[time] for time in times.tolist()]
    rows = states.index(times)
    poses = compose(states.poses[rows], np.array([scan.sensor for scan in scans]))
    covs = _in_the_map(states.poses[rows], states.covs[rows], origin)
    sweeps = [_sweep(scan) for scan in scans]
    return visit_from_scans(times, poses, covs, sweeps, result.landmarks, config)


def _in_the_map(poses: Array, covs: Array, origin: Trajectory) -> Array:
    """Covariances (n, 3, 3) of poses (n, 3) without what the whole map has in common.

    How well the first pose of all is known is an error of the world, of which all have the same.
    """
    J = moved_by_world(poses - [*origin.poses[0, :2], 0.0])
    values, axes = np.linalg.eigh(covs - J @ origin.covs[0] @ J.mT)
    kept = axes @ (np.maximum(values, 0.0)[:, :, None] * axes.mT)
    return np.asarray(kept + np.diag(LEAST_SIGMAS**2))


def _sweep(scan: KeyframeScan) -> tuple[Array, Array]:
    """Bearings (k,) rad, ascending, and ranges (k,) m, of a scan as its laser sees it."""
    ends = np.column_stack([scan.points, np.zeros(len(scan.points))])
    x, y = between(scan.sensor, ends)[:, :2].T
    angles, ranges = np.arctan2(y, x), np.hypot(x, y)
    order = np.argsort(angles)
    return angles[order], ranges[order]
