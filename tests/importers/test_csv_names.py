"""Tables: columns by their names, units by what is plausible, files by their names."""

import re
import zipfile

import numpy as np
import pytest

from graphslam.core.config import Config
from graphslam.core.errors import LogError
from graphslam.importers import IMPORTERS
from graphslam.logs import open_logs, read_truth

#: stamp s, x m, y m, heading rad
POSES = np.column_stack(
    [1 + np.arange(9) / 8, np.arange(9) / 4, -np.arange(9) / 2, np.linspace(-3, 3, 9)]
)
ONE_POSE = "1,0,0,0\n"


def imported(folder, **texts):
    """Summary and messages of the log that is imported from such tables."""
    source = folder / "tables"
    source.mkdir()
    for name, text in texts.items():
        (source / f"{name}.csv").write_text(text)
    target = folder / "log.mcap"
    summary = IMPORTERS["csv"](source, target)
    return summary, list(open_logs([target], Config()).messages())


def refusal(folder, **texts):
    with pytest.raises(LogError) as caught:
        imported(folder, **texts)
    assert "\n" not in str(caught.value) and not (folder / "log.mcap").exists()
    return str(caught.value)


def table(names, columns, separator=","):
    """Text of the named columns of `POSES`, or of what follows from them."""
    stamp, x, y, phi = POSES.T
    own = {
        "stamp": stamp,
        "x": x,
        "y": y,
        "phi": phi,
        "z": np.full(9, 0.5),
        "0": np.zeros(9),
        "qz": np.sin(phi / 2),
        "qw": np.cos(phi / 2),
    }
    rows = zip(*(own[column] for column in columns.split()), strict=True)
    lines = (separator.join(repr(float(value)) for value in row) for row in rows)
    return names + "\n" + "\n".join(lines) + "\n"


# ---------------------------------------------------------------- columns of poses


@pytest.mark.parametrize(
    ("names", "columns"),
    [
        ("stamp,x,y,z,qx,qy,qz,qw", "stamp x y z 0 0 qz qw"),
        ("x,y,theta,stamp", "x y phi stamp"),
        ("Time, Y [m], X (m), Yaw_rad", "stamp y x phi"),
        ('"","timestamp","speed","x_m","y_m","phi"', "0 stamp z x y phi"),
        ("t_s,qw,qx,qy,qz,position_x,position_y,yaw", "stamp qw 0 0 qz x y z"),
        ("# y,x,heading,stamp", "y x phi stamp"),  # as numpy writes names
        ("# a drive\n# timestamp tx ty tz qx qy qz qw", "stamp x y z 0 0 qz qw"),
        ("stamp y x phi", "stamp y x phi"),
        ("a,b,c,d", "stamp x y phi"),
        ("# x is ahead", "stamp x y phi"),
        ("poses in the frame x", "stamp x y phi"),
    ],
)
@pytest.mark.parametrize("separator", [",", "\t", ";", " "])
def test_columns_are_those_of_their_names(names, columns, separator, tmp_path):
    """In any order, with others between; names that are not known leave the usual order."""
    if "," in names:
        names = names.replace(",", separator)
    text = table(names, columns, separator)
    summary, found = imported(tmp_path, odometry=text, truth=text)
    assert summary.warnings == ()
    assert [m.stamp_ns for m in found[::2]] == [125_000_000 * (8 + k) for k in range(9)]
    true = read_truth([tmp_path / "log.mcap"], Config()).trajectories["robot"].poses
    for poses in (true, [m.pose for m in found[::2]]):
        np.testing.assert_allclose(poses, POSES[:, 1:], atol=1e-12)


@pytest.mark.parametrize(
    ("names", "columns", "why"),
    [
        ("x,y,stamp", "x y stamp", "none is heading"),
        ("a,x,y,theta", "stamp x y phi", "none is stamp"),
        ("stamp,x,y,qz", "stamp x y qz", "none is heading"),
        ("stamp,time,x,y,yaw", "stamp stamp x y phi", "more than one is stamp: stamp, time"),
        ("secs,nsecs,x,y,yaw", "stamp 0 x y phi", "nsecs is in another unit"),
        ("stamp,x,y,theta_deg", "stamp x y phi", "theta_deg is in another unit"),
        ("stamp,x,y,yaw [deg]", "stamp x y phi", "is in another unit"),
        ("stamp_sec,stamp_nanosec,x,y,yaw", "stamp 0 x y phi", "more than one is stamp"),
        ("stamp_ns,x,y,theta", "stamp x y phi", "stamp_ns is in another unit"),
        ("stamp,x_mm,y_mm,theta", "stamp x y phi", "x_mm is in another unit"),
        ("# stamp,x,y,theta_deg", "stamp x y phi", "theta_deg is in another unit"),
        ("stamp x y z qx qy qz qw", "0 stamp x y z 0 0 qz qw", "another number of columns"),
    ],
)
def test_names_that_leave_a_column_open_are_refused(names, columns, why, tmp_path):
    """In one line with the file, its names and those that are expected."""
    text = table(names, columns, "," if "," in names else " ")
    told = refusal(tmp_path, odometry=text)
    assert "odometry.csv names its columns" in told and re.search(why, told)
    assert names.split()[-1].split(",")[-1] in told
    assert "stamp (s), x and y (m), and heading (rad) or qx, qy, qz, qw" in told


