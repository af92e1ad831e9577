"""Files for viewers: valid messages of ROS 2, in order, where the TUM files say."""

import errno
import importlib.util
import itertools
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from synthetic_results import orchard, room

from graphslam.core.errors import OutputError
from graphslam.core.geometry import compose, wrap
from graphslam.core.records import Landmark
from graphslam.logs.writer import LogWriter
from graphslam.results import viewer_mcap
from graphslam.results.folder import load, save
from graphslam.results.scene import ellipse, uncertainty_lines
from graphslam.results.viewer_messages import point_cloud
from graphslam.results.viewers import VIEWERS, write_viewer

NS = 1_000_000_000


@pytest.fixture(scope="module", params=["room", "orchard"])
def shown(request, tmp_path_factory):
    """A result folder of one robot with scans or of two without, and its result.mcap."""
    made = {"room": lambda: room(keyframes=40, beams=41), "orchard": lambda: orchard(30, 8)}
    folder = tmp_path_factory.mktemp(request.param) / "out"
    save(made[request.param]()[0], folder, force=False)
    assert write_viewer(folder, "mcap", folder) == ["result.mcap", "result.layout.json"]
    return folder


def records(folder):
    """(topic, schema, log time, data) of all messages of result.mcap in the order of the file."""
    with (folder / "result.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        return [
            (channel.topic, schema, message.log_time, message.data)
            for schema, channel, message in reader.iter_messages(log_time_order=False)
        ]


def decoded(folder):
    """(topic, type, log time, message) by rosbags, from the definitions in the file itself."""
    store = get_typestore(Stores.EMPTY)
    for _, schema, _, _ in records(folder):
        store.register(get_types_from_msg(schema.data.decode(), schema.name))
    return [
        (topic, schema.name, time, store.deserialize_cdr(data, schema.name))
        for topic, schema, time, data in records(folder)
    ]


def heading(rotation):
    return 2 * np.arctan2(rotation.z, rotation.w)


def stamp(header):
    return header.stamp.sec * NS + header.stamp.nanosec


def test_every_message_is_of_ros_2_and_in_the_order_of_time(shown):
    """Other schemas would keep RViz from opening the file, and players skip what comes late."""
    found = decoded(shown)
    times = [time for _, _, time, _ in found]
    assert times == sorted(times)
    known = get_typestore(Stores.ROS2_HUMBLE).types
    for topic, schema, time, message in found:
        assert schema in known, topic
        headers = [message.header] if hasattr(message, "header") else []
        headers += [t.header for t in getattr(message, "transforms", [])]
        headers += [m.header for m in getattr(message, "markers", [])]
        assert headers and all(stamp(header) <= time for header in headers)


def test_transforms_are_the_poses_of_the_trajectory_files(shown):
    saved = load(shown)
    for name, robot in saved.robots.items():
        prefix = "" if name == "robot" else f"{name}/"
        parts = {}
        for topic, _, _, message in decoded(shown):
            for t in message.transforms if topic == "/tf" else ():
                at, turn = t.transform.translation, heading(t.transform.rotation)
                key = t.header.frame_id, t.child_frame_id
                parts.setdefault(key, []).append((stamp(t.header), at.x, at.y, turn))
        to_odom = np.array(parts["map", f"{prefix}odom"])
        to_base = np.array(parts[f"{prefix}odom", f"{prefix}base_link"])
        poses = compose(to_odom[:, 1:], to_base[:, 1:])
        stamps = np.array([row[0] for row in parts["map", f"{prefix}odom"]])
        assert robot.scan_final is None or len(stamps) == len(robot.final)
        final, odometry = robot.final.at(stamps), robot.odometry.at(stamps)
        assert set(stamps) <= set(robot.final.stamps_ns.tolist()) and len(stamps) > 20
        assert np.abs(poses[:, :2] - final[:, :2]).max() < 1e-9
        assert np.abs(wrap(poses[:, 2] - final[:, 2])).max() < 1e-9
        assert np.abs(to_base[:, 1:3] - odometry[:, :2]).max() < 1e-9


