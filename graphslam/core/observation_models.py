"""One observation model per kind of target: predict, residual, noise, Jacobians, invert.

A model compares a measurement ``z``, made from a robot's pose ``x`` and given in its base frame,
with a target ``t`` in the world frame. Residuals are *expected minus measured*, as in GTSAM, and
equal the unwhitened error of the factor that `graphslam.estimation.factors` builds for the same
row. Errors of poses are additive along world axes (thesis 4.20-4.21). Everything broadcasts over
leading axes: ``z (..., k)``, ``cov (..., k, k)``, ``x (..., 3)``, ``t (..., d)``.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from graphslam.core.geometry import (
    Array,
    between,
    compose,
    compose_cov,
    log,
    log_jacobian,
    polar_points,
    rotate_cov,
    wrap,
)


class ObservationModel(Protocol):
    """A row of `MODELS`."""

    @property
    def rows(self) -> int:
        """Rows of the residual."""
        ...

    @property
    def dim(self) -> int:
        """Size of the target's state."""
        ...

    def predict(self, x: Array, t: Array) -> Array:
        """Expected measurement (..., k) of target ``t`` from pose ``x``."""
        ...

    def residual(self, z: Array, x: Array, t: Array) -> Array:
        """Expected minus measured, ``(..., rows)``."""
        ...

    def noise(self, z: Array, cov: Array, x: Array, t: Array) -> Array:
        """Covariance ``(..., rows, rows)`` of the residual's measurement part."""
        ...

    def jacobians(self, z: Array, x: Array, t: Array) -> tuple[Array, Array]:
        """Derivatives of the residual by ``x`` (..., rows, 3) and ``t`` (..., rows, dim)."""
        ...

    def invert(self, z: Array, x: Array) -> Array:
        """The target (..., dim) that ``z`` from ``x`` describes, thesis eq. 4.24."""
        ...

    def invert_jacobians(self, z: Array, x: Array) -> tuple[Array, Array]:
        """Derivatives of `invert` by ``x`` (..., dim, 3) and ``z`` (..., dim, k)."""
        ...


def _relative_jacobians(x: Array, t: Array) -> tuple[Array, Array]:
    """Derivatives (..., 3, 3) of ``between(x, t)`` by x and t: thesis 4.20, 4.21, 4.35."""
    c, s = np.cos(x[..., 2]), np.sin(x[..., 2])
    dx, dy = t[..., 0] - x[..., 0], t[..., 1] - x[..., 1]
    shape = np.broadcast_shapes(x.shape, t.shape)
    H_x, H_t = np.zeros((*shape, 3)), np.zeros((*shape, 3))
    H_x[..., 0, 0], H_x[..., 0, 1], H_x[..., 0, 2] = -c, -s, -s * dx + c * dy
    H_x[..., 1, 0], H_x[..., 1, 1], H_x[..., 1, 2] = s, -c, -c * dx - s * dy
    H_x[..., 2, 2] = -1.0
    H_t[..., 0, 0] = H_t[..., 1, 1] = c
    H_t[..., 0, 1], H_t[..., 1, 0] = s, -s
    H_t[..., 2, 2] = 1.0
    return H_x, H_t


