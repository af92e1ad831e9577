"""Reading that begins in the second process while the first loads libraries."""

import numpy as np
import pytest
import three_robots
from paths import LOGS

from graphslam.core.config import KeyframeConfig
from graphslam.core.config_io import load_config
from graphslam.core.record import packed
from graphslam.core.records import TRUE_RECORDS, Scan, Truth
from graphslam.core.worker import allow_fork
from graphslam.logs import open_logs
from graphslam.pipeline.keyframes import KeyframeSelector
from graphslam.pipeline.robot_settings import make_tracks
from graphslam.pipeline.robot_state import RobotState
from graphslam.pipeline.synchronisation import synchronise
from graphslam.scan_smoothing import log_reader
from graphslam.scan_smoothing.log_reader import read_ahead


@pytest.mark.parametrize("second", [False, True])
def test_messages_are_taken_from_the_reading_that_has_begun(tmp_path, second):
    """In a second process or not: the same ones as without it, and once only, since another
    reading begins anew; with what was found out about them."""
    path, config = tmp_path / "log.mcap", load_config()
    three_robots.write(path, seconds=120.0)
    expected = open_logs([path], config)
    messages = list(expected.messages(TRUE_RECORDS))
    allow_fork(second=second)
    try:
        log = open_logs([path], config)
        with read_ahead(log, config) as reading:
            for _ in range(2):
                found = list(log.messages(TRUE_RECORDS))
                assert [type(m) for m in found] == [type(m) for m in messages]
                assert [m.time_ns for m in found] == [m.time_ns for m in messages]
            assert reading.receive() is None
            assert log.report() == expected.report()
    finally:
        allow_fork(second=False)


def test_batches_are_asked_for_ahead_but_not_more_than_a_pipe_holds(monkeypatch):
    """All of a long log's at once would fill the pipe while the second process fills its own."""
    monkeypatch.setattr(log_reader, "MOST_AHEAD", 5)

    class Asked:
        ahead, most, left = 0, 0, 40

        def send(self, _value):
            self.ahead += 1
            self.most = max(self.most, self.ahead)

        def receive(self):
            self.ahead -= 1
            self.left -= 1
            return (
                packed([Truth("r", self.left, self.left, np.zeros(3))]) if self.left >= 0 else None
            )

    asked = Asked()
    found = list(log_reader._received(asked, 40))
    assert [message.time_ns for message in found] == list(range(39, -1, -1))
    assert asked.most == 5


def test_keyframes_of_a_block_are_those_found_one_by_one():
    """Also from block to block, where the last one that was used is remembered."""
    config = load_config()
    log = open_logs([LOGS / "lab.mcap"], config)
    (robot,) = log.robots
    selector, runs, scans = KeyframeSelector(KeyframeConfig()), [], []
    for _ in range(2):
        run = RobotState(make_tracks(log, config)[robot])
        read = synchronise(log.messages(TRUE_RECORDS), {robot: run.track}, 5.0, log.dropped)
        scans = [message for message in read if isinstance(message, Scan)]
        runs.append(run)
    one_by_one = [s.time_ns for s in scans if selector.is_used((s,), runs[0])]
    at_once, others = [], []
    for block in np.array_split(np.arange(len(scans)), 7):
        used, driven = selector.used_scans([scans[k] for k in block], runs[1])
        at_once += [scan.time_ns for scan in used]
        others += [scan.time_ns for scan in driven]
    assert 10 < len(one_by_one) < len(scans)
    assert at_once == one_by_one
    # of those while the robot stood one is among the others, none if that has a state
    assert others and not set(others) & set(at_once)
    kept = sorted([*at_once, *others])
    driven = runs[1].track.driven(np.array(kept, dtype=np.int64))
    assert np.all((np.diff(driven, axis=0) != 0).any(axis=1))
    left_out = [s.time_ns for s in scans if s.time_ns not in set(kept) and s.time_ns > kept[0]]
    before = np.searchsorted(kept, left_out) - 1
    np.testing.assert_array_equal(
        runs[1].track.driven(np.array(left_out, dtype=np.int64)), driven[before]
    )
