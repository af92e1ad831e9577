"""What estimated mounts add to the covariances of robots' bases, their sensors and their map.

States are rigid to the sensor, and the start is where the base was: the world lies where the
estimated mount of the robot that begins there puts it. An error of that mount moves the whole map,
and one of any robot's mount moves its base about the sensor. The drives that tell of the mounts are
those of the states, so all are taken jointly: alone, a mount would make up most of what it adds,
and its correlation takes it away again.
"""

from collections.abc import Mapping

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import (
    Array,
    between,
    compose,
    compose_jacobians,
    inverse,
    moved_by_world,
)
from graphslam.core.mount_covariances import MountCovariance, MountCovariances
from graphslam.core.record import replace
from graphslam.core.records import Estimate, Trajectory
from graphslam.odometry.interpolation import trajectory_of_mount


def with_mount_errors(
    estimate: Estimate,
    frames: Mapping[str, str],
    landmark_frames: Mapping[int, str],
    starts: Mapping[str, Array],
    mounts: Mapping[str, Array],
) -> Estimate:
    """The estimate, whose covariances have those of the worlds by the mounts.

    Args:
        estimate: with `Estimate.mounts`, in worlds in which bases begin at their ``starts``; its
            covariances are as if the mounts by which these worlds are found were known.
        frames: robot -> the robot that begins at its start in this one's world.
        landmark_frames: the same of landmarks.
        starts: (3,) poses of the bases of these robots.
        mounts: (3,) of the robots as estimated.
    """
    known = estimate.mounts
    assert known is not None
    by_frame = {}
    for first in set(frames.values()):
        twist = np.zeros((3, len(known.cov)))
        if first in known.robots:
            twist[:, known.columns(first)] = _twist_of_world(starts[first], mounts[first])
        by_frame[first] = twist
    placing = {robot: by_frame[frames[robot]] for robot in estimate.states}
    states, crosses = {}, {}
    for robot, own in estimate.states.items():
        J = moved_by_world(own.poses) @ placing[robot]
        covs, crosses[robot] = _added(own.covs, known.states[robot], J, known.cov)
        states[robot] = replace(own, covs=covs)
    landmarks, of_landmarks = {}, {}
    for i, (mean, cov) in estimate.landmarks.items():
        J = moved_by_world(np.append(mean, 0.0)[:3])[: len(mean)] @ by_frame[landmark_frames[i]]
        added, of_landmarks[i] = _added(cov, known.landmarks[i], J, known.cov)
        landmarks[i] = mean, added
    return replace(
        estimate,
        states=states,
        landmarks=landmarks,
        mounts=MountCovariances(known.robots, known.cov, crosses, of_landmarks, placing),
    )


def base_trajectory(
    sensor: Trajectory,
    mount: Array,
    known: MountCovariance,
    states: Trajectory,
    before: IntArray,
    share: Array,
) -> Trajectory:
    """Trajectory of a base whose sensor sits at ``mount`` (3,) in it, which is not exactly known.

    Args:
        sensor: its trajectory.
        mount: as estimated.
        known: covariances of the mount, and of ``states`` with it.
        states: of the sensor.
        before: (n,) index of the last state before each pose of ``sensor``.
        share: (n,) of its covariance that is that of the state after it, see `final_at`.
    """
    back = inverse(mount)
    base = trajectory_of_mount(sensor, back)
    at = states.poses[before]
    carried, _ = compose_jacobians(at, between(at, sensor.poses))
    F, _ = compose_jacobians(sensor.poses, back)
    following = known.states[np.minimum(before + 1, len(known.states) - 1)]
    s = share[:, None, None]
    cross = F @ ((1 - s) * carried @ known.states[before] + s * following)
    moved = moved_by_mount(sensor.poses, mount)
    return replace(base, covs=_added(base.covs, cross, moved, known.mount)[0])


def moved_by_mount(sensor: Array, mount: Array) -> Array:
    """Derivative (n, 3, 3) of the base of sensors (n, 3) by their mount (3,)."""
    _, G = compose_jacobians(sensor, inverse(mount))
    c, s = np.cos(mount[2]), np.sin(mount[2])
    x, y = mount[:2]
    of_inverse = np.array([[-c, -s, s * x - c * y], [s, -c, c * x + s * y], [0.0, 0.0, -1.0]])
    return np.asarray(G @ of_inverse)


def _twist_of_world(start: Array, mount: Array) -> Array:
    """Twist (3, 3) of the world start ∘ mount ∘ start⁻¹ by the mount: how its origin moves."""
    inside = inverse(compose(start, mount))
    in_base = compose(mount, inside)
    _, G = compose_jacobians(start, in_base)
    F, _ = compose_jacobians(mount, inside)
    return np.asarray(G @ F)


def _added(cov: Array, cross: Array, J: Array, mounts: Array) -> tuple[Array, Array]:
    """Covariance of x + J m and its covariance with m, from those of x and m."""
    both = cross + J @ mounts
    mixed = cross @ J.mT
    return cov + mixed + mixed.mT + J @ mounts @ J.mT, both
