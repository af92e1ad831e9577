"""Rawlogs of MRPT: what its own writer made of a drive gives the trajectory of that drive.

`rawlog/pairs.rawlog` and `rawlog/observations.rawlog` are the drive of `written`, simulated here,
as `rawlog/write_rawlog.cpp` writes it with MRPT 2.5.8 (Debian: libmrpt-dev). To make them again:
`write_tables(FOLDER)`, then `write_rawlog FOLDER pairs|observations FILE`.
"""

import gzip
import struct
import tracemalloc
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from room_log import MOUNT, ROOM, S, true_pose
from walls import cast

import graphslam
from graphslam.core import records
from graphslam.core.config import Config
from graphslam.core.errors import LogError
from graphslam.core.geometry import between, compose
from graphslam.importers import IMPORTERS
from graphslam.logs import LogWriter, open_logs, schemas
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


# ---------------------------------------------------------------- older layouts

#: 100 ns since 1601 of a second after `START_NS`
_TICKS = (START_NS + S) // 100 + 116_444_736_000_000_000


def packed(name, version, *fields):
    """An object: fields are bytes, or a format of `struct` with its numbers."""
    body = b"".join(f if isinstance(f, bytes) else struct.pack(f"<{f[0]}", *f[1:]) for f in fields)
    return bytes([0x80 + len(name)]) + name.encode() + bytes([version]) + body + b"\x88"


def matrix(values, kind="f"):
    name = "CMatrixD" if kind == "d" else "CMatrix"
    return packed(name, 0, ("2I", *values.shape), (f"{values.size}{kind}", *values.ravel()))


def pose2(version=0):
    return packed("CPose2D", version, ("3f" if version == 0 else "3d", 0.5, 0.25, 0.125))


#: a laser 0.5 m ahead, 0.25 m up, turned by 90 degrees
_TURNED = np.array([[0, -1, 0, 0.5], [1, 0, 0, 0], [0, 0, 1, 0.25], [0, 0, 0, 1.0]])


def pose3(version):
    half = np.sqrt(0.5)
    fields = {
        0: (matrix(_TURNED),),
        1: (matrix(_TURNED, "d"),),
        2: (("7d", 0.5, 0, 0.25, half, 0, 0, half),),
        3: (("12d", 0.5, 0, 0.25, *_TURNED[:3, :3].ravel()),),
    }
    return packed("CPose3D", version, *fields[version])


def text(value):
    return struct.pack("<I", len(value)) + value.encode()


def scan(version, pose=3, label="l", stamp=_TICKS, ranges=(1.5, 2.5, 8.0)):
    """A scan over half a turn whose third range is none."""
    count = len(ranges)
    fields = [("f?f", np.pi, True, 8.0), pose3(pose)]
    if version < 6:
        fields.append(matrix(np.zeros((6, 6))))
    fields.append((f"I{count}f", count, *ranges))
    fields += [bytes([1] * (count - 1) + [0])] * (version >= 1)
    fields += [("f", 0.01)] * (version >= 2) + [("Q", stamp)] * (version >= 3)
    fields += [("f", 0.0)] * (version >= 4) + [text(label), ("d", 0.0)] * (version >= 5)
    fields += [("?", True), (f"{count}i", *range(count))] * (version >= 7)
    fields += [("f", 0.1)] * (version >= 8)
    return packed("CObservation2DRangeScan", version, *fields)


def motion(version, matched=False, stamp=_TICKS):
    """A motion by 0.5, 0.25 m and 0.125 rad."""
    kind = ("i", int(matched))
    gaussian = packed(
        "CPosePDFGaussian", min(version, 2), pose2(),
        ("6f" if version == 1 else "6d", *range(6)) if version else matrix(np.eye(3)),
    )  # fmt: skip
    if version < 2:
        fields = [gaussian, kind]
    else:
        options = {2: 44, 3: 44, 4: 48}.get(version, 56)
        fields = [kind, *([gaussian] if matched else [pose2(1), bytes(options)])]
    if version >= 7:
        fields += [("?3d", True, 1.0, 0.0, 0.5), ("?2i", True, 5, 6)]
    elif version >= 1:
        fields += [("?2f", False, 0.0, 0.0), ("?2i", False, 0, 0)]
    fields += [("Q", stamp)] * (version >= 6)
    return packed("CActionRobotMovement2D", version, *fields)


