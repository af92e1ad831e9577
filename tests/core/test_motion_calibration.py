"""Calibration of motion sources: what each parameter means, and what is known of it beforehand."""

from dataclasses import replace

import numpy as np
import pytest
from finite_differences import jacobian

from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.geometry import exp
from graphslam.core.motion_models import (
    MAX_CURVATURE_PER_M,
    MOTION_SOURCES,
    Calibration,
    Increments,
    compound,
    model_error_cov,
    nominal_calibration,
    parameter_cov,
    rows_of_twists,
    wheel_twist,
)

ROBOT = RobotConfig(wheel_radius_left_m=0.11, wheel_radius_right_m=0.1, axle_m=0.6)
NOISE = OdometryConfig()
#: twists forwards, sideways, backwards, turning either way, and the seconds that they took
ROWS = np.array([
    [0.4, 0.03, 0.2, 1.0], [-0.3, -0.02, -0.5, 2.0], [0.2, 0.1, 0.0, 0.5], [0.1, 0.0, -0.3, 1.5],
])  # fmt: skip
LEARNED = np.array([0.04, -0.06, 0.05, 0.02])


def made(source, rows, calibration, config=NOISE):
    return MOTION_SOURCES[source](np.asarray(rows, float), calibration, ROBOT, config)


@pytest.mark.parametrize("source", ["odometry", "commands", "wheels"])
def test_the_derivative_by_calibration_holds_where_it_was_learned(source):
    """At values that are not nominal, of every increment and of every parameter."""
    rows = rows_of_twists("wheels", ROWS[:, :3], ROBOT) if source == "wheels" else ROWS
    at = LEARNED[:3] * 0.1 if source == "wheels" else LEARNED[: 3 + (source == "commands")]
    numeric = jacobian(lambda c: made(source, rows, c).delta.ravel(), at)
    found = made(source, rows, at).d_cal
    np.testing.assert_allclose(found.reshape(-1, len(at)), numeric, atol=1e-6)


@pytest.mark.parametrize("source", ["odometry", "commands"])
def test_scales_and_drift_mean_what_their_names_say(source):
    """Translation by its scale in both directions, turning by its own, and by so much per metre
    driven FORWARDS: in reverse it turns the other way, sideways not at all."""
    scale, turn_scale, drift = LEARNED[:3]
    expected = ROWS[:, :3] * [1 + scale, 1 + scale, 1 + turn_scale]
    expected[:, 2] += drift * ROWS[:, 0]
    nominal = np.append(LEARNED[:3], [0.0] * (source == "commands"))
    found = made(source, ROWS, nominal)
    np.testing.assert_allclose(found.delta, exp(expected), atol=1e-15)
    # the white noise is that of what was reported, and of how long it took
    np.testing.assert_allclose(
        found.cov, model_error_cov(ROWS[:, :3], ROWS[:, 3], NOISE), atol=1e-18
    )


def test_the_turning_loss_grows_with_the_squared_curvature_up_to_a_limit():
    """A path of 0.1 m on a circle of radius 1/k is shorter by 0.1 loss k²; robots that turn more
    tightly than 6/m hardly drive, and lose no more than at 6/m. On the spot nothing is lost."""
    loss = 0.01
    for curvature, effective in ((1.0, 1.0), (-2.5, 2.5), (5.9, 5.9), (7.0, 6.0), (40.0, 6.0)):
        row = np.array([[0.1, 0.0, 0.1 * curvature, 1.0]])
        found = made("commands", row, np.array([0.0, 0.0, 0.0, loss])).delta[0]
        path = 0.1 * (1 - loss * effective**2)
        np.testing.assert_allclose(found, exp(np.array([path, 0.0, row[0, 2]])), atol=1e-15)
    assert MAX_CURVATURE_PER_M == 6.0
    on_the_spot = made("commands", [[0.0, 0.0, 0.8, 1.0]], LEARNED).delta[0]
    np.testing.assert_allclose(on_the_spot, [0, 0, 0.8 * (1 + LEARNED[1])], atol=1e-12)
    sideways = made("commands", [[0.06, 0.08, 0.2, 1.0]], np.array([0, 0, 0, loss])).delta[0]
    shorter = 1 - loss * 2.0**2  # 0.2 rad in 0.1 m
    np.testing.assert_allclose(
        sideways, exp(np.array([0.06 * shorter, 0.08 * shorter, 0.2])), atol=1e-15
    )


@pytest.mark.parametrize("source", ["wheels", "odometry", "commands"])
def test_rows_of_twists_are_what_a_source_reports_of_them(source):
    """Wheels that turn so make that twist; 0 s in motion, so no noise of time."""
    rows = rows_of_twists(source, ROWS[:, :3] * [1, 0, 1], ROBOT)
    np.testing.assert_array_equal(rows[:, -1], 0.0)
    found = wheel_twist(rows[:, :2], ROBOT) if source == "wheels" else rows[:, :3]
    np.testing.assert_allclose(found, ROWS[:, :3] * [1, 0, 1], atol=1e-16)
    p = 3 + (source == "commands")
    delta = made(source, rows, np.zeros(p)).delta
    np.testing.assert_allclose(delta, exp(ROWS[:, :3] * [1, 0, 1]), atol=1e-15)


