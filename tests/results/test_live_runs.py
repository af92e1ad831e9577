"""The map of an experiment's runs: errors enlarged around the truth, numbers as they are."""

import re

import numpy as np
import pytest
from small_experiment import SMALL

from graphslam.evaluation.monte_carlo_bench import draw_run
from graphslam.evaluation.monte_carlo_campaign import Job, run_job
from graphslam.evaluation.monte_carlo_definition import Definition, Logs, load_definition
from graphslam.evaluation.monte_carlo_paths import MAX_POSITIONS, MAX_RUNS, path_columns, run_maps
from graphslam.results.drawing_elements import Style
from graphslam.results.live_figure import live_html
from graphslam.results.live_runs import (
    RunPath,
    RunsMap,
    caption,
    enlargement,
    live_runs,
    runs_drawing,
    shown_first,
)

WALLS = [np.array([[0.0, -5.0], [20.0, -5.0]]), np.array([[0.0, 5.0], [20.0, 5.0]])]
STYLES = {"good": Style("#4477aa"), "lost": Style("#ee6677")}


def corridor(good_m=0.02, lost_m=4.0, runs=5):
    """Straight drives of 10 m; those of a variant end so far to the left of the truth."""
    truth = np.column_stack([np.linspace(5.0, 15.0, 11), np.zeros(11)])
    time = np.linspace(0.0, 10.0, 11)

    def paths(off_m):
        side = np.column_stack([np.zeros(11), off_m * np.linspace(0.0, 1.0, 11)])
        return [RunPath(run, "robot", time, truth + side, truth) for run in range(runs)]

    return RunsMap(
        "runs-0", "corridor", WALLS, np.empty((0, 2)),
        {"good": paths(good_m), "lost": paths(lost_m)},
    )  # fmt: skip


def test_errors_are_enlarged_by_a_round_factor_until_they_are_seen():
    """90 % quantiles 0.009 and 0.018 m of a map of 21.6 m: at most 4 % of it, 0.86 m."""
    shown = corridor(good_m=0.01, lost_m=0.02)
    assert enlargement(shown) == 50
    assert "of good and lost" in caption(shown) and "50 times as large" in caption(shown)


def test_a_variant_that_is_far_off_neither_shrinks_nor_hides_the_others():
    three = corridor()
    shown = RunsMap(
        three.name, three.title, three.walls, three.points,
        {**three.runs, "fine": three.runs["good"]},
    )  # fmt: skip
    assert enlargement(shown) > 1
    assert shown_first(shown) == ["good", "fine"]
    figure = live_runs(shown, {**STYLES, "fine": Style("#228833")})
    on = {"room": True, "good": True, "lost": False, "fine": True, "the truth": True}
    assert figure.layers == on
    assert "lost" not in caption(shown)


def test_of_many_variants_the_first_and_the_last_are_shown_at_first():
    """More than two hide each other."""
    paths = corridor(0.01).runs["good"]
    shown = RunsMap("runs-0", "", WALLS, np.empty((0, 2)), dict.fromkeys("abcd", paths))
    assert shown_first(shown) == ["a", "d"]
    six = RunsMap("runs-0", "", WALLS, np.empty((0, 2)), dict.fromkeys("abcdef", paths))
    assert shown_first(six) == ["a", "e"]  # the colour of f is nearly that of a
    assert shown_first(RunsMap("runs-0", "", WALLS, np.empty((0, 2)), {"a": paths})) == ["a"]


def test_what_pointing_shows_is_the_error_and_what_is_drawn_is_that_times_the_factor():
    shown = corridor(good_m=0.01, lost_m=0.02)
    factor = enlargement(shown)
    series = live_runs(shown, STYLES).series
    (points,) = (one for one in series if one.glyph == "points" and one.layer == "good")
    np.testing.assert_allclose(points.columns["error"].max(), 1.0)  # cm
    np.testing.assert_allclose(points.columns["y"].max(), factor * 0.01)
    (line,) = (one for one in series if one.glyph == "path" and one.layer == "good")
    assert np.isnan(line.columns["x"]).sum() == 5  # runs are not joined
    assert len(line.columns["time"]) == len(line.columns["x"])


