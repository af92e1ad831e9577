"""Calibration learned from the motions that the estimate found: recursive least squares."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.geometry import between, compose, exp
from graphslam.core.motion_models import Calibration, wheel_twist
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, OdometryIncrement, OdometryPose, WheelAngles
from graphslam.odometry.calibration_jacobian import CalibratedSource, at_estimated_motion
from graphslam.odometry.online_calibration import (
    FORGETTING_FACTOR,
    MIN_SIGMA_SHARE,
    OUTLIER_D2,
    CalibrationEvidence,
    Calibrator,
    TrackedMotions,
    learnt_from_evidence,
    observed_information,
)
from graphslam.odometry.online_noise import noisier
from graphslam.odometry.preintegration import Track

SECOND = 1_000_000_000
PERIOD_NS = 50_000_000  # of odometry
STATE_NS = 500_000_000
#: what is wrong with the robot: scales, drift rad/m; where the laser sits, how late it is
SCALES = {"translation_scale": 0.03, "rotation_scale": -0.04, "drift_rad_per_m": 0.02}
LASER = {"laser_x_m": 0.08, "laser_y_m": -0.06, "laser_yaw_rad": 0.02, "laser_latency_s": 0.04}
NOTHING = dict.fromkeys(SCALES, 0.0)
CENTRED = dict.fromkeys(LASER, 0.0)
#: what an estimated motion is off by in itself
FLOOR = [OdometryConfig().calibration_floor_m] * 2 + [OdometryConfig().calibration_floor_rad]
#: information from landmarks that show a motion as well as `FLOOR` lets them
PLENTY = 1e12 * np.eye(3)
#: sigmas of the prior, from the settings
PRIOR = {
    "translation_scale": OdometryConfig().translation_scale_sigma,
    "rotation_scale": OdometryConfig().rotation_scale_sigma,
    "drift_rad_per_m": OdometryConfig().drift_sigma_rad_per_m,
    "laser_x_m": OdometryConfig().laser_sigma_m,
    "laser_y_m": OdometryConfig().laser_sigma_m,
    "laser_yaw_rad": OdometryConfig().laser_sigma_rad,
    "laser_latency_s": OdometryConfig().laser_latency_sigma_s,
}


def weaving(n, rng):
    """Odometry twists (n, 3) of a robot that speeds up, slows down and turns both ways."""
    t = np.arange(n) * PERIOD_NS / SECOND
    speed = 0.5 + 0.3 * np.sin(0.9 * t + rng.uniform(0, 6))
    turning = 0.5 * np.sin(0.37 * t + rng.uniform(0, 6)) + 0.2 * np.sin(1.7 * t)
    return np.column_stack([speed, 0 * t, turning]) * PERIOD_NS / SECOND


def straight(n):
    return np.tile([0.5 * PERIOD_NS / SECOND, 0.0, 0.0], (n, 1))


def chain(twists):
    poses = [np.zeros(3)]
    for twist in twists:
        poses.append(compose(poses[-1], exp(twist)))
    return np.array(poses)


class Drive:
    """A robot whose odometry says ``twists``, and the true motions of its laser between states."""

    def __init__(self, twists, scales=SCALES, laser=LASER, *, mounted=True, rng=None):
        scale, turn_scale, drift = scales.values()
        true = twists * [1 + scale, 1 + scale, 1 + turn_scale]
        true[:, 2] += drift * twists[:, 0]
        self.rng = rng
        self.track = Track(OdometryConfig(), RobotConfig(), mounted=mounted)
        self._truth = Track(OdometryConfig(), RobotConfig())
        said, real = chain(twists), chain(true)
        for k in range(len(said)):
            ns = k * PERIOD_NS
            self.track.add(OdometryPose("r", ns, ns, said[k]))
            self._truth.add(OdometryPose("r", ns, ns, real[k]))
        *mount, late = laser.values()
        self._mount, self._late_ns = np.array(mount), round(late * SECOND)
        self.states = np.arange(SECOND, len(twists) * PERIOD_NS - SECOND, STATE_NS)
        self.calibrator = Calibrator(OdometryConfig())

    def moved(self, start_ns, end_ns):
        """True motion of the laser, as landmarks show it: noise `FLOOR` if any."""
        times = np.array([start_ns, end_ns]) - self._late_ns
        start, end = compose(self._truth.pose(times), self._mount)
        noise = 0.0 if self.rng is None else self.rng.normal(0, FLOOR)
        return between(start, end) + noise

    def learn(self):
        for start, end in zip(self.states[:-1], self.states[1:], strict=True):
            motion = self.track.motion(int(start), int(end))
            moved = self.moved(start, end)
            source = CalibratedSource.of(self.track)
            self.track.calibration = self.calibrator.update(source, motion, moved, PLENTY)
        return self.calibrator.summary()


def test_known_errors_are_found_from_perfect_motions():
    """Scale, drift, mount and latency at once, to 0.3 of the sigma found: the prior takes its share
    of the value, (sigma / prior)², and the latency is a one-sided difference over 50 ms."""
    found = Drive(weaving(6000, np.random.default_rng(0))).learn()
    for name, value in (SCALES | LASER).items():
        estimate, sigma, observable = found[name]
        assert estimate == pytest.approx(value, abs=0.3 * sigma), name
        assert observable and sigma < 0.3 * PRIOR[name], name


def test_what_is_found_lies_within_its_sigmas():
    """Over 8 runs with noise, truth drawn from the prior: squared errors over variances average to
    no more than the upper 99.9 % bound of chi-square. (Only the upper one: a filter that forgets
    claims a little more than the scatter that it has, by up to a half.)"""
    total, n = np.zeros(len(PRIOR)), 8
    for seed in range(n):
        rng = np.random.default_rng(seed)
        drawn = {name: rng.normal(0, sigma) for name, sigma in PRIOR.items()}
        scales = {name: drawn[name] for name in SCALES}
        laser = {name: drawn[name] for name in LASER}
        found = Drive(weaving(2500, rng), scales, laser, rng=rng).learn()
        total += [((found[name][0] - drawn[name]) / found[name][1]) ** 2 for name in PRIOR]
    assert np.all(total / n < chi2.ppf(0.999, n) / n), dict(zip(PRIOR, total / n, strict=True))
    assert np.all(total / n > 0.1)  # nor are the sigmas so wide that they say nothing


def derivative_at_likeliest(source, motion, moved):
    """Where odometry, by its covariance, and the estimate, by `FLOOR`, together put the motion."""
    share = motion.cov @ np.linalg.inv(motion.cov + np.diag(np.square(FLOOR)))
    likeliest = motion.delta + share @ (moved - motion.delta)
    delta, d_cal = motion.delta[None], motion.d_delta_d_calibration[None]
    return at_estimated_motion(source, delta, d_cal, likeliest[None])[0]


def test_one_step_is_the_information_filter_by_hand():
    """Prior and motion, each by its own covariance: the motion's without its calibration part,
    which is what is being learned, plus what the estimate of a motion is off by."""
    drive = Drive(weaving(100, np.random.default_rng(1)), mounted=False)
    prior, motion = drive.track.calibration, drive.track.motion(SECOND, 3 * SECOND)
    moved = motion.delta + np.array([0.01, 0.005, -0.005])
    source = CalibratedSource.of(drive.track)
    after = drive.calibrator.update(source, motion, moved, PLENTY)
    D = motion.d_delta_d_calibration
    noise = motion.cov - D @ prior.cov @ D.T + np.diag(np.square(FLOOR))
    D = derivative_at_likeliest(source, motion, moved)
    info = np.linalg.inv(prior.cov) + D.T @ np.linalg.solve(noise, D)
    expected = np.linalg.solve(info, D.T @ np.linalg.solve(noise, moved - motion.delta))
    np.testing.assert_allclose(after.mean, expected, rtol=1e-7)
    found = [sigma for _, sigma, _ in drive.calibrator.summary().values()]
    np.testing.assert_allclose(found, np.sqrt(np.diag(np.linalg.inv(info))), rtol=1e-7)


def test_going_on_from_a_joint_estimate_is_the_information_filter_by_hand():
    """What was learned before is replaced by the estimate of all states so far: the next motion
    adds to its information, of which `FORGETTING_FACTOR` and the prior's share remain."""
    # without errors, so that odometry is as noisy as stated
    drive = Drive(weaving(1000, np.random.default_rng(1)), NOTHING, CENTRED, mounted=False)
    prior = drive.track.prior
    drive.learn()
    found = Calibration(prior.names, np.full(3, 0.01), 0.09 * prior.cov)
    used = drive.calibrator.restart(prior, found)
    np.testing.assert_array_equal(used.mean, found.mean)
    np.testing.assert_allclose(used.cov, (0.09 + MIN_SIGMA_SHARE**2) * prior.cov, rtol=1e-12)
    drive.track.calibration = used
    motion = drive.track.motion(SECOND, 3 * SECOND)
    miss, source = np.array([0.002, 0.001, -0.001]), CalibratedSource.of(drive.track)
    after = drive.calibrator.update(source, motion, motion.delta + miss, PLENTY)
    D = motion.d_delta_d_calibration
    noise = motion.cov - D @ used.cov @ D.T + np.diag(np.square(FLOOR))
    D = derivative_at_likeliest(source, motion, motion.delta + miss)
    past, known = FORGETTING_FACTOR, np.linalg.inv(found.cov)
    info = past * known + (1 - past) * np.linalg.inv(prior.cov) + D.T @ np.linalg.solve(noise, D)
    vector = past * known @ found.mean + D.T @ np.linalg.solve(noise, miss + D @ found.mean)
    np.testing.assert_allclose(after.mean, np.linalg.solve(info, vector), rtol=1e-7)


