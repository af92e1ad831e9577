"""Scan-to-map matching: scans that have no state are laid on the walls of the solved map.

Odometry says where such a scan was between the states around it, to some millimetres and a third of
a degree. Once the map is known, its returns on known walls say so better. This moves neither states
nor landmarks: a scan is a Gauss-Newton solution for its own pose (P. J. Besl and N. D. McKay, A
method for registration of 3-D shapes, IEEE PAMI 14(2), 1992, DOI 10.1109/34.121791, with lines for
points), its pose by odometry being the prior.

The work grows with the number of scans and of walls; a scan has a limited number of returns.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.config import FrontEndConfig
from graphslam.core.geometry import Array, between, rotate_cov, transform_each, wrap
from graphslam.mapping.returns_on_walls import OnWalls, WallTree, returns_on_walls
from graphslam.perception.beam_noise import noisier

#: sigmas that a return may be off the wall that it is taken for, and from which on it pulls with
#: less than its distance (Huber)
GATE, HUBER = 2.5, 1.5
#: m, rad: a scan is taken to be off by so much at least while its returns look for their walls
LEAST_M, LEAST_RAD = 0.01, 0.003
#: rounds of Gauss-Newton, at most, in each of which returns look for their walls: of all scans,
#: then of those that moved by more (m, m, rad) in the one before
ROUNDS, SETTLED = 6, (0.004, 0.004, 0.004)
#: a scan of which a smaller share of returns is on walls than this one of the median share has not
#: found its place, or sees what is not in the map: nothing is better known of it
LEAST_SHARE = 0.6
#: noise is found from so many scans, spread over all, in at most so many rounds, until it grows by
#: less
SAMPLE, MAX_ROUNDS, NOISE_GROWTH = 600, 6, 1.02
#: power of the growth that each round finds: expectation maximisation by itself is slow
ACCELERATION = 2.0
#: the spread of returns is that of those within so many times the gate; the median of the absolute
#: value of a normal variable is 0.6745 sigmas
SPREAD_GATE, MEDIAN_SIGMAS = 3.0, 0.6745
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


class MatchedScans(NamedTuple):
    """Poses (n, 3), world frame; covariances (n, 3, 3) given the map; those without the returns.

    Covariances are along the scans' own axes. ``prior_covs`` (n, 3, 3) are as large as the returns
    show them to be.
    """

    poses: Array
    covs: Array
    prior_covs: Array


def match_to_walls(
    poses: Array,
    covs: Array,
    returns: Callable[[IntArray], ScanReturns],
    walls: WallTree,
    config: FrontEndConfig,
) -> MatchedScans:
    """Poses of scans by their returns on walls, and by what was known of them.

    Args:
        poses: (n, 3) of the scans, world frame, near the truth.
        covs: (n, 3, 3) of their errors, along their own axes, independent of each other. Where they
            turn out to be larger by a factor on each axis, that is taken into account.
        returns: of scans (m,), rows; in the frames of ``poses``.
        walls: as they are estimated, world frame.
        config: noise of returns and of surfaces. Where returns turn out to spread more, so does
            their noise.
    """
    if not len(poses):
        return MatchedScans(poses, covs, covs)
    covs = covs + TINY
    scans = np.arange(len(poses))
    some = scans[:: -(-len(scans) // SAMPLE)]
    scale, spread = _noise(_Block(poses[some], covs[some], returns(some), walls, config))
    covs = scale[:, None] * covs * scale
    config = noisier(config, spread)
    made = []
    for begin in range(0, len(scans), BLOCK):
        own = scans[begin : begin + BLOCK]
        fits = fit_to_walls(poses[own], covs[own], returns(own), walls, config)
        lost = ~_found(fits.share)
        fits.poses[lost], fits.covs[lost] = poses[own][lost], covs[own][lost]
        made.append(fits[:2])
    found, left = (np.concatenate(parts) for parts in zip(*made, strict=True))
    return MatchedScans(found, left, covs)


def _noise(block: "_Block") -> tuple[Array, float]:
    """Factors on the sigmas of the prior of some scans (3,), and on that of ranges, at least 1."""
    scale, spread, poses = np.ones(3), 1.0, block.prior
    for round_ in range(MAX_ROUNDS):
        step = block.matched(poses, scale, spread)
        poses = step.poses
        # what the prior is off by, and what is not known of that
        off = between(block.prior, poses) ** 2 + np.diagonal(step.covs, axis1=1, axis2=2)
        ratio = (off / np.diagonal(block.covs, axis1=1, axis2=2))[_found(step.share)]
        growth = np.sqrt(ratio.mean(axis=0)) / scale if len(ratio) else np.ones(3)
        wider = max(block.spread(poses, spread), 1.0)
        scale, spread = np.maximum(scale * growth**ACCELERATION, 1.0), spread * wider
        if round_ and np.all(growth < NOISE_GROWTH) and wider < NOISE_GROWTH:
            break
    return scale, spread


def fit_to_walls(
    prior: Array, covs: Array, returns: ScanReturns, walls: WallTree, config: FrontEndConfig
) -> "ScanFits":
    """`match_to_walls` of some scans with known noise; whether they are lost is to be seen.

    Args:
        prior: (n, 3) poses of the scans.
        covs: (n, 3, 3) of their errors, along their own axes.
        returns: of the scans, in the frames of ``prior``.
        walls: in the frame in which ``prior`` is.
        config: noise of returns and of surfaces.
    """
    poses, left, share = _Block(prior, covs, returns, walls, config).matched(prior)
    moved, far = between(prior, poses), np.arange(len(prior))
    for _ in range(ROUNDS - 1):
        moving = (np.abs(moved) > SETTLED).any(axis=1)
        far = far[moving]
        if not len(far):
            break
        before = poses[far]
        block = _Block(prior[far], covs[far], returns.only(far), walls, config, before)
        poses[far], left[far], share[far] = block.matched(before)
        moved = between(before, poses[far])
    return ScanFits(poses, left, share)


def _found(share: Array) -> BoolArray:
    """Which scans, of whose returns a ``share`` (n,) is on walls, have found their place."""
    some = share[share > 0]
    return share >= LEAST_SHARE * np.median(some) if len(some) else share > 0


class ScanFits(NamedTuple):
    """Poses (n, 3), covariances (n, 3, 3) along their own axes, and the share (n,) on walls."""

    poses: Array
    covs: Array
    share: Array


class _Block:
    """Scans that are matched together, with the pairs of returns and walls that may be one.

    These are found from where the scans ``start``, mostly their ``prior``.
    """

    def __init__(
        self,
        prior: Array,
        covs: Array,
        returns: ScanReturns,
        walls: WallTree,
        config: FrontEndConfig,
        start: Array | None = None,
    ) -> None:
        self.prior, self.covs = prior, covs
        self._walls, self._config = walls, config
        self._scan, self._points = returns.scan, returns.points.astype(float)
        self._number, self._lasers = returns.number, returns.lasers
        self._near = walls.near(self._in_world(prior if start is None else start))

    def matched(self, poses: Array, scale: Array | float = 1.0, spread: float = 1.0) -> ScanFits:
        """A step from ``poses`` (n, 3) to better ones.

        ``scale``: factors (3,) on the sigmas of the prior; ``spread``: one on that of ranges.
        """
        covs = np.multiply.outer(scale, scale) * self.covs if np.ndim(scale) else self.covs
        place_m = np.maximum(np.sqrt(0.5 * (covs[:, 0, 0] + covs[:, 1, 1])), LEAST_M)
        heading_rad = np.maximum(np.sqrt(covs[:, 2, 2]), LEAST_RAD)
        world = self._in_world(poses)
        on = self._on_walls(world, poses, GATE, heading_rad, place_m, spread)
        of, floor_m = self._scan[on.row], self._config.floor_normal_m
        weight = on.weights(of * len(self._walls.means) + on.wall, floor_m)
        far = np.abs(on.across) / np.hypot(on.sigma, floor_m)
        weight *= np.minimum(1.0, HUBER / np.maximum(far, HUBER))
        c, s = (f(self._walls.means[:, 2])[on.wall] for f in (np.cos, np.sin))
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
        left = rotate_cov(np.asarray(np.linalg.inv(M)), -found[:, 2])
        share = np.bincount(of, minlength=len(poses)) / np.maximum(self._number, 1)
        return ScanFits(found, left, share)

    def spread(self, poses: Array, spread: float) -> float:
        """By which factor returns spread more about the walls than they should."""
        least = np.full(len(poses), LEAST_RAD), np.full(len(poses), LEAST_M)
        gate = SPREAD_GATE * GATE
        on = self._on_walls(self._in_world(poses), poses, gate, *least, spread)
        off = np.abs(on.across) / np.hypot(on.sigma, self._config.floor_normal_m)
        return float(np.median(off)) / MEDIAN_SIGMAS if len(off) else 1.0

    def _in_world(self, poses: Array) -> Array:
        return transform_each(poses[self._scan], self._points)

    def _on_walls(
        self,
        world: Array,
        poses: Array,
        gate: float,
        heading_rad: Array,
        place_m: Array,
        spread: float,
    ) -> OnWalls:
        scan, config = self._scan, self._config
        if spread != 1.0:
            config = noisier(config, spread)
        return returns_on_walls(
            self._near, world, transform_each(poses, self._lasers)[scan], self._walls, config,
            gate=gate, margin_m=0.0, heading_rad=heading_rad[scan], place_m=place_m[scan],
        )  # fmt: skip
