"""Whether a result and its truth are in one world frame, and the move between them if not.

Without a given start the world's origin is the first pose of the first robot, or that of a known
map. The truth of most
recordings is in a frame of its own, in which that pose is somewhere else: then absolute errors and
their NEES are of the frames, not of the estimate.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from graphslam.core.config import Config
from graphslam.core.consistency import fit_rigid_transform, poses_differ
from graphslam.core.geometry import Array, compose, transform, unit_vectors, wrap
from graphslam.core.records import Landmark, TrueLandmark
from graphslam.evaluation.landmark_metrics import MATCH_DISTANCE_M
from graphslam.evaluation.trajectory_metrics import PosePairs, align, align_poses, displacement

#: m, m, rad: how exact a sample of a true pose is taken to be
TRUTH_SIGMA = (0.01, 0.01, 0.01)
#: of constellations: fewest places, how far a place may be off and pairs are apart at least, m, and
#: how many moves are tried
MIN_PLACES, PLACE_GATE_M, MIN_APART_M, MAX_TRIED = 6, 0.3, 2.0, 20_000
#: walls meet in a corner if the angle between them is larger, and both come so near to it, m
MIN_CORNER_RAD, CORNER_GAP_M = np.radians(30), 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Pose (3,) of the truth's frame in that of the estimate; ``by`` what it was found.

    That is ``poses`` or ``identities`` or ``constellation`` (of landmarks without identity).
    """

    pose: Array
    by: str


def is_world_given(config: Config, summary: Mapping[str, Any]) -> bool:
    """Whether the world frame of a result is one that the user knows.

    It is if a start was given. In a known map a start is in the frame of the map, which nobody
    knows unless a start was given to the log by which the map began. One sample of the truth says
    that the truth is in that frame too.

    Args:
        config: settings of the result.
        summary: of the result.
    """
    if config.known_map.directory and not config.start.from_truth:
        return bool(summary.get("known_map", {}).get("world_given", False))
    return config.start.from_truth or bool(config.start.poses)


def is_common_frame(given: bool, pairs: Mapping[str, PosePairs], world: str | None) -> bool:
    """Whether estimated and true poses are meant to be in one frame.

    They are if the world was given, or if the pose that defines the estimate's frame is where the
    truth has it.

    Args:
        given: see `is_world_given`.
        pairs: final poses of robots in the world frame, at least one.
        world: the robot whose start defines it, if known.
    """
    if given:
        return True
    first = pairs[world if world is not None and world in pairs else min(pairs)]
    cov = np.diag(np.square(TRUTH_SIGMA))
    known = np.nan_to_num(first.covs[0])
    return not poses_differ(first.estimate[0], known, first.truth[0], cov)


def alignment_of_poses(pairs: Sequence[PosePairs]) -> Alignment:
    """By the positions of all poses, see `align_poses`."""
    return Alignment(align_poses(*_sides(pairs)), "poses")


def displacement_of_poses(pairs: Sequence[PosePairs]) -> Alignment:
    """By positions and headings of all poses: also that of robots that hardly moved."""
    return Alignment(displacement(*_sides(pairs)), "poses")


def _sides(pairs: Sequence[PosePairs]) -> list[Array]:
    """All true poses (n, 3), and all estimated ones (n, 3)."""
    return [np.concatenate([getattr(p, side) for p in pairs]) for side in ("truth", "estimate")]


def alignment_of_landmarks(
    estimated: Sequence[Landmark], true: Sequence[TrueLandmark]
) -> Alignment | None:
    """By points of equal identity, or else by a constellation of `places`; None without either.

    A few points with the wrong name or out of place do not matter: a move that takes most points to
    their places is searched for.
    """
    points = {landmark.identity: landmark for landmark in true if landmark.kind == "point"}
    named = [e for e in estimated if e.kind == "point" and e.identity in points and e.identity]
    if len(named) >= 2:
        own = np.array([e.position[:2] for e in named])
        there = np.array([points[e.identity or ""].pose[:2] for e in named])
        return Alignment(_robust_fit(own, there), "identities")
    own, there = places(estimated), places(true)
    pose = _constellation_fit(own, there)
    return None if pose is None else Alignment(pose, "constellation")


def places(landmarks: Sequence[Landmark] | Sequence[TrueLandmark]) -> Array:
    """Positions (n, 2) that a map has, whoever made it: points, and corners where walls meet.

    What is seen of a wall ends anywhere, but two walls meet in one place.
    """
    points = [_pose(one)[:2] for one in landmarks if one.kind == "point"]
    walls = [one for one in landmarks if one.kind != "point" and one.extent is not None]
    poses = np.array([_pose(one) for one in walls]).reshape(-1, 3)
    ends = np.array([one.extent for one in walls]).reshape(-1, 2, 2)
    along = unit_vectors(poses[:, 2])
    a, b = np.triu_indices(len(walls), 1)
    cross = along[a, 0] * along[b, 1] - along[a, 1] * along[b, 0]
    use = np.abs(cross) > np.sin(MIN_CORNER_RAD)
    a, b, cross = a[use], b[use], cross[use]
    off = poses[b, :2] - poses[a, :2]
    reach = (off[:, 0] * along[b, 1] - off[:, 1] * along[b, 0]) / cross
    corners = poses[a, :2] + reach[:, None] * along[a]
    beyond = np.maximum(*(_distance_from_wall(corners, ends[k], along[k]) for k in (a, b)))
    corners = corners[beyond <= CORNER_GAP_M]
    return np.concatenate([np.array(points).reshape(-1, 2), corners])