def test_wheels_of_unequal_size_are_found():
    """Tyres 4 mm and 2 mm larger than configured, the axle 1 cm longer: within three sigmas, and
    the difference of the radii, which bends the path, to 0.3 mm (0.01 rad over 0.25 m and 200
    states, times the axle)."""
    rng = np.random.default_rng(3)
    config = OdometryConfig(wheel_radius_sigma_m=3e-3, axle_sigma_m=0.02)
    nominal = RobotConfig()
    real = replace(nominal, wheel_radius_left_m=0.104, wheel_radius_right_m=0.102, axle_m=0.51)
    n = 4000
    t = np.arange(n) * 0.05
    steps = np.column_stack([5 + 2 * np.sin(0.6 * t), 5 + 2 * np.cos(0.45 * t)]) * 0.05
    track = Track(config, nominal)
    for k, (left, right) in enumerate(np.cumsum(np.vstack([[0, 0], steps]), axis=0)):
        track.add(WheelAngles("r", k * PERIOD_NS, k * PERIOD_NS, left, right))
    true = chain(wheel_twist(steps, real))
    calibrator = Calibrator(OdometryConfig())
    for k in range(0, n, 10):
        motion = track.motion(k * PERIOD_NS, (k + 10) * PERIOD_NS)
        moved = between(true[k], true[k + 10]) + rng.normal(0, FLOOR)
        source = CalibratedSource.of(track)
        track.calibration = calibrator.update(source, motion, moved, PLENTY)
    found = calibrator.summary()
    errors = {"wheel_radius_left_m": 4e-3, "wheel_radius_right_m": 2e-3, "axle_m": 0.01}
    assert set(found) == set(errors)
    for name, value in errors.items():
        assert abs(found[name][0] - value) < 3 * found[name][1], name
    left, right = (found[f"wheel_radius_{side}_m"][0] for side in ("left", "right"))
    assert left - right == pytest.approx(2e-3, abs=3e-4)


