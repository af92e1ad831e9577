"""What the biases of surfaces leave of the mounts' errors.

A surface returns all its ranges with one bias, and no number of scans averages it. Seen head-on it
moves the wall, on which no other variable depends; seen at a slant it moves and turns it by less.
A robot that turns sees its walls under all angles, and what fits them together is the mount, so
the difference moves it. By how much follows from the solution: errors δ of measurements move it by
P Hᵀ W δ. That is the consider covariance of S. F. Schmidt, Application of state-space methods to
navigation problems, Advances in Control Systems 3, 1966, DOI 10.1016/B978-1-4831-6716-9.50011-4.
"""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from graphslam.core.geometry import Array, inverse
from graphslam.core.mount_covariances import MountCovariances
from graphslam.core.observation_models import MODELS, LineModel
from graphslam.core.records import Association, Estimate, Step

#: beams of a wall at which the bias is looked at
BEAMS = 9
#: share of a bias's variance that all surfaces have in common: that of the laser itself, and of the
#: material that most walls of a building are of
COMMON = 0.5


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


def mount_bias(steps: Sequence[Step], estimate: Estimate, sigma_m: float) -> Array:
    """Covariance (3R, 3R), m and rad, that biases of surfaces add to `Estimate.mounts`.

    Args:
        steps: as they were solved.
        estimate: their solution, whose states are those of the sensors.
        sigma_m: of the bias of a surface, in m; all observations of one landmark have the same,
            and `COMMON` of its variance is that of all.
    """
    _, moved = mount_shifts(steps, estimate)
    together = moved.sum(axis=0)
    own, common = moved.T @ moved, np.outer(together, together)
    return np.asarray(sigma_m**2 * ((1.0 - COMMON) * own + COMMON * common))


def mount_shifts(steps: Sequence[Step], estimate: Estimate) -> tuple[list[int], Array]:
    """Landmarks, and by how much the mounts (n, 3R) move for each m of bias of their ranges."""
    mounts = estimate.mounts
    assert mounts is not None
    seen: dict[tuple[str, str], list[Association]] = defaultdict(list)
    for step in steps:
        for a in step.associations:
            if a.extent is not None and a.target in mounts.landmarks:
                seen[a.robot, a.model].append(a)
    numbers = {number: k for k, number in enumerate(mounts.landmarks)}
    moved = np.zeros((len(numbers), len(mounts.cov)))
    for (robot, model), own in seen.items():
        rows = np.array([numbers[int(a.target)] for a in own])
        np.add.at(moved, rows, _moved(own, robot, model, estimate, mounts))
    return list(numbers), moved


def _moved(
    seen: Sequence[Association],
    robot: str,
    name: str,
    estimate: Estimate,
    mounts: MountCovariances,
) -> Array:
    """By how much the mounts move (n, 3R) for each m of bias in one of these observations."""
    states, model = estimate.states[robot], MODELS[name]
    at = np.searchsorted(states.stamps_ns, [a.time_ns for a in seen])
    z, cov = np.array([a.z for a in seen]), np.array([a.cov for a in seen])
    x, t = states.poses[at], np.array([estimate.landmarks[int(a.target)][0] for a in seen])
    own = bias_of_lines(z, np.array([a.extent for a in seen]))
    if isinstance(model, LineModel):  # it is compared where it faces the landmark's origin
        own[:, 1] += model.along(z, x, t) * own[:, 2]
        own = own[:, 1:]
    weighted = np.linalg.solve(model.noise(z, cov, x, t), own[:, :, None])
    H_x, H_t = model.jacobians(z, x, t)
    by_landmark = np.array([mounts.landmarks[int(a.target)] for a in seen])
    found = mounts.states[robot][at].mT @ (H_x.mT @ weighted)
    return np.asarray((found + by_landmark.mT @ (H_t.mT @ weighted))[:, :, 0])
