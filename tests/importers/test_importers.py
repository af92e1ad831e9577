"""Importers: what other programs make of the source is what our log says, to the digit."""

import bz2
import gzip
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from paths import real_data

from graphslam.core import geometry, records
from graphslam.core.config import Config
from graphslam.core.errors import LogError
from graphslam.core.geometry import rotation3
from graphslam.importers import IMPORTERS, pose_stamp_ns
from graphslam.importers.import_carmen import parse_stamp_ns
from graphslam.importers.import_pose_graph import PoseGraphEdge, reverse_edge
from graphslam.logs import open_logs


def example(name: str) -> Path:
    return Path(gtsam.findExampleDataFile(name))


def run(name: str, source: Path, target: Path) -> list[records.Message]:
    summary = IMPORTERS[name](source, target)
    messages = list(open_logs([target], Config()).messages())
    tf = summary.counts.get("/tf_static", 0)
    assert sum(summary.counts.values()) - tf == len(messages)
    return messages


# ---------------------------------------------------------------- every importer


@pytest.mark.parametrize("name", IMPORTERS)
def test_bad_sources_get_one_line_and_leave_no_file(name, tmp_path):
    target = tmp_path / "log.mcap"
    empty, noise = tmp_path / "empty.txt", tmp_path / "noise.gz"
    empty.write_text("")
    noise.write_bytes(b"no gzip at all")
    # an MRCLAM set may be a folder; this one holds none of its files
    lacking = {"mrclam": "has no RobotN_Odometry.dat", "csv": "has no odometry.csv"}
    folder = lacking.get(name, "is a directory")
    # no log of ROS is packed with gzip, and a rawlog need not be
    others = {"rosbag": "is not an MCAP file", "rawlog": "no object begins"}
    no_gzip = others.get(name, "cannot be read to its end")
    for source, why in (
        (tmp_path / "missing", "no such file"),
        (tmp_path, folder),
        (empty, "is it"),
        (noise, no_gzip),
    ):
        with pytest.raises(LogError, match=why) as caught:
            IMPORTERS[name](source, target)
        assert "\n" not in str(caught.value) and str(source) in str(caught.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty.txt", "noise.gz"]


# ---------------------------------------------------------------- pose graphs

G2O = ["CSAIL.g2o", "CSAIL_outliers.g2o", "CSAIL_robot1.g2o", "CSAIL_robot2.g2o", "MIT.g2o"]
GRAPHS = ["victoria_park.txt", "w100.graph", "example.graph", *(f"graphs/{name}" for name in G2O)]


def gtsam_graph(source: Path) -> gtsam.NonlinearFactorGraph:
    read: Callable[..., tuple] = gtsam.load2D
    arguments = (str(source),)
    if source.suffix == ".g2o":
        read, arguments = gtsam.readG2o, (str(source), False)
    return read(*arguments)[0]


def covariance(factor: gtsam.NonlinearFactor) -> np.ndarray:
    """Covariance of a factor's noise model, in gtsam's convention."""
    R = factor.noiseModel().R()
    return np.linalg.inv(R.T @ R)


@pytest.mark.parametrize("name", GRAPHS)
def test_factors_are_those_that_gtsam_reads(name, tmp_path):
    """Measured values and covariances of all edges and sightings, compared one by one."""
    source = real_data(name) if "/" in name else example(name)
    messages = run("isam", source, tmp_path / "log.mcap")
    graph = gtsam_graph(source)
    keys, between, sighted = set(), [], []
    for i in range(graph.size()):
        factor = graph.at(i)
        if isinstance(factor, gtsam.BetweenFactorPose2):
            a, b = factor.keys()
            keys |= {a, b}
            m = factor.measured()
            edge = PoseGraphEdge(a, b, np.array([m.x(), m.y(), m.theta()]), covariance(factor))
            between.append(edge if a < b else reverse_edge(edge))
        else:
            pose, landmark = factor.keys()
            m = factor.measured()
            z = (m.bearing().theta(), m.range())
            sighted.append((pose, gtsam.Symbol(landmark).index(), *z, covariance(factor)))
    stamp = {key: pose_stamp_ns(k) for k, key in enumerate(sorted(keys))}

    poses = [m for m in messages if isinstance(m, records.OdometryIncrement | records.RelativePose)]
    assert len(poses) == len(between)
    ours = sorted(((m.start_ns, m.stamp_ns, *m.delta.round(9)), m) for m in _indexed(poses))
    theirs = sorted(
        ((stamp[e.start], stamp[e.end], *e.delta.round(9)), e) for e in _indexed(between)
    )
    for (_, mine), (_, edge) in zip(ours, theirs, strict=True):
        m, e = mine.item, edge.item
        assert (m.start_ns, m.stamp_ns) == (stamp[e.start], stamp[e.end])
        np.testing.assert_allclose(geometry.between(m.delta, e.delta), 0, atol=1e-9)
        M = rotation3(e.delta[2])
        np.testing.assert_allclose(M.T @ m.cov @ M, e.cov, rtol=1e-6, atol=1e-12)

    seen = sorted(
        (m.stamp_ns, int(m.identity), *m.z, *m.cov.ravel())
        for m in messages
        if isinstance(m, records.Sighting)
    )
    known = sorted((stamp[p], lm, b, r, *cov.ravel()) for p, lm, b, r, cov in sighted)
    assert len(seen) == len(known)
    if seen:
        np.testing.assert_allclose(seen, known, rtol=1e-9, atol=1e-12)


class _Item:
    """Wraps what cannot be compared, so that sorting looks at the keys only."""

    def __init__(self, item):
        self.item = item

    def __getattr__(self, name):
        return getattr(self.item, name)

    def __lt__(self, other):
        return False


def _indexed(items):
    return map(_Item, items)


def test_the_log_of_a_pose_graph_says_that_its_stamps_are_invented(tmp_path):
    target = tmp_path / "log.mcap"
    summary = IMPORTERS["isam"](example("victoria_park.txt"), target)
    logs = open_logs([target], Config())
    assert logs.notes["stamps"].startswith("invented")
    assert any("invented" in line for line in summary.warnings)
    assert summary.counts == {"/odom_increment": 6968, "/sightings": 3640}
    steps = [m for m in logs.messages() if isinstance(m, records.OdometryIncrement)]
    assert [s.stamp_ns - s.start_ns for s in steps] == [1_000_000_000] * 6968
    assert steps[0].start_ns == pose_stamp_ns(0) == 1_000_000_000


pose = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)


