"""Planar point clouds are scans, others are refused; velocities are the last resort for motion."""

from pathlib import Path

import numpy as np
import pytest
from command_line import call
from room_log import MOUNT, SCAN, START_NS, S, drive

import graphslam
from graphslam.core import records
from graphslam.core.config import Config
from graphslam.core.errors import LogError
from graphslam.core.geometry import Array, polar_points
from graphslam.logs import LogWriter, inspect_logs, open_logs, schemas
from graphslam.logs.point_cloud import cloud_points, is_planar, sweep_of


def cloud(points: Array, stamp: int, code: int = 8, pad: int = 3) -> object:
    """A PointCloud2 (n, 3) with points of an odd size, in rows that end with other bytes."""
    kind = {7: "<f4", 8: "<f8"}[code]
    size = np.dtype(kind).itemsize
    raw = np.zeros((len(points), 3 * size + 1 + pad), dtype=np.uint8)
    raw[:, pad : pad + 3 * size] = points.astype(kind).view(np.uint8).reshape(len(points), -1)
    fields = [
        schemas.build(
            "sensor_msgs/msg/PointField", name=n, offset=pad + k * size, datatype=code, count=1
        )
        for k, n in enumerate("xyz")
    ]
    return schemas.build(
        schemas.POINT_CLOUD,
        header=schemas.header(stamp, "laser"),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=raw.shape[1],
        row_step=raw.size + 5,
        data=np.append(raw.ravel(), np.zeros(5, dtype=np.uint8)),
        is_dense=True,
    )


def test_rows_whose_length_is_not_said_are_as_long_as_their_points():
    """Some drivers leave ``row_step`` at zero."""
    points = np.array([[1.0, 2.0, 0.1], [3.0, 4.0, 0.1]])
    made = cloud(points, 0)
    made.row_step = 0
    np.testing.assert_array_equal(cloud_points(made), points)


def as_clouds(log: Path, path: Path, height: float = 0.0) -> Path:
    """The log with its scans as clouds: points without order, of a laser at some height."""
    with LogWriter(path) as out:
        out.mount("robot", START_NS, MOUNT)
        for message in open_logs([log], Config()).messages():
            if isinstance(message, records.OdometryPose):
                out.odometry("robot", message.stamp_ns, message.pose)
            elif isinstance(message, records.Scan):
                known = np.isfinite(message.ranges)
                flat = polar_points(message.ranges[known], message.angles[known])
                points = np.column_stack([flat, np.full(len(flat), height)])[::-1]
                own = cloud(points, message.stamp_ns)
                out.message("/points", schemas.POINT_CLOUD, own, message.stamp_ns)
    return path


def test_a_planar_cloud_gives_the_trajectory_of_its_scan(tmp_path):
    log = drive(tmp_path / "room.mcap", seconds=10, truth=False)
    expected = graphslam.smooth(log).robots["robot"].final
    path = as_clouds(log, tmp_path / "clouds.mcap", height=0.3)
    found = graphslam.smooth(path)
    np.testing.assert_allclose(found.robots["robot"].final.poses, expected.poses, atol=1e-6)
    assert any("it is read as scans" in line for line in found.summary["warnings"])
    info = inspect_logs([path], Config())
    shape = next(topic.scan for topic in info.topics if topic.name == "/points")
    assert shape.beams == 181 and shape.field_of_view_rad == pytest.approx(np.pi)
    assert info.usable and not info.doubtful


def test_beams_without_a_return_are_put_in_and_echoes_left_out():
    angles, ranges = np.radians(np.arange(-90, 91.0)), np.linspace(1, 5, 181)
    kept = np.ones(181, dtype=bool)
    kept[[5, 50, 51, 52, 120]] = False
    flat = polar_points(ranges[kept], angles[kept])
    echoes = polar_points(ranges[kept][::9] + 0.5, angles[kept][::9])
    points = np.column_stack([*np.vstack([flat, echoes]).T, np.zeros(len(flat) + len(echoes))])
    bearings, found = sweep_of(np.random.default_rng(0).permutation(points))
    np.testing.assert_allclose(bearings, angles, atol=1e-12)
    np.testing.assert_allclose(found, np.where(kept, ranges, np.nan), atol=1e-12)


def rings(count: int) -> Array:
    """Points (n, 3) of a laser of several rings in a room of 6 m."""
    angles = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    planes = [
        np.column_stack([3 * np.cos(angles), 3 * np.sin(angles), np.full(360, 3 * np.tan(tilt))])
        for tilt in np.radians(np.linspace(-15, 15, count))
    ]
    return np.concatenate(planes)


def test_a_laser_with_several_rings_is_refused_with_what_to_do(tmp_path):
    assert is_planar(rings(1)[:, [0, 1, 2]] * [1, 1, 0]) and not is_planar(rings(16))
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        for k in range(10):
            own = cloud(rings(16), START_NS + k, code=7)
            log.message("/velodyne_points", schemas.POINT_CLOUD, own, START_NS + k)
    with pytest.raises(LogError, match=r"/velodyne_points.*pointcloud_to_laserscan"):
        open_logs([path], Config())
    assert call("info", path).code == 1
    with LogWriter(path) as log:
        for k in range(10):
            stamp = START_NS + k * S // 10
            own = cloud(rings(16), stamp, code=7)
            log.message("/velodyne_points", schemas.POINT_CLOUD, own, stamp)
            log.odometry("robot", stamp, (0.1 * k, 0, 0))
            log.scan("robot", stamp, np.ones(181), **SCAN)
    assert {t.name for t in open_logs([path], Config()).topics} == {"/odom", "/scan"}


@pytest.mark.parametrize("stamped", [False, True])
def test_velocities_are_the_odometry_of_a_robot_with_sightings_alone(stamped, tmp_path):
    """Driven as said for 0.5 s after the last command, then not."""
    build, path = schemas.build, tmp_path / "log.mcap"
    with LogWriter(path) as log:
        for tenth in [*range(11), 30]:  # 1 s of commands, then none for 2 s
            stamp = START_NS + tenth * S // 10
            log.sighting("robot", stamp, [0.1, 2.0], np.eye(2), identity="a")
            turn = build("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.2)
            on = build("geometry_msgs/msg/Vector3", x=0.5, y=0.0, z=0.0)
            twist = build("geometry_msgs/msg/Twist", linear=on, angular=turn)
            if stamped:
                kind = schemas.TWIST_STAMPED
                own = build(kind, header=schemas.header(stamp, "base_link"), twist=twist)
                log.message("/twist", kind, own, stamp)
            else:
                log.message("/cmd_vel", schemas.TWIST, twist, stamp)
    log = open_logs([path], Config())
    (line,) = (line for line in log.warnings if "has no odometry" in line)
    assert "velocities of /" in line and "commanded_velocities=true" in line
    found = [m for m in log.messages() if isinstance(m, records.OdometryPose)]
    assert [(m.time_ns - START_NS) / S for m in found] == pytest.approx(
        [*np.arange(0, 1.05, 0.1), 3.0]
    )
    assert found[10].pose[2] == pytest.approx(0.2) and found[-1].pose[2] == pytest.approx(0.3)
    assert np.hypot(*found[10].pose[:2]) == pytest.approx(0.5, rel=0.01)
