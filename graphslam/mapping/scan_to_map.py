"""Scan-to-map matching: scans that have no state are laid on the walls of the solved map.

Odometry says where such a scan was between the states around it, to some millimetres and a third of
a degree. Once the map is known, its returns on known walls say so better. This moves neither states
nor landmarks: a scan is a Gauss-Newton solution for its own pose (P. J. Besl and N. D. McKay, A
method for registration of 3-D shapes, IEEE PAMI 14(2), 1992, DOI 10.1109/34.121791, with lines for
points), its pose by odometry being the prior.

The work grows with the number of scans and of walls; a scan has a limited number of returns.
"""

from dataclasses import dataclass

import numpy as np

from graphslam.core.config import FrontEndConfig
from graphslam.core.geometry import Array, between, rotate_cov, transform_each, wrap
from graphslam.mapping.gating import IntArray
from graphslam.mapping.returns_on_walls import WallTree, returns_on_walls

#: sigmas that a return may be off the wall that it is taken for, and from which on it pulls with
#: less than its distance (Huber)
GATE, HUBER = 2.5, 1.5
#: m, rad: a scan is taken to be off by so much at least while its returns look for their walls
LEAST_M, LEAST_RAD = 0.01, 0.003
#: rounds of Gauss-Newton, in each of which returns look for their walls and the noise of the prior
#: is found: at least, and at most until its sigmas grow by less
ROUNDS, MAX_ROUNDS, NOISE_GROWTH = 2, 4, 1.05
#: power of the growth that each round finds: expectation maximisation by itself is slow
ACCELERATION = 2.0
#: m, rad: added to the prior, which may be exact
TINY = np.diag([1e-4, 1e-4, 1e-5]) ** 2
#: scans that are matched at once: memory is that of their returns
BLOCK = 512


@dataclass(frozen=True, slots=True, eq=False)
class ScanReturns:
    """Some returns of each of n scans.

    ``number`` (n,): how many of ``points`` (k, 2) m are of each, one scan after the other, in the
    frame in which its pose is asked for, with the laser at ``lasers`` (n, 2) m.
    """

    number: IntArray
    points: Array
    lasers: Array

    @property
    def scan(self) -> IntArray:
        """(k,): which scan each point is of."""
        return np.repeat(np.arange(len(self.number)), self.number)

    def blocks(self, size: int) -> "list[tuple[slice, ScanReturns]]":
        """Parts of ``size`` scans, each with the rows of its scans."""
        ends = np.cumsum(self.number)
        found = []
        for begin in range(0, len(self.number), size):
            own = slice(begin, min(begin + size, len(self.number)))
            points = self.points[ends[begin] - self.number[begin] : ends[own.stop - 1]]
            found.append((own, ScanReturns(self.number[own], points, self.lasers[own])))
        return found


def match_to_walls(
    poses: Array,
    covs: Array,
    returns: ScanReturns,
    walls: WallTree | None,
    config: FrontEndConfig,
) -> tuple[Array, Array]:
    """Poses of scans by their returns on walls, and by what was known of them.

    Args:
        poses: (n, 3) of the scans, world frame, near the truth.
        covs: (n, 3, 3) of their errors, along their own axes, independent of each other.
        returns: of the scans, in the frames of ``poses``.
        walls: as they are estimated, world frame; None without any.
        config: noise of returns and of surfaces.

    Returns:
        Poses (n, 3), world frame; their covariances (n, 3, 3) given the map, along their own axes.
    """
    if walls is None or not len(poses):
        return poses, covs
    prior, scale = poses, np.ones(3)
    blocks = returns.blocks(BLOCK)
    near = [walls.near(_in_world(poses[own], part)) for own, part in blocks]
    covs = covs + TINY
    for round_ in range(MAX_ROUNDS):
        known = scale[:, None] * covs * scale
        made = [
            _matched(poses[own], prior[own], known[own], part, pairs, walls, config)
            for (own, part), pairs in zip(blocks, near, strict=True)
        ]
        found, left = (np.concatenate(parts) for parts in zip(*made, strict=True))
        poses = found
        # what the prior is off by, and what is not known of that
        off = between(prior, poses) ** 2 + np.diagonal(left, axis1=1, axis2=2)
        share = np.mean(off / np.diagonal(covs, axis1=1, axis2=2), axis=0)
        growth = np.sqrt(share) / scale
        if round_ + 1 >= ROUNDS and np.all(growth < NOISE_GROWTH):
            break
        scale = np.maximum(scale * growth**ACCELERATION, 1.0)
    return poses, left


def _matched(
    poses: Array,
    prior: Array,
    covs: Array,
    returns: ScanReturns,
    near: tuple[IntArray, IntArray],
    walls: WallTree,
    config: FrontEndConfig,
) -> tuple[Array, Array]:
    """A step of `match_to_walls` for some scans, from ``poses`` (n, 3).

    ``near``: rows of returns and of walls (p,), (p,) that are near each other.
    """
    place_m = np.maximum(np.sqrt(0.5 * (covs[:, 0, 0] + covs[:, 1, 1])), LEAST_M)
    heading_rad = np.maximum(np.sqrt(covs[:, 2, 2]), LEAST_RAD)
    scan, world = returns.scan, _in_world(poses, returns)
    on = returns_on_walls(
        near, world, transform_each(poses, returns.lasers)[scan], walls, config,
        gate=GATE, margin_m=0.0, heading_rad=heading_rad[scan], place_m=place_m[scan],
    )  # fmt: skip
    of = scan[on.row]
    weight = on.weights(of * len(walls.means) + on.wall, config.floor_normal_m)
    far = np.abs(on.across) / np.hypot(on.sigma, config.floor_normal_m)
    weight *= np.minimum(1.0, HUBER / np.maximum(far, HUBER))
    c, s = (f(walls.means[on.wall, 2]) for f in (np.cos, np.sin))
    arm = world[on.row] - poses[of, :2]
    J = np.column_stack([-s, c, c * arm[:, 0] + s * arm[:, 1]])  # of across, by the pose
    M, off = rotate_cov(np.asarray(np.linalg.inv(covs)), prior[:, 2]), prior - poses
    off[:, 2] = wrap(off[:, 2])
    b = (M @ off[:, :, None])[:, :, 0]
    for i in range(3):
        b[:, i] -= np.bincount(of, weight * on.across * J[:, i], len(poses))
        for j in range(3):
            M[:, i, j] += np.bincount(of, weight * J[:, i] * J[:, j], len(poses))
    poses = poses + np.linalg.solve(M, b[:, :, None])[:, :, 0]
    return poses, rotate_cov(np.asarray(np.linalg.inv(M)), -poses[:, 2])


def _in_world(poses: Array, returns: ScanReturns) -> Array:
    """Where returns (k, 2) are if their scans are at ``poses`` (n, 3)."""
    return transform_each(poses[returns.scan], returns.points.astype(float))
