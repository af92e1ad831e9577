"""Which landmarks of a large map may be near what is seen.

Gates compare an image with every landmark they are given. With all of a map the cost of a log would
grow with the square of its length, so they get those alone whose box touches that of the image.
Looking through the boxes takes 2 ns a landmark.
"""

from collections.abc import Sequence

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import AssociationConfig
from graphslam.core.geometry import Array, compose
from graphslam.core.records import Observation
from graphslam.mapping.gating import MAX_ANGLE_RAD


class LandmarkIndex:
    """Boxes (m, 2) around landmarks: where they begin and where they end, m, world frame."""

    def __init__(self, means: Array, extents: Array) -> None:
        """Of landmarks at ``means`` (m, 3), with ``extents`` (m, 2) along their x axes, m."""
        ends = [compose(means, np.pad(e, ((0, 0), (0, 2)))) for e in np.split(extents, 2, axis=1)]
        corners = np.array([means, *ends])[..., :2]
        self._low, self._high = corners.min(axis=0), corners.max(axis=0)

    def touching(self, low: Array, high: Array) -> IntArray:
        """Indices (k,), ascending, of those that touch the box from ``low`` (2,) to ``high``."""
        touches = (self._low <= high) & (self._high >= low)
        return np.flatnonzero(touches[:, 0] & touches[:, 1])


def reach(seen: Sequence[Observation], pose: Array, config: AssociationConfig) -> Array:
    """Box (2, 2), from and to, m, outside which no landmark passes `gating.candidate_pairs`.

    A wall is compared where it overlaps with what was seen of it. There the two are as far apart as
    they are where the observation has its origin, and farther by what they differ in direction.

    Args:
        seen: n observations in the robot's base frame, n at least 1.
        pose: predicted pose (3,) of the robot, world frame.
        config: gates.
    """
    corners: list[Array] = []
    margin = config.max_distance_m
    for o in seen:
        if o.kind == "point":
            bearing, distance = o.z
            corners.append(distance * np.array([np.cos(bearing), np.sin(bearing)]))
            continue
        ends = np.zeros(2) if o.extent is None else o.extent
        along = np.array([np.cos(o.z[2]), np.sin(o.z[2])])
        corners += [o.z[:2], *(o.z[:2] + end * along for end in ends)]
        farthest = np.sin(MAX_ANGLE_RAD) * float(np.abs(ends).max())
        margin = max(margin, config.max_distance_m + farthest + config.overlap_gap_m)
    placed = np.zeros((len(corners), 3))
    placed[:, :2] = corners
    world = compose(pose, placed)[:, :2]
    return np.array([world.min(axis=0) - margin, world.max(axis=0) + margin])