@given(pose, pose)
def test_a_turned_edge_has_the_same_error_at_any_state(delta, off):
    """gtsam evaluates both directions alike: the conversion is exact, not first order.

    To 1e-5, as gtsam's logarithm cancels at small angles: at 1e-9 rad it is good to seven digits.
    """
    cov = np.diag([0.1, 0.2, 0.3])
    there, back = PoseGraphEdge(0, 1, delta, cov), reverse_edge(PoseGraphEdge(0, 1, delta, cov))
    values = gtsam.Values()
    values.insert(0, gtsam.Pose2(1.0, 2.0, 0.5))
    values.insert(1, gtsam.Pose2(1.0, 2.0, 0.5) * gtsam.Pose2(*delta) * gtsam.Pose2(*(0.3 * off)))
    errors = [
        gtsam.BetweenFactorPose2(
            e.start, e.end, gtsam.Pose2(*e.delta), gtsam.noiseModel.Gaussian.Covariance(e.cov)
        ).error(values)
        for e in (there, back)
    ]
    np.testing.assert_allclose(errors[0], errors[1], rtol=1e-5, atol=1e-9)


def test_landmarks_of_g2o_files_are_not_lost(tmp_path):
    """gtsam drops LANDMARK2 lines silently; their information is in x and y."""
    source = tmp_path / "small.g2o"
    source.write_text(
        "EDGE_SE2 0 1 1 0 0 100 0 0 100 0 400\nEDGE_SE2_XY 1 2 3 4 25 0 25\n"
        "LANDMARK2 0 2 4 4 25 0 25\n"
    )
    sightings = [
        m for m in run("g2o", source, tmp_path / "log.mcap") if isinstance(m, records.Sighting)
    ]
    assert [m.identity for m in sightings] == ["2", "2"]
    np.testing.assert_allclose(sightings[1].z, [np.arctan2(4, 3), 5])
    # isotropic 0.2 m at 5 m
    np.testing.assert_allclose(sightings[1].cov, np.diag([(0.2 / 5) ** 2, 0.2**2]), atol=1e-15)


