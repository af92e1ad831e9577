"""The result folder: whole or not at all, read back equal, opened by other tools."""

import dataclasses
import json

import gtsam
import numpy as np
import pytest
from synthetic_results import START_NS, orchard, room

from graphslam.core.config import Config
from graphslam.core.config_io import load_config
from graphslam.core.errors import OutputError
from graphslam.core.geometry import rotate_cov, wrap
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Estimate, Motion, Start, Step, Trajectory
from graphslam.estimation.g2o import EDGES, NO_INFORMATION, graph_g2o, graph_ids, number_vertices
from graphslam.results.file_formats import (
    cov_text,
    read_landmarks,
    read_trajectory,
    stamp_ns,
    tum_text,
)
from graphslam.results.folder import load, save
from graphslam.results.target_folder import check_target


@pytest.fixture(scope="module")
def made():
    return room(keyframes=60, beams=21)[0]


@pytest.fixture(scope="module")
def two_robots():
    return orchard(keyframes=50, trees=12)[0]


def trajectory(stamps, poses, covs=None):
    n = len(stamps)
    covs = np.zeros((n, 3, 3)) if covs is None else covs
    return Trajectory(np.array(stamps, dtype=np.int64), np.array(poses, dtype=float), covs)


# ---------------------------------------------------------------- the folder


def test_folder_holds_the_contract(made, tmp_path):
    save(made, tmp_path / "out", force=False, report=lambda _: "<html>")
    files = {str(p.relative_to(tmp_path / "out")) for p in (tmp_path / "out").rglob("*.*")}
    names = ("tum", "causal.tum", "scan.tum", "scan.causal.tum", "cov.csv", "causal.cov.csv")
    names += ("odometry.tum",)
    assert files == {
        "scans.npz",
        "summary.json",
        "config.toml",
        "landmarks.json",
        "graph.g2o",
        "graph_ids.csv",
        "report.html",
        *(f"trajectories/robot.{name}" for name in names),
    }
    assert load_config(tmp_path / "out" / "config.toml") == Config()


@pytest.mark.parametrize("fixture", ["made", "two_robots"])
def test_load_gives_back_what_was_saved(fixture, request, tmp_path):
    result = request.getfixturevalue(fixture)
    save(result, tmp_path / "out", force=False)
    saved = load(tmp_path / "out")
    assert list(saved.robots) == sorted(result.robots)
    assert saved.summary == json.loads(json.dumps(result.summary))
    for name, robot in result.robots.items():
        for field in (*("final", "causal", "scan_final", "scan_causal", "dead_reckoning"),):
            ours = getattr(robot, field)
            back = getattr(saved.robots[name], field.replace("dead_reckoning", "odometry"))
            if ours is None:
                assert back is None
                continue
            assert np.array_equal(ours.stamps_ns, back.stamps_ns)
            # 9 decimals of position, 12 of the quaternion
            assert np.abs(ours.poses[:, :2] - back.poses[:, :2]).max() <= 0.5001e-9
            assert np.abs(wrap(ours.poses[:, 2] - back.poses[:, 2])).max() < 1e-11
            if field in ("final", "causal"):
                assert np.array_equal(ours.covs, back.covs)  # repr floats: exact
    for ours, back in zip(result.landmarks, saved.landmarks, strict=True):
        for field in ("position", "cov", "extent"):
            assert np.array_equal(getattr(ours, field), getattr(back, field), equal_nan=True)
        assert (ours.id, ours.kind, ours.identity, ours.sightings, ours.first_ns, ours.last_ns) == (
            (back.id, back.kind, back.identity, back.sightings, back.first_ns, back.last_ns)
        )
        assert (ours.line is None) == (back.line is None)
        if ours.line is not None:
            assert ours.line[:2] == back.line[:2]
            assert np.array_equal(ours.line[2], back.line[2])


def test_names_with_slashes_and_dots_stay_apart(made, tmp_path):
    robot = made.robots["robot"]
    names = {"fleet/a": robot, "fleet/a.scan": robot, "b.causal": robot}
    save(dataclasses.replace(made, robots=names), tmp_path / "out", force=False)
    assert set(load(tmp_path / "out").robots) == set(names)


