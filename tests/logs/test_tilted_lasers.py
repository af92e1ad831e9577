"""Lasers that are not level: their returns are projected, or the log is refused with a line."""

import numpy as np
import pytest
from room_log import BEAMS, MOUNT, ROOM, START_NS, S, drive, true_pose
from walls import cast

import graphslam
from graphslam.core import records
from graphslam.core.config import Config
from graphslam.core.config_io import load_config
from graphslam.core.errors import LogError
from graphslam.core.geometry import compose
from graphslam.logs import LogWriter, inspect_logs, open_logs, schemas
from graphslam.logs.cdr_writing import odometry_bytes, tf_bytes

HEIGHT = 0.6


def rotation(roll, pitch, yaw):
    """Matrix and quaternion of turns about x, then y, then z."""
    q = np.array([0.0, 0.0, 0.0, 1.0])
    R = np.eye(3)
    for axis, angle in zip((2, 1, 0), (yaw, pitch, roll), strict=True):
        c, s = np.cos(angle), np.sin(angle)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(3)
        turn[i, i] = turn[j, j] = c
        turn[i, j], turn[j, i] = -s, s
        R = R @ turn
        v = np.zeros(3)
        v[axis] = np.sin(angle / 2)
        w = np.cos(angle / 2)
        q = np.append(q[3] * v + w * q[:3] + np.cross(q[:3], v), q[3] * w - q[:3] @ v)
    return R, q


def tilted(path, level, roll=0.0, pitch=0.0, yaw=0.0):
    """The log with a laser that is tilted, at `HEIGHT`; it sees walls and the floor."""
    R, q = rotation(roll, pitch, yaw)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    rays = np.column_stack([np.cos(BEAMS), np.sin(BEAMS), np.zeros(len(BEAMS))]) @ R.T
    flat = np.hypot(rays[:, 0], rays[:, 1])
    with LogWriter(path) as log:
        mount = tf_bytes([(START_NS, "base_link", "laser", (*MOUNT[:2], HEIGHT, *q))])
        log.encoded("/tf_static", schemas.TF_MESSAGE, mount, START_NS)
        for message in open_logs([level], Config()).messages():
            if isinstance(message, records.OdometryPose):
                log.odometry("robot", message.stamp_ns, message.pose)
            elif isinstance(message, records.Scan):
                seconds = (message.stamp_ns - START_NS - 7) / S
                at = compose(true_pose(seconds), [*MOUNT[:2], 0.0])
                angles = np.arctan2(rays[:, 1], rays[:, 0])
                walls = np.array([cast(ROOM, angles[k : k + 1], at, 30.0)[0] for k in range(181)])
                with np.errstate(divide="ignore"):
                    floor = np.where(rays[:, 2] < 0, -HEIGHT / rays[:, 2], np.inf)
                ranges = np.minimum(walls / flat, floor)
                log.scan("robot", message.stamp_ns, ranges, angle_min_rad=float(BEAMS[0]),
                         angle_step_rad=float(np.radians(1)), range_max_m=20.0)  # fmt: skip
    return path


@pytest.fixture(scope="module")
def level(tmp_path_factory):
    return drive(tmp_path_factory.mktemp("level") / "log.mcap", seconds=10, truth=False)


@pytest.mark.parametrize(
    "tilt",
    [{"pitch": -0.2}, {"roll": 0.15, "yaw": 0.3}, {"roll": np.pi - 0.1, "pitch": 0.05}],
    ids=["up", "aside", "on its head"],
)
def test_every_return_of_a_tilted_laser_lies_on_the_wall_that_it_is_of(tilt, level, tmp_path):
    """Read as level the walls would be 2 % farther, and the floor a wall of its own."""
    path = tilted(tmp_path / "log.mcap", level, **tilt)
    log = open_logs([path], Config())
    assert any("projected on the plane" in line for line in log.warnings)
    scans = [m for m in log.messages() if isinstance(m, records.Scan)]
    for scan in scans[::5]:
        at = compose(true_pose((scan.stamp_ns - START_NS - 7) / S), scan.mount)
        expected = cast(ROOM, scan.angles, at, 30.0)
        known = np.isfinite(scan.ranges)
        assert known.sum() > 60
        assert (np.diff(scan.angles) > 0).all()
        np.testing.assert_allclose(scan.ranges[known], expected[known], atol=1e-5)
    assert inspect_logs([path], Config()).doubtful


