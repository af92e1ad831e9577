"""Rigid registration of the later run's world frame in the reference's, by landmarks of both.

Two crossing lines, or two points, that are congruent in both maps determine a rigid motion. These
motions vote; the best candidates are refined by least squares with a redescending weight, which
suppresses landmarks that moved, and the one that explains most landmarks wins.

The fit is not `core.consistency.fit_rigid_transform`: lines are among the landmarks, and every
landmark has a full covariance of its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.change_detection.visit import Bools, Ints, Visit
from graphslam.core.config import FrontEndConfig
from graphslam.core.errors import OutputError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import (
    Array,
    between,
    compose,
    rotation,
    transform,
    unit_vectors,
    wrap,
)
from graphslam.core.record import replace
from graphslam.core.records import Landmark
from graphslam.perception.point_to_line import offset_jacobian

#: least angle between two lines whose intersection is used, rad
_CROSSING_RAD = 0.35
#: tolerances of congruent pairs: angle between two lines, rad; distance of two points, m
_ANGLE_RAD, _LENGTH_M = 0.06, 0.15
#: bins of the vote, m, m, rad: twice the distance tolerance, the angle tolerance
_BIN = np.array([2 * _LENGTH_M, 2 * _LENGTH_M, _ANGLE_RAD])
_CANDIDATES = 12
#: errors of landmarks beside their covariances (flatness, association): the front end's floors
_FLOOR_RAD, _FLOOR_M = FrontEndConfig.floor_angle_rad, FrontEndConfig.floor_normal_m
_GATE = float(chi2_quantile(0.999, 2))
#: pairs of landmarks of one map, at most: those of the longest lines where there are more
_MAX_PAIRS = 2500
#: factors on the gates of the matching, one per iteration of the refinement
_SLACKS = (8.0, 4.0, 2.0, 1.0, 1.0, 1.0)
#: share of the best score from which on another pose explains nearly as much, and how many are
#: told: a square room looks the same from four
_NEARLY, _RIVALS = 0.7, 4
#: m, m, rad: poses that differ by less are one
_SAME = (0.5, 0.5, 0.05)
#: least information of a registration: no direction may be known worse than to 0.1 m or 0.1 rad
_MIN_INFORMATION = 1e2


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """Pose (3,) of the later world frame in the reference's, with covariance (3, 3).

    ``matched`` (k, 2): indices of landmarks (reference, later) that agree.
    """

    pose: Array
    cov: Array
    matched: Ints


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """Lines of a map: ``normal`` (n,), ``offset`` (n,), ``cov`` (n, 2, 2), ``ends`` (n, 2, 2)."""

    index: Ints
    normal: Array
    offset: Array
    cov: Array
    ends: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Points:
    """Points of a map: ``xy`` (n, 2), ``cov`` (n, 2, 2)."""

    index: Ints
    xy: Array
    cov: Array


def register(reference: Sequence[Landmark], later: Sequence[Landmark]) -> Registration:
    """The pose of the later world frame in the reference's, from landmarks in these frames.

    Raises:
        OutputError: there are not enough landmarks in common to fix a pose.
    """
    return register_rivals(reference, later)[0]


def register_rivals(
    reference: Sequence[Landmark], later: Sequence[Landmark]
) -> tuple[Registration, ...]:
    """`register`, and other poses that explain nearly as much: a building may be symmetric.

    Best first, at most `_RIVALS`.

    Raises:
        OutputError: there are not enough landmarks in common to fix a pose.
    """
    a, b = (_lines(reference), _points(reference)), (_lines(later), _points(later))
    votes = np.concatenate([_motions_of_lines(a[0], b[0]), _motions_of_points(a[1], b[1])])
    refined = (_refine(motion, a, b) for motion in _vote_peaks(votes))
    best = sorted((r for r in refined if r is not None), key=lambda r: -r[0])
    if not best:
        raise OutputError(
            "the two runs cannot be registered: their maps have no landmarks in common that fix a "
            "pose (two crossing lines or two points); did both drive through the same place?"
        )
    rivals: list[Registration] = []
    for score, found in best:
        if score >= _NEARLY * best[0][0] and not any(_is_same(found, one) for one in rivals):
            rivals.append(found)
    return tuple(rivals[:_RIVALS])


def _is_same(a: Registration, b: Registration) -> bool:
    """Whether two registrations are one: they turn alike, and move the world's origin alike."""
    return bool(np.all(np.abs(between(a.pose, b.pose)) < _SAME))


