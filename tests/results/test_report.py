"""The report: complete, self-contained, repeatable, and never with an empty panel."""

import dataclasses
import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
from synthetic_results import orchard, room

from graphslam.core.config import Config
from graphslam.core.records import Estimate, Trajectory
from graphslam.evaluation.metrics import evaluate
from graphslam.results.drawing import TEXT_PT, TICK_TEXT_PT, Axes
from graphslam.results.drawing_elements import (
    FAINT,
    INK,
    OPAQUE,
    UNIT,
    Box,
    Shade,
    Style,
    path_data,
    png,
)
from graphslam.results.drawing_scales import Scale, linear_scale, log_scale
from graphslam.results.folder import SavedResult
from graphslam.results.live_figure import live_html
from graphslam.results.live_map import live_map
from graphslam.results.live_paths import _followed
from graphslam.results.report import render
from graphslam.results.report_figure import Drawing, density, map_axes
from graphslam.results.report_maps import overview_of, poses_at, trajectory_map
from graphslam.results.report_tables import headline, landmark_sigma, number


@pytest.fixture(scope="module")
def indoors():
    result, truth = room(keyframes=80, beams=61)
    saved = SavedResult(result.robots, result.landmarks, result.summary, Config())
    return result, render(result, evaluate(saved, {"robot": truth}))


@pytest.fixture(scope="module")
def outdoors():
    result, _, _ = orchard(keyframes=80, trees=50)
    return result, render(result)


