# ruff: noqa: RUF001 -- σ is meant: people read it
"""What people read in a report: lengths, durations, counts; nothing of the writer's machine."""

import dataclasses
import re

import numpy as np
import pytest
from synthetic_results import room

from graphslam.core.geometry import area_centroid
from graphslam.evaluation.monte_carlo_definition import Definition, Logs
from graphslam.evaluation.monte_carlo_summary import summarise
from graphslam.results.drawing import legend
from graphslam.results.drawing_elements import UNIT, Style
from graphslam.results.report import render
from graphslam.results.report_comparison import (
    BackendCurves,
    Comparison,
    TimedPath,
    render_comparison,
)
from graphslam.results.report_experiment import experiment_page
from graphslam.results.report_figure import Drawing
from graphslam.results.report_html import (
    counted,
    duration,
    length,
    table,
    warning_box,
    without_folders,
)
from graphslam.results.report_tables import calibration
from graphslam.slam.summary import noise_warnings

SQUARE = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]])


def test_the_centroid_is_that_of_the_area_not_of_its_corners():
    divided = np.array([[0.0, 0.0], [0.5, 0.0], [0.7, 0.0], [1.9, 0.0], *SQUARE[1:]])
    for polygon in (SQUARE, divided, divided[::-1]):
        np.testing.assert_allclose(area_centroid(polygon + 1e6), [1e6 + 1.0, 1e6 + 0.5], atol=1e-9)


def test_without_area_the_centroid_is_the_mean_of_the_corners():
    np.testing.assert_allclose(area_centroid(np.array([[0.0, 0.0], [2.0, 2.0]])), [1.0, 1.0])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (length(0.052), "5.2 cm"),
        (length(1.3749), "1.37 m"),
        (length(0.9999), "1.000 m"),
        (counted(1, "keyframe"), "1 keyframe"),
        (counted(0, "scan"), "0 scans"),
        (duration(888.0), "888 s"),
        (duration(2691.0), "44.9 min"),
        (without_folders("/data/a/run.mcap: late", ["/data/a/run.mcap"]), "run.mcap: late"),
    ],
)
def test_numbers_are_written_for_reading(text, expected):
    assert text == expected


#: a log or a scenario on the writer's machine
PATH = "/home/someone/secret/run.mcap"


def of_a_result():
    result, _ = room(keyframes=20, beams=31)
    log = {"messages": 1, "lost": 1, "sha256": "ab" * 32, "path": PATH}
    reason = {"level": "doubtful", "kind": "lost", "where": PATH, "text": f"{PATH}: 1 lost"}
    summary = {
        **result.summary,
        "logs": [log],
        "warnings": [f"{PATH}: /scan: late"],
        "verdict": {"verdict": "doubtful", "reasons": [reason]},
    }
    html = render(dataclasses.replace(result, summary=summary))
    assert log["sha256"] in html
    return html


def of_a_comparison():
    done = {
        "spec": "ekf", "label": "EKF", "error": None, "final_is_causal": True, "steps": 3,
        "associations": 2, "late": 0, "skipped": {}, "ms_per_step": {"p50": 1.0},
    }  # fmt: skip
    failed = {"spec": "batch", "label": "batch", "error": f"{PATH}: 1 lost"}
    summary = {
        "mode": "replay", "recorded_by": "isam2", "reference": "ekf", "rows": [done, failed],
        "logs": [{"path": PATH, "sha256": "ab" * 32}], "warnings": [f"{PATH}: /scan: late"],
    }  # fmt: skip
    path, three = {"robot": TimedPath(np.arange(3), np.eye(3))}, np.ones(3)
    curves = BackendCurves(
        "ekf", "EKF", {"final": path, "causal": path}, {"final": {}, "causal": {}},
        three, three, three,
    )  # fmt: skip
    return render_comparison(Comparison(summary, (curves,), {}))