@pytest.mark.parametrize("jump", [[1.0, 0, 0], [0, -0.5, 0], [0, 0, 0.3], [0, 0, 2 * np.pi - 0.3]])
def test_a_jump_of_the_estimate_teaches_nothing(jump):
    """A loop closure moves the new state by a metre: no motion of the robot. The calibration stays
    the very object that it was, and later learning goes on as if nothing had been."""
    drive = Drive(weaving(1000, np.random.default_rng(1)))
    before = drive.learn()
    motion = drive.track.motion(2 * SECOND, 2 * SECOND + STATE_NS)
    current, source = drive.track.calibration, CalibratedSource.of(drive.track)
    moved = drive.moved(2 * SECOND, 2 * SECOND + STATE_NS) + jump
    assert drive.calibrator.update(source, motion, moved, PLENTY) is current
    assert drive.calibrator.summary() == before


def test_the_gate_of_jumps_is_chi_square():
    """Three degrees of freedom, 99.9 %."""
    assert chi2.sf(OUTLIER_D2, 3) == pytest.approx(1e-3, rel=0.02)


def test_headings_are_compared_the_short_way_round():
    """A motion of pi - 0.01 that was estimated as -pi + 0.01 is off by 0.02 and no outlier."""
    track = Track(OdometryConfig(), RobotConfig())
    for k, phi in enumerate(np.linspace(0, np.pi - 0.01, 50)):
        track.add(OdometryPose("r", k * PERIOD_NS, k * PERIOD_NS, np.array([0, 0, phi])))
    motion = track.motion(0, 49 * PERIOD_NS)
    calibrator = Calibrator(OdometryConfig())
    source, moved = CalibratedSource.of(track), np.array([0, 0, -np.pi + 0.01])
    after = calibrator.update(source, motion, moved, PLENTY)
    assert 0 < after.mean[1] < 0.02 / np.pi