def test_the_model_error_of_a_sideways_motion_is_that_of_its_path():
    config = replace(NOISE, k_x_m=1.0, k_y_m=2.0, k_phi_m=3.0)
    ahead, aside = model_error_cov(np.array([[0.5, 0, 0.1], [0.3, 0.4, 0.1]]), np.zeros(2), config)
    np.testing.assert_allclose(aside, ahead, rtol=1e-12)


@pytest.mark.parametrize("source", ["wheels", "odometry"])
def test_a_robot_that_stands_has_no_noise_of_parameters(source):
    """Neither of its counts: a robot that turns one wheel only has."""
    config = replace(NOISE, count_sigma_rad=0.05)
    still, one = np.zeros((2, 3)), np.zeros((2, 3))
    one[1, :] = [0.3, 0, 1.0] if source == "wheels" else wheel_twist(np.array([[0.3, 0]]), ROBOT)[0]
    np.testing.assert_array_equal(parameter_cov(source, still, ROBOT, config), 0.0)
    first, second = parameter_cov(source, one, ROBOT, config)
    np.testing.assert_array_equal(first, 0.0)
    assert second[2, 2] > 0


def test_the_length_of_a_chain_is_that_of_its_path():
    """Not of its chord: forth and back is twice the way."""
    delta = np.array([[0.3, 0.4, 1.0], [-0.3, 0.4, 0.0], [0.0, 0.0, 2.0]])
    parts = Increments(delta, np.zeros((3, 3, 3)), np.zeros((3, 3, 0)))
    assert compound(parts).length_m == pytest.approx(1.0)


# ------------------------------------------------------------ what is known beforehand


PRIORS = {
    "translation_scale": ("translation_scale_sigma", 0.011),
    "rotation_scale": ("rotation_scale_sigma", 0.012),
    "drift_rad_per_m": ("drift_sigma_rad_per_m", 0.013),
    "wheel_radius_left_m": ("wheel_radius_sigma_m", 0.014),
    "wheel_radius_right_m": ("wheel_radius_sigma_m", 0.014),
    "axle_m": ("axle_sigma_m", 0.015),
    "laser_x_m": ("laser_sigma_m", 0.016),
    "laser_y_m": ("laser_sigma_m", 0.016),
    "laser_yaw_rad": ("laser_sigma_rad", 0.017),
    "laser_latency_s": ("laser_latency_sigma_s", 0.018),
}


@pytest.mark.parametrize("mounted", [False, True])
@pytest.mark.parametrize("source", ["odometry", "commands", "wheels"])
def test_priors_are_the_sigmas_of_the_settings(source, mounted):
    """By name and in the order of the parameters; d²/2 for the lever d of the turning loss."""
    config = replace(NOISE, turning_lever_sigma_m=0.3, **dict(PRIORS.values()))
    found = nominal_calibration(source, config, mounted)
    expected = [0.3**2 / 2 if n == "turning_loss_m2" else PRIORS[n][1] for n in found.names]
    np.testing.assert_allclose(found.cov, np.diag(expected) ** 2, rtol=1e-12)
    np.testing.assert_array_equal(found.mean, 0.0)
    assert ("laser_yaw_rad" in found.names) is mounted
    held = replace(config, fixed_calibration=(found.names[0],), axle_sigma_m=0.0)
    sigmas = np.sqrt(np.diag(nominal_calibration(source, held, mounted).cov))
    is_held = [n in (found.names[0], "axle_m") for n in found.names]
    np.testing.assert_allclose(sigmas, np.where(is_held, 1e-9, expected), rtol=1e-12)


def test_with_noise_that_is_drawn_anew_only_the_sensor_is_calibrated():
    config = replace(NOISE, parameter_noise="white")
    found = nominal_calibration("odometry", config, True)
    free = np.diag(found.cov) > 1e-12
    assert [n for n, one in zip(found.names, free, strict=True) if one] == [
        "laser_x_m", "laser_y_m", "laser_yaw_rad", "laser_latency_s",
    ]  # fmt: skip


def test_a_parameter_that_is_held_keeps_its_value_or_is_zero_and_has_no_sigma():
    """Covariances stay positive definite; what was correlated with a parameter at zero is not."""
    known = Calibration(("a", "b", "c"), np.array([1.0, 2.0, 3.0]), np.eye(3) + 0.3)
    held = known.held()
    np.testing.assert_array_equal(held.mean, known.mean)
    np.testing.assert_allclose(held.cov, 1e-18 * np.eye(3))
    some = known.at_zero([0, 2])
    np.testing.assert_array_equal(some.mean, [0.0, 2.0, 0.0])
    np.testing.assert_allclose(some.cov, np.diag([1e-24, 1.3, 1e-24]))
    np.testing.assert_array_equal(known.mean, [1.0, 2.0, 3.0])
    assert known.cov[0, 2] == 0.3
