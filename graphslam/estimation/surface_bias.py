"""What the biases of surfaces leave of the errors of states, landmarks and mounts.

A surface returns all its ranges with one bias, and no number of scans averages it. Seen head-on it
moves the wall, on which no other variable depends; seen at a slant it moves and turns it by less.
What fits walls together that are seen at different angles are the states, and a mount where the
robot turns, so the difference moves them. By how much follows from the solution: errors δ of
measurements move it by P Hᵀ W δ. That is the consider covariance of S. F. Schmidt, Application of
state-space methods to navigation problems, Advances in Control Systems 3, 1966, DOI
10.1016/B978-1-4831-6716-9.50011-4.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, inverse, rotation3
from graphslam.core.information_root import InformationRoot
from graphslam.core.observation_models import MODELS, LineModel
from graphslam.core.record import replace
from graphslam.core.records import Estimate
from graphslam.estimation.joint_covariances import mount_errors, solve_root
from graphslam.estimation.weighed_walls import WeighedWalls

#: beams of a wall at which the bias is looked at
BEAMS = 9
#: share of a bias's variance that all surfaces have in common: that of the laser itself, and of the
#: material that most walls of a building are of
COMMON = 0.5
#: errors that are told apart, at most: of more surfaces some share one, with either sign. Numbers
#: that are so far apart are of walls that no state sees together
MOST_ERRORS = 128


def bias_of_lines(z: Array, extent: Array) -> Array:
    """How fitted lines move by a bias of their ranges (n, 3), m and rad for each m of bias.

    Args:
        z: (n, 3) lines in the frame of the sensor, see `Observation`.
        extent: (n, 2) from where to where each is seen, along it.

    Returns:
        Along the axes of each line: of its middle, by the ends of what is seen; of its normal
        offset and direction, by least squares over beams of equal angles between them.
    """
    foot = inverse(z)
    distance = np.maximum(np.abs(foot[:, 1]), 1e-3)
    ends = np.arctan2(extent - foot[:, :1], distance[:, None])
    angle = np.linspace(ends[:, 0], ends[:, 1], BEAMS, axis=1)
    along = foot[:, :1] + distance[:, None] * np.tan(angle)
    away = -np.sign(foot[:, 1:2]) * np.cos(angle)
    mean, middle = away.mean(axis=1), along.mean(axis=1)
    off = along - middle[:, None]
    slope = (off * away).sum(axis=1) / np.maximum((off**2).sum(axis=1), 1e-12)
    return np.column_stack([np.sin(ends).mean(axis=1), mean - slope * middle, slope])


def with_surface_bias(
    estimate: Estimate, walls: Sequence[WeighedWalls], sigma_m: float
) -> Estimate:
    """An estimate whose covariances, joint ones too, have what biases of surfaces leave.

    That of a wall is where the wall is seen: it has not the bias itself.

    Args:
        estimate: with the root of its information.
        walls: all observations of walls that it is made from.
        sigma_m: of the bias of a surface, in m; all observations of one landmark have the same,
            and `COMMON` of its variance is that of all.
    """
    assert estimate.root is not None
    shared = surface_errors(walls, estimate.root)
    shared *= sigma_m
    root = replace(estimate.root, shared=shared)

    def own(first: IntArray, turns: Array) -> Array:
        """Errors (n, 3, k) along world axes of poses by their first rows."""
        return np.asarray(turns @ shared[first[:, None] + np.arange(3)])

    states, by_states = {}, {}
    for robot, path in estimate.states.items():
        by_states[robot] = own(root.states[robot], rotation3(path.poses[:, 2]))
        states[robot] = replace(path, covs=path.covs + by_states[robot] @ by_states[robot].mT)
    landmarks, by_landmarks = {}, {}
    for number, (mean, cov) in estimate.landmarks.items():
        first, dim = root.landmarks[number], len(mean)
        turn = rotation3(mean[2]) if dim == 3 else np.eye(dim)
        by_landmarks[number] = turn @ shared[first : first + dim]
        landmarks[number] = mean, cov + by_landmarks[number] @ by_landmarks[number].T
    mounts = estimate.mounts
    if mounts is not None:
        by_mounts = mount_errors(root, mounts)
        mounts = replace(
            mounts,
            cov=mounts.cov + by_mounts @ by_mounts.T,
            states={
                robot: cross + by_states[robot] @ by_mounts.T
                for robot, cross in mounts.states.items()
            },
            landmarks={
                number: cross + by_landmarks[number] @ by_mounts.T
                for number, cross in mounts.landmarks.items()
            },
        )
    return replace(estimate, states=states, landmarks=landmarks, root=root, mounts=mounts)


def surface_errors(walls: Sequence[WeighedWalls], root: InformationRoot) -> Array:
    """By how much each row of the root moves (n, k) by k independent biases of sigma one.

    The time is that of `solve_root` for at most `MOST_ERRORS` columns and one.
    """
    numbers = np.unique(np.concatenate([one.targets for one in walls]))
    width = min(len(numbers), MOST_ERRORS)
    right = np.zeros((int(root.own.sum()), width + 1))
    share = np.sqrt(1.0 - COMMON)
    for seen in walls:
        of = np.searchsorted(numbers, seen.targets)
        sign = np.where(of // MOST_ERRORS % 2, -share, share)[:, None]
        for rows, moved in _gradients(seen, root):
            at = rows[:, None] + np.arange(3)
            np.add.at(right, (at, (of % MOST_ERRORS)[:, None]), sign * moved)
            np.add.at(right, (at, np.full_like(at, width)), np.sqrt(COMMON) * moved)
    return solve_root(root, right)


def _gradients(seen: WeighedWalls, root: InformationRoot) -> Iterator[tuple[IntArray, Array]]:
    """First rows (n,) of the states, then of the landmarks, and Hᵀ W δ (n, 3) of a bias of one."""
    model, own = MODELS[seen.model], bias_of_lines(seen.z, seen.extent)
    own[:, 1] -= np.sign(own[:, 1])  # the wall itself moves by that
    if isinstance(model, LineModel):  # it is compared where it faces the landmark's origin
        own[:, 1] += model.along(seen.z, seen.x, seen.t) * own[:, 2]
        own = own[:, 1:]
    noise = model.noise(seen.z, seen.cov, seen.x, seen.t)
    weighted = np.linalg.solve(noise, own[:, :, None])
    H_x, H_t = model.jacobians(seen.z, seen.x, seen.t)
    of_state, of_landmark = seen.state_rows(root), seen.landmark_rows(root)
    for H, poses, rows in ((H_x, seen.x, of_state), (H_t, seen.t, of_landmark)):
        yield rows, ((H @ rotation3(poses[:, 2])).mT @ weighted)[:, :, 0]