class Reader(HTMLParser):
    """Collects text, addresses and what is not closed."""

    VOID = frozenset({"meta", "br", "img", "link", "input", "hr"})

    def __init__(self):
        super().__init__()
        self.text, self.links, self.open, self.headings, self.tags = [], [], [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        assert tag != "script" or not dict(attrs).get("src")
        self.links += [v for k, v in attrs if k in ("src", "href", "xlink:href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.links += [v for k, v in attrs if k in ("src", "href", "xlink:href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)
        self.text.append(data)


def read(html):
    reader = Reader()
    reader.feed(html)
    assert not reader.open
    return reader


def without_scripts(html):
    """What a browser without scripts, or a printer, has to show."""
    return re.sub(r"<script[^>]*>.*?</script>", "", html, flags=re.DOTALL)


def drawings(html):
    html = without_scripts(html)
    return re.findall(r"<svg.*?</svg>", html, flags=re.DOTALL)


@pytest.mark.parametrize("fixture", ["indoors", "outdoors"])
def test_one_file_that_asks_for_no_other(fixture, request):
    _, html = request.getfixturevalue(fixture)
    html = without_scripts(html)
    reader = read(html)
    assert all(link.startswith(("#", "data:image/png;base64,")) for link in reader.links)
    assert not {"script", "link", "iframe"} & set(reader.tags)
    assert "@import" not in html
    assert reader.tags.count("style") == 1
    assert not re.search(r"url\((?!#)", html)
    assert "width=device-width" in html


@pytest.mark.parametrize("fixture", ["indoors", "outdoors"])
def test_every_reference_inside_a_drawing_is_met_once_on_the_page(fixture, request):
    _, html = request.getfixturevalue(fixture)
    html = without_scripts(html)
    names = re.findall(r' id="([^"]+)"', html)
    assert len(names) == len(set(names))
    used = set(re.findall(r"url\(#([^)]+)\)", html)) | set(re.findall(r'href="#([^"]+)"', html))
    assert used == set(names)
    for drawing in drawings(html):
        ET.fromstring(drawing)  # raises if a clean-up broke it


@pytest.mark.parametrize("fixture", ["indoors", "outdoors"])
def test_drawings_take_the_colours_of_the_page(fixture, request):
    _, html = request.getfixturevalue(fixture)
    for drawing in drawings(html):
        assert INK not in drawing
        assert FAINT not in drawing
        assert "currentColor" in drawing
        # whatever is painted white or black would be lost in light or in dark
        assert not re.search(r"(fill|stroke): ?#(ffffff|000000)", drawing)


def test_the_same_result_gives_the_same_bytes(indoors):
    result, _ = indoors
    assert render(result) == render(result)


def test_dates_and_machine_are_not_in_it(indoors):
    _, html = indoors
    assert "dc:date" not in html
    assert "matplotlib" not in html


def test_everything_asked_for_is_shown(indoors):
    _, html = indoors
    text = "".join(read(html).text)
    for words in (
        "made_up.mcap",
        "Superposed scans on the trajectory from all data",
        "The same scans by odometry alone",
        "95 % ellipses",
        "bars across the ends",
        "Final against causal",
        "Innovations",
        "Wall time per step",
        "between the two thresholds",
        "no odometry around the scan",
        "631 scans are stamped earlier than the one before <scan & odom>",  # escaped, so readable
        "translation scale",
        "Table of 12 landmarks",
        "gtsam 4.3.0",
        "[front_end]",
        "Against true poses",
    ):
        assert words in text, words
    # scans on the final trajectory, on odometry, and two plots of dots
    assert html.count("data:image/png;base64,") >= 4


def test_without_scans_there_is_no_word_of_them_and_no_empty_panel(outdoors):
    result, html = outdoors
    reader = read(html)
    text = "".join(reader.text)
    assert "scans of" not in text
    assert "Superposed" not in text
    assert "Paths on the trajectory from all data" in text
    assert "Against the truth" not in reader.headings
    assert "Warnings" not in reader.headings
    assert "Calibration" not in text
    for robot in result.robots:
        assert robot in text


def test_a_bare_result_renders(outdoors):
    result, _ = outdoors
    name, robot = next(iter(result.robots.items()))
    bare = dataclasses.replace(
        result,
        robots={name: robot},
        landmarks=(),
        innovations={},
        step_ms=np.empty(0),
        estimate=Estimate({name: robot.final}, {}, 0.0, 0),
        summary={},
    )
    reader = read(render(bare))
    assert reader.headings == ["Map", "Over time", "Accounts"]


def test_a_single_standing_pose_renders(indoors):
    result, _ = indoors
    robot = result.robots["robot"]

    def first(t):
        return Trajectory(t.stamps_ns[:1], t.poses[:1], np.zeros((1, 3, 3)))

    fields = [f.name for f in dataclasses.fields(robot) if f.name != "scan_ties"]
    one = dataclasses.replace(robot, **{name: first(getattr(robot, name)) for name in fields})
    standing = dataclasses.replace(
        result, robots={"robot": one}, keyframe_scans=result.keyframe_scans[:1]
    )
    read(render(standing))


def test_unknown_models_and_unusable_covariances_render(outdoors):
    result, _ = outdoors
    name, robot = next(iter(result.robots.items()))
    nothing = Trajectory(
        robot.final.stamps_ns, robot.final.poses, np.full_like(robot.final.covs, np.nan)
    )
    odd = dataclasses.replace(
        result,
        robots={name: dataclasses.replace(robot, final=nothing)},
        innovations={"cylinder": np.array([[0.0, 1.0], [1.0, 2.0]]), "point": np.empty((0, 2))},
    )
    text = "".join(read(render(odd)).text)
    assert "cylinder" in text
    assert "position known" not in text


def test_names_from_logs_cannot_inject_markup(outdoors):
    result, _ = outdoors
    evil = "<script>alert(1)</script>"
    log = {"path": evil, "sha256": evil, "messages": 1, "lost": 0}
    summary = {**result.summary, "logs": [log], "warnings": [evil], "rejected": {evil: 1}}
    robots = {f"{evil}{i}": robot for i, robot in enumerate(result.robots.values())}
    html = render(dataclasses.replace(result, robots=robots, summary=summary))
    assert "script" not in read(without_scripts(html)).tags
    assert evil not in html
    assert html.count("<script") == render(result).count("<script")


def test_many_landmarks_are_drawn_but_few_numbered():
    result, _, _ = orchard(keyframes=30, trees=300)
    html = render(result)
    labels = [d.count('class="halo"') for d in drawings(html)]
    assert 10 < max(labels) <= 40


def test_many_points_stay_small():
    """Breaks if each of 270 000 points is drawn for itself."""
    result, _ = room(keyframes=1500, beams=181)
    assert len(render(result)) < 6e6


# ---------------------------------------------------------------- the parts


def test_scans_are_drawn_where_they_were_measured():
    # four points at the corners of a 3 x 3 picture and one outside
    points = np.array([[0.5, 0.5], [2.5, 0.5], [0.5, 2.5], [2.5, 2.5], [9.0, 9.0]])
    shade = density(points, np.array([[0.0, 3.0], [0.0, 3.0]]), "#4477aa", pixels=3)
    assert (shade.levels > 0).tolist() == [[True, False, True], [False] * 3, [True, False, True]]
    assert shade.color == "#4477aa"


@pytest.mark.parametrize("columns", [4, 5])
def test_a_picture_is_read_back_as_it_was(columns):
    """Breaks if two pixels of a byte are exchanged, or an odd row is cut."""
    levels = (np.arange(3 * columns, dtype=np.uint8) % (OPAQUE + 1)).reshape(3, columns)
    read = cv2.imdecode(np.frombuffer(png(Shade(levels, "#4477aa")), np.uint8), -1)
    assert (read[..., 3] == levels * 17).all()
    assert (read[..., :3] == [0xAA, 0x77, 0x44]).all()  # blue, green, red


def places_of(path):
    """The places (n, 2) on a path with a single run."""
    head, _, steps = path.removeprefix("M").partition("l")
    moves = np.array([head.split(), *np.array(steps.split()).reshape(-1, 2)], dtype=int)
    return np.cumsum(moves, axis=0)


def test_a_thinned_curve_keeps_its_ends_and_extremes_and_stays_near():
    """Breaks if a peak between two others is lost, or a loop is cut off."""
    noise = np.random.default_rng(1).normal(size=20_000)
    noise[7777] = 9.0
    curve = np.column_stack([np.linspace(0, 3000, 20_000), 500 + 50 * noise])
    seen = places_of(path_data(curve))
    assert len(seen) < 5000
    assert (seen[[0, -1]] == np.rint(curve[[0, -1]])).all()
    assert seen[:, 1].max() == 950
    turn = np.linspace(0, 2 * np.pi, 5000)
    circle = 1000 * np.column_stack([np.cos(turn), np.sin(turn)])
    seen = places_of(path_data(circle))
    assert len(seen) < 2000
    between = np.linspace(seen[:-1], seen[1:], 5).reshape(-1, 2)
    assert np.abs(np.hypot(*between.T) - 1000).max() < 4.5  # half a pixel


def test_a_curve_has_gaps_where_it_has_no_values():
    path = path_data(np.array([[0.0, 0], [10, 0], [np.nan, 0], [20, 0], [30, 5]]))
    assert path == "M0 0l10 0M20 0l10 5"
    assert path_data(np.full((3, 2), np.nan)) == ""


@pytest.mark.parametrize(
    ("scale", "ticks"),
    [
        (Scale(-10.3, 20.4), "\u221210 \u22125 0 5 10 15 20"),
        (Scale(0.0, 1.0), "0.0 0.2 0.4 0.6 0.8 1.0"),
        (Scale(1.2e-3, 2.9e-3), "0.0015 0.0020 0.0025"),
        (Scale(5200000.1, 5200001.7), "5200000.5 5200001.0 5200001.5"),
        (Scale(0.04, 2.2, is_log=True), "0.05 0.1 0.2 0.5 1 2"),
        (Scale(1e-3, 200.0, is_log=True), "0.001 0.01 0.1 1 10 100"),
        (Scale(21.0, 28.0, is_log=True), "22 24 26 28"),
    ],
)
def test_ticks_are_round_and_within_the_scale(scale, ticks):
    assert " ".join(scale.labels(scale.ticks(7))) == ticks


def test_scales_reach_a_little_beyond_the_data():
    assert linear_scale(0.0, 10.0, 0.1) == Scale(-1.0, 11.0)
    assert log_scale(1.0, 100.0, 0.5) == Scale(0.1, 1000.0, is_log=True)
    assert linear_scale(3.0, 3.0, 0.0) == Scale(2.5, 3.5)
    assert linear_scale(np.nan, np.nan, 0.0) == Scale(0.0, 1.0)
    assert log_scale(4.0, 4.0, 0.0) == Scale(2.0, 8.0, is_log=True)
    assert log_scale(np.nan, np.nan, 0.0) == Scale(0.1, 1.0, is_log=True)


@pytest.mark.parametrize("limits", [(0.0, 1.0), (-300.0, 200.0), (-20000.0, 5000.0), (0.0, 2e-4)])
def test_the_label_of_an_axis_is_neither_cut_nor_on_its_numbers(limits):
    """Breaks with a fixed distance from the axis, which long numbers reach."""
    drawing = Drawing("map", 3.0)
    axes = map_axes(drawing, np.array([limits, limits]))
    text = drawing.to_svg()
    (x,) = (float(v) for v in re.findall(r"rotate\(-90 (-?\d+)[^>]*>y, m</text>", text))
    numbers = re.findall(r'text-anchor="end"[^>]*>([^<]+)</text>', text)
    assert len(numbers) > 2
    half = TEXT_PT * UNIT / 2
    assert x - half >= 0
    if max(map(len, numbers)) < 6:
        assert x + half <= axes.box.left - (5 + 0.6 * TICK_TEXT_PT * max(map(len, numbers))) * UNIT


def test_what_is_drawn_lies_where_the_axes_say():
    axes = Axes(Box(100, 50, 1100, 450), "a")
    axes.log_y = True
    axes.set_x(0.0, 10.0)
    axes.set_y(0.1, 1000.0)
    places = axes.place(np.array([0.0, 10.0, 5.0, 5.0]), np.array([0.1, 1000.0, 10.0, -1.0]))
    assert np.allclose(places[:3], [[100, 450], [1100, 50], [600, 250]])
    assert np.isnan(places[3, 1])


def test_a_legend_names_each_curve_once():
    axes = Axes(Box(0, 100, 3000, 400), "a")
    for name in ("ekf", "isam2", "ekf"):
        axes.line([0, 1], [0, 1], Style(INK), name)
    assert re.findall(r">([a-z]+2?)</text>", axes.to_svg()) == ["ekf", "isam2"]


def test_poses_between_stamps_lie_on_the_twist_and_ends_stand():
    t = Trajectory(
        np.array([10, 20]), np.array([[0.0, 0, 0], [1, 1, np.pi / 2]]), np.zeros((2, 3, 3))
    )
    found = poses_at(t, [0, 10, 15, 20, 99])
    assert np.allclose(found[[0, 1]], t.poses[0])
    assert np.allclose(found[[3, 4]], t.poses[1])
    # the quarter circle of radius 1 around (0, 1), half way
    assert np.allclose(found[2], [np.sqrt(0.5), 1 - np.sqrt(0.5), np.pi / 4])


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (13631, "13\u202f631"),
        (0, "0"),
        (True, "yes"),
        (None, "\u2013"),
        (float("nan"), "\u2013"),
        (0.0123456, "0.0123"),
        (99.96, "100.0"),
        (1234567.8, "1\u202f234\u202f568"),
        (0.0, "0"),
        (-2.5, "-2.50"),
        (1e-7, "1.00e-07"),
        ("a<b", "a&lt;b"),
    ],
)
def test_numbers_are_short_and_readable(value, text):
    assert number(value) == text


