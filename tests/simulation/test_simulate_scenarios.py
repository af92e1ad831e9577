"""Scenarios as files: the ones that come along, determinism, and what is wrong with bad ones."""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
from command_line import call, check_one_line
from paths import ROOT

from graphslam.core.config_io import load_config
from graphslam.core.records import OdometryPose, Scan, Sighting
from graphslam.logs import LogWriter, open_logs, read_true_associations, read_truth
from graphslam.simulation import SCENARIOS, ScenarioError, load_scenario, simulate
from graphslam.simulation.scene import prepare_visits

CONFIG = load_config()

GOOD = """
[world]
walls = [
  { name = "room", points_m = [[0, 0], [8, 0], [8, 6], [0, 6]], closed = true },
  { name = "screen", points_m = [[4, 0], [4, 2]] },
]
boxes = [{ name = "table", center_m = [6, 4], size_m = [1, 1] }]
cylinders = [{ name = "post", center_m = [2, 4], radius_m = 0.2 }]

[robots.one]
start_m = [1, 1]
body = { radius_m = 0.3 }
drive = [{ through_m = [[3, 3]] }]
laser = { step_deg = 1.0 }
[robots.two]
start_m = [6, 2]
body = { length_m = 0.6, width_m = 0.4, rear_m = 0.2 }
sightings = [{ of = "robots" }, { of = "landmarks", identified = false }]
"""


def written(tmp_path, text):
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return path


def short(name, seconds=4.0):
    return replace(load_scenario(name), duration_s=seconds)


def messages(path, kind):
    return [m for m in open_logs([path], CONFIG).messages() if isinstance(m, kind)]


def digests(path):
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    return [hashlib.sha256(file.read_bytes()).hexdigest() for file in files]


def target_of(tmp_path, scenario, name="log"):
    return tmp_path / (name if scenario.later else f"{name}.mcap")


# ------------------------------------------------------------ the table


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_runs_and_its_log_is_readable(name, tmp_path):
    scenario = short(name)
    target = target_of(tmp_path, scenario)
    done = simulate(scenario, target)
    for recording in done.recordings:
        log = open_logs([recording.path], CONFIG)
        assert log.robots == tuple(sorted(scenario.robots))
        assert not log.warnings
        kinds = {type(m) for m in log.messages()}
        # a beam without a return is written as infinity (REP 117) and counted as such
        assert set(log.dropped) <= {"range: no return"}
        assert not log.warnings
        assert OdometryPose in kinds
        assert {Scan, Sighting} & kinds
        assert set(read_truth([recording.path], CONFIG).trajectories) == set(scenario.robots)


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_drive_is_free_of_collisions_to_its_end(name):
    """`prepare_visits` raises if a robot touches anything; and every drive moves its robot."""
    for visit in prepare_visits(load_scenario(name)):
        assert max(actor.drive.path_m for actor in visit.actors.values()) > 5


def test_lab_is_as_long_as_the_thesis_says(tmp_path):
    done = simulate(load_scenario("lab"), tmp_path / "lab.mcap").recordings[0]
    vehicle = done.robots["vehicle"]
    assert vehicle.scans == 350
    assert vehicle.path_m == pytest.approx(25, abs=0.5)
    assert done.path.stat().st_size < 2e6
    laser = load_scenario("lab").robots["vehicle"].laser
    assert (laser.range_sigma_m, laser.bias_sigma_m, laser.period_s) == (0.015, 0.01, 0.3)


def test_dead_reckoning_of_the_corridor_ends_80_m_off(tmp_path):
    done = simulate(load_scenario("corridor"), tmp_path / "c.mcap").recordings[0]
    assert done.robots["vehicle"].dead_reckoning_end_m > 80
    assert done.path.stat().st_size < 2e6
    poses = read_truth([done.path], CONFIG).trajectories["vehicle"].poses
    assert poses[0, :2] == pytest.approx(poses[-1, :2], abs=1e-3)


def test_the_pioneer_has_one_landmark_in_view_and_is_seen_at_every_sample(tmp_path):
    path = tmp_path / "two.mcap"
    done = simulate(load_scenario("two-robots"), path).recordings[0]
    assert done.robots["pioneer"].scans == 90
    seen = messages(path, Sighting)
    assert {m.seen_robot for m in seen} == {"pioneer"}
    assert {m.robot for m in seen} == {"vehicle"}
    stamps = np.array([m.stamp_ns for m in seen])
    assert (np.diff(stamps) == 300_000_000).all()
    segments = [m for m in read_truth([path], CONFIG).landmarks if m.kind == "segment"]
    assert [m.identity for m in segments] == ["wall"]
    # the wall, surface 0, is in every scan; poles are 1 to 6, the vehicle would be 7
    surfaces = done.scans["pioneer"].hits.surfaces
    assert np.count_nonzero(surfaces == 0, axis=1).min() >= 10
    assert surfaces.max() <= 6


