"""Back ends side by side: the same numbers as alone, failures that stay in their row, a page."""

import json
import os
import pickle
import re
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import call, check_one_line
from room_log import drive

import graphslam.evaluation.compare_backends
from graphslam.core.config import Config
from graphslam.core.config_io import load_config
from graphslam.core.errors import ConfigError, EstimationError, LogError, OutputError
from graphslam.estimation.backends import BACKENDS
from graphslam.evaluation.compare_backends import compare
from graphslam.evaluation.compare_folder import is_comparison, save_comparison
from graphslam.evaluation.compare_variants import parse_variants
from graphslam.evaluation.ground_truth import truth_of_logs
from graphslam.evaluation.metrics import evaluate
from graphslam.evaluation.recorded_steps import record_steps
from graphslam.evaluation.timed_replay import growth_exponent, timed_replay, timed_replay_in_process
from graphslam.evaluation.trajectory_metrics import pair_poses, path_errors, trajectory_metrics
from graphslam.logs import GroundTruth, LogWriter, open_logs
from graphslam.results.report_comparison import (
    comparison_tables,
    filter_wins,
    reading_notes,
    render_comparison,
)
from graphslam.simulation import load_scenario, simulate
from graphslam.slam.smooth import smooth

START = ["start.from_truth=true"]
SPECS = ["dead-reckoning", "isam2", "batch"]
ACCURACY = ("robots", "joint", "landmarks", "common_frame")


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """Two robots that see each other, walls and a point, with their truth; compared once."""
    path = tmp_path_factory.mktemp("two") / "two.mcap"
    simulate(load_scenario("two-robots"), path, 0)
    config = load_config(None, START)
    log = open_logs([path], config)
    truth = truth_of_logs(log)
    done = compare(
        log, config, parse_variants(SPECS, load_config(None, START)), truth=truth, run=timed_replay
    )
    return SimpleNamespace(path=path, config=config, log=log, truth=truth, done=done)


def rows_of(comparison):
    return {row["spec"]: row for row in comparison.summary["rows"]}


class Broken:
    """A back end that gives up at its tenth step."""

    error_frame = "body"

    def __init__(self, config):
        self._inner, self._left = BACKENDS["isam2"](config), 10

    def __getattr__(self, name):
        return getattr(self._inner, name)

    def add(self, step):
        self._left -= 1
        if not self._left:
            raise EstimationError("indeterminate at <landmark 7>")
        self._inner.add(step)


# ---------------------------------------------------------------- the same numbers as alone


def assert_equal_numbers(one, other):
    """Nested numbers, to 1e-9 of themselves: the same computation, perhaps in another order."""
    assert type(one) is type(other)
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key, value in one.items():
            assert_equal_numbers(value, other[key])
    else:
        exact = other is None or isinstance(other, str | bool)
        assert one == (other if exact else pytest.approx(other, rel=1e-9, abs=1e-12))


@pytest.mark.parametrize(("mode", "backend"), [("replay", "isam2"), ("associate", "batch")])
def test_a_row_is_what_smooth_and_evaluate_say(two, mode, backend):
    """Breaks if states become trajectories or landmarks in another way than in `smooth`: another
    mount, another world, another calibration. Reconsidering is no part of a back end."""
    config = load_config(None, [*START, f"backend.name={backend}", "backend.reoptimise=false"])
    alone = evaluate(
        smooth(open_logs([two.path], config), config), two.truth.trajectories, two.truth.landmarks
    )
    rows = parse_variants([backend], load_config(None, START))
    found = compare(two.log, two.config, rows, mode, truth=two.truth, run=timed_replay)
    assert_equal_numbers({key: found.summary["rows"][0][key] for key in ACCURACY}, alone)


