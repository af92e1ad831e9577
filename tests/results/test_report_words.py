"""What people read in a report: lengths, durations, counts; nothing of the writer's machine."""

import dataclasses
import re

import numpy as np
import pytest
from synthetic_results import room

from graphslam.core.geometry import area_centroid
from graphslam.results.drawing import legend
from graphslam.results.drawing_elements import UNIT, Style
from graphslam.results.report import render
from graphslam.results.report_figure import Drawing
from graphslam.results.report_html import counted, duration, length, table, without_folders

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


def test_a_report_tells_nothing_of_the_machine_that_wrote_it():
    result, _ = room(keyframes=20, beams=31)
    path = "/home/someone/secret/run.mcap"
    log = {**result.summary["logs"][0], "path": path} if result.summary.get("logs") else {}
    log = {"messages": 1, "lost": 0, "sha256": "ab" * 32, **log, "path": path}
    summary = {**result.summary, "logs": [log], "warnings": [f"{path}: /scan: late"]}
    html = render(dataclasses.replace(result, summary=summary))
    assert "secret" not in html
    assert "run.mcap: /scan: late" in html
    assert log["sha256"] in html


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
