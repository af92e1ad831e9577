"""The terminal: stages with a time to the end, quiet, verbose, suggestions, completion, view."""

import os
import webbrowser

import pytest
from command_line import call
from rich.console import Console
from synthetic_results import room

from graphslam.cli import show, view
from graphslam.cli.commands import app
from graphslam.cli.stage_bar import PLANS, Stages
from graphslam.core.errors import OutputError
from graphslam.core.stages import announce, listening
from graphslam.core.suggestions import did_you_mean


class Clock:
    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


def test_the_share_done_never_falls_and_reaches_the_end():
    clock = Clock()
    stages = Stages(clock)
    shares = []
    for done in range(0, 101, 10):
        clock.now += 0.5
        stages.read(done, 100)
        shares.append(stages.done)
    for stage in ("final optimisation", "front end", "final", "final optimisation", "trajectories"):
        stages.announced(stage)
        for _ in range(5):
            clock.now += 0.4
            shares.append(stages.done)
    stages.announced("report")
    clock.now += 100.0
    shares.append(stages.done)
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)


@pytest.mark.parametrize("plan", PLANS)
def test_the_time_left_is_true_of_a_job_whose_stages_take_their_usual_shares(plan):
    """However long the opening took. Breaks if it is counted as work."""
    clock, opening, work = Clock(), 30.0, 50.0
    stages = Stages(clock)
    clock.now = opening
    stages.announced(
        {"scans": "tracking", "steps": "front end", "sessions": plan}.get(plan, "reading")
    )
    for stage, begins in list(PLANS[plan].items())[1:]:
        clock.now = opening + work * begins
        stages.announced(stage)
        assert stages.left_s == pytest.approx(work * (1.0 - begins), rel=0.01)
        clock.now += 0.002 * work
        assert stages.left_s == pytest.approx(work * (0.998 - begins), rel=0.05)


def test_half_of_the_reading_tells_when_a_job_of_scans_will_end():
    clock = Clock()
    stages = Stages(clock)
    stages.announced("tracking")
    clock.now = 10.0
    stages.read(50, 100)
    whole = 20.0 / PLANS["scans"]["final optimisation"]
    assert stages.left_s == pytest.approx(whole - 10.0)


def test_the_joining_of_sessions_is_a_stage_of_the_work():
    """It takes most of the time, in which nothing was shown but that reading was nearly done."""
    clock = Clock()
    stages = Stages(clock)
    stages.announced("sessions")
    for done in (10, 20):
        stages.announced("tracking")  # of each session
        clock.now += 5.0
        stages.read(done, 20)
    stages.announced("joining")
    assert stages.stage == "joining"
    before = stages.done
    clock.now += 20.0
    assert before < stages.done < PLANS["sessions"]["final optimisation"]
    assert stages.left_s is not None


def test_a_log_that_is_read_anew_is_planned_anew_and_the_bar_does_not_go_back():
    """As Victoria Park: a rough solution first, of which nobody knows how long it takes."""
    clock = Clock()
    stages = Stages(clock)
    stages.read(100, 100)
    clock.now = 0.5
    stages.announced("final optimisation")
    assert stages.left_s is None
    clock.now = 40.0
    before = stages.done
    stages.announced("front end")
    stages.read(0, 100)
    assert stages.done >= before
    clock.now = 80.0
    stages.read(100, 100)
    whole = 40.0 / PLANS["steps"]["final optimisation"]
    assert stages.left_s == pytest.approx(whole - 40.0)
    assert before < stages.done < 1.0


def test_nothing_is_said_about_the_end_before_something_is_known():
    stages = Stages(Clock())
    stages.read(0, 100)
    assert stages.left_s is None


def test_stages_are_heard_only_within_the_block():
    heard = []
    announce("before")
    with listening(heard.append):
        announce("within")
    announce("after")
    assert heard == ["within"]


def test_stages_of_a_fork_are_not_heard():
    """A fork has the listener of this process, which would draw another bar over its bar."""
    heard = []
    source, target = os.pipe()
    with listening(heard.append):
        announce("here")
        if (child := os.fork()) == 0:
            announce("there")
            os.write(target, "".join(heard).encode())
            os._exit(0)
    os.waitpid(child, 0)
    assert os.read(source, 100) == b"here"
    os.close(source)
    os.close(target)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["simulate", "corridr", "-o", "x.mcap"], "did you mean corridor?"),
        (["smooth", "x.mcap", "--backend", "bacth", "-o", "x"], "did you mean batch?"),
        (["experiment", "slp", "-o", "x"], "did you mean slip?"),
    ],
)
def test_a_name_that_is_nearly_known_is_suggested(arguments, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = call(*arguments)
    assert done.code
    assert words in done.err


def test_nothing_is_suggested_that_is_far_away():
    assert did_you_mean("xyz", ["batch", "ekf"]) == ""


def test_quiet_prints_nothing_and_verbose_the_stages(tmp_path):
    done = call("simulate", "lab", "-o", tmp_path / "lab.mcap", "--quiet")
    assert (done.code, done.out, done.err) == (0, "", "")
    folder = tmp_path / "out"
    done = call("smooth", tmp_path / "lab.mcap", "-o", folder, "--verbose")
    assert done.code == 0
    stages = [line.split(" s  ")[1] for line in done.err.splitlines() if " s  " in line]
    assert stages[0] == "opening"
    assert stages[-1] == "writing"


def test_every_command_has_examples_that_name_it():
    commands = [command.name for command in app.registered_commands]
    assert len(commands) > 10
    for command in commands:
        text = call(command, "--help").out
        assert "Examples:" in text
        assert f"\n    graphslam {command} " in text


def test_the_three_numbers_are_coloured_only_where_colours_are_wanted(
    monkeypatch, tmp_path, capsys
):
    result, _ = room(keyframes=20, beams=31)
    text = show.summary_line(result)
    assert "median position sigma" in text.plain and "chi2/dof" in text.plain
    console = Console(force_terminal=True, color_system="standard", no_color=False)
    with console.capture() as coloured:
        console.print(text)
    assert "\x1b[1;3" in coloured.get()
    monkeypatch.setenv("NO_COLOR", "1")
    console = Console(force_terminal=True)
    with console.capture() as plain:
        console.print(text)
    assert "\x1b[1;3" not in plain.get()  # bold may stay


def test_view_opens_the_report_and_says_where_there_is_none(tmp_path, monkeypatch):
    opened = []
    monkeypatch.setattr(webbrowser, "open", lambda url: opened.append(url) or True)
    with pytest.raises(OutputError, match=r"no report\.html"):
        view.open_report(tmp_path)
    (tmp_path / "report.html").write_text("x")
    assert view.open_report(tmp_path) == tmp_path / "report.html"
    assert opened == [(tmp_path / "report.html").as_uri()]
    monkeypatch.setattr(webbrowser, "open", lambda _url: False)
    with pytest.raises(OutputError, match="no browser"):
        view.open_report(tmp_path)
