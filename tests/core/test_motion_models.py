"""Motion from wheels and odometry (thesis 2.1-2.12, 4.8-4.15) and the track that it makes."""

from dataclasses import replace

import numpy as np
import pytest
from finite_differences import jacobian
from hypothesis import given
from hypothesis import strategies as st

from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.geometry import between, compose, compose_cov, exp, wrap
from graphslam.core.motion_models import (
    MOTION_SOURCES,
    Calibration,
    Increments,
    compound,
    model_error_cov,
    mounted_motion,
    nominal_calibration,
    wheel_jacobian,
    wheel_twist,
)
from graphslam.core.records import OdometryIncrement, OdometryPose, WheelAngles
from graphslam.odometry.preintegration import STANDING_SIGMA, Track, preintegrate_batch
from graphslam.odometry.readings import EDGE_NS, integrate_pending

ROBOT = RobotConfig(wheel_radius_left_m=0.11, wheel_radius_right_m=0.1, axle_m=0.6)
EVEN = RobotConfig(wheel_radius_left_m=0.1, wheel_radius_right_m=0.1, axle_m=0.5)
NOISE = OdometryConfig()
SECOND = 1_000_000_000


def increments(source, rows, robot=ROBOT, config=NOISE, seconds=0.0):
    """Of rows without their column of seconds, if the source has one."""
    nominal = nominal_calibration(source, config, False).mean
    rows = np.asarray(rows, float)
    if source != "given":
        rows = np.column_stack([rows, np.full(len(rows), seconds)])
    return MOTION_SOURCES[source](rows, nominal, robot, config)


def drive(left, right, robot=EVEN, n=1):
    """The motion of n equal wheel increments, rad."""
    return compound(increments("wheels", [[left, right]] * n, robot)).delta


def odometry_track(times_s, poses, config=NOISE, **options):
    track = Track(config, EVEN, **options)
    for t, pose in zip(times_s, poses, strict=True):
        ns = round(t * SECOND)
        track.add(OdometryPose("r", ns, ns, np.asarray(pose, float)))
    return track


def wheel_track(angles, robot, config=NOISE):
    """Readings every second; ``angles`` (n, 2) rad."""
    track = Track(config, robot)
    for k, (left, right) in enumerate(angles):
        track.add(WheelAngles("r", k * SECOND, k * SECOND, float(left), float(right)))
    return track


# ------------------------------------------------------------ thesis 2.6-2.12


def test_equal_wheels_drive_straight():
    """2.12: any turning or sidestep here is a sign or a radius mixed up."""
    np.testing.assert_allclose(drive(3.0, 3.0), [0.3, 0.0, 0.0], atol=1e-16)


def test_opposite_wheels_turn_on_the_spot_counter_clockwise():
    """2.6 with right minus left: 2 r theta / L."""
    np.testing.assert_allclose(drive(-1.0, 1.0), [0.0, 0.0, 2 * 0.1 / 0.5], atol=1e-16)


def test_faster_right_wheel_curves_to_the_left_on_the_thesis_circle():
    """2.11 as printed, at a turn where it does not cancel."""
    turn, path = 0.1 * (4 - 1) / 0.5, 0.1 * (4 + 1) / 2
    expected = [path * np.sin(turn) / turn, path * (1 - np.cos(turn)) / turn, turn]
    np.testing.assert_allclose(drive(1.0, 4.0), expected, rtol=1e-14)
    assert drive(1.0, 4.0)[1] > 0


