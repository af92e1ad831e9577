"""Code in the documentation: Python runs, commands parse, settings load, pages are up to date."""

import importlib.util
import json
import re
import shutil
import sys
import tomllib
from types import SimpleNamespace

import pytest
import typer
from doc_pages import PAGES, blocks, command_lines
from markdown_it import MarkdownIt
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


@pytest.fixture
def description(monkeypatch, tmp_path):
    """A function that gives the description for the package index, with more lines in
    pyproject.toml if wanted."""

    def made(lines=""):
        for name in ("README.md", "setup.py"):
            shutil.copy(ROOT / name, tmp_path / name)
        project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
        assert "[project.urls]\n" in project
        project = project.replace("[project.urls]\n", f"[project.urls]\n{lines}")
        (tmp_path / "pyproject.toml").write_text(project, encoding="utf-8")
        found = {}
        build = SimpleNamespace(setup=lambda **given: found.update(given))
        monkeypatch.setitem(sys.modules, "setuptools", build)
        spec = importlib.util.spec_from_file_location("build", tmp_path / "setup.py")
        spec.loader.exec_module(importlib.util.module_from_spec(spec))
        assert found["long_description_content_type"] == "text/markdown"
        assert len(found["long_description"]) > 5000
        return found["long_description"]

    return made


def links_on_the_index(text):
    """What a page of the package index leads to or shows: its own renderer, as it is called there.

    `make extras-test` has it; without it the Markdown is read as common Markdown.
    """
    if importlib.util.find_spec("readme_renderer"):
        from readme_renderer.markdown import render

        page = render(text, variant="GFM")
        assert page, "the index would refuse it"
    else:
        page = MarkdownIt().render(text)
    links = re.findall(r'(?:href|src)="([^"]*)"', page)
    return [link for link in links if not link.startswith("#user-content-")]  # its own headings


def test_the_description_on_the_package_index_has_no_dead_link(description):
    """Breaks where a link of the README is taken over as it is, in whatever way it is written."""
    links = links_on_the_index(description())
    assert links and all(link.startswith("https://") for link in links)
    assert any(
        not link.startswith("https://")
        for link in links_on_the_index((ROOT / "README.md").read_text(encoding="utf-8"))
    )


def test_with_a_repository_its_links_lead_to_files_that_are_there(description):
    """Of an address that does not exist: the day there is one, this is all that changes."""
    base = "https://example.org/somebody/repository"
    links = links_on_the_index(description(f'Repository = "{base}"\n'))
    inside = [link.removeprefix(f"{base}/blob/main/") for link in links if link.startswith(base)]
    assert len(inside) > 15
    assert all((ROOT / link.partition("#")[0]).exists() for link in inside)


def test_addresses_of_the_project_are_of_the_distribution_and_no_repository_is_made_up():
    """One line a viewer of the metadata can follow: the page of its own name on the index."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["urls"]["Package index"] == f"https://pypi.org/project/{project['name']}/"
    assert all(url.startswith("https://") for url in project["urls"].values())


def test_the_citation_has_the_version():
    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_every_page_with_python_has_a_test_that_runs_it():
    """Those of test_public_api and those above."""
    pages = {page.name for page in PAGES if blocks(page, "python")}
    assert pages == {"README.md", "change-detection.md", "live.md", "python.md"}
