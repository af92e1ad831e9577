"""Which of the things that vanished is which of those that appeared, and how it moved."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from graphslam.changes.evidence import Evidence
from graphslam.changes.grid import summed
from graphslam.changes.regions import connected
from graphslam.changes.registration import Registration
from graphslam.changes.surface import Surface
from graphslam.changes.visit import Bools, Ints, Visit
from graphslam.geometry import (
    Array,
    compose,
    compose_cov,
    compose_jacobians,
    inverse,
    inverse_cov,
    rotation,
    transform,
    wrap,
)
from graphslam.records import Landmark

#: shapes are alike if what is left between them is less than this, m, for these shares of one and
#: of the other: each visit may have seen a part that the other did not
_ALIKE_M, _ALIKE_SHARES = 0.05, (0.6, 0.8)
#: fits whose shares differ by less than this are as good
_AS_GOOD = 0.05
#: pieces of surface with a score below this are where they were, in sigmas
_UNCONFIRMED = 2.0
#: a shape ends this far from what is known to have changed; gaps in it are shorter than _GAP_M: the
#: old and the new place cross where neither is known to have changed
_REACH_M, _GAP_M = 1.0, 0.3
#: fewest pieces of a shape; turns that are tried; gates round by round, m
_FEWEST, _TURNS = 10, 24
_GATES_M = (0.5, 0.5, 0.4, 0.3, 0.2, 0.2, 0.1, 0.1, 0.1, 0.06, 0.06)
#: a difference of normals in m: sides that face apart are far apart; least cosine between them
_NORMAL_M, _FACING = 0.3, 0.7
#: normals that differ by less than this are those of a straight stretch
_STRAIGHT = 0.05
#: what the ends of a stretch are known to, m: beams and cells are coarse, edges are left out
_END_SIGMA_M = 0.04
#: what a straight stretch is known to across, m; a piece, apart from its noise; how many pieces
#: share one window
_ACROSS_SIGMA_M, _PIECE_SIGMA_M, _SHARED = 0.01, 0.003, 5.0
_LENGTH_M = 0.12
_FARTHEST_M = 5.0
#: a box that was seen from another side looks like one that was turned by more than this
_LARGEST_TURN_RAD = np.radians(60.0)


@dataclass(frozen=True, slots=True, eq=False)
class Displacement:
    """Rigid motion (3,) of the world that takes a thing from where it was, with cov (3, 3)."""

    motion: Array
    cov: Array


def segment_moves(
    reference: Sequence[Landmark], later: Sequence[Landmark], registration: Registration
) -> list[tuple[Landmark, Array, Displacement]]:
    """Segments of the map that are in both runs with the same length, but not in the same place.

    Returns:
        Per moved segment the reference's landmark, its ends (2, 2) m in the later run, in the
        reference's frame, and its displacement.
    """
    matched_ref, matched_later = set(registration.matched[:, 0]), set(registration.matched[:, 1])
    before = [m for i, m in enumerate(reference) if m.kind == "segment" and i not in matched_ref]
    after = [m for i, m in enumerate(later) if m.kind == "segment" and i not in matched_later]
    pairs = []
    for i, a in enumerate(before):
        for j, b in enumerate(after):
            longer = abs(_length(a) - _length(b))
            pose = compose(registration.pose, b.position)
            way = float(np.hypot(*(pose[:2] - a.position[:2])))
            if longer < _LENGTH_M and way < _FARTHEST_M and _length(a) > 4 * _LENGTH_M:
                pairs.append((longer + 0.1 * way, i, j))
    found, taken = [], (set[int](), set[int]())
    for _, i, j in sorted(pairs):
        if i in taken[0] or j in taken[1]:
            continue
        taken[0].add(i)
        taken[1].add(j)
        a, b = before[i], after[j]
        pose = compose(registration.pose, b.position)
        cov = compose_cov(registration.pose, registration.cov, b.position, b.cov)
        back = inverse(a.position)
        motion = compose(pose, back)
        total = compose_cov(pose, cov, back, inverse_cov(a.position, a.cov))
        ends = transform(registration.pose, b.extent)
        found.append((a, ends, Displacement(motion, total)))
    return found


def _length(landmark: Landmark) -> float:
    return float(np.hypot(*(landmark.extent[1] - landmark.extent[0])))


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """What one visit saw of a thing that is not where it was, or not where it had been.

    ``points`` (k, 2) m and ``normals`` (k, 2) of pieces, pointing at who saw them; ``white`` (k,)
    m² the variance of their offsets that windows average out; ``common`` (k,) m² that of the
    poses, which one side shares; ``incidence`` (k,) mean cosine of the beams.
    """

    points: Array
    normals: Array
    white: Array
    common: Array
    incidence: Array


def shape_of(
    surface: Surface, visit: Visit, evidence: Evidence, spread: float, core: Array
) -> Shape | None:
    """The surface that hangs together with a place and that the other visit does not confirm.

    What vanished often hid a part of itself from the later visit, or what appeared hides it: a
    thing that moved by less than its size is never seen to be gone as a whole. Pieces that were
    not tested therefore belong to the shape; pieces that were found as before do not.

    Args:
        surface: of the visit that saw the shape.
        visit: that visit.
        evidence: the other visit's beams on that surface.
        spread: see `graphslam.changes.evidence.spread`.
        core: (c, 2) m, the place.

    Returns:
        None if nothing is there.
    """
    open_ = surface.good & (~evidence.tested | (evidence.scores(spread) > _UNCONFIRMED))
    rows = np.nonzero(open_)[0]
    tree = cKDTree(core)
    away = tree.query(surface.points[rows], distance_upper_bound=_REACH_M)[0]
    rows, away = rows[np.isfinite(away)], away[np.isfinite(away)]
    grid = surface.nearest.grid
    label = connected(grid, surface.cells[rows], int(np.ceil(_GAP_M / grid.cell_m)))
    here = away < 2 * grid.cell_m
    rows = rows[np.isin(label, label[here])]
    if not len(rows):
        return None
    place = np.full(len(surface.cells), -1, dtype=np.int64)
    place[rows] = np.arange(len(rows))
    beams = np.nonzero(surface.beams >= 0)[0]
    beams = beams[place[surface.beams[beams]] >= 0]
    d, row = visit.directions[beams], place[surface.beams[beams]]
    n = surface.normals[rows]
    seen = np.column_stack([summed(row, d[:, k], len(rows)) for k in (0, 1)])
    n = np.where((np.einsum("ni,ni->n", n, seen) > 0)[:, None], -n, n)
    return Shape(
        surface.points[rows], n, surface.offset_cov[rows], surface.pose_var[rows],
        surface.incidence[rows],
    )  # fmt: skip


def motion_between(a: Shape, b: Shape, bias_m: float) -> tuple[float, Displacement] | None:
    """The motion that brings shape a onto shape b; None if they are not alike.

    Of motions that fit about as well the one that turns least is taken: a square box looks the
    same from all sides. For that reason no motion is stated that turns a thing far: most likely it
    was not turned, and what was seen is another side of it.

    Args:
        a: before.
        b: after.
        bias_m: how much too far a material may be measured.

    Returns:
        Share of both that agrees, and the motion.
    """
    away = b.points.mean(axis=0) - a.points.mean(axis=0)
    if min(len(a.points), len(b.points)) < _FEWEST or np.hypot(*away) > _FARTHEST_M:
        return None
    straight = [is_straight(s) for s in (a, b)]
    if all(straight):
        return _straight_motion(a, b)
    if any(straight):
        return None
    fits = [_icp(a, b, float(turn), bias_m) for turn in np.arange(_TURNS) * 2 * np.pi / _TURNS]
    found = [fit for fit in fits if fit is not None and abs(fit[1].motion[2]) < _LARGEST_TURN_RAD]
    if not found:
        return None
    best = max(fit[0] for fit in found)
    good = [fit for fit in found if fit[0] > best - _AS_GOOD]
    return min(good, key=lambda fit: abs(float(wrap(fit[1].motion[2]))))


def is_straight(shape: Shape) -> bool:
    """Whether its normals all point the same way, as those of a wall do."""
    n = shape.normals
    return float(np.linalg.eigvalsh(n.T @ n / len(n))[0]) < _STRAIGHT


def _straight_motion(a: Shape, b: Shape) -> tuple[float, Displacement] | None:
    """Of two straight stretches of the same length: direction, and middle to middle."""
    middles, angles, lengths, across = [], [], [], []
    for shape in (a, b):
        middle = shape.points.mean(axis=0)
        n = shape.normals.mean(axis=0)
        # the line's own direction is better known than the mean of its pieces' normals
        values, vectors = np.linalg.eigh(np.cov(shape.points.T))
        along = vectors[:, 1]
        facing = np.array([-along[1], along[0]])
        if facing @ n < 0:
            along = -along
        t = (shape.points - middle) @ along
        lengths.append(float(np.ptp(t)))
        middles.append(middle + along * (t.max() + t.min()) / 2)
        angles.append(float(np.arctan2(along[1], along[0])))
        across.append(float(values[0]) + float(shape.common.mean()) + _ACROSS_SIGMA_M**2)
    longer = abs(lengths[0] - lengths[1])
    if longer > _LENGTH_M or min(lengths) < 4 * _LENGTH_M:
        return None
    turn = float(wrap(angles[1] - angles[0]))
    pose = np.array([*middles[1], turn])
    start = np.array([-middles[0][0], -middles[0][1], 0.0])
    cov = np.zeros((3, 3))
    for angle, var in zip((angles[1],) * 2, across, strict=True):
        R = rotation(angle)
        cov[:2, :2] += R @ np.diag([_END_SIGMA_M**2, var]) @ R.T
    # both ends to ``across``: the direction of a line over its length, for each stretch
    cov[2, 2] = sum(12 * var / length**2 for var, length in zip(across, lengths, strict=True)) / 3
    F, _ = compose_jacobians(pose, start)
    share = min(lengths) / max(lengths)
    return share, Displacement(compose(pose, start), F @ cov @ F.T)


def _icp(a: Shape, b: Shape, turn: float, bias_m: float) -> tuple[float, Displacement] | None:
    """Offsets along the normals of b, again and again; only sides that face alike are matched."""
    tree = cKDTree(np.hstack([b.points, _NORMAL_M * b.normals]))
    center = a.points.mean(axis=0)
    local = a.points - center
    pose = np.array([*b.points.mean(axis=0), turn])  # of the frame at a's middle
    for gate in _GATES_M:
        J, e, near, used = _matched(tree, a, b, local, pose, gate)
        if used.sum() < _FEWEST:
            return None
        white = a.white[used] + b.white[near[used]] + _PIECE_SIGMA_M**2
        weight = 1 / (_SHARED * white)
        information = np.einsum("n,na,nb->ab", weight, J[used], J[used])
        values = np.linalg.eigvalsh(information)
        if values[0] < 1e2:  # a direction known worse than to 0.1 m, rad
            return None
        step = np.linalg.solve(information, J[used].T @ (weight * -e[used]))
        pose = np.array([*(pose[:2] + step[:2]), wrap(pose[2] + step[2])])
    J, e, near, used = _matched(tree, a, b, local, pose, _ALIKE_M)
    moved = np.hstack([transform(pose, local), _NORMAL_M * a.normals @ rotation(pose[2]).T])
    back = cKDTree(moved).query(np.hstack([b.points, _NORMAL_M * b.normals]))[0] < _ALIKE_M
    shares = sorted((float(used.mean()), float(back.mean())))
    if shares[0] < _ALIKE_SHARES[0] or shares[1] < _ALIKE_SHARES[1]:
        return None
    P = np.linalg.inv(information)
    # What a side shares is not averaged over its pieces: the poses. The material's bias is one for
    # the thing, and counts as far as the two visits saw it at other angles.
    white = a.white[used] + b.white[near[used]] + _PIECE_SIGMA_M**2
    pull = J[used] / (_SHARED * white)[:, None]
    common = np.sqrt(a.common[used] + b.common[near[used]])
    n = b.normals[near[used]]
    side = np.floor((np.arctan2(n[:, 1], n[:, 0]) + np.pi) / (np.pi / 4)).astype(np.int64)
    too_far = pull.T @ (bias_m * (a.incidence[used] - b.incidence[near[used]]))
    middle = np.outer(too_far, too_far)
    for number in np.unique(side):
        g = (pull[side == number] * common[side == number, None]).sum(axis=0)
        middle += np.outer(g, g)
    cov = P + P @ middle @ P
    # the frame at a's middle stood at (center, 0)
    start = np.array([-center[0], -center[1], 0.0])
    F, _ = compose_jacobians(pose, start)
    # alike in what is common, and the more of both that is the better
    return sum(shares) / 2, Displacement(compose(pose, start), F @ cov @ F.T)


def _matched(
    tree: cKDTree, a: Shape, b: Shape, local: Array, pose: Array, gate_m: float
) -> tuple[Array, Array, Ints, Bools]:
    """Per piece of a: Jacobian (n, 3) of its offset e (n,), its piece of b, whether it counts."""
    moved, facing = transform(pose, local), a.normals @ rotation(pose[2]).T
    _, near = tree.query(np.hstack([moved, _NORMAL_M * facing]))
    n = b.normals[near]
    d = moved - b.points[near]
    e = np.einsum("ni,ni->n", d, n)
    aside = np.abs(d[:, 0] * n[:, 1] - d[:, 1] * n[:, 0])
    # a piece beyond the end of b has no partner, however near its line
    used = (np.abs(e) < gate_m) & (aside < max(gate_m / 2, _ALIKE_M))
    used &= np.einsum("ni,ni->n", facing, n) > _FACING
    arm = moved - pose[:2]
    J = np.column_stack([n, -n[:, 0] * arm[:, 1] + n[:, 1] * arm[:, 0]])
    return J, e, near, used


def moved_points(points: Array, by: Displacement) -> Array:
    """Points (n, 2) m after the motion."""
    return np.asarray(points @ rotation(by.motion[2]).T + by.motion[:2])


def close_to(points: Array, ends: Array, within_m: float) -> Ints:
    """Which points (n, 2) m lie within a distance of the stretch between ``ends`` (2, 2) m."""
    along = ends[1] - ends[0]
    t = np.clip((points - ends[0]) @ along / float(along @ along), 0.0, 1.0)
    away = np.hypot(*(points - ends[0] - t[:, None] * along).T)
    return np.asarray(np.nonzero(away < within_m)[0])
