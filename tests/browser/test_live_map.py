# ruff: noqa: RUF001 -- σ is meant: it is read on the page
"""The map of a report in a real browser: zoom, hover, replay, swipe, layers; offline and quiet."""

import numpy as np
import pytest
from synthetic_results import orchard, room

from graphslam.results.report import render

pytestmark = pytest.mark.browser

#: texts of all tips on the page; BokehJS draws inside shadow trees
TIPS = """() => {
  const found = [];
  const walk = (root) => {
    for (const e of root.querySelectorAll("*")) {
      if (e.classList.contains("bk-Tooltip") || e.localName === "bk-tooltip")
        found.push((e.shadowRoot || e).textContent);
      if (e.shadowRoot) walk(e.shadowRoot);
    }
  };
  walk(document);
  return found.join(" ");
}"""


@pytest.fixture(scope="module")
def indoors():
    result, _ = room(keyframes=60, beams=61)
    return result, render(result)


@pytest.fixture(scope="module")
def outdoors():
    result, _, _ = orchard(keyframes=60, trees=20)
    return result, render(result)


def ranges(opened):
    both = "[live.plot.x_range, live.plot.y_range].map((r) => [r.start, r.end])"
    return np.array(opened.js("map", both))


def place(opened, point):
    """Pixel of the page at a point of the world."""
    opened.live("map")
    box = opened.page.locator(".live-stage").bounding_box()
    frame = opened.js(
        "map",
        "(() => { const f = live.view.frame.bbox; return [f.left, f.right, f.top, f.bottom]; })()",
    )
    (x0, x1), (y0, y1) = ranges(opened)
    left, right, top, bottom = frame
    x = left + (right - left) * (point[0] - x0) / (x1 - x0)
    y = bottom - (bottom - top) * (point[1] - y0) / (y1 - y0)
    return box["x"] + x, box["y"] + y


def tip(opened):
    """Text of what is hovered."""
    opened.page.wait_for_timeout(200)
    return opened.page.evaluate(TIPS)


@pytest.mark.parametrize("kind", ["indoors", "outdoors"])
@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("theme", ["light", "dark"])
def test_the_page_is_quiet_asks_for_nothing_and_fits(kind, width, theme, request, open_page):
    _, html = request.getfixturevalue(kind)
    assert len(html.encode()) < 6e6
    opened = open_page(html, width, color_scheme=theme)
    opened.live("map")
    assert opened.messages == []
    assert [url for url in opened.requests if not url.startswith(("file:", "data:"))] == []
    assert opened.page.evaluate("document.documentElement.scrollWidth") == width
    background = opened.js("map", "live.plot.background_fill_color")
    assert background == ("#ffffff" if theme == "light" else "#1b1f24")


def test_scales_are_equal_and_the_wheel_zooms_only_after_a_click(indoors, open_page):
    opened = open_page(indoors[1])
    opened.live("map")
    before = ranges(opened)
    size = opened.js("map", "[live.plot.inner_width, live.plot.inner_height]")
    assert np.ptp(before[0]) / size[0] == pytest.approx(np.ptp(before[1]) / size[1], rel=0.01)
    middle = place(opened, before.mean(axis=1))
    opened.page.mouse.move(*middle)
    opened.page.mouse.wheel(0, 30)
    opened.page.wait_for_timeout(1000)  # one turn of the wheel stays with what it began to scroll
    np.testing.assert_allclose(ranges(opened), before)
    middle = place(opened, before.mean(axis=1))
    opened.page.mouse.click(*middle)
    opened.page.wait_for_timeout(200)
    opened.page.mouse.wheel(0, -300)
    opened.page.wait_for_timeout(300)
    zoomed = ranges(opened)
    assert np.ptp(zoomed[0]) < 0.9 * np.ptp(before[0])
    assert np.ptp(zoomed[0]) / size[0] == pytest.approx(np.ptp(zoomed[1]) / size[1], rel=0.01)
    assert opened.messages == []


def test_dragging_moves_the_map(indoors, open_page):
    opened = open_page(indoors[1])
    opened.live("map")
    before = ranges(opened)
    x, y = place(opened, before.mean(axis=1))
    opened.page.mouse.move(x, y)
    opened.page.mouse.down()
    opened.page.mouse.move(x + 60, y, steps=4)
    opened.page.mouse.up()
    opened.page.wait_for_timeout(200)
    moved = ranges(opened) - before
    assert (moved[0] < -1e-3).all()
    np.testing.assert_allclose(moved[1], 0.0, atol=1e-6)


