"""How good a result is: against true poses, true landmarks, and reference relative poses.

`evaluate` puts the numbers of `trajectory_metrics`, `landmark_metrics` and `relation_metrics`
together, named with their units, in the shape of ``evaluate --json``.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from graphslam.core.errors import OutputError
from graphslam.core.records import JointScans, Landmark, Result, Trajectory, TrueLandmark
from graphslam.core.worker import parallel_map
from graphslam.evaluation.common_frame import (
    Alignment,
    alignment_of_landmarks,
    alignment_of_poses,
    changes_matches,
    displacement_of_poses,
    is_common_frame,
    is_world_given,
    moved_landmarks,
)
from graphslam.evaluation.error_statistics import NEES_NUMBERS, with_joint_bounds
from graphslam.evaluation.joint_nees import nees_weights
from graphslam.evaluation.landmark_metrics import landmark_metrics
from graphslam.evaluation.relation_metrics import (
    Relations,
    find_stamps,
    one_after_another,
    relation_metrics,
)
from graphslam.evaluation.trajectory_metrics import (
    PosePairs,
    pair_poses,
    path_errors,
    trajectory_metrics,
)
from graphslam.results.folder import SavedResult
from graphslam.results.joint_file import joint_scans

#: ms that a pose takes in the numbers of its trajectory
POSE_MS = 0.0025
#: numbers that are undefined where estimate and truth have no frame in common
_WORLD_METRICS = dict.fromkeys(("ate_rmse_m", "max_m", "heading_rmse_rad", *NEES_NUMBERS))


def robots_in_own_frame(summary: Mapping[str, Any]) -> set[str]:
    """Robots of a result whose frame is not the world's and has no known place in it."""
    world = summary.get("world")
    return {robot for robot, frame in summary.get("frames", {}).items() if frame != world}


def evaluate(
    result: Result | SavedResult,
    truth: Mapping[str, Trajectory] | None = None,
    true_landmarks: Sequence[TrueLandmark] = (),
    relations: Relations | None = None,
) -> dict[str, Any]:
    """Everything that ``evaluate --json`` prints, as far as there is something to compare with.

    With ``truth``: ``robots`` and ``joint``. Robots without truth are left out; of robots in a
    frame of their own there are only aligned and relative errors, and they are not in ``joint``.
    With ``true_landmarks``: ``landmarks``. ``common_frame`` says whether the world frames of
    estimate and truth are the same (see `common_frame`): else there are only aligned errors, and
    landmarks match after an alignment, by the poses if their truth is known. With ``relations``:
    ``relations`` of the final poses, and in their key ``causal`` of the causal ones. Relations name
    no robot: they are compared with the robot whose scans match most of them, or with all sessions
    of one place that share its frame.

    Raises:
        OutputError: the truth is of other robots, no pose lies within its span, or relations come
            without scans.
    """
    found: dict[str, Any] = {}
    alignment = None
    given = is_world_given(result.config, result.summary)
    if truth:
        pairs = _pair_all(result, truth)
        own_frame = robots_in_own_frame(result.summary)
        in_world = {n: both["final"] for n, both in pairs.items() if n not in own_frame}
        common = not in_world or is_common_frame(given, in_world, result.summary.get("world"))
        found["common_frame"] = common
        robots = list(in_world.values())
        if robots:
            alignment = (displacement_of_poses if common else alignment_of_poses)(robots)
        elsewhere = own_frame if common else set(pairs)
        found |= _compare_trajectories(pairs, elsewhere, set(in_world))
        _bound_by_joint(found, result, pairs, elsewhere, set(in_world))
    if true_landmarks:
        placed = [landmark for landmark in result.landmarks if landmark.frame is None]
        if "common_frame" not in found:
            found["common_frame"] = given or not placed
            if not found["common_frame"]:
                alignment = alignment_of_landmarks(placed, true_landmarks)
                found["common_frame"] = not (
                    alignment is None or changes_matches(alignment, true_landmarks)
                )
        found["landmarks"] = _compare_landmarks(
            placed, true_landmarks, found["common_frame"], alignment
        )
    if relations is not None:
        found["relations"] = _compare_relations(result, relations)
    return found


def _compare_landmarks(
    estimated: Sequence[Landmark],
    true: Sequence[TrueLandmark],
    common: bool,
    alignment: Alignment | None,
) -> dict[str, Any]:
    """``landmarks`` of `evaluate`; covariances are of places in the world, not of aligned ones.

    Where the frames are not the same and no alignment is known, no landmark can be matched. In a
    common frame the alignment only tells which match: a start that is a little off turns the far
    end of a map by more than two walls are apart.
    """
    if common:
        there = moved_landmarks(alignment, true) if alignment else true
        return {**landmark_metrics(estimated, true, there), "aligned_by": None}
    if alignment is None:
        return {**dict.fromkeys(landmark_metrics((), ())), "exchanged": [], "aligned_by": None}
    metrics = landmark_metrics(estimated, moved_landmarks(alignment, true))
    return {
        **metrics,
        "nees_per_dof": None,
        "coverage": None,
        "worst": None,
        "aligned_by": alignment.by,
    }


