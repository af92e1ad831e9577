"""A laser that repeats one scan: its scans are left out once odometry moves, and are said to be."""

import numpy as np
import pytest
from room_log import START_NS, S, drive

from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.config_io import load_config
from graphslam.core.geometry import between, wrap
from graphslam.core.records import OdometryPose, Scan
from graphslam.logs import open_logs
from graphslam.odometry.readings import Readings
from graphslam.pipeline.repeated_scans import RepeatedScans
from graphslam.slam.smooth import smooth

VARIED = np.linspace(1.0, 5.0, 60)


def moving(speed_m_s=0.5, turn_rad_s=0.0):
    track = Readings(OdometryConfig(), RobotConfig())
    for k in range(100):
        pose = np.array([speed_m_s, 0.0, turn_rad_s]) * k / 10
        track.add(OdometryPose("robot", S + k * S // 10, S + k * S // 10, pose))
    return track


def left_out(scans, track):
    """Times, s, of scans (ranges) at 2 Hz that are left out."""
    repeats = RepeatedScans()
    for k, ranges in enumerate(scans):
        time = S + k * S // 2
        scan = Scan("robot", time, time, np.array(ranges, dtype=float), 0.0, 0.1, np.zeros(3))
        repeats.leaves_out(scan, track)
    return [(time - S) / S for time, _ in repeats.left_out]


@pytest.mark.parametrize("track", [moving(), moving(0.0, 0.5)])
def test_repeated_scans_of_a_robot_that_moves_are_left_out_and_what_comes_after_is_not(track):
    other = VARIED + 1e-6
    scans = [other, VARIED, VARIED, VARIED, other, other + 1, VARIED]
    assert left_out(scans, track) == [1.0, 1.5]


def test_missing_returns_do_not_hide_a_repetition():
    scan = np.where(np.arange(60) % 3 == 0, np.nan, VARIED)
    assert left_out([scan, scan], moving()) == [0.5]


@pytest.mark.parametrize(
    ("scan", "track"),
    [
        (VARIED, moving(0.0)),  # it stands
        (VARIED, moving(0.005)),  # odometry creeps
        (np.full(60, 80.0), moving()),  # an empty field, to the largest range
        (np.full(60, np.nan), moving()),
        (np.where(np.arange(60) < 55, np.nan, VARIED), moving()),
    ],
)
def test_scans_that_may_well_be_the_same_are_kept(scan, track):
    assert left_out([scan] * 10, track) == []


@pytest.mark.parametrize("backend", ["batch", "ekf"])
def test_the_result_of_a_frozen_laser_is_that_of_odometry_from_there_on(tmp_path, backend):
    """Taken as they come, the scans say that the robot stands: it is left metres behind."""
    kept = []

    def ranges(found, k):
        kept.append(found)
        return found if k < 12 else kept[12]

    config = load_config(overrides=[f'backend.name="{backend}"'])
    log = open_logs([drive(tmp_path / "log.mcap", seconds=12, ranges=ranges)], config)
    result = smooth(log, config)
    robot, summary = result.robots["robot"], result.summary
    final, odometry = robot.final, robot.dead_reckoning
    late = np.searchsorted(final.stamps_ns, START_NS + 7 * S)
    assert len(final) == 25 and late < 16  # every scan is reported
    for k in range(late, 24):
        ours, its = (between(t.poses[late], t.poses[k + 1]) for t in (final, odometry))
        # the same but for the calibration that the scans before have told
        assert np.hypot(*(ours - its)[:2]) < 0.15 and abs(wrap(ours[2] - its[2])) < 0.15
    assert np.hypot(*between(final.poses[late], final.poses[-1])[:2]) > 2.0
    count = summary["dropped"]["scan: repeats an earlier one while odometry moves"]
    assert count == 12
    told = [reason["text"] for reason in summary["verdict"]["reasons"]]
    assert summary["verdict"]["verdict"] == "doubtful"
    assert any("its laser repeats one scan from 6.0 s on" in text for text in told), told
    assert any(f"{count} scans repeat" in line for line in summary["warnings"])
