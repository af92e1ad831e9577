"""tinySLAM logs: ticks, ranges, and the geometry that the format implies."""

import numpy as np
import pytest
from paths import real_data

from graphslam.core import records
from graphslam.core.config import Config
from graphslam.core.errors import LogError
from graphslam.importers import IMPORTERS
from graphslam.logs import open_logs


def line(time_us, left, right, ranges):
    return " ".join(map(str, [time_us, 14710, left, right, *[0] * 20, *ranges, 0]))


def imported(source, target):
    summary = IMPORTERS["tinyslam"](source, target)
    log = open_logs([target], Config())
    return summary, log, list(log.messages())


def test_ticks_and_ranges_are_those_of_the_file(tmp_path):
    """2000 ticks are one turn; millimetres; beam 0 points to -120 degrees; 0 is no return."""
    ranges = np.full(682, 1500)
    ranges[0], ranges[681] = 0, 2250
    source = tmp_path / "log.dat"
    source.write_text(
        line(212387282, 29221, 25178, ranges) + "\n" + line(212484734, 31221, 25678, ranges) + "\n"
    )
    _, log, messages = imported(source, tmp_path / "log.mcap")
    first, second = (m for m in messages if isinstance(m, records.WheelAngles))
    assert (first.stamp_ns, second.stamp_ns) == (212387282000, 212484734000)
    # ticks of the file times 2 pi / 2000, in double precision
    assert second.left_rad - first.left_rad == pytest.approx(2 * np.pi, abs=1e-9)
    assert second.right_rad - first.right_rad == pytest.approx(np.pi / 2, abs=1e-9)
    scan = next(m for m in messages if isinstance(m, records.Scan))
    assert np.isnan(scan.ranges[0]) and len(scan.ranges) == 682
    # float32 ranges and angles of LaserScan
    assert scan.ranges[681] == pytest.approx(2.25, abs=1e-6)
    np.testing.assert_allclose(scan.angles[[0, 681]], np.deg2rad([-120, 120]), atol=1e-4)
    np.testing.assert_allclose(scan.mount, [0.145, 0, 0], atol=1e-12)
    assert log.notes["robots.robot.axle_m"] == "0.33"


def test_other_lines_are_counted(tmp_path):
    """A line that was cut off is not a scan; a file without any scan is refused."""
    source = tmp_path / "log.dat"
    source.write_text(line(1000, 1, 1, np.full(682, 1000)) + "\n1 2 3\n")
    summary, _, messages = imported(source, tmp_path / "log.mcap")
    assert summary.warnings == (f"{source}: 1 lines cannot be read, the first is 2",)
    assert len(messages) == 2
    source.write_text("1 2 3\n")
    with pytest.raises(LogError, match="is it tinySLAM"):
        IMPORTERS["tinyslam"](source, tmp_path / "none.mcap")


@pytest.mark.parametrize(("name", "scans"), [("exp1.dat.xz", 756), ("exp2.dat.xz", 641)])
def test_real_logs(name, scans, tmp_path):
    """Every line is a scan and a pair of ticks."""
    summary, _, _ = imported(real_data(f"tinyslam/{name}"), tmp_path / "log.mcap")
    assert summary.counts["/scan"] == summary.counts["/joint_states"] == scans
    assert not summary.warnings