# ------------------------------------------------------------ what cannot be seen


def test_driving_straight_never_shows_where_the_laser_is():
    """Nor the scale of rotation, nor the latency at constant speed: they keep the prior, to the
    digit, and say so. Scale, drift and yaw do show."""
    drive = Drive(straight(2000), NOTHING, CENTRED)
    found = drive.learn()
    for name in ("laser_x_m", "laser_y_m", "rotation_scale", "laser_latency_s"):
        value, sigma, observable = found[name]
        assert value == pytest.approx(0.0, abs=1e-9) and not observable, name
        assert sigma == pytest.approx(PRIOR[name], rel=1e-9), name
    for name in ("translation_scale", "drift_rad_per_m", "laser_yaw_rad"):
        assert found[name][2], name


def test_turning_in_place_shows_the_lasers_place_and_not_its_yaw():
    drive = Drive(straight(2000) @ np.array([[0, 0, 1.0], [0] * 3, [0] * 3]), NOTHING, LASER)
    found = drive.learn()
    assert found["laser_x_m"][2] and found["laser_y_m"][2] and found["rotation_scale"][2]
    for name in ("laser_x_m", "laser_y_m"):
        assert abs(found[name][0] - LASER[name]) < found[name][1]
    # while the place is not known, what it does looks like a motion of the base by a millimetre
    for name in ("translation_scale", "drift_rad_per_m"):
        value, sigma, observable = found[name]
        assert value == pytest.approx(0.0, abs=1e-3 * sigma) and not observable, name
        assert sigma == pytest.approx(PRIOR[name], rel=1e-3), name


def test_what_was_learned_is_not_forgotten_below_the_prior():
    """After a stretch that shows the laser's place, a long one that does not: the value goes back
    to the prior with it, the sigma grows to the prior's and never beyond."""
    drive = Drive(weaving(2000, np.random.default_rng(5)), NOTHING, CENTRED)
    learned = drive.learn()["laser_x_m"][1]
    going_on = Drive(straight(8000), NOTHING, CENTRED)
    going_on.calibrator, going_on.track.calibration = drive.calibrator, drive.track.calibration
    sigma = going_on.learn()["laser_x_m"][1]
    prior = PRIOR["laser_x_m"]
    assert learned < 0.2 * prior and 0.5 * prior < sigma <= prior * (1 + 1e-9)


