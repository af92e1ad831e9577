"""What an estimated mount adds to the covariances of a robot's base, its sensor and its map.

States are rigid to the sensor, and the start is where the base was: the world lies where the
estimated mount puts it. An error of the mount moves the whole map, and the base once more about the
sensor. The drive that tells of the mount is that of the states, so both are taken jointly: alone,
the mount would make up most of what it adds, and its correlation takes it away again.
"""

import numpy as np

from graphslam.core.geometry import Array, between, compose, compose_jacobians, inverse
from graphslam.core.record import replace
from graphslam.core.records import Estimate, MountCovariance, Trajectory
from graphslam.odometry.interpolation import IntArray, trajectory_of_mount


def with_mount_errors(estimate: Estimate, start: Array, mount: Array) -> Estimate:
    """The estimate of a single robot, whose covariances have that of the world by its mount.

    Args:
        estimate: with `Estimate.mount`, in the world in which the base begins at its ``start``; its
            covariances are as if the mount by which that world is found were known.
        start: (3,) pose of the base.
        mount: (3,) as estimated.
    """
    known = estimate.mount
    assert known is not None
    ((robot, states),) = estimate.states.items()
    covs, cross = _added(
        states.covs, known.states, _of_world(start, mount, states.poses), known.mount
    )
    landmarks, crosses, placing = {}, {}, {}
    for i, (mean, cov) in estimate.landmarks.items():
        J = _of_world(start, mount, np.append(mean, 0.0)[:3])[: len(mean)]
        added, crosses[i] = _added(cov, known.landmarks[i], J, known.mount)
        landmarks[i], placing[i] = (mean, added), J
    return replace(
        estimate,
        states={robot: replace(states, covs=covs)},
        landmarks=landmarks,
        mount=MountCovariance(known.mount, cross, crosses, placing),
    )


def base_trajectory(
    sensor: Trajectory, mount: Array, known: MountCovariance, states: Trajectory, before: IntArray
) -> Trajectory:
    """Trajectory of a base whose sensor sits at ``mount`` (3,) in it, which is not exactly known.

    Args:
        sensor: its trajectory.
        mount: as estimated.
        known: covariances of the mount, and of ``states`` with it.
        states: of the sensor.
        before: (n,) index of the last state before each pose of ``sensor``.
    """
    back = inverse(mount)
    base = trajectory_of_mount(sensor, back)
    at = states.poses[before]
    carried, _ = compose_jacobians(at, between(at, sensor.poses))
    F, G = compose_jacobians(sensor.poses, back)
    c, s = np.cos(mount[2]), np.sin(mount[2])
    x, y = mount[:2]
    of_inverse = np.array([[-c, -s, s * x - c * y], [s, -c, c * x + s * y], [0.0, 0.0, -1.0]])
    cross = F @ carried @ known.states[before]
    return replace(base, covs=_added(base.covs, cross, G @ of_inverse, known.mount)[0])


def _of_world(start: Array, mount: Array, poses: Array) -> Array:
    """Derivative (..., 3, 3) by the mount of poses in the world start ∘ mount ∘ start⁻¹."""
    inside = compose(inverse(compose(start, mount)), poses)
    in_base = compose(mount, inside)
    _, G = compose_jacobians(np.broadcast_to(start, in_base.shape), in_base)
    F, _ = compose_jacobians(np.broadcast_to(mount, inside.shape), inside)
    return G @ F


def _added(cov: Array, cross: Array, J: Array, mount: Array) -> tuple[Array, Array]:
    """Covariance of x + J m and its covariance with m, from those of x and m."""
    both = cross + J @ mount
    mixed = cross @ J.mT
    return cov + mixed + mixed.mT + J @ mount @ J.mT, both
