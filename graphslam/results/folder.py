"""The result folder: written atomically, and read back.

The layout is documented in docs/formats.md: summary.json, config.toml, trajectories/,
landmarks.json, graph.g2o (with graph_ids.csv naming its vertices), joint.npz and scans.npz where
there are scans, and report.html. The formats of the files are in `file_formats`, `joint_file` and
`scans_file`.
"""

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote, unquote

from graphslam.core.config import Config, RobustConfig
from graphslam.core.config_io import dump_config, load_config
from graphslam.core.errors import OutputError
from graphslam.core.notebook_views import ResultViews
from graphslam.core.output_folder import Identity, atomic_folder, identity, unfinished
from graphslam.core.records import JointScans, Landmark, Result, RobotResult, Trajectory
from graphslam.core.worker import parallel_map
from graphslam.estimation.g2o import graph_g2o, graph_ids
from graphslam.results.file_formats import (
    cov_text,
    landmark_json,
    read_json,
    read_landmarks,
    read_trajectory,
    to_json,
    tum_text,
)
from graphslam.results.joint_file import joint_bytes, joint_scans, read_joint
from graphslam.results.scans_file import SCANS_FILE, place_scans, scans_bytes


@dataclass(frozen=True, slots=True, eq=False)
class SavedRobot:
    """One robot's trajectories as saved; scan poses are None where the robot had no scans.

    ``odometry`` is the base by odometry alone. It and scan trajectories have no covariance file:
    their ``covs`` are NaN.
    """

    final: Trajectory
    causal: Trajectory | None
    scan_final: Trajectory | None
    scan_causal: Trajectory | None
    odometry: Trajectory | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SavedResult(ResultViews):
    """A result folder read back; ``joint`` is None where nothing tells how scans are correlated."""

    robots: Mapping[str, SavedRobot]
    landmarks: tuple[Landmark, ...]
    summary: Mapping[str, Any]
    config: Config
    joint: JointScans | None = None


JOINT_FILE = "joint.npz"

# ---------------------------------------------------------------- writing


def check_target(
    directory: Path, *, force: bool, replaceable: Callable[[Path], bool] | None = None
) -> Identity:
    """Check before a long computation that a folder may be written at ``directory``.

    Args:
        directory: the folder to be written.
        force: replace an existing one.
        replaceable: whether ``force`` may replace a given existing folder; default: result
            folders. An empty folder is always replaced.

    Returns:
        What stands there; if it is something else when the folder is written, another process
        wrote it.

    Raises:
        OutputError: it exists and ``force`` is not given, it exists and may not be replaced, or
            its parent is not writable.
    """
    parent = directory.absolute().parent
    while not parent.exists():
        parent = parent.parent
    if not (parent.is_dir() and os.access(parent, os.W_OK | os.X_OK)):
        raise OutputError(f"{directory}: cannot be written: {parent} is no folder to write to")
    unfinished(directory)  # a folder that a dead process had moved away stands there again
    before = identity(directory)
    if before is None:
        return None
    if not force:
        raise OutputError(f"{directory}: already exists; give --force to replace it")
    empty = directory.is_dir() and not any(directory.iterdir())
    if directory.is_symlink() or not (empty or (replaceable or _is_result)(directory)):
        raise OutputError(
            f"{directory}: is not a result folder of graphslam, so it is not replaced; "
            "choose another name"
        )
    return before


def save(
    result: Result,
    directory: Path,
    more: Sequence[tuple[str, bytes]] = (),
    *,
    force: bool,
    report: Callable[[Result], str] | None = None,
    before: Identity | Literal["now"] = "now",
) -> None:
    """Write the result folder, with ``more`` files (name, content), see `write_folder`.

    ``report`` renders report.html, and may add to the summary; it is called when all else but that
    is made. Without it there is no report. ``before``: what `check_target` found when
    the run began, which alone may be replaced.

    Raises:
        OutputError: the target exists and may not be replaced, a number is not finite, or the
            disk cannot be written; no partial output is left.
    """
    if before == "now":
        before = check_target(directory, force=force)
    write_folder(directory, [*more, *_files(result, report)], before)


def write_folder(
    directory: Path, files: Sequence[tuple[str, str | bytes]], before: Identity
) -> None:
    """Write files (name, content) as a folder that appears whole or not at all.

    ``before``: what `check_target` found there.

    Raises:
        OutputError: the disk cannot be written; no partial output is left.
    """
    with atomic_folder(directory, before) as part:
        for name, content in files:
            path = part / name
            path.parent.mkdir(exist_ok=True)
            if isinstance(content, bytes):
                path.write_bytes(content)
            else:
                # names of files need not be text: what is not is written as its escape
                path.write_text(content, encoding="utf-8", errors="backslashreplace")


