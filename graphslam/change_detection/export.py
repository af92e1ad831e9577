"""Changes for other tools: a map to overlay on the reference's, and an MCAP file for viewers."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from graphslam.change_detection.detect import ChangeResult
from graphslam.change_detection.grid import Grid
from graphslam.change_detection.objects import Change
from graphslam.core.geometry import Array
from graphslam.logs import schemas
from graphslam.logs.writer import LogWriter
from graphslam.results.grid_map import FREE, OCCUPIED, UNKNOWN, write_grid_map

_FRAME = "map"
#: red, green, blue of the kinds
_RGB = {"appeared": (0.16, 0.63, 0.17), "vanished": (0.89, 0.34, 0.1), "moved": (0.58, 0.2, 0.75)}
_MAX_POINTS = 200_000
_LINE_STRIP, _TEXT, _POINT_FLOAT32 = 4, 9, 7


def write_overlay_map(folder: Path, grid: Grid, old: Iterable[Array], new: Iterable[Array]) -> None:
    """The changes as a map ``changes`` for nav2's map_server.

    Occupied within the polygons (m, 2) of ``new``: something is there now; free within those of
    ``old``: something was there before; unknown elsewhere. Overlaid on the reference's map it gives
    the current map.
    """
    image = np.full(grid.shape[::-1], UNKNOWN, dtype=np.uint8)
    for polygons, value in ((old, FREE), (new, OCCUPIED)):  # the new are drawn over the old
        for polygon in polygons:
            cells = (polygon - np.array(grid.origin_m)) / grid.cell_m - 0.5
            cv2.fillPoly(image, [np.round(cells).astype(np.int32)], value)
    write_grid_map(
        folder, "changes", image, cell_m=grid.cell_m, origin_m=grid.origin_m,
        meaning="changes: occupied = appeared or moved here, free = vanished or moved away",
    )  # fmt: skip


def write_mcap(found: ChangeResult, path: Path) -> None:
    """MCAP for viewers: `/changes` as markers, `/reference` and `/later` as point clouds.

    Each change has the stamp at which it was first observed.

    Raises:
        OutputError: the file cannot be written.
    """
    begin = int(found.later.stamps_ns.min())
    with LogWriter(path) as log:
        for name, visit in (("reference", found.reference), ("later", found.later)):
            cloud = schemas.build(
                "sensor_msgs/msg/PointCloud2", **_cloud(visit.ends[visit.surface], begin)
            )
            log.message(f"/{name}", "sensor_msgs/msg/PointCloud2", cloud, begin)
        for stamp in sorted({change.first_seen_ns for change in found.changes}):
            markers = [
                marker
                for number, change in enumerate(found.changes)
                if change.first_seen_ns == stamp
                for marker in _markers(number, change)
            ]
            kind = "visualization_msgs/msg/MarkerArray"
            log.message("/changes", kind, schemas.build(kind, markers=markers), stamp)


def _cloud(points: Array, stamp_ns: int) -> dict[str, Any]:
    points = points[:: max(1, len(points) // _MAX_POINTS)]
    data = np.zeros((len(points), 3), dtype="<f4")
    data[:, :2] = points
    fields = [
        schemas.build(
            "sensor_msgs/msg/PointField", name=axis, offset=4 * i, datatype=_POINT_FLOAT32, count=1
        )
        for i, axis in enumerate("xyz")
    ]
    return {
        "header": schemas.header(stamp_ns, _FRAME), "height": 1, "width": len(points),
        "fields": fields, "is_bigendian": False, "point_step": 12, "row_step": 12 * len(points),
        "data": data.reshape(-1).view(np.uint8), "is_dense": True,
    }  # fmt: skip


def _markers(number: int, change: Change) -> list[Any]:
    """Markers of the outline, of the old one if it is known, and of a label."""
    lines = [_marker(3 * number, change, _LINE_STRIP, change.polygon, 0.03, "")]
    if change.before is not None:
        lines.append(_marker(3 * number + 1, change, _LINE_STRIP, change.before, 0.015, ""))
    label = f"{number + 1} {change.kind}"
    return [*lines, _marker(3 * number + 2, change, _TEXT, change.polygon, 0.25, label)]


def _marker(
    number: int, change: Change, kind: int, polygon: Array, size_m: float, text: str
) -> Any:
    def point(x: float, y: float) -> Any:
        return schemas.build("geometry_msgs/msg/Point", x=float(x), y=float(y), z=0.0)

    build = schemas.build
    at = polygon.mean(axis=0) if text else np.zeros(2)
    upright = build("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    r, g, b = _RGB[change.kind]
    return build(
        "visualization_msgs/msg/Marker",
        header=schemas.header(change.first_seen_ns, _FRAME),
        ns="changes", id=number, type=kind, action=0,
        pose=build("geometry_msgs/msg/Pose", position=point(*at), orientation=upright),
        scale=build("geometry_msgs/msg/Vector3", x=size_m, y=0.0, z=size_m),
        color=build("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=1.0),
        lifetime=build("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
        frame_locked=False,
        points=[] if text else [point(x, y) for x, y in [*polygon, polygon[0]]],
        colors=[], texture_resource="",
        texture=build(
            "sensor_msgs/msg/CompressedImage", header=schemas.header(0, ""), format="",
            data=np.zeros(0, dtype=np.uint8),
        ),
        uv_coordinates=[], text=text, mesh_resource="",
        mesh_file=build("visualization_msgs/msg/MeshFile", filename="", data=np.zeros(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )  # fmt: skip
