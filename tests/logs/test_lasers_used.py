"""Which of a robot's lasers are used, and what is said of the others."""

import numpy as np
import pytest

from graphslam.core.config_io import load_config
from graphslam.logs import LogWriter, open_logs
from graphslam.logs.log_info import inspect_logs
from graphslam.logs.schemas import DEFAULT_ROBOT

FAN = {"angle_min_rad": -1.5, "angle_step_rad": 0.1, "range_max_m": 10.0}
MOUNTS = {"laser": (0.3, 0.0, 0.0), "rear": (-0.3, 0.1, np.pi)}


def written(path, lasers=("laser", "rear"), *, robots=(DEFAULT_ROBOT,), mounts=MOUNTS):
    """Ten seconds of a robot that drives ahead; the first laser has most scans."""
    with LogWriter(path) as log:
        for robot in robots:
            for sensor, mount in mounts.items():
                log.mount(robot, 0, mount, sensor)
            for k in range(100):
                ns = k * 100_000_000
                log.odometry(robot, ns, (0.05 * k, 0.0, 0.0))
                for n, sensor in enumerate(lasers):
                    if k % (n + 1) == 0:
                        log.scan(robot, ns, np.linspace(2.0, 3.0 + n, 31), sensor=sensor, **FAN)
    return path


def opened(path, *settings):
    return open_logs([path], load_config(overrides=settings))


def sensors_read(log):
    scans = [m for m in log.messages(all_lasers=True) if hasattr(m, "ranges")]
    return {scan.sensor: scan.mount for scan in scans}


def test_all_lasers_are_read_each_with_its_own_mount(tmp_path):
    """Those who ask for no more get the scans of the first laser only."""
    log = opened(written(tmp_path / "log.mcap"))
    read = sensors_read(log)
    assert set(read) == {"", "scan_rear"}
    np.testing.assert_allclose(read[""], MOUNTS["laser"], atol=1e-12)
    np.testing.assert_allclose(read["scan_rear"], MOUNTS["rear"], atol=1e-12)
    assert {m.sensor for m in log.messages() if hasattr(m, "ranges")} == {""}
    assert log.sensors(DEFAULT_ROBOT) == {"/scan": "", "/scan_rear": "scan_rear"}
    info = inspect_logs([tmp_path / "log.mcap"], load_config())
    assert {t.name for t in info.topics if t.used and t.scan} == {"/scan", "/scan_rear"}
    assert not info.doubtful and not any("laser" in line for line in log.warnings)


def test_a_laser_whose_mount_is_unknown_is_left_out_with_what_mends_it(tmp_path):
    """At a mount that was made up, its walls would be added to the map at a wrong place."""
    path = written(tmp_path / "log.mcap", mounts={"laser": MOUNTS["laser"]})
    log = opened(path)
    assert not log.further_lasers
    setting = "robots.robot.lasers.scan_rear=[X, Y, YAW]"
    (line,) = [line for line in log.warnings if "/scan_rear" in line]
    assert "is not used" in line and setting in line
    told = opened(path, setting.replace("X, Y, YAW", "-0.3, 0.1, 3.1"))
    np.testing.assert_array_equal(sensors_read(told)["scan_rear"], [-0.3, 0.1, 3.1])


def test_scans_of_one_frame_are_of_one_laser(tmp_path):
    """A driver's topic and a filter's: no scan counts twice."""
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.mount("a", 0, MOUNTS["laser"])
        for k in range(20):
            ns = k * 100_000_000
            log.odometry("a", ns, (0.05 * k, 0.0, 0.0))
            log.scan("a", ns, np.full(31, 2.0), **FAN)
            log.scan(DEFAULT_ROBOT, ns, np.full(31, 2.0), sensor="a/laser", **FAN)  # its frame
    topics = ", ".join(f'"{name}" = "a"' for name in ("/a/odom", "/a/scan", "/scan_a/laser"))
    log = opened(path, f"logs.topics={{{topics}}}")
    assert not log.further_lasers
    assert any("not used: /scan_a/laser" in line for line in log.warnings)


@pytest.mark.parametrize("first", ["base_link", "laser"])
def test_a_scan_in_the_frame_of_the_base_is_made_of_other_lasers(tmp_path, first):
    """Whether it is the one with most messages or not, its returns are not used beside theirs."""
    lasers = ("base_link", "rear") if first == "base_link" else ("laser", "base_link")
    log = opened(written(tmp_path / "log.mcap", lasers))
    assert not log.further_lasers
    assert any("laser is taken from" in line and "not used" in line for line in log.warnings)


@pytest.mark.parametrize(
    ("robots", "settings"), [(("a", "b"), ()), ((DEFAULT_ROBOT,), ("backend.name=isam2",))]
)
def test_what_cannot_use_more_than_one_laser_says_so(tmp_path, robots, settings):
    log = opened(written(tmp_path / "log.mcap", robots=robots), *settings)
    assert not log.further_lasers
    unused = [line for line in log.warnings if "not used" in line]
    assert len(unused) == len(robots) and all("logs.topics" in line for line in unused)


def test_the_base_of_wheels_is_that_above_the_laser(tmp_path):
    """JointState names no frame: of a robot with a namespace the base is not `base_link`."""
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.mount("vehicle", 0, MOUNTS["laser"])
        for k in range(20):
            log.wheel_angles("vehicle", k * 100_000_000, 0.5 * k, 0.5 * k)
            log.scan("vehicle", k * 100_000_000, np.linspace(2.0, 3.0, 31), **FAN)
    log = opened(path)
    np.testing.assert_allclose(log.mount("/vehicle/scan"), MOUNTS["laser"], atol=1e-12)
    assert not any("no transform" in line for line in log.warnings)
