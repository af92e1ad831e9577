"""Maps of changes and charts of comparisons and experiments in a real browser."""

import numpy as np
import pytest

from graphslam.results import report_html
from graphslam.results.drawing_elements import Style
from graphslam.results.live_charts import Curve, live_chart
from graphslam.results.live_figure import live_html
from graphslam.results.live_runs import RunPath, RunsMap, live_runs
from graphslam.results.report_changes import ChangeMark, ChangesPicture, changes_page
from graphslam.results.report_comparison import (
    BackendCurves,
    Comparison,
    ErrorCurve,
    TimedPath,
    render_comparison,
)

pytestmark = pytest.mark.browser


def changed_room():
    """A chest of drawers that moved by a metre in an empty room."""
    rng = np.random.default_rng(1)
    wall = np.column_stack([rng.uniform(-5, 5, 4000), np.full(4000, 4.0)])
    chest = np.array([[2.0, 1.0], [3.0, 1.0], [3.0, 2.0], [2.0, 2.0]])
    moved = ChangeMark(
        "moved", chest, chest - [1.0, 0.0], np.array([1.0, 0.0, 0.1]), np.full(3, 0.01), 0.997,
        321, 4.0,
    )  # fmt: skip
    new = ChangeMark("appeared", chest - [5.0, 3.0], None, None, None, 0.98, 45, 9.0)
    return ChangesPicture(
        ("morning", "evening"), wall, wall - np.array([0.0, 0.5]), np.zeros((10, 10), dtype=bool),
        np.array([[-6.0, 6.0], [-4.0, 5.0]]), (moved, new), rng.normal(size=500), 1.0,
        {"changes": "2"}, "",
    )  # fmt: skip


@pytest.mark.parametrize("width", [1280, 390])
def test_a_change_is_named_where_one_points_and_visits_are_swiped(width, open_page):
    opened = open_page(changes_page(changed_room()), width)
    box = opened.live("changes")
    counted = (
        "(() => { const [im] = live.picture.data.image; const found = {};"
        " for (const v of im) if (v) found[v & 0xffffff] = 1;"
        " return Object.keys(found).length; })()"
    )
    assert opened.js("changes", counted) == 2  # colours of the two visits
    before, after = (
        opened.js("changes", f"live.series.find((s) => s.layer === '{name}').full.{column}[0]")
        for name, column in (("moved", "number"), ("moved", "at_x"))
    )
    assert before == 1
    assert after == pytest.approx(2.5)
    tip = opened.js("changes", "live.series.find((s) => s.layer === 'moved').tip")
    assert "sure" in tip
    box.locator("input[name=swipe]").fill("100")
    opened.page.wait_for_timeout(300)
    assert opened.js("changes", counted) == 1
    assert opened.messages == []
    assert [url for url in opened.requests if not url.startswith(("file:", "data:"))] == []
    assert opened.page.evaluate("document.documentElement.scrollWidth") == width


def two_back_ends():
    """A filter and a smoother on one drive of 100 s along x; causally they drift to one side."""
    stamps, names = np.arange(101) * 10**9, ("EKF", "batch")
    x = np.linspace(0.0, 20.0, 101)
    truth = np.column_stack([x, np.zeros_like(x)])
    rows, backends = [], []
    for name in names:
        rows.append({
            "spec": name, "label": name, "error": None, "final_is_causal": name == "EKF",
            "steps": 101, "associations": 2, "late": 0, "skipped": {}, "ms_per_step": {"p50": 1.0},
        })  # fmt: skip
        paths, curves = {}, {}
        for kind in ("final", "causal"):
            off = 0.0 if name == "batch" and kind == "final" else 0.02 * x
            poses = np.column_stack([x, off * np.ones_like(x), np.zeros_like(x)])
            paths[kind] = {"robot": TimedPath(stamps, poses)}
            error = ErrorCurve(stamps, np.abs(poses[:, 1]), np.zeros(101), np.ones(101))
            curves[kind] = {"robot": error}
        backends.append(BackendCurves(name, name, paths, curves, *3 * [np.ones(101)]))
    summary = {
        "mode": "replay", "recorded_by": "batch", "reference": "batch", "rows": rows,
        "start_given": True, "logs": [{"path": "run.mcap", "sha256": "ab" * 32}], "warnings": [],
    }  # fmt: skip
    return Comparison(summary, tuple(backends), {"robot": truth})