def test_rows_come_in_the_order_asked_with_every_key_of_the_contract(two):
    rows = two.done.summary["rows"]
    assert [row["spec"] for row in rows] == SPECS
    for row in rows:
        assert row["error"] is None
        assert set(ACCURACY) <= row.keys()
        ms = row["ms_per_step"]
        assert 0 < ms["p50"] <= ms["p99"] <= ms["max"] <= 1e3 * row["total_s"]
    assert two.done.summary["mode"] == "replay"
    assert two.done.summary["recorded_by"] == "isam2"


def test_the_reference_is_at_no_distance_from_itself_and_odometry_is_far(two):
    rows = rows_of(two.done)
    assert two.done.summary["reference"] == "batch"
    assert rows["batch"]["difference"]["final"]["max_m"] == 0.0
    assert rows["isam2"]["difference"]["final"]["max_m"] < 1e-6  # the same optimum
    # odometry ends 1.07 m off in this scenario, the smoother some mm
    assert rows["dead-reckoning"]["difference"]["final"]["max_m"] > 0.5
    assert rows["isam2"]["difference"]["causal"]["rmse_m"] > 0


def test_final_is_causal_for_what_never_revises_and_only_there(two):
    """Interpolation between states would let a filter see the next one."""
    rows = rows_of(two.done)
    assert {spec for spec, row in rows.items() if row["final_is_causal"]} == {"dead-reckoning"}
    for robot in rows["dead-reckoning"]["robots"].values():
        assert robot["final"] == robot["causal"]
    assert rows["isam2"]["joint"]["final"] != rows["isam2"]["joint"]["causal"]
    assert any(
        "Final equals causal for dead-reckoning" in text for text in reading_notes(two.done.summary)
    )


def test_filters_name_their_errors_and_do_not_revise(two):
    """With horizon 0 a state still moves until the next one comes, which is not smoothing."""
    specs = ["ekf", "ekf+ekf.error=body", "isam2:0", "isam2"]
    rows = parse_variants(specs, load_config(None, START))
    found = rows_of(compare(two.log, two.config, rows, truth=two.truth, run=timed_replay))
    for spec in specs[:3]:
        assert found[spec]["final_is_causal"]
        assert found[spec]["joint"]["final"] == found[spec]["joint"]["causal"]
    assert not found["isam2"]["final_is_causal"]
    labels = [found[spec]["label"] for spec in specs]
    assert [re.findall("(world|body)-frame errors", label) for label in labels] == [
        *(["world"], ["body"], ["body"]),
        [],
    ]
    assert len(set(labels)) == 4


def test_late_evidence_is_counted(two):
    recording = record_steps(two.log, two.config)
    late = sum(seen.late for step in recording.steps for seen in step.associations)
    assert late > 0
    for row in two.done.summary["rows"]:
        assert (row["late"], row["associations"]) == (late, recording.associations)
        assert row["skipped"] == {}


def test_what_a_filter_could_not_use_is_said(two):
    specs = ["ekf", "ekf+ekf.past_states=0", "isam2"]
    done = compare(
        two.log,
        two.config,
        parse_variants(specs, load_config(None, START)),
        truth=two.truth,
        run=timed_replay,
    )
    found = rows_of(done)
    assert found["ekf"]["skipped"] == found["isam2"]["skipped"] == {}
    assert found[specs[1]]["skipped"] == {"late evidence": found["ekf"]["late"]}
    assert any(f"{specs[1]} could not use" in text for text in reading_notes(done.summary))
    page = render_comparison(done)
    # one of both is there: what a filter is better in, or that it is not
    assert ("Where a filter is ahead" in page) is bool(filter_wins(done.summary))
    assert ("No filter is ahead" in page) is not bool(filter_wins(done.summary))


# ---------------------------------------------------------------- a process of its own


def test_a_process_of_its_own_comes_to_the_same(two):
    steps = record_steps(two.log, two.config).steps
    here, there = timed_replay(steps, two.config), timed_replay_in_process(steps, two.config)
    for name, path in here.replay.estimate.states.items():
        assert np.array_equal(path.poses, there.replay.estimate.states[name].poses)
        assert np.array_equal(here.replay.causal[name].covs, there.replay.causal[name].covs)