def of_an_experiment():
    row = {"scenario": PATH, "front_end": "none", "scale": 1.0, "variant": "v", "code": "c"}
    definition = Definition(variants={"v": ()}, runs=2, logs=Logs((PATH,)), name="mine")
    errors = (f"ScenarioError: {PATH}: 1 lost", f"LogError: {PATH}: /scan: late")
    return experiment_page(summarise(definition, [{**row, "error": text} for text in errors]))


@pytest.mark.parametrize("page", [of_a_result, of_a_comparison, of_an_experiment])
def test_a_report_tells_nothing_of_the_machine_that_wrote_it(page):
    """Neither in titles and tables nor in what warnings, reasons and failures say."""
    html = page()
    assert "secret" not in html
    assert "run.mcap: /scan: late" in html
    assert "run.mcap: 1 lost" in html


def test_cells_of_a_wide_table_say_on_a_phone_what_they_are():
    wide = table(["a", "b", "c", "d", "e"], [(1, 2, 3, 4, 5)])
    assert "class=wide" in wide
    assert '<td data-label="e">5</td>' in wide
    assert "data-label" not in table(["a", "b"], [(1, 2)])


def test_a_legend_of_many_rows_stays_within_its_drawing():
    drawing = Drawing("many names", 2.0)
    axes = drawing.axes(0.5, 0.4, 0.1, 0.3)
    for i in range(12):
        axes.line([0, 1], [0, i], Style("#4477aa"), f"a back end of a long name, number {i}")
    svg = drawing.to_svg()
    top = int(re.search(r'viewBox="0 (-?\d+)', svg).group(1))
    rows = [
        int(y)
        for y, name in re.findall(r'<text x="\d+" y="(-?\d+)"[^>]*>([^<]+)', svg)
        if "long" in name
    ]
    assert len(rows) == 12
    assert min(rows) - 8 * UNIT >= top  # a letter is eight points high


def test_the_sample_of_a_dashed_line_ends_with_a_whole_dash():
    style = Style("#4477aa", 1.1, dashes=(5, 1.5))
    (sample, _) = legend([("name", style)], 0, 3000, 100)
    long = int(re.search(r"h(\d+)", sample).group(1)) / (UNIT * style.width)
    assert long % 6.5 == pytest.approx(5.0, abs=0.1)


def test_a_factor_on_a_variance_is_read_without_an_exponent():
    noise = {
        "robot 1 point": {"measured": {"bearings": 1 / 2213.0, "ranges": 0.9}},
        "robot 1 motion": {"measured": {"turning": 8.17}},
    }
    assert noise_warnings(noise) == [
        "robot 1: the variance of bearings of points is 1/2200 of what is stated",
        "robot 1: the variance of turning is 8.2 times what is stated",
    ]


def test_a_long_list_of_warnings_is_folded_and_none_is_lost():
    short, long = (warning_box(f"number {k}." for k in range(n)) for n in (8, 20))
    assert "<details>" not in short
    assert long.index("number 5.") < long.index("<details>") < long.index("number 6.")
    assert "14 more" in long and all(f"number {k}." in long for k in range(20))
    assert warning_box([]) == ""


def test_calibration_of_a_fleet_has_a_column_for_each_robot_and_units():
    def of(robot):
        value = {"value": 0.0275, "sigma": 0.0118, "observable": True}
        fixed = {"value": 0.0, "sigma": 0.0, "observable": False}
        return {f"{robot}.drift_rad_per_m": value, f"{robot}.laser_x_m": fixed}

    both = calibration({"calibration": of("a.b") | of("c")}, ["a.b", "c"])
    assert re.findall(r'scope="col">([^<]*)', both) == ["parameter", "a.b", "c"]
    assert "drift, rad/m" in both and both.count("0.0275 ± 0.0118") == 2
    assert "Fixed: laser x, m." in both
    assert "value ± σ</th>" in calibration({"calibration": of("a.b")}, ["a.b"])
    assert calibration({}, ["a"]) == ""
