"""The pipeline on small logs whose truth is known: what comes out, at which stamps, and why."""

import importlib
import shlex
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from paths import ROOT
from pose_checks import assert_same_pose
from room_log import drive
from walls import cast, rectangles

import graphslam
from graphslam.cli.arguments import check_start
from graphslam.core.config import Config, OdometryConfig, RobotConfig, StartConfig
from graphslam.core.config_io import load_config
from graphslam.core.errors import EstimationError, GraphSlamError
from graphslam.core.geometry import between, compose, exp, inverse, transform, wrap
from graphslam.core.observation_models import MODELS
from graphslam.core.records import OdometryPose, RelativePose, Sighting, Trajectory
from graphslam.evaluation.trajectory_metrics import align
from graphslam.logs import LogWriter, open_logs
from graphslam.mapping.landmark_map import seen_extents
from graphslam.odometry.interpolation import origin_shift, transform_trajectory
from graphslam.odometry.preintegration import Track
from graphslam.pipeline.pipeline import Pipeline
from graphslam.pipeline.robot_state import RobotState
from graphslam.slam.smooth import initialise, smooth

S = 1_000_000_000
T0 = 1_700_000_000 * S + 123_456_789
COV = np.diag([4e-4, 1e-4, 1e-4])  # of an increment
SEEN = np.diag([1e-4, 1e-4])  # of a bearing and range


def run(path, *settings, config=None):
    tree = load_config(overrides=settings) if config is None else config
    return smooth(open_logs([path], tree), tree)


# ------------------------------------------------------------ a laser that sits elsewhere

BEAMS = np.radians(np.arange(-135, 136.0))
SCAN = {"angle_min_rad": float(BEAMS[0]), "angle_step_rad": np.radians(1), "range_max_m": 30.0}
ROOM = rectangles((-6, -5, 7, 5), (0, -1, 1, 1), (-6, 3, -4, 5))
SAID, REAL = np.array([0.2, 0.0, 0.0]), np.array([0.27, -0.04, 0.01])
LATE_NS = 60_000_000  # the laser's clock against the odometry's
LASER_S = 60


def driven(seconds):
    """Round the box in the room, now fast and now slow: the latency shows in changes of speed."""
    a = 2 * np.pi * seconds / 25 + 0.5 * np.sin(1.3 * seconds)
    x, y = 0.5 + 3.5 * np.cos(a), 3.0 * np.sin(a)
    return np.array([x, y, np.arctan2(3.0 * np.cos(a), -3.5 * np.sin(a))])


