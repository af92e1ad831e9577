"""Covariances of bases, sensors and maps with that of the estimated mount."""

import numpy as np
import pytest

from graphslam.core.geometry import compose, inverse, transform, transform_each
from graphslam.core.mount_covariances import MountCovariances
from graphslam.core.records import Estimate, Trajectory
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
        mounts=MountCovariances(("r",), SIGMA @ SIGMA, {"r": R @ cross}, {}),
    )
    found = with_mount_errors(estimate, {"r": "r"}, {}, {"r": START}, {"r": MOUNT})
    own = found.mounts.of("r")
    base = base_trajectory(found.states["r"], MOUNT, own, found.states["r"], stamps, np.zeros(6))
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
    known = MountCovariances(("r",), P, {"r": np.zeros((1, 3, 3))}, {})
    estimate = Estimate({"r": trajectory}, {}, 0.0, 0, mounts=known)
    found = with_mount_errors(estimate, {"r": "r"}, {}, {"r": START}, {"r": MOUNT})
    own = found.mounts.of("r")
    base = base_trajectory(
        found.states["r"], MOUNT, own, found.states["r"], np.array([0]), np.zeros(1)
    )
    # the prior is on the state, 0.3 m ahead: its direction of 0.02 rad moves the base about it by
    # 6 mm, beside 10 mm: 1.7 mm more in all
    assert np.sqrt(np.diag(base.covs[0])) == pytest.approx([0.01, 0.01, 0.02], abs=2e-3)
    assert np.sqrt(found.states["r"].covs[0, 0, 0]) > 0.015


def test_robots_in_one_world_have_the_errors_of_the_mount_that_places_it():
    """Two sessions, each with a mount of its own, and landmarks: covariances are of samples."""
    rng = np.random.default_rng(8)
    mounts = {"a": MOUNT, "b": np.array([0.1, -0.2, -0.4])}
    poses = {name: START + rng.normal(size=(3, 3)) * [3.0, 3.0, 2.0] for name in mounts}
    point = np.array([4.0, 3.0])
    size = 9 + 9 + 2 + 6
    scale = np.concatenate([np.full(20, 0.01), np.tile(np.diag(SIGMA), 2)])
    A = np.eye(size) + 0.3 * rng.normal(size=(size, size))
    cov = scale[:, None] * (A @ A.T) * scale
    errors = rng.multivariate_normal(np.zeros(size), cov, size=30_000)
    rows = {"a": slice(0, 9), "b": slice(9, 18)}
    m = slice(20, 26)
    # along the axes of the old world, which is turned
    world = world_of(MOUNT)
    c, s = np.cos(world[2]), np.sin(world[2])
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    def blocks(own):
        return np.array([cov[k : k + 3, k : k + 3] for k in range(own.start, own.stop, 3)])

    estimate = Estimate(
        {
            name: Trajectory(
                np.arange(3), compose(world, poses[name]), R @ blocks(rows[name]) @ R.T
            )
            for name in mounts
        },
        {5: (transform(world, point), R[:2, :2] @ cov[18:20, 18:20] @ R[:2, :2].T)},
        0.0,
        0,
        mounts=MountCovariances(
            ("a", "b"),
            cov[m, m],
            {name: R @ cov[rows[name], m].reshape(3, 3, 6) for name in mounts},
            {5: R[:2, :2] @ cov[18:20, m]},
        ),
    )
    found = with_mount_errors(estimate, {"a": "a", "b": "a"}, {5: "a"}, {"a": START}, mounts)
    worlds = world_of(MOUNT + errors[:, 20:23])
    in_world = {}
    for k, name in enumerate(mounts):
        own = errors[:, rows[name]].reshape(-1, 3, 3)
        sensors = compose(worlds[:, None], poses[name] + own)
        back = inverse(mounts[name] + errors[:, 20 + 3 * k : 23 + 3 * k])
        in_world[name] = compose(sensors, back[:, None])
        states = found.states[name]
        own = found.mounts.of(name)
        base = base_trajectory(states, mounts[name], own, states, np.arange(3), np.zeros(3))
        for seen, covs in ((sensors, states.covs), (in_world[name], base.covs)):
            for n in range(3):
                sample = np.cov(seen[:, n].T)
                sigma = np.sqrt(np.diag(sample))
                assert np.abs((covs[n] - sample) / np.outer(sigma, sigma)).max() < 0.06
    seen = transform_each(worlds, point + errors[:, 18:20])
    sample = np.cov(seen.T)
    np.testing.assert_allclose(found.landmarks[5][1], sample, atol=0.05 * sample.max())
    # what landmarks have in common with a mount, for maps that go on
    cross = (seen - seen.mean(axis=0)).T @ errors[:, m] / len(seen)
    expected = found.mounts.landmarks[5]
    sigma = np.outer(np.sqrt(np.diag(sample)), np.sqrt(np.diag(cov[m, m])))
    assert np.abs((cross - expected) / sigma).max() < 0.06
