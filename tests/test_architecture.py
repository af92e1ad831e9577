"""The house rules: who may import whom, what an import may do, what every function must say."""

import ast
import re
import subprocess
import sys
import typing
from functools import cache
from pathlib import Path

import pytest

import graphslam
from graphslam.core.config import BackendConfig, FrontEndConfig
from graphslam.estimation.backends import BACKENDS
from graphslam.perception.front_ends import FRONT_ENDS

ROOT = Path(graphslam.__file__).parent

#: The packages, lowest first. An import goes to a lower one, or stays in its package. This is the
#: only list; docs/architecture.md prints it.
PACKAGES = (
    "core",
    "logs",
    "importers",
    "simulation",
    "perception",
    "odometry",
    "estimation",
    "mapping",
    "multi_robot",
    "pipeline",
    "verdict",
    "scan_smoothing",
    "sighting_smoothing",
    "slam",
    "results",
    "live",
    "change_detection",
    "evaluation",
    "campaigns",
    "cli",
)
#: of all pairs of packages, the most of which one imports the other; fifteen larger packages had
#: 0.63
MOST_ARROWS = 0.55
#: most lines of a module: what is longer has more than one responsibility
MOST_LINES = 450

#: library -> the packages that may import it: everything else stays free of its types and its cost
KEEPERS = {
    "dask": {"campaigns"},
    "distributed": {"campaigns"},  # only with the extra `cluster`
    "cv2": {"perception", "results", "change_detection"},
    "gtsam": {"estimation"},
    "matplotlib": set(),  # takes half a second to import; `plot` imports it by its name
    "mcap": {"logs"},
    "rerun": {"results"},  # 170 MB, for who asked for it
    "rich": {"cli"},
    "rosbags": {"logs"},
    "typer": {"cli"},
}

FILES = sorted(ROOT.rglob("*.py"))


def package_of(path):
    """First part of the module's name below the root; of a module at the root, its name."""
    return path.relative_to(ROOT).with_suffix("").parts[0]


@cache
def tree_of(path):
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


@cache
def nodes_of(path):
    """All nodes of a file: most rules here look at all of all files."""
    return tuple(ast.walk(tree_of(path)))


@cache
def imports(path):
    """(line, dotted name) of everything imported anywhere in a file, inside functions as well."""
    return tuple(_imports(path))


def _imports(path):
    for node in nodes_of(path):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative import"
            if node.module == "graphslam":
                yield from ((node.lineno, f"graphslam.{alias.name}") for alias in node.names)
            else:
                yield node.lineno, node.module


def place(path, line):
    return f"{path.relative_to(ROOT.parent)}:{line}"


# ------------------------------------------------------------ packages


def package_imports():
    """(file, line, importing package, imported package) of every import between packages."""
    for path in FILES:
        here = package_of(path)
        for line, name in imports(path):
            parts = name.split(".")
            there = parts[1] if parts[0] == "graphslam" and len(parts) > 1 else here
            if there not in (here, "__version__"):
                yield path, line, here, there


def test_everything_is_in_a_package():
    """A module at the root would belong nowhere; a package that is gone leaves the list."""
    assert {path.name for path in ROOT.glob("*.py")} == {"__init__.py", "__main__.py"}
    assert {path.parent.name for path in ROOT.glob("*/__init__.py")} == set(PACKAGES)


def test_imports_go_only_downwards():
    """Breaks with the first import upwards or sideways: `core` that knows a robot, a back end
    that knows the pipeline. No cycle between packages can hide in it either."""
    wrong = [
        f"{place(path, line)} {here} imports {there}"
        for path, line, here, there in package_imports()
        if here in PACKAGES and PACKAGES.index(there) >= PACKAGES.index(here)
    ]
    assert not wrong, "\n".join(wrong)


def test_only_the_command_line_uses_the_public_interface():
    """`graphslam/__init__.py` is above all packages: what it defines is for callers, and an import
    of it from below would be an import upwards."""
    wrong = [
        place(path, line)
        for path in FILES
        for line, name in imports(path)
        if package_of(path) not in ("cli", "__init__", "__main__")
        and name.split(".")[0] == "graphslam"
        and [*name.split("."), ""][1] not in (*PACKAGES, "__version__")
    ]
    assert not wrong, "\n".join(wrong)


def test_few_packages_know_each_other():
    """Prints how many pairs of packages import each other: what someone has to keep in mind."""
    arrows = {(here, there) for _, _, here, there in package_imports() if here in PACKAGES}
    pairs = len(PACKAGES) * (len(PACKAGES) - 1) // 2
    print(f"{len(arrows)} import arrows between {pairs} pairs of packages")
    assert len(arrows) <= MOST_ARROWS * pairs


def test_the_architecture_page_prints_this_order():
    page = (ROOT.parent / "docs/architecture.md").read_text(encoding="utf-8")
    assert " < ".join(PACKAGES) in " ".join(page.replace("`", "").split())


def test_no_module_is_long():
    long = {
        str(path.relative_to(ROOT)): lines
        for path in FILES
        if (lines := len(path.read_text(encoding="utf-8").splitlines())) > MOST_LINES
    }
    assert not long


