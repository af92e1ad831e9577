"""Walls that are turned against each other within scans: a sweep that nobody told of."""

import numpy as np
import pytest
from sweep_motion import scenario

from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.config_io import load_config
from graphslam.core.geometry import between
from graphslam.core.records import Association, Estimate, KeyframeScan, OdometryPose, Trajectory
from graphslam.logs import open_logs
from graphslam.odometry.preintegration import Track
from graphslam.simulation import simulate
from graphslam.slam.smooth import smooth
from graphslam.verdict.sweep_skew import NO_SKEW, sweep_skew

S = 1_000_000_000
#: middles and directions (n, 3) of the walls of a room, as seen from its middle
WALLS = np.array([[3.0, 0.0, 1.57], [0.0, 2.0, 3.14], [-3.0, 0.0, -1.57], [0.0, -2.0, 0.0]])
SCANS, SIGMA_RAD = 60, 0.01
EXTENT = np.array([-1.0, 1.0])


def room(sweep_s, late_s=0.0, order=1, turning=1.0):
    """Associations, scans, estimate and track of a robot that turns to and fro on the spot.

    Beams go once around from behind in ``order``, within ``sweep_s``; the whole scan is ``late_s``.
    """
    rng = np.random.default_rng(0)
    times = S + np.arange(SCANS) * S // 2

    def heading(seconds):
        return 10 * turning * np.sin(0.1 * seconds)

    track = Track(OdometryConfig(), RobotConfig())
    for k in range(0, 350):
        track.add(
            OdometryPose("r", k * S // 10, k * S // 10, np.array([0.0, 0.0, heading(k / 10)]))
        )
    states = np.column_stack([np.zeros((SCANS, 2)), heading(times / S)])
    angles = order * np.linspace(-np.pi, np.pi, 360, endpoint=False)
    points = 2.5 * np.column_stack([np.cos(angles), np.sin(angles)])
    seen = []
    for time, state in zip(times.tolist(), states, strict=True):
        for n, wall in enumerate(WALLS):
            local = between(state, wall)
            part = (order * np.arctan2(local[1], local[0]) + np.pi) / (2 * np.pi)
            at = np.array([0.0, 0.0, heading(time / S + late_s + part * sweep_s)])
            z = between(at, wall) + np.array([0.0, 0.0, rng.normal(0, SIGMA_RAD)])
            cov = np.diag([1.0, 1e-4, SIGMA_RAD**2])
            seen.append(Association("r", time, n, "line", z, cov, extent=EXTENT))
    scans = [KeyframeScan("r", time, points) for time in times.tolist()]
    covs = np.zeros((SCANS, 3, 3))
    marks = {n: (wall, np.zeros((3, 3))) for n, wall in enumerate(WALLS)}
    return seen, scans, Estimate({"r": Trajectory(times, states, covs)}, marks, 0.0, 0), track


@pytest.mark.parametrize("order", [1, -1])
def test_the_time_of_an_unknown_sweep_is_found_whatever_its_direction(order):
    skew = sweep_skew(*room(0.1, order=order))
    assert skew.sweep_s == pytest.approx(0.1, abs=0.015)
    assert skew.sigmas > 20 and skew.share > 0.5 and skew.rms_rad > 0.01


@pytest.mark.parametrize(("late_s", "turning"), [(0.0, 1.0), (0.05, 1.0), (0.0, 0.0)])
def test_scans_that_are_late_as_a_whole_are_not_skewed(late_s, turning):
    """Nor are those of a robot that stands."""
    skew = sweep_skew(*room(0.0, late_s=late_s, turning=turning))
    assert skew.sigmas < 4 and skew.share < 0.05 and skew.rms_rad < 0.002


def test_a_few_walls_tell_nothing():
    seen, *others = room(0.1)
    assert sweep_skew(seen[:80], *others) == NO_SKEW


@pytest.mark.parametrize(("undistort", "verdict"), [("true", "good"), ("false", "doubtful")])
def test_a_sweep_that_is_not_taken_out_is_doubted(undistort, verdict, tmp_path):
    """A laser ten times a second around on a robot that turns at 1.5 rad/s."""
    path = tmp_path / "log.mcap"
    simulate(scenario(0.1), path, 1)
    config = load_config(overrides=[f"logs.undistort={undistort}"])
    found = smooth(open_logs([path], config), config).summary["verdict"]
    assert found["verdict"] == verdict
    assert any("set time_increment" in one["text"] for one in found["reasons"]) == (
        verdict == "doubtful"
    )
