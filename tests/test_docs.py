"""The documentation says what the program does."""

import ast
import functools
import importlib.util
import re

import pytest
from paths import ROOT

import graphslam
from graphslam.cli.commands import app
from graphslam.core.config import Config, RobotConfig
from graphslam.core.config_io import RENAMED_KEYS

#: the thesis' equations by chapter: the first and the last number
EQUATIONS = {3: (1, 25), 4: (1, 38), 5: (1, 14)}
DASH = "\N{EN DASH}"


def test_the_configuration_page_is_what_the_configuration_says():
    spec = importlib.util.spec_from_file_location("configuration", ROOT / "docs/configuration.py")
    generator = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generator)
    assert generator.PAGE.read_text(encoding="utf-8") == generator.page(), "run `make pages`"


def test_the_readme_has_every_command_and_only_links_that_lead_somewhere():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for command in app.registered_commands:
        assert f"graphslam {command.name} " in readme
    targets = [part.split(")")[0] for part in readme.split("](")[1:]]
    assert targets
    for target in targets:
        assert target.startswith("https://") or (ROOT / target).exists(), target


def test_every_public_name_is_in_the_reference():
    page = (ROOT / "docs/api.md").read_text(encoding="utf-8")
    named = set(re.findall(r"^\.\. auto\w+:: graphslam\.(\w+)$", page, flags=re.M))
    assert named == set(graphslam.__all__) - {"__version__"}


def test_the_readme_names_every_public_function():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    names = [name for name in graphslam.__all__ if name[0].islower()]
    assert [name for name in names if f"`{name}`" not in readme] == []


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


def test_every_schema_that_is_read_names_its_test():
    """Each row of the table schema, encoding, container in docs/logs.md: tests that there are."""
    text = (ROOT / "docs/logs.md").read_text(encoding="utf-8")
    table = text.split("| tested in |\n")[1].split("\n\n")[0].splitlines()[1:]
    files = [
        *(ROOT / "tests/logs").glob("test_*.py"),
        *(ROOT / "tests/importers").glob("test_*.py"),
    ]
    tests = "".join(path.read_text(encoding="utf-8") for path in files)
    assert table
    for row in table:
        named = re.findall(r"`(test_\w+)`", row.split(" | ")[-1])
        assert named, row
        assert all(f"def {name}(" in tests for name in named), row


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


def functions_of_test(module):
    """Names of the functions of a file of tests, in classes too."""
    (path,) = (ROOT / "tests").rglob(f"{module}.py")
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


def is_there(name):
    """Whether what a page calls by a name in code quotes exists; None if that is no name of ours.

    Names are files (``core/config.py``, ``benchmarks/horizon.py``), tests (``test_ekf.py``,
    ``test_ekf.test_motion_jacobians``), objects of the package (``logs.open_logs``) and settings
    (``ekf.error``, ``robots.NAME.axle_m``, ``start.from_truth=true``).
    """
    if test := re.fullmatch(r"(test_\w+)\.(\w+)", name):
        module, function = test.groups()
        paths = list((ROOT / "tests").rglob(f"{module}.py"))
        return len(paths) == 1 and (function == "py" or function in functions_of_test(module))
    if re.fullmatch(r"[\w*]+(/[\w*]+)+\.(py|md|toml)", name):
        return any(any(folder.glob(name)) for folder in (ROOT, ROOT / "graphslam"))
    if robot := re.fullmatch(r"robots\.NAME\.(\w+)", name):
        return hasattr(RobotConfig(), robot[1])
    dotted = re.fullmatch(r"(?:graphslam\.)?(([a-z]\w*)(?:\.\w+)+)(?:\(.*\)| ?=.*)?", name)
    if (
        dotted
        and not name.endswith(FILES)
        and (dotted[2] in PACKAGES or hasattr(Config(), dotted[2]))
    ):
        return exists(dotted[1])
    return None


PACKAGES = {path.parent.name for path in (ROOT / "graphslam").glob("*/__init__.py")}
#: names that end so are of files that a user has
FILES = ("py", "csv", "html", "json", "jsonl", "mcap", "md", "npz", "pgm", "tum", "yaml")
PAGES = [
    *sorted(set((ROOT / "docs").glob("*.md")) - {ROOT / "docs/configuration.md"}),
    *(
        ROOT / name
        for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "benchmarks/README.md")
    ),
]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_what_a_page_names_is_there(page):
    """Files, tests, functions and settings by their current names; links to pages that exist."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    wrong = [name for name in re.findall(r"`([^`\n]+)`", text) if is_there(name) is False]
    assert not wrong, f"{page.name}: {', '.join(wrong)}"
    links = [link for link in re.findall(r"\]\(([^)#\s]+)", text) if not link.startswith("http")]
    wrong = [link for link in links if not (page.parent / link).exists()]
    assert not wrong, f"{page.name}: {', '.join(wrong)}"


def test_the_path_of_a_scan_names_modules_and_what_is_in_them():
    """Each line of the tree of calls: a file, and a function or class that it defines."""
    text = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    tree = re.search(r"^## The path of a scan.*?^```\n(.*?)^```", text, flags=re.M | re.S)[1]
    lines = [re.match(r" *([\w/]+\.py): (\w+) ", line) for line in tree.splitlines()]
    assert len(lines) > 30 and all(lines)
    for path, name in (line.groups() for line in lines):
        body = ast.parse((ROOT / "graphslam" / path).read_text(encoding="utf-8")).body
        assert name in {getattr(node, "name", "") for node in body}, f"{path}: {name}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_keys_of_the_summary_are_not_modules(page):
    """What a page says is "in summary.json", or that it "has", is a key of docs/formats.md."""
    keys = re.findall(r"^\| `(\w+)`", (ROOT / "docs/formats.md").read_text("utf-8"), flags=re.M)
    text = page.read_text(encoding="utf-8")
    names = re.findall(r"`([^`\n]+)` in\s`?summary\.json", text)
    names += re.findall(r"`?summary\.json`? (?:has|counts)\s[^.;,]*?`([^`\n]+)`", text)
    wrong = [n for n in names if n.split(".")[0] not in keys or ("." in n and exists(n))]
    assert not wrong, f"{page.name}: {', '.join(wrong)}"


@pytest.mark.parametrize(("old", "new"), RENAMED_KEYS.items())
def test_the_changelog_has_every_renamed_setting(old, new):
    assert f"| {old} | `{new}` |" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("script", sorted((ROOT / "benchmarks").glob("*.py")))
def test_the_table_of_benchmarks_has_every_script(script):
    assert f"`{script.name}`" in (ROOT / "benchmarks/README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("cells", thesis_rows(), ids=lambda cells: cells[0][:30])
def test_a_row_of_the_thesis_page_names_what_implements_it_and_a_test(cells):
    names = re.findall(r"`([a-z_0-9]+(?:\.\w+)+)(?:\(.*?\))?`", cells[1])
    assert names or "scenario" in cells[1] or "`MODELS`" in cells[1] or "front_end" in cells[1]
    assert re.findall(r"`(test_\w+)\.(\w+)`", cells[2]) or cells[2].startswith("as before")