@dataclass(frozen=True)
class PoseModel:
    """A target with position and direction, measured as a pose: thesis eq. 4.18.

    The residual is log(z⁻¹ x⁻¹ t), the error of GTSAM's between factor; its noise is z's
    covariance along the axes of the measured pose.
    """

    rows: int = 3
    dim: int = 3

    def predict(self, x: Array, t: Array) -> Array:
        """Pose of the target in the base frame."""
        return between(x, t)

    def residual(self, z: Array, x: Array, t: Array) -> Array:
        """See `ObservationModel`."""
        return log(between(z, between(x, t)))

    def noise(self, z: Array, cov: Array, x: Array, t: Array) -> Array:
        """See `ObservationModel`; z's covariance is along the axes of the base frame."""
        return rotate_cov(cov, -z[..., 2])

    def jacobians(self, z: Array, x: Array, t: Array) -> tuple[Array, Array]:
        """See `ObservationModel`."""
        h = between(x, t)
        H_x, H_t = _relative_jacobians(x, t)
        _, D = _relative_jacobians(z, h)
        D = log_jacobian(between(z, h)) @ D
        return D @ H_x, D @ H_t

    def invert(self, z: Array, x: Array) -> Array:
        """See `ObservationModel`."""
        return compose(x, z)

    def invert_jacobians(self, z: Array, x: Array) -> tuple[Array, Array]:
        """G_x and G_z of thesis eq. 4.25-4.28."""
        c, s = np.cos(x[..., 2]), np.sin(x[..., 2])
        shape = np.broadcast_shapes(x.shape, z.shape)
        G_x, G_z = np.zeros((*shape, 3)), np.zeros((*shape, 3))
        G_x[..., 0, 0] = G_x[..., 1, 1] = G_x[..., 2, 2] = 1.0
        G_x[..., 0, 2] = -s * z[..., 0] - c * z[..., 1]
        G_x[..., 1, 2] = c * z[..., 0] - s * z[..., 1]
        G_z[..., 0, 0] = G_z[..., 1, 1] = c
        G_z[..., 0, 1], G_z[..., 1, 0] = -s, s
        G_z[..., 2, 2] = 1.0
        return G_x, G_z


@dataclass(frozen=True)
class LineModel(PoseModel):
    """A line of unknown ends: only its normal offset and direction are compared.

    The target is a pose on the line, x axis along it; where on the line is a gauge. The
    measurement is moved along its own line by ``along`` to face the target's origin, where normal
    offset and direction form the residual. Moving it carries the direction error into the
    normal offset with that lever arm, which `noise` accounts for. (Treating the middle of a
    partly seen wall as a point, however uncertain along the wall, is wrong and confident.)
    """

    rows: int = 2
    dim: int = 3

    def along(self, z: Array, x: Array, t: Array) -> Array:
        """Distance (...,) along the measured line from z to the target's origin, m."""
        direction = x[..., 2] + z[..., 2]
        c, s = np.cos(direction), np.sin(direction)
        ahead = c * (t[..., 0] - x[..., 0]) + s * (t[..., 1] - x[..., 1])
        c, s = np.cos(z[..., 2]), np.sin(z[..., 2])
        return np.asarray(ahead - c * z[..., 0] - s * z[..., 1])

    def facing(self, z: Array, x: Array, t: Array) -> Array:
        """The measurement moved along its own line to face the target's origin, (..., 3)."""
        along = self.along(z, x, t)
        faced = np.broadcast_to(z, (*along.shape, 3)).copy()
        faced[..., 0] += along * np.cos(z[..., 2])
        faced[..., 1] += along * np.sin(z[..., 2])
        return faced

    def residual(self, z: Array, x: Array, t: Array) -> Array:
        """(normal offset m, direction rad)."""
        return super().residual(self.facing(z, x, t), x, t)[..., 1:]

    def noise(self, z: Array, cov: Array, x: Array, t: Array) -> Array:
        """See `ObservationModel`; the part of ``cov`` along the line is not used."""
        V = rotate_cov(cov, -z[..., 2])[..., 1:, 1:]
        T = np.zeros((*V.shape[:-2], 2, 2))
        T[..., 0, 0] = T[..., 1, 1] = 1.0
        T[..., 0, 1] = self.along(z, x, t)
        return np.asarray(T @ V @ T.mT)

    def jacobians(self, z: Array, x: Array, t: Array) -> tuple[Array, Array]:
        """See `ObservationModel`; how ``along`` itself depends on the state is second order."""
        H_x, H_t = super().jacobians(self.facing(z, x, t), x, t)
        return H_x[..., 1:, :], H_t[..., 1:, :]


