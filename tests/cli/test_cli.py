"""The command line: what scripts rely on. Exit codes, one-line errors, JSON, and a whole run."""

import errno
import json
import os
import re
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import call, check_one_line
from mcap.writer import Writer
from paths import ROOT
from room_log import MOUNT, SCAN, SCANS, START_NS, S, drive, true_pose

from graphslam.cli import main, terminal
from graphslam.core.config_io import load_config
from graphslam.core.geometry import between, compose
from graphslam.importers import IMPORTERS
from graphslam.logs import LogWriter
from graphslam.results.file_formats import read_trajectory
from graphslam.results.folder import load
from graphslam.slam import smooth as smooth_module


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """The log, the folder that smooth made of it, and what it printed with --json."""
    folder = tmp_path_factory.mktemp("room")
    log = drive(folder / "room.mcap")
    done = call("smooth", log, "-o", folder / "out", "--start", "truth", "--causal", "--json")
    assert done.code == 0, done.err
    return SimpleNamespace(folder=folder, log=log, out=folder / "out", done=done)


def listing(folder):
    """Every file under a folder with its content."""
    return {p: p.read_bytes() if p.is_file() else None for p in sorted(folder.rglob("*"))}


# ---------------------------------------------------------------- a whole run


def test_smooth_writes_every_file_of_the_contract(room):
    names = {str(p.relative_to(room.out)) for p in room.out.rglob("*") if p.is_file()}
    stems = ("tum", "causal.tum", "scan.tum", "scan.causal.tum", "cov.csv", "causal.cov.csv")
    stems += ("odometry.tum",)
    assert names == {
        *("summary.json", "config.toml", "landmarks.json", "graph.g2o", "graph_ids.csv"),
        *("report.html", "joint.npz", "scans.npz"),
        *(f"trajectories/robot.{stem}" for stem in stems),
    }
    assert sorted(p.name for p in room.folder.iterdir()) == ["out", "room.mcap"]


def test_causal_files_of_a_log_of_scans_are_written_where_they_are_asked_for(room, tmp_path):
    """Without --causal there are none, nor is anything else missing; a back end that is causal by
    nature always writes them."""
    for chosen, extra in (((), set()), (("--backend", "ekf"), {"causal.tum", "causal.cov.csv"})):
        out = tmp_path / f"out{len(chosen)}"
        assert call("smooth", room.log, "-o", out, *chosen).code == 0
        stems = {p.name.removeprefix("robot.") for p in (out / "trajectories").iterdir()}
        assert stems - {"scan.causal.tum"} == {"tum", "scan.tum", "cov.csv", "odometry.tum"} | extra
        assert ("scan.causal.tum" in stems) == bool(extra)
    report = (tmp_path / "out0" / "report.html").read_text()
    assert "causal estimate" not in report and "Final against odometry" in report


def test_smooth_prints_the_summary_that_it_wrote(room):
    summary = json.loads(room.done.out)
    assert summary == json.loads((room.out / "summary.json").read_text())
    assert room.done.err == ""
    assert summary["counts"]["scans"] == SCANS + 1
    assert set(summary) >= {
        *("format", "versions", "logs", "config_sha256", "stages", "scans_per_s"),
        *("real_time_factor", "peak_memory_mb", "counts", "rejected", "dropped", "graph"),
        *("calibration", "warnings"),
    }
    assert summary["warnings"] == []


def test_every_scan_has_a_pose_of_base_and_laser_at_its_own_stamp(room):
    """The laser sits rigidly on the base, where calibration puts it: near where the log says."""
    stamps = START_NS + 7 + np.arange(SCANS + 1) * S // 2
    for kind in ("tum", "causal.tum", "scan.tum", "scan.causal.tum"):
        trajectory = read_trajectory(room.out / f"trajectories/robot.{kind}")
        np.testing.assert_array_equal(trajectory.stamps_ns, stamps)
    base = read_trajectory(room.out / "trajectories/robot.tum").poses
    laser = read_trajectory(room.out / "trajectories/robot.scan.tum").poses
    mounts = between(base, laser)
    np.testing.assert_allclose(mounts, mounts[[0] * len(mounts)], atol=1e-6)
    np.testing.assert_allclose(mounts[0], MOUNT, atol=0.1)


