"""A gyroscope takes over the turning of the odometry; slip of wheels is not taken for its bias."""

import numpy as np
import pytest
from paths import ROOT

import graphslam
from graphslam.core import records
from graphslam.core.config import Config, RobotConfig
from graphslam.core.config_io import load_config
from graphslam.core.geometry import between, compose, exp, wrap
from graphslam.core.geometry import log as log_of
from graphslam.core.motion_models import rows_of_twists, wheel_twist
from graphslam.logs import LogWriter, inspect_logs, open_logs, schemas
from graphslam.logs.cdr_writing import imu_bytes, tf_bytes
from graphslam.logs.imu_turning import GAP_NS, Turning, find_turning

S = 1_000_000_000
T0 = 1_700_000_000 * S
#: s of the drive, rad/s of the gyroscope's bias at its start and end, its noise per reading
SECONDS, BIASES, NOISE = 120, (0.02, 0.03), 0.01


def drive(slip=0.3, seconds=SECONDS):
    """Times ns and poses of odometry at 10 Hz whose wheels slip in turns, and the true headings.

    Straight, a turn of 90 degrees, a stop, again and again.
    """
    t = np.arange(0, seconds, 0.1)
    phase = t % 10
    speed = np.where(phase < 8, 0.5, 0.0)
    rate = np.where((phase > 4) & (phase < 6), np.pi / 4, 0.0)
    heading = np.concatenate([[0.0], np.cumsum(rate[:-1] * 0.1)])
    poses = [np.zeros(3)]
    for v, w in zip(speed[:-1], rate[:-1], strict=True):
        poses.append(compose(poses[-1], exp(0.1 * np.array([v, 0, (1 + slip) * w + 0.01 * v]))))
    return T0 + np.rint(t * S).astype(np.int64), np.array(poses), heading


