"""The documentation says what the program does."""

import ast
import functools
import importlib.util
import re

import pytest
from paths import ROOT

from graphslam.cli.commands import app
from graphslam.core.config import Config

#: the thesis' equations by chapter: the first and the last number
EQUATIONS = {3: (1, 25), 4: (1, 38), 5: (1, 14)}
DASH = "\N{EN DASH}"


def test_the_configuration_page_is_what_the_configuration_says():
    spec = importlib.util.spec_from_file_location("configuration", ROOT / "docs/configuration.py")
    generator = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generator)
    assert generator.PAGE.read_text(encoding="utf-8") == generator.page(), "run `make docs`"


def test_the_readme_has_every_command_and_only_links_that_lead_somewhere():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for command in app.registered_commands:
        assert f"graphslam {command.name} " in readme
    targets = [part.split(")")[0] for part in readme.split("](")[1:]]
    assert targets
    for target in targets:
        assert target.startswith("https://") or (ROOT / target).exists(), target


def thesis_rows():
    """Cells of each row of docs/thesis.md: of the thesis, here, test, deviation."""
    text = (ROOT / "docs/thesis.md").read_text(encoding="utf-8")
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| ")]
    assert all(len(row) == 4 for row in rows)
    return rows[1:]


def equations(cell):
    """The numbers, (chapter, number), that a row begins with; a section's says so or has three."""
    listed = re.match(rf"(?:\d\.\d+(?:{DASH}\d\.\d+)?(?:, )?)+(?![.\d])", cell)
    for part in re.split(", ?", listed[0].strip(", ")) if listed else []:
        (chapter, first), *last = (map(int, end.split(".")) for end in part.split(DASH))
        yield from ((chapter, n) for n in range(first, (list(last[0])[1] if last else first) + 1))


def test_every_equation_of_the_thesis_is_somewhere():
    found = {number for cell, *_ in thesis_rows() for number in equations(cell)}
    wanted = {(c, n) for c, (first, last) in EQUATIONS.items() for n in range(first, last + 1)}
    assert wanted - found == set()


def exists(name):
    """Whether a dotted name is an object of the package, or a key of the configuration."""
    parts = name.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(["graphslam", *parts[:cut]]))
            functools.reduce(getattr, parts[cut:], found)
        except (ImportError, AttributeError):
            continue
        return True
    try:
        functools.reduce(getattr, parts, Config())
    except AttributeError:
        return False
    return True


@pytest.mark.parametrize("cells", thesis_rows(), ids=lambda cells: cells[0][:30])
def test_what_the_thesis_page_names_is_there(cells):
    """Functions, settings and tests; a file of tests where many hold a row."""
    names = re.findall(r"`([a-z_0-9]+(?:\.\w+)+)(?:\(.*?\))?`", cells[1])
    assert names or "scenario" in cells[1] or "`MODELS`" in cells[1] or "front_end" in cells[1]
    assert [name for name in names if not exists(name)] == []
    tests = re.findall(r"`(test_\w+)\.(\w+)`", cells[2])
    assert tests or cells[2].startswith("as before")
    for module, name in tests:
        (path,) = (ROOT / "tests").rglob(f"{module}.py")
        functions = {
            node.name
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(node, ast.FunctionDef)
        }
        assert name == "py" or name in functions, f"{module}.{name}"
