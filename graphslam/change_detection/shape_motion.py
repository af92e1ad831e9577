"""How a thing moved whose shape both visits saw."""

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

#: shapes are alike if what is left between them is less than this, m, for these shares of one and
#: of the other: each visit may have seen a part that the other did not
_ALIKE_M, _ALIKE_SHARES = 0.05, (0.6, 0.8)
#: fits whose shares differ by less than this are as good
_AS_GOOD = 0.05
#: fewest pieces of a shape; turns that are tried; gates round by round, m
_FEWEST, _TURNS = 10, 24
_GATES_M = (0.5, 0.5, 0.4, 0.3, 0.2, 0.2, 0.1, 0.1, 0.1, 0.06, 0.06)
#: a difference of normals in m: sides that face apart are far apart; least cosine between them
_NORMAL_M, _FACING = 0.3, 0.7
#: a box that was seen from another side looks like one that was turned by more than this
_LARGEST_TURN_RAD = np.radians(60.0)


def motion_between(a: Shape, b: Shape, known: MotionSettings) -> tuple[float, Displacement] | None:
    """The motion that brings shape a onto shape b; None if they are not alike.

    Of motions that fit about as well the one that turns least is taken: a square box looks the
    same from all sides. For that reason no motion is stated that turns a thing far: most likely it
    was not turned, and what was seen is another side of it.

    Args:
        a: before.
        b: after.
        known: how well a piece is known.

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
    found = [fit for fit in fits if fit is not None and abs(fit[1].motion[2]) < _LARGEST_TURN_RAD]
    if not found:
        return None
    best = max(fit[0] for fit in found)
    good = [fit for fit in found if fit[0] > best - _AS_GOOD]
    return min(good, key=lambda fit: abs(float(wrap(fit[1].motion[2]))))


def _icp(
    a: Shape, b: Shape, turn: float, known: MotionSettings
) -> tuple[float, Displacement] | None:
    """Offsets along the normals of b, again and again; only sides that face alike are matched."""
    tree = cKDTree(np.hstack([b.points, _NORMAL_M * b.normals]))
    center = a.points.mean(axis=0)
    local = a.points - center
    pose = np.array([*b.points.mean(axis=0), turn])  # of the frame at a's middle
    for gate in _GATES_M:
        J, e, near, used = _matched(tree, a, b, local, pose, gate)
        if used.sum() < _FEWEST:
            return None
        white = a.white[used] + b.white[near[used]]
        weight = 1 / (PIECES_PER_WINDOW * white)
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
    white = a.white[used] + b.white[near[used]]
    pull = J[used] / (PIECES_PER_WINDOW * white)[:, None]
    common = np.sqrt(a.common[used] + b.common[near[used]] + known.repeatability_m**2)
    n = b.normals[near[used]]
    side = np.floor((np.arctan2(n[:, 1], n[:, 0]) + np.pi) / (np.pi / 4)).astype(np.int64)
    too_far = pull.T @ (known.bias_m * (a.incidence[used] - b.incidence[near[used]]))
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
