"""What `graphslam map` makes of a result: a grid map, drawings of the line map, tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from graphslam.core.errors import OutputError
from graphslam.core.output_folder import write_into
from graphslam.core.records import Landmark, Trajectory
from graphslam.results.folder import SavedResult, load
from graphslam.results.grid_map import grid_map_files
from graphslam.results.line_map import line_map_files
from graphslam.results.occupancy_grid import GridMap, grid_map
from graphslam.results.scans_file import SCANS_FILE, PlacedScan, read_scans
from graphslam.results.tables_csv import (
    LANDMARK_COLUMNS,
    TRAJECTORY_COLUMNS,
    csv_text,
    landmark_rows,
    trajectory_rows,
)

NAME = "map"


@dataclass(frozen=True, slots=True, eq=False)
class MapFiles:
    """Names and contents of the files of a map; ``grid`` is None without scans.

    ``verdict``: that of the result, None if it has none.
    """

    files: tuple[tuple[str, str | bytes], ...]
    grid: GridMap | None
    verdict: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """What ``graphslam map --json`` prints."""
        grid = None
        if self.grid is not None:
            rows, columns = self.grid.log_odds.shape
            grid = {
                "resolution_m": self.grid.cell_m,
                "origin_m": list(self.grid.origin_m),
                "columns": columns,
                "rows": rows,
                "occupied": int(self.grid.occupied.sum()),
                "free": int(self.grid.free.sum()),
            }
        files = [name for name, _ in self.files]
        return {"files": files, "grid": grid, "verdict": self.verdict}


def make_map(
    directory: Path,
    target: Path,
    *,
    resolution_m: float | None = None,
    mode: str = "trinary",
    force: bool = False,
) -> MapFiles:
    """Make the map of a result folder and write its files into ``target``.

    Args:
        directory: the result folder.
        target: a folder, which may be ``directory``; made if missing.
        resolution_m: edge of a cell; default: as the scans allow.
        mode: of the grid map, see `graphslam.results.grid_map.grid_map_files`.
        force: replace files of these names.

    Raises:
        OutputError: it is no result folder, a file exists, or the disk refuses; the files that
            were there before are then left as they were.
        ConfigError: the map would have too many cells of ``resolution_m``.
    """
    saved = load(directory)
    scans = read_scans(directory / SCANS_FILE)
    counts = saved.summary.get("counts", {})
    # a robot that never moved far enough for a second keyframe has mapped nothing yet
    if counts.get("scans") and counts.get("keyframes", 0) > len(saved.robots) and not scans:
        raise OutputError(
            f"{directory}: has no {SCANS_FILE}, of which maps are made: it is of an older version "
            "or of a back end that keeps no scans; run smooth again"
        )
    made = _saved_map_files(saved, scans, resolution_m, mode)
    write_into(target, made.files, force=force)
    return made


def _saved_map_files(
    saved: SavedResult, scans: Sequence[PlacedScan], resolution_m: float | None, mode: str
) -> MapFiles:
    paths = {name: robot.final for name, robot in saved.robots.items()}
    return _map_files(saved.summary, paths, saved.landmarks, scans, resolution_m, mode)


def in_world(summary: Mapping[str, Any], robot: str) -> bool:
    """Whether a robot's poses are in the world frame, not in a frame of its own."""
    world = summary.get("world")
    return bool(summary.get("frames", {}).get(robot, world) == world)


def _map_files(
    summary: Mapping[str, Any],
    paths: Mapping[str, Trajectory],
    landmarks: Sequence[Landmark],
    scans: Sequence[PlacedScan],
    resolution_m: float | None,
    mode: str,
) -> MapFiles:
    """Maps are of what is in the world frame, tables of all."""
    placed = [scan for scan in scans if in_world(summary, scan.robot)]
    grid = grid_map(placed, resolution_m) if placed else None
    drawn = [m for m in landmarks if m.frame is None]
    own = {name: path for name, path in paths.items() if in_world(summary, name)}
    frames = {name: summary["frames"][name] for name in paths if name not in own}
    files = [
        *(grid_map_files(grid, NAME, mode) if grid is not None else ()),
        *line_map_files(drawn, own, NAME),
        ("landmarks.csv", csv_text(LANDMARK_COLUMNS, landmark_rows(landmarks))),
        ("trajectories.csv", csv_text(TRAJECTORY_COLUMNS, trajectory_rows(paths, frames))),
    ]
    return MapFiles(tuple(files), grid, summary.get("verdict", {}).get("verdict"))
