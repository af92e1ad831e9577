"""The noise of odometry by the residuals of its motions."""

import numpy as np
import pytest

from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.motion_models import RATES, with_rates
from graphslam.core.records import OdometryPose, WheelAngles
from graphslam.odometry.noise_estimation import (
    motion_variances,
    variances_by_rate,
    without_noise,
)
from graphslam.odometry.preintegration import Track

S = 1_000_000_000


def driven(kind, *, mounted):
    """A track of 40 s on changing arcs, read every 0.1 s."""
    track = Track(OdometryConfig(), RobotConfig(), mounted=mounted)
    pose, angles = np.zeros(3), np.zeros(2)
    for k in range(400):
        speed, turn = 0.5 + 0.2 * np.sin(0.05 * k), 0.8 * np.sin(0.03 * k)
        heading = pose[2] + 0.05 * turn
        step = 0.1 * speed
        pose = pose + np.array([step * np.cos(heading), step * np.sin(heading), 0.1 * turn])
        angles = angles + 0.1 * np.array([speed - 0.2 * turn, speed + 0.2 * turn]) / 0.1
        if kind == "wheels that jump" and k in (114, 230):  # encoders whose counters overflow
            angles[k % 4 // 2] -= 65.7
        time_ns = 100 * S + k * S // 10
        track.add(
            OdometryPose("r", time_ns, time_ns, pose)
            if kind == "poses"
            else WheelAngles("r", time_ns, time_ns, *angles.tolist())
        )
    return track


@pytest.mark.parametrize("mounted", [False, True])
@pytest.mark.parametrize("kind", ["poses", "wheels", "wheels that jump"])
def test_variances_by_rate_are_those_that_motions_gain(kind, mounted):
    """Each rate changed by one changes the variances by its column: they are linear in the rates.
    A rate at another place, or a lever arm left out, is off by far more than rounding. Where
    several turns are between two readings, the arcs cannot be told from where they end."""
    track = driven(kind, mounted=mounted)
    times = 100 * S + np.arange(0, 39 * S, 730_000_000)
    between = times[:-1], times[1:]
    bare = without_noise(track.config)
    asked = [(track, *between)]
    (none,), found = motion_variances(asked, [bare]), variances_by_rate(track, *between)
    assert found.shape == (len(times) - 1, 3, len(RATES))
    for k, one in enumerate(np.eye(len(RATES))):
        gained = motion_variances(asked, [with_rates(bare, one)])[0] - none
        np.testing.assert_allclose(found[:, :, k], gained, atol=1e-9)  # of 0.7
    assert found.min() > -1e-9