@pytest.mark.parametrize("name", ["drive.mcap", "rosbag_0.db3", "tuesday/summary.json"])
def test_what_others_put_into_a_result_is_not_lost_with_it(made, tmp_path, name):
    """A recording in the folder of its own result was gone after --force, as was another result."""
    target = tmp_path / "out"
    save(made, target, force=False)
    (target / name).parent.mkdir(exist_ok=True)
    (target / name).write_bytes(b"dear")
    with pytest.raises(OutputError, match=f"out: has {name.split('/')[0]} in it, which would be"):
        save(made, target, force=True)
    assert (target / name).read_bytes() == b"dear"
    (target / name).rename(target / "result.mcap")  # what viewers read is made anew
    if "/" in name:
        (target / name).parent.rmdir()
    save(made, target, force=True)
    assert not (target / "result.mcap").exists()


def test_an_existing_result_needs_force_and_is_replaced(made, tmp_path):
    target = tmp_path / "out"
    save(made, target, force=False)
    (target / "stale.txt").write_text("old")
    with pytest.raises(OutputError, match="--force"):
        save(made, target, force=False)
    assert (target / "stale.txt").exists()
    save(made, target, force=True)
    assert not (target / "stale.txt").exists()
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_what_is_not_a_result_folder_is_never_replaced(made, tmp_path):
    documents = tmp_path / "documents"
    documents.mkdir()
    (documents / "thesis.tex").write_text("years of work")
    (tmp_path / "file").write_text("x")
    (tmp_path / "link").symlink_to(documents)
    for name in ("documents", "file", "link"):
        with pytest.raises(OutputError, match="not a result folder"):
            save(made, tmp_path / name, force=True)
        with pytest.raises(OutputError, match="not a result folder"):
            check_target(tmp_path / name, force=True)
    assert (documents / "thesis.tex").read_text() == "years of work"
    assert {p.name for p in tmp_path.iterdir()} == {"documents", "file", "link"}


def test_a_known_map_is_never_replaced_by_a_result_in_it(made, tmp_path):
    """Nor is a folder that holds it; one beside it, and one within it, are."""
    save(made, tmp_path / "building" / "monday", force=False)
    monday = str(tmp_path / "building" / "monday")
    (tmp_path / "same").symlink_to(monday)
    for name, known in (("building/monday", monday), ("building", monday)):
        for spelled in (known, str(tmp_path / "same"), f"{known}/../monday"):
            with pytest.raises(OutputError, match="has the known map in it"):
                check_target(tmp_path / name, force=True, known_map=spelled)
    save(made, tmp_path / "building" / "tuesday", force=False)
    assert check_target(tmp_path / "building" / "tuesday", force=True, known_map=monday)
    assert (
        check_target(tmp_path / "building" / "monday" / "day", force=True, known_map=monday) is None
    )


@pytest.mark.parametrize("existing", [False, True])
def test_a_failure_leaves_nothing_and_keeps_the_old(made, tmp_path, existing):
    target = tmp_path / "out"
    if existing:
        save(made, target, force=False)

    def fails(_):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        save(made, target, force=True, report=fails)
    bad = dataclasses.replace(made, summary={**made.summary, "scans_per_s": np.nan})
    with pytest.raises(OutputError, match=r"summary\.json"):
        save(bad, target, force=True)
    assert [p.name for p in tmp_path.iterdir()] == (["out"] if existing else [])
    if existing:
        load(target)


def test_numpy_numbers_in_the_summary_are_written(made, tmp_path):
    summary = {**made.summary, "scans_per_s": np.float64(1.5), "extra": np.arange(3)}
    save(dataclasses.replace(made, summary=summary), tmp_path / "o", force=False)
    back = load(tmp_path / "o").summary
    assert (back["scans_per_s"], back["extra"]) == (1.5, [0, 1, 2])


def test_a_directory_that_cannot_be_written_is_one_line(made, tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match="cannot be written"):
        save(made, tmp_path / "file" / "out", force=False)