def test_where_odometry_breaks_another_robot_begins(tmp_path):
    """A closure leads from a pose of one to one of the other, the earlier first; files that were
    put together without a newline between them are still so many lines."""
    edge = "EDGE_SE2 {} {} 1 2 0.5 100 0 0 100 0 400"
    pairs = ((0, 1), (1, 2), (5, 6), (6, 7), (7, 1))
    source = tmp_path / "graph.g2o"
    source.write_text("".join(edge.format(*pair) for pair in pairs))
    summary = IMPORTERS["g2o"](source, tmp_path / "log.mcap")
    messages = list(open_logs([tmp_path / "log.mcap"], Config()).messages())
    second = 1_000_000_000
    assert [(m.robot, m.start_ns // second, m.time_ns // second) for m in messages] == [
        ("robot1", 1, 2),
        ("robot1", 2, 3),
        ("robot2", 4, 5),
        ("robot2", 5, 6),
        ("robot2", 2, 6),
    ]
    assert messages[-1].other == "robot1"
    assert any("start of robot2" in line for line in summary.warnings)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("ODOMETRY 0 1 1 0 0 1 0 0 1 0 1\nEDGE2 0 3 1 0 0 1 0 0 1 0 1\n", "pose 3 has no odometry"),
        ("ODOMETRY 0 1 1 0 zero 1 0 0 1 0 1\n", "line 1 .ODOMETRY."),
        ("ODOMETRY 0 1 1 0 0 1 0 0\n", "line 1 .ODOMETRY.: needs 6 finite numbers"),
        ("ODOMETRY 0 1 1 0 nan 1 0 0 1 0 1\n", "finite"),
        ("ODOMETRY 0 1 1 0 0 1 2 3 4 5 6\n", "noise is neither"),
        ("ODOMETRY 0 1 1 0 0 1 0 0 -1 0 1\n", "positive definite"),
        ("EDGE_SE2 0 1 1 0 0 1 0 0 0 0 1\n", "positive definite"),
        ("EDGE2 1 1 1 0 0 1 0 0 1 0 1\n", "the same pose"),
        ("VERTEX2 1 1 1 0\n", "no edge"),
    ],
)
def test_pose_graphs_that_make_no_sense_name_the_place(text, why, tmp_path):
    source = tmp_path / "graph.txt"
    source.write_text(text)
    with pytest.raises(LogError, match=why):
        IMPORTERS["isam"](source, tmp_path / "log.mcap")


# ---------------------------------------------------------------- CARMEN


@given(st.integers(0, 2**31 * 10**9 - 1))
def test_decimal_seconds_become_nanoseconds_exactly(nanoseconds):
    text = f"{nanoseconds // 10**9}.{nanoseconds % 10**9:09d}"
    assert parse_stamp_ns(text) == nanoseconds


@pytest.mark.parametrize("text", ["nan", "inf", "", "12:00", "1e10"])
def test_a_stamp_that_is_no_time_is_an_error(text):
    with pytest.raises(ValueError, match="not a time"):
        parse_stamp_ns(text)


LINES = """\
# message_name [message contents] ipc_timestamp ipc_hostname logger_timestamp
PARAM robot_frontlaser_offset 0.25 nohost 0
ODOM 0 0 0 0 0 0 100.000001 host 0.1
FLASER 3 1.25 2.5 81.83 0 0 0 0 0 0 100.5 host 0.2
ODOM 1 0 0.5 0 0 0 100.25 host 0.3
FLASER 3 1.25 2.5 0 0 0 0 0 0 100.6 host 0.2
FLASER two
ODOM broken 0 0 0 0 0 101 host 0.4
NMEA-GGA whatever
"""


@pytest.mark.parametrize("suffix", ["", ".gz", ".bz2"])
def test_carmen_lines_become_messages_in_the_order_of_the_file(suffix, tmp_path):
    source = tmp_path / f"log.clf{suffix}"
    pack = {"": lambda b: b, ".gz": gzip.compress, ".bz2": bz2.compress}[suffix]
    source.write_bytes(pack(LINES.encode()))
    target = tmp_path / "log.mcap"
    summary = IMPORTERS["carmen"](source, target)
    assert summary.counts == {"/tf_static": 1, "/odom": 2, "/scan": 1}
    assert summary.warnings == (
        f"{source}: 2 FLASER lines cannot be read",
        f"{source}: 1 ODOM lines cannot be read",
    )
    first, second, scan = open_logs([target], Config()).messages()
    assert (first.stamp_ns, second.stamp_ns) == (100_000_001_000, 100_250_000_000)
    assert isinstance(scan, records.Scan) and scan.stamp_ns == 100_500_000_000
    np.testing.assert_allclose(scan.mount, [0.25, 0, 0])
    np.testing.assert_array_equal(scan.ranges[:2], [1.25, 2.5])
    np.testing.assert_allclose(scan.angles, [-np.pi / 2, 0, np.pi / 2], atol=1e-6)


