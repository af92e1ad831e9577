"""The result folder: written atomically, and read back.

The layout is documented in docs/formats.md: summary.json, config.toml, trajectories/,
landmarks.json, graph.g2o (with graph_ids.csv naming its vertices), joint.npz and scans.npz where
there are scans, and report.html. The formats of the files are in `file_formats`, `joint_file` and
`scans_file`.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote, unquote

from graphslam.core.config import Config, RobustConfig
from graphslam.core.config_io import dump_config, load_config
from graphslam.core.errors import OutputError
from graphslam.core.notebook_views import ResultViews
from graphslam.core.output_folder import Identity
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
from graphslam.results.joint_file import joint_bytes, joint_landmarks, read_joint
from graphslam.results.scans_file import SCANS_FILE, place_scans, scans_bytes
from graphslam.results.target_folder import check_target, is_result, write_folder


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
#: ms that a pose takes in all files of its robot
POSE_MS = 0.005

# ---------------------------------------------------------------- writing


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
    write_folder(directory, chain(more, _files(result, report)), before)


def _files(
    result: Result, report: Callable[[Result], str] | None
) -> Iterator[tuple[str, str | bytes]]:
    """Names and contents of every file of the folder, each made when it is asked for."""
    yield "config.toml", dump_config(result.config)
    landmarks = [landmark_json(landmark) for landmark in result.landmarks]
    yield "landmarks.json", to_json(landmarks, "landmarks.json")
    yield "graph.g2o", graph_g2o(result.steps, result.estimate, kernel_of(result))
    yield "graph_ids.csv", graph_ids(result.estimate)
    poses = [float(len(robot.final)) for robot in result.robots.values()]
    robots = list(result.robots.items())
    for own in parallel_map(trajectory_files, robots, efforts=poses, unit_ms=POSE_MS):
        yield from own
    joint = joint_landmarks(result.estimate, result.robots)
    if joint is not None:
        yield JOINT_FILE, joint_bytes(joint)
    scans = place_scans(result.keyframe_scans, result.estimate.states)
    if scans:
        yield SCANS_FILE, scans_bytes(scans)
    if report is not None:
        yield "report.html", report(result)
    yield "summary.json", to_json(result.summary, "summary.json")


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


# ---------------------------------------------------------------- reading


def check_one_frame(saved: SavedResult, directory: Path) -> None:
    """See that a result is a map of one place.

    Raises:
        OutputError: its robots are in separate frames.
    """
    if len(set(saved.summary.get("frames", {}).values())) > 1:
        raise OutputError(
            f"{directory}: its robots are in separate frames: it is no map of one place"
        )


def load(directory: Path) -> SavedResult:
    """Read a result folder back.

    Raises:
        OutputError: it is not a result folder, or a file of it is malformed.
        ConfigError: its config.toml is not valid.
    """
    if not is_result(directory):
        why = "damaged" if (directory / "summary.json").exists() else "no"
        raise OutputError(f"{directory}: not a result folder of graphslam ({why} summary.json)")
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