def test_errors_too_large_to_enlarge_are_drawn_to_scale():
    shown = corridor(good_m=3.0, lost_m=3.0)
    assert enlargement(shown) == 1
    assert "to scale" in caption(shown)


def test_the_drawing_names_every_variant_that_it_shows_and_the_truth():
    drawing = runs_drawing(corridor(0.01, 0.02), STYLES)
    assert drawing.startswith("<svg")
    for name in ("good", "lost", "the truth"):
        assert f">{name}</text>" in drawing


def test_names_from_a_definition_cannot_inject_markup():
    shown = corridor()
    evil = "<script>alert(1)</script>"
    named = RunsMap("runs-0", evil, shown.walls, shown.points, {evil: shown.runs["good"]})
    style = {evil: Style("#4477aa")}
    page = live_html(live_runs(named, style)) + runs_drawing(named, style)
    assert "<script>alert" not in page


# ------------------------------------------------------------ rows


def test_a_path_is_thinned_with_both_ends():
    n = 1000
    truth = np.column_stack([np.arange(n), np.zeros(n), np.zeros(n)])
    found = path_columns(np.arange(n) / 10.0, truth + 0.00004, truth)
    assert len(found["time_s"]) == len(found["estimate"]) == len(found["truth"]) == MAX_POSITIONS
    assert (found["time_s"][0], found["time_s"][-1]) == (0.0, 99.9)
    assert found["truth"][-1] == [999.0, 0.0]
    assert found["estimate"][-1] == [999.0, 0.0]  # a tenth of a millimetre is the unit


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A small bench and the rows of four of its runs."""
    path = tmp_path_factory.mktemp("bench") / "small.toml"
    path.write_text(SMALL)
    definition = load_definition(path)
    jobs = [Job("", "", 0.1, variant, run) for run in (0, 1) for variant in definition.variants]
    identity = ("scenario", "front_end", "scale", "variant", "run")
    return definition, [
        {**{key: getattr(job, key) for key in identity}, **run_job(definition, job)} for job in jobs
    ]


def test_the_map_of_a_bench_has_its_room_and_every_run(bench):
    definition, rows = bench
    (found,) = run_maps(definition, rows)
    assert found.title == "All runs"
    assert len(found.walls) == 1 and len(found.points) == 2
    assert {name: len(paths) for name, paths in found.runs.items()} == {
        "dead-reckoning": 4, "batch": 4,
    }  # fmt: skip
    for path in found.runs["batch"]:
        truth = draw_run(definition.bench, 0.1, None).truth[path.robot][1:, :2]
        np.testing.assert_allclose(path.truth[1:], truth, atol=1e-4)  # as planned after the start
        row = next(r for r in rows if (r["variant"], r["run"]) == ("batch", path.run))
        ends = [end[:2] for end in row["end"]]
        assert any(np.allclose(path.estimate[-1], end, atol=1e-4) for end in ends)


def test_rows_without_paths_make_no_map(bench):
    definition, rows = bench
    assert run_maps(definition, [{**row, "paths": None} for row in rows]) == []
    failed = [{key: value for key, value in row.items() if key != "paths"} for row in rows]
    assert run_maps(definition, failed) == []


def test_a_map_shows_a_limited_number_of_runs(bench):
    definition, rows = bench
    many = [{**rows[1], "run": run} for run in range(3 * MAX_RUNS)]
    (found,) = run_maps(definition, many)
    assert len({path.run for path in found.runs["batch"]}) == MAX_RUNS


def test_the_map_of_a_scenario_has_its_world_and_one_whose_file_is_gone_none(bench):
    _, rows = bench
    logs = Logs(scenarios=("forest", "/home/someone/gone.toml"))
    definition = Definition(variants={"batch": ()}, logs=logs)
    row = {**rows[1], "scale": 1.0, "front_end": "segments"}
    forest, gone = run_maps(definition, [{**row, "scenario": name} for name in logs.scenarios])
    assert (forest.title, gone.title) == ("forest", "gone.toml")
    assert len(forest.walls) > 10 and not gone.walls
    rings = [wall for wall in forest.walls if len(wall) == 25]
    assert rings and all(np.allclose(ring[0], ring[-1]) for ring in rings)
    drawing = runs_drawing(gone, {"batch": Style("#4477aa")})
    assert len(re.findall("<path", drawing)) > 1