def reading(version, label="wheels", stamp=_TICKS):
    fields = [pose2(1), text(label), ("Q", stamp)]
    fields += [("?2i", True, 5, 6), ("?2f", True, 1.0, 0.5)] * (version == 1)
    fields += [("?2i", True, 5, 6), ("?3d", True, 1.0, 0.0, 0.5)] * (version == 2)
    return packed("CObservationOdometry", version, *fields)


def rate(version, stamp=_TICKS):
    there, numbers = [k in (3, 5) for k in range(31)], [0.25 * (k == 3) for k in range(31)]
    count = 31 if version == 4 else 21 if version == 3 else 15
    before = [] if version == 4 else [("I", count)]
    return packed(
        "CObservationIMU", version, pose3(3), *before, bytes(there[:count]), ("Q", stamp),
        *before, (f"{count}d", *numbers[:count]), text("gyro"),
    )  # fmt: skip


def frame(*observations, version=2):
    before = {0: ("QI", 0, 0), 1: ("I", 7), 2: ("",)}[version]
    return packed("CSensoryFrame", version, before, ("I", len(observations)), *observations)


def actions(*motions):
    return packed("CActionCollection", 0, ("I", len(motions)), *motions)


def plain(folder, *objects):
    """An imported rawlog that is not packed: summary and messages."""
    (folder / "a.rawlog").write_bytes(b"".join(objects))
    return imported(folder / "a.rawlog", folder)


def of(kind, messages):
    return [m for m in messages if isinstance(m, kind)]


@pytest.mark.parametrize(
    ("version", "pose"), [(3, 0), (4, 1), (4, 2), (5, 2), (6, 3), (7, 3), (8, 3)]
)
def test_scans_of_all_versions_say_the_same(version, pose, tmp_path):
    """Versions to 7 as MRPT 2.5.8 reads them; 8 has the duration of the sweep."""
    _, messages = plain(tmp_path, reading(2), scan(version, pose))
    (found,) = of(records.Scan, messages)
    assert found.stamp_ns == START_NS + S
    np.testing.assert_array_equal(found.ranges, [1.5, 2.5, np.nan])
    # float32 of pi
    np.testing.assert_allclose(found.angles, [-np.pi / 2, 0, np.pi / 2], atol=1e-6)
    np.testing.assert_allclose(found.mount, [0.5, 0, np.pi / 2], atol=1e-7)


@pytest.mark.parametrize("version", [0, 1, 2])
def test_scans_without_a_time_are_counted(version, tmp_path):
    summary, messages = plain(tmp_path, reading(2), scan(version))
    assert not of(records.Scan, messages)
    assert summary.warnings[0].endswith("1 observations have no time, and are left out")


@pytest.mark.parametrize("matched", [False, True])
@pytest.mark.parametrize("version", range(8))
def test_motions_of_all_versions_are_added_up(version, matched, tmp_path):
    """Those before version 6 have no time: they end at the first observation behind them."""
    own, later = START_NS + 2 * S, _TICKS + 10**7
    pairs = [
        actions(motion(version, matched)), frame(scan(7)),
        actions(motion(version, matched, stamp=later)), frame(scan(7, stamp=later)),
    ]  # fmt: skip
    _, messages = plain(tmp_path, *pairs)
    first, second = of(records.OdometryPose, messages)
    assert (first.stamp_ns, second.stamp_ns) == (START_NS + S, own)
    step = np.array([0.5, 0.25, 0.125])
    np.testing.assert_allclose(first.pose, step, atol=1e-11)
    np.testing.assert_allclose(second.pose, compose(step, step), atol=1e-11)


def test_two_motions_in_one_collection_are_one_and_that_of_the_odometry(tmp_path):
    other = motion(7, matched=True).replace(pose2(), packed("CPose2D", 0, ("3f", 9, 9, 1)))
    _, messages = plain(tmp_path, actions(other, motion(7)), frame(scan(7)))
    (found,) = of(records.OdometryPose, messages)
    np.testing.assert_allclose(found.pose, [0.5, 0.25, 0.125], atol=1e-11)