def gyroscope(times, heading, noise=NOISE, biases=BIASES, seed=0):
    """Times ns and rates of a gyroscope at 100 Hz."""
    at = np.arange(times[0], times[-1] + 1, S // 100)
    true = np.interp(at, times, heading)
    rates = np.gradient(true, 1e-9 * (at - at[0]))
    bias = np.interp(at, times[[0, -1]], biases)
    return at, rates + bias + noise * np.random.default_rng(seed).normal(size=len(at))


def write(path, times, poses, at, rates, data=imu_bytes):
    with LogWriter(path) as log:
        for time, pose in zip(times.tolist(), poses, strict=True):
            log.odometry("robot", time, pose)
            if (time - T0) % S == 0:
                log.scan("robot", time, np.ones(9), angle_min_rad=0, angle_step_rad=0.1,
                         range_max_m=9.0)  # fmt: skip
        for time, rate in zip(at.tolist(), rates.tolist(), strict=True):
            log.encoded("/imu/data", schemas.IMU, data(time, "imu", rate), time)
    return path


def headings(log):
    poses = [m.pose for m in log.messages() if isinstance(m, records.OdometryPose)]
    return np.unwrap(np.array(poses)[:, 2])


# ---------------------------------------------------------------- what it is for


def test_with_slip_of_a_third_in_turns_the_heading_is_far_better_than_that_of_wheels(tmp_path):
    """Required is half the error of dead reckoning; it is a tenth, and the path stays."""
    times, poses, truth = drive()
    path = write(tmp_path / "log.mcap", times, poses, *gyroscope(times, truth))
    log = open_logs([path], Config())
    off = headings(log) - truth
    without = headings(open_logs([path], load_config(None, ["odometry.gyroscope=off"]))) - truth
    assert abs(off).max() < 0.1 * abs(without).max()
    assert abs(off).max() < 0.1
    found = [m.pose for m in log.messages() if isinstance(m, records.OdometryPose)]
    lengths = np.hypot(*np.diff(np.array(found)[:, :2], axis=0).T)
    np.testing.assert_allclose(lengths, np.hypot(*np.diff(poses[:, :2], axis=0).T), atol=2e-4)
    (line,) = (line for line in log.warnings if "gyroscope" in line)
    assert "turning is that of the gyroscope of /imu/data" in line
    assert log.gyroscopes["robot"].bias == pytest.approx(np.mean(BIASES), abs=1e-3)


def test_the_bias_is_that_of_the_gyroscope_and_not_the_slip_of_wheels():
    times, poses, truth = drive()
    found = find_turning("/imu", *gyroscope(times, truth), times, poses)
    assert isinstance(found, Turning)
    error = found.turned(int(times[5]), int(times[-5])) - (truth[-5] - truth[5])
    assert abs(error) < 0.05  # a bias that took in the slip would be 0.05 rad/s, 6 rad in all


@pytest.mark.parametrize("late_s", [0.0, 0.12, -0.05])
def test_a_gyroscope_that_is_late_is_put_in_its_time(late_s):
    """0.1 s at 0.8 rad/s are 5 degrees in each turn, which scans would contradict."""
    times, poses, truth = drive()
    at, rates = gyroscope(times, truth)
    found = find_turning("/imu", at + round(late_s * S), rates, times, poses)
    assert isinstance(found, Turning) and found.late_s == pytest.approx(late_s, abs=0.01)
    half = found.turned(T0 + 34 * S, T0 + 35 * S)  # up to the middle of a turn
    assert half == pytest.approx(truth[350] - truth[340], abs=0.02)


def test_the_simulated_gyroscope_of_a_scenario_is_used(tmp_path):
    """The scenario says what it is; the log is read as any other."""
    text = (ROOT / "graphslam/simulation/scenarios/lab.toml").read_text(encoding="utf-8")
    scenario = tmp_path / "lab.toml"
    extra = "\n[robots.vehicle.gyroscope]\nbias_deg_s = 1.0\nbias_wander_deg_s = 0.005\n"
    slip = text.replace(
        "[robots.vehicle.encoders]\n", "[robots.vehicle.encoders]\nturn_slip = 0.3\n"
    )
    assert slip != text
    scenario.write_text(slip + extra, encoding="utf-8")
    graphslam.simulate(str(scenario), tmp_path / "log.mcap")
    errors = []
    for setting in ("auto", "off"):
        log = open_logs(
            [tmp_path / "log.mcap"], load_config(None, [f"odometry.gyroscope={setting}"])
        )
        truth = [m.pose[2] for m in log.messages() if isinstance(m, records.Truth)]
        turned = headings(log)
        errors.append(abs(wrap(turned[-1] - turned[0] - (truth[-1] - truth[0]))))
        assert ("vehicle" in log.gyroscopes) == (setting == "auto")
    assert errors[0] < 0.5 * errors[1]


# ---------------------------------------------------------------- what is not used

BAD = {
    "no signal": (lambda r: 0 * r, "times as much as the odometry"),
    "degrees": (np.degrees, "times as much as the odometry"),
    "other way": (lambda r: -r, "times as much as the odometry"),
    "other axis": (lambda r: np.random.default_rng(1).permutation(r), "as much as the odometry"),
    "noise": (
        lambda r: r + np.random.default_rng(1).normal(size=len(r)) * 2, "where that is good",
    ),
}  # fmt: skip


@pytest.mark.parametrize("bad", BAD.values(), ids=BAD)
def test_what_is_no_gyroscope_of_this_robot_is_not_used(bad, tmp_path):
    spoil, why = bad
    times, poses, truth = drive()
    at, rates = gyroscope(times, truth, biases=(0, 0))
    found = find_turning("/imu", at, spoil(rates), times, poses)
    assert isinstance(found, str) and why in found, found


def test_the_first_usable_one_of_several_is_used(tmp_path):
    """A camera's acceleration comes as an Imu without rates, more often than the gyroscope."""
    times, poses, truth = drive()
    at, rates = gyroscope(times, truth)
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        for time, pose in zip(times.tolist(), poses, strict=True):
            log.odometry("robot", time, pose)
            log.scan("robot", time, np.ones(9), angle_min_rad=0, angle_step_rad=0.1,
                     range_max_m=9.0)  # fmt: skip
        for time, rate in zip(at.tolist(), rates.tolist(), strict=True):
            for k in range(2):
                log.encoded("/a/accel", schemas.IMU, imu_bytes(time + k, "imu", np.nan), time)
            log.encoded("/imu/data", schemas.IMU, imu_bytes(time, "imu", rate), time)
    log = open_logs([path], Config())
    assert log.gyroscopes["robot"].topic == "/imu/data"
    assert any(
        line.startswith("/a/accel: the gyroscope of robot is not used: it has no readings")
        for line in log.warnings
    )


def test_a_log_without_a_usable_gyroscope_is_read_to_the_bit_as_without_any(tmp_path):
    times, poses, truth = drive(seconds=60)
    at, rates = gyroscope(times, truth)
    path = write(tmp_path / "log.mcap", times, poses, at, -rates)
    log = open_logs([path], Config())
    assert not log.gyroscopes and any("is not used: it turns -" in line for line in log.warnings)
    checks = {finding.check for finding in inspect_logs([path], Config()).findings}
    assert "gyroscope" in checks and "unused" not in checks  # such messages are read
    bare = open_logs([write(tmp_path / "bare.mcap", times, poses, at[:0], rates[:0])], Config())
    for a, b in zip(log.messages(), bare.messages(), strict=True):
        assert a.time_ns == b.time_ns
        if isinstance(a, records.OdometryPose):
            assert a.pose.tobytes() == b.pose.tobytes()


def test_a_robot_that_does_not_turn_does_not_tell(tmp_path):
    times, poses, truth = drive()
    straight = poses * [1, 0, 0]
    found = find_turning("/imu", *gyroscope(times, 0 * truth), times, straight)
    assert found == "the robot turns too little to compare it with the odometry"


# ---------------------------------------------------------------- gaps, frames, bytes


def test_where_the_gyroscope_was_silent_the_wheels_count(tmp_path):
    times, poses, truth = drive()
    at, rates = gyroscope(times, truth)
    silent = (at > T0 + 45 * S) & (at < T0 + 45 * S + 2 * GAP_NS)
    found = find_turning("/imu", at[~silent], rates[~silent], times, poses)
    assert isinstance(found, Turning)
    assert found.turned(T0 + 44 * S, T0 + 46 * S) is None
    assert found.turned(T0 + 45 * S, T0 + 45 * S + GAP_NS) is None
    assert found.turned(T0 - S, T0 + S) is None and found.turned(T0 + S, T0 + 200 * S) is None
    assert found.turned(T0 + 46 * S, T0 + 47 * S) == pytest.approx(0.0, abs=0.01)
    path = write(tmp_path / "log.mcap", times, poses, at[~silent], rates[~silent])
    turned = np.diff(headings(open_logs([path], Config())))
    k = 451  # from 45.1 to 45.2 s: in the gap, in a turn
    assert turned[k] == pytest.approx(1.3 * np.pi / 40 + 0.0005, abs=1e-9)
    assert turned[k - 50] == pytest.approx(0.0, abs=0.01)


def test_a_gyroscope_on_its_head_turns_the_other_way(tmp_path):
    """Its frame says so; a half turn about x."""
    times, poses, truth = drive(seconds=60)
    at, rates = gyroscope(times, truth)
    path = tmp_path / "log.mcap"
    write(path, times, poses, at, -rates)
    upside = tmp_path / "upside.mcap"
    mount = tf_bytes([(T0, "base_link", "imu", (0, 0, 0.1, 1.0, 0.0, 0.0, 0.0))])
    with LogWriter(upside) as log:
        log.encoded("/tf_static", schemas.TF_MESSAGE, mount, T0)
    assert not open_logs([path], Config()).gyroscopes
    assert open_logs([path, upside], Config()).gyroscopes


@pytest.mark.parametrize("frame", ["", "imu", "robot1/imu"])
def test_the_message_is_that_of_the_reference_writer(frame):
    data = imu_bytes(5 * S + 7, frame, 0.25)
    message = schemas._typestore().deserialize_cdr(data, schemas.IMU)
    assert (message.header.frame_id, message.header.stamp.nanosec) == (frame, 7)
    assert (message.angular_velocity.z, message.angular_velocity.x) == (0.25, 0.0)
    assert schemas.decode(schemas.IMU, data).angular_velocity.z == 0.25


def test_wheel_angles_turn_as_the_gyroscope_says_and_go_as_far(tmp_path):
    """JointState of a robot whose wheels slip: the axle that they turn about is not the nominal."""
    times, poses, truth = drive()
    wheels = RobotConfig(wheel_radius_left_m=0.11, wheel_radius_right_m=0.1, axle_m=0.6)
    steps = rows_of_twists("wheels", log_of(between(poses[:-1], poses[1:])), wheels)[:, :2]
    angles = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])
    at, rates = gyroscope(times, truth)
    path = tmp_path / "log.mcap"
    with LogWriter(path) as out:
        for time, (left, right) in zip(times.tolist(), angles.tolist(), strict=True):
            out.wheel_angles("robot", time, left_rad=left, right_rad=right)
            if (time - T0) % S == 0:
                out.scan("robot", time, np.ones(9), angle_min_rad=0, angle_step_rad=0.1,
                         range_max_m=9.0)  # fmt: skip
        for time, rate in zip(at.tolist(), rates.tolist(), strict=True):
            out.encoded("/imu/data", schemas.IMU, imu_bytes(time, "imu", rate), time)
    geometry = {"wheel_radius_left_m": 0.11, "wheel_radius_right_m": 0.1, "axle_m": 0.6}
    settings = [f"robots.robot.{name}={value}" for name, value in geometry.items()]
    log = open_logs([path], load_config(None, settings))
    read = [m for m in log.messages() if isinstance(m, records.WheelAngles)]
    found = np.diff([(m.left_rad, m.right_rad) for m in read], axis=0)
    twists = wheel_twist(found, wheels)
    np.testing.assert_allclose(twists[:, 0], wheel_twist(steps, wheels)[:, 0], atol=1e-12)
    off = np.concatenate([[0.0], np.cumsum(twists[:, 2])]) - truth
    assert abs(off).max() < 0.1
    assert abs(np.unwrap(poses[:, 2]) - truth).max() > 1.0