@dataclass(frozen=True)
class PointModel:
    """A point measured by bearing (rad) and range (m); ``of_pose``: the point is a robot's origin.

    The thesis has no such row (its objects all carry an angle); this is the sighting of a tree.
    """

    rows: int = 2
    dim: int = 2
    of_pose: bool = False

    def predict(self, x: Array, t: Array) -> Array:
        """Bearing and range in the base frame."""
        dx, dy = t[..., 0] - x[..., 0], t[..., 1] - x[..., 1]
        return np.stack([wrap(np.arctan2(dy, dx) - x[..., 2]), np.hypot(dx, dy)], axis=-1)

    def residual(self, z: Array, x: Array, t: Array) -> Array:
        """See `ObservationModel`."""
        r = self.predict(x, t) - z
        return np.stack([wrap(r[..., 0]), r[..., 1]], axis=-1)

    def noise(self, z: Array, cov: Array, x: Array, t: Array) -> Array:
        """See `ObservationModel`."""
        return cov

    def jacobians(self, z: Array, x: Array, t: Array) -> tuple[Array, Array]:
        """See `ObservationModel`; undefined where robot and target coincide."""
        dx, dy = t[..., 0] - x[..., 0], t[..., 1] - x[..., 1]
        r2 = np.maximum(dx * dx + dy * dy, 1e-12)
        r = np.sqrt(r2)
        shape = np.shape(r)
        H_x, H_t = np.zeros((*shape, 2, 3)), np.zeros((*shape, 2, 3 if self.of_pose else 2))
        H_t[..., 0, 0], H_t[..., 0, 1] = -dy / r2, dx / r2
        H_t[..., 1, 0], H_t[..., 1, 1] = dx / r, dy / r
        H_x[..., :2] = -H_t[..., :2]
        H_x[..., 0, 2] = -1.0
        return H_x, H_t

    def invert(self, z: Array, x: Array) -> Array:
        """See `ObservationModel`; a robot's heading is not observed and comes out as 0."""
        point = x[..., :2] + polar_points(z[..., 1], x[..., 2] + z[..., 0])
        if self.of_pose:
            point = np.concatenate([point, np.zeros((*point.shape[:-1], 1))], axis=-1)
        return point

    def invert_jacobians(self, z: Array, x: Array) -> tuple[Array, Array]:
        """See `ObservationModel`."""
        direction = x[..., 2] + z[..., 0]
        c, s, r = np.cos(direction), np.sin(direction), z[..., 1]
        dim = 3 if self.of_pose else 2
        G_x, G_z = np.zeros((*np.shape(r), dim, 3)), np.zeros((*np.shape(r), dim, 2))
        G_x[..., 0, 0] = G_x[..., 1, 1] = 1.0
        G_x[..., 0, 2] = G_z[..., 0, 0] = -r * s
        G_x[..., 1, 2] = G_z[..., 1, 0] = r * c
        G_z[..., 0, 1], G_z[..., 1, 1] = c, s
        return G_x, G_z


#: model name -> how an observation and its target are compared
MODELS: dict[str, ObservationModel] = {
    "point": PointModel(),
    "line": LineModel(),
    "segment": PoseModel(),
    "robot-pose": PoseModel(),
    "robot-point": PointModel(dim=3, of_pose=True),
}


def transport(z: Array, cov: Array, frame: Array, frame_cov: Array) -> tuple[Array, Array]:
    """A measurement given in a frame that sits at ``frame`` in the base frame, in the base frame.

    Args:
        z: (2,) bearing and range, or (3,) a pose.
        cov: its covariance, along the frame's axes.
        frame: pose (3,) of the frame (a sensor's mount, or a motion since the last state).
        frame_cov: (3, 3) of the frame's pose, along base axes; zeros for a rigid mount.

    Returns:
        The measurement and its covariance in the base frame, linearised.
    """
    if not frame.any() and not frame_cov.any():
        return z, cov
    if len(z) == 3:
        return compose(frame, z), compose_cov(frame, frame_cov, z, cov)
    model = PointModel()
    point = model.invert(z, frame)
    G_x, G_z = model.invert_jacobians(z, frame)
    point_cov = G_x @ frame_cov @ G_x.T + G_z @ cov @ G_z.T
    origin = np.zeros(3)
    _, H = model.jacobians(z, origin, point)
    return model.predict(origin, point), np.asarray(H @ point_cov @ H.T)


__all__ = [
    "MODELS",
    "LineModel",
    "ObservationModel",
    "PointModel",
    "PoseModel",
    "rotate_cov",
    "transport",
]