@pytest.mark.parametrize("width", [1280, 390])
def test_back_ends_share_a_map_and_are_swiped_to_their_causal_paths(width, open_page):
    opened = open_page(render_comparison(two_back_ends()), width)
    box = opened.live("paths")
    path = (
        "live.series.find((s) => s.robot && s.layer === 'batch' && s.side === '{}')"
        ".renderer.visible"
    )
    assert opened.js("paths", path.format("after")) and not opened.js(
        "paths", path.format("before")
    )
    box.locator("input[name=swipe]").fill("100")
    opened.page.wait_for_timeout(300)
    assert opened.js("paths", path.format("before"))
    box.get_by_label("batch", exact=True).click()
    opened.page.wait_for_timeout(100)
    assert not opened.js("paths", path.format("before"))
    # half of the drive: the filter is alone, 20 cm to the side, and says so where one points
    box.locator("input[name=time]").fill("500")
    opened.page.wait_for_timeout(300)
    place = opened.js("paths", "[live.source.data.x, live.source.data.y]")
    np.testing.assert_allclose(np.ravel(place), [10.0, 0.2], atol=1e-3)
    tips = opened.js(
        "paths",
        "live.series.filter((s) => s.tip && s.side === 'before')"
        ".map((s) => [s.tip, s.full.error[50]])",
    )
    (tip, error), _ = tips
    assert tip.startswith("<b>EKF</b>, causal") and "cm from the truth" in tip
    assert error == pytest.approx(20.0)
    assert opened.messages == []
    assert [url for url in opened.requests if not url.startswith(("file:", "data:"))] == []
    assert opened.page.evaluate("document.documentElement.scrollWidth") == width


@pytest.mark.parametrize("width", [1280, 390])
def test_runs_of_an_experiment_are_replayed_around_the_truth_and_tell_their_errors(
    width, open_page
):
    truth = np.column_stack([np.linspace(0.0, 10.0, 21), np.zeros(21)])
    time = np.linspace(0.0, 20.0, 21)
    runs = {
        name: [
            RunPath(run, "a", time, truth + np.array([0.0, side * off]), truth)
            for run, side in sides
        ]
        for name, off in (("ekf", 0.02), ("batch", 0.01))
        for sides in [((0, -1.0), (1, 1.0))]
    }
    walls = [np.array([[-1.0, 4.0], [11.0, 4.0]]), np.array([[-1.0, -4.0], [11.0, -4.0]])]
    shown = RunsMap("runs-0", "All runs", walls, np.array([[5.0, 2.0]]), runs)
    styles = {"ekf": Style("#4477aa"), "batch": Style("#ee6677")}
    page = report_html.document("runs", [live_html(live_runs(shown, styles))])
    opened = open_page(page, width)
    box = opened.live("runs-0")
    lines = "live.series.filter((s) => s.glyph === 'path' && s.layer === 'ekf')"
    box.locator("input[name=time]").fill("500")
    opened.page.wait_for_timeout(300)
    # both runs up to half of the drive, and the robot on the true path
    x = opened.js("runs-0", f"Array.from({lines}[0].source.data.x)")
    seen = [value for value in x if value is not None and value == value]
    assert len(seen) == 22 and max(seen) == pytest.approx(5.0)
    place = opened.js("runs-0", "[live.source.data.x, live.source.data.y]")
    np.testing.assert_allclose(np.ravel(place), [5.0, 0.0], atol=1e-3)
    tips = opened.js(
        "runs-0", "live.series.filter((s) => s.tip).map((s) => [s.tip, s.full.error[3]])"
    )
    assert [error for _, error in tips] == pytest.approx([2.0, 1.0])  # cm, not enlarged
    assert tips[0][0].startswith("<b>ekf</b>, run @run")
    box.get_by_label("ekf").click()
    opened.page.wait_for_timeout(100)
    assert not opened.js("runs-0", f"{lines}[0].renderer.visible")
    assert opened.messages == []
    assert opened.page.evaluate("document.documentElement.scrollWidth") == width


def test_a_chart_tells_values_and_zooms_on_logarithmic_axes(open_page):
    x = np.array([0.03, 0.1, 0.3, 1.0])
    curves = [
        Curve("a <b> & @x", Style("#4477aa"), x, np.array([0.0, 1e-3, 1e-2, 1e-1])),
        Curve("other", Style("#ee6677", dashes=(1.2, 1.2)), x, x),
    ]
    chart = live_chart(
        "chart", "A chart.", "", curves, ("noise", "error, m"), log=(True, True), marked=True
    )
    opened = open_page(report_html.document("charts", [live_html(chart)]))
    box = opened.live("chart")
    before = opened.js("chart", "live.plot.y_range.end / live.plot.y_range.start")
    # at least three numbers along either axis
    for axis in ("x", "y"):
        low, high = opened.js(
            "chart", f"[live.plot.{axis}_range.start, live.plot.{axis}_range.end]"
        )
        ticks = opened.js("chart", f"Array.from(live.plot.{axis}axes[0].ticker.ticks)")
        assert sum(low <= tick <= high for tick in ticks) >= 3
    box.locator(".live-stage").click()
    opened.page.wait_for_timeout(200)
    opened.page.mouse.wheel(0, -300)
    opened.page.wait_for_timeout(300)
    assert opened.js("chart", "live.plot.y_range.end / live.plot.y_range.start") < before
    box.get_by_label("a <b> & @x").click()
    shown = opened.js("chart", "live.series.map((s) => s.renderer.visible)")
    assert shown == [False, False, True, True]
    assert opened.messages == []