def test_the_changed_table_moves_linearly_up_to_60_cm(tmp_path):
    done = simulate(load_scenario("change"), tmp_path / "change")
    assert sorted(p.name for p in done.target.iterdir()) == [
        "later.mcap",
        "reference.mcap",
        "truth.json",
    ]
    truth = json.loads((done.target / "truth.json").read_text())
    before, after = (np.array(truth["changes"][0][k]) for k in ("before", "after"))
    moved = np.hypot(*(after - before).T)
    assert moved == pytest.approx([0.0, 0.6], abs=1e-3)
    hinge, along = after[0], (after[1] - after[0]) / np.hypot(*(after[1] - after[0]))
    cells = [cell for cell in truth["cells"] if cell["kind"] == "appeared"]
    assert len(cells) > 20
    for cell in cells:
        offset = np.array([cell["x"], cell["y"]]) - hinge
        aside = offset[0] * along[1] - offset[1] * along[0]
        assert abs(aside) < truth["cell_m"]
        assert cell["displacement_m"] == pytest.approx(0.6 * offset @ along / 1.6, abs=0.01)
    assert min(c["displacement_m"] for c in cells) < 0.2
    assert max(c["displacement_m"] for c in cells) > 0.55


def test_worlds_are_made_of_what_their_names_say(tmp_path):
    kinds = {}
    for name in ("long-corridor", "forest"):
        simulate(load_scenario(name), tmp_path / f"{name}.mcap")
        marks = read_truth([tmp_path / f"{name}.mcap"], CONFIG).landmarks
        kinds[name] = [m.kind for m in marks]
        if name == "long-corridor":
            assert {m.pose[2] % np.pi for m in marks} == {0.0}
    assert kinds["long-corridor"] == ["segment"] * 2
    assert set(kinds["forest"]) == {"point"}


# ------------------------------------------------------------ determinism


@pytest.mark.parametrize("name", ["lab", "change", "fleet"])
def test_equal_seeds_give_equal_bytes_and_others_do_not(name, tmp_path):
    scenario = short(name)
    found = []
    for number, seed in enumerate((3, 3, 4)):
        target = target_of(tmp_path, scenario, str(number))
        simulate(scenario, target, seed)
        found.append(digests(target))
    assert found[0] == found[1]
    assert not set(found[0]) & set(found[2])


def test_another_sensor_does_not_change_the_noise_of_the_first(tmp_path):
    """So that experiments with and without cooperation differ in nothing else."""
    scenario = load_scenario(written(tmp_path, GOOD))
    simulate(scenario, tmp_path / "with.mcap")
    robots = dict(scenario.robots)
    robots["two"] = replace(robots["two"], sightings=())
    simulate(replace(scenario, robots=robots), tmp_path / "without.mcap")
    a, b = (messages(tmp_path / f"{name}.mcap", Scan) for name in ("with", "without"))
    assert len(a) == len(b) > 10
    for first, second in zip(a, b, strict=True):
        np.testing.assert_array_equal(first.ranges, second.ranges)


# ------------------------------------------------------------ the command


def test_the_command_writes_a_log_and_tells_about_it(tmp_path):
    path, log = written(tmp_path, GOOD), tmp_path / "log.mcap"
    done = call("simulate", path, "-o", log, "--seed", 7, "--json")
    assert done.code == 0
    told = json.loads(done.out)
    assert told["seed"] == 7
    assert told["recordings"][0]["robots"]["one"]["scans"] == len(messages(log, Scan))
    again = call("simulate", path, "-o", log)
    assert again.code == 1
    assert "--force" in again.err
    assert call("simulate", path, "-o", log, "--force").code == 0
    assert not list(tmp_path.glob(".*"))


def test_two_visits_need_a_folder(tmp_path):
    done = call("simulate", "change", "-o", tmp_path / "x.mcap")
    assert done.code == 1
    assert "-o DIR" in done.err


@pytest.mark.parametrize("name", ["thesis.txt", "drive.mcap", "folder/thesis.txt"])
def test_two_visits_replace_no_folder_of_others(tmp_path, name):
    """With --force any folder was deleted."""
    target = tmp_path / "mine"
    (target / name).parent.mkdir(parents=True)
    (target / name).write_text("dear", encoding="utf-8")
    done = call("simulate", "change", "-o", target, "--force")
    assert done.code == 1
    assert "mine: " in check_one_line(done)
    assert (target / name).read_text(encoding="utf-8") == "dear"


