"""Errors of trajectories against true poses: absolute, aligned, relative, and consistency.

The world frame of the estimate is taken as that of the truth. What is not called *aligned* is
meaningful only where the start was given (``smooth --start truth``).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.consistency import fit_rigid_transform
from graphslam.core.geometry import Array, between, interpolate, path_length, transform, wrap
from graphslam.core.records import Trajectory
from graphslam.evaluation.error_statistics import NeesSeries, nees_series, nees_statistics, rms

#: true poses farther apart than this in time are not interpolated between
MAX_TRUTH_GAP_S = 1.0
#: names of the spans of relative errors -> arguments of `relative_errors`
SPANS: Mapping[str, Mapping[str, float]] = {"1_s": {"seconds": 1.0}, "10_m": {"metres": 10.0}}
#: m: a path of less extent, and the share of it, left of positions, by which they tell no direction
_STANDING_M, _NOISE_SHARE = 0.1, 0.1


@dataclass(frozen=True, slots=True, eq=False)
class PosePairs:
    """Estimated and true poses (n, 3) at the same stamps (n,) ns, covariances (n, 3, 3)."""

    stamps_ns: np.ndarray[Any, np.dtype[np.int64]]
    estimate: Array
    covs: Array
    truth: Array

    def __len__(self) -> int:
        return len(self.stamps_ns)


def pair_poses(
    estimate: Trajectory, truth: Trajectory, max_gap_s: float = MAX_TRUTH_GAP_S
) -> PosePairs:
    """Truth at the estimate's stamps, along the constant twist between its neighbours.

    Stamps outside the truth's span, or between two true poses ``max_gap_s`` or more apart, have no
    pair; a stamp that the truth holds exactly always has one. Both must be sorted by stamp.
    """
    stamps, true_stamps = estimate.stamps_ns, truth.stamps_ns
    after = np.searchsorted(true_stamps, stamps, side="left")
    inside = (after < len(true_stamps)) & (stamps >= true_stamps[0])
    after = np.minimum(after, len(true_stamps) - 1)
    exact = true_stamps[after] == stamps
    before = np.where(exact, after, np.maximum(after - 1, 0))
    gap = true_stamps[after] - true_stamps[before]
    use = inside & (exact | (gap < max_gap_s * 1e9))
    share = (stamps - true_stamps[before]) / np.maximum(gap, 1)
    poses = interpolate(truth.poses[before[use]], truth.poses[after[use]], share[use])
    return PosePairs(stamps[use], estimate.poses[use], estimate.covs[use], poses)


def align(source: Array, target: Array) -> Array:
    """Pose (3,) that moves points ``source`` (n, 2) best onto ``target`` (n, 2), no scale.

    Least squares over positions, all with the same weight.
    """
    return fit_rigid_transform(target, source, np.ones(len(source)))[0]


def displacement(source: Array, target: Array) -> Array:
    """Pose (3,) that moves poses ``source`` (n, 3) onto ``target`` (n, 3), on average.

    By their headings, and by positions once these are turned.
    """
    turn = np.exp(1j * (target[:, 2] - source[:, 2])).mean()
    pose = np.array([0.0, 0.0, np.angle(turn)])
    pose[:2] = np.mean(target[:, :2] - transform(pose, source[:, :2]), axis=0)
    return pose


def align_poses(source: Array, target: Array) -> Array:
    """Pose (3,) that moves poses ``source`` (n, 3) best onto ``target`` (n, 3), see `align`.

    Where a robot stands all the time the noise of its positions tells no direction: then it is the
    `displacement`.
    """
    pose = align(source[:, :2], target[:, :2])
    extent = np.std(target[:, :2], axis=0)
    left = target[:, :2] - transform(pose, source[:, :2])
    extent_m, left_m = float(np.hypot(*extent)), float(np.sqrt(np.mean(np.sum(left**2, axis=1))))
    if extent_m < _STANDING_M and left_m >= _NOISE_SHARE * extent_m:
        return displacement(source, target)
    return pose


def relative_errors(
    pairs: PosePairs, *, seconds: float | None = None, metres: float | None = None
) -> Array:
    """Errors (k, 3) of the motion over ``seconds`` or over ``metres`` of true path (give one).

    The partner of a pose is the one nearest to that time or path later, if it is off by less than
    half of it in time or a tenth in path. The error is the estimated motion in the frame of the
    true one.

    Source: time: J. Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012,
    DOI 10.1109/IROS.2012.6385773; path: A. Geiger, P. Lenz, R. Urtasun, CVPR 2012,
    DOI 10.1109/CVPR.2012.6248074.
    """
    if (seconds is None) == (metres is None):
        raise ValueError("give seconds or metres")
    if len(pairs) < 2:
        return np.empty((0, 3))
    if seconds is not None:
        axis, delta, slack = (pairs.stamps_ns - pairs.stamps_ns[0]) / 1e9, seconds, 0.5 * seconds
    else:
        assert metres is not None  # narrows the type; checked above
        axis, delta, slack = path_length(pairs.truth), metres, 0.1 * metres
    wanted = axis + delta
    after = np.clip(np.searchsorted(axis, wanted), 1, len(axis) - 1)
    nearer = np.abs(axis[after - 1] - wanted) < np.abs(axis[after] - wanted)
    end = np.where(nearer, after - 1, after)
    # otherwise the last pose would be the partner of many poses at once
    reached = wanted <= axis[-1] + 1e-9
    start = np.flatnonzero(reached & (np.abs(axis[end] - wanted) <= slack))
    end = end[start]
    true_motion = between(pairs.truth[start], pairs.truth[end])
    return between(true_motion, between(pairs.estimate[start], pairs.estimate[end]))


def _aligned(distance: Array, turn: Array) -> dict[str, float | None]:
    """What an alignment leaves of the errors (n,) of positions, m, and headings, rad."""
    if len(distance) < 2:  # one pose lies on any other
        return dict.fromkeys(("ate_aligned_rmse_m", "max_aligned_m", "heading_aligned_rmse_rad"))
    return {
        "ate_aligned_rmse_m": rms(distance),
        "max_aligned_m": float(distance.max()),
        "heading_aligned_rmse_rad": rms(turn),
    }


@dataclass(frozen=True, slots=True, eq=False)
class PathErrors:
    """Errors of one robot's poses: what the numbers of one or several robots are made of.

    ``estimate`` and ``truth`` are poses (n, 3); ``relative``: name of a span in `SPANS` ->
    `relative_errors` (k, 3) over it; ``nees``: of the poses.
    """

    estimate: Array
    truth: Array
    relative: Mapping[str, Array]
    nees: NeesSeries


def path_errors(pairs: PosePairs) -> PathErrors:
    """The errors of one robot's poses."""
    relative = {name: relative_errors(pairs, **span) for name, span in SPANS.items()}
    series = nees_series(_differences(pairs.estimate, pairs.truth), pairs.covs)
    return PathErrors(pairs.estimate, pairs.truth, relative, series)


