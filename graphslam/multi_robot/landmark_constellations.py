"""Robots that saw the same points: where one began in the frame of another, by points without name.

Two points of one map that are as far apart as two of another map say how the maps may lie. Each
such pair of pairs is tried, and the moves that bring most other points together are fitted. With
many pairs tried, some bring points together by chance: what is believed must bring so many that
chance, by the density of the points and the number of moves tried, hardly ever does, and no other
move may do nearly as well. (Constellations as in P. Lusk et al., CLIPPER, ICRA 2021, DOI
10.1109/ICRA48506.2021.9561069; chance as in W. Grimson and D. Huttenlocher, On the verification of
hypothesized matches, PAMI 13, 1991, DOI 10.1109/34.106994.)
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import pdtrc

from graphslam.core.config import AssociationConfig
from graphslam.core.consistency import fit_rigid_transform
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, between, transform, wrap
from graphslam.multi_robot.relative_frames import MAX_TURN_SIGMA_RAD, RelativeFrame
from graphslam.perception.scan_matching import IntArray

#: each point makes pairs with so many nearest ones
NEIGHBOURS = 8
#: moves that are tried at most, and that are fitted
MOST, FITTED = 300_000, 200
#: sigmas by which two distances, and two places of one point, may differ
SIGMAS = 3.0
#: m: cells in which moves are tried; radius in which the density of points is counted
CELL_M, AROUND_M = 0.1, 10.0
#: fewest points that must come together, and expected number of moves that do as well by chance
FEWEST, CHANCE = 6, 1e-6
#: another move that brings together more than this part of the points leaves it undecided
RIVAL = 0.7
#: m, rad: moves farther apart are different ones
APART_M, APART_RAD = 1.0, 0.15


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """A move (3,), its covariance (3, 3), and the pairs (k, 2) that it brings together.

    ``chance``: how many of all the moves tried are expected to do as well by chance.
    """

    pose: Array
    cov: Array
    pairs: IntArray
    chance: float


def relate_points(
    a: str,
    b: str,
    here: tuple[Array, Array],
    there: tuple[Array, Array],
    config: AssociationConfig,
) -> RelativeFrame | str:
    """Where ``b`` began in the frame of ``a``, or why that is not known ("" if nothing says so).

    Args:
        a: name of a robot.
        b: name of another one.
        here: means (n, 2) and covariances (n, 2, 2) of unnamed points, in the frame of ``a``.
        there: the same in the frame of ``b``.
        config: floors of what is seen.
    """
    (p, P), (q, Q) = here, there
    if min(len(p), len(q)) < FEWEST:
        return ""
    floor = config.floor_m**2
    v, w = (_largest_variance(cov) + 0.5 * floor for cov in (P, Q))
    moves = _candidate_transforms(p, v, q, w)
    if not len(moves):
        return ""
    tree = cKDTree(p)
    fits = [
        _refine(move, p, v, q, w, tree, len(moves))
        for move in _select_transforms(moves, p, v, q, w)
    ]
    sound = sorted((f for f in fits if f is not None), key=lambda f: -len(f.pairs))
    if not sound or sound[0].chance > CHANCE:
        return ""
    best = sound[0]
    if best.cov[2, 2] > MAX_TURN_SIGMA_RAD**2:
        return ""
    others = [f for f in sound if _are_distinct(best.pose, f.pose)]
    if any(f.chance <= CHANCE or len(f.pairs) > RIVAL * len(best.pairs) for f in others):
        return (
            f"{len(best.pairs)} points that {a} and {b} saw lie alike, and "
            f"{len(others[0].pairs)} do so another way: that has two meanings"
        )
    return RelativeFrame(b, a, best.pose, best.cov, float(len(best.pairs)))


def _largest_variance(cov: Array) -> Array:
    return np.asarray(np.linalg.eigvalsh(cov)[:, -1], dtype=float)


def _are_distinct(a: Array, b: Array) -> bool:
    off = between(a, b)
    return bool(np.hypot(off[0], off[1]) > APART_M or abs(off[2]) > APART_RAD)


def _candidate_transforms(p: Array, v: Array, q: Array, w: Array) -> Array:
    """Moves (m, 3) that take two points of ``q`` to two of ``p`` that are as far apart."""
    near = cKDTree(q).query(q, k=min(NEIGHBOURS + 1, len(q)))[1][:, 1:]
    first = np.repeat(np.arange(len(q)), near.shape[1])
    ours = np.unique(np.sort(np.column_stack([first, near.ravel()]), axis=1), axis=0)
    length = np.linalg.norm(q[ours[:, 1]] - q[ours[:, 0]], axis=1)
    reach = SIGMAS * np.sqrt(2 * (v.max() + w.max()))
    one_way = cKDTree(p).query_pairs(float(length.max() + reach), output_type="ndarray")
    theirs = np.concatenate([one_way, one_way[:, ::-1]])
    apart = np.linalg.norm(p[theirs[:, 1]] - p[theirs[:, 0]], axis=1)
    order = np.argsort(apart)
    theirs, apart = theirs[order], apart[order]
    low = np.searchsorted(apart, length - reach)
    count = np.searchsorted(apart, length + reach) - low
    k = np.repeat(np.arange(len(ours)), count)
    n = low[k] + np.arange(len(k)) - np.repeat(np.cumsum(count) - count, count)
    spread = v[theirs[n]].sum(axis=1) + w[ours[k]].sum(axis=1)
    fits = (apart[n] - length[k]) ** 2 <= SIGMAS**2 * spread
    k, n = k[fits], n[fits]
    every = slice(None, None, 1 + len(k) // MOST)
    k, n = k[every], n[every]
    to, of = p[theirs[n]], q[ours[k]]
    d, e = to[:, 1] - to[:, 0], of[:, 1] - of[:, 0]
    turn = wrap(np.arctan2(d[:, 1], d[:, 0]) - np.arctan2(e[:, 1], e[:, 0]))
    middle = of.mean(axis=1)
    c, s = np.cos(turn), np.sin(turn)
    rotated = np.column_stack([
        c * middle[:, 0] - s * middle[:, 1], s * middle[:, 0] + c * middle[:, 1]
    ])  # fmt: skip
    return np.column_stack([to.mean(axis=1) - rotated, turn])


def _select_transforms(moves: Array, p: Array, v: Array, q: Array, w: Array) -> Array:
    """Those moves (k, 3) that bring most points ``q`` near points ``p``, roughly."""
    gate = SIGMAS * np.sqrt(np.median(v) + np.median(w))
    low = p.min(axis=0) - gate - CELL_M
    size = np.ceil((p.max(axis=0) + gate + CELL_M - low) / CELL_M).astype(int) + 1
    grid = np.zeros(size + 1, dtype=bool)  # the last cells are outside, and empty
    middles = np.stack(np.meshgrid(*(np.arange(n) for n in size), indexing="ij"), axis=-1)
    distance = cKDTree(p).query(
        low + CELL_M * middles.reshape(-1, 2), distance_upper_bound=float(gate)
    )[0]
    grid[:-1, :-1] = np.isfinite(distance).reshape(tuple(size))
    c, s = np.cos(moves[:, 2]), np.sin(moves[:, 2])
    hits = np.zeros(len(moves), dtype=np.int64)
    for x, y in q:
        at = np.column_stack([c * x - s * y, s * x + c * y]) + moves[:, :2] - low
        cell = np.round(at / CELL_M).astype(np.intp)
        outside = (cell < 0) | (cell >= size)
        cell = np.where(outside.any(axis=1)[:, None], size, cell)
        hits += grid[cell[:, 0], cell[:, 1]]
    chosen: list[int] = []
    for k in np.argsort(-hits, kind="stable"):
        if len(chosen) == FITTED:
            break
        off = between(moves[chosen], moves[k]) if chosen else np.zeros((0, 3))
        # what lies within a gate of another comes to the same fit
        if not ((np.hypot(off[:, 0], off[:, 1]) < gate) & (np.abs(off[:, 2]) < 0.02)).any():
            chosen.append(int(k))
    return moves[chosen]


def _refine(
    move: Array, p: Array, v: Array, q: Array, w: Array, tree: cKDTree, tried: int
) -> _Fit | None:
    """A move fitted to the points that it brings together, these found anew each time."""
    pose, cov = move, np.zeros((3, 3))
    pairs = np.zeros((0, 2), dtype=np.intp)
    for _ in range(6):
        placed = transform(pose, q)
        distance, nearest = tree.query(placed)
        spread = v[nearest] + w
        k = np.flatnonzero(distance**2 <= chi2_quantile(0.99, 2) * spread)
        # each point once, with what is nearest
        k = k[np.argsort(distance[k], kind="stable")]
        k = np.sort(k[np.unique(nearest[k], return_index=True)[1]])
        found = np.column_stack([nearest[k], k])
        if len(found) < FEWEST:
            return None
        pose, cov = fit_rigid_transform(p[nearest[k]], q[k], spread[k])
        if np.array_equal(found, pairs):
            break
        pairs = found
    placed = transform(pose, q)
    count = tree.query_ball_point(placed, AROUND_M, return_length=True)
    share = count / AROUND_M**2 * chi2_quantile(0.99, 2) * (np.median(v) + w)
    by_chance = float(np.minimum(share, 1.0).sum())
    # two points made the move
    chance = tried * float(pdtrc(len(pairs) - 3, by_chance))
    return _Fit(pose, cov, pairs, chance)


__all__ = ["relate_points"]
