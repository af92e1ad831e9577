"""Odometry made of scans: where it leads, what it does not know, and logs that have no other."""

from dataclasses import replace

import numpy as np
import pytest
from room_log import START_NS, S, drive, true_pose
from walls import AROUND, CORRIDOR, L_ROOM, cast, rectangles

from graphslam.core.config import Config
from graphslam.core.config_io import load_config
from graphslam.core.geometry import between, compose, exp
from graphslam.core.records import OdometryIncrement, OdometryPose, Scan, Truth
from graphslam.logs import open_logs
from graphslam.odometry.laser_odometry import with_laser_odometry
from graphslam.slam.smooth import smooth

STEP = AROUND[1] - AROUND[0]
NOWHERE = np.zeros(3)
#: of a robot that drives and turns
TWIST = np.array([0.4, 0.0, 0.3])


def scans_along(walls, poses, period_s=0.2, seed=0, limit=20.0):
    """Scans once around, with 1 cm of noise, from each of some poses."""
    rng = np.random.default_rng(seed)
    return [
        Scan(
            "r", k, round(k * period_s * S),
            cast(walls, AROUND, pose, limit) + rng.normal(0, 0.01, len(AROUND)),
            AROUND[0], STEP, NOWHERE,
        )
        for k, pose in enumerate(poses)
    ]  # fmt: skip


def increments(messages):
    """The increments among what `with_laser_odometry` makes of messages of robot r."""
    made = with_laser_odometry(messages, {"r"}, Config())
    return [m for m in made if isinstance(m, OdometryIncrement)]


def end(found):
    """The last pose (3,) in the frame of the first, and its variances (3,) if errors just add."""
    pose = np.zeros(3)
    for one in found:
        pose = compose(pose, one.delta)
    return pose, sum(np.diag(one.cov) for one in found)


@pytest.mark.parametrize("seed", range(3))
def test_scans_tell_how_a_robot_moved(seed):
    """To 2 cm and 0.01 rad after 2.4 m and a quarter of a turn, within what is stated, which is
    not more than 0.2 m: nothing else tells."""
    poses = [compose(np.array([-3.0, -2.0, 0.3]), exp(TWIST * 0.2 * k)) for k in range(31)]
    pose, variances = end(increments(scans_along(L_ROOM, poses, seed=seed)))
    off = pose - between(poses[0], poses[-1])
    assert np.hypot(off[0], off[1]) < 0.02 and abs(off[2]) < 0.01
    assert np.all(off**2 < 9 * variances) and np.all(variances < 0.2**2)