def _files(result: Result, report: Callable[[Result], str] | None) -> list[tuple[str, str | bytes]]:
    """Names and contents of every file of the folder."""
    files: list[tuple[str, str | bytes]] = [
        ("config.toml", dump_config(result.config)),
        (
            "landmarks.json",
            to_json([landmark_json(landmark) for landmark in result.landmarks], "landmarks.json"),
        ),
        ("graph.g2o", graph_g2o(result.steps, result.estimate, kernel_of(result))),
        ("graph_ids.csv", graph_ids(result.estimate)),
    ]
    for own in parallel_map(trajectory_files, list(result.robots.items())):
        files += own
    joint = joint_scans(result.estimate, result.robots)
    if joint is not None:
        files.append((JOINT_FILE, joint_bytes(joint)))
    scans = place_scans(result.keyframe_scans, result.estimate.states)
    if scans:
        files.append((SCANS_FILE, scans_bytes(scans)))
    if report is not None:
        files.append(("report.html", report(result)))
    files.append(("summary.json", to_json(result.summary, "summary.json")))
    return files


def kernel_of(result: Result) -> RobustConfig:
    """The kernel of a result's graph: as wide as the log's noise allows."""
    scale = result.summary["graph"].get("kernel_scale", result.config.robust.scale)
    return replace(result.config.robust, scale=scale)


def trajectory_files(named: tuple[str, RobotResult]) -> list[tuple[str, str]]:
    """Names and contents of the files of one robot."""
    name, robot = named
    stem = f"trajectories/{_file_name(name)}"
    files = [
        (f"{stem}.tum", tum_text(robot.final)),
        (f"{stem}.cov.csv", cov_text(robot.final)),
        (f"{stem}.odometry.tum", tum_text(robot.dead_reckoning)),
    ]
    if robot.causal is not None:
        files += [
            (f"{stem}.causal.tum", tum_text(robot.causal)),
            (f"{stem}.causal.cov.csv", cov_text(robot.causal)),
        ]
    for kind, scan in (("scan", robot.scan_final), ("scan.causal", robot.scan_causal)):
        if scan is not None:
            files.append((f"{stem}.{kind}.tum", tum_text(scan)))
    return files


def _file_name(robot: str) -> str:
    """A robot's name as a file name: namespaces hold slashes, and a dot would read as a suffix."""
    return quote(robot, safe="").replace(".", "%2E")


def _is_result(directory: Path) -> bool:
    """Whether a folder has our summary.json and trajectories/; nothing else is ever replaced."""
    try:
        summary = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return (
        isinstance(summary, dict) and "format" in summary and (directory / "trajectories").is_dir()
    )


# ---------------------------------------------------------------- reading


def load(directory: Path) -> SavedResult:
    """Read a result folder back.

    Raises:
        OutputError: it is not a result folder, or a file of it is malformed.
        ConfigError: its config.toml is not valid.
    """
    if not _is_result(directory):
        raise OutputError(f"{directory}: not a result folder of graphslam (no summary.json)")
    folder = directory / "trajectories"
    stems = sorted(p.name.removesuffix(".tum") for p in folder.glob("*.tum"))
    robots = {unquote(stem): _load_robot(folder / stem) for stem in stems if "." not in stem}
    if not robots:
        raise OutputError(f"{folder}: holds no trajectory")
    return SavedResult(
        robots,
        read_landmarks(directory / "landmarks.json"),
        read_json(directory / "summary.json"),
        load_config(directory / "config.toml"),
        read_joint(directory / JOINT_FILE) if (directory / JOINT_FILE).exists() else None,
    )


def _load_robot(stem: Path) -> SavedRobot:
    def path(suffix: str) -> Path:
        return stem.with_name(stem.name + suffix)

    def scan(suffix: str) -> Trajectory | None:
        return read_trajectory(path(suffix)) if path(suffix).exists() else None

    causal = path(".causal.tum")
    return SavedRobot(
        read_trajectory(path(".tum"), path(".cov.csv")),
        read_trajectory(causal, path(".causal.cov.csv")) if causal.exists() else None,
        scan(".scan.tum"),
        scan(".scan.causal.tum"),
        scan(".odometry.tum"),
    )