@pytest.mark.parametrize("library", sorted(KEEPERS))
def test_only_its_keepers_import_a_library(library):
    """So that mcap stays in `logs`, gtsam in `estimation`."""
    wrong = [
        f"{place(path, line)} imports {name}"
        for path in FILES
        for line, name in imports(path)
        if name.split(".")[0] == library and package_of(path) not in KEEPERS[library]
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    "module", ["graphslam", "graphslam.slam.smooth", "graphslam.results.folder"]
)
def test_importing_the_library_is_quiet_and_light(module):
    """A script that smooths pays neither for plots nor for a command line, and importing writes
    nothing. In a process of its own: this one has imported everything."""
    code = f"import sys, {module}; print(*sorted({{m.split('.')[0] for m in sys.modules}}))"
    command = [sys.executable, "-W", "error::ImportWarning", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    loaded = set(done.stdout.split())
    assert not loaded & {"matplotlib", "typer", "rich", "click"}
    assert done.stderr == ""
    assert len(done.stdout.splitlines()) == 1
    if module == "graphslam":
        assert not loaded & {"numpy", "gtsam", "cv2", "scipy", "mcap"}


# ------------------------------------------------------------ tables


@pytest.mark.parametrize(
    ("table", "kind"), [(BACKENDS, BackendConfig), (FRONT_ENDS, FrontEndConfig)]
)
def test_the_settings_offer_what_the_table_has(table, kind):
    """Adding an estimator or a front end is one line in its table and its name in the settings."""
    assert type(table) is dict
    assert set(typing.get_args(typing.get_type_hints(kind)["name"])) == set(table)


# ------------------------------------------------------------ docstrings


def public(path):
    """(qualified name, node, its class or None) of every public definition of a file."""

    def walk(node, owner, prefix):
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                if child.name.startswith("_"):
                    continue
                yield f"{prefix}{child.name}", child, owner
                if isinstance(child, ast.ClassDef):
                    yield from walk(child, child, f"{prefix}{child.name}.")

    yield from walk(tree_of(path), None, "")


def test_every_public_definition_has_a_docstring():
    missing = [
        f"{place(path, node.lineno)} {name}"
        for path in FILES
        for name, node, _ in public(path)
        if not ast.get_docstring(node)
    ]
    missing += [str(path) for path in FILES if not ast.get_docstring(tree_of(path))]
    assert not missing, "\n".join(missing)


ARRAY = re.compile(r"\b(Array|IntArray|BoolArray|NDArray|ndarray)\b")
#: (3,), (n, 2), (..., k), (D, D): or a unit; or a reference to where it is said
SHAPE = re.compile(r"\((\.\.\.|[A-Za-z]{1,2}|\d)( ?[-+*] ?\d)?(,| \d)[^)]*\)")
UNIT = re.compile(r"\b(m|rad|ns|s|m²|rad²|metres|rows)\b")
REFERENCE = re.compile(r"[Ss]ee `")


def speaks_of_arrays(node):
    """Whether a function takes or returns arrays, by its annotations."""
    arguments = node.args
    every = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    notes = [a.annotation for a in every] + [node.returns]
    return any(ARRAY.search(ast.unparse(note)) for note in notes if note is not None)


def test_docstrings_about_arrays_give_a_shape_or_a_unit():
    """A heuristic: in its own docstring, its class's or the one that it refers to. "Array" alone
    says nothing about what goes in."""
    missing = []
    for path in FILES:
        for name, node, owner in public(path):
            if isinstance(node, ast.ClassDef) or not speaks_of_arrays(node):
                continue
            text = ast.get_docstring(node) or ""
            if owner is not None:
                text += ast.get_docstring(owner) or ""
            if not (SHAPE.search(text) or UNIT.search(text) or REFERENCE.search(text)):
                missing.append(f"{place(path, node.lineno)} {name}")
    assert not missing, "\n".join(missing)


def test_the_shape_heuristic_knows_a_shape_when_it_sees_one():
    """So that the test above can fail."""
    for text in ("poses (n, 3)", "``(..., 3)``", "pose (3,)", "(D, D)", "(k, 3, 3)", "ends (2, 2)"):
        assert SHAPE.search(text), text
    for text in ("an array", "the pose (of the robot)", "everything (see above)"):
        assert not SHAPE.search(text), text


def test_functions_that_raise_our_errors_say_so():
    """A public function with a `raise` of ours in its own body documents it (Raises:)."""
    ours = {"LogError", "ConfigError", "EstimationError", "OutputError", "ScenarioError"}
    missing = []
    for path in FILES:
        if package_of(path) == "cli":
            continue
        for name, node, _ in public(path):
            if isinstance(node, ast.ClassDef):
                continue
            raised = {
                call.func.id
                for stop in ast.walk(node)
                if isinstance(stop, ast.Raise) and isinstance(call := stop.exc, ast.Call)
                and isinstance(call.func, ast.Name)
            }  # fmt: skip
            text = ast.get_docstring(node) or ""
            if raised & ours and "Raises:" not in text and not re.search(r"[Ss]ee `", text):
                missing.append(f"{place(path, node.lineno)} {name} raises {raised & ours}")
    assert not missing, "\n".join(missing)


#: names in docstrings and comments that are not of this package: libraries, values of settings
FOREIGN = {"scipy.special", "scipy.stats", "gtsam.readG2o", "readG2o", "load2D", "mcap", "rosbags"}


def test_names_in_docstrings_and_comments_exist():
    """A name in single backticks is a module, an identifier or a value of a setting: a renamed
    function must not live on in what is written about it."""
    known = {part for name in FOREIGN for part in name.split(".")} | {"toml"}
    for path in FILES:
        known |= set(path.relative_to(ROOT.parent).with_suffix("").parts)
        for node in nodes_of(path):
            for field in ("id", "attr", "name", "arg"):
                value = getattr(node, field, None)
                known |= set(value.split(".")) if isinstance(value, str) else set()
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                known |= {node.value} if node.value.isidentifier() else set()
    wrong = [
        f"{place(path, number)} `{name}`"
        for path in FILES
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        for name in re.findall(r"(?<!`)`([A-Za-z_][\w.]*)`(?!`)", line)
        if not set(name.split(".")) <= known
    ]
    assert not wrong, "\n".join(wrong)


def defined_in(path):
    """Names that a module defines itself, those that it imports left out."""
    names = set()
    for node in tree_of(path).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            names.add(node.name)
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names |= {n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)}
    return names


