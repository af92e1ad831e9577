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
#: rounds of Gauss-Newton, in each of which returns look for their walls
ROUNDS = 2
#: the noise of the prior is found from so many scans, spread over all, in at most so many rounds,
#: until its sigmas grow by less
SAMPLE, MAX_ROUNDS, NOISE_GROWTH = 600, 6, 1.02
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

    def only(self, scans: IntArray) -> "ScanReturns":
        """Those of some scans (m,), rows."""
        number = self.number[scans]
        begin = (np.cumsum(self.number) - self.number)[scans]
        rows = np.repeat(begin + number - np.cumsum(number), number) + np.arange(number.sum())
        return ScanReturns(number, self.points[rows], self.lasers[scans])


def match_to_walls(
    poses: Array,
    covs: Array,
    returns: ScanReturns,
    walls: WallTree,
    config: FrontEndConfig,
) -> tuple[Array, Array]:
    """Poses of scans by their returns on walls, and by what was known of them.

    Args:
        poses: (n, 3) of the scans, world frame, near the truth.
        covs: (n, 3, 3) of their errors, along their own axes, independent of each other. Where they
            turn out to be larger by a factor on each axis, that is taken into account.
        returns: of the scans, in the frames of ``poses``.
        walls: as they are estimated, world frame.
        config: noise of returns and of surfaces.

    Returns:
        Poses (n, 3), world frame; their covariances (n, 3, 3) given the map, along their own axes.
    """
    if not len(poses):
        return poses, covs
    covs = covs + TINY
    scans = np.arange(len(poses))
    some = scans[:: -(-len(scans) // SAMPLE)]
    sample = _Block(poses[some], covs[some], returns.only(some), walls, config)
    scale = _noise_scale(sample)
    made = []
    for begin in range(0, len(scans), BLOCK):
        own = scans[begin : begin + BLOCK]
        block = _Block(poses[own], covs[own], returns.only(own), walls, config)
        found, left = poses[own], covs[own]
        for _ in range(ROUNDS):
            found, left = block.matched(found, scale)
        made.append((found, left))
    found, left = (np.concatenate(parts) for parts in zip(*made, strict=True))
    return found, left


def _noise_scale(block: "_Block") -> Array:
    """Factors (3,) on the sigmas of the prior of some scans, at least 1."""
    scale, poses = np.ones(3), block.prior
    for round_ in range(MAX_ROUNDS):
        poses, left = block.matched(poses, scale)
        # what the prior is off by, and what is not known of that
        off = between(block.prior, poses) ** 2 + np.diagonal(left, axis1=1, axis2=2)
        share = np.mean(off / np.diagonal(block.covs, axis1=1, axis2=2), axis=0)
        growth = np.sqrt(share) / scale
        scale = np.maximum(scale * growth**ACCELERATION, 1.0)
        if round_ and np.all(growth < NOISE_GROWTH):
            break
    return scale


class _Block:
    """Scans that are matched together, with the pairs of returns and walls that may be one."""

    def __init__(
        self,
        prior: Array,
        covs: Array,
        returns: ScanReturns,
        walls: WallTree,
        config: FrontEndConfig,
    ) -> None:
        self.prior, self.covs = prior, covs
        self._walls, self._config = walls, config
        self._scan, self._points = returns.scan, returns.points.astype(float)
        self._lasers = returns.lasers
        self._near = walls.near(transform_each(prior[self._scan], self._points))

    def matched(self, poses: Array, scale: Array) -> tuple[Array, Array]:
        """A step from ``poses`` (n, 3) to better ones; the covariances (n, 3, 3) of these.

        ``scale`` (3,): factors on the sigmas of the prior.
        """
        scan, walls, config = self._scan, self._walls, self._config
        covs = scale[:, None] * self.covs * scale
        place_m = np.maximum(np.sqrt(0.5 * (covs[:, 0, 0] + covs[:, 1, 1])), LEAST_M)
        heading_rad = np.maximum(np.sqrt(covs[:, 2, 2]), LEAST_RAD)
        world = transform_each(poses[scan], self._points)
        on = returns_on_walls(
            self._near, world, transform_each(poses, self._lasers)[scan], walls, config,
            gate=GATE, margin_m=0.0, heading_rad=heading_rad[scan], place_m=place_m[scan],
        )  # fmt: skip
        of = scan[on.row]
        weight = on.weights(of * len(walls.means) + on.wall, config.floor_normal_m)
        far = np.abs(on.across) / np.hypot(on.sigma, config.floor_normal_m)
        weight *= np.minimum(1.0, HUBER / np.maximum(far, HUBER))
        c, s = (f(walls.means[:, 2])[on.wall] for f in (np.cos, np.sin))
        x, y = (world[on.row] - poses[of, :2]).T
        J = -s, c, c * x + s * y  # of the distance across, by the pose
        off = self.prior - poses
        off[:, 2] = wrap(off[:, 2])
        M = rotate_cov(np.asarray(np.linalg.inv(covs)), self.prior[:, 2])
        b = (M @ off[:, :, None])[:, :, 0]
        for i in range(3):
            own = weight * J[i]
            b[:, i] -= np.bincount(of, own * on.across, len(poses))
            for j in range(i, 3):
                M[:, i, j] += np.bincount(of, own * J[j], len(poses))
                M[:, j, i] = M[:, i, j]
        found = poses + np.linalg.solve(M, b[:, :, None])[:, :, 0]
        return found, rotate_cov(np.asarray(np.linalg.inv(M)), -found[:, 2])
