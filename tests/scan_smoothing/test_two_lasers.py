"""Two lasers on one robot, front and rear, that their log says are elsewhere."""

from dataclasses import replace

import numpy as np
import pytest

from graphslam import evaluate, smooth
from graphslam.core.geometry import between, wrap
from graphslam.simulation import load_scenario, simulate
from graphslam.simulation.laser import laser_mount, told_mount

ERROR = {"mount_error_m": (0.02, -0.015), "mount_error_deg": 1.0}


@pytest.fixture(scope="module")
def lasers():
    laser = load_scenario("lab").robots["vehicle"].laser
    front = replace(laser, step_deg=1.0, **ERROR)
    back = {"mount_m": (-0.3, 0.05), "mount_deg": 180.0, "period_s": 0.45, "latency_s": 0.03}
    return {"front": front, "rear": replace(front, **back)}


@pytest.fixture(scope="module")
def log(lasers, tmp_path_factory):
    path = tmp_path_factory.mktemp("lasers") / "log.mcap"
    lab = load_scenario("lab")
    vehicle = replace(lab.robots["vehicle"], laser=None, lasers=lasers)
    simulate(replace(lab, robots={"vehicle": vehicle}), path, 1)
    return path


@pytest.fixture(scope="module")
def result(log):
    return smooth(log, start={"from_truth": True})


def error_m(result, log):
    found = evaluate(result, truth=log)["robots"]["vehicle"]["final"]
    return found["ate_aligned_rmse_m"], found["nees_per_dof"]


def test_the_mount_of_each_and_its_latency_are_found(result, lasers):
    """A state of one laser taken for one of the other would be off by their mounts' difference."""
    assert [entry["name"] for entry in result.summary["lasers"]["vehicle"]] == ["", "scan_rear"]
    for entry, laser in zip(result.summary["lasers"]["vehicle"], lasers.values(), strict=True):
        told = between(told_mount(laser), np.array(entry["mount_in_log"]))
        np.testing.assert_allclose(told, 0.0, atol=1e-9)
        off = entry["mount"] - laser_mount(laser)
        assert np.abs(off[:2]).max() < 0.005 and abs(wrap(off[2])) < np.deg2rad(0.2)
        assert abs(entry["latency_s"] - laser.latency_s) < 0.02


def test_calibration_says_how_well_they_are_known(result):
    found = result.summary["calibration"]
    for name in ("laser_x_m", "laser_y_m", "laser_yaw_rad", "laser_latency_s"):
        rear = found[f"vehicle.scan_rear.{name}"]
        assert rear["observable"] and 0 < rear["sigma"] < 0.01


def test_two_are_not_worse_than_the_first_alone(result, log):
    """They would be, were their scans put together by the mounts that the log tells."""
    topics = {f"/vehicle/{name}": "vehicle" for name in ("odom", "truth", "scan_front")}
    alone = smooth(log, start={"from_truth": True}, logs={"topics": topics})
    assert "vehicle.scan_rear.laser_x_m" not in alone.summary["calibration"]
    (both_m, nees), (alone_m, _) = error_m(result, log), error_m(alone, log)
    assert both_m < 1.02 * alone_m
    assert nees < 2.0


def test_poses_are_reported_at_the_scans_of_the_first(result, lasers):
    robot = result.robots["vehicle"]
    assert len(robot.final) == len(robot.scan_final)
    assert np.median(np.diff(robot.final.stamps_ns)) == pytest.approx(
        1e9 * lasers["front"].period_s
    )


def test_a_laser_that_looks_elsewhere_than_its_log_says_is_left_out(log, lasers):
    """Half a turn off, its walls would be put into the map behind the robot instead of ahead."""
    turned = {"robots": {"vehicle": {"lasers": {"scan_rear": [-0.3, 0.05, 0.0]}}}}
    found = smooth(log, start={"from_truth": True}, **turned)
    assert [entry["name"] for entry in found.summary["lasers"]["vehicle"]] == [""]
    (line,) = [line for line in found.summary["warnings"] if "scan_rear" in line]
    assert "contradict" in line and "robots.vehicle.lasers.scan_rear=" in line
    assert error_m(found, log)[0] < 0.01