def test_a_refusal_shows_what_can_be_printed_of_names_and_not_all_of_many(tmp_path):
    names = ",".join(["x", "\x1b[31m", "a" * 1000, *(f"c{k}" for k in range(1000))])
    told = refusal(tmp_path, odometry=f"{names}\n1,0,0,0\n")
    assert "\x1b" not in told and len(told) < 1000 and "a" * 40 + ", c0" in told


# ---------------------------------------------------------------- columns of scans and mounts


@pytest.mark.parametrize(
    ("names", "row"),
    [
        ("stamp,angle_min,angle_max,angle_increment,ranges", "1,-0.5,9,0.25,2,,3"),
        ("range_0,range_1,range_2,step,first,time", "2,,3,0.25,-0.5,1"),
        ("stamp,first,step,r0,r1,r2,intensity_0,intensity_1", "1,-0.5,0.25,2,,3,77,78"),
        ("stamp,first,step,r0,r1,...", "1,-0.5,0.25,2,,3"),
        ("stamp,step_rad,first_rad,a,b,c", "1,0.25,-0.5,2,,3"),
        ("a,b,c", "1,-0.5,0.25,2,,3"),
    ],
)
def test_columns_of_scans_are_those_of_their_names(names, row, tmp_path):
    _, (_, scan) = imported(tmp_path, odometry=ONE_POSE, scans=f"{names}\n{row}\n")
    assert (scan.angle_min_rad, scan.angle_step_rad) == (-0.5, 0.25)
    np.testing.assert_array_equal(
        np.where(np.isfinite(scan.ranges), scan.ranges, np.nan), [2.0, np.nan, 3.0]
    )


@pytest.mark.parametrize(
    ("names", "why"),
    [
        ("stamp,angle_min,angle_max,ranges", "none is step"),
        ("stamp,frame,first,step,b0", "none is ranges"),
        ("stamp,first,step,ranges,intensities", "others follow ranges"),
        ("stamp,first,step,r0,i0,r1,i1", "not in a row"),
        ("stamp,first_deg,step_deg,ranges", "first_deg is in another unit"),
        ("stamp,first,step,ranges_mm", "ranges_mm is in another unit"),
    ],
)
def test_names_that_leave_a_column_of_scans_open_are_refused(names, why, tmp_path):
    told = refusal(tmp_path, odometry=ONE_POSE, scans=f"{names}\n1,0,0.1,2,3,4,5\n")
    assert "scans.csv names its columns" in told and why in told and "first and step (rad)" in told


@pytest.mark.parametrize("text", ["yaw,y,x\n0.25,0,0.5\n", "0.5,0,0.25\n"])
def test_the_mount_is_that_of_the_named_columns(text, tmp_path):
    _, (_, scan) = imported(tmp_path, odometry=ONE_POSE, scans="1,0,0.1,2\n", laser=text)
    np.testing.assert_allclose(scan.mount, (0.5, 0.0, 0.25), atol=1e-12)


# ---------------------------------------------------------------- units


def circle(unit=1.0, step_s=0.1, rows=200, unwrapped=False):
    """A drive around a circle of 5 m, 4 turns; headings in ``unit`` per rad."""
    turn = np.linspace(0, 8 * np.pi, rows)
    heading = turn + 0.0 if unwrapped else (turn + np.pi) % (2 * np.pi) - np.pi
    x, y = 5 * np.sin(turn), 5 - 5 * np.cos(turn)
    return np.column_stack([1 + step_s * np.arange(rows), x, y, unit * heading])


def text_of(rows, names=""):
    return names + "".join(",".join(map(repr, map(float, row))) + "\n" for row in rows)


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("unwrapped", [False, True])
def test_headings_in_degrees_are_asked_about(unwrapped, backwards, tmp_path):
    rows = circle(180 / np.pi, unwrapped=unwrapped)
    if backwards:  # half of the time
        rows[100:, 3] += 180
    summary, _ = imported(tmp_path, odometry=text_of(rows))
    (warning,) = summary.warnings
    assert "odometry.csv: are its headings in degrees?" in warning


