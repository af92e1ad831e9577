"""A batch of logs: a result of each, one overview, nothing done twice, nothing lost."""

import json
import os
import re
import shutil
import socket
from pathlib import Path
from types import SimpleNamespace

import pytest
from command_line import call, check_one_line
from room_log import drive

from graphslam.campaigns import batch as batch_module
from graphslam.campaigns import log_results
from graphslam.campaigns.log_results import work_on_log
from graphslam.campaigns.one_log import LogTask, failed_row, read_row
from graphslam.campaigns.tasks import Outcome
from graphslam.cli import arguments
from graphslam.core.config_io import load_config
from graphslam.core.errors import LogError, OutputError
from graphslam.logs.find_recordings import find_recordings
from graphslam.results.folder import load

SHORT_S = 6


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """Three logs, one of them in a folder below, one that is none, and what `batch` made of them
    with two processes."""
    folder = tmp_path_factory.mktemp("fleet")
    logs = folder / "logs"
    (logs / "b").mkdir(parents=True)
    drive(logs / "a.mcap", seconds=SHORT_S)
    drive(logs / "b" / "day.mcap", seconds=SHORT_S + 1, robot="b")
    drive(logs / "c.mcap", seconds=SHORT_S, truth=False)
    (logs / "broken.mcap").write_bytes(b"no recording")
    (logs / "notes.txt").write_text("passed over")
    done = call("batch", logs, "-o", folder / "out", "--jobs", "2", "--json")
    return SimpleNamespace(logs=logs, out=folder / "out", done=done, found=json.loads(done.out))


def rows_of(found):
    return {row["name"]: row for row in found["logs"]}


def copy_of(fleet, tmp_path):
    shutil.copytree(fleet.out, tmp_path / "out")
    return tmp_path / "out"


def test_a_folder_of_logs_becomes_a_folder_of_results_and_an_overview(fleet):
    """The broken one is listed with its line, does not stop the rest, and is said at the end."""
    assert fleet.done.code == 1
    assert re.search(
        r"graphslam: error: 1 of 4 logs failed; broken: .* not an MCAP file", fleet.done.err
    )
    assert [row["name"] for row in fleet.found["logs"]] == ["a", "b-day", "broken", "c"]
    assert fleet.found == json.loads((fleet.out / "overview.json").read_text())
    counts = fleet.found["counts"]
    assert (counts["logs"], counts["done"], counts["failed"], counts["waiting"]) == (4, 3, 1, 0)
    assert [Path(path).name for path in fleet.found["not_recordings"]] == ["notes.txt"]
    rows = rows_of(fleet.found)
    assert rows["broken"]["status"] == "failed" and "MCAP" in rows["broken"]["error"]
    assert rows["a"]["length_m"] == pytest.approx(3.1, abs=0.4)
    assert rows["a"]["duration_s"] == pytest.approx(SHORT_S, abs=0.2)
    assert 0 < rows["a"]["error_m"] < 0.1 and rows["c"]["error_m"] is None
    assert rows["b-day"]["robots"] == ["b"]
    for name in ("a", "b-day", "c"):
        assert 0 < rows[name]["sigma_m"] < 0.3 and rows[name]["memory_mb"] > 10
        assert load(fleet.out / "results" / name).robots
    assert sorted(p.name for p in fleet.out.iterdir()) == [
        "overview.json",
        "report.html",
        "results",
    ]


def test_the_result_of_a_log_is_that_of_smooth(fleet, tmp_path):
    assert call("smooth", fleet.logs / "a.mcap", "-o", tmp_path / "alone").code == 0
    for alone in (tmp_path / "alone").rglob("*"):
        if alone.suffix in (".tum", ".csv", ".g2o", ".toml") or alone.name == "landmarks.json":
            inside = fleet.out / "results" / "a" / alone.relative_to(tmp_path / "alone")
            assert inside.read_bytes() == alone.read_bytes()


