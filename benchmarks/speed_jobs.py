"""The jobs that `speed.py` measures: commands, and the logs and graphs that they work on."""

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from common import DATA, FREIBURG, FREIBURG_LOGS, ROOT, command, import_freiburg
from speed_logs import building, grid_pose_graph, rings, robots, simulated

MRCLAM = DATA / "mrclam/MRCLAM_Dataset6.tar.xz"
#: logs by name, and what they are
LOGS = {
    "lab": "a cluttered room, simulated",
    "office-loop": "corridors and rooms, simulated",
    "intel": "Intel Research Lab, 508 m",
    "aces": "ACES building, 325 m",
    "mrclam6": "MRCLAM 6, five robots, 888 s",
    "mrclam6-truth": "the same with `--start truth`",
    "building": "12 rings of corridors, 2 km, simulated",
    "grid": "pose graph of 3500 poses",
}
#: jobs with a setting that is no default
OPTIONS = {"mrclam6-truth": ("--start", "truth")}
#: groups of logs of growing length
SCALED = {"laps": rings, "robots": robots}
#: per-keyframe runs by name, and their settings
STEPS = {
    "horizon 20 s": ("backend.name=isam2", "backend.horizon_s=20"),
    "horizon 0": ("backend.name=isam2", "backend.horizon_s=0"),
    "ekf": ("backend.name=ekf",),
}
#: solvers by the names of `speed_runs`: the module that each needs
PEERS = {"gtsam-lm": "gtsam", "gtsam-isam2": "gtsam", "g2o-lm": "g2opy"}
#: of the vertices that peers start from where a graph has its solution in it, m and rad
START_SIGMAS = (0.1, 0.1, 0.02)

Values = dict[str, Any]


class AbsentError(Exception):
    """Data or a library that a job needs is not there; the message says which."""


@dataclass(frozen=True)
class Job:
    """A command to be measured.

    ``arguments()`` prepares it and returns the arguments of its process, or raises `AbsentError`;
    ``values`` makes of what it printed what else is to be noted.
    """

    group: str
    name: str
    what: str
    arguments: Callable[[], Sequence[str]]
    values: Callable[[bytes], Values]


# ---------------------------------------------------------------- jobs


def all_jobs(
    folder: Path, laps: Sequence[int], rounds: Sequence[int], stepped: str
) -> Iterator[Job]:
    """Every job in the order of measurement.

    Args:
        folder: for logs and results.
        laps: numbers of rounds of the office ring.
        rounds: numbers of rounds of the five robots.
        stepped: the log for costs per keyframe and for other solvers.
    """
    yield Job("jobs", "help", "`graphslam --help`", lambda: _graphslam("--help"), lambda _: {})
    for name, what in LOGS.items():
        yield _smooth(folder, "jobs", name, what)
    for group, counts in (("laps", laps), ("robots", rounds)):
        for count in counts:
            yield _smooth(folder, group, f"{group}-{count}", str(count))
    for name, settings in STEPS.items():
        yield _steps(folder, name, stepped, settings)
    for graph in ("grid", stepped):
        for solver, module in PEERS.items():
            yield _peer(folder, graph, solver, module)


def _graphslam(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "graphslam", *arguments]


def _child(*arguments: str) -> list[str]:
    return [sys.executable, str(ROOT / "benchmarks/speed_runs.py"), *arguments]


def _smooth(folder: Path, group: str, name: str, what: str) -> Job:
    """The whole command with default settings, its stages, and the error of its result."""
    target = folder / "results" / name

    def arguments() -> list[str]:
        log, options = str(find_log(folder, name)), OPTIONS.get(name, ())
        return _graphslam("smooth", log, "-o", str(target), "--force", "--json", *options)

    def values(_printed: bytes) -> Values:
        summary = json.loads((target / "summary.json").read_text(encoding="utf-8"))
        return {
            "stages": summary["stages"],
            "scans": summary["counts"]["scans"],
            "keyframes": summary["counts"]["keyframes"],
            "error_m": _error_m(target, name),
        }

    return Job(group, name, what, arguments, values)


def _steps(folder: Path, name: str, log: str, settings: Sequence[str]) -> Job:
    return Job(
        "steps",
        name,
        log,
        lambda: _child("steps", str(find_log(folder, log)), *settings),
        json.loads,
    )


def _peer(folder: Path, graph: str, solver: str, module: str) -> Job:
    def arguments() -> list[str]:
        if find_spec(module) is None:
            raise AbsentError(f"{module} is not installed: pip install {module}")
        return _child(solver, str(_graph_to_solve(folder, graph)))

    return Job("peers", f"{solver} {graph}", graph, arguments, json.loads)


# ---------------------------------------------------------------- their inputs


def find_log(folder: Path, name: str) -> Path:
    """A log by its name, made or imported in the folder if it is not there yet.

    Raises:
        AbsentError: it comes from data that are not there.
    """
    kind, _, count = name.partition("-")
    if (ROOT / f"logs/{name}.mcap").exists():
        return ROOT / f"logs/{name}.mcap"
    if kind in SCALED:
        return simulated(SCALED[kind](int(count)), name, folder)
    if name == "building":
        return simulated(building(), name, folder)
    if name == "grid":
        return _imported("g2o", _grid_file(folder), folder / "grid.mcap")
    if name in FREIBURG_LOGS:
        _check(FREIBURG / f"{name}.clf.bz2")
        return import_freiburg(name, folder)
    if kind == "mrclam6":
        return _imported("mrclam", MRCLAM, folder / "mrclam6.mcap")
    raise AbsentError(f"logs/{name}.mcap is not there")


def _check(source: Path) -> None:
    if not source.exists():
        raise AbsentError(f"{source.name} is not there: set GRAPHSLAM_DATA")


def _imported(form: str, source: Path, log: Path) -> Path:
    if not log.exists():
        _check(source)
        command("import", form, str(source), "-o", str(log))
    return log


def _grid_file(folder: Path) -> Path:
    path = folder / "grid.g2o"
    path.write_text(grid_pose_graph(), encoding="utf-8")
    return path


def _graph_to_solve(folder: Path, name: str) -> Path:
    """The grid as it is; of a log the graph of its result, its vertices moved from the solution."""
    if name == "grid":
        return _grid_file(folder)
    log = find_log(folder, name)
    result = folder / "results" / name
    if not result.exists():
        command("smooth", str(log), "-o", str(result))
    start = folder / f"{name}-start.g2o"
    text = (result / "graph.g2o").read_text(encoding="utf-8")
    start.write_text(moved_vertices(text), encoding="utf-8")
    return start


def moved_vertices(graph: str) -> str:
    """A g2o file with noise on its vertices, except on the first, which keeps the frame."""
    rng = np.random.default_rng(1)
    lines = graph.splitlines()
    for number, line in enumerate(lines[1:], 1):
        if line.startswith("VERTEX_SE2 "):
            tag, vertex, *pose = line.split()
            moved = np.array(pose, dtype=float) + START_SIGMAS * rng.normal(size=3)
            lines[number] = " ".join([tag, vertex, *map(repr, moved.tolist())])
    return "\n".join(lines) + "\n"


@cache  # results of repetitions are equal
def _error_m(result: Path, name: str) -> float | None:
    """Root mean square of the aligned positions, or the mean of relations; None without truth."""
    relations = FREIBURG / f"{name}.relations"
    if name == "grid":
        return None
    if relations.exists():
        found = command("evaluate", str(result), "--relations", str(relations))
        return float(found["relations"]["all"]["trans_mean_m"])
    final = command("evaluate", str(result))["joint"]["final"]
    return float(final["ate_aligned_rmse_m"])
