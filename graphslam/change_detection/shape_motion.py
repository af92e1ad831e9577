"""The motion of an object whose shape both visits saw."""

import numpy as np
from scipy.spatial import cKDTree

from graphslam.change_detection.shapes import (
    PIECES_PER_WINDOW,
    Displacement,
    MotionSettings,
    Shape,
    is_straight,
)
from graphslam.change_detection.visit import Bools, Ints
from graphslam.change_detection.wall_motion import straight_motion
from graphslam.core.geometry import Array, compose, compose_jacobians, rotation, transform, wrap
from graphslam.perception.point_to_line import (
    gauss_newton_step,
    line_metrics,
    normal_equations,
    offset_jacobian,
    point_terms,
    step_poses,
)

#: shapes are alike if the residuals are below this, m, for these shares of the pieces of one and of
#: the other: each visit may have seen a part that the other did not
_ALIKE_M, _ALIKE_SHARES = 0.05, (0.6, 0.8)
#: fits whose shares differ by less than this are equally good
_AS_GOOD = 0.05
#: fewest pieces of a shape; initial headings that are tried; gates, m, one per iteration
_FEWEST, _TURNS = 10, 24
_GATES_M = (0.5, 0.5, 0.4, 0.3, 0.2, 0.2, 0.1, 0.1, 0.1, 0.06, 0.06)
#: m per unit of difference between normals: sides that face apart are far apart; their least cosine
_NORMAL_M, _FACING = 0.3, 0.7
#: least eigenvalue of the information: no direction known worse than to 0.1 m, rad
_LEAST_INFORMATION = 1e2


def motion_between(a: Shape, b: Shape, known: MotionSettings) -> tuple[float, Displacement] | None:
    """The motion that brings shape a onto shape b; None if they are not alike.

    Of motions that fit equally well the one with the smallest turn is taken: a square box looks the
    same from all sides. For the same reason no motion with a large turn is stated: most likely the
    object did not turn, and another side of it was seen.

    Returns:
        Share of both that agrees, and the motion.
    """
    away = b.points.mean(axis=0) - a.points.mean(axis=0)
    if min(len(a.points), len(b.points)) < _FEWEST or np.hypot(*away) > known.max_displacement_m:
        return None
    straight = [is_straight(s) for s in (a, b)]
    if all(straight):
        return straight_motion(a, b, known)
    if any(straight):
        return None
    fits = [_icp(a, b, float(turn), known) for turn in np.arange(_TURNS) * 2 * np.pi / _TURNS]
    found = [fit for fit in fits if fit is not None and fit[1].is_plausible]
    if not found:
        return None
    best = max(fit[0] for fit in found)
    good = [fit for fit in found if fit[0] > best - _AS_GOOD]
    return min(good, key=lambda fit: abs(float(wrap(fit[1].motion[2]))))


def _icp(
    a: Shape, b: Shape, turn: float, known: MotionSettings
) -> tuple[float, Displacement] | None:
    """Iterated point-to-line fit of a to b; only sides that face the same way are matched."""
    tree = cKDTree(np.hstack([b.points, _NORMAL_M * b.normals]))
    center = a.points.mean(axis=0)
    local = a.points - center
    pose = np.array([*b.points.mean(axis=0), turn])  # of the frame at a's centre
    for gate in _GATES_M:
        near, used = _correspondences(tree, a, b, local, pose, gate)
        if used.sum() < _FEWEST:
            return None
        moved = transform(pose, local[used])
        n = b.normals[near]
        terms, _ = point_terms(moved - b.points[near], line_metrics(n), moved - pose[:2])
        information, gradient = normal_equations(terms @ _weights(a, b, near, used))
        if np.linalg.eigvalsh(information)[0] < _LEAST_INFORMATION:
            return None
        pose = step_poses(pose, gauss_newton_step(information, gradient))
    near, used = _correspondences(tree, a, b, local, pose, _ALIKE_M)
    moved = np.hstack([transform(pose, local), _NORMAL_M * a.normals @ rotation(pose[2]).T])
    back = cKDTree(moved).query(np.hstack([b.points, _NORMAL_M * b.normals]))[0] < _ALIKE_M
    shares = sorted((float(used.mean()), float(back.mean())))
    if shares[0] < _ALIKE_SHARES[0] or shares[1] < _ALIKE_SHARES[1]:
        return None
    P = np.linalg.inv(information)
    # The errors of the poses are shared by a side and do not average out over its pieces. The
    # material's bias is one for the object, and counts as far as the incidence angles differ.
    n = b.normals[near]
    J = offset_jacobian(n, moved[used, :2] - pose[:2])
    pull = J * _weights(a, b, near, used)[:, None]
    common = np.sqrt(a.common[used] + b.common[near] + known.repeatability_m**2)
    side = np.floor((np.arctan2(n[:, 1], n[:, 0]) + np.pi) / (np.pi / 4)).astype(np.int64)
    biased = pull.T @ (known.bias_m * (a.incidence[used] - b.incidence[near]))
    middle = np.outer(biased, biased)
    for number in np.unique(side):
        g = (pull[side == number] * common[side == number, None]).sum(axis=0)
        middle += np.outer(g, g)
    cov = P + P @ middle @ P
    # the frame at a's centre was at (center, 0)
    start = np.array([-center[0], -center[1], 0.0])
    F, _ = compose_jacobians(pose, start)
    return sum(shares) / 2, Displacement(compose(pose, start), F @ cov @ F.T)


def _weights(a: Shape, b: Shape, near: Ints, used: Bools) -> Array:
    """Weights (k,) 1/m² of matched pieces: of the noise that windows average out."""
    return np.asarray(1 / (PIECES_PER_WINDOW * (a.white[used] + b.white[near])))


def _correspondences(
    tree: cKDTree, a: Shape, b: Shape, local: Array, pose: Array, gate_m: float
) -> tuple[Ints, Bools]:
    """Pieces (k,) of b that belong to the k pieces of a that have one, and which these are (n,)."""
    moved, facing = transform(pose, local), a.normals @ rotation(pose[2]).T
    _, near = tree.query(np.hstack([moved, _NORMAL_M * facing]))
    n = b.normals[near]
    d = moved - b.points[near]
    e = np.einsum("ni,ni->n", d, n)
    aside = np.abs(d[:, 0] * n[:, 1] - d[:, 1] * n[:, 0])
    # a piece beyond the end of b has no counterpart, however near to its line
    used = (np.abs(e) < gate_m) & (aside < max(gate_m / 2, _ALIKE_M))
    used &= np.einsum("ni,ni->n", facing, n) > _FACING
    return near[used], used
