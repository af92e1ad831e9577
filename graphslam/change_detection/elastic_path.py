"""A path laid onto surfaces as a whole: it may bend, but only as much as a path's shape allows.

Scans placed one by one hop to whatever they resemble, and stiff pieces of a path do not follow a
map that bends within them. Here all poses are found at once: each scan is pulled by the surfaces
it sees, its neighbours hold it by the motion between them.
"""

from dataclasses import replace

import numpy as np
from scipy.linalg import solveh_banded

from graphslam.change_detection.scan_to_map import scan_normal_equations
from graphslam.change_detection.surface_map import Surface
from graphslam.change_detection.visit import Visit
from graphslam.core.geometry import Array, between, compose, wrap

#: sigmas of the motion between neighbouring scans, m, m, rad
_STEP_SIGMAS = np.array([0.003, 0.003, 0.002])
#: a scan's beams share what is wrong with the surfaces: they tell as much as this share of them
_SHARE = 0.02


def fit_elastic_path(
    visit: Visit, shape: Array, surface: Surface, gates_m: tuple[float, ...]
) -> Visit:
    """The visit with all poses where its scans and its path's shape want them.

    Args:
        visit: scans about where they belong, in the frame of the surfaces.
        shape: poses (s, 3) of the path in any frame; only the motions between them count.
        surface: what to agree with.
        gates_m: farthest a return may lie from its surface to count, one per iteration.
    """
    beams = np.nonzero(visit.surface)[0]
    steps = between(shape[:-1], shape[1:])
    for gate in gates_m:
        information, right = scan_normal_equations(visit, surface, beams, gate)
        diagonal, beside, held = motion_terms(visit.poses, steps, _STEP_SIGMAS)
        step = _solved(diagonal + _SHARE * information, beside, held + _SHARE * right)
        poses = visit.poses + step
        poses[:, 2] = wrap(poses[:, 2])
        visit = replace(visit, poses=poses)
    return visit


def motion_terms(
    poses: Array, steps: Array, sigmas: Array, doubted: float = np.inf
) -> tuple[Array, Array, Array]:
    """What the motions between neighbours want of a path's poses: normal equations.

    Args:
        poses: (s, 3).
        steps: (s - 1, 3) from each to the next, in its frame.
        sigmas: (3,) of a step, m, m, rad; the first two are equal, so they hold in any direction.
        doubted: distance of a step, in sigmas, from which on it is doubted.

    Returns:
        Blocks (s, 3, 3) on the diagonal, (s - 1, 3, 3) above it, and right-hand side (s, 3).
    """
    ahead = compose(poses[:-1], steps)
    r = poses[1:] - ahead
    r[:, 2] = wrap(r[:, 2])
    W = np.diag(sigmas**-2.0) / (1 + ((r / sigmas) ** 2).sum(axis=1) / doubted**2)[:, None, None]
    # the next pose minus the one expected: d/d(next) = I, d/d(this) = -F
    F = np.tile(np.eye(3), (len(steps), 1, 1))
    F[:, 0, 2], F[:, 1, 2] = -(ahead - poses[:-1])[:, 1], (ahead - poses[:-1])[:, 0]
    Wr = np.einsum("nij,nj->ni", W, r)
    diagonal, right = np.zeros((len(poses), 3, 3)), np.zeros((len(poses), 3))
    diagonal[1:] += W
    diagonal[:-1] += F.mT @ W @ F
    right[1:] -= Wr
    right[:-1] += np.einsum("nji,nj->ni", F, Wr)
    return diagonal, -F.mT @ W, right


def _solved(diagonal: Array, beside: Array, right: Array) -> Array:
    """Solution (s, 3) of a symmetric block tridiagonal system.

    Its blocks are ``diagonal`` (s, 3, 3) and above it ``beside`` (s - 1, 3, 3).
    """
    size = len(diagonal)
    banded = np.zeros((6, 3 * size))  # upper form: banded[5 + i - j, j] = A[i, j]
    for a in range(3):
        for b in range(3):
            if a <= b:
                banded[5 + a - b, b::3] = diagonal[:, a, b]
            banded[5 + a - b - 3, 3 + b :: 3] = beside[:, a, b]
    return np.asarray(solveh_banded(banded, right.ravel())).reshape(size, 3)
