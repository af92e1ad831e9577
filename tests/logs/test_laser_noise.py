"""The noise of a laser's ranges is found in its scans, and nothing else is taken for it."""

import numpy as np
import pytest

from graphslam.core.config import Config, FrontEndConfig
from graphslam.logs import LogWriter, open_logs
from graphslam.logs.laser_noise import LOW, LOW_M, MIDDLE_M, WINDOW, find_range_noise
from graphslam.pipeline.robot_settings import with_log_settings

STEP_RAD = np.radians(0.5)
ANGLES = np.arange(-180, 181) * STEP_RAD
S = 1_000_000_000
SHAPE = {"angle_min_rad": ANGLES[0], "angle_step_rad": STEP_RAD, "range_max_m": 30.0}


def ranges_in_room(width_m=8.0, depth_m=6.0, x=0.5, y=0.3):
    """Ranges (n,) m to the walls of a room around a laser at x, y from its middle."""
    c, s = np.cos(ANGLES), np.sin(ANGLES)
    with np.errstate(divide="ignore"):
        to_x = (np.where(c > 0, width_m / 2, -width_m / 2) - x) / c
        to_y = (np.where(s > 0, depth_m / 2, -depth_m / 2) - y) / s
    return np.minimum(np.where(to_x > 0, to_x, np.inf), np.where(to_y > 0, to_y, np.inf))


def scans(sigma_m, share=0.0, number=60, seed=0, rough_m=0.0):
    """Of a robot that drives across the room; ``rough_m``: clutter in every second of its beams."""
    rng = np.random.default_rng(seed)
    made = []
    for x in np.linspace(-3.0, 3.0, number):
        clean = ranges_in_room(x=x)
        clean[::2] -= rough_m * rng.random(len(clean[::2]))
        made.append(clean + np.hypot(sigma_m, share * clean) * rng.normal(size=len(clean)))
    return made


def found(made):
    return find_range_noise((ranges, STEP_RAD * np.arange(len(ranges))) for ranges in made)


@pytest.mark.parametrize("sigma_m", [0.005, 0.02, 0.05, 0.1])
def test_noise_that_does_not_grow_is_found(sigma_m):
    noise = found(scans(sigma_m))
    # windows at the room's corners hold two walls: they add at most a tenth
    assert noise.sigma_m == pytest.approx(sigma_m, rel=0.1)
    assert noise.ratio == 0.0


@pytest.mark.parametrize(("sigma_m", "share"), [(0.01, 0.02), (0.03, 0.03), (0.0, 0.02)])
def test_noise_that_grows_with_the_range_is_found(sigma_m, share):
    noise = found(scans(sigma_m, share))
    for at in (1.0, 2.0, 4.0):
        expected = np.hypot(sigma_m, share * at)
        # few windows are near, and the variance of those that are far counts
        assert np.hypot(noise.sigma_m, noise.ratio * at) == pytest.approx(expected, rel=0.2)


def test_clutter_in_a_part_of_the_scans_is_no_noise():
    """Every second beam of a fifth of the scans is up to 0.3 m short."""
    noise = found(scans(0.01, number=240) + scans(0.01, rough_m=0.3))
    # the lowest tenth of all windows is the lowest eighth of those of smooth walls
    assert noise.sigma_m == pytest.approx(0.01, rel=0.15)
    assert noise.ratio == 0.0


def test_surfaces_that_are_rough_everywhere_are_noise():
    """Lines fit them no better than with that noise."""
    assert found(scans(0.01, rough_m=0.3)).sigma_m > 0.1


def test_returns_that_are_missing_are_left_out():
    made = scans(0.05)
    rng = np.random.default_rng(1)
    for ranges in made:
        ranges[rng.random(len(ranges)) < 0.1] = np.nan
        ranges[:20] = np.inf
        ranges[20:30] = 0.0
    assert found(made).sigma_m == pytest.approx(0.05, rel=0.1)


@pytest.mark.parametrize(
    "made", [[], [np.zeros(0)], [np.array([1.0, 2.0])], 3 * [np.full(361, np.nan)]]
)
def test_nothing_is_said_without_returns(made):
    assert found(made) is None


def test_beams_need_not_be_evenly_spaced():
    """Those of a cloud are where its points are; one in five is missing here."""
    keep = np.random.default_rng(3).random(len(ANGLES)) < 0.8
    noise = find_range_noise((ranges[keep], ANGLES[keep]) for ranges in scans(0.05))
    assert noise.sigma_m == pytest.approx(0.05, rel=0.1)


def test_angles_that_are_none_tell_nothing():
    made = scans(0.05)
    for bearings in (np.zeros(len(ANGLES)), np.full(len(ANGLES), np.nan)):
        assert find_range_noise((ranges, bearings) for ranges in made) is None


def test_the_quantiles_are_those_of_white_noise():
    """0.001 of the constants is three sigmas of this many windows."""
    e = np.random.default_rng(0).normal(size=(400_000, WINDOW + 2))
    bend = (e[:, :-2] + e[:, 2:] - 2 * e[:, 1:-1]) / np.sqrt(6)
    rms = np.sqrt((bend**2).mean(axis=1))
    assert np.quantile(rms, (LOW, 0.5)) == pytest.approx((LOW_M, MIDDLE_M), abs=2e-3)


def settings_of(tmp_path, sigma_m, told=None):
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        for k, ranges in enumerate(scans(sigma_m)):
            log.odometry("robot", k * S, (0.1 * k, 0.0, 0.0))
            log.scan("robot", k * S, ranges, **SHAPE)
    config = Config() if told is None else Config(front_end=told)
    logs = open_logs([path], config)
    return logs, with_log_settings(logs, config).front_end


def test_the_front_end_gets_the_noise_of_a_noisy_laser(tmp_path):
    logs, config = settings_of(tmp_path, 0.08)
    assert config.range_sigma_m == pytest.approx(0.08, rel=0.1)
    assert logs.range_noise("/scan").sigma_m == config.range_sigma_m


@pytest.mark.parametrize("sigma_m", [0.005, 0.02])
def test_a_usual_laser_keeps_the_default(tmp_path, sigma_m):
    """The noise of such a laser is less than what walls differ from lines by."""
    _, config = settings_of(tmp_path, sigma_m)
    assert config == FrontEndConfig()


def test_noise_that_is_set_is_kept(tmp_path):
    told = FrontEndConfig(range_sigma_m=0.03)
    _, config = settings_of(tmp_path, 0.08, told)
    assert config == told
