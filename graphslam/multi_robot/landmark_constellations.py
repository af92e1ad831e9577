"""Relative pose of two robots from points without identity in both their maps.

Two points of one map that are as far apart as two points of another suggest a rigid transform
between the maps. Each such transform is tried, and those that bring most other points together are
fitted. With many transforms tried, some bring points together by chance: one is accepted if it
matches so many that chance, given the density of the points and the number of transforms tried,
hardly ever does, and if no other transform does nearly as well. (Constellations as in P. Lusk et
al., CLIPPER, ICRA 2021, DOI 10.1109/ICRA48506.2021.9561069; chance as in W. Grimson and D.
Huttenlocher, On the verification of hypothesized matches, PAMI 13, 1991, DOI 10.1109/34.106994.)
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import pdtrc

from graphslam.core.arrays import IntArray
from graphslam.core.consistency import fit_rigid_transform, has_rival
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, between, transform, wrap
from graphslam.multi_robot.relative_frames import MAX_HEADING_SIGMA_RAD, RelativeFrame

#: means (n, 2) m and covariances (n, 2, 2) of points
Points = tuple[Array, Array]

#: each point is paired with this many nearest ones
NEIGHBOURS = 8
#: transforms that are tried at most, and that are fitted: bounds the run time
MAX_TRIED, MAX_FITTED = 300_000, 200
#: sigmas by which two distances, and the two positions of one point, may differ
GATE_SIGMAS = 3.0
#: probability of the chi-square gate of a match once a transform is fitted
GATE_PROBABILITY = 0.99
#: m: cells of the grid on which transforms are tried, finer than the gate (0.15 m where both maps
#: are exact, by `association.floor_m`); radius in which the density of points is counted
CELL_M, DENSITY_RADIUS_M = 0.1, 10.0
#: least number of matches, and expected number of transforms that do as well by chance
MIN_MATCHES, MAX_CHANCE = 6, 1e-6
#: a distinct transform with more than this share of the matches leaves it undecided
RIVAL_SHARE = 0.7
#: m, rad: transforms farther apart are distinct
DISTINCT_M, DISTINCT_RAD = 1.0, 0.15
#: rounds of matching and fitting
ROUNDS = 6


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """A fitted transform.

    ``pose`` (3,) with ``cov`` (3, 3); ``pairs`` (k, 2) are the points that it brings together;
    ``chance``: expected number of tried transforms that match as many by chance.
    """

    pose: Array
    cov: Array
    pairs: IntArray
    chance: float


def relate_points(
    a: str, b: str, points_a: Points, points_b: Points, floor_m: float
) -> RelativeFrame | str:
    """Start of ``b`` in the frame of ``a``, or why it is unknown ("" without evidence).

    Args:
        a: name of a robot.
        b: name of another one.
        points_a: in the frame of ``a``.
        points_b: in the frame of ``b``.
        floor_m: sigma that is added to the distance of two matched points.
    """
    (p, P), (q, Q) = points_a, points_b
    if min(len(p), len(q)) < MIN_MATCHES:
        return ""
    v, w = (np.asarray(np.linalg.eigvalsh(x)[:, -1] + 0.5 * floor_m**2) for x in (P, Q))
    tried = _candidate_transforms(p, v, q, w)
    if not len(tried):
        return ""
    tree = cKDTree(p)
    selected = _select_transforms(tried, p, v, q, w)
    fits = [_refine(pose, p, v, q, w, tree, len(tried)) for pose in selected]
    ranked = sorted((f for f in fits if f is not None), key=lambda f: -len(f.pairs))
    if not ranked or ranked[0].chance > MAX_CHANCE:
        return ""
    best = ranked[0]
    if best.cov[2, 2] > MAX_HEADING_SIGMA_RAD**2:
        return ""
    others = [f for f in ranked if _are_distinct(best.pose, f.pose)]
    matches = [len(f.pairs) for f in others]
    by_chance = all(f.chance > MAX_CHANCE for f in others)
    if not by_chance or has_rival(len(best.pairs), matches, RIVAL_SHARE):
        return (
            f"{len(best.pairs)} points in the maps of {a} and {b} match, but {matches[0]} match at "
            "another relative pose"
        )
    return RelativeFrame(b, a, best.pose, best.cov, float(len(best.pairs)))


def _are_distinct(a: Array, b: Array) -> bool:
    off = between(a, b)
    return bool(np.hypot(off[0], off[1]) > DISTINCT_M or abs(off[2]) > DISTINCT_RAD)


def _candidate_transforms(p: Array, v: Array, q: Array, w: Array) -> Array:
    """Transforms (m, 3) that take two points of ``q`` to two of ``p`` that are as far apart.

    ``v``, ``w``: variances (n,) m² of the points.
    """
    near = cKDTree(q).query(q, k=min(NEIGHBOURS + 1, len(q)))[1][:, 1:]
    first = np.repeat(np.arange(len(q)), near.shape[1])
    pairs_q = np.unique(np.sort(np.column_stack([first, near.ravel()]), axis=1), axis=0)
    length_q = np.linalg.norm(q[pairs_q[:, 1]] - q[pairs_q[:, 0]], axis=1)
    gate = GATE_SIGMAS * np.sqrt(2 * (v.max() + w.max()))
    one_way = cKDTree(p).query_pairs(float(length_q.max() + gate), output_type="ndarray")
    pairs_p = np.concatenate([one_way, one_way[:, ::-1]])
    length_p = np.linalg.norm(p[pairs_p[:, 1]] - p[pairs_p[:, 0]], axis=1)
    order = np.argsort(length_p)
    pairs_p, length_p = pairs_p[order], length_p[order]
    # every pair k of q with every pair n of p whose length is within the gate
    low = np.searchsorted(length_p, length_q - gate)
    count = np.searchsorted(length_p, length_q + gate) - low
    k = np.repeat(np.arange(len(pairs_q)), count)
    n = low[k] + np.arange(len(k)) - np.repeat(np.cumsum(count) - count, count)
    spread = v[pairs_p[n]].sum(axis=1) + w[pairs_q[k]].sum(axis=1)
    fits = (length_p[n] - length_q[k]) ** 2 <= GATE_SIGMAS**2 * spread
    k, n = k[fits], n[fits]
    every = slice(None, None, 1 + len(k) // MAX_TRIED)
    to, source = p[pairs_p[n[every]]], q[pairs_q[k[every]]]
    d, e = to[:, 1] - to[:, 0], source[:, 1] - source[:, 0]
    turn = wrap(np.arctan2(d[:, 1], d[:, 0]) - np.arctan2(e[:, 1], e[:, 0]))
    middle = source.mean(axis=1)
    c, s = np.cos(turn), np.sin(turn)
    rotated = np.column_stack([
        c * middle[:, 0] - s * middle[:, 1], s * middle[:, 0] + c * middle[:, 1]
    ])  # fmt: skip
    return np.column_stack([to.mean(axis=1) - rotated, turn])


def _select_transforms(tried: Array, p: Array, v: Array, q: Array, w: Array) -> Array:
    """Those of the transforms (k, 3) that bring most points ``q`` near points ``p``, on a grid."""
    gate = GATE_SIGMAS * np.sqrt(np.median(v) + np.median(w))
    low = p.min(axis=0) - gate - CELL_M
    size = np.ceil((p.max(axis=0) + gate + CELL_M - low) / CELL_M).astype(int) + 1
    grid = np.zeros(size + 1, dtype=bool)  # the last cells are outside, and empty
    middles = np.stack(np.meshgrid(*(np.arange(n) for n in size), indexing="ij"), axis=-1)
    distance = cKDTree(p).query(
        low + CELL_M * middles.reshape(-1, 2), distance_upper_bound=float(gate)
    )[0]
    grid[:-1, :-1] = np.isfinite(distance).reshape(tuple(size))
    c, s = np.cos(tried[:, 2]), np.sin(tried[:, 2])
    hits = np.zeros(len(tried), dtype=np.int64)
    for x, y in q:
        at = np.column_stack([c * x - s * y, s * x + c * y]) + tried[:, :2] - low
        cell = np.round(at / CELL_M).astype(np.intp)
        outside = (cell < 0) | (cell >= size)
        cell = np.where(outside.any(axis=1)[:, None], size, cell)
        hits += grid[cell[:, 0], cell[:, 1]]
    chosen: list[int] = []
    for k in np.argsort(-hits, kind="stable"):
        if len(chosen) == MAX_FITTED:
            break
        off = between(tried[chosen], tried[k]) if chosen else np.zeros((0, 3))
        # what lies within a gate of another comes to the same fit
        if not ((np.hypot(off[:, 0], off[:, 1]) < gate) & (np.abs(off[:, 2]) < 0.02)).any():
            chosen.append(int(k))
    return tried[chosen]


def _refine(
    start: Array, p: Array, v: Array, q: Array, w: Array, tree: cKDTree, tried: int
) -> _Fit | None:
    """A transform fitted to the points that it matches; these are matched again in each round.

    ``tree`` is of the points ``p``, ``tried`` the number of all transforms.
    """
    pose, cov = start, np.zeros((3, 3))
    pairs = np.zeros((0, 2), dtype=np.intp)
    gate2 = chi2_quantile(GATE_PROBABILITY, 2)
    for _ in range(ROUNDS):
        distance, nearest = tree.query(transform(pose, q))
        spread = v[nearest] + w
        k = np.flatnonzero(distance**2 <= gate2 * spread)
        # each point of p once, with the nearest of q
        k = k[np.argsort(distance[k], kind="stable")]
        k = np.sort(k[np.unique(nearest[k], return_index=True)[1]])
        matched = np.column_stack([nearest[k], k])
        if len(matched) < MIN_MATCHES:
            return None
        pose, cov = fit_rigid_transform(p[nearest[k]], q[k], spread[k])
        if np.array_equal(matched, pairs):
            break
        pairs = matched
    count = tree.query_ball_point(transform(pose, q), DENSITY_RADIUS_M, return_length=True)
    share = count / DENSITY_RADIUS_M**2 * gate2 * (np.median(v) + w)
    expected = float(np.minimum(share, 1.0).sum())
    # two of the matches determined the transform
    chance = tried * float(pdtrc(len(pairs) - 3, expected))
    return _Fit(pose, cov, pairs, chance)
