"""Sensor mounts in the plane from static transforms."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from graphslam.core import records
from graphslam.core.arrays import BoolArray
from graphslam.core.geometry import Array
from graphslam.core.record import replace

# Child -> (parent, parent_from_child (4, 4)): a frame has one parent.
TransformTree = Mapping[str, tuple[str, Array]]

# A tilt of 3 degrees changes ranges to vertical walls by 1 - cos(3 deg), about one per mille.
MAX_TILT_RAD = np.deg2rad(3.0)
# Beyond that few beams meet walls before the floor or the ceiling.
_MOST_TILT_RAD = np.deg2rad(30.0)
#: m above the base, below which a return of a tilted laser may be of the floor, not of a wall
_FLOOR_M = 0.05


@dataclass(frozen=True, slots=True)
class Mount:
    """Pose (3,) of a sensor in the base frame; ``inverted`` if it is mounted upside down.

    ``tilt_rad`` is the angle between the sensor's z axis and the vertical, 0 also if inverted.
    ``turn`` (3, 3) takes a vector in the sensor's frame into level axes with the heading of
    ``pose``; ``height_m`` is that of the sensor above the base.
    """

    pose: Array
    inverted: bool
    tilt_rad: float
    turn: Array = field(default_factory=lambda: np.eye(3))
    height_m: float = 0.0

    def levelled(self, points: Array) -> tuple[Array, BoolArray]:
        """Points (n, 3) of the sensor in level axes, and which of them (n,) are not of the floor.

        A wall is vertical: its points lie on it at any height.
        """
        level = points @ self.turn.T
        return level, np.asarray(level[:, 2] + self.height_m > _FLOOR_M)


def transforms_in(messages: Iterable[Any]) -> Iterator[tuple[str, str, Array]]:
    """Parent, child and matrix (4, 4), parent from child, of all transforms of TFMessages."""
    for message in messages:
        for stamped in message.transforms:
            parent, child = stamped.header.frame_id, stamped.child_frame_id
            matrix = _matrix(stamped.transform)
            if np.isfinite(matrix).all():
                yield parent.lstrip("/"), child.lstrip("/"), matrix


def find_mount(tree: TransformTree, base: str, sensor: str) -> Mount | None:
    """Mount of frame ``sensor`` on frame ``base``; None if the tree does not connect them.

    One may be the other's ancestor, or both may have a common one (base_footprint).
    """
    if base == sensor:
        return Mount(np.zeros(3), False, 0.0)
    found = transform_between(tree, base, sensor)
    return None if found is None else planar_mount(found)


def transform_between(tree: TransformTree, base: str, sensor: str) -> Array | None:
    """The transform (4, 4) base from sensor; None if the tree does not connect them."""
    of_base, of_sensor = _ancestors(tree, base), _ancestors(tree, sensor)
    common = next((frame for frame in of_sensor if frame in of_base), None)
    if common is None:
        return None
    return np.asarray(np.linalg.solve(of_base[common], of_sensor[common]))


def is_same(one: Mount, other: Mount) -> bool:
    """Whether two mounts are one, to rounding."""
    return bool(np.allclose(one.pose, other.pose) and np.allclose(one.turn, other.turn))


def axis_above(tree: TransformTree, base: str, sensor: str) -> Array:
    """The vertical (3,) of ``base`` in the axes of ``sensor``; z where ``tree`` ties them not."""
    of_base, of_sensor = _ancestors(tree, base), _ancestors(tree, sensor)
    common = next((frame for frame in of_sensor if frame in of_base), None)
    if common is None:
        return np.array([0.0, 0.0, 1.0])
    return np.asarray(np.linalg.solve(of_base[common], of_sensor[common])[2, :3])


def base_above(tree: TransformTree, sensor: str) -> str:
    """The frame that moves with the robot, where no odometry names it: the base of a sensor.

    By ROS' convention its name begins with "base", after a namespace; else it is the root.
    """
    frames = list(_ancestors(tree, sensor))
    return next((f for f in frames if f.rpartition("/")[2].startswith("base")), frames[-1])


def planar_mount(base_from_sensor: Array) -> Mount:
    """The planar part of a transform (4, 4); the heading is that of the sensor's x axis."""
    R = base_from_sensor[:3, :3]
    x, y = base_from_sensor[:2, 3]
    pose = np.array([x, y, np.arctan2(R[1, 0], R[0, 0])])
    inverted = bool(R[2, 2] < 0)
    tilt = float(np.arccos(min(1.0, abs(R[2, 2]))))
    c, s = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ R
    return Mount(pose, inverted, tilt, turn, float(base_from_sensor[2, 3]))


def is_level(mount: Mount) -> bool:
    """Whether the tilt of the sensor is small enough for a planar map."""
    return bool(mount.tilt_rad <= MAX_TILT_RAD)


def is_projectable(mount: Mount) -> bool:
    """Whether a sensor that is not level sees walls with most of its beams."""
    return bool(mount.tilt_rad <= _MOST_TILT_RAD)


def _ancestors(tree: TransformTree, frame: str) -> dict[str, Array]:
    """``frame`` and its ancestors, each with the transform (4, 4) ancestor from ``frame``."""
    found = {frame: np.eye(4)}
    while frame in tree:
        parent, parent_from_frame = tree[frame]
        if parent in found:  # a cycle, which tf forbids
            break
        found[parent] = parent_from_frame @ found[frame]
        frame = parent
    return found


def _matrix(transform: Any) -> Array:
    """The transform as a matrix (4, 4); NaN if its quaternion is zero or not finite."""
    t, q = transform.translation, transform.rotation
    norm = np.sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w)
    if not norm > 0:
        return np.full((4, 4), np.nan)
    x, y, z, w = q.x / norm, q.y / norm, q.z / norm, q.w / norm
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])  # times v: (x, y, z) x v
    matrix = np.eye(4)
    matrix[:3, :3] += 2 * (w * cross + cross @ cross)
    matrix[:3, 3] = [t.x, t.y, t.z]
    return matrix


def levelled(scan: records.Scan, mount: Mount) -> records.Scan:
    """What a tilted laser saw of vertical walls, as a level one sees them."""
    angles = scan.angles
    rays = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])
    level, _ = mount.levelled(rays)
    if not len(scan.ranges):
        return replace(scan, bearings=np.empty(0))  # only its time is of interest
    _, walls = mount.levelled(np.nan_to_num(scan.ranges)[:, None] * rays)
    bearings = np.unwrap(np.arctan2(level[:, 1], level[:, 0]))
    ranges = np.where(walls, scan.ranges, np.nan) * np.hypot(level[:, 0], level[:, 1])
    period = scan.beam_period_s
    if bearings[-1] < bearings[0]:  # from above, an upside-down laser scans clockwise
        bearings, ranges, period = bearings[::-1].copy(), ranges[::-1].copy(), -period
    step = float(bearings[-1] - bearings[0]) / max(len(bearings) - 1, 1) or scan.angle_step_rad
    return replace(
        scan, ranges=ranges, angle_min_rad=float(bearings[0]), angle_step_rad=step,
        beam_period_s=period, bearings=bearings,
    )  # fmt: skip
