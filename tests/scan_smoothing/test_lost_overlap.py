"""Motions that odometry does not show, between keyframes whose scans have little in common."""

import numpy as np
import pytest
from room_log import BEAMS, MOUNT, SCAN, START_NS, S
from walls import cast, rectangles

from graphslam.core.config_io import load_config
from graphslam.core.geometry import compose, inverse
from graphslam.core.records import Scan
from graphslam.evaluation.metrics import evaluate
from graphslam.logs import LogWriter, open_logs, read_truth
from graphslam.scan_smoothing.lost_overlap import MOST_BETWEEN, scans_to_add
from graphslam.slam.smooth import smooth

#: two corridors with niches and a pillar each, from one into the other
ROOM = rectangles(
    (0, 0, 9, 9), (-0.1, 2, 7, 9.1), (3, 0, 4, 0.3), (8.7, 5, 9, 6), (8.2, 8, 8.5, 8.3)
)
#: tenths of a second: forward, round by 1.6 rad, forward
LEGS = ((48, 0.12, 0.0), (20, 0.0, 0.08), (50, 0.12, 0.0))


def log_of(path, *, slips, seed=5):
    """A drive in a room; if the wheels slip, odometry does not show that the robot turns."""
    rng = np.random.default_rng(seed)
    pose, odometry, k = np.array([2.2, 1.0, 0.0]), np.zeros(3), 0
    with LogWriter(path) as log:
        log.mount("robot", START_NS, MOUNT)
        for steps, forward_m, turn_rad in ((1, 0.0, 0.0), *LEGS):
            for _ in range(steps):
                stamp = START_NS + k * S // 10
                pose = compose(pose, np.array([forward_m, 0.0, turn_rad]))
                shown = np.array([forward_m, 0.0, 0.0 if slips else turn_rad])
                odometry = compose(odometry, shown + rng.normal(0, 1e-4, 3))
                log.odometry("robot", stamp, odometry)
                log.truth("robot", stamp, pose)
                if k % 2 == 0:
                    ranges = cast(ROOM, BEAMS, compose(pose, MOUNT), 30.0)
                    log.scan("robot", stamp, ranges + rng.normal(0, 0.01, len(BEAMS)), **SCAN)
                k += 1
    return path


@pytest.mark.parametrize("slips", [False, True])
def test_a_turn_that_the_wheels_do_not_show_is_found_in_the_scans_between(tmp_path, slips):
    """The next keyframe would be 1.6 rad away, where half of its view is of another corridor."""
    config = load_config(None, ["start.from_truth=true"])
    log = log_of(tmp_path / "turn.mcap", slips=slips)
    result = smooth(open_logs([log], config), config)
    found = evaluate(result, read_truth([log], config).trajectories)["robots"]["robot"]["final"]
    assert found["ate_rmse_m"] < 0.03, found


def scan(time_ns):
    return Scan("r", time_ns, time_ns, np.ones(9), 0.0, 0.1, mount=inverse(MOUNT))


def test_all_scans_between_are_added_and_of_very_many_some_all_along():
    scans = [scan(t) for t in range(0, 400, 2)]
    few, many = (4, 10), (100, 300)
    assert [s.time_ns for s in scans_to_add([few], scans)] == [6, 8]
    added = [s.time_ns for s in scans_to_add([few, many], scans)][2:]
    assert len(added) == MOST_BETWEEN and added == sorted(set(added))
    assert (added[0], added[-1]) == (102, 298) and max(np.diff(added)) <= 12
    assert scans_to_add([], scans) == [] == scans_to_add([(4, 5)], scans)
