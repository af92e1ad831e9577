"""Covariances between scans: by finite differences, GTSAM, and read back from a folder."""

from dataclasses import replace

import numpy as np
import pytest
from backend_cases import make, two_robots
from room_log import drive

import graphslam
from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.geometry import adjoint, between, compose, exp, log
from graphslam.core.information_root import InformationRoot
from graphslam.core.records import JointScans, OdometryPose, Trajectory
from graphslam.estimation.joint_covariances import pair_covariances
from graphslam.evaluation.metrics import evaluate
from graphslam.evaluation.relation_covariances import relative_covariances
from graphslam.evaluation.relation_metrics import Relations
from graphslam.odometry.interpolation import final_at, final_scans, trajectory_of_mount
from graphslam.odometry.preintegration import Track

S = 1_000_000_000
STATES_S = np.array([0.0, 2.0, 3.0, 5.0])
MOUNT = np.array([0.3, -0.1, 0.7])


def way(t):
    """The pose after t seconds."""
    return compose(np.array([2.0, -1.0, 0.4]), exp(np.array([0.5, 0.02, 0.25]) * t))


def track():
    made = Track(OdometryConfig(), RobotConfig())
    for t in np.arange(0, 6.01, 0.1):
        made.add(OdometryPose("r", round(t * S), round(t * S), way(t)))
    return made


def dense(cov):
    """The root of four states with this covariance (12, 12), as one clique."""
    R = np.linalg.cholesky(np.linalg.inv(cov)).T
    one = np.zeros(1, dtype=np.int64)
    none = np.zeros(0, dtype=np.int64)
    return InformationRoot(one - 1, one + 12, one, none, R.ravel(), {"r": np.arange(0, 12, 3)})


def joint_of(times_s, cov, odometry):
    """States, their scans' poses, and what their joint covariance follows from."""
    times = np.round(np.asarray(times_s) * S).astype(np.int64)
    stamps = np.round(STATES_S * S).astype(np.int64)
    states = Trajectory(stamps, np.array([way(t) for t in STATES_S]), np.zeros((4, 3, 3)))

    def scans_of(poses):
        base = final_at(replace(states, poses=poses), odometry, times, times)
        return trajectory_of_mount(base, MOUNT)

    mounts = np.broadcast_to(MOUNT, (len(times), 3))
    _, ties = final_scans(states, odometry, times, times, mounts)
    return states, scans_of, JointScans(dense(cov), {"r": states}, {"r": ties})


