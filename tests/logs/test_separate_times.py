"""Recordings that have the same topics: one after the other, twice the same, or of two robots."""

import pytest

import graphslam
from graphslam.core.errors import LogError
from graphslam.logs import LogWriter, open_logs
from graphslam.logs.log_info import inspect_logs

SECOND = 1_000_000_000
SCAN = {"angle_min_rad": -1.0, "angle_step_rad": 0.1, "range_max_m": 10.0}


def record(path, first_s, last_s, *, speed=0.5, odometry=True, scans=True, but=()):
    """A straight drive at 10 Hz: of one robot, wherever it is recorded; ``but`` some messages."""
    with LogWriter(path) as log:
        for k in range(10 * first_s, 10 * last_s + 1):
            if k in but:
                continue
            stamp = k * SECOND // 10
            if odometry:
                log.odometry("robot", stamp, [0.1 * speed * k, 0, 0])
            if scans:
                log.scan("robot", stamp, [5.0 - 0.01 * speed * k] * 21, **SCAN)
    return path


def test_two_robots_whose_topics_have_the_same_names_are_refused(tmp_path):
    """As one robot their scans would alternate, and the result would be good for nothing. What is
    said names both recordings and what to do, and doing it works."""
    paths = [record(tmp_path / "anna.mcap", 0, 30), record(tmp_path / "ben.mcap", 10, 40, speed=1)]
    with pytest.raises(LogError, match=r"anna\.mcap and .*ben\.mcap: .*same 20 s.*--same-place"):
        open_logs(paths, graphslam.load_config())
    assert "--same-place" in inspect_logs(paths, graphslam.load_config()).problem
    apart = open_logs(paths, graphslam.load_config(**{"logs.same_place": True}))
    assert apart.robots == ("anna", "ben")


@pytest.mark.parametrize("begin_s", [20, 21])
def test_parts_of_a_drive_are_one_robots(tmp_path, begin_s):
    """The next part begins a second before the last one ends, or after: recorders do both."""
    paths = [record(tmp_path / "1.mcap", 0, 21), record(tmp_path / "2.mcap", begin_s, 40)]
    assert open_logs(paths, graphslam.load_config()).robots == ("robot",)


def test_a_drive_that_was_recorded_twice_is_one_robots(tmp_path):
    """By two recorders at once, each of which missed some messages."""
    paths = [
        record(tmp_path / "on_board.mcap", 0, 30, but=range(140, 155)),
        record(tmp_path / "by_radio.mcap", 5, 28, but=range(100, 280, 3)),
    ]
    assert open_logs(paths, graphslam.load_config()).robots == ("robot",)


def test_what_a_robot_says_may_be_in_several_recordings(tmp_path):
    """Odometry in one, scans in the other: no topic is in both."""
    paths = [
        record(tmp_path / "odometry.mcap", 0, 30, scans=False),
        record(tmp_path / "scans.mcap", 0, 30, odometry=False),
    ]
    assert open_logs(paths, graphslam.load_config()).robots == ("robot",)


def test_drives_with_a_pause_between_them_are_told_how_to_be_joined(tmp_path):
    """Read as one, the robot stands still for a day and its odometry jumps; what is said names the
    setting that takes each recording for itself. A pause within one recording is no other drive."""
    paths = [record(tmp_path / "1.mcap", 0, 20), record(tmp_path / "2.mcap", 5000, 5020)]
    (told,) = (f for f in inspect_logs(paths, graphslam.load_config()).findings if gap(f))
    assert "--same-place" in told.remedy
    whole = record(tmp_path / "whole.mcap", 0, 600, but=range(200, 5800))
    (told,) = (f for f in inspect_logs([whole], graphslam.load_config()).findings if gap(f))
    assert "max_gap_s" in told.remedy and "--same-place" not in told.remedy


def gap(finding):
    """Whether a finding is of a gap of the odometry."""
    return finding.check == "gaps" and finding.topic.endswith("odom")