def _differences(estimate: Array, truth: Array) -> Array:
    """Errors (n, 3) of poses along the axes of the world, m and rad."""
    errors = estimate - truth
    errors[:, 2] = wrap(errors[:, 2])
    return errors


def trajectory_metrics(robots: Sequence[PathErrors]) -> dict[str, Any]:
    """All trajectory numbers of one robot, or of several under one common alignment.

    Absolute errors: ``ate_rmse_m``, ``max_m`` and ``heading_rmse_rad`` as estimated, those that are
    called aligned after one `align_poses` of all. Consistency is of the poses as estimated.
    ``rpe`` as in `relative_errors`, over 1 s and over 10 m. A number without data is None, as are
    the aligned ones of a single pose.

    Raises:
        ValueError: there is no pair at all.
    """
    estimate = np.concatenate([one.estimate for one in robots])
    truth = np.concatenate([one.truth for one in robots])
    if not len(truth):
        raise ValueError("no pair of poses")
    errors = _differences(estimate, truth)
    distance = np.hypot(errors[:, 0], errors[:, 1])
    alignment = align_poses(estimate, truth)
    left = np.hypot(*(transform(alignment, estimate[:, :2]) - truth[:, :2]).T)
    rpe = {name: _rpe(np.concatenate([one.relative[name] for one in robots])) for name in SPANS}
    return {
        "poses": len(truth),
        "ate_rmse_m": rms(distance),
        **_aligned(left, wrap(errors[:, 2] + alignment[2])),
        "max_m": float(distance.max()),
        "heading_rmse_rad": rms(errors[:, 2]),
        "rpe": rpe,
        **nees_statistics([one.nees for one in robots]),
    }


def _rpe(errors: Array) -> dict[str, Any]:
    return {
        "pairs": len(errors),
        "trans_rmse_m": rms(np.hypot(errors[:, 0], errors[:, 1])),
        "rot_rmse_rad": rms(errors[:, 2]),
    }
