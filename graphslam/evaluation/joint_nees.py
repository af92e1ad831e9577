"""The distribution of the NEES of whole trajectories, by their stated joint covariance.

Poses of a trajectory share errors: of the world, of a corridor, of a mount. Under the joint
covariance P that is stated, the NEES of all poses together is a sum of chi-squares of one degree of
freedom, weighted by the eigenvalues of P whitened by the blocks of the single poses.
"""

from collections.abc import Mapping

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import (
    Array,
    adjoint,
    between,
    compose,
    inverse,
    moved_by_world,
    rotation3,
)
from graphslam.core.records import JointScans, RobotResult
from graphslam.estimation.joint_covariances import covariance_of, joint_covariance
from graphslam.odometry.mount_covariance import moved_by_mount
from graphslam.results.folder import SavedRobot

Robots = Mapping[str, RobotResult] | Mapping[str, SavedRobot]

#: poses whose joint covariance is computed, at most: of more the NEES is about that of so many that
#: are evenly spread over them, since errors of neighbours are nearly the same
MOST_POSES = 300


def nees_weights(joint: JointScans, robots: Robots, used: Mapping[str, IntArray]) -> Array | None:
    """Weights (k,) of the chi-squares whose sum is the NEES of poses; their mean is one.

    Args:
        joint: of the result.
        robots: of the result.
        used: robot -> the numbers of its final poses that are meant.

    Returns:
        None if what a pose depends on is not known, or a covariance is not positive definite.
    """
    if not set(used) <= set(joint.ties):
        return None
    total = sum(map(len, used.values()))
    step = -(-total // MOST_POSES)
    P = joint_base_covariance(
        joint, robots, {name: index[step // 2 :: step] for name, index in used.items()}
    )
    try:
        return whitened_eigenvalues(P, 3)
    except np.linalg.LinAlgError:
        return None


def whitened_eigenvalues(P: Array, dim: int) -> Array:
    """Eigenvalues (k,) of a covariance (k, k) whitened by its diagonal blocks (dim, dim).

    Raises:
        LinAlgError: a block is not positive definite.
    """
    n = len(P) // dim
    blocks = P.reshape(n, dim, n, dim)[range(n), :, range(n)]
    back = np.linalg.inv(np.linalg.cholesky(blocks))
    whitened = np.einsum("nij,njmk->nimk", back, P.reshape(n, dim, n, dim))
    whitened = np.einsum("nimk,mlk->niml", whitened, back).reshape(len(P), len(P))
    return np.maximum(np.linalg.eigvalsh((whitened + whitened.T) / 2), 0.0)


def joint_base_covariance(joint: JointScans, robots: Robots, used: Mapping[str, IntArray]) -> Array:
    """Joint covariance (D, D) of n final poses of bases, D = 3n, along world axes: m and rad.

    Robots follow each other by name. Poses have the errors of the states around each scan, of the
    odometry between these, which counts as independent, of the mounts, and of the world that they
    place.
    """
    root, mounts, names = joint.root, joint.mounts, sorted(used)
    mount_rows = np.zeros(0, dtype=np.int64)
    if mounts is not None:
        mount_rows = np.concatenate([root.mounts[name] for name in mounts.robots])
    ends = np.cumsum([0, *(3 * len(used[name]) for name in names)])
    on: list[tuple[Array, ...]] = []  # rows of the root, columns, derivatives
    by_mounts = np.zeros((int(ends[-1]), len(mount_rows)))
    own = np.zeros((int(ends[-1]) // 3, 3, 3))
    for n, name in enumerate(names):
        index, ties, states = used[name], joint.ties[name], joint.states[name].poses
        bases, scans = robots[name].final.poses[index], _scans(robots[name])[index]
        before, share, sensors = ties.state[index], ties.share[index], ties.mounts[index]
        following = np.minimum(before + 1, len(states) - 1)
        # as in `relation_covariances`, taken to the base and to world axes
        to_base = rotation3(bases[:, 2]) @ adjoint(between(bases, scans))
        spread = share[:, None, None] * adjoint(inverse(sensors))
        moved = adjoint(between(scans, states[before]))
        moved = moved - spread @ adjoint(between(states[following], states[before]))
        columns = np.arange(ends[n], ends[n + 1]).reshape(-1, 3)
        for state, maps in ((before, to_base @ moved), (following, to_base @ spread)):
            rows = root.states[name][state][:, None] + np.arange(3)
            on.append(tuple(np.broadcast_arrays(rows[:, None, :], columns[:, :, None], maps)))
        own[columns[:, 0] // 3] = to_base @ ties.covs[index] @ to_base.mT
        if mounts is None:
            continue
        part = np.zeros((len(index), 3, len(mount_rows)))
        if mounts.placing:
            part += moved_by_world(bases) @ mounts.placing[name]
        if name in mounts.robots:
            lasers = compose(scans, inverse(sensors))
            mount = between(bases[0], lasers[0])
            part[:, :, mounts.columns(name)] += moved_by_mount(lasers, mount)
        by_mounts[columns.ravel()] = part.reshape(-1, len(mount_rows))
    free = np.flatnonzero(mount_rows >= 0)
    on.append(
        np.broadcast_arrays(
            mount_rows[free], np.arange(len(by_mounts))[:, None], by_mounts[:, free]
        )
    )
    rows, columns, derivatives = (
        np.concatenate([part.ravel() for part in of]) for of in zip(*on, strict=True)
    )
    P = covariance_of(root, rows, columns, derivatives, len(by_mounts))
    if mounts is not None and len(free):
        # in files of earlier versions mounts alone have the biases of surfaces, beside the root
        beyond = mounts.cov[np.ix_(free, free)] - joint_covariance(root, mount_rows[free])
        P += by_mounts[:, free] @ beyond @ by_mounts[:, free].T
    blocks = P.reshape(len(own), 3, len(own), 3)
    blocks[range(len(own)), :, range(len(own))] += own
    return P


def _scans(robot: RobotResult | SavedRobot) -> Array:
    assert robot.scan_final is not None  # it has scan ties
    return robot.scan_final.poses
