"""Trajectories between states: through the states, by odometry, honest about what is known when."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from finite_differences import jacobian
from pose_checks import assert_same_pose
from scipy.linalg import eigh

from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.geometry import (
    adjoint,
    between,
    compose,
    compose_cov,
    exp,
    inverse,
    log,
    rotate_cov,
)
from graphslam.core.mount_covariances import MountCovariances
from graphslam.core.records import Estimate, OdometryPose, Start, Step, Trajectory
from graphslam.odometry.interpolation import (
    FrameTransforms,
    causal_at,
    final_at,
    final_scans,
    origin_shift,
    trajectory_of_mount,
    transform_trajectory,
    with_stamp_errors,
)
from graphslam.odometry.preintegration import Track

SECOND = 1_000_000_000
TWIST = np.array([0.5, 0.02, 0.15])  # per second


def odometry_track(times_s, poses, upto_s=np.inf, **options):
    track = Track(OdometryConfig(), RobotConfig(), **options)
    for t, pose in zip(times_s, poses, strict=True):
        if t <= upto_s:
            ns = round(t * SECOND)
            track.add(OdometryPose("r", ns, ns, np.asarray(pose, float)))
    return track


def curve(t):
    """Odometry's pose after t seconds."""
    return exp(TWIST * t)


READINGS = np.arange(0, 12.01, 0.1)
STATES_S = [1.0, 3.0, 4.0, 7.0, 11.0]


def states():
    """States that odometry's curve misses by some centimetres, in another world frame."""
    rng = np.random.default_rng(9)
    world = np.array([3.0, -2.0, 1.0])
    poses = np.array(
        [compose(compose(world, curve(t)), 0.05 * rng.normal(size=3)) for t in STATES_S]
    )
    roots = 0.05 * rng.normal(size=(len(STATES_S), 3, 3))
    covs = roots @ roots.mT + 1e-5 * np.eye(3)
    return Trajectory(ns(STATES_S), poses, covs)


def ns(times_s):
    return np.array([round(t * SECOND) for t in times_s], dtype=np.int64)


STATES = states()
TRACK = odometry_track(READINGS, [curve(t) for t in READINGS])
EVERYWHERE = np.sort(np.random.default_rng(3).uniform(0.0, 12.0, 200))


def at(times_s, *, causal, given=STATES, track=TRACK, known=None, stamps=None):
    """Poses at the times; ``known``: the calibration at each state, the track's own if None."""
    times = ns(times_s)
    stamps = times if stamps is None else stamps
    if causal:
        known = [track.calibration] * len(given) if known is None else known
        return causal_at(given, given.index_before(times), known, track, times, stamps)
    return final_at(given, track, times, stamps)


@pytest.mark.parametrize("causal", [True, False])
def test_trajectory_passes_through_the_states(causal):
    """Pose and covariance of a state come out as they are."""
    found = at(STATES_S, causal=causal)
    assert_same_pose(found.poses, STATES.poses, atol=1e-14)
    np.testing.assert_allclose(found.covs, STATES.covs, atol=1e-17)


@pytest.mark.parametrize("causal", [True, False])
def test_covariances_are_symmetric_and_positive_semidefinite_everywhere(causal):
    covs = at(EVERYWHERE, causal=causal).covs
    covs = np.concatenate([covs, at(STATES_S, causal=causal).covs])
    np.testing.assert_allclose(covs, covs.mT, atol=1e-16)
    assert np.linalg.eigvalsh(covs).min() > 0


@pytest.mark.parametrize("causal", [True, False])
def test_results_bear_the_stamps_given(causal):
    """Time places a message, its stamp names it; they differ where a log's stamps jump."""
    stamps = np.array([77, 55])
    found = at([2.0, 5.0], causal=causal, stamps=stamps)
    np.testing.assert_array_equal(found.stamps_ns, stamps)
    np.testing.assert_array_equal(found.poses, at([2.0, 5.0], causal=causal).poses)


