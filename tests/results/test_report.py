"""The report: complete, self-contained, repeatable, and never with an empty panel."""

import dataclasses
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from html.parser import HTMLParser

import numpy as np
import pytest
from synthetic_results import orchard, room

from graphslam.core.config import Config
from graphslam.core.records import Estimate, Trajectory
from graphslam.evaluation.metrics import evaluate
from graphslam.results.folder import SavedResult
from graphslam.results.report import render
from graphslam.results.report_figure import FAINT, INK, density
from graphslam.results.report_maps import poses_at
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


def drawings(html):
    return re.findall(r"<svg.*?</svg>", html, flags=re.DOTALL)


@pytest.mark.parametrize("fixture", ["indoors", "outdoors"])
def test_one_file_that_asks_for_no_other(fixture, request):
    _, html = request.getfixturevalue(fixture)
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
        "Wall time per keyframe",
        "between the two thresholds",
        "no odometry around the scan",
        "631 scans are stamped earlier than the one before <scan & odom>",  # escaped, so readable
        "robot · translation scale",
        "All 12 landmarks",
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

    fields = (f.name for f in dataclasses.fields(robot))
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
    assert "script" not in read(html).tags


def test_many_landmarks_are_drawn_but_few_numbered():
    result, _, _ = orchard(keyframes=30, trees=300)
    html = render(result)
    labels = [d.count('class="halo"') for d in drawings(html)]
    assert 10 < max(labels) <= 40


def test_many_points_stay_small():
    """Breaks if each of 270 000 points is drawn for itself."""
    result, _ = room(keyframes=1500, beams=181)
    assert len(render(result)) < 6e6


def test_importing_the_package_does_not_import_matplotlib():
    code = "import sys, graphslam.results.report; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_drawing_leaves_the_settings_of_matplotlib_alone(outdoors):
    import matplotlib as mpl

    with mpl.rc_context({"font.size": 23.0}):
        render(outdoors[0])
        assert mpl.rcParams["font.size"] == 23.0
        assert mpl.rcParams["svg.hashsalt"] is None
    assert "matplotlib.pyplot" not in sys.modules


# ---------------------------------------------------------------- the parts


def test_scans_are_drawn_where_they_were_measured():
    # four points at the corners of a 3 x 3 picture and one outside
    points = np.array([[0.5, 0.5], [2.5, 0.5], [0.5, 2.5], [2.5, 2.5], [9.0, 9.0]])
    image = density(points, np.array([[0.0, 3.0], [0.0, 3.0]]), "#4477aa", pixels=3)
    assert image.shape == (3, 3, 4)
    assert (image[..., 3] > 0).tolist() == [[True, False, True], [False] * 3, [True, False, True]]
    assert image[0, 0, :3].tolist() == [0x44, 0x77, 0xAA]


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