def test_a_log_with_a_tilted_laser_is_smoothed(level, tmp_path):
    path = tilted(tmp_path / "log.mcap", level, pitch=-0.2)
    result = graphslam.smooth(path).robots["robot"].final
    expected = graphslam.smooth(level).robots["robot"].final
    np.testing.assert_allclose(result.poses, expected.poses, atol=0.05)


def test_a_laser_that_looks_down_is_refused_and_what_the_line_says_mends_it(level, tmp_path):
    path = tilted(tmp_path / "log.mcap", level, pitch=np.radians(60))
    with pytest.raises(LogError, match=r"laser.*tilted by 60 deg.*no section of walls.*--set"):
        open_logs([path], Config())
    info = inspect_logs([path], Config())
    assert not info.usable and info.findings[-1].check == "mount"
    assert open_logs([path], load_config(None, ["robots.robot.laser=[0.2, 0, 0]"])).robots


def moved(path, level, *, turn=(0.0, 0.0), lean=0.0):
    """The log with its laser on a link of /tf that turns between two angles, on a base that leans.

    ``turn``: about z, at every second scan the other. ``lean``: pitch of the base, in every pose.
    """
    with LogWriter(path) as log:
        _, level_turn = rotation(0.0, 0.0, 0.0)
        fixed = tf_bytes([(START_NS, "head", "laser", (*MOUNT[:2], HEIGHT, *level_turn))])
        log.encoded("/tf_static", schemas.TF_MESSAGE, fixed, START_NS)
        scans = 0
        for message in open_logs([level], Config()).messages():
            ns = message.stamp_ns
            if isinstance(message, records.OdometryPose):
                _, q = rotation(0.0, lean, message.pose[2])
                data = odometry_bytes(ns, "odom", (*message.pose[:2], 0.0), q, "base_link")
                log.encoded("/odom", schemas.ODOMETRY, data, ns)
            elif isinstance(message, records.Scan):
                scans += 1
                _, q = rotation(0.0, 0.0, turn[scans % 2])
                link = tf_bytes([(ns, "base_link", "head", (0.0, 0.0, 0.0, *q))])
                log.encoded("/tf", schemas.TF_MESSAGE, link, ns)
                log.scan("robot", ns, np.where(np.isnan(message.ranges), 99.0, message.ranges),
                         angle_min_rad=float(BEAMS[0]), angle_step_rad=float(np.radians(1)),
                         range_max_m=20.0)  # fmt: skip
    return path


def test_a_laser_on_a_link_that_turns_is_refused_with_the_link(level, tmp_path):
    """Read where the base is, each of its scans would be turned by another angle."""
    path = moved(tmp_path / "log.mcap", level, turn=(0.0, 0.5))
    with pytest.raises(LogError, match=r"moves on the robot: head in base_link on /tf.*--set"):
        open_logs([path], Config())
    assert not inspect_logs([path], Config()).usable
    assert open_logs([path], load_config(None, ["robots.robot.laser=[0.2, 0, 0]"])).robots


def test_a_link_that_shakes_carries_the_laser_where_it_is(level, tmp_path):
    """A base on springs: not "no transform", and not at the base."""
    log = open_logs([moved(tmp_path / "log.mcap", level, turn=(0.0, 0.01))], Config())
    scan = next(m for m in log.messages() if isinstance(m, records.Scan))
    np.testing.assert_allclose(scan.mount, MOUNT, atol=0.011)
    assert not any("laser" in line for line in log.warnings)


@pytest.mark.parametrize(("lean", "said"), [(0.0, False), (0.03, False), (0.1, True)])
def test_a_base_that_leans_is_said_to(lean, said, level, tmp_path):
    path = moved(tmp_path / "log.mcap", level, lean=lean)
    log = open_logs([path], Config())
    assert any("the base leans by up to 6 deg" in line for line in log.warnings) == said
    assert inspect_logs([path], Config()).doubtful == said
    poses = [m.pose for m in log.messages() if isinstance(m, records.OdometryPose)]
    plain = [m.pose for m in open_logs([level], Config()).messages() if hasattr(m, "pose")]
    np.testing.assert_allclose(poses, plain, atol=1e-12)