def test_the_room_is_mapped_to_centimetres_where_odometry_is_off_by_decimetres(room):
    """Odometry alone ends 0.6 m off; walls within 10 m at 1 cm of noise allow a few centimetres.

    Unaligned there is also where the laser sits on the base, which this drive hardly tells.
    """
    done = call("evaluate", room.out, "--json")
    found = json.loads(done.out)["robots"]["robot"]
    assert found["final"]["ate_aligned_rmse_m"] < 0.05
    assert found["final"]["ate_rmse_m"] < 0.08
    assert found["causal"]["ate_rmse_m"] < 0.10
    assert found["final"]["heading_rmse_rad"] < 0.01
    reckoned = call("smooth", room.log, "-o", room.folder / "dr", "--backend", "dead-reckoning",
                    "--start", "truth", "--json")  # fmt: skip
    assert reckoned.code == 0, reckoned.err
    off = json.loads(call("evaluate", room.folder / "dr", "--json").out)["robots"]["robot"]
    assert off["final"]["max_m"] > 0.3


def test_the_report_shows_the_truth_that_the_log_holds(room):
    assert "Against the truth" in (room.out / "report.html").read_text()


def test_output_for_people_says_what_was_found_and_where_the_report_is(room, tmp_path):
    done = call("smooth", room.log, "-o", tmp_path / "out")
    assert done.code == 0
    assert re.search(r"^1 robot, 61 scans, \d+ keyframes, \d+ landmarks", done.out)
    assert f"report: {tmp_path / 'out' / 'report.html'}\n" in done.out
    tables = call("evaluate", room.out).out.splitlines()
    assert tables[0].split()[:3] == ["robot", "ATE,", "m"]
    assert [line.split()[:2] for line in tables[1:3]] == [["robot", "final"], ["robot", "causal"]]
    info = call("info", room.log).out
    assert re.search(r"^/scan: 181 beams over 180 deg, .*, noise \d+ mm$", info, re.MULTILINE)
    assert f"usable: graphslam smooth {room.log} -o DIR" in info


def test_the_page_on_formats_has_every_file_and_every_key(room):
    page = (ROOT / "docs/formats.md").read_text(encoding="utf-8")
    for path in room.out.rglob("*.*"):
        assert path.name.replace("robot.", "ROBOT.") in page
    evaluation = json.loads(call("evaluate", room.out, "--json").out)
    landmark = json.loads((room.out / "landmarks.json").read_text())[0]
    summary = json.loads((room.out / "summary.json").read_text())
    robot = evaluation["robots"]["robot"]["final"]
    for key in (*summary, *summary["counts"], *landmark, *evaluation, *robot):
        assert f"`{key}`" in page, key


# ---------------------------------------------------------------- JSON


def test_json_of_every_command_is_one_object(room, tmp_path):
    relations = write_relations(tmp_path / "relations", room)
    pose_graph = tmp_path / "graph.txt"
    pose_graph.write_text("ODOMETRY 0 1 1 0 0 0.01 0 0 0.01 0 0.01\n")
    for arguments in (
        ("info", room.log),
        ("import", "isam", pose_graph, "-o", tmp_path / "graph.mcap"),
        ("evaluate", room.out),
        ("evaluate", room.out, "--relations", relations),
    ):
        done = call(*arguments, "--json")
        assert (done.code, done.err) == (0, "")
        assert isinstance(json.loads(done.out), dict)


def test_info_of_a_laser_without_limits_is_json_too(tmp_path):
    """JSON has no infinity, and drivers write it as a range limit."""
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        for k in range(5):
            log.odometry("robot", k * S, (k, 0, 0))
            log.scan("robot", k * S, np.ones(9), **SCAN | {"range_max_m": np.inf})
    done = call("info", path, "--json")
    assert done.code == 0, done.err
    assert [t["scan"]["range_max_m"] for t in json.loads(done.out)["topics"] if t["scan"]] == [None]
    assert "9 beams over 8 deg" in call("info", path).out