def test_its_memory_is_not_that_of_its_parent(two):
    """ru_maxrss of a child starts at its parent's size; a back end needs a fraction of this."""
    ballast = np.ones(75_000_000)  # 600 MB
    steps = record_steps(two.log, two.config).steps[:5]
    played = timed_replay_in_process(steps, two.config)
    assert 0 <= played.before_mb <= played.peak_mb < ballast.nbytes / 1e6


class Deadly:
    """Ends the process that unpickles it, as a crash in a library would."""

    def __reduce__(self):
        return os._exit, (1,)


def test_a_process_that_dies_is_an_error_of_its_row(monkeypatch, two):
    with pytest.raises(EstimationError, match="its process died"):
        timed_replay_in_process([Deadly()], Config())


# ---------------------------------------------------------------- specs


def test_specs_say_back_end_horizon_and_settings():
    found = parse_variants(["isam2", "isam2:0", "isam2:2.5+robust.kernel=none", "batch"])
    assert [v.config.backend.name for v in found] == ["isam2", "isam2", "isam2", "batch"]
    assert [v.config.backend.horizon_s for v in found] == [np.inf, 0.0, 2.5, np.inf]
    assert found[2].config.robust.kernel == "none"
    assert len({v.label for v in found}) == 4
    assert "horizon 2.5 s" in found[2].label and "robust.kernel=none" in found[2].label


@pytest.mark.parametrize(
    ("specs", "what"),
    [
        ([], "names no back end"),
        (["isam3"], "'isam3' is not one of batch"),
        ([""], "'' is not one of"),
        (["batch:5"], "only isam2 has a horizon"),
        (["isam2:"], "isam2:: backend.horizon_s"),
        (["isam2:-1"], "must not be negative"),
        (["isam2:soon"], "expected float"),
        (["isam2+robust"], "write it as key=value"),
        (["isam2+robust.kernal=none"], "did you mean kernel"),
        (["isam2", "batch", "isam2:inf"], "isam2:inf is given twice"),
    ],
)
def test_wrong_specs_are_named(specs, what):
    with pytest.raises(ConfigError, match=re.escape(what)):
        parse_variants(specs)


def test_what_the_recording_follows_from_is_the_same_for_all_in_replay(two):
    """A row with its own keyframes would silently be given the recorded ones."""
    rows = parse_variants(["isam2+keyframe.distance_m=0.5"], load_config(None, START))
    with pytest.raises(ConfigError, match=r"keyframe\.\* belongs to the recording"):
        compare(two.log, two.config, rows, run=timed_replay)
    found = compare(two.log, two.config, rows, "associate", run=timed_replay).summary["rows"][0]
    assert found["states"] < rows_of(two.done)["isam2"]["states"]


def test_a_known_map_is_refused(two):
    """Rows would silently be of a map of their own."""
    config = load_config(None, ["known_map.directory=there", *START])
    with pytest.raises(ConfigError, match=r"known_map\.directory"):
        compare(two.log, config, parse_variants(["isam2"], config), run=timed_replay)


def test_the_settings_survive_the_way_to_another_process():
    """Tables with names are read-only mappings, which have no pickle of their own."""
    config = load_config(None, ["robots.a.axle_m=0.3", "start.poses.a=[1,2,3]", *START])
    assert pickle.loads(pickle.dumps(config)) == config


# ---------------------------------------------------------------- what goes wrong


@pytest.fixture
def broken(monkeypatch):
    monkeypatch.setitem(BACKENDS, "batch", Broken)
    # in this process: another one would not know the broken back end
    monkeypatch.setattr(
        graphslam.evaluation.compare_backends, "compare", partial(compare, run=timed_replay)
    )


