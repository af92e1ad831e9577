"""What a program's own records must hold, see tests/live/test_session.py for sightings."""

import numpy as np
import pytest

from graphslam.core.records import (
    OdometryIncrement,
    RelativePose,
    Scan,
    Sighting,
    WheelAngles,
)
from graphslam.logs.record_checks import UnusableMessageError, checked

SCAN = Scan("robot", 1, 1, np.ones(3), 0.0, 0.1, np.zeros(3))

SEEN = Sighting("robot", 1, 1, np.array([0.1, 2.0]), 1e-4 * np.eye(2), None, None, np.zeros(3))


def changed(record, **values):
    return type(record)(**{n: getattr(record, n) for n in record.__dataclass_fields__} | values)


def test_a_record_that_is_right_is_the_same_one():
    """It is on the way of every message, and copies nothing."""
    assert checked(SCAN) is SCAN


@pytest.mark.parametrize(
    ("record", "reason"),
    [
        (changed(SCAN, mount=None), r"Scan: mount must be an array \(3\) of numbers"),
        (changed(SCAN, bearings=np.ones(2)), r"Scan: bearings must be an array \(n\) of numbers"),
        (changed(SCAN, angle_min_rad="left"), "Scan: angle_min_rad must be a number"),
        (changed(SCAN, angle_step_rad=np.nan), "scan: angle increment is zero or angles are not"),
        (changed(SCAN, angle_min_rad=np.inf), "scan: angle increment is zero or angles are not"),
        (changed(SCAN, angle_step_rad=0.0), "scan: angle increment is zero or angles are not"),
        (changed(SCAN, ranges=np.empty(0)), "scan: no beams"),
        (changed(SCAN, mount=np.array([0.0, np.nan, 0.0])), "scan: not finite"),
        (changed(SCAN, mount=np.array([1e30, 0.0, 0.0])), "scan: the sensor is beyond any robot"),
        (changed(SCAN, beam_period_s=np.nan), "scan: beam_period_s is not finite, or longer"),
        (changed(SCAN, beam_period_s=1e3), "scan: beam_period_s is not finite, or longer"),
        (changed(SCAN, bearings=np.array([0.0, np.nan, 0.2])), "scan: bearings: not finite"),
        (changed(SCAN, stamp_ns=1.5), "Scan: stamp_ns and time_ns must be whole numbers"),
        (WheelAngles("robot", 1, 1, None, 0.0), "WheelAngles: left_rad must be a number"),
        (changed(SEEN, mount=np.array([0.0, 0.0, np.inf])), "sighting: not finite"),
        (changed(SEEN, z=np.array([0.0, 1e-9])), "sighting: range is not positive"),
        (changed(SEEN, identity=5), "Sighting: identity must be a text"),
        (changed(SEEN, seen_robot=["b"]), "Sighting: seen_robot must be a text"),
        (
            OdometryIncrement("robot", 1, 1, None, np.zeros(3), np.eye(3)),
            "start_ns must be a whole",
        ),
        (RelativePose("robot", 1, 1, "robot", None, np.zeros(3), np.eye(3)), "start_ns must be a"),
    ],
)
def test_what_is_missing_or_of_another_shape_is_said(record, reason):
    """Not with an error from inside, later."""
    with pytest.raises(UnusableMessageError, match=reason):
        checked(record)
