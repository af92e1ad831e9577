"""How well two scans fit when one is moved along the walls that both see.

Along a corridor the matching of scans (`scan_matching`) leaves the path to odometry: its walls look
the same everywhere, and what else is seen, doors in niches or a pillar, is a few returns only. They
do not measure the path, but over several scans they tell a path from twice the path.
"""

from typing import NamedTuple

import numpy as np

from graphslam.core.geometry import Array, between, transform

#: m: returns are looked at that are nearer: beyond, those on a wall beside are too far apart
NEAR_M = 6.0
#: m: neighbouring returns that are nearer are on one surface
SURFACE_GAP_M = 0.5
#: m: a distance from a surface; the largest that counts, in these
SIGMA_M, MOST = 0.03, 3.0
#: returns by which a wall's direction is measured; m: the length of that; how many there must be
STRIDE, LENGTH_M, LEAST_PIECES = 5, (0.1, 1.0), 10
#: share of walls in other directions (of squared sines) up to which one direction is open
OPEN = 0.15
LEAST_RETURNS = 30
#: share of returns that a pose must put where the first scan could see
LEAST_IN_VIEW = 0.5
#: returns of a scan that are compared
MOST_RETURNS = 90
#: segments of a surface beside the bearing of a return that it may lie on
NEIGHBOURS = (-3, -2, -1, 0, 1)


class NearReturns(NamedTuple):
    """Near returns (n, 2) of a scan in the frame of the laser, sorted by ``bearings`` (n,)."""

    points: Array
    bearings: Array


def near_returns(points: Array, sensor: Array) -> NearReturns | None:
    """The returns (n, 2) near a laser at ``sensor`` (3,) in their frame; None if they are few."""
    own = transform(between(sensor, np.zeros(3)), points)
    ranges = np.hypot(own[:, 0], own[:, 1])
    own = own[(ranges > 0.1) & (ranges < NEAR_M)]
    if len(own) < LEAST_RETURNS:
        return None
    bearings = np.arctan2(own[:, 1], own[:, 0])
    order = np.argsort(bearings)
    return NearReturns(own[order], bearings[order])


def open_direction(scan: NearReturns) -> Array | None:
    """Unit vector (2,) along the walls; None if there are walls in other directions too."""
    pieces = scan.points[STRIDE:] - scan.points[:-STRIDE]
    length = np.hypot(pieces[:, 0], pieces[:, 1])
    use = (length > LENGTH_M[0]) & (length < LENGTH_M[1])
    if np.count_nonzero(use) < LEAST_PIECES:
        return None
    unit, weight = pieces[use] / length[use, None], length[use]
    shares, axes = np.linalg.eigh((unit * weight[:, None]).T @ unit / weight.sum())
    return np.asarray(axes[:, 1]) if shares[0] < OPEN else None


def misfits(surface: NearReturns, scan: NearReturns, poses: Array) -> Array:
    """Mean squared distances (h,), in sigmas and limited, of a scan seen from several poses.

    Returns that a pose puts where the first scan could not see do not count for it; a pose that
    puts most of them there has the largest distance.

    Args:
        surface: the scan that it is compared with; neighbouring returns are joined.
        scan: the other.
        poses: (h, 3) of its laser in the frame of the first one's.
    """
    points = scan.points[:: 1 + len(scan.points) // MOST_RETURNS]
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    turns = np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)
    placed = points @ turns.mT + poses[:, None, :2]
    at = np.searchsorted(surface.bearings, np.arctan2(placed[..., 1], placed[..., 0]))
    begins, along = surface.points[:-1], np.diff(surface.points, axis=0)
    squared_m2 = np.maximum((along**2).sum(axis=1), 1e-12)
    is_joined = squared_m2 < SURFACE_GAP_M**2
    nearest = np.full(at.shape, np.inf)
    for offset in NEIGHBOURS:
        k = np.clip(at + offset, 0, len(begins) - 1)
        away = placed - begins[k]
        share = np.clip((away * along[k]).sum(axis=-1) / squared_m2[k], 0.0, 1.0)
        share = np.where(is_joined[k], share, np.round(share))
        away -= share[..., None] * along[k]
        nearest = np.minimum(nearest, (away**2).sum(axis=-1))
    # where the first scan could not see nothing speaks for a pose or against it
    in_view = (np.hypot(placed[..., 0], placed[..., 1]) < NEAR_M) & (at > 0)
    in_view &= at < len(surface.points)
    squared = np.minimum(nearest / SIGMA_M**2, MOST**2)
    count = in_view.sum(axis=-1)
    mean = (squared * in_view).sum(axis=-1) / np.maximum(count, 1)
    return np.asarray(np.where(count >= LEAST_IN_VIEW * len(points), mean, MOST**2))
