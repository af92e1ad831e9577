"""Walls, and what a laser sees of them: beams crossed with line segments.

Walls are (w, 2, 2): the two end points of each, in m. Nothing here uses the simulator of the
package, so the two can disagree.
"""

import numpy as np

from graphslam.core.records import Scan

ORIGIN = (0.0, 0.0, 0.0)
#: beams once around, 1 degree apart
AROUND = np.radians(np.arange(-180.0, 180.0, 1.0))
#: an L-shaped room with an inner corner: it fixes a pose in all three directions
L_ROOM = np.array([
    [[-4, -3], [5, -3]], [[5, -3], [5, 2]], [[5, 2], [1, 2]], [[1, 2], [1, 4]], [[1, 4], [-4, 4]],
    [[-4, 4], [-4, -3]], [[-1, -1], [0, -1]], [[0, -1], [0, 0.5]],
], dtype=float)  # fmt: skip
#: only parallel walls, longer than the laser reaches
CORRIDOR = np.array([[[-60, -1], [60, -1]], [[60, 1], [-60, 1]]], dtype=float)


def rectangle(x0, y0, x1, y1):
    """The corners (5, 2) of an upright rectangle, the first one again at the end."""
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])


def rectangles(*bounds):
    """The walls (4n, 2, 2) of rectangles x0, y0, x1, y1."""
    outlines = [rectangle(*b) for b in bounds]
    return np.concatenate([np.stack([c[:-1], c[1:]], axis=1) for c in outlines])


def cast(walls, angles, pose=ORIGIN, limit=np.inf):
    """Ranges (n,) to the nearest wall along each beam from ``pose``; NaN where none is in reach."""
    a, b = np.moveaxis(np.asarray(walls, float) - np.asarray(pose, float)[:2], 1, 0)
    c, s = np.cos(pose[2] + angles)[:, None], np.sin(pose[2] + angles)[:, None]
    side_a, side_b = c * a[:, 1] - s * a[:, 0], c * b[:, 1] - s * b[:, 0]
    share = side_a / np.where(side_a == side_b, np.inf, side_a - side_b)
    hit = a + share[..., None] * (b - a)
    r = c * hit[..., 0] + s * hit[..., 1]
    r[(side_a * side_b > 0) | (side_a == side_b) | (r <= 0)] = np.inf
    r = r.min(axis=1)
    return np.where(r < limit, r, np.nan)


def make_scan(ranges, angle_min=-np.pi / 2, step=np.pi / 180, mount=ORIGIN):
    """A scan of robot r at time 0."""
    return Scan("r", 0, 0, np.asarray(ranges, float), angle_min, step, np.array(mount, float))


def scan_of(walls, step_deg=0.5, sigma=0.0, seed=0):
    """The scan (180 degrees) of walls from the origin, with range noise of ``sigma`` m."""
    n = int(180 / step_deg) + 1
    step = np.radians(step_deg)
    ranges = cast(walls, -np.pi / 2 + step * np.arange(n))
    return make_scan(ranges + sigma * np.random.default_rng(seed).normal(size=n), step=step)


def cloud(pose, walls, rng=None, limit=20.0):
    """Points (n, 2) of a scan once around, in its own frame; with ``rng``, 1 cm of noise."""
    r = cast(walls, AROUND, pose)
    if rng is not None:
        r = r + rng.normal(0.0, 0.01, len(r))
    seen = r < limit
    return r[seen, None] * np.column_stack([np.cos(AROUND[seen]), np.sin(AROUND[seen])])
