"""A laser that pauses for a while as the robot drives on: odometry tells where it is then."""

from pathlib import Path

import pytest
from mcap.reader import make_reader

import graphslam
from graphslam.logs import LogWriter

LOGS = Path(__file__).parents[2] / "logs"
S = 1_000_000_000


def with_a_pause(source, target, begin_s, pause_s):
    """The messages of a log but its scans of ``pause_s`` from ``begin_s`` on."""
    with source.open("rb") as stream:
        found = list(make_reader(stream).iter_messages(log_time_order=False))
    start_ns = min(message.log_time for *_, message in found)
    with LogWriter(target) as log:
        for schema, channel, message in found:
            seconds = (message.log_time - start_ns) / S
            if channel.topic.endswith("scan") and begin_s < seconds < begin_s + pause_s:
                continue
            log.encoded(channel.topic, schema.name, message.data, message.log_time)
    return target


@pytest.mark.parametrize(
    ("name", "begin_s", "pause_s"), [("office-loop", 125, 20), ("corridor", 20, 6)]
)
def test_a_corridor_that_looks_like_itself_denies_no_odometry(name, begin_s, pause_s, tmp_path):
    """Most of the scans at both ends is the same if the robot stood: 10 and 3 m off, and good."""
    path = with_a_pause(LOGS / f"{name}.mcap", tmp_path / "log.mcap", begin_s, pause_s)
    result = graphslam.smooth(path)
    assert result.summary["verdict"]["verdict"] == "good"
    found = graphslam.evaluate(result)["joint"]["final"]
    assert found["ate_aligned_rmse_m"] < 0.03  # without the pause 0.004 and 0.01