def test_full_names_in_docstrings_are_those_of_where_something_is_defined():
    """`graphslam.room.module.name` leads to the definition, not to a module that imports it. What
    `__init__` offers is taken as it is."""
    wrong = []
    for path in FILES:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            for room, module, name in re.findall(r"`graphslam\.(\w+)\.(\w+)\.(\w+)", line):
                file = ROOT / room / f"{module}.py"
                if not file.exists() or name not in defined_in(file):
                    wrong.append(f"{place(path, number)} {room}.{module}.{name}")
    assert not wrong, "\n".join(wrong)


# ------------------------------------------------------------ below the command line


def below_cli():
    return [path for path in FILES if package_of(path) not in ("cli", "__main__")]


def test_nothing_prints_or_exits_below_the_command_line():
    """`--json` promises one object on stdout, and a library never ends its caller's process."""
    wrong = []
    for path in below_cli():
        for node in nodes_of(path):
            if not isinstance(node, ast.Call):
                continue
            name = ast.unparse(node.func)
            if name == "os._exit" and package_of(path) == "core":
                continue  # the process that it forked
            if name in ("print", "exit", "quit", "sys.exit", "os._exit", "breakpoint"):
                wrong.append(f"{place(path, node.lineno)} {name}()")
            if name.startswith(("sys.stdout", "sys.stderr", "warnings.warn")):
                wrong.append(f"{place(path, node.lineno)} {name}()")
    assert not wrong, "\n".join(wrong)


def test_no_broad_except_below_the_command_line():
    """It would turn a defect of ours into a story about the user's data.

    A comparison calls a defect of one back end a defect, and keeps the rows of the others.
    """
    wrong = []
    for path in below_cli():
        if path == ROOT / "evaluation" / "compare_backends.py":
            continue
        for node in nodes_of(path):
            if isinstance(node, ast.ExceptHandler):
                caught = "" if node.type is None else ast.unparse(node.type)
                if not caught or re.search(r"\b(Exception|BaseException)\b", caught):
                    wrong.append(f"{place(path, node.lineno)} except {caught}")
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("suppress"):
                names = [ast.unparse(a) for a in node.args]
                if {"Exception", "BaseException"} & set(names):
                    wrong.append(f"{place(path, node.lineno)} suppress {names}")
    assert not wrong, "\n".join(wrong)


def narrows_a_type(test):
    """``x is not None`` or ``isinstance(x, T)``, and nothing else."""
    if isinstance(test, ast.Compare):
        none = [c for c in test.comparators if isinstance(c, ast.Constant) and c.value is None]
        return len(none) == 1 and isinstance(test.ops[0], ast.IsNot)
    return isinstance(test, ast.Call) and ast.unparse(test.func) == "isinstance"


def test_asserts_only_narrow_types():
    """Input is checked with errors that say what to do; `python -O` removes asserts."""
    found = [
        (place(path, node.lineno), node)
        for path in FILES
        for node in nodes_of(path)
        if isinstance(node, ast.Assert)
    ]
    wrong = [
        f"{where} {ast.unparse(node)}" for where, node in found if not narrows_a_type(node.test)
    ]
    assert not wrong, "\n".join(wrong)


def test_random_numbers_come_from_a_generator_that_is_passed_in():
    """A run is repeated by its seed: no global random state, no clock as a seed."""
    wrong = []
    for path in FILES:
        for node in nodes_of(path):
            if isinstance(node, ast.Call):
                name = ast.unparse(node.func)
                seeds = name.endswith(("default_rng", "SeedSequence"))
                seeded = seeds and (node.args or node.keywords)
                if re.match(r"(np|numpy)\.random\.|random\.", name) and not seeded:
                    wrong.append(f"{place(path, node.lineno)} {name}()")
    assert not wrong, "\n".join(wrong)