# ---------------------------------------------------------------- trajectories


def test_stamps_never_pass_through_a_float():
    # 976052857.337284123 as a float is off by tens of nanoseconds
    stamps = [START_NS, START_NS + 1, 5, -1, -1_500_000_000, 2**63 - 1]
    lines = tum_text(trajectory(stamps, np.zeros((6, 3)))).splitlines()
    assert [line.split()[0] for line in lines] == [
        "-1.500000000",
        "-0.000000001",
        "0.000000005",
        "976052857.337284123",
        "976052857.337284124",
        "9223372036.854775807",
    ]
    assert [stamp_ns(line.split()[0]) for line in lines] == sorted(stamps)


def test_lines_are_sorted_by_stamp_with_their_covariances():
    covs = np.arange(27.0).reshape(3, 3, 3)
    shuffled = trajectory([3, 1, 2], [[3, 0, 0], [1, 0, 0], [2, 0, 0]], covs)
    assert [line.split()[1] for line in tum_text(shuffled).splitlines()] == [
        "1.000000000",
        "2.000000000",
        "3.000000000",
    ]
    rows = [line.split(",") for line in cov_text(shuffled).splitlines()[1:]]
    assert [row[0] for row in rows] == ["1", "2", "3"]
    assert rows[0][1:] == ["9.0", "10.0", "11.0", "13.0", "14.0", "17.0"]


def test_a_pose_that_is_not_finite_is_refused():
    with pytest.raises(OutputError, match=r"0\.000000002 s"):
        tum_text(trajectory([1, 2], [[0, 0, 0], [np.nan, 0, 0]]))


def test_other_tools_tum_is_read(tmp_path):
    path = tmp_path / "t.tum"
    # comments, unnormalised quaternion, roll, a stamp without decimals, unsorted
    path.write_text("# stamp\n20 1 2 9 0 0 2 2\n\n1.5e1 3 4 0 0 0 0 -1\n")
    back = read_trajectory(path)
    assert back.stamps_ns.tolist() == [15 * 10**9, 20 * 10**9]
    assert np.allclose(back.poses, [[3, 4, 0], [1, 2, np.pi / 2]], atol=1e-15)
    assert np.isnan(back.covs).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1.0 0 0 0 0 0 0\n", "t.tum:1: expected 8 numbers, got 7"),
        ("# c\n1.0 0 0 0 0 0 0 1\nx 0 0 0 0 0 0 1\n", "t.tum:3: 'x' is not a time"),
        ("1.0 0 0 0 0 0 zero 1\n", "t.tum:1: could not convert"),
        ("1.0 nan 0 0 0 0 0 1\n", "t.tum:1: not a pose"),
        ("1.0 0 0 0 0 0 0 0\n", "t.tum:1: not a pose"),
        ("inf 0 0 0 0 0 0 1\n", "t.tum:1: 'inf' is not a time"),
        ("1e30 0 0 0 0 0 0 1\n", "t.tum:1: '1e30' is not a time"),
        ("", "holds no pose"),
    ],
)
def test_malformed_tum_names_file_and_line(tmp_path, text, message):
    (tmp_path / "t.tum").write_text(text)
    with pytest.raises(OutputError) as caught:
        read_trajectory(tmp_path / "t.tum")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_covariances_must_belong_to_the_trajectory(tmp_path):
    (tmp_path / "t.tum").write_text("1.0 0 0 0 0 0 0 1\n")
    cov = tmp_path / "t.cov.csv"
    for text, message in [
        ("h\n", "t.cov.csv:1"),
        ("stamp_ns,xx,xy,xphi,yy,yphi,phiphi\n1000000001,1,0,0,1,0,1\n", "stamps"),
        ("stamp_ns,xx,xy,xphi,yy,yphi,phiphi\n1000000000,1,0,0,1,0\n", "t.cov.csv:2"),
    ]:
        cov.write_text(text)
        with pytest.raises(OutputError, match=message):
            read_trajectory(tmp_path / "t.tum", cov)


