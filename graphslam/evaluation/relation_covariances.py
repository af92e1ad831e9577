"""Covariances of relative poses between any two scans of a result."""

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, adjoint, between, inverse
from graphslam.core.records import JointScans, Trajectory
from graphslam.estimation.joint_covariances import pair_covariances

#: pairs whose covariances are computed at a time, from the first scan on: bounds the memory
AT_ONCE = 20_000


def relative_covariances(
    joint: JointScans, robot: str, scans: Trajectory, pairs: IntArray
) -> Array:
    """Covariances (p, 3, 3) of the pose of the second scan of a pair in the frame of the first.

    Errors are along the axes of the second scan. They contain that of the states on both sides of
    each scan, correlated as they are, and that of the odometry between.

    Args:
        joint: of the result.
        robot: whose scans they are.
        scans: their final poses.
        pairs: (p, 2) indices of scans.
    """
    out = np.empty((len(pairs), 3, 3))
    order = np.argsort(pairs.min(axis=1), kind="stable")
    for begin in range(0, len(order), AT_ONCE):
        some = order[begin : begin + AT_ONCE]
        out[some] = _some_covariances(joint, robot, scans, pairs[some])
    return out


def _some_covariances(joint: JointScans, robot: str, scans: Trajectory, pairs: IntArray) -> Array:
    used, flat = np.unique(pairs, return_inverse=True)
    ends = flat.reshape(pairs.shape)
    poses, ties, known = scans.poses[used], joint.ties[robot], joint.states[robot].poses
    before, share = ties.state[used], ties.share[used]
    states = np.column_stack([before, np.minimum(before + 1, len(known) - 1)])
    # the error of the state before moves the scan, and what the next one disagrees with the motion
    # between them is spread over it (see `graphslam.odometry.interpolation.final_at`)
    start, end = (known[states[:, k]] for k in (0, 1))
    spread = share[:, None, None] * adjoint(inverse(ties.mounts[used]))
    moved = adjoint(between(poses, start)) - spread @ adjoint(between(end, start))
    maps = np.stack([moved, spread], axis=1)
    own, cross = pair_covariances(joint.root, joint.root.states[robot][states], maps, ends)
    own = own + ties.covs[used]
    a, b = ends.T
    back = -adjoint(inverse(between(poses[a], poses[b])))
    odometry = ties.odometry_covs[used]
    cross = cross + _shared_odometry(before, share, ties.covs[used], odometry, ends, back)
    mixed = back @ cross
    return np.asarray(own[b] + back @ own[a] @ back.mT + mixed + mixed.mT)


def _shared_odometry(
    before: IntArray, share: Array, covs: Array, odometry: Array, ends: IntArray, back: Array
) -> Array:
    """Covariance (p, 3, 3) of the errors between states of two scans between the same two.

    Along the axes of each. By odometry alone that of a bridge between s and t is s (1 - t) of the
    whole, s (1 - s) that at s. Where a scan was matched to the map, P is left of the covariance C
    by odometry: of its error e, P C⁻¹ e, beside one that is its own. Scans at one place that were
    not matched apart have the same error.

    Args:
        before: (n,) the states before the scans.
        share: (n,) of the motion from there to the next one.
        covs: (n, 3, 3) P.
        odometry: (n, 3, 3) C.
        ends: (p, 2) pairs of the n.
        back: (p, 3, 3) what errors of the first of a pair change of the relative pose.
    """
    found = np.zeros((len(ends), 3, 3))
    s, t = share[ends].min(axis=1), share[ends].max(axis=1)
    same = np.flatnonzero((before[ends[:, 0]] == before[ends[:, 1]]) & (s > 0) & (t < 1))
    s, t, ends, back = s[same], t[same], ends[same], back[same]
    backwards = share[ends[:, 0]] > share[ends[:, 1]]
    early, late = np.where(backwards[:, None], ends[:, ::-1], ends).T
    # from the axes of the early one to those of the late one
    onward = -np.where(backwards[:, None, None], np.linalg.inv(back), back)
    kept = np.broadcast_to(np.eye(3), onward.shape).copy()
    matched = (covs[late] != odometry[late]).any(axis=(1, 2))
    kept[matched] = np.linalg.solve(odometry[late[matched]], covs[late[matched]])
    cross = ((1 - t) / (1 - s))[:, None, None] * (covs[early] @ onward.mT @ kept)
    at_once = (s == t) & (covs[early] == covs[late]).all(axis=(1, 2))
    cross = np.where(at_once[:, None, None], covs[early], cross)
    found[same] = np.where(backwards[:, None, None], cross.mT, cross)
    return found