def test_the_sigma_of_a_line_is_taken_where_it_was_seen(indoors):
    result, _ = indoors
    for landmark in result.landmarks:
        # 2 cm across the middle of every wall; what is left is the direction's second order
        assert landmark_sigma(landmark) == pytest.approx(0.02, rel=0.01)


def test_the_headline_says_what_where_and_how_good(indoors, outdoors):
    sentence = headline(indoors[0])
    assert sentence.startswith("From 13\u202f631 scans of one robot over ")
    assert "80 keyframes and 12 line landmarks" in sentence
    assert "2 robots" in headline(outdoors[0])


@pytest.mark.parametrize("count", [1, 32])
def test_paths_of_the_map_that_moves_cut_no_corners(count):
    """An hour of drive, 18 000 poses with a corner every 8 m: lines that are drawn are within a
    centimetre of every pose, of which every n-th misses them by decimetres. All robots have poses
    for the replay, every 15 s at least."""
    result, _, _ = orchard(keyframes=30, trees=9)
    t = np.arange(18_000) * 0.2
    turn = np.pi / 2 * (np.floor(t / 40) % 3)
    at = np.cumsum(0.04 * np.column_stack([np.cos(turn), np.sin(turn), 0 * t]), axis=0)
    stamps = result.robots["robot1"].final.stamps_ns[0] + np.round(t * 1e9).astype(np.int64)
    path = Trajectory(stamps, at, np.tile(1e-4 * np.eye(3), (len(t), 1, 1)))
    robot = result.robots["robot1"]
    long = dataclasses.replace(robot, final=path, causal=path, dead_reckoning=path)
    robots = {f"r{k:02}": long for k in range(count)}
    result = dataclasses.replace(result, robots=robots, steps=())
    figure = live_map(result, overview_of(result).limits)
    drawn = [one.columns for one in figure.series if one.glyph == "path"]
    assert len(drawn) == 3 * count
    for columns in drawn:
        assert np.diff(columns["time"]).max() < 15
        at_time = np.searchsorted(columns["time"], t, side="right") - 1
        line = np.minimum(at_time, len(columns["time"]) - 2)
        ends = np.column_stack([columns["x"], columns["y"]])
        along, offset = ends[line + 1] - ends[line], at[:, :2] - ends[line]
        across = along[:, 0] * offset[:, 1] - along[:, 1] * offset[:, 0]
        assert (np.abs(across) / np.hypot(*along.T)).max() <= 0.01