@pytest.mark.parametrize("text", ["{", "{}", '[{"id": 1}]', "[3]", '[{"id": 0, "kind": "point"}]'])
def test_malformed_landmarks_are_one_line(tmp_path, text):
    (tmp_path / "landmarks.json").write_text(text)
    with pytest.raises(OutputError, match=r"landmarks\.json"):
        read_landmarks(tmp_path / "landmarks.json")


def test_no_folder_and_half_a_folder_are_one_line(made, tmp_path):
    with pytest.raises(OutputError, match="not a result folder"):
        load(tmp_path / "nothing")
    save(made, tmp_path / "out", force=False)
    (tmp_path / "out" / "trajectories" / "robot.cov.csv").unlink()
    with pytest.raises(OutputError, match=r"robot\.cov\.csv: cannot be read"):
        load(tmp_path / "out")


def test_permissions_are_those_of_the_user_not_of_a_temporary_directory(made, tmp_path):
    save(made, tmp_path / "out", force=False)
    (tmp_path / "plain").mkdir()
    assert (tmp_path / "out").stat().st_mode == (tmp_path / "plain").stat().st_mode


# ---------------------------------------------------------------- g2o


def read_back(text, tmp_path):
    path = tmp_path / "graph.g2o"
    path.write_text(text)
    return gtsam.readG2o(str(path), False)


def test_gtsam_reads_a_motion_graph_back_to_the_error_we_expect(made, tmp_path):
    motion_only = tuple(dataclasses.replace(s, associations=()) for s in made.steps)
    bare = Estimate(made.estimate.states, {}, 0.0, 0)
    graph, values = read_back(graph_g2o(motion_only, bare), tmp_path)
    poses = made.estimate.states["robot"].poses
    assert (graph.size(), values.size()) == (len(poses) - 1, len(poses))
    expected = 0.0
    for i, step in enumerate(made.steps[1:], start=1):
        motion = step.motions["robot"]
        noise = gtsam.noiseModel.Gaussian.Covariance(
            rotate_cov(motion.cov, -float(motion.delta[2]))
        )
        factor = gtsam.BetweenFactorPose2(i - 1, i, gtsam.Pose2(*motion.delta), noise)
        expected += factor.error(values)
    # text holds every bit; what is left is rounding in inverse and Cholesky factor
    assert graph.error(values) == pytest.approx(expected, rel=1e-9, abs=1e-6)
    assert expected > 1  # the property is about a graph with errors


def test_the_edge_covariance_is_that_of_the_end_frame(tmp_path):
    # A quarter turn to the left: an error along the start frame's x is along the end's -y.
    cov = np.diag([4.0, 1.0, 0.25])
    motion = Motion(0, 1, np.array([1.0, 0.0, np.pi / 2]), cov, np.zeros((3, 0)), 1.0)
    states = {"r": trajectory([0, 1], [[0, 0, 0], [1, 0, np.pi / 2]])}
    start = Start(np.zeros(3), np.eye(3))
    text = graph_g2o(
        [Step(0, {"r": start}), Step(1, motions={"r": motion})], Estimate(states, {}, 0.0, 0)
    )
    edge = next(line for line in text.splitlines() if line.startswith("EDGE_SE2 ")).split()
    assert edge[1:3] == ["0", "1"]
    assert np.allclose([float(v) for v in edge[6:]], [1, 0, 0, 0.25, 0, 4], atol=1e-15)


def test_every_model_has_an_edge_and_gtsam_reads_the_whole_file(made, two_robots, tmp_path):
    assert set(EDGES) == {*MODELS, "start", "motion", "closure", "gauge"}
    for result in (made, two_robots):
        text = graph_g2o(result.steps, result.estimate)
        graph, values = read_back(text, tmp_path)
        ids = number_vertices(result.estimate)
        assert values.size() == len(ids.states) + len(ids.landmarks)
        assert graph.size() == text.count("EDGE_SE2 ")
        seen = sum(len(s.associations) for s in result.steps)
        moved = sum(len(s.motions) for s in result.steps)
        gauges = len({a.target for s in result.steps for a in s.associations if a.model == "line"})
        assert text.count("EDGE_SE2 ") + text.count("EDGE_SE2_XY ") == seen + moved + gauges


