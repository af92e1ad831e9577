"""Scans that have no state: where they were, by the walls of the solved map."""

from types import SimpleNamespace

import numpy as np
import pytest
from paths import LOGS

from graphslam.core.config import FrontEndConfig
from graphslam.core.config_io import load_config
from graphslam.core.geometry import wrap
from graphslam.core.records import Estimate, Scan
from graphslam.evaluation.metrics import evaluate
from graphslam.logs import open_logs, read_truth
from graphslam.mapping.landmark_map import Entry
from graphslam.mapping.returns_on_walls import WallTree
from graphslam.pipeline.scans_between import ScansBetween, walls_of_frames
from graphslam.slam.smooth import smooth


@pytest.fixture(scope="module")
def results():
    """Results of the lab's log, with scans between keyframes by the map and by odometry alone."""
    found = {}
    for way in ("map", "odometry"):
        config = load_config(overrides=(f"keyframe.scans_between={way}", "start.from_truth=true"))
        found[way] = smooth(open_logs([LOGS / "lab.mcap"], config), config)
    return found


def test_the_map_tells_where_scans_between_keyframes_looked(results):
    """A third of the errors that odometry leaves, as large as those of keyframes."""
    (truth,) = read_truth([LOGS / "lab.mcap"], load_config()).trajectories.values()
    errors = {}
    for way, result in results.items():
        (robot,) = result.robots.values()
        states = next(iter(result.estimate.states.values())).stamps_ns
        true = np.interp(robot.final.stamps_ns, truth.stamps_ns, np.unwrap(truth.poses[:, 2]))
        off = wrap(robot.final.poses[:, 2] - true)
        has_state = np.isin(robot.final.stamps_ns, states)
        errors[way] = [np.sqrt(np.mean(off[own] ** 2)) for own in (~has_state, has_state)]
    assert errors["map"][0] < 0.4 * errors["odometry"][0]
    assert errors["map"][0] < 2.0 * errors["map"][1]


def test_neither_states_nor_landmarks_move(results):
    """Only trajectories differ, and only where there is no state."""
    a, b = results["map"], results["odometry"]
    for mark, other in zip(a.landmarks, b.landmarks, strict=True):
        np.testing.assert_array_equal(mark.position, other.position)
    ((name, one),) = a.robots.items()
    other = b.robots[name]
    at_states = np.isin(one.final.stamps_ns, a.estimate.states[name].stamps_ns)
    assert 0.1 < at_states.mean() < 0.9
    np.testing.assert_allclose(
        one.final.poses[at_states], other.final.poses[at_states], rtol=0, atol=1e-12
    )
    assert np.all(np.abs(one.final.poses - other.final.poses)[~at_states].max(axis=1) > 0)


def test_what_is_stated_of_them_is_less_and_true(results):
    """Headings given the states are stated better; NEES of the whole path stays below its bound."""
    (one,), (other,) = (r.robots.values() for r in (results["map"], results["odometry"]))
    between = np.trace(other.scan_ties.covs, axis1=1, axis2=2) > 0
    left = one.scan_ties.covs[between, 2, 2] / other.scan_ties.covs[between, 2, 2]
    assert np.median(left) < 0.5
    truth = read_truth([LOGS / "lab.mcap"], load_config()).trajectories
    (robot,) = evaluate(results["map"], truth)["robots"].values()
    assert robot["final"]["nees_per_dof"] < robot["final"]["nees_bounds"][1]


def test_a_robot_is_matched_to_the_walls_of_its_own_frame():
    """Frames that nothing relates lie on each other; points are no walls."""
    entries = {
        n: Entry(n, kind, np.zeros(3), np.eye(3), np.array([-1.0, 1.0]), 0, 1, None)
        for n, kind in ((1, "line"), (2, "segment"), (3, "point"), (4, "line"))
    }
    marks = {n: (np.array([float(n), 0.0, 0.0]), np.eye(3)) for n in (1, 2, 3)}
    frames = {1: "a", 2: "b", 3: "a", 4: "a"}
    found = walls_of_frames(SimpleNamespace(entries=entries), Estimate({}, marks, 0.0, 0), frames)
    assert {name: tree.means[:, 0].tolist() for name, tree in found.items()} == {
        "a": [1.0], "b": [2.0]
    }  # fmt: skip
    # the ends of a line stay where they are if its origin slides along it
    np.testing.assert_allclose(found["a"].extents, [[-2.0, 0.0]])


@pytest.fixture
def standing():
    """Prior poses of scans in a room, of which three are made while it stands; what is found."""
    walls = np.array([[4, 0, 0], [8, 3, np.pi / 2], [4, 6, np.pi], [0, 3, -np.pi / 2]])
    extents = np.array([[-4, 4], [-3, 3], [-4, 4], [-3, 3.0]])
    angles = np.linspace(-np.pi, np.pi, 60, endpoint=False)
    pose, ranges = np.array([3.0, 2.0, 0.5]), np.full(60, np.inf)
    d = np.column_stack([np.cos(pose[2] + angles), np.sin(pose[2] + angles)])
    for x, y, phi in walls:
        n = np.array([-np.sin(phi), np.cos(phi)])
        with np.errstate(divide="ignore"):
            r = ((np.array([x, y]) - pose[:2]) @ n) / (d @ n)
        ranges = np.where(r > 0, np.minimum(ranges, r), ranges)
    kept = ScansBetween()
    for time_ns in (10, 50):
        step = angles[1] - angles[0]
        scan = Scan("r", time_ns, time_ns, ranges, angles[0], step, np.zeros(3))
        kept.add([scan], SimpleNamespace())
    times = np.array([0, 10, 10, 20, 50, 60], dtype=np.int64)
    poses = np.tile(pose + np.array([0.01, -0.01, 0.02]), (6, 1))
    # odometry that is interpolated need not be exactly where the robot stands
    poses[[0, 3, 4, 5], 0] += [-0.1, 1e-4, 0.001, 0.1]
    covs = np.tile(np.diag([0.02, 0.02, 0.02]) ** 2, (6, 1, 1))
    better = kept.matched_to(WallTree.from_walls(walls, extents), FrontEndConfig())
    return poses, better(times, poses, covs)


def test_while_a_robot_stands_it_is_at_one_place(standing):
    """And scans of one stamp are too. Each was once where its own noise put it, in hours by metres
    of path; or where odometry had it, but for the first."""
    poses, (rows, found, left, prior) = standing
    assert rows.tolist() == [1, 2, 3, 4]  # before the first one, and behind the last, it drives
    np.testing.assert_array_equal(found[1:3], found[[0, 0]])
    np.testing.assert_array_equal(left[1:3], left[[0, 0]])
    assert np.all(np.linalg.eigvalsh(prior - left)[:, 0] > 0)  # its returns tell something
    assert np.all(np.abs(found[:, 2] - 0.5) < 0.2 * np.abs(poses[rows, 2] - 0.5))