def test_tyres_may_warm_up():
    """The scale changes by 2 % half way: after 3 / (1 - FORGETTING_FACTOR) states 5 % of the old
    one is left, and the prior takes 4 %."""
    n = round(3 / (1 - FORGETTING_FACTOR)) * STATE_NS // PERIOD_NS + 100
    cold = Drive(weaving(n, np.random.default_rng(6)), NOTHING, CENTRED, mounted=False)
    cold.learn()
    warm_scales = NOTHING | {"translation_scale": 0.02}
    warm = Drive(weaving(n, np.random.default_rng(7)), warm_scales, CENTRED, mounted=False)
    warm.calibrator, warm.track.calibration = cold.calibrator, cold.track.calibration
    assert warm.learn()["translation_scale"][0] == pytest.approx(0.02, rel=0.12)


def test_coming_motions_stay_uncertain():
    """What is used for them is wider than what the data say, by a share of the prior: a constant is
    none, and the filter takes noise of neighbouring states for independent."""
    drive = Drive(weaving(3000, np.random.default_rng(2)))
    found = drive.learn()
    used = np.sqrt(np.diag(drive.track.calibration.cov))
    for sigma, (_, known, _), prior in zip(used, found.values(), PRIOR.values(), strict=True):
        assert sigma == pytest.approx(np.hypot(known, MIN_SIGMA_SHARE * prior), rel=1e-9)


# ------------------------------------------------------------ what landmarks show of a motion


def test_without_landmarks_nothing_is_learned():
    """The estimate is odometry then: agreement with itself is no evidence."""
    drive = Drive(weaving(100, np.random.default_rng(1)))
    current, motion = drive.track.calibration, drive.track.motion(SECOND, 3 * SECOND)
    source = CalibratedSource.of(drive.track)
    after = drive.calibrator.update(source, motion, motion.delta, np.zeros((3, 3)))
    np.testing.assert_array_equal(after.mean, current.mean)
    np.testing.assert_array_equal(after.cov, current.cov)


def test_a_corridor_does_not_show_the_scale_of_the_path():
    """Its walls give the offset across and the heading: along them the estimate is odometry."""
    drive = Drive(straight(200), mounted=False)
    walls = np.diag([0.0, 1e8, 1e8])
    for start, end in zip(drive.states[:-1], drive.states[1:], strict=True):
        motion = drive.track.motion(int(start), int(end))
        moved = drive.moved(start, end)
        moved[0] = motion.delta[0]
        source = CalibratedSource.of(drive.track)
        drive.track.calibration = drive.calibrator.update(source, motion, moved, walls)
    found = drive.calibrator.summary()
    assert found["translation_scale"][1] == pytest.approx(PRIOR["translation_scale"], rel=1e-4)
    assert found["drift_rad_per_m"][2] and not found["translation_scale"][2]


@pytest.mark.parametrize("heading_rad", [0.0, 0.7, -2.5])
def test_information_of_observations_lies_along_world_axes(heading_rad):
    """A post 4 m ahead in the world's x direction: range gives 1/sigma² along x, bearing that of
    4 m times its sigma across, whichever way the robot faces."""
    pose, post = np.array([1.0, 2.0, heading_rad]), np.array([5.0, 2.0])
    cov = np.diag([1e-4, 4e-4])
    seen = Association("r", 0, 0, "point", MODELS["point"].predict(pose, post), cov)
    info = observed_information([seen], {"r": pose}, [post])["r"]
    np.testing.assert_allclose(np.diag(info), [1 / 4e-4, 1 / (16 * 1e-4), 1 / 1e-4], rtol=1e-9)


