"""Who is whose: recordings as robots make them are smoothed without any option.

The recordings have names, frames and other topics of real robots: two hops of tf_static, IMU,
commands, a map, rosout, camera info. The drive is that of `room_log`.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from recordings import messages_of
from room_log import BEAMS, MOUNT, SCAN, START_NS, S, drive

import graphslam
from graphslam.core import records
from graphslam.core.config import Config
from graphslam.core.config_io import load_config
from graphslam.core.errors import LogError
from graphslam.core.geometry import between
from graphslam.logs import LogWriter, inspect_logs, open_logs, schemas

#: base frame, frame of the laser
BASE, LASER = "base_footprint", "base_scan"


def pose_message(stamp: int, parent: str, child: str, pose: np.ndarray) -> object:
    x, y, phi = (float(v) for v in pose)
    build = schemas.build
    vector = build("geometry_msgs/msg/Vector3", x=x, y=y, z=0.0)
    turn = build("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=np.sin(phi / 2), w=np.cos(phi / 2))
    transform = build("geometry_msgs/msg/Transform", translation=vector, rotation=turn)
    return build(
        "geometry_msgs/msg/TransformStamped",
        header=schemas.header(stamp, parent),
        child_frame_id=child,
        transform=transform,
    )


class Robot:
    """Writes what one robot publishes; ``names``: the topics of its odometry and its scans."""

    def __init__(self, log: LogWriter, prefix: str = "", tf: str = "/tf", **names: str) -> None:
        self.log, self.prefix, self.tf = log, prefix, tf
        self.names = {"odometry": "/odom", "scan": "/scan"} | names
        # base_footprint -> base_link -> base_scan: two hops, as with a TurtleBot
        half = np.array([0.1, 0.05, 0.0])
        hops = [
            pose_message(START_NS, self.frame(BASE), self.frame("base_link"), half),
            pose_message(START_NS, self.frame("base_link"), self.frame(LASER), MOUNT - half),
        ]
        self.transforms(f"{tf}_static", START_NS, hops)

    def frame(self, name: str) -> str:
        return self.prefix + name

    def transforms(self, topic: str, stamp: int, transforms: list) -> None:
        message = schemas.build(schemas.TF_MESSAGE, transforms=transforms)
        self.log.message(topic, schemas.TF_MESSAGE, message, stamp)

    def odometry(self, stamp: int, pose: np.ndarray) -> None:
        data = schemas.build(
            schemas.ODOMETRY,
            header=schemas.header(stamp, self.frame("odom")),
            child_frame_id=self.frame(BASE),
            pose=_pose_of(pose),
            twist=_no_twist(),
        )
        self.log.message(self.names["odometry"], schemas.ODOMETRY, data, stamp)

    def moving(self, stamp: int, pose: np.ndarray) -> None:
        """The same on /tf, with a joint that moves and a localisation that jumps."""
        jump = np.array([stamp // (5 * S) % 3, 0.0, 0.0])
        wheel = np.array([0.0, 0.1, stamp * 1e-9 % 3])
        self.transforms(
            self.tf,
            stamp,
            [
                pose_message(stamp, "map", self.frame("odom"), jump),
                pose_message(stamp, self.frame("odom"), self.frame(BASE), pose),
                pose_message(stamp, self.frame("base_link"), self.frame("wheel"), wheel),
            ],
        )

    def scan(self, scan: records.Scan, stamp: int) -> None:
        message = schemas.build(
            schemas.LASER_SCAN,
            header=schemas.header(stamp, self.frame(LASER)),
            angle_min=scan.angle_min_rad,
            angle_max=scan.angle_min_rad + scan.angle_step_rad * (len(scan.ranges) - 1),
            angle_increment=scan.angle_step_rad,
            time_increment=0.0,
            scan_time=0.1,
            range_min=0.0,
            range_max=20.0,
            ranges=np.asarray(scan.ranges, dtype=np.float32),
            intensities=np.zeros(len(scan.ranges), dtype=np.float32),
        )
        self.log.message(self.names["scan"], schemas.LASER_SCAN, message, stamp)

    def others(self, stamp: int) -> None:
        """What is recorded besides, and not used."""
        build, header = schemas.build, schemas.header
        no = build("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        twist = build("geometry_msgs/msg/Twist", linear=no, angular=no)
        self.log.message("/cmd_vel", "geometry_msgs/msg/Twist", twist, stamp)
        text = build("std_msgs/msg/String", data="started")
        self.log.message("/rosout", "std_msgs/msg/String", text, stamp)
        turn = build("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
        imu = build(
            "sensor_msgs/msg/Imu",
            header=header(stamp, self.frame("imu_link")),
            orientation=turn,
            orientation_covariance=np.zeros(9),
            angular_velocity=no,
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=no,
            linear_acceleration_covariance=np.zeros(9),
        )
        self.log.message("/imu", "sensor_msgs/msg/Imu", imu, stamp)
        if not (stamp - START_NS) % (5 * S):
            self.log.message("/map", "nav_msgs/msg/OccupancyGrid", _map(stamp), stamp)
            camera = build(
                "sensor_msgs/msg/CameraInfo",
                header=header(stamp, self.frame("camera")),
                height=480,
                width=640,
                distortion_model="plumb_bob",
                d=np.zeros(5),
                k=np.eye(3).ravel(),
                r=np.eye(3).ravel(),
                p=np.zeros(12),
                binning_x=0,
                binning_y=0,
                roi=build(
                    "sensor_msgs/msg/RegionOfInterest",
                    x_offset=0, y_offset=0, height=0, width=0, do_rectify=False,
                ),
            )  # fmt: skip
            self.log.message("/camera/camera_info", "sensor_msgs/msg/CameraInfo", camera, stamp)
        joints = build(
            schemas.JOINT_STATE,
            header=header(stamp, ""),
            name=["wheel_left_joint", "wheel_right_joint"],
            position=np.array([stamp * 1e-9 % 100, 0.0]),
            velocity=np.zeros(0),
            effort=np.zeros(0),
        )
        self.log.message("/joint_states", schemas.JOINT_STATE, joints, stamp)


def _map(stamp: int) -> object:
    """What Nav2's map_server latches."""
    build = schemas.build
    info = build(
        "nav_msgs/msg/MapMetaData",
        map_load_time=schemas.time(stamp),
        resolution=0.05,
        width=4,
        height=3,
        origin=_pose_of(np.zeros(3)).pose,
    )
    cells = np.full(12, -1, dtype=np.int8)
    kind = "nav_msgs/msg/OccupancyGrid"
    return build(kind, header=schemas.header(stamp, "map"), info=info, data=cells)