def landmarks_of_map(visit: Visit) -> tuple[Landmark, ...]:
    """The landmarks of a visit, without what is not known of where its robot began."""
    if visit.robots > 1:
        return visit.landmarks
    return within_map(visit.landmarks, visit.poses[0], visit.covs[0])


def within_map(landmarks: Sequence[Landmark], pose: Array, cov: Array) -> tuple[Landmark, ...]:
    """The landmarks with covariances as if one pose of the robot were known.

    What is not known of where a map begins, and of how it is turned there, moves all of it: it says
    nothing of its shape, which registers it.

    Args:
        landmarks: in the world.
        pose: (3,) early in the drive.
        cov: (3, 3) its additive world-axis errors.
    """
    made = []
    for one in landmarks:
        if one.line is None:
            x, y = one.position[:2] - pose[:2]
            J = np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])
            left = one.cov.copy()
            left[:2, :2] = _positive(one.cov[:2, :2] - J @ cov @ J.T)
            made.append(replace(one, cov=left))
            continue
        normal, offset, known = one.line
        nx, ny = np.cos(normal), np.sin(normal)
        J = np.array([[0.0, 0.0, 1.0], [nx, ny, nx * pose[1] - ny * pose[0]]])
        made.append(replace(one, line=(normal, offset, _positive(known - J @ cov @ J.T))))
    return tuple(made)


def _positive(cov: Array) -> Array:
    """The nearest covariance (2, 2) to a difference of two."""
    values, axes = np.linalg.eigh((cov + cov.T) / 2)
    return np.asarray((axes * np.maximum(values, 0.0)) @ axes.T)


def _lines(landmarks: Sequence[Landmark]) -> _Lines:
    found = [(i, m, m.line) for i, m in enumerate(landmarks) if m.line is not None]
    return _Lines(
        np.array([i for i, _, _ in found], dtype=np.int64),
        np.array([line[0] for _, _, line in found]),
        np.array([line[1] for _, _, line in found]),
        np.array([line[2] for _, _, line in found]).reshape(-1, 2, 2),
        np.array([m.extent for _, m, _ in found]).reshape(-1, 2, 2),
    )


def _points(landmarks: Sequence[Landmark]) -> _Points:
    found = [(i, m) for i, m in enumerate(landmarks) if m.line is None]
    return _Points(
        np.array([i for i, _ in found], dtype=np.int64),
        np.array([m.position[:2] for _, m in found]).reshape(-1, 2),
        np.array([m.cov[:2, :2] for _, m in found]).reshape(-1, 2, 2),
    )


def _pairs(weight: Array) -> tuple[Ints, Ints]:
    """Ordered pairs of different indices into ``weight`` (n,), of many those of large weights."""
    chosen = np.argsort(-weight, kind="stable")[: int(np.sqrt(_MAX_PAIRS))]
    i, j = np.meshgrid(chosen, chosen, indexing="ij")
    different = i != j
    return i[different], j[different]


def _motions_of_lines(a: _Lines, b: _Lines) -> Array:
    """Motions (k, 3) that bring two crossing lines of b onto two of a, for all congruent pairs."""
    parts = []
    for m in (a, b):
        i, j = _pairs(np.hypot(*(m.ends[:, 1] - m.ends[:, 0]).T))
        angle = wrap(m.normal[j] - m.normal[i])
        crossing = np.abs(np.sin(angle)) > np.sin(_CROSSING_RAD)
        i, j, angle = i[crossing], j[crossing], angle[crossing]
        both = np.column_stack([i, j])
        N = unit_vectors(m.normal)[both]
        at = np.linalg.solve(N, m.offset[both][..., None])[..., 0]
        parts.append((m.normal[i], angle, at))
    (normal_a, angle_a, at_a), (normal_b, angle_b, at_b) = parts
    p, q = np.nonzero(np.abs(wrap(angle_a[:, None] - angle_b[None, :])) < _ANGLE_RAD)
    # the mean over both lines: each gets half of the difference of the angles
    phi = wrap(normal_a[p] - normal_b[q] + wrap(angle_a[p] - angle_b[q]) / 2)
    return _motions(phi, at_a[p], at_b[q])


