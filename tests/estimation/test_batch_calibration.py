"""Calibration together with the trajectory: simulated truth for every parameter, and corridors."""

import typing
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2

from graphslam.core.config import CalibrationParameter, OdometryConfig, RobotConfig
from graphslam.core.config_io import load_config
from graphslam.core.errors import ConfigError
from graphslam.core.geometry import between, wrap
from graphslam.core.motion_models import nominal_calibration
from graphslam.core.records import OdometryPose, Truth
from graphslam.estimation.sensor_errors import ERRORS
from graphslam.logs import open_logs
from graphslam.odometry.preintegration import Track
from graphslam.simulation import load_scenario, simulate
from graphslam.simulation.scenario import Leg
from graphslam.slam.smooth import smooth

S = 1_000_000_000
PRIORS = nominal_calibration("odometry", OdometryConfig(), True)
PRIOR = dict(zip(PRIORS.names, np.sqrt(np.diag(PRIORS.cov)), strict=True))


def odometry_of(errors, axle_m):
    """Relative errors of the left and right wheel's radius and of the axle, for given scales."""
    scale, turn, drift = (
        errors.get(n, 0.0) for n in ("translation_scale", "rotation_scale", "drift_rad_per_m")
    )
    axle = (1 + scale) / (1 + turn) - 1
    apart = drift * axle_m * (1 + axle)
    return {
        "radius_error_left": scale - apart / 2,
        "radius_error_right": scale + apart / 2,
        "axle_error": axle,
    }


def wrong(scenario, errors):
    """A scenario whose one robot's odometry and laser's clock are off, and where the laser is said
    to be, for its place and yaw to be off too."""
    ((name, robot),) = scenario.robots.items()
    late = errors.get("laser_latency_s", 0.0)
    encoders = replace(
        robot.encoders, **odometry_of(errors, robot.encoders.axle_m), latency_s=max(-late, 0.0)
    )
    laser = replace(robot.laser, latency_s=max(late, 0.0))
    real = np.array([*laser.mount_m, np.radians(laser.mount_deg)])
    said = real - [errors.get(n, 0.0) for n in ("laser_x_m", "laser_y_m", "laser_yaw_rad")]
    changed = replace(robot, encoders=encoders, laser=laser)
    return replace(scenario, robots={name: changed}), f"robots.{name}.laser={said.tolist()}"


def run(scenario, seed, folder, *settings):
    """The result, its calibration by parameter, and errors (n, 3) of final and causal poses."""
    path = folder / f"{seed}.mcap"
    simulate(scenario, path, seed)
    config = load_config(overrides=settings)
    result = smooth(open_logs([path], config), config)
    ((name, robot),) = result.robots.items()
    log = open_logs([path], config)
    truth = np.array([(m.time_ns, *m.pose) for m in log.messages() if isinstance(m, Truth)])
    heading = np.unwrap(truth[:, 3])
    columns = (truth[:, 1], truth[:, 2], heading)
    true = np.column_stack([np.interp(robot.final.stamps_ns, truth[:, 0], c) for c in columns])
    off = robot.final.poses - between(true[0], true)
    off[:, 2] = wrap(off[:, 2])
    found = {key.removeprefix(f"{name}."): v for key, v in result.summary["calibration"].items()}
    return SimpleNamespace(result=result, robot=robot, found=found, off=off, name=name)


# ------------------------------------------------------------ every parameter


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """Runs through the lab, forwards and backwards, with all parameters drawn from their priors."""
    folder, runs = tmp_path_factory.mktemp("drawn"), []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        errors = {name: rng.normal(0, sigma) for name, sigma in PRIOR.items()}
        scenario, laser = wrong(load_scenario("lab"), errors)
        runs.append((errors, run(scenario, seed, folder, laser)))
    return runs


