"""Static transforms that contradict each other are told; those that are repeated are not."""

import re

import numpy as np
import pytest
from mcap.writer import Writer
from recordings import messages_of

from graphslam.core.config import Config
from graphslam.core.config_io import load_config
from graphslam.logs import LogWriter, inspect_logs, open_logs, schemas

S = 1_000_000_000
SCAN = {"angle_min_rad": -1.0, "angle_step_rad": 0.1, "range_max_m": 10.0}
MOUNT = (0.2, 0.1, 0.3)


def stated(log, stamp, pose, *, parent="base_link", child="laser", height=0.0):
    """A transform on /tf_static; ``pose`` (3,), m and rad."""
    x, y, phi = pose
    made = schemas.build(
        "geometry_msgs/msg/TransformStamped",
        header=schemas.header(stamp, parent),
        child_frame_id=child,
        transform=schemas.build(
            "geometry_msgs/msg/Transform",
            translation=schemas.build("geometry_msgs/msg/Vector3", x=x, y=y, z=height),
            rotation=schemas.build(
                "geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=np.sin(phi / 2), w=np.cos(phi / 2)
            ),
        ),
    )
    message = schemas.build(schemas.TF_MESSAGE, transforms=[made])
    log.message("/tf_static", schemas.TF_MESSAGE, message, stamp)


def drive(path, *mounts):
    """A drive of a robot whose laser is mounted as ``mounts``, arguments of `stated`, say."""
    with LogWriter(path) as log:
        for number, (pose, how) in enumerate(mounts):
            stated(log, S + number, pose, **how)
        for k in range(20):
            log.odometry("robot", (k + 2) * S // 5, (0.1 * k, 0, 0))
            log.scan("robot", (k + 2) * S // 5, np.full(21, 2.0), **SCAN)
    return path


def told(*paths):
    """The lines about it, which `info` and `smooth` must have in common."""
    lines = [line for line in open_logs(paths, Config()).warnings if "apart" in line]
    assert lines == [line for line in inspect_logs(paths, Config()).warnings if "apart" in line]
    return lines


def test_two_mounts_of_a_laser_are_told_and_the_last_one_is_used(tmp_path):
    path = drive(tmp_path / "log.mcap", (MOUNT, {}), ((0.5, 0.1, 0.6), {}))
    (line,) = told(path)
    assert "/tf_static has two transforms from base_link to laser, 0.30 m and 17° apart" in line
    assert np.allclose(open_logs([path], Config()).mount("/scan"), (0.5, 0.1, 0.6))
    (setting,) = re.findall("--set '([^']*)'", line)
    config = load_config(None, [setting.replace("X, Y, YAW", "0.5, 0.1, 0.6")])
    assert not open_logs([path], config).warnings


def test_a_parent_that_contradicts_another_one_is_told(tmp_path):
    path = drive(
        tmp_path / "log.mcap",
        ((0, 0, 0), {"child": "mast"}),
        (MOUNT, {"parent": "mast"}),
        ((0.25, 0.1, 0.3), {}),
    )
    (line,) = told(path)
    assert "/tf_static has laser both in mast and in base_link, 0.05 m and 0° apart" in line


@pytest.mark.parametrize(
    "again",
    [
        (MOUNT, {}),
        (tuple(np.float32(MOUNT).astype(float)), {}),
        ((0.2001, 0.1, 0.3 + 2 * np.pi), {}),  # the quaternion with the other sign
        (MOUNT, {"height": 0.4}),
        ((0.9, 0.9, 0.9), {"child": "camera"}),
    ],
)
def test_what_is_repeated_or_means_nothing_for_the_laser_is_no_doubt(again, tmp_path):
    first = ((0.0, 0.0, 0.0), {"child": "camera"})
    assert not told(drive(tmp_path / "log.mcap", first, (MOUNT, {}), again, again))


def test_a_frame_that_is_moved_to_another_parent_at_the_same_place_is_no_doubt(tmp_path):
    mounts = ((0, 0, 0), {"child": "mast"}), (MOUNT, {"parent": "mast"}), (MOUNT, {})
    assert not told(drive(tmp_path / "log.mcap", *mounts))


def test_recordings_that_state_other_mounts_contradict_each_other(tmp_path):
    one = drive(tmp_path / "1.mcap", (MOUNT, {}))
    other = tmp_path / "2.mcap"
    with LogWriter(other) as log:
        stated(log, 100 * S, (0.3, 0.1, 0.3))
        log.odometry("robot", 101 * S, (0, 0, 0))
        log.scan("robot", 101 * S, np.full(21, 2.0), **SCAN)
    (line,) = told(one, other)
    assert "0.10 m and 0° apart" in line
    same_place = load_config(None, ["logs.same_place=true"])
    assert not any("apart" in line for line in open_logs([one, other], same_place).warnings)


def test_two_robots_that_call_their_frames_alike_are_told_how_to_be_kept_apart(tmp_path):
    target = tmp_path / "both.mcap"
    with target.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        for robot, mount in (("a", MOUNT), ("b", (0.0, 0.0, -0.5))):
            path = drive(tmp_path / f"{robot}.mcap", (mount, {}))
            made = {}
            for topic, schema, log_time, data in messages_of(path):
                if topic not in made:
                    name = topic if topic == "/tf_static" else f"/{robot}{topic}"
                    kind = writer.register_schema(schema, "ros2msg", schemas.definition(schema))
                    made[topic] = writer.register_channel(name, "cdr", kind)
                writer.add_message(made[topic], log_time, data, log_time)
        writer.finish()
    lines = told(target)
    assert [line.partition(":")[0] for line in lines] == ["/a/scan", "/b/scan"]
    assert all("two transforms from base_link to laser" in line for line in lines)
    assert all("/NAME/tf_static" in line for line in lines)