def test_what_is_shown_is_what_the_result_says(shown):
    saved, found = load(shown), decoded(shown)
    (markers,) = [m for topic, _, _, m in found if topic == "/landmarks"]
    by_name = {m.ns: m for m in markers.markers if m.ns != "numbers"}
    walls = [m.extent for m in saved.landmarks if m.kind != "point"]
    if walls:
        ends = np.array([(p.x, p.y) for p in by_name["walls"].points])
        np.testing.assert_allclose(ends, np.concatenate(walls))
    else:
        assert len(by_name["points"].points) == len(saved.landmarks)
    assert {m.text for m in markers.markers if m.text} == {str(m.id) for m in saved.landmarks}
    for name, robot in saved.robots.items():
        topic = "/path" if name == "robot" else f"/{name}/path"
        (path,) = [m for t, _, _, m in found if t == topic]
        end, last = path.poses[-1].pose.position, robot.final.poses[-1]
        assert np.hypot(end.x - last[0], end.y - last[1]) < 0.06
        poses = [m for t, _, _, m in found if t == topic.replace("path", "pose")]
        row = int(np.searchsorted(robot.final.stamps_ns, stamp(poses[3].header)))
        cov = poses[3].pose.covariance.reshape(6, 6)[np.ix_((0, 1, 5), (0, 1, 5))]
        np.testing.assert_array_equal(cov, robot.final.covs[row])
    grids = [m for t, _, _, m in found if t == "/map"]
    clouds = [m for t, _, _, m in found if t == "/scan_points"]
    assert len(grids) == bool(walls) and len(clouds) == (40 if walls else 0)
    for grid in grids:
        assert grid.data.size == grid.info.width * grid.info.height
        cells = grid.data.reshape(grid.info.height, grid.info.width)
        xyz = np.concatenate([c.data.view("<f4").reshape(-1, 3) for c in clouds])
        origin = [grid.info.origin.position.x, grid.info.origin.position.y]
        i, j = ((xyz[:, :2] - origin) / grid.info.resolution).astype(int).T
        assert (cells[j, i] > 50).mean() > 0.5 and set(np.unique(cells)) <= {-1, *range(101)}


def test_points_far_from_the_origin_keep_their_millimetres():
    """As in UTM, where a float32 has steps of half a metre; near it viewers get float32."""
    near = np.array([[1.0, 2.0], [3.25, 4.125]])
    for offset, kind in ((0.0, 7), (5.2e6, 8)):
        made = point_cloud(near + offset, NS, "map")
        assert {field.datatype for field in made.fields} == {kind}
        size = made.point_step // 3
        points = made.data.view(f"<f{size}").reshape(-1, 3)
        np.testing.assert_allclose(points[:, :2] - offset, near, atol=1e-6)
        assert made.row_step == len(made.data) == 2 * made.point_step


def test_the_layout_shows_every_topic(shown):
    layout = json.loads((shown / "result.layout.json").read_text())
    topics = layout["configById"][layout["layout"]]["topics"]
    written = {topic for topic, *_ in records(shown)} - {"/tf"}
    assert written <= set(topics)
    assert all(topics[topic]["visible"] for topic in written)


def test_the_camera_is_above_the_map_and_sees_all_of_it(shown):
    """It looked at the world's origin from 60 m, wherever the map was."""
    layout = json.loads((shown / "result.layout.json").read_text())
    panel = next(p for p in layout["configById"].values() if "cameraState" in p)
    camera = panel["cameraState"]
    paths = [robot.final.poses[:, :2] for robot in load(shown).robots.values()]
    off = np.abs(np.concatenate(paths) - camera["targetOffset"][:2])
    assert off.max() < camera["distance"] * np.tan(np.radians(camera["fovy"]))


@pytest.mark.skipif(not importlib.util.find_spec("mcap_ros2"), reason="needs mcap-ros2-support")
def test_the_other_reference_reader_decodes_every_message(shown):
    from mcap_ros2.decoder import DecoderFactory

    with (shown / "result.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        found = [m.decoded_message for m in reader.iter_decoded_messages()]
    assert len(found) == len(records(shown))


@pytest.mark.skipif(not importlib.util.find_spec("rerun"), reason="needs rerun-sdk")
def test_a_recording_for_rerun_is_read_back(shown, tmp_path):
    """By the viewer's own program: it verifies every chunk, and lists what there is."""
    assert write_viewer(shown, "rrd", tmp_path) == ["result.rrd"]
    rerun = Path(sys.executable).with_name("rerun")
    for verb in ("verify", "stats"):
        command = [rerun, "rrd", verb, tmp_path / "result.rrd"]
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    for name in load(shown).robots:
        for entity in ("path", "odometry", "robot"):
            assert f"/map/{name}/{entity}: " in done.stdout
    assert "/viewport" in done.stdout or "/container" in done.stdout  # the blueprint


@pytest.mark.skipif(bool(importlib.util.find_spec("rerun")), reason="rerun-sdk is there")
def test_without_rerun_an_error_says_what_to_install(shown, tmp_path):
    with pytest.raises(OutputError, match=r"coop-graphslam\[viewer\]"):
        write_viewer(shown, "rrd", tmp_path / "new")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    "problem",
    [
        OSError(errno.ENOSPC, "No space left on device"),
        OSError(errno.EROFS, "Read-only file system"),
        KeyboardInterrupt(),
    ],
    ids=str,
)
def test_a_full_disk_or_ctrl_c_leaves_no_file(shown, tmp_path, monkeypatch, problem):
    message, count = LogWriter.message, itertools.count()

    def fails(self, *args):
        if next(count) == 20:
            raise problem
        message(self, *args)

    monkeypatch.setattr(viewer_mcap.LogWriter, "message", fails)
    with pytest.raises((OutputError, KeyboardInterrupt)):
        write_viewer(shown, "mcap", tmp_path / "new")
    assert list(tmp_path.iterdir()) == []