def test_every_robot_is_informed_by_what_it_saw_itself():
    """Two robots at different places that saw one post, one of them twice, one robot that saw
    nothing."""
    poses = {"a": np.array([1.0, 2.0, 0.3]), "b": np.array([5.0, -1.0, 2.0]), "c": np.zeros(3)}
    post, cov = np.array([5.0, 2.0]), np.diag([1e-4, 4e-4])
    seen = [
        Association(r, 0, 0, "point", MODELS["point"].predict(poses[r], post), cov) for r in "aba"
    ]
    info = observed_information(seen, poses, [post] * 3)
    once = observed_information(seen[:1], {"a": poses["a"]}, [post])["a"]
    np.testing.assert_allclose(info["a"], 2 * once, rtol=1e-12)
    np.testing.assert_allclose(info["b"][1, 1], 1 / 4e-4, rtol=1e-9)  # it looks along y
    np.testing.assert_array_equal(info["c"], np.zeros((3, 3)))


# ------------------------------------------------------------ nothing to learn


def test_given_increments_are_left_alone():
    """They bring their own covariance and have no parameters; a mount changes nothing."""
    track = Track(OdometryConfig(), RobotConfig(), mounted=True)
    for k in range(20):
        start, end = k * SECOND, (k + 1) * SECOND
        step = np.array([0.5, 0, 0.1])
        track.add(OdometryIncrement("r", end, end, start, step, 1e-4 * np.eye(3)))
    calibrator, current = Calibrator(OdometryConfig()), track.calibration
    source = CalibratedSource.of(track)
    for k in range(20):
        motion = track.motion(k * SECOND, (k + 1) * SECOND)
        assert calibrator.update(source, motion, np.array([0.6, 0.05, 0.2]), PLENTY) is current
    assert calibrator.summary() == {}
    np.testing.assert_array_equal(track.mount, 0)


def test_a_robot_that_stands_teaches_nothing():
    """Whatever the estimate says: no parameter of odometry makes a standing robot move."""
    track = Track(OdometryConfig(), RobotConfig(), mounted=True)
    for k in range(100):
        track.add(OdometryPose("r", k * PERIOD_NS, k * PERIOD_NS, np.ones(3)))
    calibrator, current = Calibrator(OdometryConfig()), track.calibration
    source = CalibratedSource.of(track)
    for k in range(4):
        motion = track.motion(k * SECOND, (k + 1) * SECOND)
        assert calibrator.update(source, motion, np.array([0.01, 0.0, 0.005]), PLENTY) is current
    assert calibrator.summary() == {}


def calibrated(found, prior):
    nothing = CalibrationEvidence.none(len(prior.mean))
    known = nothing.with_motions(found, OdometryConfig())
    return learnt_from_evidence(known, prior).calibration


# ------------------------------------------------------------ all motions at once


def tracked_motions(drive, landmark_cov, rng, calibration=None):
    """Motions of a drive as tracked: means of odometry and of what landmarks show of each."""
    track = drive.track
    track.calibration = calibration or track.calibration
    starts, ends = drive.states[:-1], drive.states[1:]
    motions = [track.motion(int(a), int(b)) for a, b in zip(starts, ends, strict=True)]
    moved, covs = [], []
    for motion in motions:
        Q, R = motion.cov, np.diag(landmark_cov)
        z = drive.moved(motion.start_ns, motion.end_ns) + rng.normal(0, np.sqrt(landmark_cov))
        P = np.linalg.inv(np.linalg.inv(Q) + np.linalg.inv(R))
        moved.append(P @ (np.linalg.solve(Q, motion.delta) + np.linalg.solve(R, z)))
        covs.append(P)
    return TrackedMotions(
        np.array([m.delta for m in motions]),
        np.array([m.cov for m in motions]),
        np.array([m.d_delta_d_calibration for m in motions]),
        CalibratedSource.of(track),
        np.ones(3),
        np.array(moved),
        np.array(covs),
    )


def without_margin(known, prior):
    """Covariance of parameters by the data, see `MIN_SIGMA_SHARE`."""
    return known.cov - MIN_SIGMA_SHARE**2 * prior.cov


#: landmarks that show a motion to 2 cm and 0.01 rad: no better than odometry of half a second
POOR = np.square([0.02, 0.02, 0.01])