@pytest.mark.parametrize("time_s", [0.4, 1.0, 2.95, 3.0, 3.05, 5.0, 6.99, 8.0, 11.5])
def test_causal_never_uses_later_data(time_s):
    """Cutting states and odometry off behind the reading that covers the time changes nothing, to
    the last digit: pose and covariance."""
    cover = np.ceil(round(time_s * 10, 6)) / 10  # the reading at or after the time
    known = max(1, sum(t <= time_s for t in STATES_S))  # (before the first state: from it)
    past = Trajectory(STATES.stamps_ns[:known], STATES.poses[:known], STATES.covs[:known])
    cut = odometry_track(
        READINGS, [curve(t) for t in READINGS], upto_s=max(cover, STATES_S[0]) + 1e-6
    )
    whole, seen = at([time_s], causal=True), at([time_s], causal=True, given=past, track=cut)
    np.testing.assert_array_equal(whole.poses, seen.poses)
    np.testing.assert_array_equal(whole.covs, seen.covs)


def test_causal_never_uses_a_calibration_that_was_learned_later():
    """Neither that of later states nor what the track has in the end: position, heading, latency
    and the laser's place are all learned on the way."""
    track = odometry_track(READINGS, [curve(t) for t in READINGS], mounted=True)
    nominal, rng = track.calibration, np.random.default_rng(4)
    known = [
        replace(nominal, mean=0.05 * rng.normal(size=len(nominal.mean)), cov=n * nominal.cov)
        for n in range(1, 6)
    ]
    times = [2.0, 3.5, 6.9]
    before = at(times, causal=True, track=track, known=known)
    track.calibration = replace(nominal, mean=np.full(len(nominal.mean), 0.07))
    other = [*known[:3], *(replace(nominal, mean=nominal.mean + 0.03) for _ in range(2))]
    after = at(times, causal=True, track=track, known=other)
    np.testing.assert_array_equal(before.poses, after.poses)
    np.testing.assert_array_equal(before.covs, after.covs)
    # and it does use what was known: another calibration of the state before moves the pose
    other[2] = replace(nominal, mean=nominal.mean + 0.03)
    moved = at(times, causal=True, track=track, known=other).poses
    assert np.abs(moved[2] - before.poses[2]).max() > 1e-3
    np.testing.assert_array_equal(moved[:2], before.poses[:2])


def test_final_uses_the_calibration_of_the_track():
    """A scale of 10 % between two states that are 1.1 m apart where odometry says 1 m: nothing is
    left to correct, wherever the motion was."""
    track = odometry_track([0, 1, 2], [[0, 0, 0], [0.7, 0, 0], [1.0, 0, 0]])
    track.calibration = replace(track.calibration, mean=np.array([0.1, 0.0, 0.0]))
    ends = Trajectory(ns([0, 2]), np.array([[0, 0, 0], [1.1, 0, 0]]), np.zeros((2, 3, 3)))
    found = at([0, 0.5, 1, 1.5, 2], causal=False, given=ends, track=track).poses
    np.testing.assert_allclose(found[:, 0], [0, 0.385, 0.77, 0.935, 1.1], atol=1e-12)


def test_causal_is_the_last_state_carried_on_by_odometry():
    """No correction before the state that brings it."""
    for t, last in ((2.9, 0), (3.5, 1), (6.0, 2), (10.9, 3), (11.9, 4)):
        expected = compose(STATES.poses[last], between(curve(STATES_S[last]), curve(t)))
        assert_same_pose(at([t], causal=True).poses[0], expected)


def coarse(start_s, end_s, track=TRACK):
    """One interval as `Track.coarse_motions` has it: motion (3,) and covariance (3, 3)."""
    times = ns([start_s, end_s])
    delta, cov = track.coarse_motions(times[:1], times[1:], [track.calibration], np.array([0]))
    return delta[0], cov[0]


def test_causal_covariance_is_the_system_update():
    """P = F P Fᵀ + W Q Wᵀ with the odometry's own noise from the last state to the time
    (4.4-4.7)."""
    for t, last in ((2.0, 0), (6.999, 2), (11.9, 4)):
        delta, Q = coarse(STATES_S[last], t)
        expected = compose_cov(STATES.poses[last], STATES.covs[last], delta, Q)
        np.testing.assert_allclose(at([t], causal=True).covs[0], expected, atol=1e-15)