@pytest.mark.parametrize(
    "pair", [(0.0, 5.0), (2.0, 3.0), (0.7, 4.2), (3.4, 4.8), (4.1, 1.9), (5.6, 2.5)]
)
def test_errors_of_states_reach_scans_as_finite_differences_say(pair):
    """At states, between them, between the same two, and after the last one."""
    rng = np.random.default_rng(1)
    root = 0.02 * rng.normal(size=(12, 12))
    cov, odometry = root @ root.T + 1e-6 * np.eye(12), track()
    states, scans_of, joint = joint_of(pair, cov, odometry)
    scans = scans_of(states.poses)
    without = replace(joint.ties["r"], covs=np.zeros((2, 3, 3)))
    found = relative_covariances(
        replace(joint, ties={"r": without}), "r", scans, np.array([[0, 1]])
    )[0]
    before, columns = between(*scans.poses), []
    for k in range(12):
        moved = states.poses.copy()
        step = np.zeros(3)
        step[k % 3] = 1e-6
        moved[k // 3] = compose(moved[k // 3], exp(step))
        columns.append(log(between(before, between(*scans_of(moved).poses))) / 1e-6)
    J = np.array(columns).T
    np.testing.assert_allclose(found, J @ cov @ J.T, atol=1e-4 * np.abs(found).max())


def test_scans_between_the_same_states_share_the_odometry():
    """A scan a moment later is known relative to the one before, however unsure both are; were
    their errors independent, it would not be. At a state odometry adds nothing."""
    _, scans_of, joint = joint_of([2.0, 3.5, 3.6, 4.0, 5.5], 1e-12 * np.eye(12), track())
    ties, scans = joint.ties["r"], scans_of(joint.states["r"].poses)
    pairs = np.array([[1, 2], [2, 1], [1, 3], [0, 1], [4, 3]])
    near, _, far, one, after = np.trace(
        relative_covariances(joint, "r", scans, pairs)[:, :2, :2], axis1=1, axis2=2
    )
    alone = np.trace(ties.covs[:, :2, :2], axis1=1, axis2=2)
    assert alone[0] == 0.0 and (alone[1:] > 0).all()
    assert near < 0.4 * alone[1] and near < far
    assert one > 0.9 * alone[1] and after > alone[3]


def test_scans_matched_to_the_map_share_what_is_left_of_the_odometry():
    """By K = P C^-1 of both and the bridge's covariance, as by hand: a scan that was matched well
    shares next to nothing with its neighbour, one that was not all. Taken to share P as if that
    were of odometry, two scans 0.1 s apart were known relative to each other better than either
    was matched. Scans at one place, not matched apart, are not apart at all."""
    _, scans_of, joint = joint_of([3.5, 3.6, 3.6, 4.0], 1e-12 * np.eye(12), track())
    ties, scans = joint.ties["r"], scans_of(joint.states["r"].poses)
    C = ties.odometry_covs
    P = C * np.array([0.1, 0.05, 0.05, 1.0])[:, None, None]
    joint = replace(joint, ties={"r": replace(ties, covs=P)})
    pairs = np.array([[0, 1], [1, 0], [1, 2], [0, 3], [3, 0]])
    found = relative_covariances(joint, "r", scans, pairs)
    s, t = ties.share[:2]
    factor = (1 - t) / (1 - s)

    def expected(a, b, kept):
        A = adjoint(between(scans.poses[b], scans.poses[a]))
        cross = A @ (kept * C[a]) @ A.T
        return A @ P[a] @ A.T + P[b] - 2 * cross

    # errors along the other axes differ by how far the scans are apart, which is little here
    near = expected(0, 1, factor * 0.1 * 0.05)
    np.testing.assert_allclose(found[0], near, atol=0.02 * np.abs(near).max())
    assert np.trace(found[0]) > 0.9 * np.trace(P[0] + P[1])
    np.testing.assert_allclose(found[2], 0.0, atol=1e-12)
    far = expected(0, 3, (1 - ties.share[3]) / (1 - s) * 0.1)
    np.testing.assert_allclose(found[3], far, atol=0.02 * np.abs(far).max())
    for one, other, (a, b) in ((found[0], found[1], (0, 1)), (found[3], found[4], (0, 3))):
        turned = adjoint(between(scans.poses[a], scans.poses[b]))
        np.testing.assert_allclose(other, turned @ one @ turned.T, atol=1e-12)


def test_the_root_of_a_back_end_has_the_joint_covariance_of_gtsam():
    """Two robots, landmarks of all kinds, a closure: of every two states, to 1e-6."""
    steps, _ = two_robots(np.random.default_rng(5))
    backend = make("batch")
    for step in steps:
        backend.add(step)
    root = backend.finish().root
    times = [step.time_ns for step in steps]
    states = [(robot, t) for robot in "ab" for t in times]
    expected = backend.state_covariance(states).reshape(len(states), 3, len(states), 3)
    rows = np.concatenate([root.states[robot] for robot in "ab"])[:, None]
    n = len(states)
    pairs = np.array([(a, b) for a in range(n) for b in range(n)])
    maps = np.broadcast_to(np.eye(3), (n, 1, 3, 3))
    _, found = pair_covariances(root, rows, maps, pairs)
    expected = expected.swapaxes(1, 2).reshape(n * n, 3, 3)
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    folder = tmp_path_factory.mktemp("room")
    result = graphslam.smooth(drive(folder / "log.mcap"), output=folder / "result")
    return result, graphslam.load_result(folder / "result")


def test_a_folder_read_back_says_the_same_of_relations(room):
    """And of the causal poses, of which nothing joint is known, nothing."""
    result, saved = room
    scans = result.robots["robot"].scan_final
    pairs = np.array([[0, 1], [0, 40], [17, 3], [59, 30]])
    first = relative_covariances(saved.joint, "robot", saved.robots["robot"].scan_final, pairs)
    joint = JointScans(
        result.estimate.root, result.estimate.states, {"robot": result.robots["robot"].scan_ties}
    )
    np.testing.assert_allclose(
        first, relative_covariances(joint, "robot", scans, pairs), rtol=1e-5, atol=1e-12
    )
    rng = np.random.default_rng(2)
    a, b = rng.integers(len(scans), size=(2, 400))
    noise = rng.normal(size=(400, 3)) * [0.02, 0.02, np.radians(0.35)]
    reference = compose(between(scans.poses[a], scans.poses[b]), noise)
    made = Relations(scans.stamps_ns[a], scans.stamps_ns[b], reference)
    found = evaluate(saved, relations=made)["relations"]["all"]
    assert found == pytest.approx(evaluate(result, relations=made)["relations"]["all"])
    # the reference's noise alone is inside in 95 %, or more often, the more the less is known; of
    # 400 relations the share has a sigma of 1.1 %
    assert 0.917 <= found["trans_inside"] <= 1.0 and 0.917 <= found["rot_inside"] <= 1.0
    unknown = evaluate(replace(saved, joint=None), relations=made)["relations"]["all"]
    assert unknown["trans_inside"] is None and unknown["trans_mean_m"] == found["trans_mean_m"]


def test_relations_far_off_are_outside(room):
    """By three times what is stated, reference and all."""
    result, saved = room
    scans = result.robots["robot"].scan_final
    a, b = np.arange(0, 40), np.arange(15, 55)
    measured = between(scans.poses[a], scans.poses[b])
    stamps = scans.stamps_ns[a], scans.stamps_ns[b]
    aside = evaluate(saved, relations=Relations(*stamps, compose(measured, [0.3, 0.0, 0.0])))
    assert aside["relations"]["all"]["trans_inside"] == 0.0
    assert aside["relations"]["all"]["rot_inside"] == 1.0
    turned = evaluate(saved, relations=Relations(*stamps, compose(measured, [0.0, 0.0, 0.1])))
    assert turned["relations"]["all"]["rot_inside"] == 0.0