def test_stamps_in_milliseconds_are_asked_about(tmp_path):
    summary, _ = imported(tmp_path, odometry=text_of(circle(step_s=100)))
    (warning,) = summary.warnings
    assert "odometry.csv: are its stamps in milliseconds?" in warning


def spinning(rows=200):
    """A robot that turns on and on while it moves in one direction."""
    ahead = np.linspace(0, 10, rows)
    return np.column_stack([1 + ahead, ahead, 0 * ahead, np.linspace(0, 30, rows)])


@pytest.mark.parametrize(
    "text",
    [
        text_of(circle()),
        text_of(circle(unwrapped=True)),  # headings that were added up
        text_of(circle(unwrapped=True) + np.array([0, 0, 0, 100])),
        text_of(circle(180 / np.pi, step_s=100), "stamp_s,x_m,y_m,heading_rad\n"),  # told
        text_of(spinning()),
        text_of(circle(180 / np.pi) * [1, 0, 0, 1]),  # on the spot
        "1,1e308,0,50\n1,-1e308,0,50\n" * 20,
        "1,1,0,-1e308\n1,2,0,1.5e308\n" * 20,
    ],
    ids=["radians", "unwrapped", "offset", "named", "spinning", "spot", "far", "huge"],
)
def test_units_that_are_as_they_should_be_raise_no_question(text, tmp_path):
    source = tmp_path / "odometry.csv"
    source.write_text(text)
    assert IMPORTERS["csv"](tmp_path, tmp_path / "log.mcap").warnings == ()


def test_few_true_poses_may_be_far_apart(tmp_path):
    rows = circle(step_s=100, rows=40)
    assert imported(tmp_path, odometry=ONE_POSE, truth=text_of(rows))[0].warnings == ()


# ---------------------------------------------------------------- names of files


@pytest.mark.parametrize("name", ["Scans.csv", "scans.CSV", "SCANS.csv"])
def test_names_of_files_are_the_same_in_upper_and_lower_case(name, tmp_path):
    (tmp_path / "Odometry.CSV").write_text(ONE_POSE)
    (tmp_path / name).write_text("1,0,0.1,2\n")
    summary = IMPORTERS["csv"](tmp_path, tmp_path / "log.mcap")
    assert summary.counts["/scan"] == 1 and summary.warnings == ()


@pytest.mark.parametrize("packed", [False, True])
def test_tables_that_are_not_used_are_named(packed, tmp_path):
    source = tmp_path / ("log.zip" if packed else "log")
    names = ("odometry.csv", "scan.csv", "gps.TUM", "notes.txt", "._odometry.csv")
    if packed:
        with zipfile.ZipFile(source, "w") as archive:
            for name in names:
                archive.writestr(f"drive/{name}", ONE_POSE)
    else:
        source.mkdir()
        for name in names:
            (source / name).write_text(ONE_POSE)
    (warning,) = IMPORTERS["csv"](source, tmp_path / "log.mcap").warnings
    assert "gps.TUM, scan.csv are not used: files are called odometry.csv" in warning


def test_one_table_that_is_not_used_is_named_alone_and_not_all_of_many(tmp_path):
    (tmp_path / "scan.csv").write_text("")
    with pytest.raises(LogError, match=r"has no odometry.csv.*; it has scan.csv; is it"):
        IMPORTERS["csv"](tmp_path, tmp_path / "log.mcap")
    (tmp_path / "odometry.csv").write_text(ONE_POSE)
    (warning,) = IMPORTERS["csv"](tmp_path, tmp_path / "log.mcap").warnings
    assert "scan.csv is not used: files are called" in warning
    for k in range(100):
        (tmp_path / f"part{k}.csv").write_text("")
    (warning,) = IMPORTERS["csv"](tmp_path, tmp_path / "two.mcap").warnings
    assert "and 91 more are not used" in warning


@pytest.mark.parametrize("other", ["Odometry.csv", "odometry.tum"])
def test_two_files_of_one_kind_are_refused(other, tmp_path):
    """The poses of both would be one path that jumps."""
    (tmp_path / "odometry.csv").write_text(ONE_POSE)
    (tmp_path / other).write_text("1 0 0 0 0 0 0 1\n")
    with pytest.raises(LogError, match=r"has both .*; leave one of them"):
        IMPORTERS["csv"](tmp_path, tmp_path / "log.mcap")
