"""Errors of a landmark map against true landmarks."""

import math
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
    Distances are where the two lie beside each other: a Hough line reaches from its first to its
    last return, and its middle may be far from all that was seen of it. Of one that lies beside no
    part of a wall, the middle must be within 1 m of it.

    The error of a point is its distance. The error of a line or segment is its distance from the
    true line in the middle of what lies beside the true wall; its NEES has two degrees of freedom
    (direction and offset of the normal), since a position along a wall is a gauge.

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
    if not named:
        return list(pairs), []
    from scipy.spatial import cKDTree  # noqa: PLC0415  (imports for long)

    places = np.array([true[match[i]].pose[:2] for i in named])
    positions = np.array([estimated[i].position[:2] for i in named])
    reach = np.hypot(*(positions - places).T) / EXCHANGE_RATIO
    # the few true places that a name may have been exchanged with; 1e-9: `off` decides at the edge
    near = cKDTree(places).query_ball_point(positions, reach * (1 + 1e-9))
    owner = list(range(len(named)))  # of each true place; by number in `named`, as `place`
    place = list(owner)

    def off(point: int, to: int) -> float:
        return float(np.hypot(*(positions[point] - places[to])))

    exchanged = []
    for a in range(len(named)):
        for b in sorted(owner[k] for k in near[a] if owner[k] > a):
            if all(
                off(i, place[i]) > EXCHANGE_RATIO * off(i, place[k]) for i, k in ((a, b), (b, a))
            ):
                place[a], place[b] = place[b], place[a]
                owner[place[a]], owner[place[b]] = a, b
                exchanged.append(
                    (str(estimated[named[a]].identity), str(estimated[named[b]].identity))
                )
    match |= {i: match[named[place[k]]] for k, i in enumerate(named)}
    return [(i, match[i]) for i, _ in pairs], exchanged


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
    cost = _match_costs([estimated[i] for i in rows], [true[j] for j in columns])
    wall = np.array([estimated[i].kind != "point" for i in rows])
    nearest = cost.argmin(axis=1)
    pairs += [
        (rows[r], columns[nearest[r]]) for r in np.flatnonzero(wall & np.isfinite(cost.min(axis=1)))
    ]
    rows, cost = [i for i, is_wall in zip(rows, wall, strict=True) if not is_wall], cost[~wall]
    if not rows:
        return pairs
    from graphslam.core.assignment import cheapest_assignment  # noqa: PLC0415  (imports for long)

    # none costs more than all matches together, so as many as possible match
    none = np.full(len(rows), MATCH_DISTANCE_M * (1 + min(cost.shape)))
    matched = zip(*cheapest_assignment(cost, none), strict=True)
    return pairs + [(rows[r], columns[c]) for r, c in matched]


def _match_costs(estimated: Sequence[Landmark], true: Sequence[TrueLandmark]) -> Array:
    """Costs (n, m) of matching landmarks to true ones, m; infinite where they cannot match.

    Of points the distance. Of walls the distance where they lie beside each other and, added in
    quadrature, how far the landmark turns off the true line along its length, root mean square: a
    short edge that crosses a long landmark is no better match for lying in its middle.
    """
    poses = np.array([t.pose for t in true])
    position = np.array([e.position for e in estimated])
    extent = np.array([e.extent for e in estimated])
    points = np.array([e.kind == "point" for e in estimated], dtype=bool)
    true_points = np.array([t.kind == "point" for t in true], dtype=bool)
    ends = np.array([_ends(one) for one in true])
    apart = np.hypot(*(position[:, None, :2] - poses[:, :2]).transpose(2, 0, 1))
    offset, gap = _offset_beside(extent[:, None], poses, ends)
    middle, beyond = _offset_beside(extent.mean(axis=1)[:, None, None].repeat(2, 2), poses, ends)
    # what lies beside no part of a wall, only near its end, is more likely of something else
    near = np.where(gap > 0, np.hypot(middle, beyond), np.abs(offset))
    length = np.hypot(*(extent[:, 1] - extent[:, 0]).T)
    turn = wrap(2 * (position[:, None, 2] - poses[:, 2])) / 2  # modulo pi
    with np.errstate(invalid="ignore"):  # points have no direction
        match = (near <= MATCH_DISTANCE_M) & (np.abs(turn) <= MATCH_ANGLE_RAD)
        turned_off = np.sin(turn) * length[:, None] / math.sqrt(12)
        walls = np.where(match, np.hypot(np.hypot(gap, offset), turned_off), np.inf)
    cost = np.where(apart <= MATCH_DISTANCE_M, apart, np.inf)
    cost = np.where(points[:, None], cost, walls)
    cost[points[:, None] != true_points] = np.inf
    return cost


def _ends(true: TrueLandmark) -> tuple[float, float]:
    """Where a true wall begins and ends along its own x axis; infinite without an extent."""
    if true.extent is None or true.kind == "point":
        return -np.inf, np.inf
    along = (true.extent - true.pose[:2]) @ unit_vectors(true.pose[2])
    return float(along.min()), float(along.max())


def _offset_beside(extent: Array, pose: Array, ends: Array) -> tuple[Array, Array]:
    """Offsets (...) of landmarks from walls where they lie beside each other, and gaps, m.

    Args:
        extent: both ends (..., 2, 2) of what was seen of each landmark.
        pose: of a true wall (..., 3), the x axis along it.
        ends: where it begins and ends along that axis (..., 2).

    The offset is that in the middle of the common stretch; without one, at the landmark's nearest
    end, and the gap is how far that is from the wall along it.
    """
    c, s = np.cos(pose[..., 2, None]), np.sin(pose[..., 2, None])
    off = extent - pose[..., None, :2]
    x, y = c * off[..., 0] + s * off[..., 1], c * off[..., 1] - s * off[..., 0]
    begin = np.maximum(x.min(axis=-1), ends[..., 0])
    end = np.minimum(x.max(axis=-1), ends[..., 1])
    gap = np.maximum(begin - end, 0.0)
    at = np.clip((begin + end) / 2, x.min(axis=-1), x.max(axis=-1))
    length = x[..., 1] - x[..., 0]
    across = np.abs(length) < 1e-9  # seen at a right angle to the wall
    share = np.where(across, 0.5, (at - x[..., 0]) / np.where(across, 1.0, length))
    return y[..., 0] + share * (y[..., 1] - y[..., 0]), gap


def _landmark_error(estimated: Landmark, true: TrueLandmark) -> tuple[float, Array, Array]:
    """Error in m; difference (2,) of the parameters that can be compared; its covariance."""
    if estimated.line is None or estimated.kind == "point":
        difference = estimated.position[:2] - true.pose[:2]
        return float(np.hypot(*difference)), difference, estimated.cov[:2, :2]
    normal, offset, cov = estimated.line
    # a line has two normals: the true one nearer to the estimate's is taken
    true_normal = true.pose[2] + np.pi / 2
    true_normal += np.pi * np.round((normal - true_normal) / np.pi)
    true_offset = float(unit_vectors(true_normal) @ true.pose[:2])
    beside, _ = _offset_beside(estimated.extent, true.pose, np.array(_ends(true)))
    difference = np.array([normal - true_normal, offset - true_offset])
    return abs(float(beside)), difference, cov