@pytest.mark.parametrize("path_m", [0.25, 0.4])
def test_an_interval_taken_as_one_increment_is_as_uncertain_as_the_chain(path_m):
    """Between keyframes (0.25 m) the sigma of no direction is off by more than 4 %: one increment
    leaves out how an early error of the heading moves the end."""
    end_s = 2.0 + path_m / TWIST[0]
    motion = TRACK.motion(*ns([2.0, end_s]))
    delta, cov = coarse(2.0, end_s)
    assert_same_pose(delta, motion.delta)
    ratios = eigh(cov, motion.cov, eigvals_only=True)
    assert ratios.min() > 0.96**2 and ratios.max() < 1.04**2


def test_final_arrives_at_the_next_state():
    """A microsecond before it, the whole disagreement has been made up: no jump, in pose and in
    covariance. Tolerance: 1e-6 of the motion between the states."""
    before = at([t - 1e-6 for t in STATES_S[1:]], causal=False)
    assert_same_pose(before.poses, STATES.poses[1:], atol=1e-5)
    np.testing.assert_allclose(before.covs, STATES.covs[1:], atol=1e-6)


def test_correction_is_spread_in_proportion_to_the_motion():
    """Odometry says 4 m straight, in the first second 1 m; the next state lies 0.4 m to the side.
    Each metre gets 0.1 m of it, whatever time it took."""
    track = odometry_track([0, 1, 2, 3], [[0, 0, 0], [1, 0, 0], [2, 0, 0], [4, 0, 0]])
    ends = Trajectory(ns([0, 3]), np.array([[0, 0, 0], [4, 0.4, 0.0]]), np.zeros((2, 3, 3)))
    found = at([0, 0.5, 1, 2, 2.5, 3], causal=False, given=ends, track=track).poses
    np.testing.assert_allclose(found[:, 0], [0, 0.5, 1, 2, 3, 4], atol=1e-12)
    np.testing.assert_allclose(found[:, 1], [0, 0.05, 0.1, 0.2, 0.3, 0.4], atol=1e-12)


def test_no_correction_happens_while_the_robot_stands():
    """It waits for the motion: a standing robot's map must not drift."""
    track = odometry_track([0, 5, 10], [[0, 0, 0], [0, 0, 0], [2, 0, 0]])
    ends = Trajectory(ns([0, 10]), np.array([[0, 0, 0], [2, 0.2, 0]]), np.zeros((2, 3, 3)))
    found = at([1, 2, 4.9, 7.5], causal=False, given=ends, track=track).poses
    np.testing.assert_array_equal(found[:3], 0)
    np.testing.assert_allclose(found[3], [1.0, 0.1, 0.0], atol=1e-12)


def test_a_late_robot_is_corrected_when_its_sensor_sees_it_drive():
    """By its odometry it drives from 2 to 3 s and stands else; its sensor, 0.4 s late, sees that
    from 2.4 to 3.4 s. Before and after, the poses are those of the states, and halfway half of the
    correction is done. By the odometry's times it would begin while the robot stands. 1e-9: stamps
    are whole nanoseconds, a few roundings."""
    times = [0, 2, 3, 8]
    track = odometry_track(times, [[0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 0, 0]], mounted=True)
    track.calibration = replace(track.calibration, mean=np.array([0, 0, 0, 0, 0, 0, 0.4]))
    ends = Trajectory(ns([1, 6]), np.array([[0, 0, 0], [1.1, 0, 0]]), np.zeros((2, 3, 3)))
    found = at([2.35, 2.9, 3.4, 5.0], causal=False, given=ends, track=track)
    expected = [[0, 0, 0], [0.55, 0, 0], [1.1, 0, 0], [1.1, 0, 0]]
    assert_same_pose(found.poses, np.array(expected), atol=1e-9)