def test_sightings_without_identity_have_none(tmp_path):
    path = written(tmp_path, GOOD)
    simulate(load_scenario(path), tmp_path / "log.mcap")
    seen = messages(tmp_path / "log.mcap", Sighting)
    assert {(m.identity, m.seen_robot) for m in seen} == {(None, None), (None, "one")}


# ------------------------------------------------------------ bad files

ONE = "[robots.one]\nstart_m = [1, 1]\nbody = { radius_m = 0.3 }\n"
LATER = "[later]\n"
#: what to replace, by what, and what the line must say
BAD = {
    "unknown key": ("step_deg = 1.0", "step_dge = 1.0", r"one\.laser\.step_dge.*did you mean step"),
    "unknown table": ("[world]", "[wrold]", r"wrold: unknown key; did you mean world\?"),
    "missing key": ("start_m = [1, 1]\n", "", r"robots\.one\.start_m: missing"),
    "robot inside a wall": ("start_m = [1, 1]", "start_m = [0.1, 1]", "one: starts in room/4"),
    "robot inside a box": ("start_m = [6, 2]", "start_m = [6, 4]", "two: starts in table"),
    "drives through": ("[[3, 3]]", "[[7, 1]]", r"one: after [\d.]+ s drives into screen at"),
    "drives into a post": ("[[3, 3]]", "[[2, 5]]", r"drives into post"),
    "drives into a robot": ("[[3, 3]]", "[[3, 3], [6, 2]]", r"drives into robot two"),
    "zero rate": ("step_deg = 1.0", "period_s = 0", r"laser\.period_s: must be above 0, got 0"),
    "crossing walls": ("[4, 2]]", "[4, 7]]", "room/3 and screen cross"),
    "negative sigma": ("step_deg = 1.0", "range_sigma_m = -0.1", "range_sigma_m: must be at least"),
    "share above one": ("step_deg = 1.0", "dropout_share = 2", "dropout_share: must be at most 1"),
    "wrong type": ("radius_m = 0.3", 'radius_m = "big"', r"body\.radius_m: expected float"),
    "wrong length": ("start_m = [1, 1]", "start_m = [1, 1, 0]", r"start_m: expected 2 values"),
    "not finite": ("start_m = [1, 1]", "start_m = [1, nan]", r"start_m\[1\]: must be finite"),
    "not a list": ("start_m = [1, 1]", "start_m = 1", "start_m: expected a list"),
    "not a table": ("{ step_deg = 1.0 }", "3", "laser: expected a table"),
    "not TOML": ("[world]", "[world", "not valid TOML"),
    "same name": ('"screen"', '"table"', "2 things are named 'table'"),
    "no length": ("[4, 0], [4, 2]", "[4, 0], [4, 0]", "screen: needs two different points"),
    "two outlines": ("radius_m = 0.3", "radius_m = 0.3, length_m = 1, width_m = 1", "give either"),
    "rear": ("rear_m = 0.2", "rear_m = 0.9", "rear_m: is more than length_m"),
    "two in one leg": ("[[3, 3]] }", "[[3, 3]], turn_deg = 5 }", "exactly one of"),
    "empty leg": ("{ through_m = [[3, 3]] }", "{}", "exactly one of"),
    "turns back": ("[[3, 3]]", "[[3, 1], [1, 1.1]]", r"turns back at \(3, 1\)"),
    "beams": ("step_deg = 1.0", "step_deg = 0.7", "not a multiple of step_deg"),
    "ranges": ("step_deg = 1.0", "range_min_m = 9.0", "not below range_max_m"),
    "sees what": ('"robots"', '"people"', r"sightings\[0\]\.of: 'people' is not one of"),
    "sees whom": ('"robots"', '"robots", names = ["six"]', r"'six' is not one of the robots"),
    "name": ("[robots.two]", '[robots."two 2"]', "becomes part of ROS topics"),
    "no motion": ("drive = [{ through_m = [[3, 3]] }]\n", "", "no robot drives; set duration_s"),
    "no odometry": (
        "[robots.two]",
        "encoders = { odometry = false }\n[robots.two]",
        "must be true",
    ),
    "two worlds": ("[world]", 'world_of = "lab"\n[world]', "give either world or world_of"),
    "no such thing": ("[robots.two]", LATER + 'vanished = ["x"]\n[robots.two]', "'x'; known"),
    "no such robot": ("[robots.two]", "[later.robots.six]\nstart_m=[1,1]\n[robots.two]", "no such"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_get_one_clear_line(case, tmp_path):
    old, new, says = BAD[case]
    assert old in GOOD
    path = written(tmp_path, GOOD.replace(old, new, 1))
    with pytest.raises(ScenarioError, match=says) as told:
        prepare_visits(load_scenario(path))
    line = str(told.value)
    assert "\n" not in line
    assert "mine.toml" in line
    assert len(line) < 250


def test_the_good_file_is_good(tmp_path):
    assert len(prepare_visits(load_scenario(written(tmp_path, GOOD)))) == 1


def test_what_may_cross_may(tmp_path):
    text = GOOD.replace("[4, 2]]", "[4, 7]], may_cross = true").replace("[[3, 3]]", "[[3, 1]]")
    prepare_visits(load_scenario(written(tmp_path, text)))


@pytest.mark.parametrize(
    ("scenario", "says"),
    [("labb", "neither a file nor one of lab"), ("no/such.toml", "neither a file"), (".", "read")],
)
def test_missing_files_are_told_in_one_line(scenario, says, tmp_path):
    done = call("simulate", scenario, "-o", tmp_path / "x.mcap")
    assert done.code == 1
    assert says in done.err
    assert done.err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_world_may_come_from_another_file(tmp_path):
    written(tmp_path, GOOD)
    other = tmp_path / "other.toml"
    other.write_text('world_of = "mine.toml"\nduration_s = 1.0\n' + ONE, encoding="utf-8")
    assert load_scenario(other).world == load_scenario(tmp_path / "mine.toml").world
    other.write_text('world_of = "other.toml"\n' + ONE, encoding="utf-8")
    with pytest.raises(ScenarioError, match="names the file itself"):
        load_scenario(other)


def test_the_example_of_the_documentation_runs(tmp_path):
    page = (ROOT / "docs/simulator.md").read_text(encoding="utf-8")
    path = written(tmp_path, page.split("```toml\n")[1].split("```")[0])
    done = call("simulate", path, "-o", tmp_path / "out")
    assert done.code == 0, done.err
    assert all(f"| `{name}` |" in page for name in SCENARIOS)


# ------------------------------------------------------------ true associations


def test_true_associations_name_what_beams_and_sightings_met(tmp_path):
    """Every beam's target is the surface that the noise-free beam met, robots among them, and lies
    where the range says; every sighting's is the robot that it says, or a landmark."""
    scenario = short("fleet")
    done = simulate(scenario, tmp_path / "fleet.mcap").recordings[0]
    topics = read_true_associations([done.path], CONFIG)
    truth = read_truth([done.path], CONFIG)
    known = {landmark.identity for landmark in truth.landmarks}
    met_robots = 0
    for name in scenario.robots:
        scans = topics[f"/{name}/true_associations/scan"]
        surfaces = done.scans[name].hits.surfaces
        assert len(scans) == len(surfaces)
        for scan, numbers in zip(scans, surfaces, strict=True):
            np.testing.assert_array_equal(scan.targets >= 0, numbers >= 0)
            # equal numbers, equal names, and the other way round
            pairs = {(int(n), int(t)) for n, t in zip(numbers, scan.targets, strict=True)}
            assert len(pairs) == len({n for n, _ in pairs}) == len({t for _, t in pairs})
            assert set(scan.names) <= known | set(scenario.robots) - {name}
            met_robots += bool(set(scan.names) & set(scenario.robots))
    assert met_robots
    log = open_logs([done.path], CONFIG)
    sightings = [m for m in log.messages() if isinstance(m, Sighting)]
    for name in scenario.robots:
        own = [m for m in sightings if m.robot == name]
        named = [
            (image.stamp_ns, image.names[target])
            for image in topics[f"/{name}/true_associations/sightings"]
            for target in image.targets
        ]
        assert [m.stamp_ns for m in own] == [stamp_ns for stamp_ns, _ in named]
        for message, (_, target) in zip(own, named, strict=True):
            assert message.seen_robot == target or (message.seen_robot is None and target in known)


def test_true_associations_need_targets_among_their_names(tmp_path):
    with LogWriter(tmp_path / "bad.mcap", {}) as log:
        log.odometry("robot", 1, (0, 0, 0))
        log.true_associations("robot", 1, "scan", ["wall"], [0, 1])
        log.true_associations("robot", 2, "scan", ["wall"], [0, -1])
    found = read_true_associations([tmp_path / "bad.mcap"], CONFIG)
    (message,) = found["/true_associations/scan"]
    assert message.names == ("wall",) and message.targets.tolist() == [0, -1]
