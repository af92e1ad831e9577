"""Clocks that are set while a recording runs: what was stamped before is left out, and counted."""

import numpy as np
import pytest

from graphslam.core.config import Config
from graphslam.logs import LogWriter, open_logs
from graphslam.logs.clock_steps import OTHER_CLOCK
from graphslam.logs.log_info import inspect_logs

S = 1_000_000_000
YEAR = 365 * 86_400 * S
T0 = 50 * YEAR
SCAN = {"angle_min_rad": -1.0, "angle_step_rad": 0.1, "range_max_m": 9.0}


def write(path, stamps):
    """Odometry and a scan at every stamp, recorded one second after the other."""
    with LogWriter(path) as log:
        log.mount("robot", T0, (0, 0, 0))
        for k, stamp in enumerate(stamps):
            log.odometry("robot", stamp, (0.1 * k, 0, 0))
            log.scan("robot", stamp, np.full(21, 2.0), **SCAN)
    return path


BOOTED = [3 * S + k * S for k in range(20)]
KNOWN = [T0 + k * S for k in range(100)]
CASES = {
    "first stamps of zero": ([0, 0], KNOWN, 4),
    "a clock that begins in 1970": (BOOTED, KNOWN, 40),
    "a clock that was years ahead": ([t + 9 * YEAR for t in KNOWN[:30]], KNOWN[30:], 60),
    "set by a year": ([t - YEAR for t in KNOWN[:30]], KNOWN[30:], 60),
}


@pytest.mark.parametrize("case", CASES)
def test_what_was_stamped_before_a_clock_was_set_is_left_out_and_counted(tmp_path, case):
    """Else the log lasts for decades, and whatever has a row for each second needs all memory."""
    early, rest, count = CASES[case]
    log = open_logs([write(tmp_path / "log.mcap", early + rest)], Config())
    times = [message.time_ns for message in log.messages()]
    assert min(times) == rest[0] and max(times) == rest[-1] and len(times) == 2 * len(rest)
    assert log.dropped[OTHER_CLOCK] == count
    assert [f": {count} messages are stamped" in line for line in log.warnings] == [True]
    info = inspect_logs([tmp_path / "log.mcap"], Config())
    assert info.dropped[OTHER_CLOCK] == count
    assert [robot.speed_m_s for robot in info.robots] == [pytest.approx(0.1, rel=0.05)]


def test_time_that_begins_at_zero_and_a_weekend_in_one_recording_are_read(tmp_path):
    """A simulation begins at zero; a recording may go on after some days."""
    stamps = [k * S for k in range(50)] + [3 * 86_400 * S + k * S for k in range(50)]
    log = open_logs([write(tmp_path / "log.mcap", stamps)], Config())
    assert len(list(log.messages())) == 200 and not log.dropped