def test_a_back_end_that_fails_has_its_error_in_its_row(two, broken):
    rows = parse_variants(["isam2", "batch", "dead-reckoning"], load_config(None, START))
    done = compare(two.log, two.config, rows, truth=two.truth, run=timed_replay)
    found = rows_of(done)
    assert found["batch"]["error"] == "indeterminate at <landmark 7>"
    assert found["isam2"]["error"] is None and found["dead-reckoning"]["error"] is None
    assert done.summary["reference"] == "isam2"
    page = render_comparison(done)
    assert "failed: indeterminate at &lt;landmark 7&gt;" in page
    for _, cells in comparison_tables(done.summary).values():
        assert [bool(row) for row in cells] == [True, False, True]


def test_landmarks_that_the_recording_deleted_are_in_no_map(tmp_path):
    """A smoother keeps what a filter may drop; both have the map of the recording, which holds the
    same landmarks whoever estimates them."""
    drive(tmp_path / "log.mcap", seconds=20)
    settings = [*START, "association.delete_s=3"]
    log = open_logs([tmp_path / "log.mcap"], load_config(None, settings))
    recorded = record_steps(log, load_config(None, settings))
    assert any(step.deleted for step in recorded.steps)
    rows = parse_variants(["ekf", "batch", "isam2"], load_config(None, settings))
    found = rows_of(compare(log, load_config(None, settings), rows, run=timed_replay))
    for row in found.values():
        assert row["error"] is None
        assert row["map_landmarks"] == sum(e.in_graph for e in recorded.landmarks.entries.values())
    alone = compare(log, load_config(None, settings), rows[1:2], "associate", run=timed_replay)
    assert alone.summary["rows"][0]["map_landmarks"] > 0


class Defective(Broken):
    """A back end with a defect: an error that nobody raises on purpose."""

    def add(self, step):
        try:
            super().add(step)
        except EstimationError:
            raise KeyError(6) from None


def test_a_defect_of_one_back_end_is_no_loss_of_the_others(two, monkeypatch):
    """A comparison may have run for an hour by then; a comparison of nothing else ends with it."""
    monkeypatch.setitem(BACKENDS, "batch", Defective)
    rows = parse_variants(["isam2", "batch"], load_config(None, START))
    found = rows_of(compare(two.log, two.config, rows, truth=two.truth, run=timed_replay))
    assert found["isam2"]["error"] is None
    assert found["batch"]["error"] == "unexpected KeyError: 6; this is a defect of graphslam"
    with pytest.raises(EstimationError, match="batch: unexpected KeyError") as raised:
        compare(two.log, two.config, rows[1:], run=timed_replay)
    assert isinstance(raised.value.__cause__, KeyError)  # --debug shows where


def test_nothing_is_left_where_every_back_end_fails(two, broken):
    with pytest.raises(EstimationError, match="every back end failed; batch: indeterminate"):
        compare(
            two.log,
            two.config,
            parse_variants(["batch"], load_config(None, START)),
            run=timed_replay,
        )


def test_the_command_tells_of_a_failure_at_the_end(two, broken, tmp_path):
    out = tmp_path / "out"
    command = ("compare", two.path, "--backends", "isam2,batch", "--start", "truth", "-o", out)
    done = call(*command, "--json")
    assert done.code == 1
    assert re.fullmatch(r"graphslam: error: 1 of 2 back ends failed; batch: [^\n]+\n", done.err)
    assert [row["error"] is None for row in json.loads(done.out)["rows"]] == [True, False]
    assert is_comparison(out)


def test_truth_of_another_robot_is_refused_before_the_work(two):
    truth = GroundTruth({"elsewhere": two.truth.trajectories["vehicle"]}, ())
    with pytest.raises(OutputError, match=r"truth is of elsewhere, the log of pioneer, vehicle"):
        compare(two.log, two.config, (), truth=truth, run=pytest.fail)


