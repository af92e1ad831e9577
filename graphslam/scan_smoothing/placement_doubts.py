"""Doubts about where visits were placed, counted again where some were displaced.

A visit is placed by what it has in common with those before it; what contradicts it there is a
doubt. If it is displaced later, as much was pushed alike (`mapping.doubled_walls`), it no longer
lies there. In the solution what stayed lies on what was seen before, and what was pushed would if
that were undone. What contradicts both is no push: other things were moved as well, or the visit
was somewhere else.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.records import Trajectory
from graphslam.mapping.doubled_walls import LEAST_M
from graphslam.mapping.known_map import latest_places
from graphslam.mapping.submaps import SubmapPose, submaps_at
from graphslam.multi_robot.hypothesis_choice import doubt
from graphslam.multi_robot.map_localisation import support
from graphslam.scan_smoothing.localisation import (
    given_start,
    is_contradicted,
    is_start_given,
    told_elsewhere,
)
from graphslam.scan_smoothing.path_closing import PLACE_COV
from graphslam.scan_smoothing.scan_tracking import TrackedLog


def doubt_again(
    scan_log: TrackedLog, states: Mapping[str, Trajectory], by: Mapping[str, Array]
) -> None:
    """Count doubts of all visits in the solution; the log has these instead of those before.

    Args:
        scan_log: whose loops are closed.
        states: visit -> its final path.
        by: visit -> by how much it was displaced (2,), m; the others were not.
    """
    found = _doubts(scan_log, states, by)
    if scan_log.known.known_map is None:
        assignment = scan_log.known.frame_assignment
        remarks = {name: said for name, said in {**assignment.remarks, **found}.items() if said}
        assignment = replace(assignment, remarks=remarks)
        scan_log.known = replace(scan_log.known, frame_assignment=assignment)
        return
    for name, said in found.items():  # of one robot
        wrong = _told_elsewhere(scan_log, name, states[name].poses[0])
        scan_log.map_doubt = "; ".join(text for text in (wrong, said) if text)


def _doubts(
    scan_log: TrackedLog, states: Mapping[str, Trajectory], by: Mapping[str, Array]
) -> dict[str, str]:
    """What is to be said of each visit of which any place lies where something was seen before."""
    anchors = {name: np.array(scan_log.paths[name].anchors) for name in states}
    submaps, _ = submaps_at(anchors, states, scan_log.keyframe_scans, scan_log.config)
    known_map = scan_log.known.known_map
    stays = np.zeros(2)
    before = [] if known_map is None else [_Placed(known_map.places, stays)]
    found = {}
    for name in sorted(states, key=lambda name: (int(states[name].stamps_ns[0]), name)):
        own = [submap for submap in submaps if submap.state[0] == name]
        visit = _Placed(own, by.get(name, stays))
        seen = latest_places([place for one in reversed(before) for place in one.places])
        placed = support(seen, own, visit.pushed_since(before))
        if placed.confirmed.any():
            found[name] = doubt(placed, own, scan_log.config.loop_closure)
        before.append(visit)
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Placed:
    """Places of a visit, or of a known map, and ``by`` how much it was displaced (2,), m."""

    places: Sequence[SubmapPose]
    by: Array

    def pushed_since(self, before: Iterable["_Placed"]) -> list[Array]:
        """By how much it was displaced against each of those before it, where that is not 0."""
        off = [self.by - one.by for one in before]
        return [motion for motion in off if np.hypot(*motion) > LEAST_M]


def _told_elsewhere(scan_log: TrackedLog, name: str, pose: Array) -> str:
    """That a start was told which the solution (3,) contradicts; empty if it does not.

    It is no part of the solution: the path begins where the map has it (`start_as_given`). How well
    the map as a whole lies in the world does not matter, so the path is known as places in it are.
    """
    if not is_start_given(scan_log.config, name):
        return ""
    given = given_start(scan_log, name)
    is_wrong = is_contradicted(given, pose, PLACE_COV, is_used=False)
    return told_elsewhere(given, pose) if is_wrong else ""
