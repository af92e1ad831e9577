"""The commands on the pages of the documentation are run as printed, on small logs.

All commands of a page run one after the other in one folder, which holds the files that the page
takes for given. An output that is there already is replaced: a page shows several ways to make one.
Of experiments one run is made. Benchmarks, which take minutes to
hours, are begun here, their options read; test_benchmarks.py runs them on small input.
`make demo` is run by .ci/run.
"""

import argparse
import runpy
import sys
import webbrowser
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import victoria_park
from command_line import call
from doc_pages import PAGES, command_lines
from paths import ROOT
from room_log import START_NS, S, drive, true_pose

from graphslam.importers import IMPORTERS
from graphslam.simulation import load_scenario, simulate

SECONDS = 12
#: what takes more than a few seconds even when it is small
LONG = {
    "clusters.md", "commands.md", "ekf-versus-smoothing.md", "experiments.md", "known-maps.md",
    "sessions.md", "several-robots.md",
}  # fmt: skip
#: values of placeholders in a command
PLACES = {"LOG.mcap": "drive.mcap", "DIR": "result"}


def room(path, seconds=SECONDS):
    """A drive in a room whose scans are at the stamps that `relations` names."""
    # of equal recordings nothing can have changed
    return drive(path, seconds=seconds, seed=sum(path.name.encode()))


def relations(path):
    """Scans two seconds apart, not moved: an error of a relation is no error of the command."""
    stamps = [START_NS + k * S // 10 + 7 for k in range(0, 10 * SECONDS, 20)]
    texts = [f"{stamp // S}.{stamp % S:09d}" for stamp in stamps]
    lines = [f"{a} {b} 0 0 0 0 0 0" for a, b in pairwise(texts)]
    path.write_text("\n".join(lines) + "\n")


def trees(path):
    """The beginning of the log of Victoria Park."""
    path.parent.mkdir(exist_ok=True)
    part = path.with_suffix(".txt")
    with Path(victoria_park.SOURCE).open() as lines:
        part.write_text("".join(line for line in lines if max(map(int, line.split()[1:3])) < 200))
    IMPORTERS["isam"](part, path)


def two_rooms(path):
    path.mkdir()
    for name in ("morning", "evening"):
        room(path / f"{name}.mcap")


def of_the_room(path):
    """The result of a drive in a room."""
    log = room(path.with_name(f"{path.name}-log.mcap"))
    assert call("smooth", log, "-o", path, "--quiet").code == 0


def day(path):
    """A drive in a building large enough to be recognised."""
    simulate(load_scenario("office-loop"), path, seed=len(path.stem))


def of_the_day(path):
    """Its result."""
    day(path.with_suffix(".mcap"))
    assert call("smooth", path.with_suffix(".mcap"), "-o", path, "--quiet").code == 0


def clf(path):
    """A CARMEN log."""
    beams = " ".join(["4.0"] * 180)
    lines = [
        f"FLASER 180 {beams} {0.1 * k:.1f} 0 0 {0.1 * k:.1f} 0 0 {k}.0 host {k}.0"
        for k in range(20)
    ]
    path.write_text("\n".join(lines) + "\n")


def true_path(path):
    """Where the robot of `room` was."""
    lines = [
        f"{START_NS // S + k}.{half}23456789 {pose_line(k + (half - 1) / 10)}"
        for k in range(SECONDS)
        for half in (1, 6)
    ]
    path.write_text("\n".join(lines) + "\n")


def pose_line(seconds):
    x, y, heading = true_pose(float(seconds))
    return f"{x} {y} 0 0 0 {np.sin(heading / 2)} {np.cos(heading / 2)}"


#: files that pages take for given -> what makes them
GIVEN = {
    "drive.mcap": room,
    "before.mcap": room,
    "after.mcap": room,
    "intel.relations": relations,
    "recordings": two_rooms,
    "result": of_the_room,
    "morning": of_the_room,
    "evening": of_the_room,
    "truth.tum": true_path,
    "intel.clf": clf,
    "recording.mcap": room,
    "monday": of_the_day,
    "monday.mcap": day,
    "tuesday.mcap": day,
    "wednesday.mcap": day,
    "out/victoria_park.mcap": trees,
    "logs": lambda path: path.symlink_to(ROOT / "logs"),
}


def runnable(page):
    """The commands of a page, but for those that need a cluster: tests/cluster has one."""
    found = [words for words in command_lines(page) if words[0] == "graphslam"]
    return [words for words in found if "--scheduler" not in words]


def as_param(page):
    marks = pytest.mark.slow if page.name in LONG else ()
    return pytest.param(page, marks=marks, id=str(page.relative_to(ROOT)))


@pytest.mark.parametrize("page", [as_param(page) for page in PAGES if runnable(page)])
def test_commands_on_a_page_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(webbrowser, "open", lambda _url: True)
    commands = [[PLACES.get(word, word) for word in words[1:]] for words in runnable(page)]
    made = set()
    for words in commands:
        target = words[words.index("-o") + 1] if "-o" in words else None
        for name, make in GIVEN.items():
            needs = any(
                word == name or word.startswith(f"{name}/") or word.endswith(f"={name}")
                for word in words
            )
            if needs and name != target and not Path(name).exists():
                make(Path(name))
                made.add(name)
        if words[0] == "experiment":
            words += ["--runs", "1"]  # the last one counts
        if target in made and "--force" not in words:
            words.append("--force")
        done = call(*words, "--quiet")
        assert done.code == 0, f"{' '.join(words)}: {done.err}"
        made |= {target} - {None}
        assert target is None or Path(target).exists()


class NothingRunError(Exception):
    """The options of a script are taken; nothing was run."""


@pytest.mark.parametrize(
    ("page", "words"),
    [
        pytest.param(page, words[1:], id=f"{page.name}: {' '.join(words[1:])}")
        for page in PAGES
        for words in command_lines(page)
        if words[0] == "python" and words[1] != "-m"
    ],
)
def test_benchmarks_on_a_page_take_their_options(page, words, monkeypatch):
    """Breaks when a script no longer starts, or its options have other names."""
    parse = argparse.ArgumentParser.parse_args

    def taken(parser, *args, **options):
        parse(parser, *args, **options)
        raise NothingRunError

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", taken)
    monkeypatch.setattr(sys, "argv", [str(ROOT / words[0]), *words[1:]])
    with np.printoptions(), pytest.raises(NothingRunError):
        runpy.run_path(str(ROOT / words[0]), run_name="__main__")
