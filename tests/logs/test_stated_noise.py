"""Noise that nav_msgs/Odometry states: used if the fields are filled in sensibly."""

import numpy as np
import pytest

from graphslam.core.config import Config, OdometryConfig
from graphslam.core.geometry import compose, exp
from graphslam.logs import LogWriter, open_logs
from graphslam.odometry.noise_estimation import motion_variances, without_floors
from graphslam.pipeline.robot_settings import make_tracks

PERIOD_NS = 100_000_000
SIGMAS = np.array([0.05, 0.01, 0.08])
SENSIBLE = tuple((SIGMAS**2).tolist())


def log_of(path, variances, *, moving=True, n=200):
    """A log whose k-th reading states ``variances(k)``; every other second the robot stands."""
    pose = np.zeros(3)
    with LogWriter(path) as log:
        for k in range(n):
            if moving and k // 10 % 2:
                pose = compose(
                    pose, exp(np.array([0.03 + 0.02 * np.cos(k), 0.0, 0.01 * np.sin(k)]))
                )
            log.odometry("robot", PERIOD_NS * (k + 1), pose, twist_variances=variances(k))
    return open_logs([path], Config())


def test_noise_of_velocities_becomes_that_of_motions(tmp_path):
    """An error of the velocity of one reading lasts for its interval."""
    log = log_of(tmp_path / "log.mcap", lambda _k: SENSIBLE)
    track = make_tracks(log, Config())["robot"]
    for message in log.messages():
        track.add(message)
    begin, end = np.array([10 * PERIOD_NS]), np.array([20 * PERIOD_NS])
    (variances,) = motion_variances([(track, begin, end)], [without_floors(track.config)])[0]
    assert np.sqrt(variances[[0, 2]]) == pytest.approx(0.1 * np.sqrt(10) * SIGMAS[[0, 2]], rel=0.1)
    assert track.config.k_phi_s == pytest.approx(SENSIBLE[2] * 0.1, rel=0.01)


def test_first_messages_may_state_no_noise(tmp_path):
    """A driver that has no covariances yet. Two readings of 200: nine tenths of them state it."""
    log = log_of(tmp_path / "log.mcap", lambda k: SENSIBLE if k > 1 else (0.0, 0.0, 0.0))
    assert log.stated_noise("robot") is not None


def test_noise_that_grows_with_speed_is_fitted_as_such(tmp_path):
    def growing(k):
        return tuple((1e-4 + 1e-3 * abs(np.sin(k)) * (np.array([1.0, 1.0, 4.0]))).tolist())

    stated = log_of(tmp_path / "log.mcap", growing).stated_noise("robot")
    config = make_tracks(log_of(tmp_path / "again.mcap", growing), Config())["robot"].config
    assert config.k_phi_rad > 0.0
    turn, seconds = np.abs(stated.twists[:, 2]), stated.seconds
    path = np.hypot(*stated.twists[:, :2].T)
    fitted = config.k_phi_m * path + config.k_phi_rad * turn + config.k_phi_s * seconds
    assert fitted == pytest.approx(stated.variances[:, 2], rel=0.02)


@pytest.mark.parametrize(
    "variances",
    [
        (0.0, 0.0, 0.0),  # ROS: unknown
        (1e-9, 1e-9, 1e-9),
        (1e-3, 1e-9, 1e6),
        (1e-3, 1e-3, 1e3),
        (0.01, 0.01, 0.01),  # metres and radians alike
        (0.01, 0.01, -0.02),
        (0.01, float("nan"), 0.02),
    ],
)
def test_placeholders_say_nothing(tmp_path, variances):
    log = log_of(tmp_path / "log.mcap", lambda _k: variances)
    assert log.stated_noise("robot") is None
    assert make_tracks(log, Config())["robot"].config.k_x_m == OdometryConfig().k_x_m


def test_what_a_driver_writes_at_rest_does_not_count(tmp_path):
    """Some state next to nothing while the robot stands; half of the motions is not most."""

    def at_rest(k):
        return SENSIBLE if k // 10 % 2 else (1e-9, 1e-9, 1e-9)

    def sometimes(k):
        return SENSIBLE if k % 2 or k == 0 else (0.0, 0.0, 0.0)

    assert log_of(tmp_path / "rest.mcap", at_rest).stated_noise("robot") is not None
    assert log_of(tmp_path / "some.mcap", sometimes).stated_noise("robot") is None
    assert (
        log_of(tmp_path / "s.mcap", lambda _k: SENSIBLE, moving=False).stated_noise("robot") is None
    )


def test_settings_come_before_what_messages_state(tmp_path):
    log = log_of(tmp_path / "log.mcap", lambda _k: SENSIBLE)
    given = Config(odometry=OdometryConfig(k_x_m=1e-3))
    assert make_tracks(log, given)["robot"].config.k_phi_s == 0.0
