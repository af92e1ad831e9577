"""Mutations of the code that no test notices: how much of it the tests hold.

One operator, comparison, constant or sign of a module is changed at a time, drawn at random, in a
copy of the package; the tests of that module run until one fails. A mutation after which all pass
is printed: it is equivalent, or a test is missing.

Run: python benchmarks/mutation.py [--mutants 250] [--seed 0] [MODULE ...]
"""

import argparse
import ast
import os
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import gtsam
import pytest
import scipy.optimize
import scipy.spatial
import scipy.stats

#: what the tests import anyway, loaded once before processes are forked. Not the package itself:
#: each process imports a copy of it
PRELOADED = (cv2, gtsam, scipy.optimize, scipy.spatial, scipy.stats)
ROOT = Path(__file__).parents[1]

#: module -> its tests
TESTS: dict[str, tuple[str, ...]] = {
    "perception/segments.py": ("perception/test_front_ends.py",),
    "perception/segment_ends.py": ("perception/test_front_ends.py",),
    "perception/line_fit.py": ("perception/test_front_ends.py",),
    "perception/line_moments.py": ("perception/test_front_ends.py", "perception/test_hough.py"),
    "perception/ordered_scan.py": ("perception/test_front_ends.py",),
    "perception/hough.py": ("perception/test_hough.py",),
    "perception/hough_votes.py": ("perception/test_hough.py",),
    "perception/segments_and_hough.py": ("perception/test_hough.py",),
    "perception/cylinders.py": ("perception/test_cylinders.py",),
    "core/motion_models.py": ("core/test_motion_models.py",),
    "core/observation_models.py": ("core/test_observation_models.py", "estimation/test_factors.py"),
    "core/geometry.py": ("core/test_geometry.py",),
    "odometry/preintegration.py": ("core/test_motion_models.py",),
    "odometry/interpolation.py": ("odometry/test_interpolation.py",),
    "odometry/scan_odometry.py": ("odometry/test_scan_odometry.py",),
    "estimation/factors.py": ("estimation/test_factors.py",),
}
#: tests of whole runs: they would notice little that the others do not, in most of the time
SLOW = "not becomes_one_landmark"
#: longest run of tests, s; a mutation that takes longer never ends
LIMIT_S = 300

SWAPPED: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt,
    ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
    ast.And: ast.Or, ast.Or: ast.And, ast.USub: ast.UAdd,
}  # fmt: skip


def places(tree: ast.Module) -> Iterator[ast.AST]:
    """What can be changed, outside of annotations and texts."""
    for function in ast.walk(tree):
        if not isinstance(function, ast.FunctionDef):
            continue
        for statement in function.body:
            for node in ast.walk(statement):
                if isinstance(node, ast.BinOp | ast.BoolOp | ast.UnaryOp):
                    if type(node.op) in SWAPPED:
                        yield node
                elif isinstance(node, ast.Compare):
                    if len(node.ops) == 1 and type(node.ops[0]) in SWAPPED:
                        yield node
                elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
                    yield node


def change(node: ast.AST) -> str:
    """Change one place; what was done."""
    if isinstance(node, ast.BinOp | ast.BoolOp | ast.UnaryOp):
        before = ast.unparse(node)
        node.op = SWAPPED[type(node.op)]()  # type: ignore[assignment]
    elif isinstance(node, ast.Compare):
        before = ast.unparse(node)
        node.ops = [SWAPPED[type(node.ops[0])]()]  # type: ignore[list-item]
    else:
        assert isinstance(node, ast.Constant)
        assert isinstance(node.value, int | float)
        before = ast.unparse(node)
        node.value = node.value + 1 if isinstance(node.value, int) else 2 * node.value + 0.1
    return f"{before}  ->  {ast.unparse(node)}"


def is_noticed(package: Path, tests: Sequence[str]) -> bool:
    """Whether a test fails, in a process of its own."""
    child = os.fork()
    if child == 0:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.dup2(null, 2)
        sys.path[:0] = [str(package)]
        os.chdir(ROOT)
        files = [str(ROOT / "tests" / name) for name in tests]
        options = ["-x", "-q", "-k", SLOW, "-p", "no:cacheprovider"]
        code = 1
        try:
            code = int(pytest.main([*files, *options]))
        finally:  # whatever happens, what is left to do is the other process's
            os._exit(code)
    began = time.monotonic()
    while time.monotonic() - began < LIMIT_S:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status) != 0
        time.sleep(0.05)
    os.kill(child, 9)
    os.waitpid(child, 0)
    return True


def main() -> None:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("modules", nargs="*", metavar="MODULE", help=", ".join(TESTS))
    options.add_argument("--mutants", type=int, default=250)
    options.add_argument("--seed", type=int, default=0)
    arguments = options.parse_args()
    chosen = arguments.modules or list(TESTS)
    rng = random.Random(arguments.seed)
    with tempfile.TemporaryDirectory() as folder:
        package = Path(folder)
        shutil.copytree(ROOT / "graphslam", package / "graphslam")
        every = [
            (name, k)
            for name in chosen
            for k in range(
                sum(1 for _ in places(ast.parse((ROOT / "graphslam" / name).read_text("utf-8"))))
            )
        ]
        drawn = rng.sample(every, min(arguments.mutants, len(every)))
        for tests in {TESTS[name] for name, _ in drawn}:
            if is_noticed(package, tests):
                sys.exit(f"{', '.join(tests)}: a test fails without any mutation")
        noticed = 0
        for count, (name, k) in enumerate(drawn, 1):
            source = (ROOT / "graphslam" / name).read_text(encoding="utf-8")
            tree = ast.parse(source)
            node = list(places(tree))[k]
            line = getattr(node, "lineno", 0)
            what = change(node)
            (package / "graphslam" / name).write_text(ast.unparse(tree), encoding="utf-8")
            found = is_noticed(package, TESTS[name])
            (package / "graphslam" / name).write_text(source, encoding="utf-8")
            noticed += found
            if not found:
                print(f"not noticed: {name}:{line}: {what}", flush=True)
            if count % 10 == 0 or count == len(drawn):
                print(f"{noticed} of {count} noticed ({len(every)} places)", flush=True)


if __name__ == "__main__":
    main()
