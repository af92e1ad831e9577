"""Mutations of the code that no test notices: how much of it the tests hold.

One operator, comparison, constant or sign of a module is changed at a time, drawn at random, in a
copy of the package; the tests of that module run until one fails. A mutation after which all pass
is printed: it is equivalent, or a test is missing. Which are equivalent, and why, is in
``mutation_equivalent.toml``, by the statement as mutated; nothing is drawn by it.

Run: python benchmarks/mutation.py [--mutants 250] [--seed 0] [MODULE ...]
"""

import argparse
import ast
import json
import os
import random
import resource
import shutil
import sys
import tempfile
import time
import tomllib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import gtsam
import pytest
import scipy.optimize
import scipy.spatial
import scipy.stats
from hypothesis import Phase, settings, strategies

#: what the tests import anyway, loaded once before processes are forked. Not the package itself:
#: each process imports a copy of it
PRELOADED = (cv2, gtsam, scipy.optimize, scipy.spatial, scipy.stats, strategies)
ROOT = Path(__file__).parents[1]

#: module -> its tests
TESTS: dict[str, tuple[str, ...]] = {
    "perception/segments.py": (
        "perception/test_chains_and_ends.py",
        "perception/test_front_ends.py",
        "perception/test_breaks.py",
        "perception/test_scan_blocks.py",
    ),
    "perception/segment_ends.py": (
        "perception/test_chains_and_ends.py",
        "perception/test_front_ends.py",
        "perception/test_scan_blocks.py",
    ),
    "perception/line_fit.py": (
        "perception/test_chains_and_ends.py",
        "perception/test_front_ends.py",
    ),
    "perception/line_moments.py": ("perception/test_hough_runs.py", "perception/test_breaks.py"),
    "perception/ordered_scan.py": (
        "perception/test_chains_and_ends.py",
        "perception/test_front_ends.py",
        "perception/test_scan_blocks.py",
    ),
    "perception/hough.py": ("perception/test_hough_runs.py", "perception/test_hough.py"),
    "perception/hough_votes.py": ("perception/test_hough_runs.py", "perception/test_hough.py"),
    "perception/segments_and_hough.py": (
        "perception/test_hough_runs.py",
        "perception/test_hough.py",
    ),
    "perception/cylinders.py": ("perception/test_cylinders.py",),
    "core/motion_models.py": ("core/test_motion_models.py", "core/test_motion_calibration.py"),
    "core/observation_models.py": ("core/test_observation_models.py", "estimation/test_factors.py"),
    "core/geometry.py": ("core/test_geometry.py",),
    "odometry/preintegration.py": ("core/test_motion_models.py", "odometry/test_mounted_track.py"),
    "odometry/interpolation.py": (
        "odometry/test_interpolation.py",
        "odometry/test_mount_covariance.py",
    ),
    "odometry/scan_odometry.py": (
        "odometry/test_motion_checks.py",
        "odometry/test_scan_odometry.py",
    ),
    "estimation/factors.py": ("estimation/test_factors.py",),
}
#: tests of whole runs: they would notice little that the others do not, in most of the time
SLOW = "not becomes_one_landmark"
#: a mutation whose tests take so many times as long as without it, and s more, never ends
LIMIT_TIMES, LIMIT_S = 3.0, 20.0
#: bytes that the tests of a mutation may use: one may ask for an array of any size
MEMORY = 6 * 2**30
EQUIVALENT = Path(__file__).with_name("mutation_equivalent.toml")

SWAPPED: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt,
    ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
    ast.And: ast.Or, ast.Or: ast.And, ast.USub: ast.UAdd,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Place:
    """What can be changed, and the function and the statement that it is in."""

    node: ast.AST
    function: str
    statement: ast.stmt


def places(tree: ast.Module) -> list[Place]:
    """What can be changed, outside of annotations and texts."""
    found: dict[int, Place] = {}
    for function in ast.walk(tree):  # outer functions first: the innermost one names a place
        if not isinstance(function, ast.FunctionDef):
            continue
        for statement, node in _nodes(function.body):
            if _can_change(node):
                found[id(node)] = Place(node, function.name, statement)
    return list(found.values())


def _nodes(body: Sequence[ast.stmt]) -> Iterator[tuple[ast.stmt, ast.AST]]:
    """Nodes with the innermost statement that each belongs to."""
    todo = [(statement, statement) for statement in reversed(body)]
    while todo:
        statement, node = todo.pop()
        yield statement, node
        for child in reversed(list(ast.iter_child_nodes(node))):
            todo.append((child if isinstance(child, ast.stmt) else statement, child))


def _can_change(node: ast.AST) -> bool:
    if isinstance(node, ast.BinOp | ast.BoolOp | ast.UnaryOp):
        return type(node.op) in SWAPPED
    if isinstance(node, ast.Compare):
        return len(node.ops) == 1 and type(node.ops[0]) in SWAPPED
    return isinstance(node, ast.Constant) and type(node.value) in (int, float)


def change(place: Place) -> tuple[str, str]:
    """Change one place; what was done, and the statement as it is then."""
    node = place.node
    before = ast.unparse(node)
    if isinstance(node, ast.BinOp | ast.BoolOp | ast.UnaryOp):
        node.op = SWAPPED[type(node.op)]()  # type: ignore[assignment]
    elif isinstance(node, ast.Compare):
        node.ops = [SWAPPED[type(node.ops[0])]()]  # type: ignore[list-item]
    else:
        assert isinstance(node, ast.Constant)
        assert isinstance(node.value, int | float)
        node.value = node.value + 1 if isinstance(node.value, int) else 2 * node.value + 0.1
    statement = ast.unparse(place.statement).splitlines()[0]  # the head of a compound one
    return f"{before}  ->  {ast.unparse(node)}", statement