def test_logs_of_a_batch_are_localised_in_a_known_map(tmp_path, monkeypatch):
    """Given from where the command runs, which need not be where workers are."""
    monkeypatch.chdir(tmp_path)
    drive(tmp_path / "monday.mcap")
    (tmp_path / "logs").mkdir()
    drive(tmp_path / "logs" / "tuesday.mcap", seed=8)
    assert call("smooth", "monday.mcap", "-o", "monday").code == 0
    at = ("--set", "known_map.directory=monday", "--start", "robot=0,0,0")
    done = call("batch", "logs", "-o", "out", *at)
    assert done.code == 0, done.err
    folder = tmp_path / "out" / "results" / "tuesday"
    known = json.loads((folder / "summary.json").read_text())["known_map"]
    assert known["name"] == "monday" and known["seen"] > 3
    assert (folder / "known_map.npz").exists()
    again = ("batch", "logs", "-o", "out", *at, "--json")
    assert json.loads(call(*again).out)["counts"]["done_now"] == 0
    # the map made anew under the same name: all that is made in it must be, too
    moved = ("--force", "--start", "robot=1,0,0")
    assert call("smooth", "monday.mcap", "-o", "monday", *moved).code == 0
    assert json.loads(call(*again).out)["counts"]["done_now"] == 1
    anew = json.loads((folder / "summary.json").read_text())["known_map"]
    assert anew["sha256"] != known["sha256"]
    stale = LogTask("x", "logs/tuesday.mcap", str(tmp_path / "out"), load_config(None, at[1:2]))
    with pytest.raises(OutputError, match="monday: has changed since the batch began"):
        work_on_log(stale)
    wrong = call("batch", "logs", "-o", "other", "--set", "known_map.directory=nowhere")
    check_one_line(wrong)
    assert "nowhere" in wrong.err and not Path("other").exists()


def test_the_page_has_a_line_and_a_map_of_every_log_and_no_path_of_the_machine(fleet):
    page = (fleet.out / "report.html").read_text()
    assert len(re.findall(r"<tr data-is=", page)) == 4
    assert page.count("<svg") == 3
    assert 'href="results/b-day/report.html"' in page
    assert "not an MCAP file" in page
    assert str(fleet.logs) not in page


def test_what_is_done_is_not_done_again(fleet, tmp_path, monkeypatch):
    """Nor is what failed, without --retry; what was touched is looked at, and smoothed only if its
    content is new; other settings are another job."""
    out = copy_of(fleet, tmp_path)
    asked = []

    def none(tasks, *_others):
        asked.append([task.label for task in tasks])
        return iter(())

    with monkeypatch.context() as patch:
        patch.setattr(batch_module, "run_tasks", none)
        assert call("batch", fleet.logs, "-o", out, "--quiet").code == 1
        call("batch", fleet.logs, "-o", out, "--quiet", "--retry")
        call("batch", fleet.logs, "-o", out, "--quiet", "--set", "keyframe.distance_m=0.4")
        os.utime(fleet.logs / "a.mcap", (1, 1))
        call("batch", fleet.logs, "-o", out, "--quiet")
        call("batch", fleet.logs, "-o", out, "--quiet", "--force")
    assert asked[:2] == [[], ["broken"]]
    assert sorted(asked[2]) == sorted(asked[4]) == ["a", "b-day", "broken", "c"]
    assert asked[3] == ["a"]
    task = LogTask("a", str(fleet.logs / "a.mcap"), str(out), load_config())
    before = (out / "results/a/summary.json").stat().st_mtime_ns
    row = work_on_log(task)
    assert row == read_row(task.target) and row["files"][0]["mtime_ns"] == 10**9
    assert (out / "results/a/summary.json").stat().st_mtime_ns == before
    drive(tmp_path / "a.mcap", seconds=SHORT_S + 2)
    other = LogTask("a", str(tmp_path / "a.mcap"), str(out), load_config())
    assert work_on_log(other)["length_m"] > row["length_m"] + 0.5
    assert not list((out / ".unfinished").iterdir())


def test_ctrl_c_keeps_what_is_done_and_tells_what_waits(fleet, tmp_path, monkeypatch):
    def interrupted(tasks, *_others):
        by_label = {task.label: task for task in tasks}
        yield Outcome(by_label["c"], by_label["c"].function(*by_label["c"].arguments))
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(batch_module, "run_tasks", interrupted)
        done = call("batch", fleet.logs, "-o", tmp_path / "out")
    assert (done.code, done.out) == (130, "")
    found = json.loads((tmp_path / "out/overview.json").read_text())
    counts = found["counts"]
    assert (counts["done"], counts["failed"], counts["waiting"]) == (1, 0, 3)
    assert {row["name"] for row in found["logs"] if row["status"] == "waiting"} == {
        "a", "b-day", "broken",
    }  # fmt: skip
    page = (tmp_path / "out/report.html").read_text()
    assert "1 of 4 logs" in page and "3 waiting" in page
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["overview.json", "report.html", "results"]