@pytest.mark.parametrize("version", [0, 1, 2])
def test_readings_are_preferred_to_motions(version, tmp_path):
    """Also in frames of all versions, of which the older have a number and a time before."""
    summary, messages = plain(
        tmp_path, actions(motion(7)), frame(reading(version), scan(7), version=version)
    )
    assert summary.counts["/odom"] == 1 and len(of(records.Scan, messages)) == 1
    assert "1 actions are not used" in summary.warnings[0]


@pytest.mark.parametrize("version", [2, 3, 4])
def test_rates_of_turning_are_taken_about_the_axis_of_the_base(version, tmp_path):
    summary, _ = plain(tmp_path, reading(2), scan(7), rate(version))
    assert summary.counts["/imu"] == 1 and not summary.warnings


# ---------------------------------------------------------------- what is not known, or damaged


def test_objects_that_are_not_known_are_counted_and_what_is_in_them_or_behind_is_found(tmp_path):
    """Also a newer layout of a known class, and one whose fields hold bytes like an end."""
    image = packed("mrpt::obs::CObservationImage", 9, b"\x88\x87CPose3D" * 1000)
    broken = scan(7, stamp=_TICKS + 1)[:-1] + b"\x00"
    newer = scan(8, stamp=_TICKS + 2).replace(b"Scan\x08", b"Scan\x09")
    held = frame(image, scan(7), image)
    later = scan(7, stamp=_TICKS + 3)
    summary, messages = plain(tmp_path, reading(2), held, broken, newer, later)
    stamps = [m.stamp_ns - START_NS - S for m in of(records.Scan, messages)]
    assert stamps == [0, 300]
    told = "\n".join(summary.warnings)
    assert "2 CObservationImage are not used" in told
    assert "1 left out: CObservation2DRangeScan of version 9" in told
    assert "1 left out: CObservation2DRangeScan does not end where it should" in told


@pytest.mark.parametrize("form", FORMS)
def test_of_a_file_that_is_cut_off_what_is_before_is_used(form, tmp_path):
    whole = (HERE / f"{form}.rawlog").read_bytes()
    _, expected = imported(HERE / f"{form}.rawlog", tmp_path)
    stamps = [(type(m), m.time_ns) for m in expected]
    for share in (0.3, 0.6, 0.999):
        path = tmp_path / "cut.rawlog"
        path.write_bytes(whole[: int(share * len(whole))])
        summary, found = imported(path, tmp_path)
        # the last entries of the gzip stream are whole only with their block of Huffman codes
        assert len(found) > (share - 0.15) * len(expected)
        assert [(type(m), m.time_ns) for m in found] == stamps[: len(found)]
        assert summary.warnings[-1].endswith("damaged: it is cut off; what is before is used")


