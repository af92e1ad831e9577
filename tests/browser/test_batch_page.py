"""The overview of a batch in a real browser: sorted, searched, chosen by state; offline."""

import pytest

from graphslam.results.report_batch import batch_page

pytestmark = pytest.mark.browser


def a_row(name, verdict="good", error=0.01, **changed):
    row = {
        "name": name, "path": f"/data/{name}.mcap", "status": "done", "error": None,
        "verdict": verdict, "reasons": [], "warnings": [], "length_m": 10.0, "error_m": error,
        "sigma_m": 0.02, "loops": 1, "duration_s": 60.0, "seconds": 2.0, "memory_mb": 200.0,
    }  # fmt: skip
    return row | changed


@pytest.fixture
def html():
    rows = [
        a_row("a2", error=0.03, warnings=["one", "two"]),
        a_row("a10", error=0.2),
        a_row("b", "bad", None, reasons=["wheels are frozen in /data/b.mcap"]),
        {"name": "c", "path": "/data/c.mcap", "status": "failed", "error": "is <no> recording"},
    ]
    counts = {"logs": 4, "done": 3, "failed": 1, "waiting": 0, "done_now": 4}
    counts |= {"good": 2, "doubtful": 0, "bad": 1}
    found = {
        "counts": counts, "logs": rows, "seconds": 10.0, "workers": "2 processes",
        "totals": {"length_m": 30.0, "duration_s": 180.0, "seconds": 6.0}, "not_recordings": [],
    }  # fmt: skip
    return batch_page(found, {"a2": '<svg viewBox="0 0 4 3"></svg>'})


def names(opened):
    return opened.page.locator("tr[data-is]:visible").evaluate_all(
        "rows => rows.map(row => row.dataset.name)"
    )


@pytest.mark.parametrize("width", [1280, 390])
def test_rows_are_sorted_searched_and_chosen(open_page, html, width):
    opened = open_page(html, width=width)
    assert names(opened) == ["c", "b", "a2", "a10"]  # the worst first, names as numbers
    opened.page.locator(".tools select").select_option(label="error")
    assert names(opened) == ["a10", "a2", "b", "c"]  # without a number: last, either way
    if width > 560:
        opened.page.locator("th[data-key] button:text-is('error')").click()
        assert names(opened) == ["a2", "a10", "b", "c"]
        assert opened.page.locator("th[aria-sort=ascending]").inner_text().strip() == "error"
        opened.page.locator("th[data-key] button:text-is('warnings')").click()
        assert names(opened)[0] == "a2"
    opened.page.locator(".tools input").fill("FROZEN")
    assert names(opened) == ["b"]
    opened.page.locator(".tools input").fill("")
    opened.page.locator(".states button[data-state=good]").click()
    assert sorted(names(opened)) == ["a10", "a2"]
    opened.page.locator(".states button[data-state=good]").click()
    assert len(names(opened)) == 4
    assert opened.page.evaluate("document.documentElement.scrollWidth") <= width
    assert not opened.messages and len(opened.requests) == 1


def test_without_scripts_all_rows_are_there_and_no_controls(open_page, html):
    opened = open_page(html, java_script_enabled=False)
    assert opened.page.locator("tr[data-is]").count() == 4
    assert not opened.page.locator(".tools").is_visible()
    assert "is <no> recording" in opened.page.locator("tr[data-is=failed]").inner_text()