def test_truth_of_another_time_is_told_and_the_rest_goes_on(two):
    later = {
        name: replace(path, stamps_ns=path.stamps_ns + 10**15)
        for name, path in two.truth.trajectories.items()
    }
    rows = parse_variants(["isam2", "batch"], load_config(None, START))
    found = compare(
        two.log, two.config, rows, truth=GroundTruth(later, ()), run=timed_replay
    ).summary
    assert [text for text in found["warnings"] if text.startswith("not evaluated: no pose of")]
    assert "robots" not in found["rows"][0]
    assert found["rows"][0]["difference"]["final"] is not None


def still_log(path, value):
    with LogWriter(path) as log:
        for k in range(20):
            log.odometry("robot", k * 10**8 + 1, np.full(3, value))
    return open_logs([path], Config())


def test_a_log_without_a_step(tmp_path):
    log = still_log(tmp_path / "nan.mcap", np.nan)
    with pytest.raises(LogError, match="nothing in it could be used"):
        compare(log, Config(), parse_variants(["isam2"]), run=timed_replay)


def test_a_robot_that_never_moves_is_compared_all_the_same(tmp_path):
    """One state, no landmark, no path: nothing to divide by."""
    log = still_log(tmp_path / "still.mcap", 0.0)
    done = compare(log, Config(), parse_variants(["isam2", "dead-reckoning"]), run=timed_replay)
    for row in done.summary["rows"]:
        assert row["states"] == 1
        assert row["growth_exponent"] == {"landmarks": None, "path": None}
    assert "<svg" in render_comparison(done)


def test_an_unknown_mode(two):
    with pytest.raises(ConfigError, match="--mode guess"):
        compare(two.log, two.config, parse_variants(["isam2"]), "guess", run=timed_replay)


# ---------------------------------------------------------------- growth and the best


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.0])
def test_growth_finds_the_power_of_a_noisy_cost(exponent):
    rng = np.random.default_rng(1)
    size = np.linspace(1, 100, 2000)
    ms = 0.1 * size**exponent * rng.lognormal(0, 0.5, len(size))
    ms[::50] *= 100  # a garbage collection now and then
    # a median of 100 values of spread 0.5 is known to 6 %; 20 of them over a factor of 100 give
    # the slope to 0.02
    assert growth_exponent(size, ms) == pytest.approx(exponent, abs=0.08)


def test_growth_says_nothing_where_nothing_grows():
    assert growth_exponent(np.full(1000, 7.0), np.ones(1000)) is None
    assert growth_exponent(np.linspace(10, 19, 1000), np.ones(1000)) is None
    assert growth_exponent(np.arange(1.0, 40), np.ones(39)) is None
    assert growth_exponent(np.zeros(0), np.zeros(0)) is None


def marked(**columns):
    """Marks of the final table whose rows have these values."""
    count = len(next(iter(columns.values())))
    rows = [
        {
            "error": None,
            "joint": {"final": {name: values[i] for name, values in columns.items()}},
        }
        for i in range(count)
    ]
    heads, cells = comparison_tables({"rows": rows, "mode": "replay", "reference": "batch"})[
        "Final trajectory, from all data"
    ]
    return {head: [row[i][1] for row in cells] for i, head in enumerate(heads)}


def test_the_best_is_marked_whoever_it_is():
    """Errors: the smallest, all that print the same; NEES: the nearest to 1 as a ratio; coverage:
    the nearest to 95 %; nobody where all are equal or only one has a value."""
    found = marked(
        ate_rmse_m=[0.10004, 0.10001, 0.2],
        max_m=[0.3, 0.3, 0.3],
        heading_rmse_rad=[0.1, None, None],
        nees_per_dof=[0.5, 1.6, 4.0],
        coverage=[1.0, 0.96, 0.5],
    )
    assert found["ATE, m"] == [True, True, False]
    assert found["max, m"] == [False, False, False]
    assert found["heading, °"] == [False, False, False]
    assert found["NEES/dof"] == [False, True, False]
    assert found["coverage, %"] == [False, True, False]