class Quick:
    """Plugin of pytest: the quickest tests first, and an example that fails is enough."""

    def __init__(self, durations: Path) -> None:
        """``durations``: s of each test without a mutation; those that are missing are added."""
        self._file, self._found = durations, dict[str, float]()
        self._known = json.loads(durations.read_text()) if durations.exists() else {}

    def pytest_sessionstart(self) -> None:
        """After `conftest.py` has loaded its own profile of hypothesis."""
        phases = (Phase.explicit, Phase.generate)
        settings.register_profile(
            "mutation", max_examples=50, deadline=None, database=None, derandomize=True,
            phases=phases,
        )  # fmt: skip
        settings.load_profile("mutation")

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Sort."""
        items.sort(key=lambda item: self._known.get(item.nodeid, 0.0))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Remember."""
        self._found[report.nodeid] = self._found.get(report.nodeid, 0.0) + report.duration

    def pytest_sessionfinish(self) -> None:
        """Write."""
        if not self._found.keys() <= self._known.keys():
            self._file.write_text(json.dumps(self._found | self._known))


def is_noticed(package: Path, tests: Sequence[str], limit_s: float) -> bool:
    """Whether a test fails, in a process of its own."""
    child = os.fork()
    if child == 0:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.dup2(null, 2)
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        sys.path[:0] = [str(package)]
        os.chdir(ROOT)
        files = [str(ROOT / "tests" / name) for name in tests]
        options = ["-x", "-q", "-k", SLOW, "-p", "no:cacheprovider"]
        # of hypothesis, which is loaded already: its assertions are not ours
        options += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]
        code = 1
        try:
            quick = Quick(package / "durations.json")
            code = int(pytest.main([*files, *options], plugins=[quick]))
        finally:  # whatever happens, what is left to do is the other process's
            os._exit(code)
    began = time.monotonic()
    while time.monotonic() - began < limit_s:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status) != 0
        time.sleep(0.02)
    os.kill(child, 9)
    os.waitpid(child, 0)
    return True


def usual_s(package: Path, drawn: Sequence[str]) -> dict[str, float]:
    """How long the tests of modules take without any mutation, s."""
    taken: dict[str, float] = {}
    for tests in sorted({tests for name in drawn for tests in TESTS[name]}):
        for _ in range(2):  # in the usual order, and in that of mutations
            began = time.monotonic()
            if is_noticed(package, [tests], 1e3):
                sys.exit(f"{tests}: a test fails without any mutation")
            taken[tests] = time.monotonic() - began
    return {name: sum(taken[tests] for tests in TESTS[name]) for name in drawn}


def main() -> None:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("modules", nargs="*", metavar="MODULE", help=", ".join(TESTS))
    options.add_argument("--mutants", type=int, default=250)
    options.add_argument("--seed", type=int, default=0)
    arguments = options.parse_args()
    chosen = arguments.modules or list(TESTS)
    sources = {name: (ROOT / "graphslam" / name).read_text(encoding="utf-8") for name in chosen}
    judged = tomllib.loads(EQUIVALENT.read_text(encoding="utf-8"))["mutation"]
    why = {(one["module"], one["function"], one["statement"]): one["why"] for one in judged}
    every = [(name, k) for name in chosen for k in range(len(places(ast.parse(sources[name]))))]
    rng = random.Random(arguments.seed)
    drawn = rng.sample(every, min(arguments.mutants, len(every)))
    count: Counter[str] = Counter()
    rows: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        package = Path(folder)
        shutil.copytree(ROOT / "graphslam", package / "graphslam")
        usual = usual_s(package, sorted({name for name, _ in drawn}))
        for n, (name, k) in enumerate(drawn, 1):
            tree = ast.parse(sources[name])
            place = places(tree)[k]
            what, statement = change(place)
            (package / "graphslam" / name).write_text(ast.unparse(tree), encoding="utf-8")
            limit_s = LIMIT_TIMES * usual[name] + LIMIT_S
            if is_noticed(package, TESTS[name], limit_s):
                count["noticed"] += 1
            else:
                reason = why.get((name, place.function, statement))
                count["missed" if reason is None else "equivalent"] += 1
                kind = "not noticed" if reason is None else f"equivalent: {reason}"
                rows.append(f"| `{name}`, `{place.function}` | `{statement}` | {kind} |")
                print(f"{name}:{place.node.lineno}: {what}\n{rows[-1]}", flush=True)  # type: ignore[attr-defined]
            (package / "graphslam" / name).write_text(sources[name], encoding="utf-8")
            if n % 20 == 0 or n == len(drawn):
                print(f"{n} of {len(drawn)}: {dict(count)}", flush=True)
    print("\n| where | statement as mutated | judgement |\n|---|---|---|", *sorted(rows), sep="\n")
    noticed, real = count["noticed"], len(drawn) - count["equivalent"]
    print(
        f"\n{noticed} of {len(drawn)} noticed (seed {arguments.seed}, {len(every)} places in"
        f" {len(chosen)} modules), {count['equivalent']} equivalent, {count['missed']} not noticed:"
        f" {100 * noticed / real:.1f} % of the {real} that are not equivalent"
    )


if __name__ == "__main__":
    main()
