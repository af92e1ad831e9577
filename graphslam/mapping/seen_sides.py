"""From which side the walls of an earlier map were seen: by the scans of its places.

Its landmarks do not tell: the paths from which they were seen are marginalised out. Its places do,
as each has the returns of some scans, and where the laser was.
"""

from collections.abc import Sequence

import numpy as np

from graphslam.core.geometry import Array, compose, transform
from graphslam.mapping.returns_on_walls import WallTree
from graphslam.mapping.submaps import SubmapPose

#: m: returns that are nearer to a wall are of it: half of a partition, whose other face is another
NEAR_M = 0.05


def seen_sides(walls: Array, length: Array, places: Sequence[SubmapPose]) -> Array:
    """The side (n,) from which most returns on each wall were seen.

    Args:
        walls: (n, 3), middles and directions, m, m, rad, in the world.
        length: (n,) m.
        places: with the scans that saw them, in the same world.

    Returns:
        1: from where the wall's normal points, to the left of its direction; -1: from behind;
        0: not known, as no place has a return on it.
    """
    votes = np.zeros(len(walls))
    if not len(walls):
        return votes
    tree = WallTree.from_walls(walls, 0.5 * length[:, None] * np.array([-1.0, 1.0]))
    for place in places:
        lasers, clouds = compose(place.pose, place.submap.poses), place.submap.clouds
        of_scan = np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
        points = np.concatenate([transform(*scan) for scan in zip(lasers, clouds, strict=True)])
        row, wall = tree.near(points)
        along, across = _in_frames(walls[wall], points[row])
        on = (np.abs(across) < NEAR_M) & (np.abs(along) < 0.5 * length[wall])
        _, side = _in_frames(walls[wall[on]], lasers[of_scan[row[on]], :2])
        votes += np.bincount(wall[on], np.sign(side), len(walls))
    return np.sign(votes)


def _in_frames(walls: Array, points: Array) -> tuple[Array, Array]:
    """How far points (n, 2) are along and across the walls (n, 3), each its own; (n,), (n,) m."""
    c, s = np.cos(walls[:, 2]), np.sin(walls[:, 2])
    dx, dy = (points - walls[:, :2]).T
    return c * dx + s * dy, c * dy - s * dx