def test_a_limit_of_the_settings_holds_for_each_log(fleet, tmp_path, monkeypatch):
    # 4.3 GB; the limit leaves this process, and threads of who runs the tests, what they have
    monkeypatch.setattr(log_results, "smooth", lambda *_, **_known: bytearray(1 << 32))
    config = load_config(None, ["limits.memory_mb=3000"])
    task = LogTask("a", str(fleet.logs / "a.mcap"), str(tmp_path), config)
    with pytest.raises(LogError, match="more memory than limits"):
        work_on_log(task)
    assert not list(tmp_path.rglob("*.*"))


def test_a_log_that_fails_takes_the_place_of_its_earlier_result(fleet, tmp_path):
    """Else the folder would show a result of what is not there any more."""
    out = copy_of(fleet, tmp_path)
    task = LogTask("a", str(fleet.logs / "a.mcap"), str(out), load_config())
    row = failed_row(task, f"{task.path}: is gone")
    assert row["error"] == "is gone" and row["status"] == "failed"
    assert [path.name for path in task.target.iterdir()] == ["row.json"]


def test_a_folder_of_something_else_or_of_another_process_is_left_alone(fleet, tmp_path):
    (tmp_path / "mine.txt").write_text("x")
    said = check_one_line(call("batch", fleet.logs, "-o", tmp_path))
    assert "not the folder of such a batch" in said
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
    out = copy_of(fleet, tmp_path)
    (out / ".lock").write_text(f"{socket.gethostname()} 1\n")
    assert "process 1 works on it" in check_one_line(call("batch", fleet.logs, "-o", out))
    (out / ".lock").write_text(f"{socket.gethostname()} {2**22 + 1}\n")  # of a process that died
    assert call("batch", fleet.logs, "-o", out, "--quiet").code == 1
    assert not (out / ".lock").exists()


def test_wrong_usage(fleet, tmp_path, monkeypatch):
    cluster = ("batch", fleet.logs, "-o", tmp_path / "x", "--scheduler", "tcp://a:1")
    monkeypatch.setattr(arguments, "find_spec", lambda _name: None)
    missing = call(*cluster)
    assert missing.code == 2 and "coop-graphslam[cluster]" in missing.err
    monkeypatch.setattr(arguments, "find_spec", lambda _name: True)
    both = call(*cluster, "--jobs", "1")
    assert both.code == 2 and "not both" in both.err
    assert "no recording" in check_one_line(call("batch", tmp_path, "-o", tmp_path / "x"))
    assert "no such file" in check_one_line(call("batch", tmp_path / "gone", "-o", tmp_path / "x"))


# ------------------------------------------------------------ recordings in folders


