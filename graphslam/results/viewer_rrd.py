"""result.rrd: a result for the Rerun viewer, with a blueprint so that it opens ready.

Needs the package `rerun-sdk` (``pip install "coop-graphslam[viewer]"``).
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphslam.core.errors import OutputError
from graphslam.core.geometry import Array
from graphslam.core.output_folder import files_in
from graphslam.core.records import Landmark
from graphslam.results.scene import (
    ELLIPSE_EVERY_S,
    Scene,
    SceneRobot,
    by_frame,
    ellipse,
    every,
    read_scene,
    scan_points,
    uncertainty_lines,
)

FILE = "result.rrd"
TIMELINE = "time"
_BLACK, _RED, _BLUE, _GREY = (25, 25, 25), (217, 72, 15), (28, 126, 214), (134, 142, 150)


def write_result_rrd(directory: Path, target: Path, *, force: bool = False) -> list[str]:
    """Write result.rrd; the names of the files.

    Args:
        directory: the result folder.
        target: the folder for the file, which may be ``directory``.
        force: replace a file of this name.

    Raises:
        OutputError: rerun-sdk is not installed, it is no result folder, the file exists, or the
            disk refuses; no partial file is left.
    """
    try:
        import rerun  # noqa: PLC0415 -- 170 MB, and only this needs it
    except ImportError as error:
        raise OutputError(
            'the Rerun viewer needs rerun-sdk: pip install "coop-graphslam[viewer]"'
        ) from error
    scene = read_scene(directory)
    with files_in(target, [FILE], force=force) as part:
        stream = rerun.RecordingStream("graphslam")
        # not `save`: a thread of the SDK's own would write, and wait for ever on a full disk
        memory = stream.memory_recording()
        stream.send_blueprint(_blueprint(rerun, scene))
        _log_landmarks(rerun, stream, scene)
        for robot in scene.robots:
            _log_robot(rerun, stream, robot)
        _log_scans(rerun, stream, scene)
        content = memory.drain_as_bytes()
        stream.disconnect()
        (part / FILE).write_bytes(content)
    return [FILE]


def _blueprint(rerun: Any, scene: Scene) -> Any:
    """A view of everything from above, and the uncertainty over time."""
    make = rerun.blueprint
    above = make.Spatial3DView(name="Map", origin="/", background=[255, 255, 255])
    plots = [
        make.TimeSeriesView(name=f"Position sigma of {robot.name}, m", origin=f"sigma/{robot.name}")
        for robot in scene.robots
        if np.isfinite(robot.final.covs).any()
    ]
    rows = [above, make.Horizontal(*plots)] if plots else [above]
    return make.Blueprint(
        make.Vertical(*rows, row_shares=[4, 1][: len(rows)]),
        make.TimePanel(timeline=TIMELINE),
        collapse_panels=True,
    )


def _log_landmarks(rerun: Any, stream: Any, scene: Scene) -> None:
    """Walls, points and their bounds, and the occupied cells; they are there at all times."""
    for frame, landmarks in by_frame(scene):
        walls = [m for m in landmarks if m.kind != "point"]
        points = [m for m in landmarks if m.kind == "point"]
        if walls:
            lines = [_flat(m.extent) for m in walls]
            made = rerun.LineStrips3D(
                lines, radii=0.02, colors=_BLACK, labels=_labels(walls), show_labels=False
            )
            stream.log(f"{frame}/walls", made, static=True)
        if points:
            at = _flat(np.array([m.position[:2] for m in points]))
            made = rerun.Points3D(at, radii=0.06, colors=_BLACK, labels=_labels(points))
            stream.log(f"{frame}/points", made, static=True)
        bounds = [_flat(piece) for m in landmarks for piece in uncertainty_lines(m)]
        made = rerun.LineStrips3D(bounds, radii=0.01, colors=_RED)
        stream.log(f"{frame}/bounds_95", made, static=True)
    if scene.grid is not None:
        j, i = np.nonzero(scene.grid.occupied)
        cells = np.array(scene.grid.origin_m) + (np.column_stack([i, j]) + 0.5) * scene.grid.cell_m
        made = rerun.Points3D(_flat(cells), radii=scene.grid.cell_m / 2, colors=_GREY)
        stream.log("map/occupied", made, static=True)


def _log_robot(rerun: Any, stream: Any, robot: SceneRobot) -> None:
    """Paths; the robot, its ellipse and its sigma over time."""
    final, root = robot.final, f"{robot.world}/{robot.name}"
    for name, trajectory, color in (
        ("path", final, _RED),
        ("odometry", robot.odometry, _GREY),
    ):
        if trajectory is not None:
            line = rerun.LineStrips3D([_flat(trajectory.poses[:, :2])], radii=0.015, colors=color)
            stream.log(f"{root}/{name}", line, static=True)
    times = rerun.TimeColumn(TIMELINE, timestamp=_times(final.stamps_ns))
    ahead = np.column_stack([np.cos(final.poses[:, 2]), np.sin(final.poses[:, 2])])
    arrows = rerun.Arrows3D.columns(origins=_flat(final.poses[:, :2]), vectors=_flat(0.5 * ahead))
    stream.send_columns(f"{root}/robot", indexes=[times], columns=arrows)
    known = np.flatnonzero(np.isfinite(final.covs).all(axis=(1, 2)))
    for k in known[every(final.stamps_ns[known], ELLIPSE_EVERY_S)].tolist():
        stream.set_time(TIMELINE, timestamp=_times(final.stamps_ns[k]))
        ring = _flat(ellipse(final.poses[k, :2], final.covs[k, :2, :2]))
        stream.log(f"{root}/ellipse_95", rerun.LineStrips3D([ring], colors=_RED))
    if len(known):
        sigmas = np.sqrt(np.linalg.eigvalsh(final.covs[known, :2, :2])[:, -1])
        times = rerun.TimeColumn(TIMELINE, timestamp=_times(final.stamps_ns[known]))
        columns = rerun.Scalars.columns(scalars=sigmas)
        stream.send_columns(f"sigma/{robot.name}", indexes=[times], columns=columns)


def _log_scans(rerun: Any, stream: Any, scene: Scene) -> None:
    worlds = {robot.name: robot.world for robot in scene.robots}
    for scan in scene.scans:
        stream.set_time(TIMELINE, timestamp=_times(np.int64(scan.time_ns)))
        points = rerun.Points3D(_flat(scan_points(scan)), radii=0.03, colors=_BLUE)
        stream.log(f"{worlds[scan.robot]}/{scan.robot}/scan", points)


def _flat(points: Array) -> Array:
    """Points (n, 3) at height 0 of points (n, 2)."""
    return np.column_stack([points, np.zeros(len(points))])


def _times(stamps_ns: NDArray[np.int64] | np.int64) -> Any:
    return stamps_ns.astype("datetime64[ns]")


def _labels(landmarks: list[Landmark]) -> list[str]:
    return [f"{m.id}" + (f" ({m.identity})" if m.identity else "") for m in landmarks]