@pytest.mark.parametrize(("beams", "step_deg"), [(180, 1), (181, 1), (360, 0.5), (361, 0.5)])
def test_beams_are_spread_over_half_a_turn_from_the_right(beams, step_deg, tmp_path):
    source = tmp_path / "log.clf"
    ranges = " ".join(["1.0"] * beams)
    source.write_text(f"ODOM 0 0 0 0 0 0 1 h 0\nFLASER {beams} {ranges} 0 0 0 0 0 0 2 h 0\n")
    _, scan = run("carmen", source, tmp_path / "log.mcap")
    assert isinstance(scan, records.Scan)
    assert np.rad2deg(scan.angle_step_rad) == pytest.approx(step_deg, rel=1e-6)
    assert np.rad2deg(scan.angle_min_rad) == pytest.approx(-90, rel=1e-6)


# -------------------------------------------------------------- dialects of CARMEN

_MOUNT = np.array([0.3, -0.1, 0.2])
_END = "{stamp:.6f} host {stamp:.6f}"


def _carmen_drive() -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Stamp, pose of the robot and ranges of 90 scans on a circle."""
    rng = np.random.default_rng(5)
    return [
        (100 + 0.1 * k, np.array([np.cos(k / 30), np.sin(k / 30), k / 30]), 1 + rng.random(5))
        for k in range(90)
    ]


def _text(*numbers: object) -> str:
    return " ".join(f"{n:.9f}" if isinstance(n, float) else str(n) for n in numbers)


def _line(dialect: str, stamp: float, pose: np.ndarray, ranges: np.ndarray) -> str:
    laser = geometry.compose(pose, _MOUNT)
    beams, poses = [len(ranges), *ranges.tolist()], [*laser.tolist(), *pose.tolist()]
    shape = [0, -np.pi / 2, np.pi, np.pi / 4, 80.0, 0.01, 0]
    tail = [0.1, 0.0, 0.5, 0.5]
    middle = {
        "FLASER": [*beams, *poses],
        "RLASER": [*beams, *poses],
        "ROBOTLASER1": [*shape, *beams, 0, *poses, *tail, 0.0],
        "ROBOTLASER1 with remissions": [*shape, *beams, 5, *ranges.tolist(), *poses, *tail, 0.0],
        "ROBOTLASER1 of old logs": [*shape, *beams, *poses, *tail],
        "RAWLASER1": [*shape, *beams, 0],
        "REMISSIONFLASER": [len(ranges), *(v for r in ranges.tolist() for v in (r, 99.0))],
    }[dialect]
    return f"{dialect.split(maxsplit=1)[0]} {_text(*middle)} {_END.format(stamp=stamp)}"


DIALECTS = [
    "FLASER", "RLASER", "ROBOTLASER1", "ROBOTLASER1 with remissions", "ROBOTLASER1 of old logs",
]  # fmt: skip


@pytest.mark.parametrize("dialect", DIALECTS)
def test_without_odom_lines_the_odometry_and_the_mount_are_those_of_the_laser_lines(
    dialect, tmp_path
):
    """Many public logs are like that. Breaks if a field is counted wrongly."""
    source = tmp_path / "log.clf"
    drive = _carmen_drive()
    source.write_text("\n".join(_line(dialect, *one) for one in drive))
    summary = IMPORTERS["carmen"](source, tmp_path / "log.mcap")
    assert summary.warnings == (
        f"{source}: has no ODOM lines; the odometry is that in the lines of the laser",
    )
    messages = list(open_logs([tmp_path / "log.mcap"], Config()).messages())
    poses = [m.pose for m in messages if isinstance(m, records.OdometryPose)]
    scans = [m for m in messages if isinstance(m, records.Scan)]
    expected = np.array([pose for _, pose, _ in drive])
    np.testing.assert_allclose(geometry.between(expected, np.array(poses)), 0, atol=1e-8)
    assert len(scans) == len(drive)
    for scan, (stamp, _, ranges) in zip(scans, drive, strict=True):
        assert scan.stamp_ns == round(stamp * 1e6) * 1000
        np.testing.assert_allclose(scan.ranges, ranges, rtol=1e-6)
        np.testing.assert_allclose(scan.mount, _MOUNT, atol=2e-6)
        np.testing.assert_allclose(scan.angles, np.radians([-90, -45, 0, 45, 90]), atol=1e-6)


@pytest.mark.parametrize("dialect", ["RAWLASER1", "REMISSIONFLASER", "FLASER"])
def test_odom_lines_are_preferred_to_poses_in_other_lines(dialect, tmp_path):
    source = tmp_path / "log.clf"
    lines = []
    for k, one in enumerate(_carmen_drive()):
        if k % 10 == 0:
            lines.append(f"ODOM {_text(0.1 * k, 0.0, 0.0, 0, 0, 0)} {one[0]} host 1")
        lines.append(_line(dialect, *one))
    source.write_text("\n".join(lines))
    messages = run("carmen", source, tmp_path / "log.mcap")
    poses = [m.pose[0] for m in messages if isinstance(m, records.OdometryPose)]
    np.testing.assert_allclose(poses, range(9))
    assert sum(isinstance(m, records.Scan) for m in messages) == 90


def test_a_laser_that_is_logged_under_two_names_is_taken_once(tmp_path):
    source = tmp_path / "log.clf"
    drive = _carmen_drive()
    names = ("RAWLASER1", "ROBOTLASER1")
    source.write_text("\n".join(_line(name, *one) for one in drive for name in names))
    summary = IMPORTERS["carmen"](source, tmp_path / "log.mcap")
    assert summary.counts["/scan"] == len(drive)
    assert summary.warnings[0].endswith(
        "90 RAWLASER1 lines are not used: ROBOTLASER1 has this laser"
    )


def test_the_mount_of_a_laser_that_looks_back_is_on_both_sides_of_pi(tmp_path):
    """Headings of its lines are rounded, and the half turn is now positive, now negative."""
    source = tmp_path / "log.clf"
    back, lines = np.array([-0.3, 0.0, np.pi]), []
    for k, (stamp, pose, ranges) in enumerate(_carmen_drive()):
        laser = geometry.compose(pose, back) + np.array([0.0, 0.0, 1e-6 * (-1) ** k])
        numbers = [len(ranges), *ranges.tolist(), *laser.tolist(), *pose.tolist()]
        lines.append(f"RLASER {_text(*numbers)} {_END.format(stamp=stamp)}")
    source.write_text("\n".join(lines))
    messages = run("carmen", source, tmp_path / "log.mcap")
    for scan in (m for m in messages if isinstance(m, records.Scan)):
        np.testing.assert_allclose(geometry.between(back, scan.mount), 0.0, atol=2e-6)


def test_poses_of_the_laser_that_were_corrected_are_no_mount(tmp_path):
    """In corrected logs the first pose of FLASER is that of a SLAM program, not the odometry's."""
    source = tmp_path / "log.clf"
    lines = []
    for k, (stamp, pose, ranges) in enumerate(_carmen_drive()):
        laser = geometry.compose(pose, np.array([0.01 * k, 0.0, 0.0]))
        numbers = [len(ranges), *ranges.tolist(), *laser.tolist(), *pose.tolist()]
        lines.append(f"FLASER {_text(*numbers)} {_END.format(stamp=stamp)}")
    source.write_text("\n".join(lines))
    messages = run("carmen", source, tmp_path / "log.mcap")
    (mount,) = {m.mount.tobytes() for m in messages if isinstance(m, records.Scan)}
    assert not np.frombuffer(mount).any()


