"""Tables: the same drive as CSV and TUM gives the same records, and odd lines are counted.

Names of columns, their units and names of files are in `test_csv_names.py`.
"""

import numpy as np
import pytest
from room_log import MOUNT, drive

import graphslam
from graphslam.core import records
from graphslam.core.config import Config
from graphslam.core.errors import LogError
from graphslam.importers import IMPORTERS
from graphslam.logs import open_logs, read_truth


def seconds(ns: int) -> str:
    return f"{ns // 10**9}.{ns % 10**9:09d}"


def numbers(values) -> str:
    return ",".join("" if np.isnan(v) else repr(float(v)) for v in values)


def tables(log, folder, kind: str, prefix: str = ""):
    """The messages of a log as tables."""
    folder.mkdir(exist_ok=True)
    lines = {"odometry": [], "scans": ["stamp,first,step,ranges"], "truth": ["# true poses"]}
    for message in open_logs([log], Config()).messages():
        stamp = seconds(message.stamp_ns)
        if isinstance(message, records.Scan):
            shape = (message.angle_min_rad, message.angle_step_rad)
            lines["scans"].append(f"{stamp},{numbers(shape)},{numbers(message.ranges)}")
            continue
        name = "truth" if isinstance(message, records.Truth) else "odometry"
        x, y, phi = message.pose
        text = f"{stamp},{numbers((x, y, phi))}"
        if kind == "tum":
            values = (x, y, 0.5, 0.0, 0.0, np.sin(phi / 2), np.cos(phi / 2))
            text = f"{stamp} {numbers(values).replace(',', ' ')}"
        lines[name].append(text)
    for name, own in lines.items():
        suffix = "csv" if name == "scans" else kind
        (folder / f"{prefix}{name}.{suffix}").write_text("\n".join(own))
    (folder / f"{prefix}laser.csv").write_text("x,y,heading\n" + numbers(MOUNT))
    (folder / "notes.txt").write_text("not looked at")
    return folder


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return drive(tmp_path_factory.mktemp("drive") / "drive.mcap")


@pytest.mark.parametrize("kind", ["csv", "tum"])
def test_tables_give_the_same_trajectory_and_truth(kind, log, tmp_path):
    source = tables(log, tmp_path / "tables", kind)
    target = tmp_path / "log.mcap"
    assert not IMPORTERS["csv"](source, target).warnings
    found, expected = (list(open_logs([p], Config()).messages()) for p in (target, log))
    assert [(type(m), m.stamp_ns) for m in found] == [(type(m), m.stamp_ns) for m in expected]
    mine, theirs = (graphslam.smooth(p).robots["robot"].final for p in (target, log))
    # headings written again as text or quaternion differ by 1e-16, which is not read
    np.testing.assert_array_equal(mine.poses, theirs.poses)
    mine, theirs = (read_truth([p], Config()).trajectories["robot"] for p in (target, log))
    np.testing.assert_allclose(mine.poses, theirs.poses, atol=1e-12)


def test_robots_are_named_by_the_files(log, tmp_path):
    for name in ("a", "b"):
        source = tables(log, tmp_path / "tables", "csv", f"{name}.")
    IMPORTERS["csv"](source, tmp_path / "log.mcap")
    assert open_logs([tmp_path / "log.mcap"], Config()).robots == ("a", "b")


def test_lines_that_cannot_be_read_are_counted_and_a_file_of_them_is_refused(log, tmp_path):
    source = tables(log, tmp_path / "tables", "csv")
    path = source / "odometry.csv"
    path.write_text(path.read_text() + "\n1.0,2\nnonsense\n")
    (warning,) = IMPORTERS["csv"](source, tmp_path / "log.mcap").warnings
    assert "2 lines of odometry.csv cannot be read" in warning
    # stamps in nanoseconds, which others write too
    path.write_text("1700000000123456789,0,0,0\n1700000000223456789,0,0,0\n")
    with pytest.raises(LogError, match="stamps are seconds"):
        IMPORTERS["csv"](source, tmp_path / "log.mcap")


def poses_of(folder, name, text):
    """What the odometry of a log is that was imported from such a table."""
    source = folder / name
    source.mkdir()
    (source / "odometry.csv").write_text(text)
    target = folder / f"{name}.mcap"
    assert IMPORTERS["csv"](source, target).warnings == ()
    return [(m.stamp_ns, *m.pose) for m in open_logs([target], Config()).messages()]


POSES = np.column_stack(
    [np.arange(9) / 10, np.arange(9) / 100, -np.arange(9) / 50, np.full(9, 0.25)]
)


