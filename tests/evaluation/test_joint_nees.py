"""The NEES of whole trajectories under their stated joint covariance, by drawing from it."""

from dataclasses import replace

import numpy as np
import pytest
from room_log import drive, true_pose
from scipy.stats import chi2

import graphslam
from graphslam.core.geometry import compose, exp, inverse, wrap
from graphslam.core.information_root import InformationRoot
from graphslam.core.mount_covariances import MountCovariances
from graphslam.core.records import JointScans, RobotResult, ScanTies, Trajectory
from graphslam.evaluation.error_statistics import (
    nees,
    weighted_chi2_quantiles,
    with_joint_bounds,
)
from graphslam.evaluation.joint_nees import (
    MOST_POSES,
    joint_base_covariance,
    nees_weights,
    whitened_eigenvalues,
)
from graphslam.evaluation.metrics import evaluate
from graphslam.logs import read_truth
from graphslam.odometry.interpolation import origin_shift

PROBABILITIES = (0.005, 0.025, 0.975, 0.995)


@pytest.mark.parametrize("n", [1, 5, 40, 500])
def test_equal_weights_are_a_chi_square(n):
    found = weighted_chi2_quantiles(np.full(n, 2.0), PROBABILITIES)
    # of 100 000 draws 500 lie outside each of the outer ones: their probabilities are known to 5 %
    inside = chi2.cdf(found / 2.0, n)
    np.testing.assert_allclose(
        np.minimum(inside, 1 - inside), [0.005, 0.025, 0.025, 0.005], rtol=0.2
    )


def test_weights_far_apart_are_as_drawn():
    """One error that all share, beside many small ones."""
    rng = np.random.default_rng(1)
    weights = np.concatenate([[300.0, 40.0, 9.0], rng.uniform(0.1, 1.0, 400)])
    drawn = np.square(rng.normal(size=(40_000, len(weights)))) @ weights
    found = weighted_chi2_quantiles(weights, PROBABILITIES)
    share = np.searchsorted(np.sort(drawn), found) / len(drawn)
    np.testing.assert_allclose(
        np.minimum(share, 1 - share), [0.005, 0.025, 0.025, 0.005], rtol=0.25
    )


def test_the_nees_of_correlated_poses_is_inside_as_often_as_said():
    """Forty poses share an error of the world; a chi-square of independent ones is too narrow."""
    rng = np.random.default_rng(3)
    shared = np.tile(np.eye(3), (40, 1)) * np.array([1.0, 1.0, 0.3])
    own = np.kron(np.eye(40), np.diag([0.3, 0.2, 0.1]))
    P = shared @ shared.T + own @ own.T
    errors = rng.multivariate_normal(np.zeros(120), P, size=4000)
    blocks = np.tile(P[:3, :3], (40, 1, 1))
    means = np.array([nees(e.reshape(40, 3), blocks).mean() / 3 for e in errors])
    weights = whitened_eigenvalues(P, 3)
    assert weights.sum() == pytest.approx(120)
    found = with_joint_bounds({"nees_per_dof": 1.0}, weights)
    for name, outside in (("nees_bounds", 0.025), ("nees_bounds_99", 0.005)):
        low, high = found[name]
        sigma = np.sqrt(outside / 4000)
        assert np.mean(means < low) == pytest.approx(outside, abs=4 * sigma)
        assert np.mean(means > high) == pytest.approx(outside, abs=4 * sigma)
    assert 1 < found["effective_poses"] < 2
    low, high = chi2.ppf([0.025, 0.975], 120) / 120
    assert np.mean((means > low) & (means < high)) < 0.4


S = 1_000_000_000
START = np.array([2.0, -1.0, 0.7])