#: writes the folder's recording for Rerun where no file may be larger than 20 kB
SMALL_DISK = """
import resource, signal, sys
from pathlib import Path
from graphslam.core.errors import OutputError
from graphslam.results.viewers import write_viewer
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
try:
    write_viewer(Path(sys.argv[1]), "rrd", Path(sys.argv[2]))
except OutputError as error:
    print(error)
"""


def test_a_full_disk_leaves_no_recording_for_rerun(shown, tmp_path):
    """Breaks if its SDK writes the file, in a thread of its own that waits for ever there."""
    pytest.importorskip("rerun")
    words = [sys.executable, "-c", SMALL_DISK, str(shown), str(tmp_path / "new")]
    done = subprocess.run(words, capture_output=True, text=True, check=True, timeout=120)
    assert "cannot be written" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_an_existing_file_needs_force_and_kinds_are_known(shown, tmp_path):
    with pytest.raises(OutputError, match=r"result.mcap: already exists; give --force"):
        write_viewer(shown, "mcap", shown)
    write_viewer(shown, "mcap", shown, force=True)
    with pytest.raises(ValueError, match="pdf"):
        write_viewer(shown, "pdf", tmp_path)
    from graphslam.cli import arguments

    assert list(VIEWERS) == arguments.VIEWERS


def test_bounds_hold_95_percent_of_the_errors():
    """Of a point inside its ellipse, of a wall's end between the ends of its bar."""
    rng = np.random.default_rng(4)
    cov = np.array([[0.04, 0.018], [0.018, 0.02]])
    ring = ellipse(np.array([3.0, 1.0]), cov)
    errors = np.einsum("ni,ij,nj->n", ring - [3, 1], np.linalg.inv(cov), ring - [3, 1])
    np.testing.assert_allclose(errors, 5.991, rtol=1e-3)
    line_cov = np.array([[1e-4, 2e-4], [2e-4, 9e-4]])
    normal, offset = 0.7, 2.0
    n, t = np.array([np.cos(normal), np.sin(normal)]), np.array([-np.sin(normal), np.cos(normal)])
    ends = offset * n + np.array([[-3.0], [5.0]]) * t
    wall = Landmark(
        1, "line", np.array([*ends.mean(axis=0), normal - np.pi / 2]), np.eye(3), ends,
        (normal, offset, line_cov), 9, 0, 1, None,
    )  # fmt: skip
    bars = uncertainty_lines(wall)
    draws = rng.multivariate_normal([normal, offset], line_cov, 20000)
    for end, bar in zip(ends, bars, strict=True):
        # where the drawn line crosses the normal through the end
        drawn = np.column_stack([np.cos(draws[:, 0]), np.sin(draws[:, 0])])
        miss = (draws[:, 1] - drawn @ end) / (drawn @ n)
        half = np.hypot(*(bar[1] - bar[0])) / 2
        assert abs((np.abs(miss) < half).mean() - 0.95) < 0.01


def test_view_writes_a_file_for_a_viewer_where_it_is_missing(shown, tmp_path, monkeypatch):
    """And once only: what is there is opened again as it is."""
    import shutil

    from command_line import call

    folder = tmp_path / "out"
    shutil.copytree(shown, folder, ignore=shutil.ignore_patterns("result.*"))
    done = call("view", folder, "--mcap", "--json")
    assert json.loads(done.out) == {"opened": str(folder / "result.mcap")}, done.err
    assert (folder / "result.mcap").read_bytes() == (shown / "result.mcap").read_bytes()
    (folder / "result.mcap").write_bytes(b"kept")
    assert "Lichtblick" in call("view", folder, "--mcap").out
    assert (folder / "result.mcap").read_bytes() == b"kept"
    if not importlib.util.find_spec("rerun"):
        assert call("view", folder, "--rrd").code == 2
        return
    from graphslam.cli import view

    started = []
    monkeypatch.setattr(view.subprocess, "Popen", lambda command, **_: started.append(command))
    assert call("view", folder, "--rrd").code == 0
    assert started[0][1:] == ["-m", "rerun", str(folder / "result.rrd")]
