"""Tracks of a sensor: its mount and latency, what is known of them, and where readings end."""

from dataclasses import replace

import numpy as np
import pytest
from finite_differences import jacobian
from pose_checks import assert_same_pose

from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.geometry import between, compose, exp, inverse, inverse_cov, rotation3
from graphslam.core.motion_models import nominal_calibration
from graphslam.core.records import OdometryIncrement, OdometryPose, WheelAngles
from graphslam.odometry.calibration_jacobian import CalibratedSource
from graphslam.odometry.mounted_motions import calibration_covs
from graphslam.odometry.noise_estimation import without_floors
from graphslam.odometry.path_sums import LATENCY_STEP_NS
from graphslam.odometry.preintegration import STANDING_SIGMA, Track

S = 1_000_000_000
ROBOT = RobotConfig(wheel_radius_left_m=0.11, wheel_radius_right_m=0.1, axle_m=0.6)
NOISE = OdometryConfig()
TWIST = np.array([0.5, 0.02, 0.15])  # per second
MOUNT, LATE_S = np.array([0.3, -0.1, 0.2]), 0.12


def curve(t):
    return exp(TWIST * np.asarray(t, float)[..., None])


def track_of(times_s, poses, *, config=NOISE, mean=None, **options):
    track = Track(config, ROBOT, **options)
    for t, pose in zip(times_s, poses, strict=True):
        ns = round(float(t) * S)
        track.add(OdometryPose("r", ns, ns, np.asarray(pose, float)))
    if mean is not None:
        track.calibration = replace(track.calibration, mean=np.asarray(mean, float))
    return track


def mounted(config=NOISE, begin_s=0.0):
    """Ten readings a second along the curve, by a robot whose laser and latency were learned."""
    times = np.arange(0, 10.01, 0.1)
    mean = np.zeros(8 if config.commanded_velocities else 7)
    mean[-4:] = [*MOUNT, LATE_S]
    return track_of(begin_s + times, curve(times), config=config, mean=mean, mounted=True)


def burst(**options):
    """Every tenth reading comes a microsecond after the one before, with the way of 0.1 s."""
    times = 0.1 * np.arange(100)
    times[10::10] = times[9:-1:10] + 1e-6
    return track_of(times, curve(0.1 * np.arange(100)), mean=[0.01, 0.02, 0, *MOUNT, LATE_S],
                    mounted=True, **options)  # fmt: skip


# ------------------------------------------------------------ readings that are cut


