"""A visit's path made straight by its own scans, where the smoothed one bends.

A map may bend where few landmarks hold it: a corner turned on odometry alone. Two visits then bend
differently and no rigid motion brings one onto the other. Here each scan is matched to the surfaces
that the scans shortly before it saw (point to line, doi:10.1109/ROBOT.2008.4543181), predicted by
the smoothed motion. What the scans agree on over a few metres is straight to a degree.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from graphslam.changes.visit import Bools, Visit
from graphslam.geometry import Array, between, compose, rotation, transform, wrap

#: scans before that make the surfaces, and every how many of them
_WINDOW, _EVERY = 30, 3
#: sigmas of the smoothed motion from scan to scan
_STEP_SIGMAS = np.array([0.01, 0.01, 0.01])
_GATES_M = (0.2, 0.15, 0.1, 0.1)
#: what a return lies off a surface by, m: neighbours share errors, so more than their noise
_SIGMA_M = 0.04
#: beams to each side that tell the direction of a surface, and how straight they must be
_SIDE, _STRAIGHT, _FEWEST = 3, 0.1, 20


def straightened(visit: Visit) -> Visit:
    """The visit on a path that its scans agree with; its first scan stays where it is."""
    local = visit.range_m[:, None] * np.column_stack([np.cos(visit.angle), np.sin(visit.angle)])
    normals, flat = _normals(visit, local)
    ends = np.searchsorted(visit.scan, np.arange(len(visit.poses) + 1))
    points, lines, facing = [], [], []
    for low, high in pairwise(ends):
        points.append(local[low:high][visit.surface[low:high]])
        lines.append(local[low:high][flat[low:high]])
        facing.append(normals[low:high][flat[low:high]])
    poses = visit.poses.copy()
    prior = np.diag(_STEP_SIGMAS**-2.0)
    for i in range(1, len(poses)):
        poses[i] = compose(poses[i - 1], between(visit.poses[i - 1], visit.poses[i]))
        before = range(max(0, i - _WINDOW), i)[::-_EVERY]
        at = np.concatenate([transform(poses[k], lines[k]) for k in before])
        n = np.concatenate([facing[k] @ rotation(poses[k, 2]).T for k in before])
        if len(at) >= _FEWEST and len(points[i]) >= _FEWEST:
            poses[i] = _matched(poses[i], prior, points[i], at, n)
    return replace(visit, poses=poses)


def _normals(visit: Visit, local: Array) -> tuple[Array, Bools]:
    """Of the surface at each return (n, 2), in the laser's frame, and where it is straight (n,)."""
    width = 2 * _SIDE + 1
    normals, flat = np.zeros_like(local), np.zeros(len(local), dtype=bool)
    if len(local) < width:
        return normals, flat
    windows = np.lib.stride_tricks.sliding_window_view(np.nan_to_num(local), width, axis=0)
    away = windows - windows.mean(axis=2, keepdims=True)
    values, vectors = np.linalg.eigh(away @ away.mT)
    normals[_SIDE:-_SIDE] = vectors[:, :, 0]
    whole = np.lib.stride_tricks.sliding_window_view(visit.surface, width).all(axis=1)
    one_scan = visit.scan[width - 1 :] == visit.scan[: len(visit.scan) - width + 1]
    flat[_SIDE:-_SIDE] = whole & one_scan & (values[:, 0] < _STRAIGHT * values[:, 1])
    return normals, flat


def _matched(pose: Array, prior: Array, points: Array, at: Array, normals: Array) -> Array:
    """The pose (3,) near ``pose`` that brings ``points`` (k, 2) onto lines ``at`` (m, 2) m.

    ``prior`` (3, 3) is the information of ``pose``.
    """
    tree, start = cKDTree(at), pose
    for gate in _GATES_M:
        world = transform(pose, points)
        away, near = tree.query(world, distance_upper_bound=gate)
        used = np.isfinite(away)
        n, d = normals[near[used]], world[used] - at[near[used]]
        e = np.einsum("ni,ni->n", n, d)
        arm = world[used] - pose[:2]
        J = np.column_stack([n, -n[:, 0] * arm[:, 1] + n[:, 1] * arm[:, 0]])
        weight = _SIGMA_M**-2.0 / (1 + (2 * e / gate) ** 2) ** 2
        back = start - pose
        back[2] = wrap(back[2])
        step = np.linalg.solve(
            J.T @ (weight[:, None] * J) + prior, J.T @ (weight * -e) + prior @ back
        )
        pose = np.array([*(pose[:2] + step[:2]), wrap(pose[2] + step[2])])
    return pose