def test_true_positions_are_the_truth(tmp_path):
    source = tmp_path / "log.clf"
    lines = [f"ODOM 0 0 0 0 0 0 {k} host {k}" for k in range(3)]
    lines += [f"TRUEPOS {k} 2 0.5 0 0 0 {k} host {k}" for k in range(3)]
    source.write_text("\n".join(lines))
    truth = [
        m for m in run("carmen", source, tmp_path / "log.mcap") if isinstance(m, records.Truth)
    ]
    assert [m.pose.tolist() for m in truth] == [[k, 2, 0.5] for k in range(3)]


def test_intel_is_read_whole_with_its_stamps_and_in_the_order_of_the_recording(tmp_path):
    """With its late stamps the path of dead reckoning is 675 m; in the order of recording 509 m."""
    source, relations = real_data("freiburg/intel.clf.bz2"), real_data("freiburg/intel.relations")
    target = tmp_path / "intel.mcap"
    IMPORTERS["carmen"](source, target)
    logs = open_logs([target], Config())
    stamps, poses, last_ns = [], [], 0
    for message in logs.messages():
        assert message.time_ns >= last_ns
        last_ns = message.time_ns
        if isinstance(message, records.Scan):
            stamps.append(message.stamp_ns)
        elif isinstance(message, records.OdometryPose):
            poses.append(message.pose)
    assert len(stamps) == 13_631 and len(poses) == 26_915 and not logs.dropped
    path = np.hypot(*np.diff(np.array(poses)[:, :2], axis=0).T).sum()
    assert 505 < path < 512
    pairs = (line.split()[:2] for line in relations.read_text().splitlines())
    wanted = {int(Decimal(text) * 10**9) for pair in pairs for text in pair}
    assert wanted <= set(stamps)
    assert logs.no_return_m("/scan") == pytest.approx(81.83)