def judged(spec, nees, rmse_m, p50, causal, error=None):
    """A row of compare.json with three numbers."""
    return {
        "spec": spec, "label": spec.upper(), "error": error, "final_is_causal": causal,
        "joint": {"final": {"ate_rmse_m": 0.0}, "causal": {"nees_per_dof": nees}},
        "landmarks": {"rmse_m": rmse_m}, "ms_per_step": {"p50": p50},
    }  # fmt: skip


def test_where_a_filter_is_ahead_is_said_and_where_it_is_not():
    """Of every smoother, by the column's own measure, to the digits shown; dead reckoning is no
    filter, what failed is nobody, and a filter's final trajectory, which is its causal one, does
    not win over another's final one."""
    rows = [
        judged("isam2", nees=0.5, rmse_m=0.01, p50=5.0, causal=False),
        judged("batch", nees=0.4, rmse_m=0.02, p50=3.0, causal=False),
        judged("ekf", nees=1.5, rmse_m=0.0099999, p50=3.5, causal=True),
        judged("isam2:0", nees=1.7, rmse_m=0.03, p50=2.0, causal=True),
        judged("dead-reckoning", nees=1.0, rmse_m=0.001, p50=0.1, causal=True),
        {"spec": "ekf+x=1", "label": "EKF, x=1", "error": "indeterminate"},
    ]
    assert filter_wins({"rows": rows}) == [
        ("causal: NEES/dof", "EKF", 1.5, "ISAM2", 0.5),
        ("cost: ms/step p50", "ISAM2:0", 2.0, "BATCH", 3.0),
    ]
    assert filter_wins({"rows": rows[:2]}) == filter_wins({"rows": rows[2:]}) == []


# ---------------------------------------------------------------- the page and the folder


def test_the_page_is_one_file_with_every_table_and_figure(two):
    page = render_comparison(two.done, "[backend]\n")
    assert page == render_comparison(two.done, "[backend]\n")
    shown = re.sub(r"<script[^>]*>.*?</script>", "", page, flags=re.DOTALL)
    assert not re.search(r'(?:src|href)="(?!#|data:)', shown)
    for row in two.done.summary["rows"]:
        assert row["label"] in page
    for title in comparison_tables(two.done.summary):
        assert title in page
    assert "ahead of every smoother" not in page  # odometry is no filter
    assert "a comparison of estimation alone" in page
    labels = re.findall(r'<svg[^>]* aria-label="([^"]+)"', page)
    assert len(labels) == len(set(labels)) == 9  # paths, errors, NEES twice each; three of cost


def test_without_truth_rows_are_compared_with_each_other(two):
    rows = parse_variants(["dead-reckoning", "isam2"], load_config(None, START))
    done = compare(two.log, two.config, rows, run=timed_replay)
    found = rows_of(done)
    assert not set(ACCURACY) & found["isam2"].keys()
    assert done.summary["reference"] == "isam2"  # a smoother is nearer to the truth than odometry
    assert found["dead-reckoning"]["difference"]["final"]["rmse_m"] > 0.1
    titles = [title.split()[0] for title in comparison_tables(done.summary)]
    assert titles == ["What", "Distance", "Cost"]
    page = render_comparison(done)
    assert "Distance to isam2" in page and "NEES" not in page


def test_without_a_start_what_is_drawn_is_aligned(tmp_path):
    """The world then has its origin at the first pose, metres from where the truth has it."""
    log = open_logs([drive(tmp_path / "room.mcap", seconds=8)], Config())
    truth = truth_of_logs(log)
    done = compare(log, Config(), parse_variants(["isam2"]), truth=truth, run=timed_replay)
    assert not done.summary["rows"][0]["common_frame"]
    assert done.summary["rows"][0]["joint"]["final"]["ate_rmse_m"] is None
    assert done.summary["rows"][0]["joint"]["final"]["nees_per_dof"] is None
    assert any("no world frame in common" in text for text in reading_notes(done.summary))
    assert any("start was not given" in text for text in done.summary["warnings"])
    (curve,) = done.backends[0].curves["final"].values()
    assert np.sqrt(np.mean(curve.position_m**2)) == pytest.approx(
        done.summary["rows"][0]["joint"]["final"]["ate_aligned_rmse_m"]
    )
    # an offset of the frame is no error of the estimate: turned back, heading is within 2 degrees
    assert curve.heading_rad.max() < np.radians(2)
    assert np.isnan(curve.nees).all()
    (path,) = done.backends[0].paths["final"].values()
    assert np.hypot(*(path.poses[0, :2] - done.truth["robot"][0])) < 0.1
    page = render_comparison(done)
    assert "aligned with the truth" in page and "Consistency" not in page