@pytest.mark.parametrize("names", ["", "# a log\n\nstamp{0}x{0}y{0}phi\n", "\ufeff"])
@pytest.mark.parametrize(
    ("separator", "decimal"),
    [
        (";", ","),
        (" ; ", ","),
        ("\t", ","),
        *((s, ".") for s in (";", ",", " , ", ", ", "  ", "\t")),
    ],
)
def test_columns_are_separated_by_one_thing_in_a_file(names, separator, decimal, tmp_path):
    """With semicolons numbers may have decimal commas, as spreadsheets of many countries write."""
    lines = [separator.join(f"{v:.3f}".replace(".", decimal) for v in row) for row in POSES]
    found = poses_of(tmp_path, "log", names.format(separator) + "\n".join(lines))
    assert [f[0] for f in found] == [100_000_000 * k for k in range(9)]
    np.testing.assert_allclose([f[1:] for f in found], POSES[:, 1:], atol=1e-12)


@pytest.mark.parametrize(
    "text",
    [
        "stamp,x,y,phi\n" + "0,1,0,01,0,0,0,0\n" * 5,  # decimal commas between commas
        "0,1 0,01 0,0 0,0\n" * 5,  # and between blanks
        "0,1\t 0,01 \t0,0 0,0\n" * 5,  # some of which are tabs
    ],
)
def test_decimal_commas_that_cannot_be_told_are_refused(text, tmp_path):
    (tmp_path / "odometry.csv").write_text(text)
    with pytest.raises(LogError, match=r"odometry.csv has no usable line.*commas only if ;"):
        IMPORTERS["csv"](tmp_path, tmp_path / "log.mcap")


def test_a_line_of_poses_with_another_number_of_columns_is_counted(tmp_path):
    lines = [",".join(map(str, row)) for row in POSES]
    lines[3] += ",0,0"
    (tmp_path / "odometry.csv").write_text("\n".join(lines))
    (warning,) = IMPORTERS["csv"](tmp_path, tmp_path / "log.mcap").warnings
    assert "1 lines of odometry.csv cannot be read" in warning


@pytest.mark.parametrize("text", ["x=0.3,y=0.1,phi=0\n", "0.3 0.1\n", "x,y\n0.3,0.1\n", ""])
def test_a_mount_that_cannot_be_read_is_not_that_of_a_laser_at_the_base(text, log, tmp_path):
    source = tables(log, tmp_path / "tables", "csv")
    (source / "laser.csv").write_text(text)
    why = r"laser.csv (has no usable line|names its columns x, y).*x m, y m, heading rad"
    with pytest.raises(LogError, match=why):
        IMPORTERS["csv"](source, tmp_path / "log.mcap")


def test_empty_columns_between_tabs_are_beams_without_return(tmp_path):
    """Also the first and the last; they are not merged, and lines of comments stay comments."""
    (tmp_path / "odometry.csv").write_text(" \t# poses\n\t\n1.0\t0,5\t0\t0,25\n")
    (tmp_path / "scans.csv").write_text("1.0\t-0,5\t0,1\t\t\t2,5\t\t3\t\t\r\n")
    assert IMPORTERS["csv"](tmp_path, tmp_path / "log.mcap").warnings == ()
    odometry, scan = open_logs([tmp_path / "log.mcap"], Config()).messages()
    assert tuple(odometry.pose) == (0.5, 0.0, 0.25)
    nothing = np.nan
    np.testing.assert_array_equal(
        np.where(np.isfinite(scan.ranges), scan.ranges, nothing),
        [nothing, nothing, 2.5, nothing, 3.0, nothing, nothing],
    )
    assert (scan.angle_min_rad, scan.angle_step_rad) == pytest.approx((-0.5, 0.1))


def test_a_line_that_begins_with_a_tab_has_no_stamp(tmp_path):
    """Its first column is empty: the next one is not taken for the stamp."""
    (tmp_path / "odometry.csv").write_text("1\t0\t0\t0\t9\n" * 3 + "\t2\t0\t0\t0\t0\n")
    summary = IMPORTERS["csv"](tmp_path, tmp_path / "log.mcap")
    assert summary.counts["/odom"] == 3
    assert "1 lines of odometry.csv cannot be read" in summary.warnings[0]


def test_tabs_behind_commas_align_columns(tmp_path):
    found = poses_of(tmp_path, "log", "0.5,\t1.5,\t0.5,\t0.25\n" * 3)
    assert {f[1:] for f in found} == {(1.5, 0.5, 0.25)}
