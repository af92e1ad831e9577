"""A visit's path re-estimated from its own scans, where the smoothed path is bent.

A map may bend where few landmarks constrain it, as at a corner that was turned on odometry alone.
Two visits then bend differently, and no rigid motion registers them. Here each scan is matched to
the scans shortly before it, starting from the smoothed motion, which is doubted where it jumps.
From there `relax_scan_network` estimates all poses at once, so that the shape of the path is that
of the scans, however the smoothed path was bent. Two paths of which one lies on the other's map are
refined in the same way, together (`refine_together`): what one of them leaves open the other one
may tell.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from graphslam.change_detection.scan_network import Cloud, relax_scan_network
from graphslam.change_detection.visit import Bools, Visit
from graphslam.core.geometry import Array, between, compose, polar_points, rotation, transform, wrap
from graphslam.perception.point_to_line import (
    gauss_newton_step,
    line_metrics,
    normal_equations,
    point_terms,
    redescending,
    step_poses,
)

#: how many scans before a scan it is matched to, and of how many of them one is taken
_WINDOW, _EVERY = 30, 3
#: sigmas of the smoothed motion from scan to scan (m, m, rad), and their robust scale: a path that
#: a wrong match pulled away jumps by degrees between two keyframes
_STEP_SIGMAS, _DOUBTED = np.array([0.01, 0.01, 0.01]), 2.0
#: rad: headings that are tried where the smoothed motion may have jumped; m: how near to another
#: return one counts for a heading
_TURNS = np.radians(np.arange(-12.0, 12.5, 1.0))
_TURN_GATE_M = 0.1
#: m, one per iteration
_GATES_M = (0.2, 0.15, 0.1, 0.1)
#: m: sigma of a return's distance. Neighbouring returns share errors, so more than their noise
_SIGMA_M = 0.04
#: beams to each side that give the direction of a surface, the largest ratio of their variances
#: across and along it, and the fewest returns that are matched
_SIDE, _STRAIGHT, _FEWEST = 3, 0.1, 20


def refine_path(visit: Visit) -> Visit:
    """The visit with the poses at which its scans agree; its first pose is fixed."""
    cloud = _cloud(visit)
    bounds = np.searchsorted(cloud.scan, np.arange(len(visit.poses) + 1))
    scans = [(cloud.points[low:high], cloud.metrics[low:high]) for low, high in pairwise(bounds)]
    motion = between(visit.poses[:-1], visit.poses[1:])
    poses = visit.poses.copy()
    prior = np.diag(_STEP_SIGMAS**-2.0)
    for i in range(1, len(poses)):
        poses[i] = compose(poses[i - 1], motion[i - 1])
        before = range(max(0, i - _WINDOW), i)[::-_EVERY]
        map_points = np.concatenate([transform(poses[k], scans[k][0]) for k in before])
        turns = [rotation(poses[k, 2]) for k in before]
        map_metrics = np.concatenate(
            [R @ scans[k][1] @ R.T for k, R in zip(before, turns, strict=True)]
        )
        if len(map_points) >= _FEWEST and len(scans[i][0]) >= _FEWEST:
            poses[i] = _match(poses[i], prior, scans[i][0], map_points, map_metrics)
    (poses,) = relax_scan_network([poses], [cloud], [motion], _STEP_SIGMAS, _DOUBTED)
    return replace(visit, poses=poses)


def refine_together(visits: Sequence[Visit], shapes: Sequence[Array]) -> list[Visit]:
    """The visits with the poses at which the scans of all agree; the first pose of all is fixed.

    The visits lie on each other to a few decimetres. ``shapes`` (s, 3) are the poses of their paths
    in any frame, as only the motions between them count.
    """
    motions = [between(shape[:-1], shape[1:]) for shape in shapes]
    clouds, poses = [_cloud(visit) for visit in visits], [visit.poses for visit in visits]
    refined = relax_scan_network(poses, clouds, motions, _STEP_SIGMAS, _DOUBTED)
    return [replace(v, poses=own) for v, own in zip(visits, refined, strict=True)]


def _cloud(visit: Visit) -> Cloud:
    local = polar_points(visit.range_m, visit.angle)
    normals, straight = _normals(visit, local)
    metrics = np.where(straight[:, None, None], line_metrics(normals), np.eye(2))
    returned = np.isfinite(visit.range_m)
    return Cloud(visit.scan[returned], local[returned], metrics[returned])


def _normals(visit: Visit, local: Array) -> tuple[Array, Bools]:
    """Surface normals (n, 2) at all returns in the laser's frame, and where it is straight (n,)."""
    width = 2 * _SIDE + 1
    normals, straight = np.zeros_like(local), np.zeros(len(local), dtype=bool)
    if len(local) < width:
        return normals, straight
    windows = np.lib.stride_tricks.sliding_window_view(np.nan_to_num(local), width, axis=0)
    away = windows - windows.mean(axis=2, keepdims=True)
    values, vectors = np.linalg.eigh(away @ away.mT)
    normals[_SIDE:-_SIDE] = vectors[:, :, 0]
    whole = np.lib.stride_tricks.sliding_window_view(visit.surface, width).all(axis=1)
    one_scan = visit.scan[width - 1 :] == visit.scan[: len(visit.scan) - width + 1]
    straight[_SIDE:-_SIDE] = whole & one_scan & (values[:, 0] < _STRAIGHT * values[:, 1])
    return normals, straight


def _match(pose: Array, prior: Array, points: Array, target: Array, metrics: Array) -> Array:
    """The pose (3,) near ``pose`` at which ``points`` (k, 2) m lie on those of ``target`` (m, 2) m.

    ``metrics`` (m, 2, 2) belong to ``target``, see `Cloud`; ``prior`` (3, 3) is the information of
    ``pose``.
    """
    tree, expected = cKDTree(target), pose
    pose = _best_heading(tree, pose, points)
    for gate in _GATES_M:
        placed = transform(pose, points)
        away, near = tree.query(placed, distance_upper_bound=gate)
        used = np.isfinite(away)
        placed, near = placed[used], near[used]
        terms, squared = point_terms(placed - target[near], metrics[near], placed - pose[:2])
        A, g = normal_equations(terms @ (_SIGMA_M**-2.0 * redescending(squared, gate)))
        back = expected - pose
        back[2] = wrap(back[2])
        held = prior / (1 + back @ prior @ back / _DOUBTED**2)
        pose = step_poses(pose, gauss_newton_step(A + held, g - held @ back))
    return pose


def _best_heading(tree: cKDTree, pose: Array, points: Array) -> Array:
    """The pose (3,) turned by what brings most of ``points`` (k, 2) m onto those of the tree."""
    tried = np.tile(pose, (len(_TURNS), 1))
    tried[:, 2] += _TURNS
    placed = np.concatenate([transform(turned, points) for turned in tried])
    away = tree.query(placed, distance_upper_bound=_TURN_GATE_M)[0].reshape(len(_TURNS), -1)
    fits = np.maximum(1 - (away / _TURN_GATE_M) ** 2, 0.0).sum(axis=1)
    return np.asarray(tried[int(np.argmax(fits))])
