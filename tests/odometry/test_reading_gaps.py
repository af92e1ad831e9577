"""Poses while odometry is silent."""

import numpy as np
import pytest

import graphslam
from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.geometry import compose, exp
from graphslam.core.records import OdometryPose
from graphslam.logs import LogWriter
from graphslam.odometry.missing_increments import VELOCITY_GROWTH
from graphslam.odometry.preintegration import Track
from graphslam.odometry.reading_gaps import covs_in_gaps

S = 1_000_000_000
STEP = S // 10
TWIST = np.array([0.05, 0.0, 0.02])


def track_with_gap(seconds, twist=TWIST):
    """Poses at 10 Hz for a second on both sides of a gap."""
    track = Track(OdometryConfig(), RobotConfig())
    for k in (*range(11), *range(10 + 10 * seconds, 21 + 10 * seconds)):
        track.add(OdometryPose("r", k * STEP, k * STEP, exp(k * twist)))
    return track


def test_the_variance_in_a_gap_is_that_of_a_walking_velocity_tied_at_both_ends():
    """A bridge of noise that is white, s (1 - s), would be a third of the path off at its ends."""
    n, seconds = 400, 4.0
    rng = np.random.default_rng(0)
    dt = seconds / n
    velocity = np.cumsum(np.sqrt(VELOCITY_GROWTH * dt) * rng.normal(size=(4000, n)), axis=1)
    way = dt * np.cumsum(velocity, axis=1)
    ends = np.column_stack([velocity[:, -1], way[:, -1]])
    found = covs_in_gaps(track_with_gap(4), S + np.array([1, 2, 3]) * S)[:, 0, 0]
    for place, variance in zip((0.25, 0.5, 0.75), found, strict=True):
        there = way[:, int(place * n) - 1]
        left = there - ends @ np.linalg.lstsq(ends, there, rcond=None)[0]
        # 4000 draws know a variance to 2 %, steps of 10 ms to 1 %
        assert variance == pytest.approx(left.var(), rel=0.1)


def test_nothing_is_added_at_readings_and_where_the_robot_stands():
    """Some drivers publish nothing while the robot stands: it is where it was."""
    track = track_with_gap(4)
    assert not covs_in_gaps(track, np.append(track.times, [S // 2, 20 * S])).any()
    assert not covs_in_gaps(track_with_gap(4, np.zeros(3)), np.array([3 * S])).any()


@pytest.mark.parametrize("stands", [False, True])
def test_no_pose_is_reported_in_a_long_gap_in_which_the_robot_moved(tmp_path, stands):
    """They were on one arc between both ends, 2 m off with sigmas of 0.03 m."""
    points = np.array([[3.0, 2.0], [-3.0, 2.0], [0.5, -4.0]])
    poses = [np.zeros(3)]
    for k in range(400):
        moving = not (stands and 100 <= k < 300)
        poses.append(compose(poses[-1], exp(moving * np.array([0.03, 0.0, 0.04 * np.sin(k / 7)]))))
    with LogWriter(tmp_path / "gap.mcap") as log:
        for k, pose in enumerate(poses):
            if 100 < k < 300:
                continue
            log.odometry("r", k * STEP, pose)
            for name, point in enumerate(points):
                away = point - pose[:2]
                z = np.arctan2(away[1], away[0]) - pose[2], np.hypot(*away)
                log.sighting("r", k * STEP, z, np.diag([1e-4, 1e-4]), identity=str(name))
    final = graphslam.smooth(tmp_path / "gap.mcap").robots["r"].final
    inside = (final.stamps_ns > 100 * STEP) & (final.stamps_ns < 300 * STEP)
    assert inside.any() == stands and len(final.stamps_ns) >= 200