def test_a_path_of_a_comparison_and_its_truth_cut_no_corners():
    """In the same way, for the back ends of one log."""
    t = np.arange(18_000) * 0.2
    at = 0.01 * t[:, None] * np.column_stack([np.cos(t / 9), np.sin(t / 9)])
    chosen = _followed(at, 1)
    line = np.clip(np.searchsorted(chosen, np.arange(len(t)), side="right") - 1, 0, len(chosen) - 2)
    begin, along = at[chosen[line]], at[chosen[line + 1]] - at[chosen[line]]
    across = along[:, 0] * (at - begin)[:, 1] - along[:, 1] * (at - begin)[:, 0]
    assert (np.abs(across) / np.hypot(*along.T)).max() <= 0.01 and len(chosen) <= 9000


def test_a_name_in_the_legend_of_a_map_is_of_one_robot():
    """By colour and dashes, of three dozen; in the map that moves and in the drawing."""
    result, _, _ = orchard(keyframes=30, trees=9)
    robots = {f"r{k:02}": result.robots["robot1"] for k in range(36)}
    many = dataclasses.replace(result, robots=robots, steps=())
    figure = live_map(many, overview_of(many).limits)
    drawn = [one for one in figure.series if one.glyph == "path" and one.layer in robots]
    looks = {(one.layer, one.color, str(one.dash)) for one in drawn}
    assert len(looks) == len({look[1:] for look in looks}) == 36
    samples = re.findall(r"<i class=[^>]*></i>(?=r\d\d<)", live_html(figure))
    assert len(samples) == len(set(samples)) == 36
    svg, _ = trajectory_map(many, 3.0)
    samples = re.findall(r'<path d="M\d+ -?\d+h\d+" style="([^"]*)"', svg)
    assert len(samples) == len(set(samples)) == 36