def test_every_parameter_is_found_within_its_sigma(drawn):
    """Mean of squared errors in sigmas over 4 runs, 7 parameters: below 2, twice what independent
    noise would give (walls of one material are wrong together, which no scan knows), and not so
    small that the sigmas say nothing. No single one beyond 4 sigmas."""
    z = np.array([
        [(done.found[name]["value"] - errors[name]) / done.found[name]["sigma"] for name in PRIOR]
        for errors, done in drawn
    ])  # fmt: skip
    assert 0.2 < np.mean(z**2) < 2.0
    assert np.abs(z).max() < 4.0


def test_a_mount_is_what_the_log_says_and_the_deviations_that_are_reported(drawn):
    """Also where the yaw is 1 deg off: it does not turn the laser's place about the base."""
    for _, done in drawn:
        (laser,) = done.result.summary["lasers"][done.name]
        names = ("laser_x_m", "laser_y_m", "laser_yaw_rad")
        off = [done.found[name]["value"] for name in names]
        np.testing.assert_allclose(np.add(laser["mount_in_log"], off), laser["mount"], atol=1e-9)


def test_the_drive_through_a_room_shows_every_parameter(drawn):
    """A fifth of the prior's sigma is left at most; wheels to 0.26 % of their radius, which is the
    drift times the axle: two of its sigmas over more runs, of 0.13 %. The base is where it is to
    2 cm though none of this was known."""
    for errors, done in drawn:
        for name, prior in PRIOR.items():
            assert done.found[name]["observable"]
            assert done.found[name]["sigma"] < 0.2 * prior, name
        drift = done.found["drift_rad_per_m"]["value"] - errors["drift_rad_per_m"]
        assert abs(drift) * load_scenario("lab").robots["vehicle"].encoders.axle_m < 2.6e-3
        assert np.hypot(done.off[:, 0], done.off[:, 1]).mean() < 0.02


def test_a_fixed_parameter_stays_and_the_others_are_found(tmp_path):
    """Scale and the laser's place across are right in this log and are held: no sigma, no value,
    not called observable; drift and latency, which are off, are found beside them."""
    errors = {"drift_rad_per_m": 0.02, "laser_latency_s": 0.05}
    scenario, laser = wrong(load_scenario("lab"), errors)
    fixed = "odometry.fixed_calibration=['translation_scale', 'laser_y_m']"
    found = run(scenario, 7, tmp_path, laser, fixed).found
    for name in ("translation_scale", "laser_y_m"):
        assert found[name] == {"value": 0.0, "sigma": 0.0, "observable": False}
    for name, value in errors.items():
        assert abs(found[name]["value"] - value) < 3 * found[name]["sigma"]
        assert found[name]["observable"]


def test_every_parameter_can_be_fixed():
    """The names that the setting takes are those of all sources, each then known to 1e-6, and
    those of sensors of sightings."""
    config = OdometryConfig()
    sources = ("odometry", "commands", "wheels")
    names = {n for source in sources for n in nominal_calibration(source, config, True).names}
    assert names | set(ERRORS) == set(typing.get_args(CalibrationParameter))
    for source in sources:
        for name in nominal_calibration(source, config, True).names:
            held = nominal_calibration(source, replace(config, fixed_calibration=(name,)), True)
            small = np.sqrt(np.diag(held.cov)) < 1e-6
            assert [n for n, is_small in zip(held.names, small, strict=True) if is_small] == [name]
    with pytest.raises(
        ConfigError, match=r"odometry.fixed_calibration\[0\]: 'wheel' is not one of"
    ):
        load_config(overrides=["odometry.fixed_calibration=['wheel']"])


