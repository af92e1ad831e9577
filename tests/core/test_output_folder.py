"""Files and folders appear whole or not at all, and what was computed is not lost."""

import re
from pathlib import Path

import pytest
from room_log import drive

import graphslam
from graphslam.core.errors import OutputError
from graphslam.core.output_folder import atomic_folder, files_in, identity, write_into


def contents(folder):
    return {
        path.name: path.read_text() if path.is_file() else sorted(contents(path))
        for path in folder.iterdir()
    }


# ---------------------------------------------------------------- files in a folder


def test_a_folder_is_not_replaced_by_a_file_and_is_found_before_the_work(tmp_path):
    (tmp_path / "a").write_text("old")
    (tmp_path / "b").mkdir()
    with (
        pytest.raises(OutputError, match="b: is a folder, so it is not replaced"),
        files_in(tmp_path, ["a", "b"], force=True),
    ):
        raise AssertionError
    with pytest.raises(OutputError, match="is a folder"):
        write_into(tmp_path, [("a", "new"), ("b", "new")], force=True)
    assert contents(tmp_path) == {"a": "old", "b": []}


@pytest.mark.parametrize("failing", range(5))
def test_a_disk_that_refuses_in_between_leaves_what_was_there(tmp_path, monkeypatch, failing):
    """Whichever rename it is: a file moved aside, or a new one moved in, over an old one or not."""
    (tmp_path / "a").write_text("old")
    (tmp_path / "c").write_text("old")
    count = iter(range(99))
    rename = Path.rename

    def refuse(path, target):
        if next(count) == failing:
            raise OSError(28, "disk full")
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", refuse)
    with pytest.raises(OutputError, match="cannot be written: disk full"):
        write_into(tmp_path, [(name, "new") for name in "abc"], force=True)
    assert contents(tmp_path) == {"a": "old", "c": "old"}
    write_into(tmp_path, [(name, "new") for name in "abc"], force=True)
    assert contents(tmp_path) == dict.fromkeys("abc", "new")


def test_a_file_that_the_block_does_not_make_leaves_the_others_as_they_were(tmp_path):
    """Breaks when the new ones are renamed over the old ones one by one."""
    (tmp_path / "a").write_text("old")
    with pytest.raises(OutputError), files_in(tmp_path, ["a", "b"], force=True) as part:
        (part / "a").write_text("new")
    assert contents(tmp_path) == {"a": "old"}


def test_files_that_a_killed_process_had_moved_aside_are_put_back(tmp_path):
    (tmp_path / ".b.4000000.old").write_text("old")
    with pytest.raises(ZeroDivisionError), files_in(tmp_path, ["a", "b"], force=True):
        raise ZeroDivisionError
    assert contents(tmp_path) == {"b": "old"}


# ---------------------------------------------------------------- a folder


def test_what_was_made_stands_beside_a_folder_that_was_touched_meanwhile(tmp_path):
    """A file manager that leaves its file there does not cost the result of hours."""
    target = tmp_path / "out"
    target.mkdir()
    for kept in ("out-new", "out-new-2"):
        with (
            pytest.raises(OutputError, match=re.escape(f"{kept} beside it")) as raised,
            atomic_folder(target, identity(target)) as part,
        ):
            (part / "mine").write_text(kept)
            (target / f".DS_Store{kept}").touch()
        assert str(target) in str(raised.value)
        assert contents(tmp_path / kept) == {"mine": kept}
    assert sorted(contents(tmp_path)) == ["out", "out-new", "out-new-2"]
    assert len(contents(target)) == 2


def test_a_comparison_is_not_lost_where_somebody_made_the_folder_meanwhile(tmp_path):
    """Breaks when the target is checked anew at the end."""
    log, out = drive(tmp_path / "log.mcap", seconds=3), tmp_path / "out"
    with pytest.raises(OutputError, match="out-new beside it"):
        graphslam.compare(
            log,
            ["dead-reckoning"],
            output=out,
            announce=lambda _text: out.mkdir(exist_ok=True),
        )
    assert "report.html" in {path.name for path in (tmp_path / "out-new").iterdir()}
    assert not list(out.iterdir())
