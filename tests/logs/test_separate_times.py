"""Recordings that have the same topics: one after the other, twice the same, or of two robots."""

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

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
    # compare and info have no such option: they say so of smooth, and what they can do
    told = r"anna\.mcap and .*ben\.mcap: .*same 20 s.*smooth --same-place .*compare: --each"
    with pytest.raises(LogError, match=told):
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


def relogged(path, shift_s):
    """The recording with other log times, stamps as they are."""
    target = path.with_name(f"late_{path.name}")
    schemas, channels = {}, {}
    with path.open("rb") as file, target.open("wb") as out:
        log = Writer(out)
        log.start()
        for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
            if channel.id not in channels:
                schemas[schema.id] = log.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = log.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id], channel.metadata
                )
            at = message.log_time + shift_s * SECOND
            log.add_message(channels[channel.id], at, message.data, at, message.sequence)
        log.finish()
    return target


def test_stamps_place_messages_not_the_times_of_recording(tmp_path):
    """Parts of a drive whose times of recording begin at the same time are one robot's, as is a
    drive recorded twice, once by a clock that is wrong by 9 s. Two robots are two, whenever their
    messages were recorded."""
    first = record(tmp_path / "1.mcap", 0, 30)
    second = relogged(record(tmp_path / "2.mcap", 31, 60), -31)
    assert open_logs([first, second], graphslam.load_config()).robots == ("robot",)
    again = relogged(record(tmp_path / "again.mcap", 0, 30), 9)
    assert open_logs([first, again], graphslam.load_config()).robots == ("robot",)
    other = relogged(record(tmp_path / "other.mcap", 0, 30, speed=1), 5000)
    with pytest.raises(LogError, match="different messages"):
        open_logs([first, other], graphslam.load_config())


def test_a_robot_that_is_silent_for_a_while_is_another_one_all_the_same(tmp_path):
    """In the middle of the time that both have there is nothing to compare."""
    paths = [
        record(tmp_path / "anna.mcap", 0, 120),
        record(tmp_path / "ben.mcap", 0, 120, speed=1, but=range(500, 700)),
    ]
    with pytest.raises(LogError, match="different messages"):
        open_logs(paths, graphslam.load_config())


def test_recordings_in_one_folder_are_compared_like_others(tmp_path):
    """A folder is one recording of several pieces: of one drive, not of two robots."""
    for name, robots in (("two", (0.5, 1.0)), ("split", (0.5, 0.5))):
        (tmp_path / name).mkdir()
        for k, speed in enumerate(robots):
            begin_s = 10 * k if name == "two" else 30 * k
            record(tmp_path / name / f"{k}.mcap", begin_s, begin_s + 30, speed=speed)
    with pytest.raises(LogError, match=r"0\.mcap and .*1\.mcap"):
        open_logs([tmp_path / "two"], graphslam.load_config())
    assert open_logs([tmp_path / "split"], graphslam.load_config()).robots == ("robot",)


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
