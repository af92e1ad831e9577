"""Matches that leave the direction of a corridor open, and what that direction is.

Along a corridor one submap lies on another as well here as some metres on. Such a match says where
the walls are, not where along them the robot is: its covariance is large in their direction. What
is metres off along a direction that is wrong by hundredths lies decimetres aside, so the direction
is that of the walls themselves. How matches lie behind one another, and which direction the points
determine least, only says which walls.
"""

from collections.abc import Sequence

import numpy as np

from graphslam.core.geometry import Array, wrap
from graphslam.perception.scan_matching import Match, Submap

#: m, rad: matches that differ less, across and in heading, differ along a corridor only
SAME_ACROSS = (0.1, 0.02)
#: m: sigma of a match along an open direction. Where it lies there is no news: several such matches
#: of a path that drifted together must not pull it
UNKNOWN_ALONG_M = 50.0
#: rad: walls that far from a direction may be those of its corridor; m: sigma across that their
#: direction, known to 3 mrad, adds: a match is searched for at most 5 m off
NEAR_RAD, ASIDE_M = 0.2, 0.015
#: points that show the direction of walls, at least
LEAST_POINTS = 30
#: rad: turns of the median that are looked at; m: width of half a line that points are in
TURNS_RAD, LINE_M = np.arange(-20, 21) * 1e-3, 0.02


def common_direction(best: Match, rivals: Sequence[Match]) -> Array | None:
    """Unit vector (2,) along which all rivals differ from the best match; None if they do not."""
    off = np.array([m.pose for m in rivals]) - best.pose
    turned = np.abs(wrap(off[:, 2]))
    _, axes = np.linalg.eigh(off[:, :2].T @ off[:, :2])
    along = axes[:, 1]
    beside = np.abs(off[:, :2] @ axes[:, 0])
    is_line = beside.max() <= SAME_ACROSS[0] and turned.max() <= SAME_ACROSS[1]
    return along if is_line else None


def wall_direction(submap: Submap, near: Array) -> Array:
    """Unit vector (2,) along the walls of a submap whose direction is nearly ``near`` (2,).

    It begins with the median of the directions of the surfaces around the points, and is turned
    until most points are in line. Where few points show such a surface it is ``near`` itself.
    """
    xx, yy, xy = (submap.information[:, i, j] for i, j in ((0, 0), (1, 1), (0, 1)))
    is_wall = (xx + yy > 0) & (xx * yy - xy**2 < 1e-6 * (xx + yy) ** 2)
    normal = 0.5 * np.arctan2(2 * xy, xx - yy)
    turn = np.mod(normal - np.arctan2(near[1], near[0]), np.pi) - np.pi / 2
    turn = turn[is_wall & (np.abs(turn) <= NEAR_RAD)]
    if len(turn) < LEAST_POINTS:
        return near
    heading = np.arctan2(near[1], near[0]) + np.median(turn) + TURNS_RAD
    in_line = _points_in_line(submap.points, heading)
    best = int(np.argmax(in_line[1:-1])) + 1
    before, there, after = in_line[best - 1 : best + 2]
    bend = before - 2 * there + after
    part = 0.5 * (before - after) / bend if bend < 0 else 0.0
    c, s = (f(heading[best] + part * (heading[1] - heading[0])) for f in (np.cos, np.sin))
    return np.array([c, s])


def _points_in_line(points: Array, heading: Array) -> Array:
    """How much points (n, 2) are in line along headings (m,): (m,), of pairs in one line."""
    across = points @ np.array([-np.sin(heading), np.cos(heading)])
    line = np.floor((across - across.min()) / LINE_M).astype(np.int64)
    size = (len(heading), line.max() + 2)
    of = np.arange(len(heading)) * size[1]
    count = np.bincount((line + of).ravel(), minlength=size[0] * size[1]).reshape(size)
    # of two neighbours: lines do not lie in the middles of cells
    return np.asarray(((count[:, 1:] + count[:, :-1]) ** 2).sum(axis=1), dtype=float)


def open_along(cov: Array, along: Array) -> Array:
    """The covariance (3, 3) of a match that knows nothing along a direction (2,) of walls."""
    c, s = along
    turn = np.array([[c, -s], [s, c]])
    opened = cov.copy()
    opened[:2, :2] += turn @ np.diag([UNKNOWN_ALONG_M, ASIDE_M]) ** 2 @ turn.T
    return opened