def test_what_odometry_does_not_cover_is_no_standstill():
    """A robot that drives at 0.5 m/s when its odometry begins: a motion that begins 0.2 s earlier
    may have 0.1 m more; one that the readings cover has nothing unseen."""
    track = Track(OdometryConfig(), RobotConfig())
    for k in range(20):
        track.add(OdometryPose("r", k * S // 10, k * S // 10, np.array([0.05 * k, 0.0, 0.0])))
    np.testing.assert_allclose(track.uncovered_bound(-S // 5, S), [0.1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(track.uncovered_bound(S, 21 * S // 10), [0.1, 0, 0], atol=1e-9)
    np.testing.assert_array_equal(track.uncovered_bound(0, S), np.zeros(3))


# ------------------------------------------------------------ only parallel walls


def corridor(errors, drive=()):
    scenario, _ = wrong(load_scenario("long-corridor"), errors)
    ((name, robot),) = scenario.robots.items()
    return replace(scenario, robots={name: replace(robot, drive=drive or robot.drive)})


def parallel_walls(seed, folder, drive=()):
    rng = np.random.default_rng(seed)
    names = ("translation_scale", "rotation_scale", "drift_rad_per_m")
    return run(corridor({n: rng.normal(0, PRIOR[n]) for n in names}, drive), seed, folder)


@pytest.fixture(scope="module")
def one_way(tmp_path_factory):
    """Four runs of 60 m between two walls whose ends are never seen, scales drawn from priors."""
    folder = tmp_path_factory.mktemp("one-way")
    return [parallel_walls(seed, folder) for seed in range(4)]


def test_along_parallel_walls_nothing_is_invented(one_way):
    """Errors along 60 m are those of the scale that odometry is believed to have: NEES within the
    99.8 % bounds of chi-square (drawn truth, 4 runs). The sigma is the scale's times the path, to
    10 % (a little is white): it grows with the path and not with its root, as if each stretch had a
    scale of its own, which would claim a tenth of it."""
    z = np.array([done.off[-1, 0] / np.sqrt(done.robot.final.covs[-1, 0, 0]) for done in one_way])
    assert chi2.ppf(0.001, 4) < z @ z < chi2.ppf(0.999, 4)
    for done in one_way:
        path, cov = done.robot.final.poses[:, 0], done.robot.final.covs[:, 0, 0]
        scale = done.found["translation_scale"]
        # of the scale they tell what the way across, between them, tells: more than half, if the
        # scale would be another in each stretch nine tenths
        assert scale["sigma"] > 0.2 * PRIOR["translation_scale"]
        assert np.sqrt(cov[-1]) == pytest.approx(scale["sigma"] * path[-1], rel=0.1)
        half = np.searchsorted(path, path[-1] / 2)
        assert np.sqrt(cov[half] / cov[-1]) == pytest.approx(0.5, abs=0.05)


def test_across_parallel_walls_the_robot_is_held(one_way):
    """Walls hold the offset to centimetres and the heading to milliradians, within 4 sigmas. No
    direction is known better than exactly, also between states, as far as the mount is in both."""
    for done in one_way:
        assert np.linalg.eigvalsh(done.robot.final.covs).min() > 0.0
        sigma = np.sqrt(np.diagonal(done.robot.final.covs, axis1=1, axis2=2))
        assert np.abs(done.off[:, 1]).max() < 0.1 and np.abs(done.off[:, 2]).max() < 0.02
        assert (np.abs(done.off[10:, 1:]) < 4 * sigma[10:, 1:]).all()


def test_to_and_fro_between_parallel_walls_closes_no_loop(tmp_path):
    """Every place looks like every other, each is seen three times: nothing may be closed, with all
    of closing and merging on. The second way out is as uncertain as the first."""
    there, back = ((15.0, 0.3), (30.0, -0.2)), ((15.0, 0.2), (0.0, 0.0))
    again = ((15.0, -0.2), (30.0, 0.0))
    done = parallel_walls(9, tmp_path, tuple(Leg(through_m=t) for t in (there, back, again)))
    summary = done.result.summary
    assert summary["counts"]["loop_closures"] == 0
    assert summary["consolidated"]["closures_verified"] == 0
    assert summary["counts"]["landmarks"] == 2
    sigma = np.sqrt(done.robot.final.covs[:, 0, 0])
    assert np.abs(done.off[-1, 0]) < 3 * sigma[-1]
    x = done.robot.final.poses[:, 0]
    first = int(np.argmax(x > 28.0))
    assert sigma[-1] > 0.9 * sigma[first] * x[-1] / x[first]