def _pose(landmark: Landmark | TrueLandmark) -> Array:
    return landmark.position if isinstance(landmark, Landmark) else landmark.pose


def _distance_from_wall(points: Array, ends: Array, along: Array) -> Array:
    """How far (n,) points (n, 2) on the lines of walls are beyond their ends (n, 2, 2)."""
    at = ((points - ends[:, 0]) * along).sum(axis=1)
    other = ((ends[:, 1] - ends[:, 0]) * along).sum(axis=1)
    low, high = np.minimum(other, 0.0), np.maximum(other, 0.0)
    return np.asarray(np.maximum(np.maximum(low - at, at - high), 0.0))


def _constellation_fit(own: Array, there: Array) -> Array | None:
    """Pose (3,) of the frame of ``there`` (m, 2) in that of ``own`` (n, 2); None if none fits.

    Two points of one map as far apart as two of the other suggest a move; of all moves the one that
    takes most points of ``own`` to one of ``there`` is fitted to these. It must take half of them.
    """
    if min(len(own), len(there)) < MIN_PLACES:
        return None
    from scipy.spatial import cKDTree  # noqa: PLC0415  (imports for long)

    (i, j), (k, m) = (np.nonzero(~np.eye(len(p), dtype=bool)) for p in (own, there))
    first, second = own[j] - own[i], there[m] - there[k]
    apart, wanted = np.hypot(*first.T), np.hypot(*second.T)
    order = np.argsort(wanted)
    low, high = (
        np.searchsorted(wanted[order], apart + side * PLACE_GATE_M) for side in (-1.0, 1.0)
    )
    # long pairs tell the direction best; every second is the same pair backwards
    usable = np.flatnonzero((apart > MIN_APART_M) & (high > low))
    rng = np.random.default_rng(0)
    mine = rng.choice(usable, MAX_TRIED) if len(usable) else usable
    theirs = order[(low[mine] + rng.random(len(mine)) * (high - low)[mine]).astype(np.int64)]
    turn = wrap(np.arctan2(*second[theirs].T[::-1]) - np.arctan2(*first[mine].T[::-1]))
    c, s = np.cos(turn), np.sin(turn)
    rotations = np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)
    shift = there[k[theirs]] - (rotations @ own[i[mine]][:, :, None])[:, :, 0]
    moved = own @ rotations.mT + shift[:, None]
    off, nearest = cKDTree(there).query(moved, distance_upper_bound=PLACE_GATE_M)
    near = np.isfinite(off)
    if not len(near):
        return None
    best = int(np.argmax(near.sum(axis=1) - np.where(near, off, 0.0).sum(axis=1)))
    if 2 * near[best].sum() < len(own):
        return None
    use = near[best]
    return fit_rigid_transform(own[use], there[nearest[best][use]], np.ones(int(use.sum())))[0]


def _robust_fit(own: Array, there: Array) -> Array:
    """Pose (3,) of the frame of ``there`` (n, 2) in that of ``own``, by most of the points.

    Of the moves by two points each, that with most points within the distance of a match (and the
    smallest sum of their distances), fitted to these.
    """
    best = np.zeros(len(own), dtype=bool)
    worth = (0, 0.0)
    for i in range(len(own)):
        # the farther apart two points are, the better they tell the direction
        j = int(np.hypot(*(there - there[i]).T).argmax())
        pose = align(there[[i, j]], own[[i, j]])
        off = np.hypot(*(transform(pose, there) - own).T)
        near = off <= MATCH_DISTANCE_M
        this = (int(near.sum()), -float(off[near].sum()))
        if this > worth:
            best, worth = near, this
    use = best if best.sum() >= 2 else np.ones(len(own), dtype=bool)
    return fit_rigid_transform(own[use], there[use], np.ones(int(use.sum())))[0]


def changes_matches(alignment: Alignment, true: Sequence[TrueLandmark]) -> bool:
    """Whether it moves a landmark farther than the distance within which landmarks match."""
    places = np.array([landmark.pose[:2] for landmark in true])
    moved = np.hypot(*(transform(alignment.pose, places) - places).T)
    return bool((moved > MATCH_DISTANCE_M).any())


def moved_landmarks(alignment: Alignment, true: Sequence[TrueLandmark]) -> list[TrueLandmark]:
    """True landmarks in the frame of the estimate."""
    return [
        replace(
            landmark,
            pose=compose(alignment.pose, landmark.pose),
            extent=None if landmark.extent is None else transform(alignment.pose, landmark.extent),
        )
        for landmark in true
    ]
