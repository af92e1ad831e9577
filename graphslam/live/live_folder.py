"""The folder of a drive that goes on: a result folder of what is known now, replaced whole."""

import platform
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from graphslam import __version__
from graphslam.core.config import Config
from graphslam.core.config_io import dump_config
from graphslam.core.output_folder import Identity, atomic_folder
from graphslam.core.records import Landmark
from graphslam.live.history import History
from graphslam.results.file_formats import landmark_json, to_json
from graphslam.results.folder import trajectory_files
from graphslam.results.line_map import svg_text, thinned_index
from graphslam.results.map_files import make_map
from graphslam.results.report_html import (
    document,
    duration,
    header,
    length,
    number,
    section,
    warning_box,
)
from graphslam.results.scans_file import SCANS_FILE, scans_bytes
from graphslam.slam.summary import FORMAT

#: s after which a browser loads the page again while the drive goes on
RELOAD_S = 5
#: lines of the drawing are as thin on a wide page as on a phone, and walls in the page's ink
CSS = """figure svg { width: 100%; height: auto; max-height: 85vh; }
figure svg g { stroke-width: 1.5; }
figure svg g * { vector-effect: non-scaling-stroke; }
figure svg #walls, figure svg #points { stroke: currentColor; }
figure svg #paths { stroke: var(--accent); }
"""


def write_live_folder(
    target: Path,
    before: Identity,
    config: Config,
    history: History,
    landmarks: tuple[Landmark, ...],
    summary: Mapping[str, Any],
) -> None:
    """Write what is known now: trajectories, landmarks, maps, summary.json and a page.

    Args:
        target: the folder; it is replaced as a whole.
        before: what stands there, see `check_target`.
        config: settings.
        history: estimates so far.
        landmarks: the map now.
        summary: what summary.json has besides what every one has.

    Raises:
        OutputError: the disk cannot be written, or another process wrote the folder; it is then as
            it was.
    """
    robots = history.results()
    told = {
        "format": FORMAT,
        "versions": {
            "graphslam": __version__,
            "gtsam": version("gtsam"),
            "numpy": version("numpy"),
            "python": platform.python_version(),
        },
        "backend": config.backend.name,
        **summary,
    }
    files: list[tuple[str, str | bytes]] = [
        ("config.toml", dump_config(config)),
        ("summary.json", to_json(told, "summary.json")),
        ("landmarks.json", to_json([landmark_json(m) for m in landmarks], "landmarks.json")),
        *(file for robot in robots.items() for file in trajectory_files(robot)),
    ]
    if history.scans:
        files.append((SCANS_FILE, scans_bytes(history.scans)))
    world = [m for m in landmarks if m.frame is None]
    paths = {
        name: robot.final.poses[thinned_index(robot.final.poses[:, :2]), :2]
        for name, robot in robots.items()
        if told["frames"].get(name) == told["world"]
    }
    files.append(("report.html", _page(svg_text(world, paths), told)))
    with atomic_folder(target, before) as part:
        for name, content in files:
            path = part / name
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(content.encode(errors="backslashreplace") if isinstance(content, str)
                             else content)  # fmt: skip
        if robots:
            make_map(part, part)


def _page(drawing: str, told: Mapping[str, Any]) -> str:
    """report.html: the map so far and a few numbers; it loads itself again."""
    live = told["live"]
    going = live["state"] == "following"
    counts = told["counts"]
    tiles = [
        ("recorded", duration(live["recorded_s"])),
        ("estimates", number(live["estimates"])),
        ("keyframes", number(counts["keyframes"])),
        ("landmarks", number(counts["landmarks"])),
        ("loop closures", number(counts["loop_closures"])),
        ("largest jump", length(live["largest_jump_m"])),
    ]
    name = Path(told["logs"][0]["path"]).name
    lead = "Where the robots are, by the data so far; what comes later does not change it."
    sections = [
        header("graphslam follow", name, f"{lead} State: {live['state']}.", tiles),
        warning_box(told["warnings"]),
        section("Map so far" if going else "Map", f"<figure>{drawing}</figure>"),
    ]
    page = document(name, sections, CSS)
    refresh = f'<meta http-equiv="refresh" content="{RELOAD_S}">'
    return page.replace("<head>", f"<head>{refresh}", 1) if going else page