def _motions_of_points(a: _Points, b: _Points) -> Array:
    """Motions (k, 3) that bring two points of b onto two of a, for all congruent pairs."""
    parts = []
    for m in (a, b):
        i, j = _pairs(np.ones(len(m.index)))
        d = m.xy[j] - m.xy[i]
        parts.append(((m.xy[i] + m.xy[j]) / 2, np.hypot(*d.T), np.arctan2(d[:, 1], d[:, 0])))
    (middle_a, length_a, angle_a), (middle_b, length_b, angle_b) = parts
    p, q = np.nonzero(np.abs(length_a[:, None] - length_b[None, :]) < _LENGTH_M)
    return _motions(wrap(angle_a[p] - angle_b[q]), middle_a[p], middle_b[q])


def _motions(phi: Array, to: Array, start: Array) -> Array:
    """Motions (k, 3) that turn by ``phi`` (k,) and bring ``start`` (k, 2) to ``to`` (k, 2)."""
    return compose(np.column_stack([to, phi]), np.column_stack([-start, np.zeros(len(phi))]))


def _vote_peaks(votes: Array) -> list[Array]:
    """Medians (3,) of the fullest bins, of two grids shifted by half a bin so none cuts a peak."""
    found = []
    for shift in (0.0, 0.5):
        if not len(votes):
            break
        bins = np.floor(votes / _BIN + shift).astype(np.int64)
        _, inverse, counts = np.unique(bins, axis=0, return_inverse=True, return_counts=True)
        inverse = inverse.ravel()
        for peak in np.argsort(-counts, kind="stable")[:_CANDIDATES]:
            found.append(np.median(votes[inverse == peak], axis=0))
    return found


def _refine(
    pose: Array, a: tuple[_Lines, _Points], b: tuple[_Lines, _Points]
) -> tuple[float, Registration] | None:
    """Iterated matching and least squares; the score is the matched length, None if ambiguous."""
    cov: Array = np.eye(3)
    pairs, score = np.zeros((0, 2), dtype=np.int64), 0.0
    for slack in _SLACKS:
        line_pairs, line_rows = _match_lines(pose, a[0], b[0], slack)
        point_pairs, point_rows = _match_points(pose, a[1], b[1], slack)
        pairs = np.concatenate([line_pairs, point_pairs])
        information, gradient = np.zeros((3, 3)), np.zeros(3)
        score = 0.0
        for r, H, S, size in (line_rows, point_rows):
            W = np.linalg.inv(S)
            d2 = np.einsum("ni,nij,nj->n", r, W, r)
            weight = 1 / (1 + d2 / 4) ** 2  # Geman-McClure: suppresses outliers
            information += np.einsum("n,nia,nij,njb->ab", weight, H, W, H)
            gradient += np.einsum("n,nia,nij,nj->a", weight, H, W, r)
            # what agrees counts, hardly how well: a few exact ones must not outweigh many
            score += float((size * np.maximum(1 - d2 / (2 * _GATE), 0.0)).sum())
        if not _fixes_pose(information, pose, pairs, b):
            return None
        cov = np.asarray(np.linalg.inv(information), dtype=float)
        step = cov @ gradient
        pose = np.array([*(pose[:2] + step[:2]), wrap(pose[2] + step[2])])
    if len(pairs) < 2:
        return None
    return score, Registration(pose, cov, pairs)


def _fixes_pose(information: Array, pose: Array, pairs: Ints, b: tuple[_Lines, _Points]) -> bool:
    """Whether the pose is known where the landmarks are: at the origin a lever would be in it."""
    if not len(pairs):
        return False
    middles = np.concatenate([b[0].ends.mean(axis=1), b[1].xy])
    number = np.concatenate([b[0].index, b[1].index])
    x, y = transform(pose, middles[np.isin(number, pairs[:, 1])].mean(axis=0)) - pose[:2]
    # by how much the pose changes if it is moved and turned there
    G = np.array([[1.0, 0.0, y], [0.0, 1.0, -x], [0.0, 0.0, 1.0]])
    return bool(np.linalg.eigvalsh(G.T @ information @ G)[0] >= _MIN_INFORMATION)


_Rows = tuple[Array, Array, Array, Array]