def _pose_of(pose: np.ndarray) -> object:
    x, y, phi = (float(v) for v in pose)
    build = schemas.build
    point = build("geometry_msgs/msg/Point", x=x, y=y, z=0.0)
    turn = build("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=np.sin(phi / 2), w=np.cos(phi / 2))
    own = build("geometry_msgs/msg/Pose", position=point, orientation=turn)
    return build("geometry_msgs/msg/PoseWithCovariance", pose=own, covariance=np.zeros(36))


def _no_twist() -> object:
    no = schemas.build("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    twist = schemas.build("geometry_msgs/msg/Twist", linear=no, angular=no)
    kind = "geometry_msgs/msg/TwistWithCovariance"
    return schemas.build(kind, twist=twist, covariance=np.zeros(36))


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> list[records.Message]:
    path = drive(tmp_path_factory.mktemp("room") / "room.mcap", truth=False)
    return list(open_logs([path], Config()).messages())


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    path = drive(tmp_path_factory.mktemp("expected") / "room.mcap", truth=False)
    return graphslam.smooth(path).robots["robot"].final


def record(
    path: Path,
    room: list[records.Message],
    robots: Callable[[LogWriter], Mapping[Robot, tuple[str, ...]]],
) -> Path:
    """A recording in which each robot drives in the room and publishes some of its messages."""
    with LogWriter(path) as log:
        made = robots(log)
        for message in room:
            for robot, parts in made.items():
                if isinstance(message, records.Scan):
                    robot.scan(message, message.stamp_ns)
                elif isinstance(message, records.OdometryPose):
                    for part in parts:
                        getattr(robot, part)(
                            message.stamp_ns, *([] if part == "others" else [message.pose])
                        )
    return path


def topics_of(path: Path) -> dict[str, str]:
    """Used topics, except those of static transforms, and their robots."""
    return {topic.name: topic.robot for topic in open_logs([path], Config()).topics}


# ---------------------------------------------------------------- one robot

NAMES = {
    "TurtleBot": {},
    "filtered": {"odometry": "/odometry/filtered"},
    "controller": {"odometry": "/diff_drive_controller/odom", "scan": "/lidar/scan"},
    "front": {"scan": "/front/scan"},
    "deep": {"odometry": "/sensors/wheels/odom", "scan": "/hw/lidar/front/scan"},
}


@pytest.mark.parametrize("names", NAMES.values(), ids=NAMES)
def test_one_robot_is_one_robot_whatever_its_topics_are_called(names, room, tmp_path):
    parts = ("odometry", "moving", "others")
    path = record(tmp_path / "log.mcap", room, lambda log: {Robot(log, **names): parts})
    used = topics_of(path)
    wanted = {"odometry": "/odom", "scan": "/scan"} | names
    assert used == dict.fromkeys(wanted.values(), "robot")
    scans = [m for m in open_logs([path], Config()).messages() if isinstance(m, records.Scan)]
    np.testing.assert_allclose(scans[0].mount, MOUNT, atol=1e-12)
    info = inspect_logs([path], Config())
    assert info.usable and not info.doubtful
    unused = {f.topic for f in info.findings if f.check in ("unused", "gyroscope")}
    assert unused >= {"/cmd_vel", "/imu"} and "/rosout" not in unused


def test_two_odometries_of_one_body_are_one_robot(room, tmp_path):
    """`/odometry/filtered` beside `/odom`: a filter's, of the same base."""

    def robots(log):
        own, filtered = Robot(log), Robot(log, odometry="/odometry/filtered")
        filtered.scan = lambda *_: None
        return {own: ("odometry", "others"), filtered: ("odometry",)}

    path = record(tmp_path / "log.mcap", room, robots)
    log = open_logs([path], Config())
    assert log.robots == ("robot",)
    (unused,) = (line for line in log.warnings if "odometry is taken from" in line)
    assert "/odom" in unused and "/odometry/filtered" in unused


@pytest.mark.parametrize(
    ("frames", "used"),
    [
        (("odom", "map"), "/odom"),
        (("a/odom", "/a/Map"), "/odom"),
        (("odom", "world"), "/odom"),
        (("odom", "robot_odom_filtered"), "/localization/odom"),
        (("map", "world"), "/localization/odom"),
    ],
)
def test_odometry_in_a_frame_that_jumps_is_used_only_where_there_is_no_other(
    frames, used, tmp_path
):
    """By REP 105 a robot jumps in map when it is localised; else the one with more messages."""
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        for k in range(40):
            own = ("/odom", frames[0]), ("/localization/odom", frames[1])
            for topic, frame in own[k % 2 :]:  # every second message of the other one alone
                data = schemas.build(
                    schemas.ODOMETRY,
                    header=schemas.header(START_NS + k * S // 20, frame),
                    child_frame_id="base_link",
                    pose=_pose_of(np.array([0.01 * k, 0.0, 0.0])),
                    twist=_no_twist(),
                )
                log.message(topic, schemas.ODOMETRY, data, START_NS + k * S // 20)
            log.scan("robot", START_NS + k * S // 20, np.full(len(BEAMS), 2.0), **SCAN)
    chosen = {topic.name for topic in open_logs([path], Config()).topics}
    assert chosen == {used, "/scan"}
    info = {topic.name: topic.used for topic in inspect_logs([path], Config()).topics}
    assert {name for name, is_used in info.items() if is_used} == chosen


def test_without_any_tf_one_of_each_is_one_robot(room, tmp_path):
    class Bare(Robot):
        def transforms(self, *_):
            pass

    names = {"odometry": "/wheels/odom", "scan": "/front/scan"}
    path = record(tmp_path / "log.mcap", room, lambda log: {Bare(log, **names): ("odometry",)})
    assert topics_of(path) == dict.fromkeys(names.values(), "robot")


# ---------------------------------------------------------------- odometry on /tf


@pytest.mark.parametrize("scan", ["/scan", "/front/scan"])
def test_odometry_that_is_on_tf_only_gives_the_same_trajectory(scan, room, expected, tmp_path):
    """To the stamps' resolution; map -> odom jumps by metres and may not come in."""
    path = record(
        tmp_path / "log.mcap", room, lambda log: {Robot(log, scan=scan): ("moving", "others")}
    )
    log = open_logs([path], Config())
    assert any("taken from /tf: base_footprint in odom" in line for line in log.warnings)
    (found,) = graphslam.smooth(path).robots.values()
    np.testing.assert_array_equal(found.final.stamps_ns, expected.stamps_ns)
    # headings written again as text or quaternion differ by 1e-16, which is not read
    np.testing.assert_array_equal(found.final.poses, expected.poses)


def test_odometry_on_tf_needs_no_transform_to_the_sensor(room, expected, tmp_path):
    """Where the laser is can be told; the odometry was left out, and the laser's path was said to
    be the base's."""

    class Untied(Robot):
        def transforms(self, topic, stamp, transforms):
            if not topic.endswith("_static"):
                super().transforms(topic, stamp, transforms)

    path = record(tmp_path / "log.mcap", room, lambda log: {Untied(log): ("moving",)})
    lines = open_logs([path], Config()).warnings
    assert any("taken from /tf: base_footprint in odom" in line for line in lines)
    assert any("tf_static has no transform from base_footprint" in line for line in lines)
    mount = {"default": {"laser": MOUNT.tolist()}}
    (found,) = graphslam.smooth(path, robots=mount).robots.values()
    # the mount comes through two transforms, or as it is
    np.testing.assert_allclose(found.final.poses, expected.poses, atol=1e-5)


def test_odometry_on_tf_in_two_moving_hops_is_their_product(room, tmp_path):
    """odom -> platform -> base_footprint: as composed, and only when the last hop has come."""
    part = np.array([0.3, -0.2, 0.4])

    class TwoHops(Robot):
        def moving(self, stamp, pose):
            # the platform turns; what is left to the base makes the pose
            turned = part * (1 + 0.1 * np.sin(stamp * 1e-9))
            rest = between(turned, pose)
            self.transforms(
                self.tf,
                stamp,
                [
                    pose_message(stamp, "platform", BASE, rest),
                    pose_message(stamp, "odom", "platform", turned),
                ],
            )

    path = record(tmp_path / "log.mcap", room, lambda log: {TwoHops(log): ("moving",)})
    log = open_logs([path], Config())
    poses = [m.pose for m in log.messages() if isinstance(m, records.OdometryPose)]
    wanted = [m.pose for m in room if isinstance(m, records.OdometryPose)]
    np.testing.assert_allclose(np.array(poses)[:, :2], np.array(wanted)[:, :2], atol=1e-9)
    turned = np.array(poses)[:, 2] - np.array(wanted)[:, 2]
    np.testing.assert_allclose(np.sin(turned), 0, atol=1e-9)


def test_static_transforms_that_are_repeated_on_tf_are_mounts(room, tmp_path):
    """As old publishers of static transforms do."""

    class Repeating(Robot):
        def transforms(self, topic, stamp, transforms):
            self.repeated = transforms if topic.endswith("_static") else self.repeated
            super().transforms("/tf", stamp, [*transforms, *self.repeated])

    path = record(tmp_path / "log.mcap", room, lambda log: {Repeating(log): ("moving",)})
    scans = [m for m in open_logs([path], Config()).messages() if isinstance(m, records.Scan)]
    np.testing.assert_allclose(scans[0].mount, MOUNT, atol=1e-12)


# ---------------------------------------------------------------- several robots


@pytest.mark.parametrize("parts", [("odometry", "others"), ("moving",)])
def test_two_robots_in_one_recording_are_two(parts, room, tmp_path):
    def robots(log):
        return {
            Robot(log, f"{name}/", odometry=f"/{name}/odom", scan=f"/{name}/scan"): parts
            for name in ("tb1", "tb2")
        }

    path = record(tmp_path / "log.mcap", room, robots)
    log = open_logs([path], Config())
    assert log.robots == ("tb1", "tb2")
    by_robot = {
        robot: [m.pose for m in log.messages() if m.robot == robot and hasattr(m, "pose")]
        for robot in log.robots
    }
    assert len(by_robot["tb1"]) == len(by_robot["tb2"]) > 250


def test_two_robots_in_one_recording_are_smoothed_without_an_option(room, tmp_path):
    """Each is where its odometry and its scans put it; the start of the second is found."""

    def robots(log):
        return {
            Robot(log, f"{name}/", odometry=f"/{name}/odom", scan=f"/{name}/scan"):
            ("odometry", "others")
            for name in ("tb1", "tb2")
        }  # fmt: skip

    begin = [message for message in room if message.time_ns < START_NS + 5 * S]
    path = record(tmp_path / "log.mcap", begin, robots)
    result = graphslam.smooth(path)
    assert set(result.robots) == {"tb1", "tb2"}
    first, second = (result.robots[name].final for name in ("tb1", "tb2"))
    ends = between(first.poses[0], first.poses[-1]), between(second.poses[0], second.poses[-1])
    np.testing.assert_allclose(ends[0], ends[1], atol=0.05)


def test_two_robots_with_trees_of_their_own_are_two(room, tmp_path):
    """Nav2 with namespaces: /tb1/tf and /tb2/tf have frames of the same names."""

    def robots(log):
        return {
            Robot(log, tf=f"/{name}/tf", scan=f"/{name}/scan"): ("moving",)
            for name in ("tb1", "tb2")
        }

    path = record(tmp_path / "log.mcap", room, robots)
    log = open_logs([path], Config())
    assert log.robots == ("tb1", "tb2")
    assert {topic.name for topic in log.topics} == {
        "/tb1/scan", "/tb2/scan", "/tb1/tf (odom to base_footprint)",
        "/tb2/tf (odom to base_footprint)",
    }  # fmt: skip


def test_robots_in_one_namespace_are_as_many_as_have_sensors_and_odometry_there(room, tmp_path):
    """/fleet/a and /fleet/b are two robots; /rig/front with all of a robot is one, rig."""

    def recorded(path, *spaces):
        def robots(log):
            return {
                Robot(log, f"{s}/", odometry=f"/{s}/odom", scan=f"/{s}/scan"): ("odometry",)
                for s in spaces
            }

        return topics_of(record(path, room, robots))

    assert recorded(tmp_path / "two.mcap", "fleet/a", "fleet/b") == {
        "/fleet/a/odom": "a", "/fleet/a/scan": "a", "/fleet/b/odom": "b", "/fleet/b/scan": "b",
    }  # fmt: skip
    assert recorded(tmp_path / "one.mcap", "rig/front") == {
        "/rig/front/odom": "rig", "/rig/front/scan": "rig",
    }  # fmt: skip
    assert set(recorded(tmp_path / "same.mcap", "x/a", "x/b", "y/a", "y/c").values()) == {
        "x_a", "b", "y_a", "c",
    }  # fmt: skip


def test_a_sensor_belongs_to_the_robot_that_carries_its_frame(room, tmp_path):
    """The laser of tb2 has a name without namespace; its frame says whose it is."""

    def robots(log):
        first = Robot(log, "tb1/", odometry="/tb1/odom", scan="/tb1/scan")
        second = Robot(log, "tb2/", odometry="/tb2/odom", scan="/lidar/scan")
        return {first: ("odometry",), second: ("odometry",)}

    path = record(tmp_path / "log.mcap", room, robots)
    assert topics_of(path) == {
        "/tb1/odom": "tb1", "/tb1/scan": "tb1", "/tb2/odom": "tb2", "/lidar/scan": "tb2",
    }  # fmt: skip


def test_what_cannot_be_decided_prints_the_setting_that_decides_it(room, tmp_path):
    class Bare(Robot):
        def transforms(self, *_):
            pass

    def robots(log):
        first = Bare(log, odometry="/a/odom", scan="/a/scan")
        second = Bare(log, odometry="/b/odom", scan="/lidar/scan")
        return {first: ("odometry",), second: ("odometry",)}

    path = record(tmp_path / "log.mcap", room, robots)
    with pytest.raises(LogError) as caught:
        open_logs([path], Config())
    text = str(caught.value)
    assert "whose is /lidar/scan?" in text and "\n" not in text
    setting = text.partition("--set '")[2].partition("'")[0].replace('"/lidar/scan" = "a"', "")
    setting = setting.replace(", }", ', "/lidar/scan" = "b"}')
    log = open_logs([path], load_config(None, [setting]))
    assert {topic.name: topic.robot for topic in log.topics} == {
        "/a/odom": "a", "/a/scan": "a", "/b/odom": "b", "/lidar/scan": "b",
    }  # fmt: skip
    assert inspect_logs([path], Config()).problem == text


@pytest.mark.parametrize(
    "names",
    [
        ("/scan_{}", "/odom_{}"),
        ("/scan/{}", "/odom/{}"),
        ("/site/fleet/{}/scan", "/site/fleet/{}/odom"),
    ],
)
def test_robots_in_one_namespace_are_told_by_their_frames(tmp_path, names):
    """Else they are one robot, with the laser of one and the odometry of the other."""
    plain, renamed = tmp_path / "plain.mcap", tmp_path / "renamed.mcap"
    with LogWriter(plain) as log:
        for k in range(20):
            for robot in ("anna", "ben"):
                log.odometry(robot, START_NS + k * S, [0.1 * k, 0, 0])
                log.scan(robot, START_NS + k * S, np.full(len(BEAMS), 2.0), **SCAN)
    scan, odometry = names
    kinds = {schemas.LASER_SCAN: scan, schemas.ODOMETRY: odometry}
    with LogWriter(renamed) as log:
        for topic, schema, log_time, data in messages_of(plain):
            robot = topic.split("/")[1]
            log.encoded(kinds[schema].format(robot), schema, data, log_time)
    log = open_logs([renamed], Config())
    assert log.robots == ("anna", "ben")
    assert {(topic.robot, topic.name) for topic in log.topics} == {
        (robot, name.format(robot)) for robot in ("anna", "ben") for name in names
    }