def _pair_all(
    result: Result | SavedResult, truth: Mapping[str, Trajectory]
) -> dict[str, dict[str, PosePairs]]:
    """Robot -> ``final`` and, if there are any, ``causal`` poses with their true ones.

    Raises:
        OutputError: the truth is of other robots, or of another time.
    """
    if not set(truth) & set(result.robots):
        raise OutputError(
            f"the truth is of {', '.join(truth)}, the result of {', '.join(result.robots)}; name "
            "the robot with --truth ROBOT=FILE.tum"
        )
    pairs = {
        name: {
            kind: pair_poses(path, truth[name])
            for kind, path in (("final", robot.final), ("causal", robot.causal))
            if path is not None
        }
        for name, robot in result.robots.items()
        if name in truth and len(truth[name])
    }
    pairs = {name: both for name, both in pairs.items() if all(map(len, both.values()))}
    if not pairs:
        raise OutputError(
            f"no pose of {', '.join(result.robots)} lies within the span of the truth of "
            f"{', '.join(truth)}"
        )
    return pairs


def _compare_trajectories(
    pairs: Mapping[str, Mapping[str, PosePairs]], elsewhere: set[str], joined: set[str]
) -> dict[str, Any]:
    """``robots`` and ``joint`` of `evaluate`.

    Args:
        pairs: see `_pair_all`.
        elsewhere: robots whose estimate is in another frame than their truth.
        joined: robots whose estimates are in one frame, whether that is the truth's or not.
    """
    each = {(name, kind): p for name, both in pairs.items() for kind, p in both.items()}
    own = list(each.values())
    found_errors = parallel_map(path_errors, own, efforts=list(map(len, own)), unit_ms=POSE_MS)
    errors = dict(zip(each, found_errors, strict=True))
    in_world = [name for name in pairs if name in joined]
    metrics = {key: trajectory_metrics([one]) for key, one in errors.items()}
    found: dict[str, Any] = {
        "robots": {
            name: {
                kind: metrics[name, kind] | (_WORLD_METRICS if name in elsewhere else {})
                for kind in both
            }
            for name, both in pairs.items()
        }
    }
    if in_world:
        found["joint"] = {
            kind: trajectory_metrics([errors[name, kind] for name in in_world])
            | (_WORLD_METRICS if joined <= elsewhere else {})
            for kind in pairs[in_world[0]]
            if all(kind in pairs[name] for name in in_world)
        }
    return found


def _bound_by_joint(
    found: dict[str, Any],
    result: Result | SavedResult,
    pairs: Mapping[str, Mapping[str, PosePairs]],
    elsewhere: set[str],
    joined: set[str],
) -> None:
    """Put bounds by the joint covariance into ``found``, where the result has it."""
    joint = _joint_of(result)
    if joint is None:
        return
    used = {
        name: np.searchsorted(result.robots[name].final.stamps_ns, pairs[name]["final"].stamps_ns)
        for name in pairs.keys() - elsewhere
    }
    groups = [({name}, found["robots"][name]) for name in used]
    if joined <= used.keys() and "joint" in found:
        groups.append((joined, found["joint"]))
    for names, both in groups:
        if both["final"]["nees_per_dof"] is None:
            continue
        weights = nees_weights(joint, result.robots, {name: used[name] for name in names})
        if weights is not None:
            both["final"] = with_joint_bounds(both["final"], weights)


def _joint_of(result: Result | SavedResult) -> JointScans | None:
    if isinstance(result, SavedResult):
        return result.joint if result.joint is not None and result.joint.ties else None
    return joint_scans(result.estimate, result.robots)


def _compare_relations(result: Result | SavedResult, relations: Relations) -> dict[str, Any]:
    """``relations`` of `evaluate`.

    Sessions follow each other in time, so a stamp tells which one it is of; robots at one time
    have equal stamps. Of several sessions covariances are not compared.
    """
    scans = [
        (name, robot.scan_final, robot.scan_causal)
        for name, robot in result.robots.items()
        if robot.scan_final is not None
    ]
    if not scans:
        raise OutputError("relations need the poses of scans, and this result has none")
    stamps = np.concatenate([relations.from_ns, relations.to_ns])
    found_in = [int(find_stamps(stamps, one[1].stamps_ns)[1].sum()) for one in scans]
    name, final, causal = scans[int(np.argmax(found_in))]
    frames = result.summary.get("frames", {})
    sessions = [
        one
        for one, count in zip(scans, found_in, strict=True)
        if count and frames.get(one[0]) == frames.get(name)
    ]
    together = result.config.logs.same_place and len(sessions) > 1
    if together:
        final = one_after_another([one[1] for one in sessions])
        paths = [one[2] for one in sessions if one[2] is not None]
        causal = one_after_another(paths) if len(paths) == len(sessions) else None
    joint = _joint_of(result)
    if together or (joint is not None and name not in joint.ties):
        joint = None
    found = relation_metrics(relations, final, joint, name)
    return found if causal is None else {**found, "causal": relation_metrics(relations, causal)}