def test_the_map_holds_the_whole_path_and_ellipses_that_are_apart():
    """However many poses it has: only returns of scans may be outliers. Breaks with quantiles of
    the path, and with an ellipse for each of many poses in one place."""
    result, _, _ = orchard(keyframes=30, trees=300)
    robot = result.robots["robot1"]
    poses = np.repeat(robot.final.poses, 100, axis=0)
    stamps = robot.final.stamps_ns[0] + np.arange(len(poses)) * 10**8
    poses[1234, :2] += 50.0
    final = Trajectory(stamps, poses, np.repeat(robot.final.covs, 100, axis=0))
    long = dataclasses.replace(robot, final=final, causal=None, dead_reckoning=final)
    result = dataclasses.replace(result, robots={**result.robots, "robot1": long})
    figure = live_map(result, overview_of(result).limits)
    assert (figure.limits[:, 1] > poses[1234, :2]).all()
    (ellipses,) = (one.columns for one in figure.series if one.glyph == "ellipses")
    at = np.column_stack([ellipses["x"], ellipses["y"]])
    reach = np.maximum(ellipses["width"], ellipses["height"]) / 2
    trees = np.array([m.position[:2] for m in result.landmarks])
    of_tree = (np.hypot(*(at[:, None] - trees).transpose(2, 0, 1)) < 1e-9).any(axis=1)
    for of in (of_tree, ~of_tree):
        apart = np.hypot(*(at[of, None] - at[of]).transpose(2, 0, 1))
        np.fill_diagonal(apart, np.inf)
        assert of.sum() > 1 and (apart > reach[of]).all()
