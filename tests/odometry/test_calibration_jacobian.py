"""What a calibration changes in motions is told by how the robot moved, not by noisy odometry."""

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.geometry import between, compose, exp
from graphslam.core.motion_models import rows_of_twists
from graphslam.core.records import OdometryPose, Trajectory, WheelAngles
from graphslam.odometry.calibration_jacobian import (
    CalibratedSource,
    along_estimated_path,
    at_estimated_motion,
)
from graphslam.odometry.preintegration import Track

S = 1_000_000_000
ROBOT = RobotConfig(wheel_radius_left_m=0.11, wheel_radius_right_m=0.1, axle_m=0.6)
#: of a reading, ten in a second: a circle with a radius of 3 m
TWIST, NOISE = np.array([0.05, 0.0, 0.05 / 3]), np.array([0.003, 0.0, 0.005])
MOUNT = np.array([0.4, -0.1, 0.3])
READINGS, STATE_EVERY = 1000, 5


def track_of(source, twists, mount):
    """Odometry of the given twists; a sensor that is mounted so, if it is."""
    track = Track(OdometryConfig(), ROBOT, mounted=mount is not None)
    times = (np.arange(len(twists) + 1) * (S // 10)).tolist()
    if source == "wheels":
        turns = rows_of_twists("wheels", twists, ROBOT)[:, :2]
        angles = np.concatenate([np.zeros((1, 2)), np.cumsum(turns, axis=0)])
        readings = [WheelAngles("r", t, t, *a) for t, a in zip(times, angles.tolist(), strict=True)]
    else:
        poses = [np.zeros(3)]
        for motion in exp(twists):
            poses.append(compose(poses[-1], motion))
        readings = [OdometryPose("r", t, t, pose) for t, pose in zip(times, poses, strict=True)]
    for reading in readings:
        track.add(reading)
    if mount is not None:
        mean = track.calibration.mean.copy()
        mean[-4:-1] = mount
        track.calibration = replace(track.calibration, mean=mean)
    return track


@pytest.mark.parametrize("mount", [None, np.zeros(3), MOUNT], ids=["base", "centred", "mounted"])
@pytest.mark.parametrize("source", ["poses", "wheels"])
def test_noise_of_odometry_is_not_in_what_calibration_changes(source, mount):
    """On a circle nothing tells turning too much from turning per metre driven, so both columns are
    in proportion; those of noisy odometry are not, and residuals of the same noise have scales that
    end at -1. What is left is of second order, and of where in a motion the noise was: a fifth of
    what noise makes of the derivative at most."""
    rng = np.random.default_rng(0)
    twists = np.tile(TWIST, (READINGS, 1))
    true = track_of(source, twists, mount)
    noisy = track_of(source, twists + NOISE * rng.normal(size=twists.shape), mount)
    ends = np.arange(1, READINGS // STATE_EVERY) * STATE_EVERY * (S // 10)
    without, measured = (track.motions(ends[:-1], ends[1:]) for track in (true, noisy))
    made = at_estimated_motion(
        CalibratedSource.of(noisy), measured.delta, measured.d_cal, without.delta
    )
    parameters = slice(0, noisy.increment_parameters + 3 * (mount is not None))
    off = (measured.d_cal - without.d_cal)[:, :, parameters]
    left = (made - without.d_cal)[:, :, parameters]
    assert np.abs(off).max() > 0.0
    assert np.sqrt(np.mean(left**2)) < 0.2 * np.sqrt(np.mean(off**2))
    # the same noise in the residuals: what a column seems to explain of them
    residual = between(measured.delta, without.delta)
    size = np.abs(np.einsum("nip,ni->p", off, residual))
    assert (np.abs(np.einsum("nip,ni->p", left, residual)) <= 0.2 * size + 1e-9).all()


def test_noise_of_odometry_is_not_in_what_a_latency_changes():
    """A latency moves both ends of a motion by the velocities there. Those of noisy odometry are in
    its residual as well: where a time lies between two readings, half of the noise of one, so that
    latencies at which all times do so look likelier. Velocities around states of the estimate are
    smooth instead: they follow those of a turn that takes seconds to a tenth."""
    t = np.arange(READINGS) * 0.1
    true = np.column_stack([0.05 + 0.02 * np.sin(0.5 * t), 0 * t, 0.05 * np.sin(0.3 * t)])
    noise = NOISE * np.random.default_rng(0).normal(size=true.shape)
    exact, noisy = (
        track_of("poses", true, np.zeros(3)),
        track_of("poses", true + noise, np.zeros(3)),
    )
    ends = np.arange(2, READINGS // STATE_EVERY) * STATE_EVERY * (S // 10)
    states = Trajectory(ends, exact.pose(ends), np.zeros((len(ends), 3, 3)))
    begin, end = ends[:-1], ends[1:]
    wanted = exact.motions(begin, end).d_cal[:, :, -1]
    found = noisy.motions(begin, end)
    measured = found.d_cal[:, :, -1]
    made = along_estimated_path(noisy, begin, end, found, states)[:, :, -1]
    inner = slice(2, -2)  # at its ends the path is not known on both sides

    def off(one):
        return np.sqrt(np.mean((one - wanted)[inner] ** 2) / np.mean(wanted[inner] ** 2))

    assert off(made) < 0.15 < 1.0 < off(measured)