def two_robots(rng):
    """Two robots in one world, by their states, mounts and the root of all: with the truth drawn.

    Returns:
        Their joint covariance's record, results, and a function that draws errors of all poses.
    """
    n, names = 4, ("a", "b")
    mounts = {"a": np.array([0.3, 0.1, 0.05]), "b": np.array([-0.2, 0.0, 1.2])}
    size = 2 * 3 * n + 6
    scale = np.concatenate([np.tile([0.02, 0.02, 0.004], 2 * n), np.tile([0.01, 0.01, 0.003], 2)])
    A = np.eye(size) + 0.3 * rng.normal(size=(size, size))
    cov = scale[:, None] * (A @ A.T) * scale
    R = np.linalg.cholesky(np.linalg.inv(cov)).T
    one, none = np.zeros(1, dtype=np.int64), np.zeros(0, dtype=np.int64)
    rows = {"a": np.arange(0, 3 * n, 3), "b": np.arange(3 * n, 6 * n, 3)}
    mount_rows = {"a": np.arange(6 * n, 6 * n + 3), "b": np.arange(6 * n + 3, 6 * n + 6)}
    root = InformationRoot(one - 1, one + size, one, none, R.ravel(), rows, {}, mount_rows)
    # poses in the world in which the sensor begins where the base does
    before = {name: START + rng.normal(size=(n, 3)) * [3.0, 3.0, 1.0] for name in names}
    shift = origin_shift(START, mounts["a"])
    stamps = np.arange(n) * S
    unknown = np.full((n, 3, 3), np.nan)
    states, results, ties = {}, {}, {}
    for name in names:
        scans = compose(np.broadcast_to(shift, (n, 3)), before[name])
        states[name] = Trajectory(stamps, scans, unknown)
        base = Trajectory(stamps, compose(scans, inverse(mounts[name])), unknown)
        results[name] = RobotResult(base, None, states[name], None, base)
        zeros = np.zeros((n, 3))
        ties[name] = ScanTies(
            np.arange(n), zeros[:, 0], zeros, np.zeros((n, 3, 3)), np.zeros((n, 3, 3))
        )
    step = 1e-6
    twist = np.array([
        (compose(origin_shift(START, mounts["a"] + step * e), inverse(shift))) / step
        for e in np.eye(3)
    ]).T  # fmt: skip
    placing = dict.fromkeys(names, np.hstack([twist, np.zeros((3, 3))]))
    bias = np.diag([1e-4, 1e-4, 0.0, 0.0, 0.0, 0.0])
    known = MountCovariances(names, cov[6 * n :, 6 * n :] + bias, {}, {}, placing)

    def draw(count):
        errors = rng.multivariate_normal(np.zeros(size), cov, size=count)
        errors[:, 6 * n :] += rng.multivariate_normal(np.zeros(6), bias, size=count)
        off = []
        for name in names:
            own = errors[:, rows[name][0] : rows[name][-1] + 3].reshape(count, n, 3)
            moved = compose(np.broadcast_to(before[name], own.shape), exp(own))
            world = origin_shift(START, mounts["a"] + errors[:, mount_rows["a"]])
            there = compose(np.broadcast_to(world[:, None], moved.shape), moved)
            back = inverse(mounts[name] + errors[:, mount_rows[name]])
            bases = compose(there, np.broadcast_to(back[:, None], there.shape))
            e = bases - results[name].final.poses
            e[..., 2] = wrap(e[..., 2])
            off.append(e.reshape(count, -1))
        return np.concatenate(off, axis=1)

    return JointScans(root, states, ties, known), results, draw


def test_the_joint_covariance_of_bases_is_that_of_samples():
    """With the mounts of both robots, of which one places the world, and what they share."""
    joint, results, draw = two_robots(np.random.default_rng(7))
    used = {name: np.arange(4) for name in results}
    P = joint_base_covariance(joint, results, used)
    sample = np.cov(draw(30_000).T)
    sigma = np.sqrt(np.diag(sample))
    assert np.abs((P - sample) / np.outer(sigma, sigma)).max() < 0.06
    # without the mounts it is not
    alone = joint_base_covariance(replace(joint, mounts=None), results, used)
    assert np.abs((alone - sample) / np.outer(sigma, sigma)).max() > 0.3


def test_what_is_not_known_of_a_robot_has_no_weights():
    joint, results, _ = two_robots(np.random.default_rng(7))
    assert nees_weights(joint, results, {"a": np.arange(4), "c": np.arange(4)}) is None
    assert len(nees_weights(joint, results, {"b": np.arange(4)})) == 12


def test_evaluation_bounds_the_nees_by_the_joint_covariance(tmp_path):
    """Of a result, and the same of its folder; the blocks are those of the trajectory's file."""
    log = drive(tmp_path / "log.mcap")
    told = {"start.poses.robot": true_pose(0.0).tolist()}
    result = graphslam.smooth(log, output=tmp_path / "result", **told)
    robot = result.robots["robot"]
    saved = graphslam.load_result(tmp_path / "result")
    assert len(robot.final) < MOST_POSES
    used = {"robot": np.arange(len(robot.final))}
    P = joint_base_covariance(saved.joint, saved.robots, used)
    blocks = P.reshape(len(robot.final), 3, len(robot.final), 3)[
        range(len(robot.final)), :, range(len(robot.final))
    ]
    sigma, stated = (np.sqrt(np.diagonal(x, axis1=1, axis2=2)) for x in (blocks, robot.final.covs))
    # the error of what stamps mean, along the way, is beside it
    np.testing.assert_allclose(sigma, stated, rtol=0.05)
    truth = read_truth([log], result.config).trajectories
    found, again = (evaluate(one, truth)["joint"]["final"] for one in (result, saved))
    assert again["nees_bounds"] == pytest.approx(found["nees_bounds"], rel=1e-3)
    weights = whitened_eigenvalues(P, 3)
    expected = with_joint_bounds(found, weights)
    for name in ("nees_bounds", "nees_bounds_99", "effective_poses"):
        assert found[name] == pytest.approx(expected[name], rel=0.02)
    (low, high), (low_99, high_99) = found["nees_bounds"], found["nees_bounds_99"]
    assert low_99 < low < 1 < high < high_99


def test_every_third_of_the_poses_tells_the_same():
    """What `nees_weights` leaves out of a long path, whose errors follow each other slowly."""
    n = 900
    t = np.arange(n) / 60.0
    P = np.kron(np.exp(-np.abs(t[:, None] - t)), np.eye(3)) + 0.05 * np.eye(3 * n)
    some = P.reshape(n, 3, n, 3)[1::3, :, 1::3].reshape(n, n)
    all_poses, third = (
        weighted_chi2_quantiles(w, PROBABILITIES) / len(w)
        for w in (whitened_eigenvalues(P, 3), whitened_eigenvalues(some, 3))
    )
    np.testing.assert_allclose(third, all_poses, rtol=0.02)
