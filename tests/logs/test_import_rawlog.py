"""Rawlogs of MRPT: what its own writer made of a drive gives the trajectory of that drive.

`rawlog/pairs.rawlog` and `rawlog/observations.rawlog` are the drive of `written`, simulated here,
as `rawlog/write_rawlog.cpp` writes it with MRPT 2.5.8 (Debian: libmrpt-dev). To make them again:
`write_tables(FOLDER)`, then `write_rawlog FOLDER pairs|observations FILE`.
"""

import gzip
import struct
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from room_log import MOUNT, ROOM, S, true_pose
from walls import cast

import graphslam
from graphslam.core import records
from graphslam.core.config import Config
from graphslam.core.errors import LogError
from graphslam.core.geometry import between, compose
from graphslam.logs import IMPORTERS, LogWriter, open_logs, schemas
from graphslam.logs.cdr_writing import imu_bytes

HERE = Path(__file__).parent / "rawlog"
FORMS = ("pairs", "observations")
START_NS = 1_700_000_000 * S
#: 97 beams over 3 rad: what float32 holds, as the format does
VIEW, BEAMS, RANGE_MAX = 3.0, 97, 5.0


@cache
def written():
    """Of every stamp, 5 a second: odometry, rate of turning, and each second ranges, inf or mm.

    All numbers are decimals, so that they are the same on every machine.
    """
    found, pose, angles = {}, np.zeros(3), np.linspace(-VIEW / 2, VIEW / 2, BEAMS)
    for k in range(151):
        true = true_pose(k / 5)
        moved = between(true_pose((k - 1) / 5), true) if k else np.zeros(3)
        pose = compose(pose, moved * [1.03, 1, 1] + [0, 0, 0.02 * np.hypot(*moved[:2])]).round(6)
        ranges = None
        if k % 5 == 0:
            ranges = cast(ROOM, angles, compose(true, MOUNT), RANGE_MAX).round(3)
            ranges = np.where(np.isnan(ranges), np.inf, ranges)
        found[START_NS + k * S // 5] = pose, round(5 * moved[2], 4), ranges
    return found


def write_tables(folder):
    """The drive as `write_rawlog.cpp` reads it; 0 is no return."""
    folder.mkdir(exist_ok=True)
    lines = {"odometry": [], "rates": [], "scans": [], "mount": [(0, *MOUNT)]}
    for stamp, (pose, rate, ranges) in written().items():
        lines["odometry"].append((stamp, *pose))
        lines["rates"].append((stamp, rate))
        if ranges is not None:
            there = np.where(np.isfinite(ranges), ranges, 0)
            lines["scans"].append((stamp, VIEW, RANGE_MAX, *there))
    for name, own in lines.items():
        text = "".join(" ".join(map(str, row)) + "\n" for row in own)
        (folder / f"{name}.txt").write_text(text)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """The drive as MCAP."""
    path = tmp_path_factory.mktemp("rawlog") / "drive.mcap"
    with LogWriter(path) as log:
        log.mount("robot", START_NS, MOUNT)
        for stamp, (pose, rate, ranges) in written().items():
            log.odometry("robot", stamp, pose)
            log.encoded("/imu", schemas.IMU, imu_bytes(stamp, "base_link", rate), stamp)
            if ranges is not None:
                log.scan("robot", stamp, ranges, angle_min_rad=-VIEW / 2,
                         angle_step_rad=VIEW / (BEAMS - 1), range_max_m=RANGE_MAX)  # fmt: skip
    return path


def imported(source, folder):
    """The summary and the messages of an imported rawlog."""
    summary = IMPORTERS["rawlog"](source, folder / "log.mcap")
    return summary, list(open_logs([folder / "log.mcap"], Config()).messages())


@pytest.mark.parametrize("form", FORMS)
def test_what_mrpt_wrote_gives_the_same_trajectory(form, log, tmp_path):
    """Counterclockwise scans and added motions in one form, clockwise and readings in the other.

    To 1e-9 m and rad: the motions of the pairs are differences of the poses, rounded at 1e-16.
    """
    summary, found = imported(HERE / f"{form}.rawlog", tmp_path)
    expected = list(open_logs([log], Config()).messages())
    assert [(type(m), m.stamp_ns) for m in found] == [(type(m), m.stamp_ns) for m in expected]
    assert sum("CObservationRange are not used" in line for line in summary.warnings) == 1
    assert summary.counts == {"/tf_static": 1, "/odom": 151, "/imu": 151, "/scan": 31}
    mine, theirs = (graphslam.smooth(p).robots["robot"] for p in (tmp_path / "log.mcap", log))
    np.testing.assert_array_equal(mine.final.stamps_ns, theirs.final.stamps_ns)
    np.testing.assert_allclose(mine.final.poses, theirs.final.poses, rtol=0, atol=1e-9)
