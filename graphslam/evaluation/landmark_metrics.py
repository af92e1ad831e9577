"""Errors of a landmark map against true landmarks."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, unit_vectors, wrap
from graphslam.core.records import Landmark, TrueLandmark
from graphslam.evaluation.error_statistics import PROBABILITY, nees, rms

#: A landmark matches a true one within this distance, and a line within this angle modulo pi. Both
#: define the metric: changing them would make numbers of different runs incomparable.
MATCH_DISTANCE_M, MATCH_ANGLE_RAD = 1.0, 0.35
#: the names of two points are exchanged if each is this many times nearer to the other's true place
EXCHANGE_RATIO = 3.0


def landmark_metrics(
    estimated: Sequence[Landmark],
    true: Sequence[TrueLandmark],
    aligned: Sequence[TrueLandmark] | None = None,
) -> dict[str, Any]:
    """``rmse_m``, ``nees_per_dof``, ``coverage``, ``worst``, ``matched``, ``missed``, ``extra``.

    Landmarks match by identity where both have one. Other points match by the assignment with the
    smallest sum of distances among pairs within 1 m. Other lines and segments each match the
    nearest true one within 1 m and 0.35 rad modulo pi, since a wall may be seen in several pieces.
    That is of the middle of what was seen; of several the one is taken whose line is nearest to
    it, and on which something was seen.

    The error of a point is its distance. The error of a line or segment is the distance of the
    middle of its extent from the true line; its NEES has two degrees of freedom (direction and
    offset of the normal), since a position along a wall is a gauge.

    ``coverage`` is that of the ellipsoids that 95 % are to be in. ``missed`` counts true
    landmarks without a match, ``extra`` estimated ones. ``worst`` has ``id``, ``nees_per_dof``
    and ``error_m`` of the landmark with the largest NEES per degree of freedom: one wrong
    association can dominate the mean. ``exchanged`` lists pairs of identities of points that
    each lie at the other's true place: their names are wrong, not their positions, and they are
    matched by position.

    ``aligned`` are the true ones, in their order, laid on the estimate as a whole, if it is there
    that they match.
    """
    there = true if aligned is None else aligned
    pairs, exchanged = _undo_exchanges(_match(estimated, there), estimated, there)
    errors, values, dofs = [], [], []
    for i, j in pairs:
        error, difference, cov = _landmark_error(estimated[i], true[j])
        errors.append(error)
        values.append(float(nees(difference[None], cov[None])[0]))
        dofs.append(len(difference))
    squares, dof = np.array(values), np.array(dofs)
    usable = np.flatnonzero(np.isfinite(squares))
    mean = worst = coverage = None
    if len(usable):
        mean = float(squares[usable].sum() / dof[usable].sum())
        inside = squares[usable] <= chi2_quantile(PROBABILITY, dof[usable])
        coverage = float(inside.mean())
        k = usable[(squares[usable] / dof[usable]).argmax()]
        worst = {
            "id": estimated[pairs[k][0]].id,
            "nees_per_dof": float(squares[k] / dof[k]),
            "error_m": errors[k],
        }
    return {
        "rmse_m": rms(np.array(errors)),
        "nees_per_dof": mean,
        "coverage": coverage,
        "worst": worst,
        "matched": len(pairs),
        "missed": len(true) - len({j for _, j in pairs}),
        "extra": len(estimated) - len(pairs),
        "exchanged": exchanged,
    }


def _undo_exchanges(
    pairs: Sequence[tuple[int, int]], estimated: Sequence[Landmark], true: Sequence[TrueLandmark]
) -> tuple[list[tuple[int, int]], list[tuple[str, str]]]:
    """Matches with exchanged names undone, and the pairs of those names."""
    match = dict(pairs)
    named = [i for i, j in pairs if estimated[i].identity and estimated[i].kind == "point"]
    exchanged = []
    for a, b in itertools.combinations(named, 2):
        if all(
            _point_distance(estimated[i], true[match[i]])
            > EXCHANGE_RATIO * _point_distance(estimated[i], true[match[k]])
            for i, k in ((a, b), (b, a))
        ):
            match[a], match[b] = match[b], match[a]
            exchanged.append((str(estimated[a].identity), str(estimated[b].identity)))
    return [(i, match[i]) for i, _ in pairs], exchanged


def _point_distance(estimated: Landmark, true: TrueLandmark) -> float:
    return float(np.hypot(*(estimated.position[:2] - true.pose[:2])))


def _match(estimated: Sequence[Landmark], true: Sequence[TrueLandmark]) -> list[tuple[int, int]]:
    """Indices (estimated, true) of the matches, see `landmark_metrics`."""
    named = {landmark.identity: j for j, landmark in enumerate(true) if landmark.identity}
    pairs, taken = [], set()
    for i, landmark in enumerate(estimated):
        j = named.get(landmark.identity or "")
        if j is not None and j not in taken:
            pairs.append((i, j))
            taken.add(j)
    rows = [i for i, landmark in enumerate(estimated) if landmark.identity not in named]
    columns = [j for j in range(len(true)) if j not in taken]
    if not rows or not columns:
        return pairs
    cost = _match_distances([estimated[i] for i in rows], [true[j] for j in columns])
    wall = np.array([estimated[i].kind != "point" for i in rows])
    nearest = cost.argmin(axis=1)
    pairs += [
        (rows[r], columns[nearest[r]]) for r in np.flatnonzero(wall & np.isfinite(cost.min(axis=1)))
    ]
    rows, cost = [i for i, is_wall in zip(rows, wall, strict=True) if not is_wall], cost[~wall]
    if not rows:
        return pairs
    # a forbidden pair costs more than all allowed ones together, so as many as possible match
    forbidden = MATCH_DISTANCE_M * (1 + min(cost.shape))
    from scipy.optimize import linear_sum_assignment  # noqa: PLC0415  (imports for long)

    chosen = linear_sum_assignment(np.where(np.isfinite(cost), cost, forbidden))
    matched = [
        (rows[r], columns[c]) for r, c in zip(*chosen, strict=True) if np.isfinite(cost[r, c])
    ]
    return pairs + matched


def _match_distances(estimated: Sequence[Landmark], true: Sequence[TrueLandmark]) -> Array:
    """Distances (n, m) between landmarks and true ones, m; infinite where they cannot match."""
    poses = np.array([t.pose for t in true])
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    position = np.array([e.position for e in estimated])
    extent = np.array([e.extent for e in estimated])
    points = np.array([e.kind == "point" for e in estimated], dtype=bool)
    true_points = np.array([t.kind == "point" for t in true], dtype=bool)
    # where each true wall begins and ends along its own x axis
    ends = np.full((len(true), 2), [-np.inf, np.inf])
    for k, one in enumerate(true):
        if one.extent is not None and not true_points[k]:
            along = (one.extent - one.pose[:2]) @ np.array([c[k], s[k]])
            ends[k] = along.min(), along.max()
    apart = np.hypot(*(position[:, None, :2] - poses[:, :2]).transpose(2, 0, 1))
    off = extent[:, :, None] - poses[:, :2]
    x, y = c * off[..., 0] + s * off[..., 1], c * off[..., 1] - s * off[..., 0]
    y = y.mean(axis=1)
    # a gap between what was seen and the wall: what was seen may span several walls of one line
    gap = np.maximum(x.min(axis=1) - ends[:, 1], ends[:, 0] - x.max(axis=1))
    gap = np.maximum(gap, 0.0)
    middle = x.mean(axis=1)
    near = np.hypot(middle - np.clip(middle, ends[:, 0], ends[:, 1]), y) <= MATCH_DISTANCE_M
    turn = wrap(2 * (position[:, None, 2] - poses[:, 2])) / 2  # modulo pi
    with np.errstate(invalid="ignore"):  # points have no direction
        walls = np.where(near & (np.abs(turn) <= MATCH_ANGLE_RAD), np.hypot(gap, y), np.inf)
    distance = np.where(points[:, None], apart, walls)
    distance[points[:, None] != true_points] = np.inf
    return np.where(distance <= MATCH_DISTANCE_M, distance, np.inf)


def _landmark_error(estimated: Landmark, true: TrueLandmark) -> tuple[float, Array, Array]:
    """Error in m; difference (2,) of the parameters that can be compared; its covariance."""
    if estimated.line is None or estimated.kind == "point":
        difference = estimated.position[:2] - true.pose[:2]
        return float(np.hypot(*difference)), difference, estimated.cov[:2, :2]
    normal, offset, cov = estimated.line
    # a line has two normals: the true one nearer to the estimate's is taken
    true_normal = true.pose[2] + np.pi / 2
    true_normal += np.pi * np.round((normal - true_normal) / np.pi)
    n = unit_vectors(true_normal)
    true_offset = float(n @ true.pose[:2])
    error = abs(float(n @ estimated.extent.mean(axis=0)) - true_offset)
    difference = np.array([normal - true_normal, offset - true_offset])
    return error, difference, cov