def test_where_a_robot_slipped_between_states_is_not_known():
    """By odometry it drove 2 m, by the states 1 m: the metre was lost anywhere between them. As
    noise, which adds up bit by bit, half way 1 cm would be left of it."""
    track = odometry_track([0, 1, 2], [[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    ends = Trajectory(ns([0, 2]), np.array([[0, 0, 0], [1.0, 0, 0]]), np.zeros((2, 3, 3)))
    found = at([0, 1, 1.5, 2], causal=False, given=ends, track=track)
    np.testing.assert_allclose(found.poses[:, 0], [0, 0.5, 0.75, 1], atol=1e-12)
    sigma = np.sqrt(found.covs[:, 0, 0])
    np.testing.assert_allclose(sigma, [0, 0.5, np.sqrt(3 / 16), 0], atol=5e-3)  # and that noise


def test_a_motion_that_odometry_did_not_see_at_all_may_have_been_at_any_time():
    """Frozen odometry: by its own shares the robot would stand where it froze, and then jump."""
    track = odometry_track([0, 8, 10], [[0, 0, 0], [0, 0, 0], [0.1, 0, 0]])
    ends = Trajectory(ns([0, 10]), np.array([[0, 0, 0], [2, 0, 0]]), np.zeros((2, 3, 3)))
    found = at([2, 4, 8], causal=False, given=ends, track=track).poses
    np.testing.assert_allclose(found[:, 0], [0.38, 0.76, 1.52], atol=1e-12)


def test_turning_on_the_spot_takes_its_share_of_the_correction():
    """Odometry errors grow with turning, too; by path alone this interval would have none."""
    track = odometry_track([0, 1, 2], [[0, 0, 0], [0, 0, 1.0], [0, 0, 2.0]])
    ends = Trajectory(ns([0, 2]), np.array([[0, 0, 0], [0, 0, 2.2]]), np.zeros((2, 3, 3)))
    found = at([0.5, 1, 1.5], causal=False, given=ends, track=track).poses
    np.testing.assert_allclose(found[:, 2], [0.55, 1.1, 1.65], atol=1e-12)


def test_final_covariance_is_that_of_a_bridge_by_hand():
    """Half way along a straight interval with a known heading: half of either end's variance and a
    quarter of the odometry's, which is less than it was before the next state was known."""
    track = odometry_track([0, 1, 2], [[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    covs = np.array([np.diag([4e-4, 4e-4, 0]), np.diag([1e-4, 9e-4, 0])])
    ends = Trajectory(ns([0, 2]), np.array([[0, 0, 0], [2.0, 0, 0]]), covs)
    _, Q = coarse(0, 2, track)
    final = at([1], causal=False, given=ends, track=track).covs[0]
    np.testing.assert_allclose(final, 0.5 * covs[0] + 0.5 * covs[1] + 0.25 * Q, atol=1e-15)


def test_between_two_states_a_scan_is_as_uncertain_as_the_odometry_bridge():
    """What is left of odometry's error with both ends known, s (1 - s) of the whole interval's, as
    an error of the sensor's pose in its own frame: turned to the robot's axes there, and with the
    lever arm to the sensor, here by finite differences. Not more than a quarter, nothing at the
    states."""
    times, rng = [3.0, 5.0, 6.2, 7.0], np.random.default_rng(2)
    mounts = rng.normal(0, 0.5, size=(4, 3))
    final, ties = final_scans(STATES, TRACK, ns(times), ns(times), mounts)
    assert_same_pose(final.poses, at(times, causal=False).poses, atol=0)
    assert ties.state.tolist() == [1, 2, 2, 3]
    np.testing.assert_allclose(ties.share, [0.0, 1 / 3, 2.2 / 3, 0.0], atol=1e-9)
    for k in (1, 2):
        s, start = ties.share[k], STATES.poses[ties.state[k]]
        _, Q = coarse(4.0, 7.0)
        own = rotate_cov(s * (1 - s) * Q, start[2] - final.poses[k, 2])

        def of_sensor(e, mount=mounts[k]):
            return log(compose(compose(inverse(mount), exp(e)), mount))

        J = jacobian(of_sensor, np.zeros(3))
        np.testing.assert_allclose(ties.covs[k], J @ own @ J.T, rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(ties.covs[[0]], 0.0)


def test_a_scan_that_is_known_better_lies_where_it_was_found():
    """Its own error replaces that of odometry, which is told with the poses; other scans stay."""
    times, mounts = [5.0, 6.2, 11.8], np.array([[0.3, 0.1, 0.2]] * 3)
    plain, ties = final_scans(STATES, TRACK, ns(times), ns(times), mounts)
    covs = np.diag([1e-4, 4e-4, 1e-6]) + np.zeros((2, 3, 3))
    offsets = np.array([[0.01, -0.02, 0.03], [0.05, 0.0, -0.1]])
    asked = []

    def better(times_ns, poses, noise, covs=covs):
        asked.append((times_ns, poses.copy(), noise.copy()))
        return np.array([1, 2]), compose(poses[1:], offsets), covs, 4.0 * noise[1:]

    final, known = final_scans(STATES, TRACK, ns(times), ns(times), mounts, better)
    ((when, poses, noise),) = asked
    assert when.tolist() == ns(times).tolist()
    np.testing.assert_array_equal(poses, plain.poses)
    J = adjoint(inverse(mounts[0]))
    np.testing.assert_allclose(J @ noise @ J.mT, ties.covs, rtol=1e-9, atol=1e-18)
    np.testing.assert_array_equal(final.poses[0], plain.poses[0])
    np.testing.assert_array_equal(known.covs[0], ties.covs[0])
    np.testing.assert_allclose(known.odometry_covs[1:], 4.0 * ties.covs[1:], rtol=1e-9, atol=1e-18)
    np.testing.assert_array_equal(ties.odometry_covs, ties.covs)
    assert_same_pose(final.poses[1:], compose(plain.poses[1:], offsets), atol=1e-12)
    np.testing.assert_allclose(known.covs[1:], J @ covs @ J.mT, rtol=1e-9)
    exact, _ = final_scans(
        STATES, TRACK, ns(times), ns(times), mounts, partial(better, covs=0.0 * covs)
    )
    own = rotate_cov(covs, final.poses[1:, 2])  # world axes
    np.testing.assert_allclose(final.covs[1:] - own, exact.covs[1:], rtol=1e-9, atol=1e-15)


def test_after_the_last_state_a_scan_is_as_uncertain_as_the_odometry_since():
    final, ties = final_scans(STATES, TRACK, ns([11.8]), ns([11.8]), np.zeros((1, 3)))
    _, Q = coarse(11.0, 11.8)
    own = rotate_cov(Q, STATES.poses[-1, 2] - final.poses[0, 2])
    np.testing.assert_allclose(ties.covs[0], own, rtol=1e-9, atol=1e-15)
    assert ties.share[0] == 0.0


def test_after_the_last_state_final_and_causal_are_one_thing():
    """Nothing is known that would tell them apart; covariances grow on from the last state's."""
    times = [11.2, 11.6, 12.0]
    final, causal = at(times, causal=False), at(times, causal=True)
    np.testing.assert_allclose(final.poses, causal.poses, atol=1e-14)
    traces = np.trace(final.covs[:, :2, :2], axis1=1, axis2=2)
    assert np.all(np.diff(traces) > 0) and traces[0] > np.trace(STATES.covs[-1][:2, :2])


@pytest.mark.parametrize("causal", [True, False])
def test_before_the_first_state_odometry_runs_backwards(causal):
    """Scans between a robot's first odometry and its first state keep their place."""
    found = at([0.3], causal=causal).poses[0]
    expected = compose(STATES.poses[0], between(curve(1.0), curve(0.3)))
    assert_same_pose(found, expected)


@pytest.mark.parametrize("causal", [True, False])
def test_one_state_is_enough(causal):
    """A robot that never moved enough for a second keyframe."""
    one = Trajectory(STATES.stamps_ns[:1], STATES.poses[:1], STATES.covs[:1])
    found = at([0.5, 1.0, 2.0], causal=causal, given=one)
    assert_same_pose(found.poses[1], STATES.poses[0], atol=1e-14)
    assert_same_pose(found.poses[2], compose(STATES.poses[0], between(curve(1), curve(2))))
    assert np.isfinite(found.covs).all()


@pytest.mark.parametrize("causal", [True, False])
def test_states_rigid_to_a_laser_follow_the_lasers_path(causal):
    """A track that learned where the laser sits and how late its stamps are: between states that
    are the laser's true poses, the trajectory is the laser's true path. Base and laser mixed up, or
    the latency's sign, are centimetres off."""
    track = odometry_track(READINGS, [curve(t) for t in READINGS], mounted=True)
    mean = np.zeros(len(track.calibration.mean))
    mount, late_s = np.array([0.3, -0.1, 0.2]), 0.08
    mean[-4:] = [*mount, late_s]
    track.calibration = replace(track.calibration, mean=mean)
    times = np.array([1.0, 3.0, 4.5, 8.0])
    laser = np.array([compose(curve(t - late_s), mount) for t in times])
    given = Trajectory(ns(times), laser, np.broadcast_to(1e-4 * np.eye(3), (4, 3, 3)))
    between_times = [1.5, 2.2, 3.3, 6.0, 7.9]
    expected = np.array([compose(curve(t - late_s), mount) for t in between_times])
    assert_same_pose(at(between_times, causal=causal, given=given, track=track).poses, expected)


def test_mounted_is_composition_with_covariance():
    """Every pose has its own mount (a log may carry several lasers); rigid, so nothing is added."""
    rng = np.random.default_rng(6)
    mounts = rng.normal(0, 0.4, size=(len(STATES), 3))
    found = trajectory_of_mount(STATES, mounts)
    for n in range(len(STATES)):
        expected = compose(STATES.poses[n], mounts[n])
        cov = compose_cov(STATES.poses[n], STATES.covs[n], mounts[n], np.zeros((3, 3)))
        assert_same_pose(found.poses[n], expected)
        np.testing.assert_allclose(found.covs[n], cov, atol=1e-16)
    np.testing.assert_array_equal(found.stamps_ns, STATES.stamps_ns)


def test_transform_trajectory_is_composition_from_the_left_with_covariance():
    """Per pose or for all of them; the covariance turns with the axes and gains nothing."""
    rng = np.random.default_rng(8)
    worlds = rng.normal(0, 2.0, size=(len(STATES), 3))
    found = transform_trajectory(STATES, worlds)
    for n, world in enumerate(worlds):
        cov = compose_cov(world, np.zeros((3, 3)), STATES.poses[n], STATES.covs[n])
        assert_same_pose(found.poses[n], compose(world, STATES.poses[n]))
        np.testing.assert_allclose(found.covs[n], cov, atol=1e-16)
    once = transform_trajectory(STATES, worlds[0])
    assert_same_pose(once.poses[0], found.poses[0], atol=0)
    assert_same_pose(
        between(once.poses[0], once.poses[1:]), between(STATES.poses[0], STATES.poses[1:])
    )


def test_origin_shift_brings_the_base_to_the_start():
    """The prior put the first *laser* state there; nominal mounts shift nothing."""
    start, mounts = (
        np.array([2.0, -1.0, 0.7]),
        np.array([[0.3, -0.1, 0.2], [0, 0, 0], [0.1, 0, 3.0]]),
    )
    world = origin_shift(start, mounts)
    for shift, mount in zip(world, mounts, strict=True):
        base = compose(compose(shift, start), inverse(mount))
        assert_same_pose(base, start, atol=1e-14)
    assert_same_pose(world[1], np.zeros(3), atol=1e-15)
    assert_same_pose(origin_shift(start, mounts[0]), world[0], atol=0)


def test_a_new_world_frame_moves_states_landmarks_and_starts_alike():
    """Each robot's and each landmark's by its own frame: as poses composed from the left, points as
    poses without a heading, covariances turned with the axes. A landmark taken for the other kind,
    or the frame of another, breaks it."""
    rng = np.random.default_rng(5)
    worlds = rng.normal(0, 2.0, size=(4, 3))
    frames = FrameTransforms({"a": worlds[0], "b": worlds[1]}, {7: worlds[2], 9: worlds[3]})
    point, line = rng.normal(size=2), rng.normal(size=3)
    cov = 0.1 * np.eye(3) + 0.05
    before = Estimate({"a": STATES, "b": STATES}, {7: (point, cov[:2, :2]), 9: (line, cov)}, 0.0, 0)
    found = frames.estimate(before)
    for robot, world in (("a", worlds[0]), ("b", worlds[1])):
        expected = transform_trajectory(STATES, world)
        np.testing.assert_array_equal(found.states[robot].poses, expected.poses)
        np.testing.assert_array_equal(found.states[robot].covs, expected.covs)
    moved, moved_cov = found.landmarks[7]
    np.testing.assert_allclose(moved, compose(worlds[2], np.append(point, 0.0))[:2], atol=1e-14)
    np.testing.assert_allclose(moved_cov, rotate_cov(cov, worlds[2][2])[:2, :2], atol=1e-15)
    moved, moved_cov = found.landmarks[9]
    assert_same_pose(moved, compose(worlds[3], line))
    np.testing.assert_allclose(moved_cov, rotate_cov(cov, worlds[3][2]), atol=1e-15)

    step = frames.step(Step(5, starts={"b": Start(line, cov)}))
    assert_same_pose(step.starts["b"].pose, compose(worlds[1], line))
    np.testing.assert_allclose(step.starts["b"].cov, rotate_cov(cov, worlds[1][2]), atol=1e-15)
    assert step.time_ns == 5


def test_what_a_mount_shares_with_states_and_landmarks_turns_with_their_axes():
    """Its own covariance is along the base's axes and stays. Covariances of states with it have
    the states' axes on the left alone."""
    rng = np.random.default_rng(3)
    world = np.array([4.0, -1.0, 2.1])
    states, point, line = (rng.normal(size=size) for size in ((5, 3, 3), (2, 3), (3, 3)))
    known = MountCovariances(("a",), 0.1 * np.eye(3), {"a": states}, {7: point, 9: line})
    found = FrameTransforms({"a": world}, {7: world, 9: world}).estimate(
        Estimate({"a": STATES}, {}, 0.0, 0, mounts=known)
    )
    c, s = np.cos(2.1), np.sin(2.1)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(found.mounts.cov, known.cov)
    np.testing.assert_allclose(found.mounts.states["a"], R @ states, atol=1e-15)
    np.testing.assert_allclose(found.mounts.landmarks[7], R[:2, :2] @ point, atol=1e-15)
    np.testing.assert_allclose(found.mounts.landmarks[9], R @ line, atol=1e-15)


# ------------------------------------------------------------ what stamps mean


@pytest.mark.parametrize("late_s", [0.1, -0.1, 0.0])
def test_a_base_is_as_uncertain_along_its_way_as_its_sensor_may_be_late(late_s):
    """Half the square of the latency times speed and turning: either of two sensors may be late."""
    track = odometry_track(READINGS, [curve(t) for t in READINGS], mounted=True)
    late = track.calibration.mean.copy()
    late[-1] = late_s
    track.calibration = replace(track.calibration, mean=late)
    times = np.array([2 * SECOND, 5 * SECOND])
    known = np.tile(1e-6 * np.eye(3), (2, 1, 1))
    base = Trajectory(times, np.array([[0, 0, 0], [3.0, 1.0, np.pi / 2]]), known)
    found = with_stamp_errors(base, track, times)
    moved = np.array([TWIST, [-TWIST[1], TWIST[0], TWIST[2]]]) * late_s
    expected = known + moved[:, :, None] * moved[:, None, :] / 2
    np.testing.assert_allclose(found.covs, expected, atol=1e-9)
    np.testing.assert_array_equal(found.poses, base.poses)