@pytest.mark.parametrize("landmark_cov", [POOR, 1e-4 * POOR])
def test_scale_errors_are_found_from_tracked_motions_to_their_sigmas(landmark_cov):
    """Also where landmarks are poor and tracked motions follow odometry most of the way: its share
    in them is taken out. Taken as independent measurements, they would show half the error."""
    total, n = np.zeros(len(SCALES)), 12
    for seed in range(n):
        rng = np.random.default_rng(seed)
        drawn = {name: rng.normal(0, PRIOR[name]) for name in SCALES}
        drive = Drive(weaving(2500, rng), drawn, CENTRED, mounted=False, rng=rng)
        prior = drive.track.calibration
        found = calibrated(tracked_motions(drive, landmark_cov, rng), prior)
        cov = without_margin(found, prior)
        assert np.all(np.sqrt(np.diag(cov)) < 0.5 * np.sqrt(np.diag(prior.cov)))
        total += np.square(found.mean - list(drawn.values())) / np.diag(cov)
    assert np.all(total / n < chi2.ppf(0.9999, n) / n), total / n


def test_what_is_found_does_not_depend_on_the_calibration_that_motions_had():
    """Evidence from motions by a calibration that is right already says the same as from motions
    without any, to 0.4 sigma: derivatives at the estimated motion are too large by the error of the
    scale there, 0.04 of 0.04, and a sigma is 0.0045."""
    prior, found = None, []
    for known in (0.0, 1.0):
        rng = np.random.default_rng(4)
        drive = Drive(weaving(2500, rng), SCALES, CENTRED, mounted=False)
        prior = drive.track.calibration
        used = replace(prior, mean=known * np.array(list(SCALES.values())))
        found.append(calibrated(tracked_motions(drive, 1e-2 * POOR, rng, used), prior))
    sigmas = np.sqrt(np.diag(without_margin(found[0], prior)))
    assert np.all(np.abs(found[0].mean - found[1].mean) < 0.4 * sigmas)


def test_without_landmarks_and_without_motions_the_prior_stays():
    """Tracked motions that are those of odometry tell nothing."""
    drive = Drive(weaving(300, np.random.default_rng(0)), mounted=False)
    prior = drive.track.calibration
    nothing = tracked_motions(drive, 1e12 * POOR, np.random.default_rng(0))
    np.testing.assert_allclose(calibrated(nothing, prior).mean, prior.mean, atol=1e-6)


def test_a_slipping_motion_does_not_count():
    """A wheel that spins for half a metre would show as 5 % of scale."""
    rng = np.random.default_rng(6)
    drive = Drive(weaving(1000, rng), SCALES, CENTRED, mounted=False)
    found = tracked_motions(drive, 1e-2 * POOR, rng)
    found.moved[7, 0] -= 0.5
    other = np.delete(np.arange(len(found.moved)), 7)
    clean = TrackedMotions(
        found.delta[other], found.cov[other], found.d_cal[other], found.source, np.ones(3),
        found.moved[other], found.moved_cov[other],
    )  # fmt: skip
    prior = drive.track.calibration
    np.testing.assert_allclose(
        calibrated(found, prior).mean, calibrated(clean, prior).mean, rtol=0, atol=1e-12
    )


# ------------------------------------------------------------ odometry noisier than stated


def noisy(n, rng, times):
    """Twists of a robot that drives straight, and what odometry with noise says of them: that of
    its heading has ``times`` the variance that the settings state."""
    twists = straight(n)
    noise = np.sqrt(times * OdometryConfig().k_phi_m * twists[:, 0]) * rng.normal(size=n)
    return twists, twists + noise[:, None] * [0.0, 0.0, 1.0]


def driven(seed, times):
    """A drive as `noisy` says, without errors of calibration."""
    twists, said = noisy(1200, np.random.default_rng(seed), times)
    drive = Drive(said, NOTHING, CENTRED, mounted=False)
    truth = chain(twists)
    drive._truth = Track(OdometryConfig(), RobotConfig())
    for k, pose in enumerate(truth):
        drive._truth.add(OdometryPose("r", k * PERIOD_NS, k * PERIOD_NS, pose))
    return drive