def _match_lines(pose: Array, a: _Lines, b: _Lines, slack: float) -> tuple[Ints, _Rows]:
    """Pairs (k, 2) of landmark indices that agree, and (residual, Jacobian, covariance, length).

    The residual is a's direction and offset minus b's after the motion, the offset at b's middle:
    at the origin a long lever would correlate it with the direction.
    """
    normal = b.normal + pose[2]
    n = unit_vectors(normal)
    t = np.column_stack([-n[:, 1], n[:, 0]])
    ends = transform(pose, b.ends.reshape(-1, 2)).reshape(-1, 2, 2)
    middle = ends.mean(axis=1)
    i, j = np.nonzero(np.abs(wrap(a.normal[:, None] - normal[None])) < 0.03 * slack + 0.03)
    na = unit_vectors(a.normal)[i]
    ta = np.column_stack([-na[:, 1], na[:, 0]])
    # distance from b's middle to line a, along a's normal
    across = a.offset[i] - np.einsum("ni,ni->n", na, middle[j])
    r = np.column_stack([wrap(a.normal[i] - normal[j]), across])
    arm = middle[j] - pose[:2]
    S = _cov_at(a.cov[i], np.einsum("ni,ni->n", ta, middle[j]))
    S += _cov_at(b.cov[j], np.einsum("ni,ni->n", t[j], arm))
    S += np.diag([_FLOOR_RAD**2, _FLOOR_M**2])
    # d(predicted)/d(pose): direction by phi; the middle moves with the frame
    H = np.zeros((len(i), 2, 3))
    H[:, 0, 2], H[:, 1] = 1.0, offset_jacobian(na, arm)
    overlap = _overlap(a.ends[i], ends[j], ta)
    d2 = np.einsum("ni,nij,nj->n", r, np.linalg.inv(S), r)
    near = (np.abs(across) < 0.1 * slack) & (d2 < _GATE * slack**2) & (overlap > 0.1)
    keep = _best_of_each(j, i, d2, near)
    size = np.minimum(overlap[keep], 3.0)
    pairs = np.column_stack([a.index[i[keep]], b.index[j[keep]]])
    return pairs, (r[keep], H[keep], S[keep], size)


def _cov_at(cov: Array, lever: Array) -> Array:
    """Covariance (n, 2, 2) of (direction, distance to a point at ``lever`` (n,) m along the line).

    The point's distance is offset - lever * direction.
    """
    J = np.zeros((len(lever), 2, 2))
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, 1, 0] = -lever
    return np.asarray(J @ cov @ J.mT)


def _overlap(a: Array, b: Array, along: Array) -> Array:
    """Length (n,) m of the overlap of extents a, b (n, 2, 2) along directions (n, 2)."""
    sa = np.sort(np.einsum("nki,ni->nk", a, along), axis=1)
    sb = np.sort(np.einsum("nki,ni->nk", b, along), axis=1)
    return np.asarray(np.minimum(sa[:, 1], sb[:, 1]) - np.maximum(sa[:, 0], sb[:, 0]))


def _match_points(pose: Array, a: _Points, b: _Points, slack: float) -> tuple[Ints, _Rows]:
    """As `_match_lines` for points: the residual is the difference of positions."""
    xy, R = transform(pose, b.xy), rotation(pose[2])
    difference = a.xy[:, None] - xy
    i, j = np.nonzero(np.hypot(difference[..., 0], difference[..., 1]) < 0.2 * slack)
    r = difference[i, j]
    S = a.cov[i] + R @ b.cov[j] @ R.T + _FLOOR_M**2 * np.eye(2)
    arm = xy[j] - pose[:2]
    H = np.zeros((len(i), 2, 3))
    H[:, 0, 0] = H[:, 1, 1] = 1.0
    H[:, 0, 2], H[:, 1, 2] = -arm[:, 1], arm[:, 0]
    d2 = np.einsum("ni,nij,nj->n", r, np.linalg.inv(S), r)
    keep = _best_of_each(j, i, d2, d2 < _GATE * slack**2)
    pairs = np.column_stack([a.index[i[keep]], b.index[j[keep]]])
    return pairs, (r[keep], H[keep], S[keep], np.full(len(keep), 0.5))


def _best_of_each(j: Ints, i: Ints, d2: Array, allowed: Bools) -> Ints:
    """Rows of the pairs (i, j) with the least d2 for every j, among the ``allowed`` ones."""
    rows = np.nonzero(allowed)[0]
    rows = rows[np.lexsort((i[rows], d2[rows], j[rows]))]
    first = np.ones(len(rows), dtype=bool)
    first[1:] = j[rows][1:] != j[rows][:-1]
    return np.asarray(rows[first])
