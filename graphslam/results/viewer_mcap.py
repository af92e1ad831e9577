"""result.mcap: a result for Foxglove, Lichtblick and RViz, in messages of ROS 2 only.

Everything has its own time, so that playing the file replays the drive with the final estimate.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from graphslam.core.geometry import Array, compose, inverse
from graphslam.core.output_folder import files_in
from graphslam.core.records import Landmark
from graphslam.logs.writer import LogWriter
from graphslam.results import viewer_messages as ros
from graphslam.results.line_map import PATH_STEP_M, thinned_index
from graphslam.results.scene import (
    ELLIPSE_EVERY_S,
    Scene,
    SceneRobot,
    by_frame,
    every,
    read_scene,
    scan_points,
    uncertainty_lines,
)

FILE, LAYOUT = "result.mcap", "result.layout.json"
#: landmarks that have their number written beside them, those with the most sightings
MAX_LABELS = 200
#: s between two transforms of a robot without scans, whose trajectory has ten poses a second
POSE_EVERY_S = 1.0
#: more for a drive that would have more of them than this, and more ellipses
MOST_POSES = 3000
#: a path has a pose at every such part of its extent, but not nearer than `PATH_STEP_M`
PATH_STEPS = 1000
#: height of the camera above the map, in sizes of the map, and at least, m
VIEW, LEAST_VIEW_M = 1.5, 20.0
_BLACK, _RED, _BLUE = (0.1, 0.1, 0.1), (0.85, 0.3, 0.1), (0.17, 0.37, 0.7)


class _Event(NamedTuple):
    stamp_ns: int
    topic: str
    schema: str
    make: Callable[[], Any]


def write_result_mcap(directory: Path, target: Path, *, force: bool = False) -> list[str]:
    """Write result.mcap and its layout for Foxglove and Lichtblick; the names of the files.

    Args:
        directory: the result folder.
        target: the folder for the files, which may be ``directory``.
        force: replace files of these names.

    Raises:
        OutputError: it is no result folder, a file exists, or the disk refuses; no partial file is
            left.
    """
    names = [FILE, LAYOUT]
    scene = read_scene(directory)
    with files_in(target, names, force=force) as part:
        with LogWriter(part / FILE) as log:
            for event in sorted(_events(scene), key=lambda e: e.stamp_ns):
                log.message(event.topic, event.schema, event.make(), event.stamp_ns)
        (part / LAYOUT).write_text(layout(scene), encoding="utf-8")
    return names


def _events(scene: Scene) -> Iterator[_Event]:
    """All messages; those of one stamp in the order in which a viewer needs them."""
    begin = scene.begin_ns
    if scene.grid is not None:
        yield _Event(begin, "/map", ros.GRID, partial(ros.occupancy, scene.grid, begin, "map"))
    for frame, landmarks in by_frame(scene):
        topic = "/landmarks" if frame == "map" else f"/{frame}/landmarks"
        make = partial(_landmark_markers, landmarks, begin, frame)
        yield _Event(begin, topic, ros.MARKERS, make)
    for robot in scene.robots:
        yield from _robot_events(robot, begin)
    for scan in scene.scans:
        robot = next(r for r in scene.robots if r.name == scan.robot)
        make = partial(ros.point_cloud, scan_points(scan), scan.time_ns, robot.world)
        yield _Event(max(scan.time_ns, begin), robot.topic("scan_points"), ros.CLOUD, make)


def _robot_events(robot: SceneRobot, begin: int) -> Iterator[_Event]:
    final, odometry = robot.final, robot.odometry
    stamps = final.stamps_ns.tolist()
    for name, trajectory in (("path", final), ("odometry_path", odometry)):
        if trajectory is not None:
            xy = trajectory.poses[:, :2]
            size = float(np.hypot(*np.ptp(final.poses[:, :2], axis=0)))
            rows = thinned_index(xy, max(PATH_STEP_M, size / PATH_STEPS))
            times = trajectory.stamps_ns[rows].tolist()
            make = partial(ros.path, trajectory.poses[rows], times, begin, robot.world)
            yield _Event(begin, robot.topic(name), ros.PATH, make)
    pace = max(POSE_EVERY_S, 1e-9 * (stamps[-1] - stamps[0]) / MOST_POSES)
    shown = range(len(stamps)) if robot.has_scans else every(final.stamps_ns, pace)
    for k in shown:
        yield _Event(stamps[k], "/tf", ros.TRANSFORMS, partial(_transforms, robot, k))
    for k in every(final.stamps_ns, max(pace, ELLIPSE_EVERY_S)):
        if np.isfinite(final.covs[k]).all():
            make = partial(
                ros.pose_with_covariance, final.poses[k], final.covs[k], stamps[k], robot.world
            )
            yield _Event(stamps[k], robot.topic("pose"), ros.POSE, make)


def _transforms(robot: SceneRobot, k: int) -> Any:
    """World -> odom -> base; their product is the final pose."""
    pose = robot.final.poses[k]
    base = robot.frame("base_link")
    stamp = int(robot.final.stamps_ns[k])
    if robot.odometry is None:
        return ros.transforms(stamp, [(robot.world, base, pose)])
    by_odometry = robot.odometry.poses[k]
    odom = robot.frame("odom")
    correction = compose(pose, inverse(by_odometry))
    return ros.transforms(stamp, [(robot.world, odom, correction), (odom, base, by_odometry)])


def _landmark_markers(landmarks: Sequence[Landmark], stamp: int, frame: str) -> Any:
    """Walls, points, their 95 % bounds, and the numbers of those with the most sightings."""
    walls = [m.extent for m in landmarks if m.kind != "point"]
    points = [m.position[:2] for m in landmarks if m.kind == "point"]
    bounds = [uncertainty_lines(m).reshape(-1, 2) for m in landmarks]
    mark = partial(ros.marker, stamp_ns=stamp, frame=frame)
    found = []
    for name, kind, parts, size, rgb in (
        ("walls", ros.LINE_LIST, walls, 0.04, _BLACK),
        ("points", ros.SPHERE_LIST, points, 0.12, _BLACK),
        ("95 %", ros.LINE_LIST, bounds, 0.02, _RED),
    ):
        if parts:
            at: Array = np.concatenate([np.reshape(part, (-1, 2)) for part in parts])
            found.append(mark(0, kind, at, namespace=name, size_m=size, rgb=rgb))
    label = partial(mark, namespace="numbers", size_m=0.2, rgb=_BLUE)
    named = sorted(landmarks, key=lambda m: (-m.sightings, m.id))[:MAX_LABELS]
    found += [label(m.id, ros.TEXT, m.extent, text=str(m.id)) for m in named]
    return ros.marker_array(found)


def _bounds(scene: Scene) -> tuple[Array, Array]:
    """Corners (2,), m, of what is in frame ``map``."""
    inside = [robot.final.poses[:, :2] for robot in scene.robots if robot.world == "map"]
    inside += [m.extent for m in scene.landmarks if scene.frame_of(m) == "map"]
    points = np.concatenate(inside) if inside else np.zeros((1, 2))
    return points.min(axis=0), points.max(axis=0)


def layout(scene: Scene) -> str:
    """A layout for Foxglove and Lichtblick, which hide topics until they are asked to show them."""
    topics: dict[str, Any] = {"/map": {"visible": True, "colorMode": "map", "alpha": 0.6}}
    for frame, _ in by_frame(scene):
        topics["/landmarks" if frame == "map" else f"/{frame}/landmarks"] = {"visible": True}
    for robot in scene.robots:
        topics |= {
            robot.topic("path"): _line("#d9480fff"),
            robot.topic("odometry_path"): _line("#868e96ff"),
            robot.topic("pose"): {"visible": True, "showCovariance": True},
            robot.topic("scan_points"): {
                "visible": True,
                "colorMode": "flat",
                "flatColor": "#1c7ed6ff",
                "pointSize": 2,
                "decayTime": 1,
            },
        }
    low, high = _bounds(scene)
    x, y = ((low + high) / 2).tolist()
    panel = {
        "cameraState": {
            "perspective": False,
            "distance": max(float((high - low).max()) * VIEW, LEAST_VIEW_M),
            "phi": 0,
            "thetaOffset": 90,
            "targetOffset": [x, y, 0],
            "target": [0, 0, 0],
            "targetOrientation": [0, 0, 0, 1],
            "fovy": 45,
            "near": 0.5,
            "far": 5000,
        },
        "followMode": "follow-none",
        "followTf": "map",
        "scene": {"transforms": {"showLabel": False}},
        "transforms": {},
        "topics": topics,
        "layers": {},
        "publish": {},
    }
    whole = {
        "configById": {"3D!result": panel},
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 5},
        "layout": "3D!result",
    }
    return json.dumps(whole, indent=1) + "\n"


def _line(color: str) -> dict[str, Any]:
    return {"visible": True, "type": "line", "lineWidth": 0.05, "gradient": [color, color]}