def test_recordings_are_found_by_content_and_named_apart(tmp_path):
    """Damaged ones too, by their names; a folder of rosbag2 is one; hidden files and the folder of
    results are passed over."""
    magic = b"\x89MCAP0\r\n"
    for name in ("x/day.mcap", "y/day.mcap", "z/day.mcap", "z/day.bag", "plain", "out/r.mcap"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(magic)
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag/metadata.yaml").write_text("rosbag2_bagfile_information: {}")
    (tmp_path / "bag/bag_0.db3").write_bytes(b"")
    (tmp_path / ".hidden.mcap").write_bytes(magic)
    (tmp_path / "text.md").write_text("x")
    found = find_recordings([tmp_path], without=tmp_path / "out")
    names = ["bag", "plain", "x-day", "y-day", "z-day.bag", "z-day.mcap"]
    assert [name for name, _ in found.recordings] == names
    assert [path.name for path in found.others] == ["text.md"]
    twice = find_recordings([tmp_path / "x", tmp_path / "y/day.mcap", tmp_path / "x/day.mcap"])
    assert [name for name, _ in twice.recordings] == ["x-day.mcap", "y-day.mcap"]
    with pytest.raises(LogError, match="no such file or folder"):
        find_recordings([tmp_path / "gone"])


def test_links_in_circles_do_not_stop_a_search(tmp_path):
    """Each folder is searched once, those elsewhere too."""
    runs, elsewhere = tmp_path / "runs", tmp_path / "elsewhere"
    for path in (runs / "x/day.mcap", elsewhere / "night.mcap"):
        path.parent.mkdir(parents=True)
        path.write_bytes(b"\x89MCAP0\r\n")
    (runs / "notes.md").write_text("x")
    for link, target in (
        ("x/up", runs), ("x/here", runs / "x"), ("itself", runs / "itself"), ("gone", runs / "no"),
        ("more", elsewhere), ("again", elsewhere), ("above", tmp_path),
    ):  # fmt: skip
        (runs / link).symlink_to(target)
    found = find_recordings([runs])
    assert [path.name for _, path in found.recordings] == ["night.mcap", "day.mcap"]
    assert [path.name for path in found.others] == ["notes.md"]


# ------------------------------------------------------------ comparisons


def test_back_ends_are_compared_on_each_log_by_the_same_engine(fleet, tmp_path):
    """Errors as of `compare` on that log alone; a broken one does not stop the rest; a folder of
    results is no place for them."""
    options = ("--backends", "ekf,batch", "--json")
    out = tmp_path / "out"
    done = call("compare", fleet.logs, "--each", "-o", out, "--jobs", "2", *options)
    assert done.code == 1 and "1 of 4 logs failed; broken: " in done.err
    rows = rows_of(json.loads(done.out))
    alone = json.loads(call("compare", fleet.logs / "a.mcap", "-o", tmp_path / "a", *options).out)
    for row in alone["rows"]:
        expected = row["joint"]["final"]["ate_aligned_rmse_m"]
        assert rows["a"]["backends"][row["spec"]]["error_m"] == pytest.approx(expected, rel=1e-9)
    assert rows["c"]["backends"]["ekf"]["error_m"] is None  # a log without truth
    assert rows["c"]["backends"]["ekf"]["difference_m"] > 0
    page = (out / "report.html").read_text()
    assert "Over all logs" in page and page.count("<tr data-is=") == 4
    assert (out / "results/a/compare.json").is_file()
    wrong = call("compare", fleet.logs, "--each", "-o", fleet.out, *options)
    assert "not the folder of such a batch" in check_one_line(wrong)


def test_a_back_end_that_fails_on_a_log_is_said_counted_and_done_again(fleet, tmp_path):
    """As of `compare` on that log alone: what it says, its exit code, and the other back end."""
    options = ("--mode", "associate", "--backends", "batch,ekf+limits.landmarks=3", "--json")
    alone = call("compare", fleet.logs / "a.mcap", "-o", tmp_path / "alone", *options)
    assert alone.code == 1
    line = re.search(r"1 of 2 back ends failed; ekf\+limits\.landmarks=3: .*", alone.err)
    command = ("compare", fleet.logs / "a.mcap", "--each", "-o", tmp_path / "out", *options)
    done = call(*command)
    assert done.code == 1 and f"1 of 1 logs failed; a: {line[0]}" in done.err
    (row,) = json.loads(done.out)["logs"]
    assert row["status"] == "done" and row["error"] == line[0]
    assert row["backends"]["batch"]["error_m"] > 0  # the folder has the other one
    page = (tmp_path / "out/report.html").read_text()
    assert '<tr data-is="failed"' in page and 'href="results/a/report.html"' in page
    for more, done_now in ((), 0), (("--retry",), 1):
        again = call(*command, *more)
        counts = json.loads(again.out)["counts"]
        assert again.code == 1 and (counts["failed"], counts["done"]) == (1, 0)
        assert counts["done_now"] == done_now


def test_workers_are_for_many_logs_and_truth_for_one(fleet, tmp_path):
    log, out = fleet.logs / "a.mcap", tmp_path / "x"
    assert call("compare", log, "-o", out, "--jobs", "2").code == 2
    assert call("compare", log, "-o", out, "--each", "--truth", "t.tum").code == 2
    said = check_one_line(call("compare", log, "-o", out, "--each", "--backends", "ekff"))
    assert "'ekff' is not one of" in said and not out.exists()
