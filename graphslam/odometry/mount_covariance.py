"""What an estimated mount adds to the covariances of a robot's base, its sensor and its map.

States are rigid to the sensor, and the start is where the base was: the world lies where the
estimated mount puts it. An error of the mount moves the whole map, and the base once more about the
sensor. The drive that tells of the mount is that of the states, so both are taken jointly: alone,
the mount would make up most of what it adds, and its correlation takes it away again.
"""

from dataclasses import replace

import numpy as np

from graphslam.core.geometry import Array, between, compose, compose_jacobians, inverse
from graphslam.core.records import Estimate, MountCovariance, Trajectory
from graphslam.odometry.interpolation import IntArray


def with_mount_errors(estimate: Estimate, robot: str, start: Array, mount: Array) -> Estimate:
    """An estimate whose covariances have the error of the world that the mount of a robot is.

    Args:
        estimate: in the world where the robot's base is at its ``start`` in the beginning; its
            covariances and those with the mount are as if that world were known.
        robot: the one to whose start the world is fixed.
        start: (3,) pose of its base.
        mount: (3,) as estimated.
    """
    known = estimate.mounts[robot]
    states = estimate.states[robot]
    J = _of_world(start, mount, states.poses)
    own, cross = _added(states.covs, known.states, J, known.mount)
    landmarks, crosses = {}, {}
    for i, (mean, cov) in estimate.landmarks.items():
        d = len(mean)
        pose = np.append(mean, 0.0)[:3]
        J_i = _of_world(start, mount, pose)[:d]
        added, crosses[i] = _added(cov, known.landmarks[i], J_i, known.mount)
        landmarks[i] = mean, added
    return replace(
        estimate,
        states={**estimate.states, robot: replace(states, covs=own)},
        landmarks=landmarks,
        mounts={**estimate.mounts, robot: MountCovariance(known.mount, cross, crosses)},
    )


def base_trajectory(
    sensor: Trajectory,
    mount: Array,
    known: MountCovariance | None = None,
    states: Trajectory | None = None,
    before: IntArray | None = None,
) -> Trajectory:
    """Trajectory of a base whose sensor sits at ``mount`` (3,) in it.

    Args:
        sensor: its trajectory.
        mount: as estimated.
        known: covariances of the mount, and with ``states``; the mount is taken as exact without.
        states: of the sensor.
        before: (n,) the last of them before each pose.
    """
    back = inverse(mount)
    F, G = compose_jacobians(sensor.poses, back)
    covs = F @ sensor.covs @ F.mT
    if known is not None and states is not None and before is not None:
        at = states.poses[before]
        carried, _ = compose_jacobians(at, between(at, sensor.poses))
        c, s = np.cos(mount[2]), np.sin(mount[2])
        x, y = mount[:2]
        of_inverse = np.array([[-c, -s, s * x - c * y], [s, -c, c * x + s * y], [0.0, 0.0, -1.0]])
        covs, _ = _added(covs, F @ carried @ known.states[before], G @ of_inverse, known.mount)
    return Trajectory(sensor.stamps_ns, compose(sensor.poses, back), covs)


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
