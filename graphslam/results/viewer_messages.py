"""ROS 2 messages that viewers show: point clouds, markers, paths, grids, transforms."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from graphslam.core.geometry import Array
from graphslam.logs import schemas
from graphslam.results.occupancy_grid import GridMap

CLOUD = "sensor_msgs/msg/PointCloud2"
MARKERS = "visualization_msgs/msg/MarkerArray"
PATH = "nav_msgs/msg/Path"
GRID = "nav_msgs/msg/OccupancyGrid"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"

#: types of visualization_msgs/Marker
LINE_STRIP, LINE_LIST, SPHERE_LIST, TEXT = 4, 5, 7, 9
_FLOAT32, _FLOAT64 = 7, 8
#: m: coordinates as of maps in UTM, of which a float32 has no millimetres
_FAR_M = 4096.0

Rgb = tuple[float, float, float]


def point_cloud(points: Array, stamp_ns: int, frame: str) -> Any:
    """PointCloud2 of points (n, 2) m, at z = 0; coordinates are float64 where they are large."""
    is_far = bool((np.abs(points) > _FAR_M).any())
    data = np.zeros((len(points), 3), dtype="<f8" if is_far else "<f4")
    data[:, :2] = points
    size, kind = data.itemsize, _FLOAT64 if is_far else _FLOAT32
    fields = [
        schemas.build(
            "sensor_msgs/msg/PointField", name=axis, offset=size * i, datatype=kind, count=1
        )
        for i, axis in enumerate("xyz")
    ]
    return schemas.build(
        CLOUD, header=schemas.header(stamp_ns, frame), height=1, width=len(points), fields=fields,
        is_bigendian=False, point_step=3 * size, row_step=3 * size * len(points),
        data=data.reshape(-1).view(np.uint8), is_dense=True,
    )  # fmt: skip


def marker(
    number: int,
    kind: int,
    points: Array,
    *,
    stamp_ns: int,
    frame: str,
    namespace: str,
    size_m: float,
    rgb: Rgb,
    text: str = "",
) -> Any:
    """A Marker of points (n, 2) m; a text stands at their mean and is ``size_m`` high.

    ``number`` is its id; ``kind`` one of the types above; ``rgb`` from 0 to 1.
    """
    build = schemas.build
    at = points.mean(axis=0) if text else np.zeros(2)
    upright = build("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    r, g, b = rgb
    return build(
        "visualization_msgs/msg/Marker",
        header=schemas.header(stamp_ns, frame),
        ns=namespace, id=number, type=kind, action=0,
        pose=build("geometry_msgs/msg/Pose", position=_point(*at), orientation=upright),
        scale=build(
            "geometry_msgs/msg/Vector3", x=size_m, y=size_m if kind == SPHERE_LIST else 0.0,
            z=size_m,
        ),
        color=build("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=1.0),
        lifetime=build("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
        frame_locked=False,
        points=[] if text else [_point(x, y) for x, y in points],
        colors=[], texture_resource="",
        texture=build(
            "sensor_msgs/msg/CompressedImage", header=schemas.header(0, ""), format="",
            data=np.zeros(0, dtype=np.uint8),
        ),
        uv_coordinates=[], text=text, mesh_resource="",
        mesh_file=build("visualization_msgs/msg/MeshFile", filename="", data=np.zeros(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )  # fmt: skip


def marker_array(markers: Sequence[Any]) -> Any:
    """A MarkerArray."""
    return schemas.build(MARKERS, markers=list(markers))


def path(poses: Array, stamps_ns: Sequence[int], stamp_ns: int, frame: str) -> Any:
    """A Path through poses (n, 3), m and rad, each with its own stamp."""
    entries = [
        schemas.build(
            "geometry_msgs/msg/PoseStamped", header=schemas.header(t, frame), pose=_pose(pose)
        )
        for t, pose in zip(stamps_ns, poses, strict=True)
    ]
    return schemas.build(PATH, header=schemas.header(stamp_ns, frame), poses=entries)


def pose_with_covariance(pose: Array, cov: Array, stamp_ns: int, frame: str) -> Any:
    """A pose (3,) with its covariance (3, 3) of x, y, heading along the axes of ``frame``."""
    full = np.zeros((6, 6))
    full[np.ix_((0, 1, 5), (0, 1, 5))] = cov
    stated = schemas.build(
        "geometry_msgs/msg/PoseWithCovariance", pose=_pose(pose), covariance=full.ravel()
    )
    return schemas.build(POSE, header=schemas.header(stamp_ns, frame), pose=stated)


def transforms(stamp_ns: int, frames: Sequence[tuple[str, str, Array]]) -> Any:
    """A TFMessage of (parent, child, pose (3,) of the child in the parent, m and rad)."""
    return schemas.build(
        TRANSFORMS,
        transforms=[
            schemas.build(
                "geometry_msgs/msg/TransformStamped",
                header=schemas.header(stamp_ns, parent),
                child_frame_id=child,
                transform=schemas.build(
                    "geometry_msgs/msg/Transform",
                    translation=schemas.build(
                        "geometry_msgs/msg/Vector3", x=float(x), y=float(y), z=0.0
                    ),
                    rotation=_turned(float(phi)),
                ),
            )
            for parent, child, (x, y, phi) in frames
        ],
    )


def occupancy(grid: GridMap, stamp_ns: int, frame: str) -> Any:
    """An OccupancyGrid: the probability of being occupied in per cent, -1 where unknown."""
    rows, columns = grid.log_odds.shape
    percent = 100 / (1 + np.exp(-np.nan_to_num(grid.log_odds)))
    cells = np.where(np.isnan(grid.log_odds), -1, np.round(percent)).astype(np.int8)
    x, y = grid.origin_m
    about = schemas.build(
        "nav_msgs/msg/MapMetaData", map_load_time=schemas.time(stamp_ns), resolution=grid.cell_m,
        width=columns, height=rows, origin=_pose(np.array([x, y, 0.0])),
    )  # fmt: skip
    header = schemas.header(stamp_ns, frame)
    return schemas.build(GRID, header=header, info=about, data=cells.ravel())


def _pose(pose: Array) -> Any:
    x, y, phi = (float(v) for v in pose)
    return schemas.build("geometry_msgs/msg/Pose", position=_point(x, y), orientation=_turned(phi))


def _turned(phi: float) -> Any:
    z, w = float(np.sin(phi / 2)), float(np.cos(phi / 2))
    return schemas.build("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=z, w=w)


def _point(x: float, y: float) -> Any:
    return schemas.build("geometry_msgs/msg/Point", x=float(x), y=float(y), z=0.0)
