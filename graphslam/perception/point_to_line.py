"""Gauss-Newton on point-to-line and point-to-point distances: the kernel of all scan matching.

A point p, seen from a pose T = (t, phi), should lie on a point q of what was seen before, or on the
line through q with unit normal n. Its residual is r = T p - q, of which a metric M (2, 2) says what
counts: n nᵀ on a line, the identity where the surface has no direction (A. Censi, ICRA 2008, DOI
10.1109/ROBOT.2008.4543181), over a variance or with a weight for it. With the arm a = T p - t the
derivative of r by additive errors of T is J = [I | a⊥], a⊥ = (-a_y, a_x). Callers find the pairs of
points, choose the weights and sum over the points that share a pose.
"""

import numpy as np

from graphslam.core.geometry import Array, wrap

#: of the nine sums of `point_terms`, which stand where in the matrix
_UPPER = np.array([[0, 1, 3], [1, 2, 4], [3, 4, 5]])


def point_terms(residuals: Array, metrics: Array, arms: Array) -> tuple[Array, Array]:
    """What points add to the normal equations of their pose.

    They have residuals r (..., 2) m, symmetric metrics M (..., 2, 2) and arms a (..., 2) m.

    Returns:
        Distinct entries (9, ...) of Jᵀ M J and Jᵀ M r, of which `normal_equations` takes weighted
        sums, and rᵀ M r (...).
    """
    rx, ry = residuals[..., 0], residuals[..., 1]
    jx, jy = -arms[..., 1], arms[..., 0]
    xx, xy, yy = metrics[..., 0, 0], metrics[..., 0, 1], metrics[..., 1, 1]
    # written out: many small matrices cost more than their products
    ux, uy = xx * rx + xy * ry, xy * rx + yy * ry
    mx, my = xx * jx + xy * jy, xy * jx + yy * jy
    terms = np.stack([xx, xy, yy, mx, my, jx * mx + jy * my, ux, uy, jx * ux + jy * uy])
    return terms, rx * ux + ry * uy


def normal_equations(sums: Array) -> tuple[Array, Array]:
    """Information A (..., 3, 3) and gradient g (..., 3) of poses.

    ``sums`` (9, ...) are weighted sums of `point_terms` over the points of each pose.
    """
    last = sums.T
    return last[..., _UPPER], last[..., 6:]


def line_metrics(normals: Array) -> Array:
    """M = n nᵀ (..., 2, 2) of points on lines with unit normals (..., 2)."""
    return np.asarray(normals[..., :, None] * normals[..., None, :])


def offset_jacobian(normals: Array, arms: Array) -> Array:
    """Derivative (..., 3) of the offsets n·r along the normals (..., 2): n J."""
    moment = normals[..., 1] * arms[..., 0] - normals[..., 0] * arms[..., 1]
    return np.concatenate([normals, moment[..., None]], axis=-1)


def redescending(squared: Array, gate_m: float) -> Array:
    """Weights (...) of Geman and McClure for squared distances (...), m²: 1/4 at half the gate."""
    return np.asarray(1 / (1 + squared * (2 / gate_m) ** 2) ** 2)


def gauss_newton_step(information: Array, gradient: Array) -> Array:
    """The additive steps (..., 3) of poses, -A⁻¹ g."""
    return -np.asarray(np.linalg.solve(information, gradient[..., None])[..., 0], dtype=float)


def step_poses(poses: Array, step: Array) -> Array:
    """Poses (..., 3) after additive steps (..., 3)."""
    moved = poses + step
    moved[..., 2] = wrap(moved[..., 2])
    return moved
