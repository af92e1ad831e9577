"""Elastic registration: a whole path fitted to surfaces, bending no more than its shape allows.

Scans that are placed one by one jump to whatever they resemble, and stiff pieces of a path do not
follow a map that bends within them. Here all poses are estimated at once: each scan is pulled by
the surfaces that it sees, and the motions between neighbouring scans hold the path together.
"""

from dataclasses import replace

import numpy as np
from scipy.linalg import solveh_banded

from graphslam.change_detection.surface_alignment import scan_normal_equations
from graphslam.change_detection.surface_map import Surface
from graphslam.change_detection.visit import Visit
from graphslam.core.geometry import Array, between, compose, wrap
from graphslam.perception.point_to_line import step_poses

#: sigmas of the motion between neighbouring scans, m, m, rad
_STEP_SIGMAS = np.array([0.003, 0.003, 0.002])
#: share of the information of a scan's beams that is used: they share the errors of the surfaces
_SHARE = 0.02


def fit_elastic_path(
    visit: Visit, shape: Array, surface: Surface, gates_m: tuple[float, ...]
) -> Visit:
    """The visit with the poses that fit both the surfaces and the shape of the path.

    The visit is near where it belongs, in the frame of the surfaces; ``shape`` (s, 3) are the poses
    of its path in any frame, as only the motions between them count. Farther than ``gates_m``, one
    per iteration, from its surface a return does not count.
    """
    beams = np.nonzero(visit.surface)[0]
    motions = between(shape[:-1], shape[1:])
    for gate in gates_m:
        information, right = scan_normal_equations(visit, surface, beams, gate)
        diagonal, above, held = motion_terms(visit.poses, motions, _STEP_SIGMAS)
        step = _solve_banded(diagonal + _SHARE * information, above, held + _SHARE * right)
        visit = replace(visit, poses=step_poses(visit.poses, step))
    return visit


def motion_terms(
    poses: Array, motions: Array, sigmas: Array, doubted: float = np.inf
) -> tuple[Array, Array, Array]:
    """Normal equations of the motions (s - 1, 3) from each pose (s, 3) to the next, in its frame.

    The first two ``sigmas`` (3,) of a motion, m, m, rad, are equal, so they hold in any direction;
    ``doubted`` is the scale of the robust weight (Cauchy), in sigmas.

    Returns:
        Blocks (s, 3, 3) on the diagonal, (s - 1, 3, 3) above it, and right-hand side (s, 3).
    """
    expected = compose(poses[:-1], motions)
    r = poses[1:] - expected
    r[:, 2] = wrap(r[:, 2])
    W = np.diag(sigmas**-2.0) / (1 + ((r / sigmas) ** 2).sum(axis=1) / doubted**2)[:, None, None]
    # derivatives of r: I by the next pose, -F by this one
    F = np.tile(np.eye(3), (len(motions), 1, 1))
    F[:, 0, 2], F[:, 1, 2] = -(expected - poses[:-1])[:, 1], (expected - poses[:-1])[:, 0]
    Wr = np.einsum("nij,nj->ni", W, r)
    diagonal, right = np.zeros((len(poses), 3, 3)), np.zeros((len(poses), 3))
    diagonal[1:] += W
    diagonal[:-1] += F.mT @ W @ F
    right[1:] -= Wr
    right[:-1] += np.einsum("nji,nj->ni", F, Wr)
    return diagonal, -F.mT @ W, right


def _solve_banded(diagonal: Array, above: Array, right: Array) -> Array:
    """Solution (s, 3) of a system with blocks on the ``diagonal`` and, symmetric, ``above`` it."""
    size = len(diagonal)
    banded = np.zeros((6, 3 * size))  # upper form: banded[5 + i - j, j] = A[i, j]
    for a in range(3):
        for b in range(3):
            if a <= b:
                banded[5 + a - b, b::3] = diagonal[:, a, b]
            banded[5 + a - b - 3, 3 + b :: 3] = above[:, a, b]
    return np.asarray(solveh_banded(banded, right.ravel())).reshape(size, 3)
