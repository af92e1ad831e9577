"""True motion to encoder counts, and encoder counts to the robot's odometry."""

import numpy as np

from graphslam.core.config import RobotConfig
from graphslam.core.geometry import Array, compose, exp
from graphslam.core.motion_models import wheel_twist
from graphslam.simulation.drive import BaseStates
from graphslam.simulation.scenario import Encoders, Gyroscope


def wheel_angles(states: BaseStates, encoders: Encoders, rng: np.random.Generator) -> Array:
    """Accumulated wheel angles (n, 2) rad, left and right, as read at n successive states.

    Wheels have the true radii and the true axle length; slip is rolled path without motion of the
    base. Readings are whole counts from an unknown initial angle of the wheel.
    """
    half = encoders.axle_m * (1 + encoders.axle_error) / 2
    turned = (1 + encoders.turn_slip) * states.turned
    rolled = states.travel[:, None] + half * turned[:, None] * np.array([-1.0, 1.0])
    step = np.abs(np.diff(rolled, axis=0))
    slip = encoders.slip_m * np.sqrt(step) * rng.normal(size=step.shape)
    rolled[1:] += np.cumsum(slip, axis=0)
    errors = np.array([encoders.radius_error_left, encoders.radius_error_right])
    angles = rolled / (encoders.wheel_radius_m * (1 + errors))
    count = 2 * np.pi / encoders.counts_per_turn
    return np.asarray(np.floor(angles / count + rng.random(2)) * count)


def turn_rates(
    states: BaseStates, times: Array, gyroscope: Gyroscope, rng: np.random.Generator
) -> Array:
    """Rates (n,) rad/s that a gyroscope reads at times (n,) s: the mean since the time before."""
    steps = np.diff(times, prepend=times[0] - gyroscope.period_s)
    rates = np.diff(states.turned, prepend=states.turned[0]) / steps
    wander = np.radians(gyroscope.bias_wander_deg_s) * np.sqrt(steps)
    bias = np.radians(gyroscope.bias_deg_s) + np.cumsum(wander * rng.normal(size=len(times)))
    noise = np.radians(gyroscope.rate_sigma_deg_s) * rng.normal(size=len(times))
    return np.asarray((1 + gyroscope.scale_error) * rates + bias + noise)


def odometry(angles: Array, encoders: Encoders) -> Array:
    """Poses (n, 3) from wheel angles (n, 2) with the robot's nominal geometry.

    In the frame of the first pose; thesis eq. 2.6-2.12.
    """
    radius = encoders.wheel_radius_m
    nominal = RobotConfig(
        wheel_radius_left_m=radius, wheel_radius_right_m=radius, axle_m=encoders.axle_m
    )
    poses = np.zeros((len(angles), 3))
    for i, step in enumerate(exp(wheel_twist(np.diff(angles, axis=0), nominal)), start=1):
        poses[i] = compose(poses[i - 1], step)
    return poses
