"""Walls that are turned against each other within scans: by sweeps, or by beams told wrong."""

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
from graphslam.verdict.scan_distortion import UNDISTORTED, scan_distortion

S = 1_000_000_000
#: middles and directions (n, 3) of the walls of a room, as seen from its middle; none is where
#: the scan of a robot at heading 0 begins and ends
WALLS = np.array([[3.0, 0.0, 1.57], [0.0, 2.0, 3.14], [-3.0, 0.1, -1.57], [0.0, -2.0, 0.0]])
SCANS, SIGMA_RAD = 60, 0.01
EXTENT = np.array([-1.0, 1.0])


def room(sweep_s=0.0, late_s=0.0, order=1, turning=1.0, wider=0.0):
    """Associations, scans, estimate and track of a robot that turns to and fro on the spot.

    Beams go once around from behind in ``order``, within ``sweep_s``; the whole scan is ``late_s``.
    They are farther apart than told by the share ``wider``.
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
            z[2] -= wider * np.arctan2(local[1], local[0])
            cov = np.diag([1.0, 1e-4, SIGMA_RAD**2])
            seen.append(Association("r", time, n, "line", z, cov, extent=EXTENT))
    scans = [KeyframeScan("r", time, points) for time in times.tolist()]
    covs = np.zeros((SCANS, 3, 3))
    marks = {n: (wall, np.zeros((3, 3))) for n, wall in enumerate(WALLS)}
    return seen, scans, Estimate({"r": Trajectory(times, states, covs)}, marks, 0.0, 0), track


@pytest.mark.parametrize("order", [1, -1])
def test_the_time_of_an_unknown_sweep_is_found_whatever_its_direction(order):
    sweep, spacing = scan_distortion(*room(0.1, order=order))
    assert sweep.value == pytest.approx(0.1, abs=0.015)
    assert sweep.sigmas > 20 and sweep.share > 0.5 and sweep.rms_rad > 0.01
    assert spacing.share < 0.1  # it turns to and fro


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("wider", [0.01, -0.01])
@pytest.mark.parametrize("turning", [0.0, 1.0])
def test_the_spacing_of_beams_is_found_whatever_their_direction(order, wider, turning):
    sweep, spacing = scan_distortion(*room(order=order, wider=wider, turning=turning))
    assert spacing.value == pytest.approx(wider, abs=0.001)  # 240 walls, 0.01 rad each: 4 sigmas
    assert spacing.sigmas > 20 and spacing.share > 0.5 and spacing.rms_rad > 0.005
    assert sweep.share < 0.1


@pytest.mark.parametrize(("late_s", "turning"), [(0.0, 1.0), (0.05, 1.0), (0.0, 0.0)])
def test_scans_that_are_late_as_a_whole_are_not_distorted(late_s, turning):
    """Nor are those of a robot that stands."""
    for found in scan_distortion(*room(late_s=late_s, turning=turning)):
        assert found.sigmas < 4 and found.share < 0.05 and found.rms_rad < 0.002


def test_a_few_walls_tell_nothing():
    seen, *others = room(0.1)
    assert scan_distortion(seen[:80], *others) == UNDISTORTED


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
