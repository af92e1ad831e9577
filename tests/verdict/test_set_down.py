"""Robots that are set down elsewhere while scans and odometry go on, and what looks like it."""

import numpy as np
import pytest
from room_log import BEAMS, MOUNT, SCAN, START_NS, S
from walls import cast, rectangles

from graphslam.core.config_io import load_config
from graphslam.core.geometry import compose
from graphslam.logs import LogWriter, open_logs
from graphslam.slam.smooth import smooth

#: a hall with pillars, and a corridor with niches beside it
WORLD = rectangles(
    (0, 0, 14, 9), (3, 2, 3.6, 2.6), (8, 6, 8.5, 6.4), (11, 1, 11.4, 2), (6, 8, 7, 9),
    (0, 10, 14, 12), (2, 11.6, 3, 12), (5, 10, 5.6, 10.4), (9, 11.5, 9.4, 12), (13, 10, 14, 10.3),
)  # fmt: skip
#: tenths of a second of a drive of 7 m, and when something happens
STEPS, EVENT = 140, 70
HALL, CORRIDOR = np.array([2.0, 4.0, 0.0]), np.array([4.0, 11.0, 0.0])


def is_set_down(k, pose):
    return (compose(CORRIDOR, [0.05 * (k - EVENT), 0.0, 0.0]) if k >= EVENT else pose), None


def is_blocked(k, pose):
    """Somebody walks in front of most of the beams for 3 s."""
    near = np.where(np.abs(BEAMS) < 1.3, 0.5, np.inf)
    return pose, near if EVENT <= k < EVENT + 30 else None


def is_left_alone(k, pose):
    return pose, None


def log_of(path, happens):
    rng = np.random.default_rng(3)
    odometry = np.zeros(3)
    with LogWriter(path) as log:
        log.mount("robot", START_NS, MOUNT)
        for k in range(STEPS):
            stamp = START_NS + k * S // 10
            pose, near = happens(k, compose(HALL, [0.05 * k, 0.0, 0.0]))
            odometry = compose(odometry, np.array([0.05 * (k > 0), 0, 0]) + rng.normal(0, 1e-4, 3))
            log.odometry("robot", stamp, odometry)
            if k % 2 == 0:
                ranges = cast(WORLD, BEAMS, compose(pose, MOUNT), 30.0)
                ranges = ranges if near is None else np.minimum(ranges, near)
                log.scan("robot", stamp, ranges + rng.normal(0, 0.01, len(BEAMS)), **SCAN)
    return path


@pytest.mark.parametrize(
    ("happens", "expected"),
    [(is_set_down, "doubtful"), (is_blocked, "good"), (is_left_alone, "good")],
)
def test_who_is_set_down_elsewhere_is_told_and_who_meets_people_is_not(tmp_path, happens, expected):
    """What is seen does not come back, which tells it from a person before the laser."""
    config = load_config(None, [])
    result = smooth(open_logs([log_of(tmp_path / "log.mcap", happens)], config), config)
    verdict = result.summary["verdict"]
    assert verdict["verdict"] == expected, verdict["reasons"]
    if happens is is_set_down:
        (text,) = [r["text"] for r in verdict["reasons"] if "another place" in r["text"]]
        assert "7.0 s after its first scan" in text
