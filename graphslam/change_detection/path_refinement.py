"""A visit's path made straight by its own scans, where the smoothed one bends.

A map may bend where few landmarks hold it: a corner turned on odometry alone. Two visits then bend
differently and no rigid motion brings one onto the other. Here each scan is matched to what the
scans shortly before it saw (doi:10.1109/ROBOT.2008.4543181), predicted by the smoothed motion,
which is doubted where it jumps. From there all poses are found at once (`relax`), so that the shape
is that of the scans, however the smoothed path was bent.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from graphslam.change_detection.scan_network import Cloud, relax_scan_network
from graphslam.change_detection.visit import Bools, Visit
from graphslam.core.geometry import Array, between, compose, polar_points, rotation, transform, wrap

#: scans before that make the surfaces, and every how many of them
_WINDOW, _EVERY = 30, 3
#: sigmas of the smoothed motion from scan to scan, and the distance in sigmas from which on it is
#: doubted: a path that was pulled by a wrong match jumps by degrees between two keyframes
_STEP_SIGMAS, _DOUBTED = np.array([0.01, 0.01, 0.01]), 2.0
#: turns that are tried where the smoothed motion may have jumped, rad, and how near a return must
#: lie to a surface to speak for one, m
_TURNS = np.radians(np.arange(-12.0, 12.5, 1.0))
_TURN_GATE_M = 0.1
_GATES_M = (0.2, 0.15, 0.1, 0.1)
#: what a return lies off a surface by, m: neighbours share errors, so more than their noise
_SIGMA_M = 0.04
#: beams to each side that tell the direction of a surface, and how straight they must be
_SIDE, _STRAIGHT, _FEWEST = 3, 0.1, 20


def refine_path(visit: Visit) -> Visit:
    """The visit on a path that its scans agree with; its first scan stays where it is."""
    local = polar_points(visit.range_m, visit.angle)
    normals, flat = _normals(visit, local)
    metrics = np.where(flat[:, None, None], normals[:, :, None] * normals[:, None, :], np.eye(2))
    ends = np.searchsorted(visit.scan, np.arange(len(visit.poses) + 1))
    points, facing = [], []
    for low, high in pairwise(ends):
        back = np.isfinite(visit.range_m[low:high])
        points.append(local[low:high][back])
        facing.append(metrics[low:high][back])
    poses = visit.poses.copy()
    prior = np.diag(_STEP_SIGMAS**-2.0)
    for i in range(1, len(poses)):
        poses[i] = compose(poses[i - 1], between(visit.poses[i - 1], visit.poses[i]))
        before = range(max(0, i - _WINDOW), i)[::-_EVERY]
        at = np.concatenate([transform(poses[k], points[k]) for k in before])
        turns = [rotation(poses[k, 2]) for k in before]
        n = np.concatenate([R @ facing[k] @ R.T for k, R in zip(before, turns, strict=True)])
        if len(at) >= _FEWEST and len(points[i]) >= _FEWEST:
            poses[i] = _matched(poses[i], prior, points[i], at, n)
    back = np.isfinite(visit.range_m)
    cloud = Cloud(visit.scan[back], local[back], metrics[back])
    motion = between(visit.poses[:-1], visit.poses[1:])
    return replace(visit, poses=relax_scan_network(poses, cloud, motion, _STEP_SIGMAS, _DOUBTED))


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


def _matched(pose: Array, prior: Array, points: Array, at: Array, metrics: Array) -> Array:
    """The pose (3,) near ``pose`` that brings ``points`` (k, 2) onto those ``at`` (m, 2) m.

    ``metrics`` (m, 2, 2) project onto the normal where they are on a line; ``prior`` (3, 3) is the
    information of ``pose``.
    """
    tree, start = cKDTree(at), pose
    pose = _turned(tree, pose, points)
    for gate in _GATES_M:
        world = transform(pose, points)
        away, near = tree.query(world, distance_upper_bound=gate)
        used = np.isfinite(away)
        M, d = metrics[near[used]], world[used] - at[near[used]]
        e2 = np.einsum("ni,nij,nj->n", d, M, d)
        arm = world[used] - pose[:2]
        J = np.zeros((len(d), 2, 3))
        J[:, 0, 0] = J[:, 1, 1] = 1.0
        J[:, 0, 2], J[:, 1, 2] = -arm[:, 1], arm[:, 0]
        weight = _SIGMA_M**-2.0 / (1 + e2 * (2 / gate) ** 2) ** 2
        JM = weight[:, None, None] * (J.mT @ M)
        back = start - pose
        back[2] = wrap(back[2])
        held = prior / (1 + back @ prior @ back / _DOUBTED**2)
        step = np.linalg.solve(
            (JM @ J).sum(axis=0) + held, held @ back - np.einsum("nai,ni->a", JM, d)
        )
        pose = np.array([*(pose[:2] + step[:2]), wrap(pose[2] + step[2])])
    return pose


def _turned(tree: cKDTree, pose: Array, points: Array) -> Array:
    """The pose (3,) turned by what brings most of ``points`` (k, 2) onto the tree's."""
    tried = np.tile(pose, (len(_TURNS), 1))
    tried[:, 2] += _TURNS
    world = np.concatenate([transform(turned, points) for turned in tried])
    away = tree.query(world, distance_upper_bound=_TURN_GATE_M)[0].reshape(len(_TURNS), -1)
    fits = np.maximum(1 - (away / _TURN_GATE_M) ** 2, 0.0).sum(axis=1)
    return np.asarray(tried[int(np.argmax(fits))])