@pytest.fixture(scope="module")
def laser(tmp_path_factory):
    """A log of one minute: odometry at 20 Hz with 3 % too much path, scans at 4 Hz whose stamps
    are 60 ms late, from a laser that sits 8 cm from where tf_static says."""
    path = tmp_path_factory.mktemp("laser") / "log.mcap"
    rng = np.random.default_rng(5)
    odometry, stamps = np.zeros(3), []
    with LogWriter(path) as log:
        log.mount("robot", T0, SAID)
        for k in range(LASER_S * 20 + 1):
            if k:
                moved = between(driven((k - 1) / 20), driven(k / 20)) * [1.03, 1.03, 1.0]
                odometry = compose(odometry, moved + rng.normal(0, 1e-4, 3))
            log.odometry("robot", T0 + k * S // 20, odometry)
            if k % 5 == 0:
                at = compose(driven(k / 20 - LATE_NS / S), REAL)
                ranges = cast(ROOM, BEAMS, at, 30.0) + rng.normal(0, 0.01, len(BEAMS))
                stamps.append(T0 + k * S // 20 + (k % 7))
                log.scan("robot", stamps[-1], ranges, **SCAN)
    return SimpleNamespace(
        path=path, stamps=np.array(stamps), result=run(path, "backend.causal=true")
    )


def test_every_scan_is_in_the_trajectory_under_its_exact_stamp(laser):
    """Keyframe or not, final and causal, base and laser; to the nanosecond."""
    found = laser.result.robots["robot"]
    for trajectory in (found.final, found.causal, found.scan_final, found.scan_causal):
        np.testing.assert_array_equal(trajectory.stamps_ns, laser.stamps)
        assert np.isfinite(trajectory.poses).all()
        assert np.linalg.eigvalsh(trajectory.covs).min() > -1e-12
    np.testing.assert_array_equal(found.dead_reckoning.stamps_ns, laser.stamps)
    assert laser.result.summary["counts"]["scans"] == len(laser.stamps)
    assert laser.result.summary["counts"]["keyframes"] < len(laser.stamps)


@pytest.mark.parametrize(
    ("settings", "revises"),
    [
        (("backend.name=ekf",), False),
        (("backend.name=isam2", "backend.horizon_s=0"), False),
        (("backend.name=dead-reckoning",), False),
        (("backend.name=isam2", "backend.horizon_s=2"), True),
    ],
)
def test_final_is_causal_for_what_revises_nothing(laser, settings, revises):
    """A filter's way between two states is not bent to the second one, nor seen from a mount that
    was found later: the trajectories are equal to the digit, or both are not."""
    found = run(laser.path, *settings).robots["robot"]
    for final, causal in ((found.final, found.causal), (found.scan_final, found.scan_causal)):
        assert np.array_equal(final.poses, causal.poses) is not revises
        assert np.array_equal(final.covs, causal.covs) is not revises


def test_the_mount_and_the_latency_are_found(laser):
    """Within three of the sigmas given; one minute shows the latency well, the rest just so."""
    found = laser.result.summary["calibration"]
    truth = {"laser_x_m": 0.07, "laser_y_m": -0.04, "laser_yaw_rad": 0.01, "laser_latency_s": 0.06}
    truth["translation_scale"] = 1 / 1.03 - 1
    for name, value in truth.items():
        entry = found[f"robot.{name}"]
        assert abs(entry["value"] - value) < 3 * entry["sigma"], (name, entry)
    assert found["robot.laser_latency_s"]["observable"]
    assert abs(found["robot.laser_latency_s"]["value"] - 0.06) < 0.02


def test_the_base_starts_at_the_origin_although_the_laser_is_what_is_estimated(laser):
    """To 5 mm: the prior's sigma is 1 mm, and the first reading errs as any other. The laser is
    0.28 m ahead of it, not at the origin."""
    found = laser.result.robots["robot"]
    for base, scan in ((found.final, found.scan_final), (found.causal, found.scan_causal)):
        assert_same_pose(base.poses[0], np.zeros(3), atol=5e-3)
        assert 0.15 < scan.poses[0, 0] < 0.35
    np.testing.assert_allclose(found.dead_reckoning.poses[0], found.final.poses[0], atol=5e-3)


def test_laser_and_base_follow_their_true_paths(laser):
    """The shape of the laser's path to 3 cm everywhere (walls to 1 cm, scale of odometry 3 %); the
    base in the world, which hangs on the calibration (its yaw: 6 cm at 6 m), to 10."""
    found = laser.result.robots["robot"]
    seconds = (laser.stamps - T0) / S
    start = driven(0.0 - LATE_NS / S)
    base = np.array([between(start, driven(t - LATE_NS / S)) for t in seconds])
    scan = compose(base, np.broadcast_to(REAL, base.shape))
    shift = align(found.scan_final.poses[:, :2], scan[:, :2])
    error = transform(shift, found.scan_final.poses[:, :2]) - scan[:, :2]
    assert np.hypot(*error.T).max() < 0.03
    error = found.final.poses - base
    assert np.hypot(error[:, 0], error[:, 1]).max() < 0.10
    drift = between(base, found.dead_reckoning.poses)
    assert np.hypot(drift[:, 0], drift[:, 1]).max() > 0.1  # there was something to gain


def test_the_first_state_is_where_the_odometry_starts_even_if_the_scan_comes_later(tmp_path):
    """A second of odometry, 0.5 m of it, before the first scan: the world's origin is the robot's
    first pose, so the first scan is half a metre on."""
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.mount("robot", T0, np.zeros(3))
        for k in range(41):
            log.odometry("robot", T0 + k * S // 20, [0.025 * k, 0, 0])
            if k >= 20 and k % 5 == 0:
                at = np.array([0.025 * k, 0, 0]) - [3, 3, 0]
                log.scan("robot", T0 + k * S // 20, cast(ROOM, BEAMS, at, 30.0), **SCAN)
    found = run(path)
    assert found.estimate.states["robot"].stamps_ns[0] == T0
    assert_same_pose(found.robots["robot"].final.poses[0], np.array([0.5, 0, 0]), atol=0.02)


# ------------------------------------------------------------ sightings and increments

TWIST = np.array([0.5, 0.0, 0.3])  # per second
TREES = {"1": np.array([2.0, 1.5]), "2": np.array([1.0, -1.0]), "3": np.array([-1.0, 2.5])}


def circling(seconds):
    return exp(TWIST * seconds)


def increments(log, n, robot="robot", period_ns=S // 10, pose=circling, cov=COV):
    """n true increments of a robot that goes in a circle, the first begins at T0."""
    for k in range(n):
        start, end = T0 + k * period_ns, T0 + (k + 1) * period_ns
        a, b = pose(k * period_ns / S), pose((k + 1) * period_ns / S)
        log.increment(robot, start, end, delta=between(a, b), cov=cov * period_ns / S)


def truth_at(times_ns, pose=circling):
    return np.array([pose((t - T0) / S) for t in times_ns])


@pytest.mark.parametrize("mode", ["motion", "all"])
def test_a_robot_without_scans_is_reported_at_10_hz_over_its_whole_odometry(tmp_path, mode):
    """Not only where something was seen: here for one second in the middle of eight."""
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        increments(log, 16, period_ns=S // 2)
        for k in range(10):
            t = 3.0 + 0.1 * k
            for identity, tree in TREES.items():
                z = MODELS["point"].predict(circling(t), tree)
                log.sighting("robot", T0 + round(t * S), z, SEEN, identity=identity)
    found = run(path, f"keyframe.mode={mode}").robots["robot"]
    assert found.scan_final is None and found.scan_causal is None
    expected = np.arange(T0, T0 + 8 * S + 1, S // 10)
    for trajectory in (found.final, found.causal, found.dead_reckoning):
        np.testing.assert_array_equal(trajectory.stamps_ns, expected)
    # noise-free data: true everywhere, between readings too (a circle segment)
    assert_same_pose(found.final.poses, truth_at(expected), atol=1e-5)
    assert_same_pose(found.causal.poses, truth_at(expected), atol=1e-5)


@pytest.mark.parametrize("n", [1, 7])
def test_one_state_per_odometry_stamp_when_all_are_kept(tmp_path, n):
    """n increments have n + 1 ends. Sightings at those stamps make no more."""
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        increments(log, n, period_ns=S)
        for k in range(n + 1):
            z = MODELS["point"].predict(circling(k), TREES["1"])
            log.sighting("robot", T0 + k * S, z, SEEN, identity="1")
    result = run(path, "keyframe.mode=all")
    states = result.estimate.states["robot"]
    np.testing.assert_array_equal(states.stamps_ns, T0 + np.arange(n + 1) * S)
    assert result.summary["counts"]["keyframes"] == n + 1
    assert_same_pose(states.poses, truth_at(states.stamps_ns), atol=1e-6)


def test_every_sighting_is_from_a_state_at_its_own_time(tmp_path):
    """Carried to keyframes every 25 cm, of the sightings every 5 cm only a fifth would count, and
    their measurements would not be those of the log."""
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        increments(log, 100)
        for k in range(101):
            for identity, tree in TREES.items():
                z = MODELS["point"].predict(circling(0.1 * k), tree)
                log.sighting("robot", T0 + k * S // 10, z, SEEN, identity=identity)
    result = run(path)
    seen = [a for step in result.steps for a in step.associations]
    assert len(seen) == 3 * 101
    states = result.estimate.states["robot"]
    np.testing.assert_array_equal(states.stamps_ns, T0 + np.arange(101) * (S // 10))
    assert result.summary["counts"]["keyframes"] == 101
    identity = {landmark.id: landmark.identity for landmark in result.landmarks}
    for step in result.steps:
        for a in step.associations:
            assert a.time_ns == step.time_ns
            z = MODELS["point"].predict(circling((a.time_ns - T0) / S), TREES[identity[a.target]])
            np.testing.assert_allclose(a.z, z, atol=1e-9)
            # without any noise in it, the log is still believed to have what it states
            np.testing.assert_allclose(a.cov, SEEN, atol=1e-12)
    for landmark in result.landmarks:
        np.testing.assert_allclose(landmark.position[:2], TREES[landmark.identity], atol=1e-5)


# ------------------------------------------------------------ relative poses


def wriggling(seconds):
    """Motions of different times do not commute here, as they would on a circle."""
    return np.array([0.5 * seconds, 0.5 * np.sin(seconds), 0.6 * np.cos(0.7 * seconds) - 0.6])


def closure_log(path, ends, other=None):
    """Increments over 10 s, and the true relative pose between each two times of ``ends`` (s)."""
    with LogWriter(path) as log:
        increments(log, 100, pose=wriggling)
        for start, end in ends:
            log.relative_pose(
                "robot",
                T0 + round(start * S),
                T0 + round(end * S),
                delta=between(wriggling(start), wriggling(end)),
                cov=COV,
                other=other,
            )
    return path


#: at readings of the odometry, where it is exact
ENDS = [(0.0, 5.0), (1.2, 5.1), (0.3, 7.7), (6.1, 9.9)]


def test_closures_between_keyframes_are_carried_by_odometry(tmp_path):
    """Noise-free: the closure between the *states* is their true relative pose. With a sign or an
    order wrong it is off by what the robot drove since."""
    result = run(closure_log(tmp_path / "log.mcap", ENDS))
    closures = [c for step in result.steps for c in step.closures]
    assert len(closures) == len(ENDS) == result.summary["counts"]["loop_closures"]
    states = set(result.estimate.states["robot"].stamps_ns.tolist())
    for closure, (start, end) in zip(closures, ENDS, strict=True):
        a, b = closure.other_time_ns, closure.time_ns
        assert {a, b} <= states and a <= T0 + round(start * S) and b <= T0 + round(end * S)
        expected = between(*truth_at([a, b], wriggling))
        assert_same_pose(closure.delta, expected, atol=1e-7)


def test_covariance_of_a_carried_closure_against_monte_carlo(tmp_path):
    """Lead and tail are noisy odometry, the measurement has its own noise: 40 000 draws. A
    correlation is known to 0.005 from those, a relative variance to 0.007; second-order terms add
    about as much."""
    path = closure_log(tmp_path / "log.mcap", [])
    log = open_logs([path], Config())
    pipeline = Pipeline(log, Config(), initialise(log, Config()))
    pipeline.run(lambda _count: None)
    robot = pipeline.runs["robot"]
    assert robot.times == [T0]  # no event needed a state
    robot.times += [T0 + 5 * S]
    start, end = T0 + S, T0 + 7 * S
    delta = between(*truth_at([start, end], wriggling))
    message = RelativePose("robot", end, end, "robot", start, delta, 4 * COV)
    closure = pipeline.closure(message, T0 + 5 * S)
    lead, tail = robot.track.motion(T0, start), robot.track.motion(T0 + 5 * S, end)

    rng = np.random.default_rng(11)
    n = 40_000
    draw = lambda mean, cov: mean + rng.multivariate_normal(np.zeros(3), cov, n)  # noqa: E731
    sample = compose(draw(lead.delta, lead.cov), draw(message.delta, message.cov))
    sample = compose(sample, inverse(draw(tail.delta, tail.cov)))
    error = sample - closure.delta
    error[:, 2] = wrap(error[:, 2])
    empirical = error.T @ error / n
    sigma = np.sqrt(np.diag(empirical))
    np.testing.assert_allclose(
        closure.cov / np.outer(sigma, sigma), empirical / np.outer(sigma, sigma), atol=0.03
    )


def test_relative_pose_to_an_unknown_end_is_counted(tmp_path):
    """Of another robot that is not there, or from before the first state."""
    for n, (ends, other) in enumerate([([(1.0, 5.0)], "nobody"), ([(-2.0, 5.0)], None)]):
        result = run(closure_log(tmp_path / f"{n}.mcap", ends, other))
        assert result.summary["dropped"] == {"relative pose: no keyframe at its start time": 1}
        assert result.summary["counts"]["loop_closures"] == 0


# ------------------------------------------------------------ several robots

START_B = np.array([4.0, 1.0, 2.5])


def second(seconds):
    return compose(START_B, exp(np.array([0.4, 0.0, -0.2]) * seconds))


@pytest.fixture(scope="module")
def meeting(tmp_path_factory):
    """Robots a and b with odometry at the same stamps, which see each other at some of them: b's
    odometry turns 0.03 rad/s too much."""
    path = tmp_path_factory.mktemp("meeting") / "log.mcap"

    def drifting(seconds):
        return exp(np.array([0.4, 0.0, -0.17]) * seconds)

    with LogWriter(path) as log:
        increments(log, 100, "a", cov=0.01 * COV)
        increments(log, 100, "b", pose=drifting, cov=10 * COV)
        for k in range(0, 101, 10):
            poses = circling(k / 10), second(k / 10)
            for robot, other, (x, t) in (("a", "b", poses), ("b", "a", poses[::-1])):
                seen = between(x, t)
                z = [np.arctan2(seen[1], seen[0]), np.hypot(seen[0], seen[1]), seen[2]]
                size = 3 if k % 20 else 2
                cov = 1e-6 * np.eye(size)
                log.sighting(robot, T0 + k * S // 10, z[:size], cov, seen_robot=other)
    return path


STARTS = ("start.poses.a=[0, 0, 0]", "start.poses.b=[4, 1, 2.5]")


def test_robots_that_see_each_other_at_equal_stamps_share_one_estimate(meeting):
    """Both get a state at the stamp, once; b's drift of 0.3 rad (odometry alone 0.6 m off) is taken
    out to millimetres where they meet."""
    result = run(meeting, *STARTS, "start.given_sigma_m=0.001", "start.given_sigma_rad=0.001")
    seen = [a for step in result.steps for a in step.associations]
    assert len(seen) == 22 and {a.model for a in seen} == {"robot-pose", "robot-point"}
    meetings = T0 + np.arange(0, 101, 10) * S // 10
    for robot, pose in (("a", circling), ("b", second)):
        states = result.estimate.states[robot]
        assert len(set(states.stamps_ns.tolist())) == len(states)
        assert set(meetings.tolist()) <= set(states.stamps_ns.tolist())
        met = np.isin(states.stamps_ns, meetings)
        expected = truth_at(states.stamps_ns[met], pose)
        assert np.abs(states.poses[met][:, :2] - expected[:, :2]).max() < 0.01
    drift = result.robots["b"].dead_reckoning.poses[-1, :2] - second(10.0)[:2]
    assert np.hypot(*drift) > 0.3


def test_each_robot_starts_where_it_is_said_to(meeting):
    result = run(meeting, *STARTS)
    assert [s for step in result.steps for s in step.starts] == ["a", "b"]
    for robot, start in (("a", np.zeros(3)), ("b", START_B)):
        assert_same_pose(result.robots[robot].final.poses[0], start, atol=0.02)


def test_a_start_that_is_not_given_is_found_by_sightings(meeting):
    """As exactly as the sightings are, although b's odometry drifts by 0.03 rad/s."""
    result = run(meeting)
    assert set(result.summary["starts_found"]) == {"b"}
    assert_same_pose(result.robots["b"].final.poses[0], START_B, atol=0.02)


def test_a_start_that_nothing_tells_is_said_with_what_to_do(meeting):
    (told,) = [
        warning
        for warning in run(meeting, "association.robot_sightings=ignore").summary["warnings"]
        if warning.startswith("b: ")
    ]
    assert "separate frame" in told
    assert "--start b=x,y,phi" in told


def test_the_option_that_places_a_robot_is_one_for_a_shell_whatever_its_name(tmp_path):
    path, robots = tmp_path / "log.mcap", ("a", "Ü b's")
    with LogWriter(path) as log:
        for k in range(20):
            for robot in robots:  # each sees a landmark of its own
                log.odometry(robot, S + k * S // 5, (0.1 * k, 0, 0))
                z = (0.0, 5.0 - 0.1 * k)
                log.sighting(robot, S + k * S // 5, z, np.eye(2) * 1e-3, identity=robot)
    (told,) = [line for line in run(path).summary["warnings"] if "separate frame" in line]
    words = shlex.split(told[told.index("--start ") :])
    (setting,) = check_start([words[1].replace("x,y,phi", "1,2,3")])
    placed = run(path, "start.poses.a=[0, 0, 0]", setting)
    assert_same_pose(placed.robots[robots[1]].final.poses[0], np.array([1, 2, 3]), atol=1e-6)


@pytest.mark.parametrize("pose", ["[1, 2]", "[1, 2, 3, 4]"])
def test_a_malformed_start_names_the_robot(meeting, pose):
    with pytest.raises(EstimationError, match="--start b: needs x,y,phi"):
        run(meeting, f"start.poses.b={pose}")


def test_a_start_for_a_robot_that_is_not_there_is_refused(meeting):
    with pytest.raises(GraphSlamError, match=r"robots? .*a, b"):
        run(meeting, *STARTS, "start.poses.c=[0, 0, 0]")


def test_truth_is_asked_for_and_not_there(meeting):
    with pytest.raises(EstimationError, match="no truth for a"):
        run(meeting, "start.from_truth=true")


def test_a_start_from_truth_is_one_sample_with_the_stated_sigma(tmp_path):
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        increments(log, 20)
        log.truth("robot", T0, [5.0, 6.0, 0.7])
        log.truth("robot", T0 + S, [50.0, 60.0, 0.7])
    result = run(path, "start.from_truth=true", "start.truth_sigma_m=0.2")
    start = result.steps[0].starts["robot"]
    np.testing.assert_allclose(start.pose, [5.0, 6.0, 0.7], atol=1e-12)
    np.testing.assert_allclose(np.diag(start.cov), [0.04, 0.04, 0.01**2])
    assert_same_pose(result.robots["robot"].final.poses[0], np.array([5, 6, 0.7]), atol=1e-6)
    np.testing.assert_allclose(result.robots["robot"].final.covs[0, 0, 0], 0.04, rtol=1e-6)


def test_a_sighting_of_a_robot_that_is_not_in_the_log_is_dropped_with_the_reason(tmp_path):
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        increments(log, 50)
        log.sighting("robot", T0 + S, [0.1, 2.0], SEEN, seen_robot="ghost")
        log.sighting("robot", T0 + 2 * S, [0.1, 2.0, 0.3], COV, seen_robot="ghost")
    result = run(path)
    assert result.summary["dropped"] == {"sighting: robot ghost is not in the log": 2}
    assert not any(step.associations for step in result.steps)


# ------------------------------------------------------------ base, laser and world


def test_base_is_found_from_states_that_are_rigid_to_the_laser():
    """States are the laser's poses, the first of them where the prior put it; the base's path
    starts at ``start`` all the same: exactly, in the final trajectory and in the causal one from
    where the mount was known."""
    start, mount = np.array([1.0, -2.0, 0.8]), np.array([0.3, -0.1, 0.2])
    track = Track(OdometryConfig(), RobotConfig(), mounted=True)
    times = np.arange(11) * S
    base = np.array([compose(start, wriggling(t / S)) for t in times])
    for t in np.arange(101) * S // 10:
        track.add(OdometryPose("robot", int(t), int(t), wriggling(t / S)))
    robot, nominal = RobotState(track), track.calibration
    laser = compose(base, np.broadcast_to(mount, base.shape))
    states = compose(np.broadcast_to(compose(start, inverse(laser[0])), laser.shape), laser)
    known = replace(nominal, mean=np.array([0, 0, 0, *mount, 0]))
    for k, (t, pose) in enumerate(zip(times, states, strict=True)):
        track.calibration = known if k >= 3 else nominal
        robot.append(int(t), pose)
        robot.causal_covs.append(1e-6 * np.eye(3))
    covs = np.array(robot.causal_covs)
    world = origin_shift(start, mount)
    final = transform_trajectory(Trajectory(times, states, covs), world)
    found = robot.result(final, robot.causal(start))
    at = np.isin(found.final.stamps_ns, times)
    assert_same_pose(found.final.poses[at], base, atol=1e-12)
    assert_same_pose(found.causal.poses[at][3:], base[3:], atol=1e-12)
    assert_same_pose(found.causal.poses[0], states[0], atol=1e-12)  # nothing was known then
    assert_same_pose(found.dead_reckoning.poses[at], base, atol=1e-12)


# ------------------------------------------------------------ causal


def test_causal_states_do_not_know_what_comes_later(laser, tmp_path):
    """The same log cut after half of its time: the causal trajectory up to there is the same. The
    final one is not, since it knows the calibration and the landmarks of the end."""
    path = tmp_path / "half.mcap"
    copy_until(laser.path, path, T0 + LASER_S * S // 2)
    cut, whole = run(path, "backend.causal=true").robots["robot"], laser.result.robots["robot"]
    n = len(cut.causal.stamps_ns)
    assert n > 100
    for a, b in ((cut.causal, whole.causal), (cut.scan_causal, whole.scan_causal)):
        np.testing.assert_array_equal(a.stamps_ns, b.stamps_ns[:n])
        np.testing.assert_allclose(a.poses, b.poses[:n], rtol=0, atol=1e-9)
        np.testing.assert_allclose(a.covs, b.covs[:n], rtol=0, atol=1e-9)
    assert np.abs(cut.final.poses - whole.final.poses[:n]).max() > 1e-6


def copy_until(source, target, end_ns):
    """The messages of a log up to a time, byte for byte."""
    schemas, channels = {}, {}
    with source.open("rb") as file, target.open("wb") as out:
        log = Writer(out)
        log.start()
        for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
            if message.log_time > end_ns:
                continue
            if schema.id not in schemas:
                schemas[schema.id] = log.register_schema(schema.name, schema.encoding, schema.data)
            if channel.id not in channels:
                channels[channel.id] = log.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id], channel.metadata
                )
            log.add_message(
                channels[channel.id],
                message.log_time,
                message.data,
                message.publish_time,
                message.sequence,
            )
        log.finish()


def test_without_calibration_the_mount_is_what_the_log_says(laser):
    config = Config(odometry=replace(OdometryConfig(), calibrate=False))
    found = run(laser.path, config=config)
    assert found.summary["calibration"] == {}
    robot = found.robots["robot"]
    mounts = between(robot.final.poses, robot.scan_final.poses)
    np.testing.assert_allclose(mounts, np.broadcast_to(SAID, mounts.shape), atol=1e-12)


# ------------------------------------------------------------ sightings beside scans


def test_sightings_beside_scans_enter_at_their_own_time():
    """Moved to the last state by odometry, all of an image would share an error unknown to the
    estimate: forest's trajectory had NEES 1.4 per degree of freedom, 85 % in the 95 % ellipses."""
    config = load_config(overrides=("start.from_truth=true",))
    log = open_logs([ROOT / "logs" / "forest.mcap"], config)
    images = {m.time_ns for m in log.messages() if isinstance(m, Sighting)}
    result = smooth(log, config)
    (states,) = result.estimate.states.values()
    assert images <= set(states.stamps_ns.tolist())
    seen = {a.time_ns for step in result.steps for a in step.associations}
    assert seen <= images


# ------------------------------------------------------------ ends of walls


@pytest.mark.parametrize(
    ("log", "module"),
    [("lab", "scan_smoothing.batch_optimisation"), ("two-robots", "slam.final_result")],
)
def test_walls_end_where_they_were_seen_also_if_the_minimum_has_turned_the_map(
    log, module, monkeypatch
):
    """One robot, solved as a batch, and two. The prior of a start is so weak that a large map turns
    by some mrad on the last step: ends of walls then lay metres along the walls from where they
    were seen. They come from the robots' poses through each observation, to 1e-6 m."""
    where = importlib.import_module(f"graphslam.{module}")
    minimum = where.settled
    world = np.array([3.0, -1.0, 0.4])

    def turned(steps, estimate, kernel):
        found = minimum(steps, estimate, kernel)
        states = {name: transform_trajectory(t, world) for name, t in found.states.items()}
        landmarks = {n: (compose(world, m), cov) for n, (m, cov) in found.landmarks.items()}
        return replace(found, states=states, landmarks=landmarks)

    monkeypatch.setattr(where, "settled", turned)
    result = run(ROOT / f"logs/{log}.mcap")
    seen = seen_extents(result.steps, result.estimate)
    lines = [mark for mark in result.landmarks if mark.kind == "line"]
    assert lines
    for mark in lines:
        ends = np.column_stack([seen[mark.id], np.zeros(2)])
        assert mark.extent == pytest.approx(transform(mark.position, ends), abs=1e-6)


# ------------------------------------------------------------ the direction of the world


def test_no_measurement_tells_the_direction_of_the_world():
    """The first pose is as uncertain as its prior says, to 1e-3: nothing else is about the world.
    Motions that were linear around poses that have turned since told something of it: a prior of
    0.5 rad became 0.03 rad, and all covariances far from the start were too small by that."""
    config = load_config(overrides=["start.given_sigma_rad=0.5"])
    start = StartConfig(poses={"vehicle": (30.0, -20.0, 2.5)}, given_sigma_rad=0.5)
    result = run(ROOT / "logs/office-loop.mcap", config=replace(config, start=start))
    sigmas = np.sqrt(np.diagonal(result.estimate.states["vehicle"].covs, axis1=1, axis2=2))
    assert sigmas[0, 2] == pytest.approx(0.5, rel=1e-3)
    assert np.all(sigmas[:, 2] > 0.499)  # the wheels and walls add to it


def test_scans_before_the_odometry_begins_are_left_out_with_a_warning(tmp_path):
    """A sixth of a log went without a word."""
    log = drive(tmp_path / "late.mcap", odometry_from=5.0)
    warnings = graphslam.smooth(log).summary["warnings"]
    assert any("10 of 61 scans were left out: no odometry is near them" in w for w in warnings)
    every = graphslam.smooth(drive(tmp_path / "all.mcap")).summary["warnings"]
    assert not any("left out" in warning for warning in every)