@pytest.mark.parametrize("seed", range(2))
def test_scans_that_are_stamped_in_bursts_are_where_they_were_made(seed):
    """Three stamps 1 ms apart after each 0.6 s, of scans that were made all 0.2 s, 8 cm apart: each
    to 3 cm, three times its noise. Held by what was predicted for 1 ms they were 7 cm off."""
    poses = [compose(np.array([-3.0, -2.0, 0.3]), exp(TWIST * 0.2 * k)) for k in range(31)]
    scans = scans_along(L_ROOM, poses, seed=seed)
    late = [round((0.6 * (k // 3) + 0.001 * (k % 3)) * S) for k in range(len(scans))]
    found, pose = [], np.zeros(3)
    for one in increments(
        replace(scan, time_ns=time_ns) for scan, time_ns in zip(scans, late, strict=True)
    ):
        pose = compose(pose, one.delta)
        found.append(pose)
    off = np.array(found) - between(poses[0], np.array(poses[1:]))
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.03


def test_a_robot_that_stands_stays_where_it_is():
    """Two hundred scans of one place: 5 mm. Increments that were added up would be off by more."""
    pose, _ = end(increments(scans_along(L_ROOM, [np.array([-2.0, 1.0, 0.3])] * 200)))
    assert np.abs(pose).max() < 0.005


def test_along_bare_walls_the_motion_stays_open():
    """Across and in heading it is known. Along them nothing is: what is stated grows with time, to
    metres in 20 s, and covers the three metres driven."""
    poses = [np.array([0.03 * k, 0.2, 0.0]) for k in range(101)]
    pose, variances = end(increments(scans_along(CORRIDOR, poses, limit=15.0)))
    off = pose - between(poses[0], poses[-1])
    assert abs(off[1]) < 0.05 and abs(off[2]) < 0.02
    assert variances[0] > 1.0 and off[0] ** 2 < 9 * variances[0]


def test_walls_that_are_passed_with_a_known_velocity_keep_it():
    """A robot leaves a room for a corridor without a mark: there it goes on as it drove."""
    walls = np.concatenate([CORRIDOR, rectangles((-3, 0.6, -2, 1.0))])
    poses = [np.array([-3.0 + 0.08 * k, 0.0, 0.0]) for k in range(101)]
    pose, _ = end(increments(scans_along(walls, poses, limit=4.0)))
    assert pose[0] == pytest.approx(8.0, abs=1.0)


@pytest.mark.parametrize("step_m", [0.1, 0.2])
@pytest.mark.parametrize("seed", range(2))
def test_a_laser_that_looks_back_sees_the_robot_move_on(seed, step_m):
    """Between two scans as much of the walls beside it comes into view as the robot has moved, and
    a box behind it goes away. If new points spoke against a pose, it would not move at all."""
    walls = np.concatenate([CORRIDOR, rectangles((-5, 0.7, -4.6, 1.0))])
    angles, mount = np.radians(np.arange(-90.0, 91.0)), np.array([-0.3, 0.05, np.pi])
    poses = [np.array([-3.0 + step_m * k, 0.0, 0.0]) for k in range(round(3.0 / step_m) + 1)]
    rng = np.random.default_rng(seed)
    scans = [
        Scan(
            "r", k, round(k * 0.35 * S),
            cast(walls, angles, compose(pose, mount), 8.0) + rng.normal(0, 0.01, len(angles)),
            angles[0], angles[1] - angles[0], mount,
        )
        for k, pose in enumerate(poses)
    ]  # fmt: skip
    pose, _ = end(increments(scans))
    # ten beams see the box: 0.94 to 1.0 of the way was measured, and 0.04 without
    assert pose == pytest.approx([3.0, 0.0, 0.0], abs=0.3)


def test_a_robot_that_was_lost_is_found_by_a_search():
    """Half a metre and 0.6 rad between two scans: farther than points find their counterparts."""
    poses = [np.array([-2.0, 1.0, 0.3])] * 5
    poses += [compose(poses[0], np.array([0.5, -0.2, 0.6]))] * 5
    pose, _ = end(increments(scans_along(L_ROOM, poses)))
    assert pose == pytest.approx([0.5, -0.2, 0.6], abs=0.02)


def test_increments_lead_to_their_scans_and_other_messages_pass():
    """In front of each scan but the first the increment from the one before, all in time order:
    a scan before its odometry would be dropped. Other robots' messages are untouched."""
    poses = [compose(np.zeros(3), exp(TWIST * 0.2 * k)) for k in range(20)]
    own = scans_along(L_ROOM, poses)
    other = [replace(scan, robot="s") for scan in own]
    odometry = [OdometryPose("s", scan.stamp_ns, scan.time_ns, NOWHERE) for scan in own]
    messages = [m for three in zip(odometry, other, own, strict=True) for m in three]
    made = list(with_laser_odometry(iter(messages), {"r"}, Config()))
    assert [m for m in made if not isinstance(m, OdometryIncrement)] == messages
    mine = [m for m in made if m.robot == "r"]
    for before, increment, scan in zip(mine[0:-2:2], mine[1::2], mine[2::2], strict=True):
        assert isinstance(increment, OdometryIncrement) and isinstance(scan, Scan)
        assert (increment.start_ns, increment.time_ns) == (before.time_ns, scan.time_ns)
    assert len(mine) == 2 * len(own) - 1
    assert list(with_laser_odometry(iter(messages), (), Config())) == messages


# ------------------------------------------------------------ whole logs


def without_odometry(path, **settings):
    """A log of the room, opened without its odometry, and the configuration."""
    topics = 'logs.topics={"/scan"="robot", "/truth"="robot"}'
    config = load_config(overrides=[topics, *(f"{k}={v}" for k, v in settings.items())])
    return open_logs([path], config), config


def test_a_log_without_odometry_is_smoothed(tmp_path):
    """As any other: 2 cm off at most, within the covariances; the summary says where the odometry
    came from, and there is none to calibrate."""
    log, config = without_odometry(drive(tmp_path / "log.mcap"))
    result = smooth(log, config)
    (robot,) = result.robots.values()
    seconds = (robot.final.stamps_ns - START_NS) / S
    truth = np.array([true_pose(t) for t in seconds])
    off = robot.final.poses - between(truth[0], truth)
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.02 and len(off) == 61
    nees = np.einsum(
        "ni,nij,nj->n", off[1:, :2], np.linalg.inv(robot.final.covs[1:, :2, :2]), off[1:, :2]
    )
    assert nees.mean() / 2 < 2.0
    assert result.summary["odometry"]["robot"]["source"] == "scans"
    assert not result.summary["calibration"]
    assert any("no odometry: scan matching of /scan" in line for line in result.summary["warnings"])
    # nobody stated how noisy motions by scans are
    assert not any("of what is stated" in w for w in result.summary["warnings"])


@pytest.mark.parametrize("backend", ["dead-reckoning", "isam2"])
def test_other_back_ends_take_scans_for_odometry_too(backend, tmp_path):
    """By scan matching alone: 5 cm."""
    log, config = without_odometry(drive(tmp_path / "log.mcap"), **{"backend.name": f'"{backend}"'})
    (robot,) = smooth(log, config).robots.values()
    last = true_pose((robot.final.stamps_ns[-1] - START_NS) / S)
    off = robot.final.poses[-1] - between(true_pose(0.0), last)
    assert np.hypot(off[0], off[1]) < 0.05


def test_a_start_from_truth_needs_no_odometry(tmp_path):
    """The truth nearest to the first scan."""
    log, config = without_odometry(drive(tmp_path / "log.mcap"), **{"start.from_truth": "true"})
    (robot,) = smooth(log, config).robots.values()
    (first, *_) = (m for m in log.messages() if isinstance(m, Truth))
    assert robot.final.poses[0] == pytest.approx(first.pose, abs=0.03)