def test_the_folder_is_whole_and_only_another_comparison_is_replaced(two, tmp_path):
    out = tmp_path / "out"
    save_comparison(two.done, two.config, out, force=False)
    assert {p.name for p in out.iterdir()} == {"compare.json", "config.toml", "report.html"}
    assert json.loads((out / "compare.json").read_text()) == two.done.summary
    assert load_config(out / "config.toml") == two.config
    with pytest.raises(OutputError, match="already exists; give --force"):
        save_comparison(two.done, two.config, out, force=False)
    save_comparison(two.done, two.config, out, force=True)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    with pytest.raises(OutputError, match="not replaced"):
        save_comparison(two.done, two.config, tmp_path / "mine", force=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine", "out"]


# ---------------------------------------------------------------- the command


@pytest.fixture
def here(monkeypatch):
    monkeypatch.setattr(
        graphslam.evaluation.compare_backends, "compare", partial(compare, run=timed_replay)
    )


def test_the_command_prints_what_it_wrote(two, here, tmp_path):
    out = tmp_path / "out"
    command = ("compare", two.path, "--backends", "isam2,batch", "-o", out, "--start", "truth")
    done = call(*command, "--json")
    assert done.code == 0, done.err
    assert done.err == ""
    assert json.loads(done.out) == json.loads((out / "compare.json").read_text())
    plain = call(*command, "--mode", "associate", "--force")
    assert plain.code == 0, plain.err
    for text in ("its own data association", "Final trajectory", "ms/step", "Associations of"):
        assert text in plain.out


@pytest.mark.parametrize(
    ("options", "what"),
    [
        (("--backends", "isam9"), "'isam9' is not one of"),
        (("--backends", "isam2", "--truth", "nobody.tum"), "of which robot is it"),
        (("--backends", "isam2", "--config", "missing.toml"), "missing.toml"),
    ],
)
def test_wrong_arguments_in_one_line(two, here, tmp_path, options, what):
    done = call("compare", two.path, "-o", tmp_path / "out", *options)
    assert what in check_one_line(done)
    assert not (tmp_path / "out").exists()


def test_an_unknown_mode_is_wrong_usage(two, tmp_path):
    done = call("compare", two.path, "-o", tmp_path / "out", "--mode", "guess")
    assert done.code == 2
    assert "replay, associate" in done.err


def test_dead_reckoning_is_of_odometry_as_recorded(tmp_path):
    """Odometry that turns by 0.02 rad a metre: what other back ends learn of it, or scans correct,
    is not its merit."""
    path = drive(tmp_path / "room.mcap")
    config = load_config(None, START)
    log = open_logs([path], config)
    truth = truth_of_logs(log)
    done = compare(
        log, config, parse_variants(["dead-reckoning", "batch"], config), truth=truth,
        run=timed_replay,
    )  # fmt: skip
    (own,) = smooth(log, config).robots.values()
    recorded = trajectory_metrics(
        [path_errors(pair_poses(own.dead_reckoning, truth.trajectories["robot"]))]
    )
    found = rows_of(done)["dead-reckoning"]["joint"]["final"]
    assert found["ate_aligned_rmse_m"] == pytest.approx(recorded["ate_aligned_rmse_m"], rel=0.02)
    assert found["rpe"]["10_m"]["rot_rmse_rad"] == pytest.approx(0.2, rel=0.3)