def test_a_full_circle_closes():
    """Breaks if an increment is a chord with the start's heading instead of a circle segment."""
    n = 100
    path = 2 * np.pi / n * 2.0  # radius 2 m
    turn = 2 * np.pi / n
    left, right = (path - turn * 0.25) / 0.1, (path + turn * 0.25) / 0.1
    whole = drive(left, right, n=n)
    np.testing.assert_allclose(whole[:2], 0, atol=1e-13)  # 100 sums of rounding 1e-16 x 4 m
    np.testing.assert_allclose(wrap(whole[2]), 0, atol=1e-13)
    np.testing.assert_allclose(drive(left, right, n=n // 2)[:2], [0, 4.0], atol=1e-13)


@pytest.mark.parametrize("turn", [1e-15, 1e-12, 1e-9, 1e-6])
def test_tiny_turns_lose_nothing(turn):
    """y = path * turn / 2 to a few roundings; (1 - cos)/turn gives 0, and wrapping lost 1e-4 of
    it."""
    parts = increments("odometry", [[2.0, 0.0, turn]])
    np.testing.assert_allclose(parts.delta[0], [2.0, turn, turn], rtol=1e-12)
    still = increments("odometry", [[2.0, 0.0, 0.0]])
    # covariance and derivatives are smooth through zero: they differ by the turn times ten at most
    np.testing.assert_allclose(parts.cov, still.cov, atol=10 * turn)
    np.testing.assert_allclose(parts.d_cal, still.d_cal, atol=10 * turn)


# ------------------------------------------------------------ thesis 4.8-4.15


@given(st.floats(-20, 20), st.floats(-20, 20))
def test_wheel_jacobian_equals_finite_differences(left, right):
    """All five parameters of 4.11; the axle's sign is the one that is easily lost."""

    def twist(parameters):
        r_l, r_r, turn_l, turn_r, axle = parameters
        return wheel_twist(np.array([[turn_l, turn_r]]), RobotConfig((), r_l, r_r, axle))[0]

    at = np.array([0.11, 0.1, left, right, 0.6])
    # third derivatives by the axle are 6 * 4 rad m / 0.6^4, times h² = 1e-10
    np.testing.assert_allclose(
        wheel_jacobian(at[None, 2:4], ROBOT)[0], jacobian(twist, at), atol=5e-8
    )


@pytest.mark.parametrize("row", [(3.0, 5.0), (-4.0, 4.5), (2.0, 2.0)])
def test_counting_noise_enters_position_and_heading_of_an_increment(row):
    """4.13: J Var(δθ) Jᵀ with J the derivative of the increment, heading included, by both wheel
    angles, here by finite differences; each wheel has the same sigma. The rest of 4.13, radii and
    axle, is the calibration's."""
    config = replace(NOISE, count_sigma_rad=0.02)
    found = increments("wheels", [row], config=config)
    without = increments("wheels", [row], config=replace(config, count_sigma_rad=0.0))

    def pose(angles):
        return exp(wheel_twist(np.atleast_2d(angles), ROBOT))[0]

    J = jacobian(pose, np.array(row))
    counting = found.cov[0] - without.cov[0]
    np.testing.assert_allclose(counting, 0.02**2 * J @ J.T, rtol=1e-6, atol=1e-12)
    # the heading's part: both radii over the axle
    np.testing.assert_allclose(counting[2, 2], 0.02**2 * (0.11**2 + 0.1**2) / 0.6**2, rtol=1e-9)
    still = increments("wheels", [(0.0, 0.0)], config=config, seconds=0.1)
    certain = replace(config, count_sigma_rad=0.0)
    before = increments("wheels", [(0.0, 0.0)], config=certain, seconds=0.1)
    np.testing.assert_array_equal(still.cov, before.cov)  # a wheel that stands is not miscounted


def test_model_error_grows_with_path_and_turning_as_printed():
    """4.14, each coefficient by itself, and unsigned when reversing."""
    config = OdometryConfig(k_x_m=1, k_x_rad=10, k_y_m=2, k_y_rad=20, k_phi_m=3, k_phi_rad=30)
    config = replace(config, k_x_s=0.1, k_y_s=0.2, k_phi_s=0.3)
    expected = np.diag([2.0 + 10 * 0.5 + 0.1 * 7, 4.0 + 20 * 0.5 + 0.2 * 7, 6.0 + 15.0 + 0.3 * 7])
    for twist in ([2.0, 0.0, 0.5], [-2.0, 0.0, -0.5]):
        found = model_error_cov(np.array([twist]), np.array([7.0]), config)[0]
        np.testing.assert_allclose(found, expected)


def test_noise_of_time_is_that_of_the_time_in_motion():
    """Breaks if a robot that stands gathers noise, or if a reading cut in two has more of it."""
    config = OdometryConfig(k_x_m=0, k_x_rad=0, k_x_s=0.01, floor_sigma_m=0.0)
    track = odometry_track([0, 1, 2, 3], [[0, 0, 0], [1, 0, 0], [1, 0, 0], [2, 0, 0]], config)
    times = np.array([[0, 3], [0, 1.25], [1, 2]]) * SECOND
    found = track.motions(times[:, 0].astype(np.int64), times[:, 1].astype(np.int64))
    calibrated = found.d_cal @ track.calibration.cov @ found.d_cal.mT
    x = (found.cov - calibrated)[:, 0, 0]
    # standing has the sigma of a robot that reports no motion, 1e-4 m
    np.testing.assert_allclose(x, [0.02, 0.01, STANDING_SIGMA**2], atol=1e-12)


@pytest.mark.parametrize("n", [2, 10, 300])
def test_model_error_does_not_depend_on_sampling(n):
    """A straight line in n parts. A variance that grew with the square of an increment would shrink
    with n. The heading's part moves the end sideways, which one part alone cannot show: k s³
    (n-1)(2n-1)/6n² by hand."""
    config, path = OdometryConfig(k_y_m=2e-4, k_phi_m=3e-4), 6.0
    one = compound(increments("odometry", [[path, 0, 0]], config=config)).cov
    cov = compound(increments("odometry", [[path / n, 0, 0]] * n, config=config)).cov
    lever = 3e-4 * path**3 * (n - 1) * (2 * n - 1) / (6 * n**2)
    expected = one[1, 1] + lever
    np.testing.assert_allclose(cov[0, 0], one[0, 0], rtol=1e-13)  # n roundings
    np.testing.assert_allclose(cov[2, 2], one[2, 2], rtol=1e-13)
    np.testing.assert_allclose(cov[1, 1], expected, rtol=1e-12)


@pytest.mark.parametrize("source", sorted(MOTION_SOURCES))
def test_every_source_turns_rows_into_increments(source):
    """Contract of a row of MOTION_SOURCES: shapes, symmetric positive semidefinite noise, and rows
    that scale: half of a row is half of the way."""
    rng = np.random.default_rng(5)
    size = {"odometry": 3, "commands": 3, "given": 12, "wheels": 2}[source]
    rows = rng.normal(size=(7, size))
    if source == "given":
        roots = rng.normal(size=(7, 3, 3))
        rows[:, 3:] = (roots @ roots.mT).reshape(7, 9)
    parts = increments(source, rows)
    p = len(nominal_calibration(source, NOISE, False).mean)
    assert (parts.delta.shape, parts.cov.shape, parts.d_cal.shape) == ((7, 3), (7, 3, 3), (7, 3, p))
    np.testing.assert_allclose(parts.cov, parts.cov.mT, atol=1e-15)
    assert np.linalg.eigvalsh(parts.cov).min() > -1e-15
    half = increments(source, rows / 2).delta
    # up to a turn of pi, where half a twist is half the circle segment
    slow = np.abs(parts.delta[:, 2]) < 1.5
    np.testing.assert_allclose(compose(half, half)[slow], parts.delta[slow], atol=1e-12)


def random_parts(n=30, p=2, seed=1, size=0.03):
    rng = np.random.default_rng(seed)
    roots = size * rng.normal(size=(n, 3, 3))
    deltas = rng.normal([0.3, 0.0, 0.05], [0.1, 0.02, 0.1], size=(n, 3))
    return Increments(deltas, roots @ roots.mT, rng.normal(size=(n, 3, p)))


@pytest.mark.parametrize("seed", range(5))
def test_compound_equals_one_compose_after_the_other(seed):
    """4.4 and 4.7 n times; a lever arm from the wrong end breaks the covariance only."""
    parts = random_parts(seed=seed)
    pose, cov = np.zeros(3), np.zeros((3, 3))
    for delta, white in zip(parts.delta, parts.cov, strict=True):
        cov = compose_cov(pose, cov, delta, white)
        pose = compose(pose, delta)
    whole = compound(parts)
    np.testing.assert_allclose(whole.delta, pose, atol=1e-13)  # 30 sums of rounding at 10 m
    np.testing.assert_allclose(whole.cov, cov, atol=1e-13)


def test_compound_cov_equals_monte_carlo():
    """The linearisation itself: with 1 % noise its second-order error is below the sampling
    error."""
    parts = random_parts(size=0.003)
    rng, n = np.random.default_rng(11), 20_000
    ends = np.zeros((n, 3))
    for delta, white in zip(parts.delta, parts.cov, strict=True):
        ends = compose(ends, rng.multivariate_normal(delta, white, n))
    cov = compound(parts).cov
    d = np.diag(cov)
    sampling = np.sqrt((np.outer(d, d) + cov**2) / n)
    assert np.all(np.abs(np.cov(ends.T) - cov) < 5 * sampling)


def test_compound_derivative_equals_finite_differences():
    """The same constant enters every increment: effects add up, not their squares."""
    parts = random_parts()

    def end(parameters):
        shifted = parts.delta + parts.d_cal @ parameters
        return compound(replace(parts, delta=shifted)).delta

    np.testing.assert_allclose(
        compound(parts).d_cal, jacobian(end, np.zeros(2)), atol=1e-6
    )  # 30 increments of curvature 30 m each, times h² = 1e-10, with room


# ------------------------------------------------------------ the track: calibration


WHEELS = np.cumsum(np.random.default_rng(2).uniform([1, 1], [3, 4], size=(8, 2)), axis=0)


def test_motion_derivative_by_wheel_geometry_equals_other_geometry():
    """Calibration re-integrates without decoding again: d_delta_d_calibration must be what another
    wheel radius in the configuration really does."""

    def end(geometry):
        robot = RobotConfig((), geometry[0], geometry[1], geometry[2])
        return wheel_track(WHEELS, robot).motion(SECOND // 2, 6 * SECOND + 7).delta

    at = np.array([0.11, 0.1, 0.6])
    found = wheel_track(WHEELS, ROBOT).motion(SECOND // 2, 6 * SECOND + 7).d_delta_d_calibration
    # derivatives are up to 60 rad m / 0.6²; third ones, times h² = 1e-10, stay below 1e-6
    np.testing.assert_allclose(found, jacobian(end, at), atol=2e-6)


def test_motion_derivative_by_odometry_scales_equals_scaled_odometry():
    """Translation scale, rotation scale, turning per metre."""
    twists = np.random.default_rng(4).normal([0.4, 0.0, 0.1], 0.1, size=(6, 3))

    def end(parameters):
        scale, turn_scale, drift = parameters
        scaled = twists * [1 + scale, 1 + scale, 1 + turn_scale]
        scaled[:, 2] += drift * twists[:, 0]
        poses = [np.zeros(3)]
        for twist in scaled:
            poses.append(compose(poses[-1], exp(twist)))
        return odometry_track(range(7), poses).motion(0, 5 * SECOND + 3).delta

    found = odometry_track([0], [np.zeros(3)])
    assert found.motion(0, 0).d_delta_d_calibration.shape == (3, 3)
    poses = [np.zeros(3)]
    for twist in twists:
        poses.append(compose(poses[-1], exp(twist)))
    motion = odometry_track(range(7), poses).motion(0, 5 * SECOND + 3)
    np.testing.assert_allclose(motion.d_delta_d_calibration, jacobian(end, np.zeros(3)), atol=1e-7)


def test_calibration_error_grows_with_path_and_white_error_with_its_root():
    """The insight that one wrong wheel radius is a constant of the run: four times the path is four
    times its sigma, and only twice the white one's."""
    quiet = dict.fromkeys(("k_x_rad", "k_y_rad", "k_phi_m", "k_phi_rad", "floor_sigma_m"), 0.0)
    quiet |= {"floor_sigma_rad": 0.0, "drift_sigma_rad_per_m": 0.0}
    line = [[0.5 * k, 0, 0] for k in range(9)]
    for config, ratio in (
        (OdometryConfig(k_x_m=0.0, k_y_m=0.0, translation_scale_sigma=0.03, **quiet), 4.0),
        (OdometryConfig(k_x_m=1e-4, translation_scale_sigma=0.0, **quiet), 2.0),
    ):
        track = odometry_track(range(9), line, config)
        short, long = (track.motion(0, n * SECOND).cov[0, 0] for n in (2, 8))
        assert np.sqrt(long / short) == pytest.approx(ratio, rel=1e-12)


def at_calibration(track, mean):
    """The track with other calibration values; their covariance stays."""
    track.calibration = replace(track.calibration, mean=np.asarray(mean, float))
    return track


@pytest.mark.parametrize("source", ["odometry", "wheels"])
def test_motion_derivative_by_calibration_holds_where_it_was_learned(source):
    """At values that are not nominal: the filter that learns them linearises there."""
    if source == "wheels":
        track, mean = wheel_track(WHEELS, ROBOT), np.array([0.002, -0.001, 0.03])
    else:
        poses = [exp(np.array([0.4, 0.02, 0.3]) * k) for k in range(8)]
        track, mean = odometry_track(range(8), poses), np.array([0.03, -0.05, 0.02])
    span = SECOND // 2, 6 * SECOND + 7

    def end(values):
        return at_calibration(track, values).motion(*span).delta

    numeric = jacobian(end, mean)
    found = at_calibration(track, mean).motion(*span).d_delta_d_calibration
    np.testing.assert_allclose(found, numeric, atol=2e-6)  # as for the wheel geometry above


def test_mounted_motion_is_the_base_motion_seen_from_the_mount():
    """A laser 0.3 m ahead of a robot that turns on the spot moves sideways."""
    mount, delta = np.array([0.3, -0.1, 0.4]), np.array([0.5, 0.1, 0.7])
    moved, by_mount = mounted_motion(delta, mount)
    np.testing.assert_allclose(moved, between(mount, compose(delta, mount)), atol=1e-15)
    numeric = jacobian(lambda m: mounted_motion(delta, m)[0], mount)
    np.testing.assert_allclose(by_mount, numeric, atol=1e-9)
    ahead, _ = mounted_motion(np.array([0.0, 0.0, np.pi / 2]), np.array([0.3, 0.0, 0.0]))
    np.testing.assert_allclose(ahead, [-0.3, 0.3, np.pi / 2], atol=1e-15)


def test_motion_derivative_of_a_mounted_track_equals_finite_differences():
    """Scales, drift and the laser's pose together, at values that are not nominal: how a turning
    error moves a laser that sits ahead is the entry most easily forgotten."""
    poses = [exp(np.array([0.4, 0.02, 0.3]) * k) for k in range(8)]
    track = odometry_track(range(8), poses, mounted=True)
    mean = np.array([0.03, -0.05, 0.02, 0.3, -0.1, 0.2, 0.0])

    def end(values):
        return at_calibration(track, [*values, 0.0]).motion(SECOND, 6 * SECOND + 7).delta

    numeric = jacobian(end, mean[:6])
    found = at_calibration(track, mean).motion(SECOND, 6 * SECOND + 7).d_delta_d_calibration
    np.testing.assert_allclose(found[:, :6], numeric, atol=1e-6)


def test_motion_derivative_by_latency_is_the_change_of_speed_over_the_interval():
    """Stamps late by L shift both ends: (end speed - start speed) L, along the start's axes. A
    robot that speeds up from 0.2 to 1 m/s; one-sided difference over 0.05 s of constant speeds."""
    places = np.concatenate([[0.0], np.cumsum([0.2, 0.2, 0.6, 1.0, 1.0])])
    track = odometry_track(range(6), [[x, 0, 0] for x in places], mounted=True)
    motion = track.motion(3 * SECOND // 2, 9 * SECOND // 2)
    np.testing.assert_allclose(
        motion.d_delta_d_calibration[:, -1], [0.2 - 1.0, 0.0, 0.0], atol=1e-6
    )


# ------------------------------------------------------------ the track: any time


def circle(t):
    """Pose at time t s on a circle of radius 3 m at 0.2 rad/s."""
    return exp(np.array([0.6, 0.0, 0.2]) * t)


@given(st.lists(st.floats(0, 9.5), min_size=1, max_size=6))
def test_pose_at_any_time_lies_on_the_circle_between_readings(times):
    """Breaks with straight interpolation of positions: 4 cm at this curvature."""
    readings = [0, 0.7, 2.5, 3.0, 6.0, 9.5]
    track = odometry_track(readings, [circle(t) for t in readings])
    at = np.array([round(t * SECOND) for t in times])
    expected = np.array([circle(ns / SECOND) for ns in at])
    found = track.pose(at)
    np.testing.assert_allclose(found[:, :2], expected[:, :2], atol=1e-12)
    np.testing.assert_allclose(wrap(found[:, 2] - expected[:, 2]), 0, atol=1e-12)


@given(st.floats(0, 9.5), st.floats(0, 9.5))
def test_motion_is_the_pose_difference_for_any_cut(a, b):
    start, end = sorted((round(a * SECOND), round(b * SECOND)))
    readings = [0, 0.7, 2.5, 3.0, 6.0, 9.5]
    track = odometry_track(readings, [circle(t) for t in readings])
    motion = track.motion(start, end)
    expected = between(track.pose(start), track.pose(end))
    np.testing.assert_allclose(motion.delta[:2], expected[:2], atol=1e-12)
    np.testing.assert_allclose(wrap(motion.delta[2] - expected[2]), 0, atol=1e-12)
    assert motion.length_m == pytest.approx(0.6 * (end - start) / SECOND, rel=0.1, abs=1e-9)
    assert np.linalg.eigvalsh(motion.cov).min() > 0


def test_two_motions_in_a_row_are_the_whole_one():
    """White noise split at a time between readings is neither lost nor counted twice."""
    config = OdometryConfig(
        translation_scale_sigma=0,
        rotation_scale_sigma=0,
        drift_sigma_rad_per_m=0,
        floor_sigma_m=0,
        floor_sigma_rad=0,
        k_phi_m=0,
        k_phi_rad=0,
    )
    track = odometry_track(range(5), [[k, 0, 0] for k in range(5)], config)
    cut = 2 * SECOND + SECOND // 3
    first, second, whole = (
        track.motion(a, b) for a, b in ((0, cut), (cut, 4 * SECOND), (0, 4 * SECOND))
    )
    np.testing.assert_allclose(compose(first.delta, second.delta), whole.delta, atol=1e-14)
    # 1/3 s is rounded to ns; a sigma of zero is held at 1e-9
    np.testing.assert_allclose(first.cov + second.cov, whole.cov, rtol=1e-9, atol=1e-15)
    assert first.length_m + second.length_m == pytest.approx(whole.length_m)


def test_before_the_first_and_after_the_last_reading_the_robot_stands():
    track = odometry_track([10, 11], [[5, 5, 1], [6, 5, 1]])
    before, after = track.pose(np.array([0, 20 * SECOND]))
    np.testing.assert_array_equal(before, [0, 0, 0])
    np.testing.assert_allclose(after, between(np.array([5, 5, 1]), np.array([6, 5, 1])), atol=1e-15)
    motion = track.motion(11 * SECOND, 20 * SECOND)
    np.testing.assert_array_equal(motion.delta, 0)


@pytest.mark.parametrize("times", [[0], [0, 1, 2]])
def test_standing_leaves_a_small_covariance_that_is_never_zero(times):
    """A zero covariance would weld two states together (and no noise model takes it)."""
    track = odometry_track(times, [[1, 2, 3]] * len(times))
    motion = track.motion(0, 2 * SECOND)
    np.testing.assert_array_equal(motion.delta, 0)
    np.testing.assert_allclose(motion.cov, STANDING_SIGMA**2 * np.eye(3))
    assert motion.length_m == 0
    assert motion.d_delta_d_calibration.shape[0] == 3


def test_burst_of_stamps_belongs_to_the_reading_before():
    """0.5 m in a microsecond is no motion but a logger that caught up: a scan stamped inside gets
    the reading recorded before it, not a share of the jump. At a real speed the share counts."""
    burst = odometry_track([0, 1, 1.000001, 2], [[0, 0, 0], [1, 0, 0], [1.5, 0, 0], [2, 0, 0]])
    inside = SECOND + 500
    assert burst.pose(inside)[0] == pytest.approx(1.0)
    assert burst.motion(0, inside).delta[0] == pytest.approx(1.0)
    assert burst.pose(SECOND + 1000)[0] == pytest.approx(1.5)
    assert burst.motion(inside, 2 * SECOND).delta[0] == pytest.approx(1.0)  # nothing is lost
    slow = odometry_track([0, 1, 2], [[0, 0, 0], [1, 0, 0], [1.5, 0, 0]])
    assert slow.pose(SECOND + SECOND // 2)[0] == pytest.approx(1.25)


def test_two_readings_of_one_stamp_both_count():
    """Zero seconds between them must not divide."""
    track = odometry_track([0, 1, 1, 2], [[0, 0, 0], [1, 0, 0], [1.2, 0, 0], [2, 0, 0]])
    assert track.motion(0, 2 * SECOND).delta[0] == pytest.approx(2.0)
    assert np.isfinite(track.pose(np.array([0, SECOND, 2 * SECOND]))).all()


def test_given_increments_keep_their_own_covariance():
    """An odometry source with honest noise gets none of ours on top; a share of an interval has
    that share of the variance."""
    track = Track(NOISE, EVEN)
    cov = np.diag([4e-4, 1e-4, 1e-5])
    track.add(OdometryIncrement("r", SECOND, SECOND, 0, np.array([1.0, 0.0, 0.0]), cov))
    motion = track.motion(0, SECOND)
    np.testing.assert_allclose(motion.delta, [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(motion.cov, cov, atol=1e-18)
    np.testing.assert_allclose(track.motion(0, SECOND // 4).cov, cov / 4, atol=1e-18)
    assert motion.d_delta_d_calibration.shape == (3, 0)


def test_track_grows_beyond_its_first_arrays():
    """2500 readings; a lost row would shorten the path."""
    track = odometry_track(0.1 * np.arange(2500), [[0.01 * k, 0, 0] for k in range(2500)])
    assert len(track) == len(track.times) == 2500
    assert track.motion(track.first_ns, track.last_ns).delta[0] == pytest.approx(24.99)
    assert track.moved(track.first_ns, track.last_ns) == pytest.approx((24.99, 0.0))


def test_reaches_and_near_tell_what_odometry_covers():
    track = Track(NOISE, EVEN)
    assert not track.reaches(0) and not track.covers(0, SECOND)
    track = odometry_track([10, 11, 14], [[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    assert track.reaches(14 * SECOND) and not track.reaches(14 * SECOND + 1)
    # between readings: they are no farther apart than the gap
    assert track.covers(10 * SECOND + 1, SECOND) and not track.covers(12 * SECOND, SECOND)
    assert track.covers(12 * SECOND, 3 * SECOND)
    # after: until a second reading is due, half a second at most; before: not at all, as its start
    # is where its odometry begins
    first, last = 10 * SECOND, 14 * SECOND + EDGE_NS
    assert track.covers(first, 9 * SECOND) and track.covers(last, 9 * SECOND)
    assert not track.covers(first - 1, 9 * SECOND) and not track.covers(last + 1, 9 * SECOND)
    # many at once
    edges = [10 * SECOND, 11 * SECOND, 12 * SECOND, 14 * SECOND, first, last]
    times = np.array([t + more for t in edges for more in (-1, 0, 1)], dtype=np.int64)
    for gap_ns in (SECOND, 3 * SECOND):
        one_by_one = [track.covers(t, gap_ns) for t in times.tolist()]
        assert track.covers_each(times, gap_ns).tolist() == one_by_one
    assert not Track(NOISE, EVEN).covers_each(times, SECOND).any()
    # one that stands at last is taken to stand for half a second, whatever the gap
    for ends in ([1, 0, 0], [1, 0, 1e-9]):
        still = odometry_track([10, 11, 14], [[0, 0, 0], [1, 0, 0], ends])
        assert still.covers(14 * SECOND + EDGE_NS, SECOND)
        assert not still.covers(14 * SECOND + EDGE_NS + 1, SECOND)
    # for two of the periods of 20 ms, or until it is a millimetre away
    for step, covered_s in (([0.01, 0, 0], 0.04), ([0, 0, 0.1], 0.04), ([0.0001, 0, 0], 0.2)):
        moving = odometry_track([10 + 0.02 * k for k in range(51)], np.outer(range(51), step))
        for seconds in (0.9 * covered_s, 1.1 * covered_s):
            assert moving.covers(round((11 + seconds) * SECOND), SECOND) == (seconds < covered_s)
    alone = odometry_track([10], [[0, 0, 0]])
    assert alone.covers(10 * SECOND + EDGE_NS, SECOND)


@pytest.mark.parametrize("source", ["poses", "wheels"])
def test_readings_asked_for_one_by_one_are_those_worked_out_at_once(source):
    """With turns across the seam, a burst, and for poses a jump: everything that accumulates is the
    same to rounding, some 1e-16 per reading."""
    rng = np.random.default_rng(4)
    moves = rng.normal(size=(200, 3)) * [0.2, 0.02, 0.3]
    times = np.cumsum(rng.uniform(0.05, 0.15, 200))
    times[120] = times[119] + 1e-6
    poses = [np.zeros(3)]
    for move in moves[1:]:
        poses.append(compose(poses[-1], move))
    poses[150] = poses[150] + [80.0, 0.0, 0.0]
    tracks = [Track(NOISE, ROBOT), Track(NOISE, ROBOT)]
    for k, t in enumerate(times):
        ns = round(t * SECOND)
        reading = OdometryPose("r", ns, ns, poses[k])
        if source == "wheels":
            reading = WheelAngles("r", ns, ns, *np.cumsum(moves, axis=0)[k, :2])
        for track in tracks:
            track.add(reading)
        tracks[0].moved(tracks[0].first_ns, ns)
    one, many = tracks
    at = np.append(many.times, many.times[:-1] + SECOND // 50)
    np.testing.assert_allclose(one.pose(at), many.pose(at), atol=1e-11)
    np.testing.assert_allclose(one.effort(at), many.effort(at), atol=1e-11)
    assert (one.resets, one.has_burst_stamps) == (many.resets, many.has_burst_stamps)
    assert one.resets == (2 if source == "poses" else 0)
    whole = many.first_ns, many.last_ns
    assert one.moved(*whole) == pytest.approx(many.moved(*whole), abs=1e-11)
    np.testing.assert_allclose(one.motion(*whole).cov, many.motion(*whole).cov, rtol=1e-9)


def test_a_second_reading_of_one_time_belongs_to_the_interval_that_ends_there():
    """Nothing of the way is lost, and no interval is empty."""
    track = odometry_track([0, 1, 1, 2], [[0, 0, 0], [1, 0, 0], [1.5, 0, 0], [2, 0, 0]])
    assert len(track) == 3 and not track.has_burst_stamps
    np.testing.assert_allclose(track.motion(0, SECOND).delta, [1.5, 0, 0], atol=1e-12)
    np.testing.assert_allclose(track.motion(SECOND, 2 * SECOND).delta, [0.5, 0, 0], atol=1e-12)
    assert track.motion(0, 2 * SECOND).length_m == pytest.approx(2.0)


def test_odometry_that_is_set_anew_is_no_motion():
    """It jumps by 50 m within a second; the robot is taken to have gone on as before."""
    places = [0.0, 0.5, 1.0, 51.0, 51.5]
    track = odometry_track(range(5), [[x, 0, 0] for x in places])
    assert track.resets == 1
    np.testing.assert_allclose(track.motion(0, 4 * SECOND).delta, [2.0, 0, 0], atol=1e-12)
    usual = odometry_track(range(5), [[0.5 * k, 0, 0] for k in range(5)])
    assert usual.resets == 0


@pytest.mark.parametrize("mounted", [False, True])
@pytest.mark.parametrize("kind", ["odometry", "commands", "wheels"])
def test_many_motions_at_once_are_the_single_ones(kind, mounted):
    """Forth and back, inside readings and beyond both ends; a lever arm from the wrong end, or the
    time of another clock, breaks it."""
    rng = np.random.default_rng(8)
    config = OdometryConfig(commanded_velocities=kind == "commands")
    track = Track(config, ROBOT, mounted=mounted)
    steps = rng.uniform(-0.02, 0.1, size=(200, 2))
    steps[60:90] = 0.0  # it stands for a while
    pose, angles = np.zeros(3), np.zeros(2)
    for k, step in enumerate(steps):
        ns = k * SECOND // 10
        pose = compose(pose, exp(np.array([step[0], 0.0, step[1]])))
        angles = angles + step
        if kind == "wheels":
            track.add(WheelAngles("r", ns, ns, *angles.tolist()))
        else:
            track.add(OdometryPose("r", ns, ns, pose))
    known = track.calibration
    mean = 0.3 * np.sqrt(np.diag(known.cov)) * rng.normal(size=len(known.mean))
    track.calibration = Calibration(known.names, mean, known.cov)
    start, end = rng.integers(-SECOND, 21 * SECOND, size=(2, 60))
    start[0] = end[0]
    at_readings = np.arange(60) % 2 == 0
    start[at_readings], end[at_readings] = (
        t[at_readings] // (SECOND // 10) * (SECOND // 10) + track.latency_ns for t in (start, end)
    )
    many = track.motions(start, end)
    for k in range(len(start)):
        one = track.between(int(start[k]), int(end[k]))
        miss = many.delta[k] - one.delta
        np.testing.assert_allclose([*miss[:2], wrap(miss[2])], 0.0, atol=1e-10)
        # within a reading the white noise of the part before is taken out along the axes of its
        # start, not along those of the part that is left: up to 0.1 rad apart here
        scale = np.sqrt(np.outer(np.diag(one.cov), np.diag(one.cov)))
        near = 1e-6 if at_readings[k] else 0.03
        np.testing.assert_allclose(many.cov[k] / scale, one.cov / scale, atol=near)
        if end[k] >= start[k]:
            # chords of parts of a circle segment: shorter by the square of its turn
            np.testing.assert_allclose(many.length_m[k], one.length_m, atol=1e-4)
            np.testing.assert_allclose(many.d_cal[k], one.d_delta_d_calibration, atol=1e-6)


def fleet(rng):
    """Tracks of several kinds, nothing read yet, and 150 readings of each."""
    tracks, readings = [], []
    for kind in ("odometry", "commands", "commands", "wheels", "wheels", "given"):
        config = OdometryConfig(commanded_velocities=kind == "commands")
        robot = replace(ROBOT, axle_m=rng.uniform(0.4, 0.7))
        tracks.append(Track(config, robot, mounted=kind != "given"))
        steps = rng.uniform(-0.02, 0.1, size=(150, 2))
        stands = 20 + 10 * len(tracks)
        steps[stands : stands + 40] = 0.0  # while others do not
        poses = [np.array([1e3, -1e3, 0.0])]
        for along, turned in steps:
            poses.append(compose(poses[-1], exp(np.array([along, 0.0, turned]))))
        times = (SECOND // 10) * np.arange(1, 151) + int(rng.integers(SECOND))
        times[100] = times[99] + 1_000_000  # in a burst
        times[120] = times[119]  # a second reading of one time
        own = []
        for k, (ns, pose, angles) in enumerate(
            zip(times.tolist(), poses, np.cumsum(steps, axis=0), strict=False)
        ):
            if kind == "wheels":
                own.append(WheelAngles("r", ns, ns, *angles.tolist()))
            elif kind == "given":
                delta, cov = between(pose, poses[k + 1]), np.diag([1e-4, 1e-5, 1e-6])
                own.append(OdometryIncrement("r", ns, ns, ns - SECOND // 10, delta, cov))
            else:
                jump = [50.0, 0.0, 0.0] if k > 95 and len(tracks) == 3 else [0.0] * 3
                own.append(OdometryPose("r", ns, ns, pose + jump))
        readings.append(own)
    return tracks, readings


def test_readings_of_several_robots_at_once_are_those_of_each():
    """Turns, standing, a burst, a jump, a repeated time: worked out one by one, and all together
    in some goes."""
    (single, readings), (together, _) = (fleet(np.random.default_rng(5)) for _ in range(2))
    for track, own in zip(single, readings, strict=True):
        for reading in own:
            track.add(reading)
            track.pose(reading.time_ns)
    goes = [0, 30, *range(31, 110), 150]
    for part in map(slice, goes[:-1], goes[1:]):
        for track, own in zip(together, readings, strict=True):
            for reading in own[part]:
                track.add(reading)
        integrate_pending(together)
    for one, other, own in zip(single, together, readings, strict=True):
        times = np.array([r.time_ns for r in own])
        times = np.sort(np.concatenate([times, times + 37_000_000]))
        # sums over 150 readings of places 1.4 km away
        np.testing.assert_allclose(other.pose(times), one.pose(times), atol=1e-9)
        np.testing.assert_allclose(other.effort(times), one.effort(times), atol=1e-11)
        assert (other.resets, other._bursts) == (one.resets, one._bursts)
    assert [t.resets for t in together] == [0, 0, 1, 0, 0, 0]


def test_who_stands_beside_one_who_drives_has_not_moved():
    """To the digit, or the floor of its motions is that of a robot that drives: also next to a sum
    that is ten thousand times as large as what it drove before."""
    drives, stands = (Track(NOISE, ROBOT) for _ in range(2))
    places = np.cumsum(np.random.default_rng(1).uniform(0.1, 0.3, size=900))
    for k, place in enumerate(places.tolist()):
        for track, x in ((drives, place), (stands, min(place, 0.5) / 30)):
            track.add(OdometryPose("r", k * SECOND, k * SECOND, np.array([x, 0.0, 0.0])))
        if k == 10:
            integrate_pending([drives, stands])
    integrate_pending([drives, stands])
    begin, end = 10 * SECOND, 899 * SECOND
    assert stands.effort(end) == stands.effort(begin)
    assert stands.moved(begin, end) == (0.0, 0.0)
    assert stands.motion(begin, end).cov[0, 0] == pytest.approx(STANDING_SIGMA**2)


def test_motions_of_several_robots_at_once_are_those_of_each():
    """Tracks of several kinds, one asked twice, one for nothing, one without readings; each by a
    calibration of its own."""
    rng = np.random.default_rng(6)
    tracks, readings = fleet(rng)
    for track, own in zip(tracks, readings, strict=True):
        for reading in own:
            track.add(reading)
        known = track.calibration
        mean = 0.3 * np.sqrt(np.diag(known.cov)) * rng.normal(size=len(known.mean))
        track.calibration = Calibration(known.names, mean, known.cov)
    still = Track(NOISE, ROBOT)
    still.add(OdometryPose("r", SECOND, SECOND, np.zeros(3)))
    asked = []
    for track in [*tracks, tracks[1], tracks[3], still]:
        asked.append((track, *rng.integers(-SECOND, 17 * SECOND, size=(2, 12))))
    asked.append((tracks[2], *np.zeros((2, 0), dtype=np.int64)))
    for (track, start, end), found in zip(asked, preintegrate_batch(asked), strict=True):
        assert len(found.delta) == len(start)
        if not len(start):
            continue
        alone = track.motions(start, end)
        for what in ("delta", "cov", "d_cal", "length_m"):
            # sums over what the others drove, too
            np.testing.assert_allclose(
                getattr(found, what), getattr(alone, what), rtol=1e-7, atol=1e-11, err_msg=what
            )


def test_a_robot_that_turns_drives_less_of_what_was_commanded():
    """By d²/2 per squared curvature, where the speed meant is that of a point at distance d: to
    the fourth order in d times the curvature."""
    v, turn, d = 0.1, 0.08, 0.15
    twist = [np.hypot(v, d * turn), 0.0, turn]
    calibration = np.array([0.0, 0.0, 0.0, d**2 / 2])
    found = MOTION_SOURCES["commands"](np.array([[*twist, 0.0]]), calibration, ROBOT, NOISE).delta[
        0
    ]
    np.testing.assert_allclose(found, exp(np.array([v, 0.0, turn])), atol=v * (d * turn / v) ** 4)
    assert found[0] < exp(np.array(twist))[0]


@pytest.mark.parametrize("source", ["wheels", "odometry"])
def test_parameters_drawn_anew_in_every_reading_are_the_printed_noise(source):
    """4.9-4.13 against sampled radii, counts and axles; and nothing of the odometry is calibrated.

    Of odometry that reports poses the wheels are the robot's: the same motion, the same noise."""
    config = replace(
        NOISE, parameter_noise="white", wheel_radius_sigma_m=0.002, axle_sigma_m=0.01,
        count_sigma_rad=0.05, k_x_m=0, k_x_rad=0, k_y_m=0, k_y_rad=0, k_phi_m=0, k_phi_rad=0,
    )  # fmt: skip
    turns = np.array([2.0, 2.6])
    rows = turns[None] if source == "wheels" else wheel_twist(turns[None], ROBOT)
    track = Track(config, ROBOT)
    track._begin(source, 0)
    rows = np.column_stack([rows, np.zeros(1)])
    found = track.increments(rows, track.calibration.mean)
    rng = np.random.default_rng(3)
    sigmas = np.array([0.002, 0.002, 0.05, 0.05, 0.01])
    nominal = np.array([0.11, 0.1, *turns, 0.6])
    drawn = nominal + sigmas * rng.normal(size=(200_000, 5))
    path = (drawn[:, 0] * drawn[:, 2] + drawn[:, 1] * drawn[:, 3]) / 2
    turning = (drawn[:, 1] * drawn[:, 3] - drawn[:, 0] * drawn[:, 2]) / drawn[:, 4]
    moved = exp(np.column_stack([path, np.zeros(len(path)), turning]))
    np.testing.assert_allclose(found.cov[0], np.cov(moved.T), rtol=0.02, atol=2e-6)
    assert track.calibration.cov.max() <= 1e-18
    plain = Track(NOISE, ROBOT)
    plain._begin(source, 0)
    assert plain.calibration.cov.max() > 1e-8


def test_white_parameter_noise_averages_out_and_a_constant_error_does_not():
    """Why the thesis' heading is too certain after a straight drive: sigma grows with the root of
    the path there, in proportion to it here."""
    sigma = {}
    for kind in ("white", "constant"):
        config = replace(NOISE, parameter_noise=kind, k_phi_m=0.0, k_phi_rad=0.0, count_sigma_rad=0)
        for metres in (10, 40):
            track = Track(config, EVEN)
            turns = np.linspace(0.0, metres / 0.1, 10 * metres + 1)
            for n, turn in enumerate(turns):
                stamp = n * SECOND // 10
                track.add(WheelAngles("r", stamp, stamp, turn, turn))
            moved = track.motion(0, 10 * metres * SECOND // 10)
            sigma[kind, metres] = np.sqrt(moved.cov[2, 2])
    assert sigma["white", 40] / sigma["white", 10] == pytest.approx(2.0, rel=0.05)
    assert sigma["constant", 40] / sigma["constant", 10] == pytest.approx(4.0, rel=0.05)
