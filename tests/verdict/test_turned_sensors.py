"""Sensors that look elsewhere than their mount says, by the direction in which the robot drives."""

import numpy as np
import pytest

import graphslam
from graphslam.core.config import Config, OdometryConfig
from graphslam.core.geometry import between, compose
from graphslam.logs import LogWriter
from graphslam.verdict.turned_sensors import LARGE, LEAST, PIECE_M, TOLD_RAD, driven_aside

S = 1_000_000_000


def driven(steps, turn_noise=0.0, seed=0):
    """Poses (n, 3) along steps (n - 1, 3), with noise of their turning, rad."""
    rng = np.random.default_rng(seed)
    poses = [np.zeros(3)]
    for step in steps:
        poses.append(compose(poses[-1], step + np.array([0, 0, turn_noise * rng.normal()])))
    return np.array(poses)


def winding(n):
    """Steps (n, 3) of 0.1 m that turn to and fro, more to the left."""
    k = np.arange(n)
    return np.column_stack([np.full(n, 0.1), np.zeros(n), 0.05 + 0.1 * np.sin(k / 9)])


@pytest.mark.parametrize("off", [0.0, 0.05, -0.03])
def test_the_angle_is_found_whatever_the_heading_of_odometry_does(off):
    """Breaks if turning, or odometry whose heading drifts by radians, is taken for the angle."""
    true = driven(winding(600))
    odometry = driven(winding(600), turn_noise=0.02, seed=1)
    assert abs(odometry[-1, 2] - true[-1, 2]) > 0.1
    # a sensor whose bearings are too large by `off` has the robot's heading too small by it
    estimated = true - np.array([0.0, 0.0, off])
    times = np.arange(len(true)) * S // 5
    angle, sigma = driven_aside(times, odometry, estimated)
    # of a chord of 0.3 m the heading is good to 0.02 rad, of 200 of them to a tenth of that
    assert sigma < 0.004
    assert abs(angle - off) < 4 * sigma


def test_robots_that_hardly_drive_say_nothing():
    """Breaks if a direction is made of noise."""
    poses = driven(winding(int(LEAST * PIECE_M / 0.1) - 10))
    assert driven_aside(np.arange(len(poses)) * S, poses, poses) is None


def log_of(path, off):
    """One robot among named points, 60 s; its bearings are ``off`` by so much, rad."""
    rng = np.random.default_rng(3)
    points = rng.uniform((-6, -3), (6, 9), (20, 2))
    true, odometry = np.zeros(3), np.zeros(3)
    with LogWriter(path) as log:
        for k in range(600):
            stamp = S + k * S // 10
            log.odometry("r", stamp, odometry)
            if k % 5 == 0:
                for n, point in enumerate(points):
                    x, y, _ = between(true, np.array([*point, 0.0]))
                    if np.hypot(x, y) < 6.0:
                        z = np.array([np.arctan2(y, x) + off, np.hypot(x, y)])
                        z = z + rng.normal(0, (0.01, 0.03))
                        log.sighting("r", stamp, z, np.diag([1e-4, 9e-4]), identity=f"p{n}")
            step = np.array([0.06, 0.0, 0.02 + 0.03 * np.sin(0.05 * k)])
            true = compose(true, step)
            odometry = compose(odometry, step + rng.normal(0, (0.002, 0.0005, 0.003)))
    return path


def test_a_turned_sensor_is_corrected_and_doubted_if_no_sensor_is_so_far_off(tmp_path):
    """Maps by turned sensors were called good: nothing in the sightings contradicts them."""
    healthy = graphslam.smooth(log_of(tmp_path / "true.mcap", 0.0)).summary["verdict"]
    assert healthy["verdict"] == "good"
    turned = log_of(tmp_path / "turned.mcap", 3 * TOLD_RAD)
    found = graphslam.smooth(turned).summary
    assert found["verdict"]["verdict"] == "good"
    assert any("too far to the left" in warning for warning in found["warnings"])
    held = Config(odometry=OdometryConfig(fixed_calibration=("sighting_yaw_rad",)))
    found = graphslam.smooth(turned, config=held).summary["verdict"]
    assert found["verdict"] == "doubtful"
    assert any("too far to the left" in reason["text"] for reason in found["reasons"])
    far_off = log_of(tmp_path / "far.mcap", 1.3 * LARGE["sighting_yaw_rad"])
    assert graphslam.smooth(far_off).summary["verdict"]["verdict"] != "good"