#: landmarks that show a motion to 2 mm and 2 mrad
GOOD = np.square([0.002, 0.002, 0.002])


@pytest.mark.parametrize("seed", range(4))
def test_noise_of_a_straight_drive_is_no_scale_of_turning(seed):
    """Where nothing but noise turns the odometry a scale of -1 would explain all of it: of 27 times
    the stated variance, as wheels on carpet have, it was -0.4. The prior's sigma is 0.04, and
    nothing was seen of the scale, so it stays within one."""
    drive = driven(seed, 27.0)
    prior = drive.track.calibration
    found = calibrated(tracked_motions(drive, GOOD, np.random.default_rng(seed)), prior)
    assert abs(found.mean[1]) < PRIOR["rotation_scale"]


@pytest.mark.parametrize("times", [1.0, 9.0, 27.0])
def test_noise_of_odometry_is_measured(times):
    """That of a motion over half a second: the floor is once in it, and not noisier. 120 motions
    tell the variance to 13 %, three of its sigmas."""
    drive = driven(7, times)
    tracked = tracked_motions(drive, GOOD, np.random.default_rng(7))
    known = CalibrationEvidence.none(3).with_motions(tracked, OdometryConfig())
    stated = OdometryConfig().k_phi_m * 0.25
    expected = (times * stated + OdometryConfig().floor_sigma_rad ** 2) / (
        stated + OdometryConfig().floor_sigma_rad ** 2
    )
    assert known.noise.scale[2] == pytest.approx(max(expected, 1.0), rel=0.4)
    assert known.noise.scale[0] == 1.0  # along the path it is as stated or less


def test_a_drive_by_noise_that_was_learnt_measures_the_same_noise():
    """The scale is that of what is stated, whatever scale the motions had already. Tracked by other
    noise the same landmarks weigh differently, and other motions are near the gate: 10 %, where 120
    motions tell a variance to 13 %."""
    drive, found = driven(3, 27.0), []
    for scale in (np.ones(3), np.array([1.0, 1.0, 9.0])):
        made = tracked_motions(drive, GOOD, np.random.default_rng(3))
        shared = made.d_cal @ made.source.calibration.cov @ made.d_cal.mT
        white = np.sqrt(scale)[:, None] * (made.cov - shared) * np.sqrt(scale)
        made = replace(made, cov=white + shared, noise_scale=scale)
        # tracked anew: the same landmarks, other odometry
        seen = np.linalg.inv(np.diag(GOOD))
        z = (
            made.delta
            + (
                np.diag(GOOD)
                @ np.linalg.inv(made.moved_cov)
                @ (made.moved - made.delta)[:, :, None]
            )[:, :, 0]
        )
        P = np.linalg.inv(np.linalg.inv(made.cov) + seen)
        moved = made.delta + (P @ seen @ (z - made.delta)[:, :, None])[:, :, 0]
        made = replace(made, moved=moved, moved_cov=P)
        found.append(CalibrationEvidence.none(3).with_motions(made, OdometryConfig()).noise.scale)
    np.testing.assert_allclose(found[0], found[1], rtol=0.1)


def test_learnt_noise_is_that_of_the_odometry_and_not_of_its_calibration():
    """A factor on the white part along each axis; what the calibration leaves open stays."""
    drive = Drive(weaving(100, np.random.default_rng(1)))
    motion, calibration = drive.track.motion(SECOND, 3 * SECOND), drive.track.calibration
    D = motion.d_delta_d_calibration
    shared = D @ calibration.cov @ D.T
    made = noisier(motion, calibration.cov, np.array([1.0, 4.0, 9.0]))
    before, after = (np.diag(one.cov - shared) for one in (motion, made))
    np.testing.assert_allclose(after, before * [1.0, 4.0, 9.0], rtol=1e-6)