def test_a_landmark_tells_its_number_sigma_and_sightings(outdoors, open_page):
    result, html = outdoors
    opened = open_page(html)
    opened.live("map")
    landmark = result.landmarks[7]
    opened.page.mouse.move(*place(opened, landmark.position[:2]))
    text = tip(opened)
    assert f"landmark {landmark.id}" in text
    assert f"{landmark.sightings} sightings" in text
    assert "σ" in text and "cm" in text


def test_a_pose_tells_its_time_and_sigma(outdoors, open_page):
    result, html = outdoors
    opened = open_page(html)
    opened.live("map")
    path = result.robots["robot1"].final
    # the pose that is farthest from all landmarks, so that nothing else is pointed at
    trees = np.array([m.position[:2] for m in result.landmarks])
    others = result.robots["robot2"].final.poses[:, :2]
    away = np.concatenate([trees, others])
    distance = np.hypot(*(path.poses[:, None, :2] - away).transpose(2, 0, 1)).min(axis=1)
    i = int(distance.argmax())
    opened.page.mouse.move(*place(opened, path.poses[i, :2]))
    text = tip(opened)
    seconds = (path.stamps_ns[i] - path.stamps_ns[0]) / 1e9
    assert f"robot1 at {seconds:.1f} s" in text
    assert "position σ" in text


def test_the_slider_replays_the_drive(indoors, open_page):
    result, html = indoors
    opened = open_page(html)
    opened.live("map")
    whole = opened.js("map", "live.picture.data.image[0].reduce((a, b) => a + (b > 0), 0)")
    opened.page.locator("input[name=time]").fill("300")
    opened.page.wait_for_timeout(300)
    part = opened.js("map", "live.picture.data.image[0].reduce((a, b) => a + (b > 0), 0)")
    assert 0 < part < whole
    path = result.robots["robot"].final
    now = 0.3 * (path.stamps_ns[-1] - path.stamps_ns[0]) / 1e9
    i = int(np.searchsorted((path.stamps_ns - path.stamps_ns[0]) / 1e9, now, side="right")) - 1
    robot = opened.js("map", "[live.source.data.x[0], live.source.data.y[0]]")
    np.testing.assert_allclose(robot, path.poses[i, :2], atol=1e-3)
    assert opened.page.locator(".live output").inner_text() == f"{now:.1f} s"
    opened.page.locator(".live button").click()
    opened.page.wait_for_timeout(500)
    assert float(opened.page.locator("input[name=time]").input_value()) > 300
    assert opened.messages == []


def test_the_swipe_shows_odometry_left_of_it(indoors, open_page):
    opened = open_page(indoors[1])
    opened.live("map")
    of = "live.series.find((s) => s.robot && s.side === '{}')"
    assert not opened.js("map", of.format("before") + ".renderer.visible")
    opened.page.locator("input[name=swipe]").fill("50")
    opened.page.wait_for_timeout(300)
    border = ranges(opened)[0].mean()
    x = {
        s: opened.js("map", f"Array.from({of.format(s)}.source.data.x)")
        for s in ("before", "after")
    }
    before, after = (
        np.array([v for v in x[s] if v is not None and v == v]) for s in ("before", "after")
    )
    assert len(before) and len(after)
    assert (before < border).all() and (after >= border).all()
    assert opened.messages == []


def test_layers_switch_off_and_on(indoors, open_page):
    opened = open_page(indoors[1])
    box = opened.live("map")
    for visible in (False, True):
        box.get_by_label("landmarks").click()
        opened.page.wait_for_timeout(100)
        found = opened.js(
            "map",
            "live.series.filter((s) => s.layer === 'landmarks').map((s) => s.renderer.visible)",
        )
        assert found and all(one == visible for one in found)


def test_without_scripts_the_drawings_are_there_and_nothing_is_empty(indoors, open_page):
    opened = open_page(indoors[1], java_script_enabled=False)
    assert opened.page.locator("figure svg").count() >= 6
    assert not opened.page.locator(".live").is_visible()


def test_print_has_the_drawings_only(indoors, open_page):
    opened = open_page(indoors[1])
    opened.live("map")
    opened.page.emulate_media(media="print")
    assert not opened.page.locator(".live").is_visible()
    assert opened.page.locator("figure svg").first.is_visible()
    opened.page.wait_for_timeout(200)
    # what is folded on the screen is on paper
    assert opened.page.locator("details table").first.bounding_box()["height"] > 100


def test_the_theme_follows_the_system(indoors, open_page):
    opened = open_page(indoors[1], color_scheme="light")
    opened.live("map")
    opened.page.emulate_media(color_scheme="dark")
    opened.page.wait_for_timeout(200)
    assert opened.js("map", "live.plot.background_fill_color") == "#1b1f24"