@pytest.mark.parametrize("period_s", [0.1, 2.0, 28.0])
def test_motions_that_cut_a_reading_have_the_noise_of_what_is_left_of_it(period_s):
    """However far apart readings are: with another lever for what is taken away, 10 m of a reading
    leave variances below zero."""
    bare = without_floors(NOISE)
    track = track_of(period_s * np.arange(5), curve(period_s * np.arange(5)), config=bare)
    track.calibration = track.calibration.held()
    rng = np.random.default_rng(0)
    times = np.sort(rng.uniform(0, 4 * period_s, 40))
    times = np.append(times, 2 * period_s)  # also at a reading
    start, end = (np.sort(times[rng.integers(0, 41, (2, 60))], axis=0) * S).astype(np.int64)
    apart = end > start
    start, end = start[apart], end[apart]
    many = track.motions(start, end)
    assert np.linalg.eigvalsh(many.cov).min() > 0
    for k, (a, b) in enumerate(zip(start.tolist(), end.tolist(), strict=True)):
        one = track.motion(a, b)
        assert_same_pose(many.delta[k], one.delta, atol=1e-9)
        np.testing.assert_allclose(many.cov[k], one.cov, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("track", [mounted, burst, lambda: track_of(range(12), curve(range(12)))])
def test_motions_among_given_times_are_those_of_any_two_of_them(track):
    """Also backwards and from a time to itself. Sums that begin elsewhere differ by rounding."""
    track = track()
    times = (np.sort(np.random.default_rng(0).uniform(1, 9, 20)) * S).astype(np.int64)
    i, j = (k.ravel() for k in np.indices((20, 20)))
    among, each = track.motions_among(times)(times[i], times[j]), track.motions(times[i], times[j])
    for name in ("delta", "cov", "d_cal", "length_m"):
        np.testing.assert_allclose(getattr(among, name), getattr(each, name), atol=1e-12)


# ------------------------------------------------------------ latency


def test_a_late_track_is_the_one_of_earlier_times():
    """Motions, poses and the motions of many intervals at once, with the frame at the mount; a
    latency of the other sign is 24 cm off."""
    track = mounted()
    start, end = np.array([1.0, 2.0, 7.3]), np.array([1.5, 6.0, 8.0])
    late = [(curve(t - LATE_S)) for t in (start, end)]
    expected = between(compose(late[0], MOUNT), compose(late[1], MOUNT))
    for a, b, delta in zip((start * S).astype(int), (end * S).astype(int), expected, strict=True):
        assert_same_pose(track.motion(int(a), int(b)).delta, delta)
    many = track.motions((start * S).astype(np.int64), (end * S).astype(np.int64))
    assert_same_pose(many.delta, expected)
    found = track.mounted_pose((start * S).astype(np.int64))
    assert_same_pose(found, compose(late[0], MOUNT))
    assert track.latency_ns == round(LATE_S * S)


def test_what_is_late_is_the_sensor_unless_the_robot_follows_commands():
    """Measured odometry says when the robot was where it says; commands do not."""
    of_sensor, of_commands = mounted(), mounted(replace(NOISE, commanded_velocities=True))
    assert of_sensor.reported_late_ns(of_sensor.calibration) == round(LATE_S * S)
    assert of_commands.reported_late_ns(of_commands.calibration) == 0
    assert of_commands.latency_ns == round(LATE_S * S)
    plain = track_of([0, 1], curve([0, 1]))
    assert plain.latency_ns == plain.reported_late_ns(plain.calibration) == 0


def test_stamps_in_bursts_teach_no_latency():
    """A share of a reading then says nothing about the time: no latency is used, none is derived,
    and the rest of the calibration stays."""
    track = burst()
    assert track.has_burst_stamps
    used = track.used_calibration
    np.testing.assert_array_equal(used.mean, [*track.calibration.mean[:-1], 0.0])
    np.testing.assert_array_equal(used.cov, track.calibration.cov)
    assert track.latency_ns == track.reported_late_ns(track.calibration) == 0
    single = track.motion(S, 5 * S).d_delta_d_calibration
    many = track.motions(np.array([S]), np.array([5 * S])).d_cal[0]
    for d_cal in (single, many):
        np.testing.assert_array_equal(d_cal[:, -1], 0.0)
        assert np.abs(d_cal[:, -2]).max() > 0.1
    regular = mounted()
    assert regular.used_calibration is regular.calibration


@pytest.mark.parametrize("interval", [(0.13, 0.16), (9.9, 10.15), (3.0, 3.1)])
def test_the_derivative_by_latency_at_the_ends_of_the_readings(interval):
    """Before the first reading and after the last the robot stands: where the interval slides into
    that, the motion gets shorter by all of its speed. Single and many at once."""
    track = mounted()
    start, end = (round(t * S) for t in interval)

    def motion(late_ns):
        poses = track.pose(np.array([start, end]) - late_ns)
        return between(*compose(poses, MOUNT))

    step = LATENCY_STEP_NS
    expected = (motion(track.latency_ns + step) - motion(track.latency_ns)) * (S / step)
    # the lever arm of the turning is of first order here: 0.15 rad/s in 0.05 s
    single = track.motion(start, end).d_delta_d_calibration[:, -1]
    np.testing.assert_allclose(single, expected, atol=2e-3)
    many = track.motions(np.array([start]), np.array([end])).d_cal[0, :, -1]
    np.testing.assert_allclose(many, single, atol=1e-6)
    if interval[0] < 1:
        assert np.abs(expected).max() > 0.1


def test_what_the_readings_cover_is_asked_at_late_times():
    """Uncovered by 0.1 s of 0.5 m/s at either end; the bound is that motion, and nothing inside."""
    track = mounted(begin_s=50.0)
    first, last = track.first_ns + track.latency_ns, track.last_ns + track.latency_ns
    inside = track.is_uncovered(np.array([first, first]), np.array([last, last - S]))
    assert not inside.any()
    outside = track.is_uncovered(np.array([first - 1, first]), np.array([last, last + 1]))
    assert outside.all()
    np.testing.assert_array_equal(track.uncovered_bound(first, last), 0.0)
    expected = np.abs(between(curve(0.0), curve(0.1)))
    before = track.uncovered_bound(first - S // 10, first + S)
    after = track.uncovered_bound(last - S, last + S // 10)
    np.testing.assert_allclose(before, expected, atol=1e-9)
    np.testing.assert_allclose(after, expected, atol=1e-9)
    both = track.uncovered_bound(first - S // 10, last + S // 10)
    np.testing.assert_allclose(both, 2 * expected, atol=1e-9)
    # no more than the interval itself, and no more than was ever driven
    long_before = track.uncovered_bound(first - 9 * S, first - 8 * S)
    np.testing.assert_allclose(long_before, np.abs(between(curve(0.0), curve(1.0))), atol=1e-9)
    much = track.uncovered_bound(first - 30 * S, first + S)
    np.testing.assert_allclose(much, np.abs(between(curve(0.0), curve(10.0))), atol=1e-9)


# ------------------------------------------------------------ the mount


def test_the_mount_is_that_of_the_calibration_and_none_without_one():
    track = mounted()
    np.testing.assert_array_equal(track.mount, MOUNT)
    np.testing.assert_array_equal(track.mount_cov, track.calibration.cov[3:6, 3:6])
    assert track.increment_parameters == 3
    plain = track_of([0, 1], curve([0, 1]))
    np.testing.assert_array_equal(plain.mount, np.zeros(3))
    np.testing.assert_array_equal(plain.mount_cov, np.zeros((3, 3)))
    assert plain.increment_parameters == 3 and not plain.is_mounted


@pytest.mark.parametrize("sigmas, is_held", [(2.9, False), (3.1, True)])
def test_a_mount_is_held_where_the_log_has_it_unless_it_is_far_off(sigmas, is_held):
    """Three sigmas off, by its covariance; scales and latency stay as they were learned."""
    times = 0.1 * np.arange(20)
    track = track_of(times, curve(times), mounted=True)
    off = 3.0 * np.sqrt(np.diag(track.calibration.cov)[3:6]) * np.array([0.6, 0.0, -0.8])
    mean = np.array([0.01, 0.02, 0.03, *off, LATE_S])
    track.calibration = replace(track.calibration, mean=mean)
    track.hold_mount_unless(sigmas)
    np.testing.assert_array_equal(track.mount, np.zeros(3) if is_held else off)
    np.testing.assert_array_equal(track.calibration.mean[[0, 1, 2, 6]], mean[[0, 1, 2, 6]])
    for known in (track.calibration, track.prior):
        assert (np.diag(known.cov)[3:6] < 1e-20).all() == is_held
        assert np.diag(known.cov)[[0, 1, 2, 6]].min() > 1e-6
    plain = track_of(times, curve(times))
    before = plain.calibration
    plain.hold_mount_unless(sigmas)
    assert plain.calibration is before


@pytest.mark.parametrize("path_m", [0.1, 0.25])
def test_coarse_motions_are_those_of_the_mounted_frame(path_m):
    """Motion and sigmas of one piece, each interval by a calibration of its own: 4 % of a sigma, as
    an error of the heading in its beginning is left out; the latency's is left out as a whole."""
    track = mounted()
    known = replace(track.calibration, cov=np.diag([0.02, 0.03, 0.02, 0.05, 0.04, 0.03, 1e-9]) ** 2)
    off = np.array([0.02, -0.03, 0.01, 0.1, 0.1, -0.1, 0.07])
    other = replace(known, mean=known.mean + off)
    start, end = 3 * S, 3 * S + round(path_m / TWIST[0] * S)
    starts, ends = (np.full(2, t, dtype=np.int64) for t in (start, end))
    delta, cov = track.coarse_motions(starts, ends, [known, other], np.array([1, 0]))
    for k, calibration in ((0, other), (1, known)):
        track.calibration = calibration
        motion = track.motion(start, end)
        assert_same_pose(delta[k], motion.delta, atol=1e-6)
        scale = np.sqrt(np.diag(motion.cov))
        np.testing.assert_allclose(np.sqrt(np.diag(cov[k])), scale, rtol=0.04)
        off = (cov[k] - motion.cov) / np.outer(scale, scale)
        assert np.abs(off).max() < 0.08


def test_coarse_motions_without_time_are_certain_and_those_at_rest_nearly():
    """The floor is that of a robot that moved only where it did."""
    track = track_of([0, 1, 2, 3], [[0, 0, 0], [1, 0, 0], [1, 0, 0], [1, 0, 0.5]])
    start, end = np.array([S, S, 0, 2 * S]), np.array([S, 2 * S, S, 3 * S])
    _, cov = track.coarse_motions(start, end, [track.calibration], np.zeros(4, dtype=np.int64))
    np.testing.assert_array_equal(cov[0], 0.0)
    np.testing.assert_allclose(cov[1], STANDING_SIGMA**2 * np.eye(3), rtol=1e-12)
    for k in (2, 3):
        assert cov[k, 0, 0] >= NOISE.floor_sigma_m**2


def test_long_coarse_motions_are_chains_of_pieces():
    """Thirty pieces on a circle; intervals with one start share them, others do not. Without the
    pieces the end of an arc of 2.2 rad would have the noise of a straight drive."""
    track = mounted()
    start = np.array([0, 0, 2, 0], dtype=np.int64) * S
    end = np.array([10, 4, 9, 1], dtype=np.int64) * S
    delta, cov = track.coarse_motions(
        start, end, [track.used_calibration], np.zeros(4, dtype=np.int64)
    )
    for k in range(4):
        motion = track.motion(int(start[k]), int(end[k]))
        assert_same_pose(delta[k], motion.delta, atol=1e-6)
        by_latency = np.outer(*[motion.d_delta_d_calibration[:, -1]] * 2)
        expected = motion.cov - track.calibration.cov[-1, -1] * by_latency
        scale = np.sqrt(np.diag(expected))
        assert np.abs((cov[k] - expected) / np.outer(scale, scale)).max() < 0.06


# ------------------------------------------------------------ floors, and other sources


@pytest.mark.parametrize(
    "pose, moved", [([0.2, 0, 0], True), ([0, 0, 0.3], True), ([0, 0, 0], False)],
    ids=["ahead", "on the spot", "at rest"],
)  # fmt: skip
def test_every_motion_has_the_floor_once(pose, moved):
    """Of position and heading, turning on the spot too; a robot at rest has a smaller one."""
    config = OdometryConfig(floor_sigma_m=0.5, floor_sigma_rad=0.7)
    bare = OdometryConfig(floor_sigma_m=0.0, floor_sigma_rad=0.0)
    single, many = [], []
    for each in (config, bare):
        track = track_of([0, 1, 2], [[0, 0, 0], pose, pose], config=each)
        single.append(track.motion(0, S).cov)
        many.append(track.motions(np.array([0]), np.array([S])).cov[0])
    floor = np.diag([0.25, 0.25, 0.49]) if moved else np.zeros((3, 3))
    for with_floor, without in (single, many):
        np.testing.assert_allclose(with_floor - without, floor, atol=1e-12)


def test_increments_with_covariances_have_no_floor_and_need_no_calibration():
    """Unless its stamps may be late, a sensor on such a robot is rigid to what is reported."""
    for late in (False, True):
        track = Track(NOISE, ROBOT, mounted=True, late=late)
        cov = np.diag([4e-4, 1e-4, 1e-5])
        for k in range(1, 30):
            at = k * S // 10
            track.add(OdometryIncrement("r", at, at, at - S // 10, curve(0.1), cov))
        assert track.is_mounted is late
        np.testing.assert_array_equal(track.floor_cov, 0.0)
        assert len(track.calibration.mean) == 4 * late
        _, found = track.coarse_motions(
            np.array([S]), np.array([S + S // 10]), [track.calibration], np.array([0])
        )
        if not late:
            np.testing.assert_allclose(found[0], cov, rtol=1e-9, atol=1e-18)
            np.testing.assert_allclose(track.motion(S, S + S // 10).cov, cov, atol=1e-15)


def test_the_way_back_is_the_inverse_with_its_covariance():
    track = mounted()
    forth, back = track.between(2 * S, 5 * S), track.between(5 * S, 2 * S)
    assert_same_pose(back.delta, inverse(forth.delta))
    np.testing.assert_allclose(back.cov, inverse_cov(forth.delta, forth.cov), rtol=1e-12)
    assert (back.start_ns, back.end_ns) == (5 * S, 2 * S)
    assert (forth.start_ns, forth.end_ns) == (2 * S, 5 * S)


def test_the_derivative_of_the_way_back_is_that_of_its_own_motion():
    """By scales and mount, of one motion and of many at once, against finite differences (they
    round by 1e-11 where readings are summed). The derivative of the way there is up to 3 off.
    That by the latency is a one-sided difference; on this curve, which goes on alike, it is 0."""
    track = mounted()
    mean, known = track.calibration.mean.copy(), track.calibration

    def back(parameters):
        moved = replace(known, mean=np.append(parameters, mean[-1:]))
        track.calibration = moved
        return track.between(5 * S, 2 * S).delta

    expected = np.column_stack([jacobian(back, mean[:-1]), np.zeros(3)])
    track.calibration = known
    one = track.between(5 * S, 2 * S)
    many = track.motions(np.array([5 * S, 2 * S]), np.array([2 * S, 5 * S]))
    np.testing.assert_allclose(one.d_delta_d_calibration, expected, atol=1e-8)
    np.testing.assert_allclose(many.d_cal[0], expected, atol=1e-8)
    assert np.abs(many.d_cal[1] - expected).max() > 0.3


@pytest.mark.parametrize("source", ["odometry", "wheels"])
def test_the_derivative_of_given_motions_is_that_of_their_calibration(source):
    """Motions whose readings are gone, by their twists: what another calibration makes of them."""
    track = Track(NOISE, ROBOT)
    track._begin(source, 0)
    p = len(nominal_calibration(source, NOISE, False).mean)
    known = np.array([0.01, -0.02, 0.03])[:p] * (0.1 if source == "wheels" else 1.0)
    track.calibration = replace(track.calibration, mean=known)
    twists = np.array([[0.4, 0.0, 0.2], [-0.2, 0.0, 0.3]])

    def moved(parameters):
        if source == "wheels":
            turns = np.column_stack([
                (twists[:, 0] - 0.3 * twists[:, 2]) / 0.11,
                (twists[:, 0] + 0.3 * twists[:, 2]) / 0.1, np.zeros(2),
            ])  # fmt: skip
            return track.increments(turns, parameters).delta.ravel()
        rows = np.column_stack([twists, np.zeros(2)])
        return track.increments(rows, parameters).delta.ravel()

    numeric = jacobian(moved, known)
    np.testing.assert_allclose(
        CalibratedSource.of(track).derivative(twists).reshape(-1, p), numeric, atol=1e-6
    )


def test_tracks_are_integrated_together_only_if_data_alone_differ():
    """Two robots with wheels have their own geometry; others only their readings."""
    tracks = [mounted(), mounted(), track_of([0, 1], curve([0, 1])), Track(NOISE, ROBOT)]
    wheels = [Track(NOISE, ROBOT) for _ in range(2)]
    for track in wheels:
        for k in range(3):
            track.add(WheelAngles("r", k * S, k * S, 0.1 * k, 0.2 * k))
    keys = [t.batch_key for t in (*tracks, *wheels)]
    assert keys[0] == keys[1]
    assert len(set(keys)) == len(keys) - 1


def test_an_error_of_the_base_moves_the_sensor_with_its_lever_arm():
    """White noise of the heading alone: at a laser 2 m ahead it is one of its sideways position."""
    quiet = dict.fromkeys(("k_x_m", "k_x_rad", "k_y_m", "k_y_rad", "k_phi_m"), 0.0)
    config = OdometryConfig(k_phi_rad=1e-4, floor_sigma_m=0.0, floor_sigma_rad=0.0, **quiet)
    track = track_of([0, 1, 2], [[0, 0, 0], [0, 0, 0.5], [0, 0, 0.5]], config=config, mounted=True)
    mean = np.array([0, 0, 0, 2.0, 0.0, 0.0, 0.0])
    track.calibration = replace(track.calibration, mean=mean).held()
    cov = track.motion(0, S).cov
    lever = rotation3(0.5) @ np.array([0.0, 2.0, 1.0])
    np.testing.assert_allclose(cov, 1e-4 * 0.5 * np.outer(lever, lever), atol=1e-15)


# ------------------------------------------------------------ a sensor without a lever arm


def test_motions_without_a_mount_are_those_with_a_tiny_one():
    """Without a mount the lever arm is left out of the calculation. Breaks if a column of the
    derivative, the wrapping of the heading or the covariance of the calibration is left out too;
    2e-12 m moves the path of a few metres by about as much."""
    times = np.arange(0, 40.01, 0.1)  # turns by 6 rad
    found = []
    for mount in (np.zeros(3), np.full(3, 2e-12)):
        mean = np.array([0.01, 0.02, 0.0, *mount, LATE_S])
        track = track_of(times, curve(times), mean=mean, mounted=True)
        begin = np.arange(1, 30) * S
        found.append(track.motions(begin, np.append(begin[1:], 38 * S)))
    for name in ("delta", "cov", "d_cal"):
        np.testing.assert_allclose(*(getattr(one, name) for one in found), atol=1e-9, err_msg=name)


def test_motions_of_one_track_and_of_several_have_the_same_covariance():
    """By the calibration of each: of one track that is a single product of matrices."""
    rng = np.random.default_rng(0)
    d_cal, A = rng.normal(size=(20, 3, 7)), rng.normal(size=(2, 7, 7))
    known, which = A @ A.mT, np.repeat([0, 1], 10)
    both = calibration_covs(d_cal, known, which)
    each = [calibration_covs(d_cal[which == k], known[k : k + 1], which[:10] * 0) for k in (0, 1)]
    np.testing.assert_allclose(both, np.concatenate(each), rtol=1e-12)
