"""The recordings in logs/: as large, as digested and as made as their page says."""

import hashlib
import re

import numpy as np
import pytest
from paths import LOGS

from graphslam.core.config_io import load_config
from graphslam.core.records import OdometryPose, Scan, Sighting
from graphslam.logs import open_logs, read_true_associations, read_truth
from graphslam.simulation import SCENARIOS, load_scenario, simulate

CONFIG = load_config()
LISTED = dict(
    re.findall(
        r"^\| `(\S+)` \| \d+ \| `([0-9a-f]{64})` \|$", (LOGS / "README.md").read_text(), re.M
    )
)


def test_every_recording_is_listed_and_every_scenario_has_one():
    files = {
        path.relative_to(LOGS).as_posix()
        for pattern in ("*.mcap", "*/*.mcap", "*/*.json")
        for path in LOGS.glob(pattern)
    }
    assert files == set(LISTED)
    assert {name.split("/")[0].removesuffix(".mcap") for name in LISTED} == set(SCENARIOS)


@pytest.mark.parametrize("name", LISTED)
def test_a_recording_is_the_listed_one_and_small(name):
    data = (LOGS / name).read_bytes()
    assert hashlib.sha256(data).hexdigest() == LISTED[name]
    assert len(data) <= 2_000_000


def test_a_recording_can_be_made_anew(tmp_path):
    """The same command gives the same log: every message, every stamp, every value.

    Not compared byte by byte: processors may differ in the last digit of a sine, which moves a
    value by 1e-15 and, where a range lies on the edge of two centimetres, one range by one.
    """
    simulate(load_scenario("two-robots"), tmp_path / "again.mcap", seed=0)
    paths = (LOGS / "two-robots.mcap", tmp_path / "again.mcap")
    kept, again = (list(open_logs([path], CONFIG).messages()) for path in paths)
    assert len(kept) == len(again)
    flipped = beams = 0
    for a, b in zip(kept, again, strict=True):
        assert (type(a), a.robot, a.stamp_ns) == (type(b), b.robot, b.stamp_ns)
        if isinstance(a, OdometryPose):
            np.testing.assert_allclose(a.pose, b.pose, atol=1e-9)
        elif isinstance(a, Sighting):
            np.testing.assert_allclose(a.z, b.z, atol=1e-9)
        elif isinstance(a, Scan):
            differ = ~np.isclose(a.ranges, b.ranges, atol=1e-6, equal_nan=True)
            flipped, beams = flipped + int(differ.sum()), beams + len(differ)
    assert beams and flipped <= 1e-4 * beams
    first, second = (read_truth([path], CONFIG) for path in paths)
    for robot, true in first.trajectories.items():
        np.testing.assert_allclose(true.poses, second.trajectories[robot].poses, atol=1e-9)
    first, second = (read_true_associations([path], CONFIG) for path in paths)
    assert {topic: len(found) for topic, found in first.items()} == {
        topic: len(found) for topic, found in second.items()
    }


def test_another_seed_makes_another_log(tmp_path):
    """What the comparison above would overlook if it compared nothing."""
    simulate(load_scenario("two-robots"), tmp_path / "other.mcap", seed=1)
    kept, other = (
        [m.pose for m in open_logs([path], CONFIG).messages() if isinstance(m, OdometryPose)]
        for path in (LOGS / "two-robots.mcap", tmp_path / "other.mcap")
    )
    assert np.abs(np.array(kept) - np.array(other)).max() > 1e-3
