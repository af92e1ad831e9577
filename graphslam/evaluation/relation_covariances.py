"""Covariances of relative poses between any two scans of a result."""

import numpy as np

from graphslam.core.geometry import Array, adjoint, between, inverse
from graphslam.core.records import IntArray, JointScans, Trajectory
from graphslam.estimation.information_root import pair_covariances

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
    cross = cross + _shared_odometry(before, share, ties.covs[used], ends)
    a, b = ends.T
    back = -adjoint(inverse(between(poses[a], poses[b])))
    mixed = back @ cross
    return np.asarray(own[b] + back @ own[a] @ back.mT + mixed + mixed.mT)


def _shared_odometry(before: IntArray, share: Array, covs: Array, ends: IntArray) -> Array:
    """Covariance (p, 3, 3) of the odometry's errors at two scans between the same two states.

    That of a bridge between s and t is s (1 - t) of the whole, s (1 - s) that at s.
    """
    s, t = share[ends].min(axis=1), share[ends].max(axis=1)
    at_first = np.where((share[ends[:, 0]] <= share[ends[:, 1]]), ends[:, 0], ends[:, 1])
    same = (before[ends[:, 0]] == before[ends[:, 1]]) & (s > 0) & (t < 1)
    factor = np.where(same, (1 - t) / np.where(same, 1 - s, 1.0), 0.0)
    return np.asarray(factor[:, None, None] * covs[at_first])
