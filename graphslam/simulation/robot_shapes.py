"""Robots as shapes, for ray casting and collision checks."""

import numpy as np

from graphslam.core.arrays import BoolArray
from graphslam.core.geometry import Array, rotation
from graphslam.simulation.raycast import points_in_frames
from graphslam.simulation.scenario import Body
from graphslam.simulation.world import Shapes


def corners(body: Body) -> Array:
    """Corners (4, 2) m of a rectangular body in its base frame, counter-clockwise."""
    back, front, half = -body.rear_m, body.length_m - body.rear_m, body.width_m / 2
    return np.array([[back, -half], [front, -half], [front, half], [back, half]])


def outline_shapes(body: Body, poses: Array) -> Shapes:
    """The body's outline at each of ``poses`` (n, 3), as shapes with a leading axis of n."""
    n = len(poses)
    if body.radius_m:
        circles = np.column_stack([poses[:, :2], np.full(n, body.radius_m)])
        return Shapes(np.zeros((n, 0, 2, 2)), circles[:, None])
    turn = np.stack([rotation(phi) for phi in poses[:, 2]])
    points = corners(body) @ turn.mT + poses[:, None, :2]
    return Shapes(np.stack([points, np.roll(points, -1, axis=1)], axis=2), np.zeros((n, 0, 3)))


def contacts(body: Body, poses: Array, shapes: Shapes) -> BoolArray:
    """Whether the body at poses (n, 3) overlaps each surface: (n, surfaces).

    A body inside a circle overlaps it; for a body inside a polygon see `encloses`.
    """
    a = points_in_frames(poses, shapes.segments[..., 0, :])
    b = points_in_frames(poses, shapes.segments[..., 1, :])
    centers = points_in_frames(poses, shapes.circles[..., :2])
    radii = np.broadcast_to(shapes.circles[..., 2], centers.shape[:2])
    if body.radius_m:
        straight = _distance(a, b) < body.radius_m
        round_ = np.hypot(centers[..., 0], centers[..., 1]) < body.radius_m + radii
    else:
        low, high = corners(body)[0], corners(body)[2]
        straight = _crosses_rectangle(a, b, low, high)
        outside = centers - np.clip(centers, low, high)
        round_ = np.hypot(outside[..., 0], outside[..., 1]) < radii
    return np.concatenate([straight, round_], axis=1)


def encloses(polygon: Array, points: Array) -> BoolArray:
    """Which of ``points`` (n, 2) lie inside a simple polygon (k, 2), by crossings of a ray."""
    a, b = polygon, np.roll(polygon, -1, axis=0)
    x, y = points[:, None, 0], points[:, None, 1]
    straddles = (a[:, 1] > y) != (b[:, 1] > y)
    rise = np.where(b[:, 1] == a[:, 1], 1.0, b[:, 1] - a[:, 1])
    crossing = a[:, 0] + (y - a[:, 1]) * (b[:, 0] - a[:, 0]) / rise
    return np.asarray(np.count_nonzero(straddles & (x < crossing), axis=1) % 2 == 1)


def _distance(a: Array, b: Array) -> Array:
    """Distances (n, k) m of the origin from segments a-b (n, k, 2)."""
    e = b - a
    length2 = np.maximum((e**2).sum(axis=-1), 1e-18)
    share = np.clip(-(a * e).sum(axis=-1) / length2, 0.0, 1.0)
    foot = a + share[..., None] * e
    return np.asarray(np.hypot(foot[..., 0], foot[..., 1]))


def _crosses_rectangle(a: Array, b: Array, low: Array, high: Array) -> BoolArray:
    """Which segments a-b (n, k, 2) intersect the rectangle ``low``-``high`` (2,), by clipping."""
    e = b - a
    flat = np.abs(e) < 1e-15
    safe = np.where(flat, 1.0, e)
    first, second = (low - a) / safe, (high - a) / safe
    between = (a > low) & (a < high)
    enter = np.where(flat, np.where(between, -np.inf, np.inf), np.minimum(first, second))
    leave = np.where(flat, np.where(between, np.inf, -np.inf), np.maximum(first, second))
    begin = np.maximum(enter.max(axis=-1), 0.0)
    end = np.minimum(leave.min(axis=-1), 1.0)
    return np.asarray(begin < end)