def test_a_wrong_check_sum_is_said(tmp_path):
    data = bytearray((HERE / "pairs.rawlog").read_bytes())
    data[-8] ^= 1
    (tmp_path / "a.rawlog").write_bytes(data)
    summary, _ = imported(tmp_path / "a.rawlog", tmp_path)
    assert "incorrect data check" in summary.warnings[-1]


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "it is empty"),
        (b"no rawlog", "no object begins where one should; is it a rawlog"),
        (gzip.compress(bytes(50_000_000)), "no object begins where one should; is it a rawlog"),
        (packed("CObservationComment", 0) + bytes(5_000_000), "in 1 MB; is it a rawlog"),
        (packed("CObservationImage", 0) * 3, "3 CObservationImage are not used"),
        (scan(9), "CObservation2DRangeScan of version 9"),
        (scan(0), "1 observations have no time"),
        (actions(motion(5)) * 2 + scan(9), "2 actions have no time, nor has"),
        (packed("CObservationOdometry", 2, pose2(1), ("I", 1 << 31)), "a size that it cannot have"),
        (struct.pack("<I", 23) + b"CObservation2DRangeScan", "no object begins"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_one_line_and_overwrites_nothing(data, why, tmp_path, monkeypatch):
    monkeypatch.setattr("graphslam.importers.mrpt_objects._FARTHEST", 1 << 20)
    source, target = tmp_path / "a.rawlog", tmp_path / "log.mcap"
    source.write_bytes(data)
    target.write_bytes(b"mine")
    tracemalloc.start()
    with pytest.raises(LogError, match=why) as caught:
        IMPORTERS["rawlog"](source, target)
    assert tracemalloc.get_traced_memory()[1] < 5e6  # of what a bomb unpacks to, parts
    tracemalloc.stop()
    assert "\n" not in str(caught.value) and target.read_bytes() == b"mine"


def test_damage_anywhere_is_refused_or_read_around(tmp_path):
    """Flipped bytes of an unpacked file: never a traceback, and most of the rest is read."""
    whole = gzip.decompress((HERE / "pairs.rawlog").read_bytes())
    rng, path = np.random.default_rng(3), tmp_path / "a.rawlog"
    for _ in range(40):
        data = bytearray(whole)
        for at in rng.integers(200, len(data), 5):
            data[at] ^= 1 << rng.integers(8)
        path.write_bytes(data)
        counts = IMPORTERS["rawlog"](path, tmp_path / "log.mcap").counts
        assert counts["/scan"] >= 31 - 5 and counts["/odom"] >= 151 - 10


# ---------------------------------------------------------------- lasers


def test_lasers_are_told_apart_by_label_and_mount(tmp_path):
    back = packed("CPose3D", 3, ("12d", -0.5, 0, 0, -1, 0, 0, 0, -1, 0, 0, 0, 1))
    scans = [scan(7, stamp=_TICKS + 10**6 * k, label="front laser") for k in range(4)]
    scans += [scan(7, stamp=_TICKS + 10**6 * k, label="").replace(pose3(3), back) for k in range(3)]
    scans += [scan(7, stamp=_TICKS + 10**6 * k, label="front laser").replace(pose3(3), back)
              for k in range(2)]  # fmt: skip
    summary, _ = plain(tmp_path, reading(2), *scans)
    counts = {topic: n for topic, n in summary.counts.items() if topic.startswith("/scan")}
    assert counts == {"/scan": 4, "/scan_laser_2": 3, "/scan_front_laser": 2}


def test_a_laser_that_moves_on_the_robot_is_left_out(tmp_path):
    poses = [packed("CPose3D", 2, ("7d", 0.1 * k, 0, 0, 1, 0, 0, 0)) for k in range(5)]
    nodding = [scan(7, label="nods").replace(pose3(3), pose) for pose in poses]
    summary, _ = plain(tmp_path, reading(2), scan(7), *nodding)
    assert summary.counts["/scan"] == 1
    assert "5 scans of 'nods' are not used: it has 5 poses on the robot" in summary.warnings[0]


@pytest.mark.parametrize("roll", [0.0, 0.1, np.pi])
def test_a_laser_keeps_its_height_and_its_tilt(roll, tmp_path):
    """Scans of upside-down lasers are mirrored, those of tilted ones projected: tf decides."""
    c, s = np.cos(roll), np.sin(roll)
    pose = packed("CPose3D", 3, ("12d", 0.2, 0, 0.5, 1, 0, 0, 0, c, -s, 0, s, c))
    plain(tmp_path, reading(2), scan(7).replace(pose3(3), pose))
    with (tmp_path / "log.mcap").open("rb") as stream:
        ((_, _, message),) = make_reader(stream).iter_messages(["/tf_static"])
    (transform,) = schemas.decode(schemas.TF_MESSAGE, message.data).transforms
    rotation, position = transform.transform.rotation, transform.transform.translation
    q = np.array([rotation.x, rotation.y, rotation.z, rotation.w])
    expected = np.array([np.sin(roll / 2), 0, 0, np.cos(roll / 2)])
    assert abs(q @ expected) == pytest.approx(1, abs=1e-12)
    assert (position.x, position.y, position.z) == (0.2, 0, 0.5)
