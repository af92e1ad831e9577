"""Scan matching: where a place was seen from, among points that were seen before.

A `Submap` holds what some neighbouring scans saw: points, the direction of the surface at each of
them, and every scan as a range image, which also knows what is *not* there. Two submaps are matched
in three steps: `search` tries a whole window of poses against a coarse field, `align` refines one
by point-to-line steps, and `agreement` counts which points of one the scans of the other confirm
and which they look through.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from graphslam.core.geometry import Array, between, transform
from graphslam.perception.correlation import occupancy_grid
from graphslam.perception.point_to_line import (
    gauss_newton_step,
    normal_equations,
    point_terms,
    step_poses,
)

BoolArray = np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
IntArray = np.ndarray[tuple[int, ...], np.dtype[np.intp]]

#: m: points of a submap are thinned to one per cell of this size
CELL_M = 0.05
#: neighbours that tell the direction of a surface, and how far away they may be, m
NEIGHBOURS, FEWEST_NEIGHBOURS, NEIGHBOURHOOD_M = 8, 4, 0.3
#: beams of a range image over the full circle
BEAMS = 360
#: m: how far a point may lie from what a beam met to be the same, and before it to be absent
SAME_M, ABSENT_M = 0.15, 0.4
#: m: noise of one point across its surface, and of a point that lies on no surface
SURFACE_SIGMA_M, CLUTTER_SIGMA_M = 0.03, 0.06
#: points whose errors count as one: materials, curvature and the submap's own shape are shared
SHARED_POINTS = 10
#: m, rad: errors of the matching as a whole that no number of points averages out
FLOOR_M, FLOOR_RAD = 0.02, 0.004
#: m: a point and its nearest neighbour farther apart than this do not belong together: first, last
REACH_FIRST_M, REACH_LAST_M = 0.6, 0.15
ITERATIONS = 12
#: m, rad: steps of the search
STEP_M, STEP_RAD = 0.15, np.radians(1.5)
#: points of a submap that the search looks at, and that the alignment uses
SEARCHED, ALIGNED = 250, 300
#: places that a search finds at most, and how much of the best one's score they have at least
FOUND, NEARLY = 4, 0.6


@dataclass(frozen=True, eq=False)
class Submap:
    """What neighbouring scans saw, in one frame.

    ``points`` (n, 2) m; ``information`` (n, 2, 2), 1/m^2, of what each tells about where another
    one near it lies: across a surface, both ways where there is none, and nothing where there are
    too few neighbours to tell (where a wall leaves the laser's reach); ``poses`` (k, 3) of the
    sensor and ``clouds``, k arrays (n, 2) of what it saw from there.
    """

    points: Array
    information: Array
    poses: Array
    clouds: Sequence[Array]
    tree: cKDTree

    # worked out when asked for: few single scans are ever compared with another one beam by beam
    @cached_property
    def images(self) -> Array:
        """(6, k, `BEAMS`), m: nearest and farthest return of each degree and both its neighbours.

        NaN without one.
        """
        returns = _range_images(self.clouds)
        return np.concatenate([np.roll(returns, turn, axis=2) for turn in (-1, 0, 1)])

    @cached_property
    def free(self) -> Array:
        """(k, `BEAMS`) m: the nearest of the six ``images``, 0 where one of them is not known."""
        return np.asarray(np.nan_to_num(self.images.min(axis=0)))


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """Pose (3,) of one submap in the frame of another, cov (3, 3) along that frame's axes.

    ``same`` and ``absent`` are shares of all points of both: confirmed by the other's scans, and
    looked through by them; the rest was out of sight.
    """

    pose: Array
    cov: Array
    same: float
    absent: float


def make_submap(poses: Array, clouds: Sequence[Array]) -> Submap:
    """A submap of some scans.

    Args:
        poses: (k, 3) of the sensor in the submap's frame.
        clouds: k arrays (n, 2) of points in the sensor's frame, m.
    """
    points = np.concatenate([transform(p, c) for p, c in zip(poses, clouds, strict=True)])
    cell = np.round(points / CELL_M).astype(np.int64)
    _, kept = np.unique((cell[:, 0] << 32) + cell[:, 1], return_index=True)
    points = points[np.sort(kept)]
    tree = cKDTree(points)
    return Submap(points, _information(points, tree), np.asarray(poses), clouds, tree)


def _range_images(clouds: Sequence[Array]) -> Array:
    """Nearest and farthest return (2, k, `BEAMS`) per degree of k scans, NaN without one."""
    x, y = np.concatenate(clouds).T
    scan = np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
    r, at = np.hypot(x, y), scan * BEAMS + _beam(x, y)
    images = np.full((2, len(clouds) * BEAMS), np.inf)
    np.minimum.at(images[0], at, r)
    np.minimum.at(images[1], at, -r)
    images[1] *= -1.0
    images[~np.isfinite(images)] = np.nan
    return images.reshape(2, len(clouds), BEAMS)


def _beam(x: Array, y: Array) -> IntArray:
    degrees = np.arctan2(y, x) * (BEAMS / (2 * np.pi))
    return np.asarray(np.round(degrees).astype(np.intp) % BEAMS)


def _information(points: Array, tree: cKDTree) -> Array:
    """What points (n, 2) tell, (n, 2, 2), see `Submap`: by the scatter of their neighbours."""
    k = min(NEIGHBOURS, len(points))
    distance, near = tree.query(points, k=k)
    known = distance.reshape(len(points), k) <= NEIGHBOURHOOD_M
    around = points[near.reshape(len(points), k)]
    count = known.sum(axis=1)
    mean = (around * known[..., None]).sum(axis=1) / count[:, None]
    d = (around - mean[:, None]) * known[..., None]
    xx, yy = (d[..., 0] ** 2).sum(axis=1), (d[..., 1] ** 2).sum(axis=1)
    xy = (d[..., 0] * d[..., 1]).sum(axis=1)
    along = 0.5 * np.arctan2(2 * xy, xx - yy)
    spread = np.sqrt(0.25 * (xx - yy) ** 2 + xy**2)
    small, large = 0.5 * (xx + yy) - spread, 0.5 * (xx + yy) + spread
    alone = count < FEWEST_NEIGHBOURS
    normals = np.column_stack([-np.sin(along), np.cos(along)])
    found = normals[:, :, None] * normals[:, None, :] / SURFACE_SIGMA_M**2
    found[small >= 0.1 * large] = np.eye(2) / CLUTTER_SIGMA_M**2
    found[alone] = 0.0
    return np.asarray(found)


def search(
    source: Submap, target: Submap, guess: Array, window: Array, least: float = 0.0
) -> list[Array]:
    """Poses (3,) of ``source`` in ``target`` at which many of its points lie on the other's.

    Args:
        source: what to place.
        target: where.
        guess: (3,) middle of the window.
        window: (3,) m, m, rad: half its size.
        least: share of its points that are to do so; those in the next cell count half.

    Returns:
        The best ones, best first, no two of them close together.
    """
    points = _some(source.points, SEARCHED)
    sizes = STEP_M, STEP_M, STEP_RAD
    x, y, turns = (_steps(half, size) for half, size in zip(window, sizes, strict=True))
    shape = len(x), len(y)
    grid = occupancy_grid(target.points, STEP_M, np.array(shape) + 2)
    scores = np.empty((len(turns), len(x), len(y)))
    for row, turn in enumerate(turns):
        placed = transform(np.array([guess[0] + x[0], guess[1] + y[0], guess[2] + turn]), points)
        scores[row] = grid.correlate_window(placed, shape)
    found: list[Array] = []
    least = max(NEARLY * float(scores.max()), least)
    while len(found) < FOUND and scores.max() > least:
        k, i, j = map(int, np.unravel_index(int(scores.argmax()), scores.shape))
        found.append(guess + np.array([x[i], y[j], turns[k]]))
        near = np.hypot(x - x[i], (y - y[j])[:, None]).T < 0.6
        scores[(np.abs(turns - turns[k]) < np.radians(8.0))[:, None, None] & near] = 0.0
    return found


def _some(points: Array, count: int) -> Array:
    return points[:: max(1, len(points) // count)]


def _steps(half: float, step: float) -> Array:
    n = int(np.ceil(half / step))
    return np.asarray(np.arange(-n, n + 1) * step, dtype=float)


def align(source: Submap, target: Submap, guess: Array) -> tuple[Array, Array]:
    """The pose (3,) of ``source`` in ``target`` near ``guess`` (3,), and its covariance (3, 3).

    Each point is drawn to its nearest neighbour: across a surface, or both ways where there is
    none; what lies too far away has no say, and what that means shrinks on the way. Along what the
    points do not tell (a corridor) the covariance is large. Source: A. Censi, ICRA 2008, DOI
    10.1109/ROBOT.2008.4543181, for the metric.
    """
    x = np.array(guess, dtype=float)
    points = _some(source.points, ALIGNED)
    A = np.eye(3)
    for k in range(ITERATIONS):
        reach = REACH_FIRST_M * (REACH_LAST_M / REACH_FIRST_M) ** min(1.0, 2 * k / ITERATIONS)
        drawn = _drawn(points, target, x, reach)
        if drawn is None:
            return x, np.diag([1e4, 1e4, 1e4])
        A = drawn.information
        x = step_poses(x, drawn.step)
        if k > ITERATIONS // 2 and np.abs(drawn.step).max() < 1e-4:
            break
    return x, _covariance(A)


def fit(source: Submap, target: Submap, pose: Array) -> tuple[float, Array, Array]:
    """How well ``source`` lies on ``target`` at ``pose`` (3,), without moving it.

    Returns:
        Share of its points that lie on something (a point that is 2 sigmas off counts half); by how
        much the pose would move (3,) to first order; and the covariance (3, 3) of that, see
        `align`.
    """
    points = _some(source.points, ALIGNED)
    drawn = _drawn(points, target, pose, REACH_LAST_M)
    if drawn is None:
        return 0.0, np.zeros(3), np.diag([1e4, 1e4, 1e4])
    return drawn.weight / len(points), drawn.step, _covariance(drawn.information)


@dataclass(frozen=True, slots=True, eq=False)
class _Drawn:
    """One step of Gauss and Newton; ``weight`` is the sum over points of their robust weights."""

    step: Array
    information: Array
    weight: float


def _drawn(points: Array, target: Submap, x: Array, reach: float) -> _Drawn | None:
    """Points (n, 2), seen from x (3,), drawn to what is within ``reach``; None where hardly any."""
    placed = transform(x, points)
    distance, near = target.tree.query(placed, distance_upper_bound=reach)
    ok = np.isfinite(distance)
    if ok.sum() < 10:
        return None
    near, p = near[ok], placed[ok]
    terms, squared = point_terms(p - target.points[near], target.information[near], p - x[:2])
    w = 1.0 / (1.0 + squared / 4.0)
    A, g = normal_equations(terms @ w)
    A += np.diag([1e-4, 1e-4, 1e-4])
    return _Drawn(gauss_newton_step(A, g), A, float(w.sum()))


def _covariance(information: Array) -> Array:
    shared = SHARED_POINTS * np.linalg.inv(information)
    return np.asarray(shared + np.diag([FLOOR_M**2, FLOOR_M**2, FLOOR_RAD**2]))


def agreement(source: Submap, target: Submap, pose: Array) -> tuple[float, float]:
    """Shares of all points of both submaps that the other's scans confirm, and look through.

    ``pose`` (3,) is that of ``source`` in ``target``. A confirmed point counts as such whatever
    other scans saw: a door that was open once is no contradiction.
    """
    same = absent = 0
    for a, b, x in (
        (source, target, pose),
        (target, source, between(pose, np.zeros(3))),
    ):
        confirmed, missed = _seen_from(transform(x, a.points), b)
        same += int(confirmed.sum())
        absent += int((missed & ~confirmed).sum())
    total = len(source.points) + len(target.points)
    return same / total, absent / total


def _seen_from(points: Array, submap: Submap) -> tuple[BoolArray, BoolArray]:
    """Which points (n, 2) any scan of the submap confirms, and which any looks through."""
    poses = submap.poses
    c, s = np.cos(poses[:, 2])[:, None], np.sin(poses[:, 2])[:, None]
    dx, dy = points[:, 0] - poses[:, :1], points[:, 1] - poses[:, 1:2]
    # not hypot: it takes as long as all of the rest
    r = np.sqrt(dx * dx + dy * dy)
    at = _beam(c * dx + s * dy, c * dy - s * dx) + BEAMS * np.arange(len(poses))[:, None]
    near = np.zeros(r.shape, dtype=np.bool_)
    with np.errstate(invalid="ignore"):
        for image in submap.images:  # one by one they stay in the cache
            near |= np.abs(image.ravel()[at] - r) < SAME_M
        through = r < submap.free.ravel()[at] - ABSENT_M
    return np.asarray(near.any(axis=0)), np.asarray(through.any(axis=0))


def match(
    source: Submap, target: Submap, guess: Array, window: Array, least: float = 0.0
) -> list[Match]:
    """All places of ``source`` in ``target`` within a window, the most agreeing first.

    ``guess`` (3,) is the middle of the window, ``window`` (3,) half its size, m, m, rad; for
    ``least`` see `search`.
    """
    found: list[Match] = []
    for start in search(source, target, guess, window, least):
        pose, cov = align(source, target, start)
        if any(_close(pose, m.pose) for m in found):
            continue
        found.append(Match(pose, cov, *agreement(source, target, pose)))
    return sorted(found, key=lambda m: m.absent - m.same)


def _close(a: Array, b: Array) -> bool:
    d = between(a, b)
    return bool(np.hypot(d[0], d[1]) < 0.4 and abs(d[2]) < np.radians(6.0))
