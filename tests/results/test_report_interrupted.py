"""What stops a command that writes a report leaves no partial folder, and the old one as it was."""

import errno
from pathlib import Path

import pytest
from synthetic_results import room

from graphslam.core.errors import OutputError
from graphslam.results.folder import save
from graphslam.results.report import render

PROBLEMS = [
    KeyboardInterrupt(),
    OSError(errno.ENOSPC, "No space left on device"),
    OSError(errno.EROFS, "Read-only file system"),
]


@pytest.fixture(scope="module")
def result():
    return room(keyframes=10, beams=31)[0]


def content(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.mark.parametrize("problem", PROBLEMS, ids=str)
@pytest.mark.parametrize("replacing", [False, True])
def test_a_report_that_cannot_be_finished_leaves_nothing(
    problem, replacing, result, tmp_path, monkeypatch
):
    target = tmp_path / "out"
    if replacing:
        save(result, target, force=False, report=lambda _result: "the old report")
    before = content(tmp_path)
    write = Path.write_text

    def half_written(path, text, **options):
        if path.name != "report.html":
            return write(path, text, **options)
        write(path, text[: len(text) // 2], **options)
        raise problem

    monkeypatch.setattr(Path, "write_text", half_written)
    with pytest.raises((OutputError, KeyboardInterrupt)):
        save(result, target, force=True, report=render)
    assert content(tmp_path) == before
    assert [path.name for path in tmp_path.iterdir()] == ["out"] * replacing


def test_ctrl_c_while_the_report_is_drawn_leaves_nothing(result, tmp_path):
    def interrupted(_result):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        save(result, tmp_path / "out", force=False, report=interrupted)
    assert list(tmp_path.iterdir()) == []