def test_line_edges_know_nothing_along_the_line(made, tmp_path):
    graph, values = read_back(graph_g2o(made.steps, made.estimate), tmp_path)
    landmarks = number_vertices(made.estimate).landmarks
    edges = [graph.at(i) for i in range(graph.size())]
    on_lines = [f for f in edges if f.keys()[1] in landmarks.values()]
    # the gauge of each line has information along it, and none else
    gauges = [f for f in on_lines if f.noiseModel().R()[1, 1] <= 1e-6]
    assert len(gauges) == len(landmarks)
    assert all(f.error(values) < 1e-12 for f in gauges)
    lines = [f for f in on_lines if f not in gauges]
    assert len(lines) == len(made.steps) - 1
    for factor in lines:
        before = factor.error(values)
        moved = gtsam.Values(values)
        key = factor.keys()[1]
        moved.update(key, values.atPose2(key).compose(gtsam.Pose2(3.0, 0.0, 0.0)))
        # moving the landmark along itself while the measured direction is off by delta changes
        # the normal residual by 3 delta, which is 0 here: z agrees with the estimate
        assert factor.error(moved) == pytest.approx(before, abs=20 * NO_INFORMATION)


def test_a_robot_sighted_by_bearing_and_range_says_nothing_of_its_heading(two_robots, tmp_path):
    graph, values = read_back(graph_g2o(two_robots.steps, two_robots.estimate), tmp_path)
    ids = number_vertices(two_robots.estimate).states
    robot2 = {i for (robot, _), i in ids.items() if robot == "robot2"}
    edges = [graph.at(i) for i in range(graph.size())]
    seen = [f for f in edges if f.keys()[0] not in robot2 and f.keys()[1] in robot2]
    assert len(seen) == len(two_robots.steps) - 1
    for factor in seen[::10]:
        key = factor.keys()[1]
        turned = gtsam.Values(values)
        turned.update(key, values.atPose2(key).compose(gtsam.Pose2(0, 0, 0.5)))
        assert factor.error(turned) == pytest.approx(factor.error(values), abs=1e-9)
        moved = gtsam.Values(values)
        a, b = values.atPose2(factor.keys()[0]), values.atPose2(key)
        away = b.translation() - a.translation()
        distance = np.hypot(*away)
        shift = 0.1 * away / distance  # one sigma of the range
        moved.update(key, gtsam.Pose2(*(b.translation() + shift), b.theta()))
        assert factor.error(moved) - factor.error(values) == pytest.approx(0.5, rel=1e-6)


def test_vertices_are_named_beside_the_graph(two_robots):
    lines = graph_ids(two_robots.estimate).splitlines()
    assert lines[0] == "id,robot,stamp_ns,landmark"
    assert lines[1] == f'0,"robot1",{START_NS},'
    assert lines[51].startswith('50,"robot2",')
    assert lines[101] == "100,,,0"


def test_vertices_hold_every_bit(made):
    text = graph_g2o(made.steps, made.estimate)
    poses = made.estimate.states["robot"].poses
    rows = [line.split()[2:] for line in text.splitlines() if line.startswith("VERTEX_SE2")]
    found = np.array(rows[: len(poses)], dtype=float)
    assert np.array_equal(found[:, :2], poses[:, :2])
    assert np.abs(wrap(found[:, 2] - poses[:, 2])).max() < 1e-15


def test_a_singular_covariance_is_one_line(made):
    motion = dataclasses.replace(made.steps[1].motions["robot"], cov=np.zeros((3, 3)))
    step = Step(made.steps[1].time_ns, motions={"robot": motion})
    with pytest.raises(OutputError, match="motion of robot at"):
        graph_g2o([step], made.estimate)


def test_evidence_for_what_was_deleted_has_no_edge(made):
    fewer = Estimate(made.estimate.states, {}, 0.0, 0)
    text = graph_g2o(made.steps, fewer)
    assert text.count("EDGE_SE2 ") == len(made.steps) - 1
