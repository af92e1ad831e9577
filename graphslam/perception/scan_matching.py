"""Scan matching: the pose of one submap in the frame of another.

A `Submap` holds what some neighbouring scans saw: points, the direction of the surface at each of
them, and every scan as a range image, which also tells what space was free. Two submaps are matched
in three steps: `search` correlates the points with an occupancy grid over a window of poses,
`align` refines a pose by point-to-line steps, and `agreement` counts which points of one submap
the scans of the other confirm, and which lie in what those saw as free space.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.config import ScanMatchingConfig
from graphslam.core.geometry import Array, between, rotation3, transform
from graphslam.perception.correlation import occupancy_grid
from graphslam.perception.nearest_points import NearestPoints, nearest_of_each
from graphslam.perception.point_to_line import (
    gauss_newton_step,
    line_metrics,
    normal_equations,
    point_terms,
    step_poses,
)

#: neighbours that give the direction of a surface: most, fewest, and their distance at most, cells
NEIGHBOURS, FEWEST_NEIGHBOURS, NEIGHBOURHOOD_CELLS = 8, 4, 6
#: beams of a range image over the full circle: a degree each, for coarser lasers leave few empty
BEAMS = 360
#: sigmas of a point: noise of one that lies on no surface; within so many of a range, and of a
#: neighbour in the last iterations, a point is the same
CLUTTER_SIGMAS, SAME_SIGMAS = 2.0, 5.0
#: points whose errors count as one: materials, curvature and the submap's own shape are shared
CORRELATED_POINTS = 10
ITERATIONS = 12
#: m: where no point is
FAR_M = 1e6
#: m, rad: an alignment has converged when nothing moves more than this
CONVERGED = 1e-4
#: cell of the grid of nearest points, as a share of that to which points are thinned
NEAREST_CELL = 1.0
#: points that must have a neighbour, at least; information (1/m², 1/rad²) added to that of a pose,
#: so that it can be inverted
MIN_NEIGHBOURS, REGULAR = 10, 1e-4
#: variance (m², rad²) of each component of a pose without neighbours
UNKNOWN_VAR = 1e4
#: steps of the search: cells are this share of the reach of the alignment, which does the rest, and
#: a step in heading (rad) moves points at 6 m by one cell
SEARCH_CELL, STEP_RAD = 0.25, np.radians(1.5)
#: points of a submap that the search uses, and that the alignment uses
SEARCH_POINTS, ALIGN_POINTS = 250, 300
#: poses that a search returns at most, their score at least as a share of the best one's, and rad:
#: nearer ones (in position: than the reach of the alignment) are one
MAX_POSES, MIN_SCORE_SHARE, DISTINCT_RAD = 4, 0.6, np.radians(8.0)
#: share of points on others below which an aligned pose is out of question, of the best one's: of
#: 3400 in Intel, ACES and a building, none below 0.69 agreed the most, or nearly as much
MIN_SHARE = 0.6
#: aligned poses are one if they are nearer than this share of the reach, and than this in heading
DUPLICATE_SHARE, DUPLICATE_RAD = 2 / 3, np.radians(6.0)


@dataclass(frozen=True, eq=False)
class ScanGroup:
    """What neighbouring scans saw, in one frame.

    ``points`` (n, 2) m; ``poses`` (k, 3) of the sensor and ``clouds``, k arrays (n, 2) of the
    points in its frame.
    """

    points: Array
    poses: Array
    clouds: Sequence[Array]
    config: ScanMatchingConfig

    # computed on demand: few single scans are ever compared with another one beam by beam
    @cached_property
    def images(self) -> Array:
        """(6, k, `BEAMS`), m: nearest and farthest return of each degree and both its neighbours.

        NaN without a return.
        """
        x, y = np.concatenate(self.clouds).T
        scan = np.repeat(np.arange(len(self.clouds)), [len(cloud) for cloud in self.clouds])
        r, at = np.hypot(x, y), scan * BEAMS + beam_of(x, y)
        returns = np.full((2, len(self.clouds) * BEAMS), np.inf)
        np.minimum.at(returns[0], at, r)
        np.minimum.at(returns[1], at, -r)
        returns[1] *= -1.0
        returns[~np.isfinite(returns)] = np.nan
        per_scan = returns.reshape(2, len(self.clouds), BEAMS).astype(np.float32)
        return np.concatenate([np.roll(per_scan, turn, axis=2) for turn in (-1, 0, 1)])

    @cached_property
    def free(self) -> Array:
        """(k, `BEAMS`) m: range up to which space was free, 0 where a return is missing.

        It ends ``free_margin_m`` before the nearest of the six ``images``.
        """
        return np.asarray(np.nan_to_num(self.images.min(axis=0))) - self.config.free_margin_m


@dataclass(frozen=True, eq=False)
class Submap(ScanGroup):
    """A group of scans that others can be laid on.

    ``information`` (n, 2, 2), 1/m^2, of each point about another one near it: across a surface, in
    both directions where there is none, and zero where there are too few neighbours to tell (where
    a wall leaves the laser's range).
    """

    information: Array
    tree: cKDTree

    @cached_property
    def nearest(self) -> NearestPoints:
        """The nearest point of each place."""
        return NearestPoints.of(self.points, NEAREST_CELL * self.config.cell_m, self.config.reach_m)


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """Pose (3,) of one submap in the frame of another, cov (3, 3) along that frame's axes.

    ``same`` and ``absent`` are shares of all points of both: confirmed by the other's scans, and in
    what those saw as free space; the rest was out of sight.
    """

    pose: Array
    cov: Array
    same: float
    absent: float


def make_submap(
    poses: Array, clouds: Sequence[Array], config: ScanMatchingConfig | None = None
) -> Submap:
    """A submap of k scans at ``poses`` (k, 3): of the sensor, in the submap's frame.

    ``clouds`` are k arrays (n, 2) of points in the sensor's frame, m.
    """
    group = make_group(poses, clouds, config or ScanMatchingConfig())
    tree = cKDTree(group.points)
    information = _information(group.points, tree, group.config)
    return Submap(group.points, group.poses, clouds, group.config, information, tree)


def make_group(poses: Array, clouds: Sequence[Array], config: ScanMatchingConfig) -> ScanGroup:
    """As `make_submap`: points (n, 2) m alone, in a tenth of the time."""
    points = np.concatenate([transform(p, c) for p, c in zip(poses, clouds, strict=True)])
    cell = np.round(points / config.cell_m).astype(np.int64)
    _, kept = np.unique((cell[:, 0] << 32) + cell[:, 1], return_index=True)
    return ScanGroup(points[np.sort(kept)], np.asarray(poses), clouds, config)


def beam_of(x: Array, y: Array) -> IntArray:
    """Degree of a range image, 0 to `BEAMS` - 1, in which points (...), m, of its sensor lie."""
    degrees = np.arctan2(y, x) * (BEAMS / (2 * np.pi))
    return np.asarray(np.round(degrees).astype(np.intp) % BEAMS)


def _information(points: Array, tree: cKDTree, config: ScanMatchingConfig) -> Array:
    """Information (n, 2, 2) of points (n, 2), see `Submap`, by the scatter of their neighbours."""
    k = min(NEIGHBOURS, len(points))
    distance, near = tree.query(points, k=k)
    distance, near = (of.reshape(len(points), k).T for of in (distance, near))
    used = distance <= NEIGHBOURHOOD_CELLS * config.cell_m  # (k, n)
    count = used.sum(axis=0)
    x, y = (of[near] for of in points.T)
    x, y = ((of - (of * used).sum(axis=0) / count) * used for of in (x, y))
    xx, yy, xy = ((a * b).sum(axis=0) for a, b in ((x, x), (y, y), (x, y)))
    return information_from_scatter(count, xx, xy, yy, config)


def information_from_scatter(
    count: Array, xx: Array, xy: Array, yy: Array, config: ScanMatchingConfig,
    fewest: int = FEWEST_NEIGHBOURS,
) -> Array:  # fmt: skip
    """Information (n, 2, 2) of points, see `Submap`, by the scatter of their neighbours.

    ``count`` (n,) of neighbours, the point included; ``xx``, ``xy``, ``yy`` (n,) of their second
    central moments, all of a point times the same factor. Fewer than ``fewest`` tell nothing.
    """
    along = 0.5 * np.arctan2(2 * xy, xx - yy)
    spread = np.sqrt(0.25 * (xx - yy) ** 2 + xy**2)
    small, large = 0.5 * (xx + yy) - spread, 0.5 * (xx + yy) + spread
    variance = config.point_sigma_m**2
    found = line_metrics(np.column_stack([-np.sin(along), np.cos(along)])) / variance
    found[small >= 0.1 * large] = np.eye(2) / (CLUTTER_SIGMAS**2 * variance)
    found[count < fewest] = 0.0
    return np.asarray(found)


def search(
    source: Submap, target: Submap, guess: Array, window: Array, min_score: float = 0.0
) -> list[Array]:
    """Poses (3,) of ``source`` in ``target`` at which many points of one lie on the other's.

    They are within ``window`` (3,) m, m, rad of ``guess`` (3,), the best first, and no two of them
    are close together. ``min_score`` is the least share of points on points; those in a
    neighbouring cell count half.
    """
    points = _subsample(source.points, SEARCH_POINTS)
    cell_m, apart_m = SEARCH_CELL * target.config.reach_m, target.config.reach_m
    sizes = cell_m, cell_m, STEP_RAD
    x, y, turns = (_steps(half, size) for half, size in zip(window, sizes, strict=True))
    shape = len(x), len(y)
    grid = occupancy_grid(target.points, cell_m, np.array(shape) + 2)
    turned = points @ rotation3(guess[2] + turns)[:, :2, :2].mT
    scores = grid.correlate_window(turned + guess[:2] + np.array([x[0], y[0]]), shape)
    found: list[Array] = []
    min_score = max(MIN_SCORE_SHARE * float(scores.max()), min_score)
    while len(found) < MAX_POSES and scores.max() > min_score:
        k, i, j = map(int, np.unravel_index(int(scores.argmax()), scores.shape))
        found.append(guess + np.array([x[i], y[j], turns[k]]))
        near = apart_m > np.hypot(x - x[i], (y - y[j])[:, None]).T
        scores[(np.abs(turns - turns[k]) < DISTINCT_RAD)[:, None, None] & near] = 0.0
    return found


def _subsample(points: Array, count: int) -> Array:
    return points[:: max(1, len(points) // count)]


def _steps(half: float, step: float) -> Array:
    n = int(np.ceil(half / step))
    return np.asarray(np.arange(-n, n + 1) * step, dtype=float)


def align(source: Submap, target: Submap, guess: Array) -> tuple[Array, Array]:
    """The pose (3,) of ``source`` in ``target`` near ``guess`` (3,), and its covariance (3, 3).

    See `align_pairs`.
    """
    poses, covs, _ = align_pairs([source], [target], [guess])
    return poses[0], covs[0]


def align_pairs(
    sources: Sequence[Submap], targets: Sequence[Submap], guesses: Sequence[Array]
) -> tuple[Array, Array, Array]:
    """Where n submaps lie in others near ``guesses`` (3,).

    Iterated least squares: each point is matched to its nearest neighbour, across a surface or in
    both directions where there is none. Points farther away than a reach that shrinks from
    iteration to iteration do not count. In directions that the points do not determine (along a
    corridor) the covariance is large. A pair's result does not depend on the other pairs.

    Returns:
        Poses (n, 3), their covs (n, 3, 3), and the shares (n,) of points on others, see `fits`.
    """
    x = np.array(guesses, dtype=float).reshape(-1, 3)
    information, weight = np.zeros((len(x), 3, 3)), np.zeros(len(x))
    if not len(x):
        return x, information, weight
    config = targets[0].config
    pairs = _PointPairs(sources, targets)
    count, left = pairs.count, np.arange(len(x))
    first, last = config.reach_m, SAME_SIGMAS * config.point_sigma_m
    for k in range(ITERATIONS):
        reach = first * (last / first) ** min(1.0, 2 * k / ITERATIONS)
        information[left], g, weight[left] = pairs.linearise(x[left], reach)
        step = gauss_newton_step(information[left], g)
        x[left] = step_poses(x[left], step)
        goes_on = weight[left] > 0
        if k > ITERATIONS // 2:
            goes_on &= np.abs(step).max(axis=1) >= CONVERGED
        if not goes_on.any():
            break
        if not goes_on.all():
            pairs, left = pairs.only(goes_on), left[goes_on]
    return x, _covariance(information, config), weight / count


def fits(
    sources: Sequence[Submap], targets: Sequence[Submap], poses: Sequence[Array]
) -> tuple[Array, Array, Array]:
    """How well n submaps lie on others at ``poses`` (3,), without moving them.

    Returns:
        Shares (n,) of their points that lie on others (a point that is 2 sigmas off counts half);
        the first Gauss-Newton steps (n, 3) of the poses; and the covariances (n, 3, 3) of the poses
        after them, see `align_pairs`.
    """
    if not len(poses):
        return np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3))
    pairs, config = _PointPairs(sources, targets), targets[0].config
    A, g, weight = pairs.linearise(np.array(poses), SAME_SIGMAS * config.point_sigma_m)
    return weight / pairs.count, gauss_newton_step(A, g), _covariance(A, config)


def shares_on_others(sources: Sequence[Submap], targets: Sequence[Submap], poses: Array) -> Array:
    """Shares (n,) of the points of n submaps that lie on those of others, see `fits`."""
    if not len(poses):
        return np.zeros(0)
    pairs = _PointPairs(sources, targets)
    reach = SAME_SIGMAS * targets[0].config.point_sigma_m
    return np.asarray(pairs.linearise(poses, reach)[2] / pairs.count)


class _PointPairs:
    """Points of n submaps, and the nearest ones of n others, as arrays (n, 2 * `ALIGN_POINTS`).

    Where a submap has fewer points, the rest is far from everything. All rows are equally long, so
    that a pair's sums are the same whatever the other pairs are.
    """

    def __init__(self, sources: Sequence[Submap], targets: Sequence[Submap]) -> None:
        clouds = [_subsample(source.points, ALIGN_POINTS) for source in sources]
        self.points = np.full((2, len(sources), 2 * ALIGN_POINTS), FAR_M)
        self.count = np.array([len(cloud) for cloud in clouds])
        for k, cloud in enumerate(clouds):
            self.points[:, k, : len(cloud)] = cloud.T
        # submap -> where its points begin in the table of all
        distinct = {id(t): t for t in targets}
        sizes = [len(t.points) for t in distinct.values()]
        begins = dict(zip(distinct, np.cumsum([0, *sizes]), strict=False))
        self.known = np.concatenate([t.points for t in distinct.values()]).T.copy()
        information = np.concatenate([t.information for t in distinct.values()])
        self.information = information.reshape(-1, 4).T.copy()
        self.begin = np.array([begins[id(t)] for t in targets])
        self.grids = [t.nearest for t in targets]

    def only(self, which: BoolArray) -> "_PointPairs":
        """Some of the pairs."""
        kept = copy(self)
        kept.points, kept.count = self.points[:, which], self.count[which]
        kept.begin = self.begin[which]
        kept.grids = [grid for grid, one in zip(self.grids, which, strict=True) if one]
        return kept

    def linearise(self, poses: Array, reach_m: float) -> tuple[Array, Array, Array]:
        """Normal equations of points seen from poses (n, 3) and their neighbours within reach.

        Returns:
            Information (n, 3, 3), gradient (n, 3), and the sums (n,) of the points' robust weights:
            all 0 where there are hardly any neighbours.
        """
        c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
        x, y = self.points
        arms = np.stack([c * x - s * y, s * x + c * y])
        placed = arms + poses.T[:2, :, None]
        near = nearest_of_each(self.grids, placed) + self.begin[:, None]
        off = placed - self.known.take(near, axis=1, mode="clip")
        ok = off[0] * off[0] + off[1] * off[1] < reach_m * reach_m
        metrics = self.information.take(near, axis=1, mode="clip").reshape(2, 2, *near.shape)
        terms, squared = point_terms(
            np.moveaxis(off, 0, -1),
            np.moveaxis(metrics, (0, 1), (-2, -1)),
            np.moveaxis(arms, 0, -1),
        )
        w = ok / (1.0 + squared / 4.0)
        enough = ok.sum(axis=1) >= MIN_NEIGHBOURS
        A, g = normal_equations(np.einsum("knp,np->kn", terms, w) * enough)
        return A + REGULAR * np.eye(3), g, w.sum(axis=1) * enough


def _covariance(information: Array, config: ScanMatchingConfig) -> Array:
    """Covariances (n, 3, 3) by information (n, 3, 3); that of no neighbours at all is large."""
    floor = np.diag([config.floor_m**2, config.floor_m**2, config.floor_rad**2])
    known = (information[:, 2, 2] > REGULAR)[:, None, None]
    inverse = np.linalg.inv(np.where(known, information, np.eye(3)))
    return np.where(known, CORRELATED_POINTS * inverse + floor, UNKNOWN_VAR * np.eye(3))


def agreement(source: Submap, target: Submap, pose: Array) -> tuple[float, float]:
    """Shares of all points of both submaps that the other confirms, and that it saw as free space.

    ``pose`` (3,) is that of ``source`` in ``target``. A point that one scan confirms counts as such
    whatever other scans saw: a door that was open once is no contradiction.
    """
    same = absent = 0
    for a, b, x in ((source, target, pose), (target, source, between(pose, np.zeros(3)))):
        confirmed, free = compare_with_scans(transform(x, a.points), b)
        same += int(confirmed.sum())
        absent += int((free & ~confirmed).sum())
    total = len(source.points) + len(target.points)
    return same / total, absent / total


def compare_with_scans(points: Array, submap: ScanGroup) -> tuple[BoolArray, BoolArray]:
    """Which points (n, 2) any scan of the submap confirms, and which lie in its free space.

    In single precision, which is finer than 0.01 mm and a thousandth of a degree.
    """
    poses = submap.poses.astype(np.float32)
    px, py = points.astype(np.float32).T
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    dx, dy = px - poses[:, :1], py - poses[:, 1:2]
    # not hypot: it takes as long as all of the rest
    r = np.sqrt(dx * dx + dy * dy)
    at = beam_of(c * dx + s * dy, c * dy - s * dx) + BEAMS * np.arange(len(poses))[:, None]
    near = np.zeros(r.shape, dtype=np.bool_)
    same_m = np.float32(SAME_SIGMAS * submap.config.point_sigma_m)
    with np.errstate(invalid="ignore"):
        for image in submap.images:  # one by one they stay in the cache
            near |= np.abs(image.take(at) - r) < same_m
    free = r < submap.free.take(at)
    return np.asarray(near.any(axis=0)), np.asarray(free.any(axis=0))


def match(
    source: Submap, target: Submap, guess: Array, window: Array, min_score: float = 0.0
) -> list[Match]:
    """All poses of ``source`` in ``target`` within a window that fit, see `match_pairs`."""
    return match_pairs([source], [target], [guess], [window], min_score)[0]


def match_pairs(
    sources: Sequence[Submap],
    targets: Sequence[Submap],
    guesses: Sequence[Array],
    windows: Sequence[Array],
    min_score: float = 0.0,
) -> list[list[Match]]:
    """For n pairs all poses of one in the other that fit, the most agreeing first.

    ``guesses`` (3,) are the middles of windows, ``windows`` (3,) half their sizes, m, m, rad; for
    ``min_score`` see `search`.
    """
    # the guess is one too: of many that are alike the search may leave out just the nearest
    starts = [
        [*search(s, t, guess, window, min_score), guess]
        for s, t, guess, window in zip(sources, targets, guesses, windows, strict=True)
    ]
    pair = [n for n, own in enumerate(starts) for _ in own]
    poses, covs, shares = align_pairs(
        [sources[n] for n in pair],
        [targets[n] for n in pair],
        [start for own in starts for start in own],
    )
    most = np.zeros(len(starts))
    np.maximum.at(most, pair, shares)
    found: list[list[Match]] = [[] for _ in starts]
    for n, pose, cov, share in zip(pair, poses, covs, shares, strict=True):
        if share <= 0.0 or share < MIN_SHARE * most[n]:
            continue
        if not any(_duplicates(pose, m.pose, targets[n].config) for m in found[n]):
            found[n].append(Match(pose, cov, *agreement(sources[n], targets[n], pose)))
    return [sorted(own, key=lambda m: m.absent - m.same) for own in found]


def _duplicates(a: Array, b: Array, config: ScanMatchingConfig) -> bool:
    d = between(a, b)
    near = np.hypot(d[0], d[1]) < DUPLICATE_SHARE * config.reach_m
    return bool(near and abs(d[2]) < DUPLICATE_RAD)
