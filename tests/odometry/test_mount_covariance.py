"""Covariances of bases, sensors and maps with that of the estimated mount."""

import numpy as np
import pytest

from graphslam.core.geometry import compose, inverse
from graphslam.core.records import Estimate, MountCovariance, Trajectory
from graphslam.odometry.interpolation import origin_shift
from graphslam.odometry.mount_covariance import base_trajectory, with_mount_errors

START = np.array([2.0, -1.0, 0.7])
MOUNT = np.array([0.3, 0.1, 0.05])
SIGMA = np.diag([0.02, 0.01, 0.003])


def world_of(mount):
    return origin_shift(START, mount)


def states(rng, n=40):
    """Poses (n, 3) of the sensor in the world in which the sensor begins at the start."""
    return np.vstack([START, START + rng.normal(size=(n - 1, 3)) * [3.0, 3.0, 2.0]])


def sampled(rng, poses, correlation, count=20_000):
    """Errors of poses and of the mount, (count, n, 3) and (count, 3), and their covariances."""
    mount = rng.normal(size=(count, 3)) @ SIGMA
    own = 0.01 * rng.normal(size=(count, len(poses), 3))
    errors = own + np.einsum("nij,cj->cni", correlation, mount)
    P = SIGMA @ SIGMA
    covs = 1e-4 * np.eye(3) + correlation @ P @ correlation.mT
    return errors, mount, covs, correlation @ P


def test_covariances_are_those_of_samples():
    rng = np.random.default_rng(5)
    poses = states(rng, 6)
    correlation = 0.3 * rng.normal(size=(6, 3, 3))
    errors, off, covs, cross = sampled(rng, poses, correlation)
    in_world = compose(world_of(MOUNT), poses)
    turn = float(world_of(MOUNT)[2])
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    stamps = np.arange(6)
    estimate = Estimate(
        {"r": Trajectory(stamps, in_world, R @ covs @ R.T)},
        {},
        0.0,
        0,
        mount=MountCovariance(SIGMA @ SIGMA, R @ cross, {}),
    )
    found = with_mount_errors(estimate, START, MOUNT)
    base = base_trajectory(found.states["r"], MOUNT, found.mount, found.states["r"], stamps)
    sensors = compose(world_of(MOUNT + off)[:, None], poses + errors)
    bases = compose(sensors, inverse(MOUNT + off)[:, None])
    for seen, covs_of in ((sensors, found.states["r"].covs), (bases, base.covs)):
        for k in range(6):
            sample = np.cov(seen[:, k].T)
            scale = np.sqrt(np.diag(sample))
            # 20 000 samples: 1 % of each sigma, and what is not linear in 1 cm and 3 mrad
            assert np.abs((covs_of[k] - sample) / np.outer(scale, scale)).max() < 0.05


def test_the_base_begins_where_the_start_is_known_to_be():
    """Whatever the mount: its errors of world and of base cancel there."""
    P = SIGMA @ SIGMA
    prior = np.diag([0.01, 0.01, 0.02]) ** 2
    sensor = compose(world_of(MOUNT), START)[None]
    trajectory = Trajectory(np.array([0]), sensor, prior[None])
    known = MountCovariance(P, np.zeros((1, 3, 3)), {})
    estimate = Estimate({"r": trajectory}, {}, 0.0, 0, mount=known)
    found = with_mount_errors(estimate, START, MOUNT)
    base = base_trajectory(found.states["r"], MOUNT, found.mount, found.states["r"], np.array([0]))
    # the prior is on the state, 0.3 m ahead: its direction of 0.02 rad moves the base about it by
    # 6 mm, beside 10 mm: 1.7 mm more in all
    assert np.sqrt(np.diag(base.covs[0])) == pytest.approx([0.01, 0.01, 0.02], abs=2e-3)
    assert np.sqrt(found.states["r"].covs[0, 0, 0]) > 0.015
