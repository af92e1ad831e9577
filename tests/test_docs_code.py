"""Code in the documentation: Python runs, commands parse, settings load, pages are up to date."""

import importlib.util
import json
import re
import sys
import tomllib
from types import SimpleNamespace

import pytest
import typer
from doc_pages import PAGES, blocks, command_lines
from paths import ROOT
from room_log import drive

from graphslam import __version__
from graphslam.cli.commands import app
from graphslam.core.config_io import load_config


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_on_a_page_are_commands_of_the_program(page):
    """Every option and value is taken by the parser; scripts and targets of make exist."""
    group = typer.main.get_command(app)
    targets = (ROOT / "Makefile").read_text(encoding="utf-8")
    for program, *words in command_lines(page):
        if program == "make":
            for target in words:
                assert "=" in target or re.search(rf"^{target}:", targets, flags=re.M), target
        elif program == "python":
            known = words[0] == "-m" or (ROOT / words[0]).exists()
            assert known, f"{page.name}: python {' '.join(words)}"
        elif "--scheduler" in words and importlib.util.find_spec("distributed") is None:
            continue  # `make extras-test` has Dask
        elif not set(words) & {"-h", "--help", "FORMAT", "SCENARIO"} and "..." not in str(words):
            command = group.commands[words[0]]
            try:
                command.make_context(words[0], list(words[1:]))
            except Exception as error:
                assert getattr(error, "exit_code", None) == 2, repr(error)
                pytest.fail(f"{page.name}: {' '.join(words)}: {error}")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_settings_on_a_page_are_settings(page, tmp_path):
    for block in blocks(page, "toml"):
        tree = tomllib.loads(block)
        if set(tree) <= set(load_config(None, ()).__dataclass_fields__):
            (tmp_path / "page.toml").write_text(block)
            load_config(tmp_path / "page.toml", ())


def test_python_of_the_page_on_python_runs(tmp_path, monkeypatch, capsys):
    """Its blocks one after the other, on a short log."""
    monkeypatch.chdir(tmp_path)
    drive(tmp_path / "drive.mcap", seconds=8)
    found = blocks(ROOT / "docs/python.md", "python")
    assert len(found) == 3
    for block in found:
        exec(block, {"__name__": "__main__"})
    out = capsys.readouterr().out
    assert "landmarks;" in out and "occupied cells:" in out
    assert len(re.findall(r"^0\.\d \d\.\d+", out, flags=re.M)) == 2
    assert {"map.yaml", "result.mcap"} <= {p.name for p in (tmp_path / "result").iterdir()}


def test_python_of_the_page_on_live_estimates_runs(tmp_path, monkeypatch):
    """Its session, on a short log."""
    monkeypatch.chdir(tmp_path)
    drive(tmp_path / "drive.mcap", seconds=5)
    (block,) = blocks(ROOT / "docs/live.md", "python")
    found = {}
    exec(block, found)
    assert found["estimate"].cov.shape == (3, 3)
    assert abs(found["x"]) > 0.1


def test_the_tutorial_is_clean_and_its_code_parses():
    """Without outputs, so that a change of it is a change of its text; .ci/run executes it."""
    book = json.loads((ROOT / "docs/tutorial.ipynb").read_text(encoding="utf-8"))
    code = [cell for cell in book["cells"] if cell["cell_type"] == "code"]
    assert len(code) > 8
    for cell in code:
        assert cell["outputs"] == [] and cell["execution_count"] is None
        compile("".join(cell["source"]), "tutorial", "exec")


def test_pages_made_from_the_program_are_up_to_date():
    spec = importlib.util.spec_from_file_location("commands", ROOT / "docs/commands.py")
    generator = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generator)
    made = generator.commands(), generator.messages()
    for name, text in zip(generator.PAGES, made, strict=True):
        page = (ROOT / "docs" / name).read_text(encoding="utf-8")
        assert page == text, f"{name}: run `make pages`"


def test_every_page_is_in_the_index_of_the_site():
    listed = set((ROOT / "docs/index.md").read_text(encoding="utf-8").split())
    missing = {p.stem for p in (ROOT / "docs").glob("*.md")} - listed - {"index"}
    assert not missing


def test_the_description_on_the_package_index_has_no_dead_link(monkeypatch):
    found = {}
    build = SimpleNamespace(setup=lambda **given: found.update(given))
    monkeypatch.setitem(sys.modules, "setuptools", build)
    spec = importlib.util.spec_from_file_location("build", ROOT / "setup.py")
    spec.loader.exec_module(importlib.util.module_from_spec(spec))
    text = found["long_description"]
    assert len(text) > 5000
    links = re.findall(r"\]\(([^)]+)\)", text)
    assert links and all(link.startswith("https://") for link in links)


def test_the_citation_has_the_version():
    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_every_page_with_python_has_a_test_that_runs_it():
    """Those of test_public_api and those above."""
    pages = {page.name for page in PAGES if blocks(page, "python")}
    assert pages == {"README.md", "change-detection.md", "live.md", "python.md"}
