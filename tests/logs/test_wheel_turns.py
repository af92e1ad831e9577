"""Wheels whose angles begin again after each turn."""

import numpy as np
import pytest
from room_log import START_NS

from graphslam.core.config import Config
from graphslam.core.geometry import wrap
from graphslam.logs import LogWriter, inspect_logs, open_logs
from graphslam.logs.wheel_turns import BEGUN_AGAIN, jumps_of

TURN = 2 * np.pi


def driven(n=600):
    """Angles (n, 2) of wheels, rad, at 10 Hz: forth, standing, turning, back."""
    k = np.arange(n - 1)
    speed = np.where(k < 300, 0.4, -0.25) * ((k % 200) < 150)
    turn = 0.15 * np.sin(0.03 * k) * (speed != 0)
    steps = np.column_stack([speed - turn, speed + turn])
    return np.cumsum([[0.3, 1.1], *steps], axis=0)


def log_of(path, angles):
    with LogWriter(path) as out:
        for k, (left, right) in enumerate(angles.tolist()):
            out.wheel_angles("robot", START_NS + k * 100_000_000, left, right)
    return path


def read(path):
    log = open_logs([path], Config())
    return log, np.array([[m.left_rad, m.right_rad] for m in log.messages()])


@pytest.mark.parametrize("begin_rad", [-np.pi, 0.0])
def test_turns_are_counted(begin_rad, tmp_path):
    """The same motion as by angles that go on, and the path that info tells."""
    angles = driven()
    within = (angles - begin_rad) % TURN + begin_rad
    jumps = np.abs(np.diff(within, axis=0)) > np.pi
    log, found = read(log_of(tmp_path / "within.mcap", within))
    np.testing.assert_allclose(found - found[0], angles - angles[0], atol=1e-9)
    assert log.repaired == {BEGUN_AGAIN: np.count_nonzero(jumps.any(axis=1))}
    said = f"begin again after each turn, {np.count_nonzero(jumps)} times"
    assert sum(said in line for line in log.warnings) == 1
    np.testing.assert_array_equal(read(tmp_path / "within.mcap")[1], found)
    whole = log_of(tmp_path / "whole.mcap", angles)
    (mine,), (theirs,) = (
        inspect_logs([p], Config()).robots for p in (tmp_path / "within.mcap", whole)
    )
    assert mine.path_m == pytest.approx(theirs.path_m)
    assert mine.turning_rad == pytest.approx(theirs.turning_rad)
    assert any(said in f.line for f in inspect_logs([tmp_path / "within.mcap"], Config()).findings)


@pytest.mark.parametrize(
    "change",
    [
        lambda a: a,
        lambda a: (a + 20.0) % 40.0 - 20.0,  # of other counters
        lambda a: a % TURN * 4,  # not in radians
        lambda a: np.where(np.arange(len(a))[:, None] < 13, a, a - a[13])[:20],  # reset at 5 rad
        lambda a: np.clip(a, 0, 3),
        lambda a: a[::9] % TURN,  # too far apart to know which way
    ],
)
def test_other_angles_stay_as_they_are(change, tmp_path):
    angles = change(driven())
    log, found = read(log_of(tmp_path / "log.mcap", angles))
    np.testing.assert_array_equal(found, angles)
    assert not log.repaired and not any("begin again" in line for line in log.warnings)


def test_a_gap_in_the_recording_does_not_hide_that_angles_begin_again():
    angles = wrap(driven())
    assert jumps_of(np.concatenate([angles[:200], angles[208:]])) > 10
    assert jumps_of(angles[:1]) == jumps_of(angles[:0]) == 0