def write_relations(path, room):
    """Relations between neighbouring scans, from the truth."""
    lines = []
    for k in range(0, SCANS, 10):
        stamps = [START_NS + 7 + j * S // 2 for j in (k, k + 10)]
        a, b = (compose(true_pose(j / 2), MOUNT) for j in (k, k + 10))
        x, y, phi = between(a, b)
        seconds = " ".join(f"{t // S}.{t % S:09d}" for t in stamps)
        lines.append(f"{seconds} {x} {y} 0 0 0 {phi}\n")
    path.write_text("".join(lines))
    return path


def test_evaluate_against_relations_and_tum(room, tmp_path):
    relations = write_relations(tmp_path / "relations", room)
    found = json.loads(call("evaluate", room.out, "--relations", relations, "--json").out)
    assert set(found) == {"relations"}
    assert (found["relations"]["all"]["n"], found["relations"]["all"]["unmatched"]) == (6, 0)
    assert found["relations"]["all"]["trans_mean_m"] < 0.06
    truth = room.out / "trajectories/robot.tum"
    for given in (truth, f"robot={truth}"):
        same = json.loads(call("evaluate", room.out, "--truth", given, "--json").out)
        assert same["robots"]["robot"]["final"]["ate_rmse_m"] == pytest.approx(0, abs=1e-9)


# ---------------------------------------------------------------- settings


@pytest.mark.parametrize(("given", "seconds"), [("0", 0.0), ("2.5", 2.5), ("inf", float("inf"))])
def test_the_horizon_is_a_setting_and_goes_through_the_whole_pipeline(
    room, tmp_path, given, seconds
):
    """From no past to all of it: every one maps the room, where odometry is off by decimetres."""
    done = call("smooth", room.log, "-o", tmp_path / "out", "--start", "truth", "--horizon", given)
    assert done.code == 0, done.err
    assert load_config(tmp_path / "out" / "config.toml").backend.horizon_s == seconds
    found = json.loads(call("evaluate", tmp_path / "out", "--json").out)["robots"]["robot"]
    assert found["final"]["ate_rmse_m"] < 0.10


@pytest.mark.parametrize("chosen", [("--backend", "ekf"), ("--set", "backend.name=batch")])
def test_a_horizon_is_refused_where_it_would_do_nothing(chosen, tmp_path):
    """Wherever the back end was chosen, and before any work."""
    done = call("smooth", "missing.mcap", "-o", tmp_path / "out", "--horizon", "5", *chosen)
    assert "only isam2 supports --horizon" in check_one_line(done)


def test_options_become_settings_over_the_file_and_set_has_the_last_word(room, tmp_path):
    file = tmp_path / "c.toml"
    file.write_text(
        "[backend]\nname = 'batch'\noptimise_at_end = false\n[keyframe]\ndistance_m = 0.5\n"
    )
    done = call(
        *("smooth", room.log, "-o", tmp_path / "out", "--config", file, "--backend"),
        *("dead-reckoning", "--front-end", "none", "--start", "robot=1,-2,0.5"),
        *("--set", "keyframe.distance_m=0.7"),
    )
    assert done.code == 0, done.err
    written = load_config(tmp_path / "out" / "config.toml")
    assert (written.backend.name, written.backend.optimise_at_end) == ("dead-reckoning", False)
    assert written.front_end.name == "none"
    assert written.keyframe.distance_m == 0.7
    assert dict(written.start.poses) == {"robot": (1.0, -2.0, 0.5)}
    first = read_trajectory(tmp_path / "out/trajectories/robot.tum").poses[0]
    np.testing.assert_allclose(first, [1, -2, 0.5], atol=1e-3)


def test_an_old_key_is_used_and_its_new_name_is_said_once(room, tmp_path):
    out = tmp_path / "out"
    done = call("smooth", room.log, "-o", out, "--set", "backend.polish=false")
    assert done.code == 0, done.err
    said = "backend.polish is now called backend.optimise_at_end"
    assert done.out.count(said) == 1
    assert json.loads((out / "summary.json").read_text())["warnings"].count(said) == 1
    assert load_config(out / "config.toml").backend.optimise_at_end is False


# ---------------------------------------------------------------- what goes wrong


def not_mcap(folder):
    (folder / "log.mcap").write_text("no MCAP")


def empty_log(folder):
    with LogWriter(folder / "log.mcap"):
        pass


def no_usable_topic(folder):
    with (folder / "log.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        schema = writer.register_schema("sensor_msgs/msg/Image", "ros2msg", b"")
        channel = writer.register_channel("/camera", "cdr", schema)
        writer.add_message(channel, 1, b"\0\1\0\0", 1)
        writer.finish()


def one_scan(folder):
    with LogWriter(folder / "log.mcap") as log:
        log.scan("robot", S, np.ones(181), **SCAN)


def good_log(folder):
    drive(folder / "log.mcap", seconds=2, truth=False)


BAD_LOGS = {
    "no such file": (lambda _folder: None, "log.mcap: no such file"),
    "not MCAP": (not_mcap, "log.mcap: is not an MCAP file"),
    "empty log": (empty_log, "log.mcap: is an empty log"),
    "no usable topic": (no_usable_topic, r"no usable topic; the log has /camera"),
    "one scan, no odometry": (one_scan, "nothing in it could be used"),
}


@pytest.mark.parametrize("case", BAD_LOGS)
def test_a_bad_log_is_one_line_and_leaves_nothing(case, tmp_path):
    make, message = BAD_LOGS[case]
    make(tmp_path)
    before = listing(tmp_path)
    done = call("smooth", tmp_path / "log.mcap", "-o", tmp_path / "out")
    assert re.search(message, check_one_line(done))
    assert listing(tmp_path) == before


BAD_OPTIONS = {
    "unknown key": (("--set", "keyframe.distanse_m=1"), "unknown key; did you mean distance_m"),
    "no value": (("--set", "keyframe"), "write it as key=value"),
    "wrong type": (
        ("--set", "backend.optimise_at_end=3"),
        "backend.optimise_at_end: expected bool",
    ),
    "no config file": (("--config", "missing.toml"), "missing.toml: cannot be read"),
    "start of a stranger": (
        ("--start", "nobody=1,2,3"),
        "--start nobody: .*robots robot",
    ),
    "start from no truth": (("--start", "truth"), "has no truth for robot"),
}


@pytest.mark.parametrize("case", BAD_OPTIONS)
def test_a_bad_setting_is_one_line_and_leaves_nothing(case, tmp_path):
    options, message = BAD_OPTIONS[case]
    good_log(tmp_path)
    before = listing(tmp_path)
    done = call("smooth", tmp_path / "log.mcap", "-o", tmp_path / "out", *options)
    assert re.search(message, check_one_line(done))
    assert listing(tmp_path) == before


USAGE = {
    "no command": ((), "Usage:"),
    "unknown command": (("smoth",), "No such command 'smoth'"),
    "no output": (("smooth", "log.mcap"), "-o"),
    "no log": (("smooth", "-o", "out"), "LOG"),
    "two numbers": (("smooth", "l", "-o", "o", "--start", "a=1,2"), "ROBOT=x,y,phi"),
    "not numbers": (("smooth", "l", "-o", "o", "--start", "a=x,y,z"), "ROBOT=x,y,phi"),
    "not finite": (("smooth", "l", "-o", "o", "--start", "a=1,2,nan"), "ROBOT=x,y,phi"),
    "no robot": (("smooth", "l", "-o", "o", "--start", "=1,2,3"), "ROBOT=x,y,phi"),
    "back end": (("smooth", "l", "-o", "o", "--backend", "ceres"), "isam2, batch"),
    "front end": (("smooth", "l", "-o", "o", "--front-end", "x"), "segments, hough, both, none"),
    "horizon": (("smooth", "l", "-o", "o", "--horizon", "-1"), "seconds from 0 to inf"),
    "no horizon": (("smooth", "l", "-o", "o", "--horizon", "nan"), "seconds from 0 to inf"),
    "format": (("import", "lcm", "a", "-o", "b"), ", ".join(sorted(IMPORTERS))),
}


@pytest.mark.parametrize("case", USAGE)
def test_wrong_usage_is_exit_code_two_and_says_what_is_right(case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments, message = USAGE[case]
    done = call(*arguments)
    assert done.code == 2
    assert message in done.out + done.err
    assert not list(tmp_path.iterdir())


def test_an_existing_folder_is_kept_without_force_and_before_any_work(room, tmp_path):
    before = listing(room.out)
    done = call("smooth", "missing.mcap", "-o", room.out)
    assert "already exists; give --force" in check_one_line(done)
    assert listing(room.out) == before
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.tex").write_text("years of work")
    done = call("smooth", room.log, "-o", tmp_path / "thesis", "--force")
    assert "is not a result folder" in check_one_line(done)
    assert (tmp_path / "thesis" / "chapter1.tex").exists()
    (tmp_path / "file").write_text("")
    done = call("smooth", room.log, "-o", tmp_path / "file" / "out")
    assert "is no folder to write to" in check_one_line(done)


def test_force_replaces_a_result_only_by_a_whole_one(tmp_path):
    good_log(tmp_path)
    log, out = tmp_path / "log.mcap", tmp_path / "out"
    assert call("smooth", log, "-o", out).code == 0
    before = listing(tmp_path)
    check_one_line(call("smooth", log, "-o", out, "--force", "--start", "truth"))
    assert listing(tmp_path) == before
    assert call("smooth", log, "-o", out, "--force", "--start", "robot=1,1,0").code == 0
    assert load(out).config.start.poses
    assert sorted(p.name for p in tmp_path.iterdir()) == ["log.mcap", "out"]


def test_import_keeps_an_existing_log_without_force(tmp_path):
    source, target = tmp_path / "log.clf", tmp_path / "log.mcap"
    source.write_text("ODOM 0 0 0 0 0 0 1.5 host 1.5\nODOM 1 0 0 0 0 0 2.5 host 2.5\n")
    assert call("import", "carmen", source, "-o", target).out.startswith(f"{target}: 3 messages")
    before = listing(tmp_path)
    assert "already exists" in check_one_line(call("import", "carmen", source, "-o", target))
    assert call("import", "carmen", source, "-o", target, "--force").code == 0
    content = source.read_bytes()
    assert "is what is to be imported" in check_one_line(
        call("import", "carmen", source, "-o", source, "--force")
    )
    assert source.read_bytes() == content
    assert listing(tmp_path) == before
    missing = call("import", "carmen", tmp_path / "nothing.clf", "-o", tmp_path / "b.mcap")
    assert "nothing.clf: no such file" in check_one_line(missing)
    assert listing(tmp_path) == before


BAD_TRUTH = {
    "bad relations": (("--relations", "bad"), "bad:2: expected 8 numbers, got 3"),
    "no relations": (("--relations", "missing"), "missing: cannot be read"),
    "bad TUM": (("--truth", "bad"), "bad:1: expected 8 numbers, got 9"),
    "TUM of a stranger": (("--truth", "nobody=bad"), "of which robot is it"),
    "a log without truth": (
        ("--truth", "log.mcap"),
        "log.mcap: holds no true poses or landmarks; give a file",
    ),
}


@pytest.mark.parametrize("case", BAD_TRUTH)
def test_bad_truth_is_one_line(case, room, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    good_log(tmp_path)
    Path("bad").write_text("# t1 t2 x y z roll pitch yaw\n1 2 3\n")
    if "TUM" in case:
        Path("bad").write_text("1 2 3 4 5 6 7 8 9\n")
    options, message = BAD_TRUTH[case]
    assert message in check_one_line(call("evaluate", room.out, *options))


def test_evaluate_says_when_there_is_nothing_to_compare_with(room, tmp_path):
    good_log(tmp_path)
    log, out = tmp_path / "log.mcap", tmp_path / "out"
    assert call("smooth", log, "-o", out).code == 0
    assert "give --truth or --relations" in check_one_line(call("evaluate", out))
    drive(log, seconds=3)  # truth, but of another drive
    assert "is not the log that was smoothed" in check_one_line(call("evaluate", out))
    assert "not a result folder" in check_one_line(call("evaluate", tmp_path))


# ---------------------------------------------------------------- odd data


def test_odd_ranges_are_dropped_and_counted_and_the_run_goes_on(tmp_path):
    def spoil(ranges, k):
        bad = ranges.copy()
        bad[3::20] = (np.nan, np.inf, -1.0, 5e4)[k % 4]
        return bad

    log = drive(tmp_path / "log.mcap", seconds=10, ranges=spoil)
    done = call("smooth", log, "-o", tmp_path / "out", "--start", "truth", "--json")
    assert done.code == 0, done.err
    summary = json.loads(done.out)
    assert summary["counts"]["scans"] == 21
    assert summary["dropped"]["range: negative"] == 5 * 9
    assert summary["dropped"]["range: absurd"] == 5 * 9
    found = json.loads(call("evaluate", tmp_path / "out", "--json").out)
    assert found["robots"]["robot"]["final"]["ate_rmse_m"] < 0.05
    assert "45 range: negative" in call("info", log).out


def test_scans_without_beams_are_dropped_and_counted(tmp_path):
    log = drive(tmp_path / "log.mcap", seconds=5, ranges=lambda found, k: found[: 181 * (k % 2)])
    done = call("smooth", log, "-o", tmp_path / "out", "--json")
    assert done.code == 0, done.err
    summary = json.loads(done.out)
    assert summary["counts"]["scans"] == 5
    assert summary["dropped"]["scan: no beams"] == 6


# ---------------------------------------------------------------- the process


def made_of(cause, error=ImportError):
    """As the extension of gtsam fails to be imported, and a class of Python 3.11 to be made."""
    made = error("initialization failed")
    made.__cause__ = cause
    return made


def fail_with(error):
    def smooth(*_arguments, **_more):
        raise error

    return smooth


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (KeyboardInterrupt(), 130, r""),
        (made_of(KeyboardInterrupt()), 130, r""),
        (made_of(made_of(KeyboardInterrupt())), 130, r""),
        (made_of(KeyboardInterrupt(), RuntimeError), 130, r""),
        (made_of(OSError("bad library")), 1, r"unexpected ImportError: .*\n"),
        (OSError(errno.ENOSPC, "No space left on device", "x"), 1, r"x: No space left on device\n"),
        (RuntimeError("two\nlines"), 1, r"unexpected RuntimeError: two lines; .*--debug.*\n"),
    ],
)
def test_any_error_is_reported_in_one_line(error, code, text, tmp_path, monkeypatch):
    good_log(tmp_path)
    before = listing(tmp_path)
    monkeypatch.setattr(smooth_module, "smooth", fail_with(error))
    done = call("smooth", tmp_path / "log.mcap", "-o", tmp_path / "out")
    assert (done.code, done.out) == (code, "")
    assert re.fullmatch(rf"graphslam: error: {text}" if text else "", done.err)
    assert listing(tmp_path) == before


def test_a_full_disk_leaves_nothing(tmp_path, monkeypatch):
    good_log(tmp_path)
    before = listing(tmp_path)

    def full(*_arguments, **_options):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    done = call("smooth", tmp_path / "log.mcap", "-o", tmp_path / "out")
    assert "out: cannot be written: No space left on device" in check_one_line(done)
    assert listing(tmp_path) == before


def test_debug_shows_the_traceback(tmp_path):
    with pytest.raises(Exception, match="no such file"):
        main(["info", "--debug", str(tmp_path / "missing.mcap")])


def test_the_bar_is_drawn_on_a_terminal_only_and_never_on_stdout(capsys, monkeypatch):
    with terminal.progress_bar("smoothing") as progress:
        progress(5, 10)
    assert capsys.readouterr() == ("", "")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    with terminal.progress_bar("smoothing") as progress:
        progress(10, 10)
    out, err = capsys.readouterr()
    assert out == ""
    assert "10/10" in err


def test_the_module_runs_and_answers_before_anything_heavy_is_imported():
    command = [sys.executable, "-X", "importtime", "-m", "graphslam", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    for name in ("info", "import", "smooth", "evaluate"):
        assert f"  {name} " in done.stdout
    imported = {line.rsplit("|", 1)[-1].strip() for line in done.stderr.splitlines()}
    assert "graphslam.cli" in imported
    assert not imported & {"gtsam", "cv2", "matplotlib", "scipy.stats"}


def test_a_log_is_being_read_before_what_only_the_estimate_needs_is_imported(tmp_path):
    """Importing that takes as long as a tenth of a small log; meanwhile the log can be read. What
    reading needs as well is imported before, once for both processes."""
    code = (
        "import sys, graphslam.cli\n"
        "from graphslam.scan_smoothing import log_reader\n"
        "log_reader.Exchange = lambda *_: sys.exit(' '.join(sys.modules))\n"
        f"graphslam.cli.main(['smooth', 'logs/lab.mcap', '-o', {str(tmp_path / 'out')!r}])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    loaded = set(done.stderr.split())
    assert "graphslam.logs.mcap_file" in loaded
    assert {"scipy.spatial", "graphslam.scan_smoothing.scan_keyframes"} <= loaded
    assert not loaded & {"gtsam", "scipy.optimize", "rich", "graphslam.results.folder"}


def test_sightings_are_solved_without_what_only_scans_need():
    """OpenCV and what matches scans take 30 MB and a twentieth of a small log of sightings."""
    code = (
        "import sys, graphslam.slam.smooth, graphslam.results.report\n"
        "from graphslam.odometry import noise_estimation\n"
        "print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "graphslam.slam.sighting_passes" in loaded
    assert not loaded & {"cv2", "scipy.optimize", "graphslam.scan_smoothing.scan_log"}


def test_a_process_of_its_own_ends_with_its_exit_code_and_all_of_its_output(tmp_path):
    """It ends without the usual steps of Python: an output that is not flushed first is lost."""
    missing = [sys.executable, "-m", "graphslam", "info", str(tmp_path / "none.mcap")]
    done = subprocess.run(missing, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("graphslam: error: ") and done.stderr.endswith("\n")
    version = [sys.executable, "-m", "graphslam", "--version"]
    done = subprocess.run(version, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, call("--version").out.strip())


def test_the_version_is_that_of_the_package():
    assert call("--version").out == f"{version('coop-graphslam')}\n"


def test_matrices_have_one_thread_unless_the_environment_says_otherwise():
    """Breaks when numpy is loaded before that is said: its threads then wait for each other."""
    code = (
        "import sys, graphslam.cli; assert 'numpy' not in sys.modules\n"
        "try: graphslam.cli.main(['--version'])\n"
        "finally: import os; print(os.environ['OPENBLAS_NUM_THREADS'])"
    )
    for chosen in (None, "3"):
        environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
        if chosen:
            environment["OPENBLAS_NUM_THREADS"] = chosen
        done = subprocess.run(
            [sys.executable, "-c", code],
            check=True,
            capture_output=True,
            text=True,
            env=environment,
        )
        assert done.stdout.split()[-1] == (chosen or "1")


# ---------------------------------------------------------------- maps


def test_map_makes_in_the_folder_what_smooth_makes_with_map(room, tmp_path):
    """And says what: of the files of the command no other is touched."""
    done = call("smooth", room.log, "-o", tmp_path / "out", "--start", "truth", "--map")
    assert done.code == 0, done.err
    made = call("map", room.out, "-o", tmp_path / "maps", "--json")
    names = json.loads(made.out)["files"]
    assert sorted(names) == sorted(p.name for p in (tmp_path / "maps").iterdir())
    for name in names:
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "maps" / name).read_bytes()
    again = call("map", tmp_path / "out")
    assert (again.code, again.err.count("\n")) == (1, 1) and "--force" in again.err
    finer = call("map", tmp_path / "out", "--resolution", "0.02", "--mode", "scale", "--force")
    assert "cells of 0.02 m" in finer.out
    assert (tmp_path / "out/map.png").is_file()
    assert call("map", room.out, "--resolution", "0").code == 2


def test_map_says_if_the_result_is_not_good(room, tmp_path):
    """Who makes a map for navigation need not have read the report."""
    target = tmp_path / "out"
    shutil.copytree(room.out, target)
    for verdict in ("good", "doubtful", "bad"):
        summary = json.loads((target / "summary.json").read_text())
        summary["verdict"]["verdict"] = verdict
        (target / "summary.json").write_text(json.dumps(summary))
        told = call("map", target, "-o", tmp_path / verdict).out
        assert (f"verdict on the result is {verdict}" in told) == (verdict != "good")
        made = call("map", target, "-o", tmp_path / verdict, "--force", "--json")
        assert json.loads(made.out)["verdict"] == verdict
