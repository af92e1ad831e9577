"""`info` as a doctor: what keeps a log from being used well is found, with what mends it."""

import itertools
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from command_line import call, check_one_line
from mcap.reader import make_reader

from graphslam.core import records
from graphslam.core.config import Config
from graphslam.core.config_io import load_config
from graphslam.core.errors import LogError
from graphslam.logs import LogWriter, inspect_logs, open_logs, schemas
from graphslam.logs.topic_context import odd_spacing

S = 1_000_000_000
T0 = 1_700_000_000 * S
SCAN = {"angle_min_rad": -1.0, "angle_step_rad": 0.1, "range_max_m": 10.0}


class Spoiled:
    """A good log of a driving robot, of which every part may be spoiled."""

    seconds = 30
    odometry_period_ns, scan_period_ns = S // 10, S // 5
    scan_offset_ns = scan_recorded_late_ns = 0
    zero_stamps = False
    mount, scans, odometry, wheels = True, True, True, False
    speed = 0.5
    ranges = 2.0

    def write(self, path: Path) -> Path:
        end = self.seconds * S
        with LogWriter(path) as log:
            if self.mount:
                log.mount("robot", T0, (0.1, 0, 0))
            for t in range(0, end, self.odometry_period_ns):
                x = self.speed * abs(t - end / 2) / S
                if self.odometry:
                    self.pose(log, T0 + t, x)
                if self.wheels:
                    angle = {"left_rad": 10 * x, "right_rad": 10 * x}
                    log.wheel_angles("robot", T0 + t, **angle)
            for t in range(0, end, self.scan_period_ns) if self.scans else ():
                ranges = np.full(21, self.ranges) + 0.01 * np.arange(21)
                stamp = T0 + t + self.scan_offset_ns
                recorded = stamp + self.scan_recorded_late_ns
                log.scan("robot", stamp, ranges, log_time_ns=recorded, **SCAN)
        return path

    def pose(self, log: LogWriter, stamp: int, x: float) -> None:
        if self.zero_stamps:
            number = schemas.build
            point = number("geometry_msgs/msg/Point", x=x, y=0.0, z=0.0)
            turn = number("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
            no = number("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
            message = number(
                schemas.ODOMETRY,
                header=schemas.header(0, "odom"),
                child_frame_id="base_link",
                pose=number(
                    "geometry_msgs/msg/PoseWithCovariance",
                    pose=number("geometry_msgs/msg/Pose", position=point, orientation=turn),
                    covariance=np.zeros(36),
                ),
                twist=number(
                    "geometry_msgs/msg/TwistWithCovariance",
                    twist=number("geometry_msgs/msg/Twist", linear=no, angular=no),
                    covariance=np.zeros(36),
                ),
            )
            log.message("/odom", schemas.ODOMETRY, message, stamp)
        else:
            log.odometry("robot", stamp, (x, 0, 0))


def spoiled(path: Path, **how: object) -> Path:
    log = Spoiled()
    for name, value in how.items():
        assert hasattr(Spoiled, name)
        setattr(log, name, value)
    return log.write(path / "log.mcap")


# fmt: off
#: how a log is spoiled, and severity, check and a part of the text of what is found
CASES = {
    "no mount": ({"mount": False}, "doubt", "mount", "no transform from base_link"),
    "zero stamps": ({"zero_stamps": True}, "doubt", "stamps", "all stamps are zero"),
    "odometry only": ({"scans": False}, "doubt", "sensors", "odometry only"),
    "laser only": ({"odometry": False}, "doubt", "odometry", "no odometry: scan matching"),
    "wheels": ({"odometry": False, "wheels": True}, "doubt", "wheels", "geometry is not known"),
    "joints beside": ({"wheels": True}, "note", "unused", "not used: /joint_states"),
    "slow odometry": ({"odometry_period_ns": S}, "doubt", "rate", "every 1.0 s only"),
    "slow scans": ({"scan_period_ns": 3 * S}, "doubt", "rate", "every 3.0 s only"),
    "standing": ({"speed": 0.0}, "doubt", "odometry", "does not move"),
    "millimetres": ({"speed": 500.0}, "doubt", "odometry", "500 m/s in the mean; is it in metres"),
    "blind": ({"ranges": 99.0}, "doubt", "ranges", "100 % of the beams"),
    "late clock": (
        {"scan_offset_ns": -2 * S, "scan_recorded_late_ns": 2 * S}, "doubt", "clocks",
        "2.0 s earlier than those of /odom",
    ),
    "other clock": ({"scan_offset_ns": 90 * S}, "unusable", "clocks", "60.1 s apart"),
}
# fmt: on


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_what_is_wrong_is_found_once_and_by_the_check_of_that_name(case, tmp_path):
    how, severity, check, text = case
    info = inspect_logs([spoiled(tmp_path, **how)], Config())
    (found,) = [f for f in info.findings if f.severity != "note" or severity == "note"]
    assert (found.severity, found.check) == (severity, check)
    assert text in found.text and "\n" not in found.line
    assert info.usable == (severity != "unusable") and info.doubtful == (severity == "doubt")
    assert found.remedy
    assert info.to_dict()["findings"][-1]["remedy"] == found.remedy
    assert (found.line in info.warnings) == (severity == "doubt" or check == "unused")


def test_nothing_is_wrong_with_a_good_log(tmp_path):
    info = inspect_logs([spoiled(tmp_path)], Config())
    assert info.usable and not info.findings and not info.warnings


@pytest.mark.parametrize("case", ["no mount", "wheels"])
def test_the_line_that_mends_it_does(case, tmp_path):
    """The options that are printed are taken as they are, numbers filled in, and mend it."""
    path = spoiled(tmp_path, **CASES[case][0])
    (finding,) = inspect_logs([path], Config()).findings
    options = re.findall(r"--set (?:'([^']*)'|(\S+))", finding.remedy)
    settings = [(a or b).replace("X, Y, YAW", "0.1, 0, 0") for a, b in options]
    if case == "wheels":  # what is assumed is not what it is
        settings = [setting.replace("=0.1", "=0.12") for setting in settings]
    assert settings and not inspect_logs([path], load_config(None, settings)).findings


def test_the_line_that_takes_another_topic_does(tmp_path):
    path = spoiled(tmp_path, wheels=True)
    (finding,) = inspect_logs([path], Config()).findings
    (setting,) = re.findall(r"--set '([^']*)'", finding.remedy)
    topics = {topic.name for topic in open_logs([path], load_config(None, [setting])).topics}
    assert topics == {"/joint_states", "/scan"}


def test_messages_without_stamps_have_the_times_of_their_recording(tmp_path):
    path = spoiled(tmp_path, zero_stamps=True)
    log = open_logs([path], Config())
    times = [m.time_ns for m in log.messages() if isinstance(m, records.OdometryPose)]
    assert times == list(range(T0, T0 + 30 * S, S // 10))
    assert any("all stamps are zero" in line for line in log.warnings)


def test_exit_codes_of_info_and_of_a_plan(tmp_path):
    """0 usable, 1 not usable, 3 with doubts if that is asked for; a plan writes nothing."""
    doubtful = spoiled(tmp_path, mount=False)
    assert call("info", doubtful).code == 0
    strict = call("info", doubtful, "--strict", "--json")
    assert strict.code == 3 and '"doubtful": true' in strict.out
    plan = call("smooth", doubtful, "--plan")
    assert plan.code == 0 and plan.out == call("info", doubtful).out
    assert not (tmp_path / "out").exists()
    assert "to mend it: record /tf_static, or --set 'robots.robot.laser=[X, Y, YAW]'" in plan.out
    unusable = spoiled(tmp_path, scan_offset_ns=90 * S)
    found = call("info", unusable)
    assert found.code == 1 and "not usable: /scan" in found.out
    assert call("smooth", unusable, "-o", tmp_path / "out", "--plan").code == 1
    assert call("info", spoiled(tmp_path), "--strict").code == 0
    check_one_line(call("info", tmp_path / "none.mcap"))


def test_beams_without_a_return_are_no_loss(tmp_path):
    out = call("info", spoiled(tmp_path, ranges=np.inf)).out
    assert "no return: 3 150 beams" in out and "dropped" not in out


def sightings(path, bearings):
    with LogWriter(path) as log:
        for k, bearing in enumerate(bearings):
            log.odometry("robot", (k + 1) * S, (0.1 * k, 0, 0))
            log.sighting("robot", (k + 1) * S, (bearing, 2.0), np.eye(2), identity="a")
    return path


def test_bearings_in_degrees_are_refused_before_anything_is_computed(tmp_path):
    path = sightings(tmp_path / "log.mcap", np.linspace(-90, 90, 60))
    done = call("smooth", path, "-o", tmp_path / "out")
    line = check_one_line(done)
    assert "bearings are in degrees: up to 90" in line and "bearing * pi / 180" in line
    assert not (tmp_path / "out").exists()
    told = call("info", path)
    assert told.code == 1 and "bearings are in degrees" in told.out


def test_scans_in_degrees_are_refused_before_anything_is_computed(tmp_path):
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.mount("robot", T0, (0, 0, 0))
        for k in range(20):
            log.odometry("robot", T0 + k * S, (k, 0, 0))
            shape = {"angle_min_rad": -90.0, "angle_step_rad": 1.0, "range_max_m": 9.0}
            log.scan("robot", T0 + k * S, np.full(181, 2.0), **shape)
    line = check_one_line(call("smooth", path, "-o", tmp_path / "out"))
    assert "bearings are in degrees: up to 90" in line and "angle_increment too" in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("stated_rad", "is_odd"),
    [
        (1.0, False),  # as it is
        (1.1, False),  # a beam more, as some drivers have it
        (0.0, False),  # left out
        (1.25, True),
        (-1.0, True),
    ],
)
def test_an_angle_max_that_beams_do_not_end_at_is_asked_about(stated_rad, is_odd):
    """A wrong angle_increment bends a map by far more than is stated, without a word. 21 beams from
    -1 rad on, 0.1 rad apart."""
    n = np.ones(5)
    found = odd_spacing("/scan", -n, n, stated_rad * n, 0.1 * n)
    assert [finding.severity for finding in found] == is_odd * ["doubt"]
    assert not odd_spacing("/scan", n[:0], n[:0], n[:0], n[:0])


@pytest.mark.parametrize("scanned", [False, True])
def test_a_gap_of_odometry_that_scans_bridge_is_not_to_be_taken_for_motion(tmp_path, scanned):
    """A longer odometry.max_gap_s makes one straight motion of 30 s; scans at least go on."""
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.mount("robot", T0, (0, 0, 0))
        for k in range(600):
            stamp = T0 + k * S // 10
            gone = 100 <= k < 400
            if not gone:
                log.odometry("robot", stamp, (0.01 * k, 0, 0))
            if scanned or not gone:
                shape = {"angle_min_rad": -1.0, "angle_step_rad": 0.1, "range_max_m": 8.0}
                log.scan("robot", stamp, np.full(21, 2.0), **shape)
    (finding,) = [f for f in inspect_logs([path], Config()).findings if "odom" in f.topic]
    assert finding.check == "gaps"
    assert ("odometry.max_gap_s" in finding.remedy) != scanned


@pytest.mark.parametrize(
    ("limits", "text"),
    [
        ((5.0, 3200.0), "from 5 to 3200 m: are they in mm or cm?"),
        ((10.0, 0.1), "from 10 to 0.1 m, so that none is possible"),
        ((0.1, np.inf), ""),
        ((0.0, 80.0), ""),
    ],
)
def test_limits_of_ranges_that_no_laser_has_are_asked_about(tmp_path, limits, text):
    """Ranges in centimetres were dead reckoning, without a word on units."""
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.mount("robot", T0, (0, 0, 0))
        for k in range(20):
            log.odometry("robot", T0 + k * S, (k, 0, 0))
            shape = {"angle_min_rad": -1.0, "angle_step_rad": 0.1}
            shape |= {"range_min_m": limits[0], "range_max_m": limits[1]}
            log.scan("robot", T0 + k * S, np.full(21, 2.0), **shape)
    found = [line for line in open_logs([path], Config()).warnings if "ranges are from" in line]
    assert len(found) == bool(text) and text in "".join(found)


@pytest.mark.parametrize("first", [0.0, -np.pi, np.pi / 2, -2 * np.pi, 2 * np.pi])
def test_beams_all_around_are_radians_wherever_they_begin(tmp_path, first):
    """0 to 6.28319 rad is a little more than a turn, as 2 π in single precision may be too."""
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.mount("robot", T0, (0, 0, 0))
        for k in range(20):
            log.odometry("robot", T0 + k * S, (k, 0, 0))
            shape = {"angle_min_rad": first, "angle_step_rad": 6.28319 / 359, "range_max_m": 9.0}
            log.scan("robot", T0 + k * S, np.full(360, 2.0), **shape)
    assert len([m for m in open_logs([path], Config()).messages() if hasattr(m, "ranges")]) == 20


@pytest.mark.parametrize("apart", [0.0, 0.5])
def test_scans_of_two_lasers_on_one_topic_are_not_taken_for_those_of_one(tmp_path, apart):
    """Of a frame beside the first one they are left out, and it is said; if tf has both frames at
    one place they are of one laser."""
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.mount("robot", T0, (0, 0, 0), sensor="front")
        log.mount("robot", T0, (-apart, 0, 0), sensor="rear")
        for k in range(20):
            log.odometry("robot", T0 + k * S, (k, 0, 0))
            for n, sensor in enumerate(("front", "rear") if k % 2 else ("front",)):
                stamp = T0 + k * S + n * S // 2
                log.scan("robot", stamp, np.full(21, 2.0), sensor=sensor, **SCAN)
    other = tmp_path / "one.mcap"
    with path.open("rb") as stream, LogWriter(other) as made:
        for schema, channel, message in make_reader(stream).iter_messages(log_time_order=False):
            topic = "/scan" if channel.topic.startswith("/scan") else channel.topic
            made.encoded(topic, schema.name, message.data, message.log_time)
    log = open_logs([other], Config())
    scans = [m for m in log.messages() if isinstance(m, records.Scan)]
    told = [line for line in log.warnings if "several lasers" in line]
    assert len(scans) == (20 if apart else 30)
    assert bool(told) == bool(apart)
    if apart:
        assert "front are used, those in frame rear are left out" in told[0]
        assert log.dropped["scan: of another laser on the same topic"] == 10


@pytest.mark.parametrize(
    "bearings",
    [
        np.linspace(0, 2 * np.pi, 60),  # radians from 0 on
        np.append(np.linspace(-3, 3, 60), [90.0] * 9),  # some are wrong
        np.linspace(-1e6, 1e6, 60),  # no angles of any unit
        np.linspace(-6, 6, 60),  # a narrow camera's degrees look the same
    ],
)
def test_bearings_that_may_be_radians_are_read(tmp_path, bearings):
    open_logs([sightings(tmp_path / "log.mcap", bearings)], Config())


def test_stamps_of_two_clocks_are_refused_by_smooth_as_by_info(tmp_path):
    """In no time that both have is there anything to compute but dead reckoning."""
    path = spoiled(tmp_path, scan_offset_ns=90 * S)
    (finding,) = inspect_logs([path], Config()).findings
    done = call("smooth", path, "-o", tmp_path / "out")
    assert done.code == 1 and check_one_line(done).strip().endswith(finding.line)
    assert "use_sim_time" in finding.line and not (tmp_path / "out").exists()


def test_odometry_on_tf_is_compared_by_its_stamps_not_by_the_times_of_recording(tmp_path):
    """In a simulation's recording the stamps begin at zero, and a recorder has a clock of its own:
    nothing is wrong with that. Scans that are stamped by the recorder's clock are refused."""
    for offset_ns in (0, T0):
        path = tmp_path / f"{offset_ns}.mcap"
        with LogWriter(path) as log:
            log.mount("robot", T0, (0.1, 0, 0))
            for t in range(S, 20 * S, S // 10):
                pose = (0.05 * t / S, 0.0, 0.0)
                log.message("/tf", schemas.TF_MESSAGE, transform(t, pose), T0 + t)
                shape = {**SCAN, "log_time_ns": T0 + t}
                log.scan("robot", t + offset_ns, np.full(21, 2.0), **shape)
        if offset_ns:
            with pytest.raises(
                LogError, match=f"/scan: its stamps and those of /tf .* {T0 // S - 19}"
            ):
                open_logs([path], Config())
        else:
            assert open_logs([path], Config()).robots == ("robot",)


def transform(stamp, pose):
    vector = schemas.build("geometry_msgs/msg/Vector3", x=pose[0], y=pose[1], z=0.0)
    turn = schemas.build(
        "geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=np.sin(pose[2] / 2), w=np.cos(pose[2] / 2)
    )
    made = schemas.build("geometry_msgs/msg/Transform", translation=vector, rotation=turn)
    stamped = schemas.build(
        "geometry_msgs/msg/TransformStamped",
        header=schemas.header(stamp, "odom"),
        child_frame_id="base_link",
        transform=made,
    )
    return schemas.build(schemas.TF_MESSAGE, transforms=[stamped])


@pytest.mark.parametrize(("back_s", "mended"), [(5, True), (3600, False)])
def test_a_longer_window_is_advised_where_it_mends_that_messages_come_late(
    back_s, mended, tmp_path
):
    """A clock that is set back by an hour is mended by no window: it would hold the whole log."""
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.mount("robot", T0, (0.1, 0, 0))
        for t in range(0, 30 * S, S // 10):
            stamp = T0 + t - (back_s * S if t > 20 * S else 0)
            log.odometry("robot", stamp, (0.05 * t / S, 0, 0), log_time_ns=T0 + t)
            log.scan("robot", stamp, np.full(21, 2.0), log_time_ns=T0 + t, **SCAN)
    opened = open_logs([path], Config())
    for _ in opened.messages():
        pass
    for lines in (opened.warnings, inspect_logs([path], Config()).warnings):
        late = [line for line in lines if " late and " in line]
        assert late and all(("logs.reorder_s" in line) == mended for line in late)
        assert all(mended or "one clock" in line for line in late)


def joints(path, names):
    """A drive of a robot whose wheels, ``names``, turn alike; an arm is on the same topic."""
    with LogWriter(path) as log:
        log.mount("robot", T0, (0.1, 0, 0))
        for k in range(60):
            stamp = T0 + k * S // 10
            for own in (names, ["arm_joint"]):
                message = schemas.build(
                    schemas.JOINT_STATE,
                    header=schemas.header(stamp, ""),
                    name=own[:: (-1) ** k],  # in no certain order
                    position=np.full(len(own), 0.1 * k),
                    velocity=np.zeros(0),
                    effort=np.zeros(0),
                )
                log.message("/joint_states", schemas.JOINT_STATE, message, stamp)
            log.scan("robot", stamp, np.full(21, 2.0), **SCAN)
    return path


@pytest.mark.parametrize("robot", ["robot", "Ü b"])
def test_joints_of_four_wheels_are_listed_with_the_options_that_name_two(robot, tmp_path):
    wheels = [f"{place}_{side}_wheel" for place in ("rear", "front") for side in ("left", "right")]
    path = joints(tmp_path / "log.mcap", wheels)
    topics = f'logs.topics={{"/scan" = "{robot}", "/joint_states" = "{robot}"}}'
    info = inspect_logs([path], load_config(None, [topics]))
    (found,) = [f for f in info.findings if f.check == "messages"]
    assert found.severity == "doubt"  # scan matching tells how it moved
    assert all(name in found.text for name in [*wheels, "arm_joint"])
    options = shlex.split(found.remedy)
    settings = [after for option, after in itertools.pairwise(options) if option == "--set"]
    assert settings == [
        f"robots.{robot}.left_joint=front_left_wheel",
        f"robots.{robot}.right_joint=front_right_wheel",
    ]
    mended = inspect_logs([path], load_config(None, [topics, *settings]))
    assert mended.usable and [one.path_m for one in mended.robots if one.name == robot] != [None]


def test_joints_that_are_no_wheels_are_listed_and_known_wheels_are_not(tmp_path):
    info = inspect_logs([joints(tmp_path / "a.mcap", ["slide_1", "slide_2"])], Config())
    (found,) = [f for f in info.findings if f.check == "messages"]
    assert "arm_joint, slide_1, slide_2" in found.text
    assert "robots.robot.left_joint=NAME" in found.remedy
    other = inspect_logs([joints(tmp_path / "b.mcap", ["wheel_left", "wheel_right"])], Config())
    assert other.usable and "messages" not in [f.check for f in other.findings]


def test_scans_are_matched_where_no_odometry_can_be_used(tmp_path):
    """An arm's joints, alone or beside wheels whose names tell no side, are no odometry; and where
    they come more often than wheels that are, these are used."""
    path = joints(tmp_path / "a.mcap", ["pan", "tilt"])
    log = open_logs([path], Config())
    assert log.without_odometry == ("robot",)
    assert any("/joint_states: is no odometry" in line for line in log.warnings)
    assert len([m for m in log.messages() if isinstance(m, records.Scan)]) == 60
    log = open_logs([joints(tmp_path / "b.mcap", ["wheel_left", "wheel_right"])], Config())
    assert not log.without_odometry
