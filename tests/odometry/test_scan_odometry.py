"""Motions against consecutive scans: what contradicts odometry; logs whose odometry is wrong."""

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2
from walls import CORRIDOR, L_ROOM, cloud
from wrong_odometry import CHANGES, recorded, run

import graphslam
from graphslam import simulation
from graphslam.core.config import ScanMatchingConfig
from graphslam.core.config_io import load_config
from graphslam.core.geometry import compose, wrap
from graphslam.core.records import Motion, Observation
from graphslam.logs import open_logs
from graphslam.odometry.scan_odometry import (
    checked_against_scans,
    fused,
    match_off_lines,
    points_off_lines,
    scan_submap,
)
from graphslam.slam.smooth import smooth

S = 1_000_000_000
AT = np.array([-2.0, 1.0, 0.3])
STEP = np.array([0.25, 0.01, 0.1])
SIGMAS = np.array([0.01, 0.01, 0.01])  # of a good odometry between two keyframes
D = np.ones((3, 2))


def said(delta):
    """A motion that odometry reports."""
    return Motion(0, S, np.asarray(delta, dtype=float), np.diag(SIGMAS**2), D, 0.25)


def scans(walls, rng=None, step=STEP, at=AT):
    """Submaps of two scans, the second after a ``step``."""
    return tuple(scan_submap(cloud(pose, walls, rng)) for pose in (at, compose(at, step)))


# ------------------------------------------------------------ one motion


def test_good_odometry_is_left_alone():
    """The very object, over 20 seeds of odometry errors and range noise: a pipeline that doubts
    good odometry would lose its calibration, which such motions do not teach."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        motion = said(STEP + rng.normal(0, SIGMAS))
        assert checked_against_scans(motion, *scans(L_ROOM, rng)) is motion


@pytest.mark.parametrize(
    "wrong",
    [[0.3, 0, 0], [-0.12, 0, 0], [0, 0.2, 0], [0, 0, 0.2], [0.1, 0, -0.1], -2 * STEP],
    ids=["slip", "spun wheel", "sideways", "turn", "both", "reversed"],
)
def test_a_wrong_motion_is_taken_from_the_scans(wrong):
    """To 2 cm and 0.01 rad, and within the covariance (99.9 %): the odometry that was contradicted
    has no say left. It teaches no calibration."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        found = checked_against_scans(said(STEP + wrong), *scans(L_ROOM, rng))
        off = found.delta - STEP
        assert found.from_scans
        assert np.hypot(off[0], off[1]) < 0.02 and abs(off[2]) < 0.01
        assert off @ np.linalg.solve(found.cov, off) < chi2.ppf(0.999, 3)
        assert not found.d_delta_d_calibration.any()


def test_along_a_corridor_odometry_stays():
    """Slip along it cannot be seen: the motion stays. A wrong turn is put right by the walls, and
    the path along them stays odometry's with its sigma at least: nothing is invented."""
    straight, middle = np.array([0.25, 0.0, 0.0]), np.zeros(3)
    for seed in range(5):
        before, now = scans(CORRIDOR, np.random.default_rng(seed), straight, middle)
        slipped = said(straight + np.array([0.3, 0, 0]))
        assert checked_against_scans(slipped, before, now) is slipped
        found = checked_against_scans(said(straight + np.array([0, 0, 0.2])), before, now)
        assert found.from_scans and abs(found.delta[2]) < 0.01
        assert abs(found.delta[0] - 0.25) < 0.02
        assert found.cov[0, 0] > 0.5 * SIGMAS[0] ** 2


def test_scans_of_different_places_contradict_nothing():
    """A scan of another room fits nowhere: that is no evidence against odometry."""
    before, _ = scans(L_ROOM)
    _, now = scans(CORRIDOR, None, STEP, np.array([20.0, 0.0, 1.0]))
    motion = said(STEP)
    assert checked_against_scans(motion, before, now) is motion


def test_too_few_returns_say_nothing():
    assert scan_submap(np.zeros((5, 2))) is None


def test_fusion_is_that_of_informations():
    """Sum of informations, and the mean weighted by them; turns the short way round."""
    rng = np.random.default_rng(0)
    A, B = (m @ m.T + np.eye(3) for m in rng.normal(size=(2, 3, 3)))
    a = np.array([1.0, 2.0, np.pi - 0.05])
    found = fused(Motion(0, S, a, A, D, 1.0), np.eye(3), B, np.array([0.5, -1.0, 0.1]))
    P = np.linalg.inv(np.linalg.inv(A) + np.linalg.inv(B))
    mean = a + P @ np.linalg.solve(B, [0.5, -1.0, 0.1])
    np.testing.assert_allclose(found.cov, P, rtol=1e-9)
    np.testing.assert_allclose(found.delta[:2], mean[:2], rtol=1e-9)
    assert wrap(found.delta[2] - mean[2]) == pytest.approx(0.0, abs=1e-9)


# ------------------------------------------------------------ the second source


def test_points_on_lines_are_left_out():
    line = Observation("line", np.array([1.0, 2.0, np.pi / 2]), np.eye(3), np.array([-1.0, 1.0]))
    post = Observation("point", np.array([0.1, 3.0]), np.eye(2))
    points = np.array([[1.05, 2.5], [0.95, 1.0], [1.3, 2.0], [1.0, 3.5]])
    np.testing.assert_array_equal(
        points_off_lines(points, [line, post], ScanMatchingConfig()), points[2:]
    )


def test_clutter_measures_the_motion_that_walls_do_not():
    """A corridor with round posts: what lies on no line tells the path along it, within its sigmas
    (99.9 % of chi-square, mean of 10 seeds). Without posts nothing is left to tell anything."""
    posts = np.array([[2.0, 0.7], [-1.5, -0.6], [3.5, -0.7], [-3.0, 0.6], [1.0, -0.8]])
    turns = np.linspace(0, 2 * np.pi, 13)
    rings = [0.12 * np.column_stack([np.cos(turns), np.sin(turns)]) + post for post in posts]
    round_ = np.concatenate([np.stack([r[1:], r[:-1]], axis=1) for r in rings])
    straight, d2 = np.array([0.25, 0.0, 0.0]), []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        clouds = [
            cloud(pose, np.concatenate([CORRIDOR, round_]), rng) for pose in (np.zeros(3), straight)
        ]
        motion = said(straight + rng.normal(0, [0.05, 0.01, 0.01]))
        motion = Motion(0, S, motion.delta, np.diag([0.05**2, 1e-4, 1e-4]), D, 0.25)
        walls = [
            Observation("line", np.array([0, y, 0.0]), np.eye(3), np.array([-30.0, 30.0]))
            for y in (-1.0, 1.0)
        ]
        found = match_off_lines(
            motion,
            scan_submap(clouds[0]),
            "r",
            points_off_lines(clouds[1], walls, ScanMatchingConfig()),
        )
        assert found is not None and (found.other_time_ns, found.time_ns) == (0, S)
        off = found.delta - straight
        assert np.sqrt(found.cov[0, 0]) < 0.05
        d2.append(off @ np.linalg.solve(found.cov, off))
        assert match_off_lines(motion, scan_submap(clouds[0]), "r", np.zeros((0, 2))) is None
    assert np.sum(d2) < chi2.ppf(0.999, 30)


# ------------------------------------------------------------ a whole log


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """The lab, driven forwards and backwards, with good odometry."""
    return recorded(0, tmp_path_factory.mktemp("lab"))


@pytest.mark.parametrize("name", CHANGES)
def test_wrong_odometry_is_noticed_and_survived(lab, name, tmp_path):
    """Mean error 5 cm at most (with good odometry it is under 1 cm; scans between two states lie on
    odometry's path between them, so single ones are worse), and it is told how often it happened.
    Late stamps contradict nothing, nor do gaps, which scans bridge: that is told, too."""
    errors, summary = run(lab, name, tmp_path / "log.mcap")
    wrong = name in ("slip", "unsigned")
    assert errors["final"].mean() < (0.05 if wrong or name == "stopped" else 0.01)
    (told,) = summary["odometry"].values()
    assert told["motions"] > 50
    assert (told["contradicted"] > 0) is wrong
    assert any("contradict" in text for text in summary["warnings"]) is wrong
    assert (told["bridged"] > 0) is (name in ("silent", "stopped"))
    if name == "late":
        latency = summary["calibration"]["vehicle.laser_latency_s"]
        assert abs(latency["value"] + 0.15) < 4 * latency["sigma"]


def test_without_scan_matching_unsigned_odometry_is_lost(lab, tmp_path):
    """The other side of the test above: the log is hard enough to need it."""
    errors, summary = run(lab, "unsigned", tmp_path / "log.mcap", "odometry.scan_matching=off")
    assert errors["final"].mean() > 1.0
    (told,) = summary["odometry"].values()
    assert told["motions"] == told["contradicted"] == 0


def test_the_second_source_does_no_harm(lab, tmp_path):
    """With `on`, of what lies on no line: a good run stays good to 1 cm, and has these factors."""
    path = tmp_path / "log.mcap"
    setting = "odometry.scan_matching=on"
    errors, _ = run(lab, "untouched", path, setting)
    assert errors["final"].mean() < 0.01
    config = load_config(overrides=[setting])
    assert any(step.closures for step in smooth(open_logs([path], config), config).steps)


def test_a_narrow_laser_that_turns_denies_no_good_odometry(tmp_path):
    """60 degrees, of which a turn between two scans leaves half in common. Laid wrongly, by half a
    metre and 0.4 rad, more points were on the earlier scan: the path jumped, 0.23 m off."""
    scenario = Path(simulation.__file__).parent / "scenarios" / "office-loop.toml"
    text = scenario.read_text(encoding="utf-8")
    assert "field_deg" not in text
    narrow = tmp_path / "narrow.toml"
    narrow.write_text(text.replace("step_deg = ", "field_deg = 60\nstep_deg = "), encoding="utf-8")
    graphslam.simulate(narrow, tmp_path / "log.mcap", seed=1)
    result = graphslam.smooth(tmp_path / "log.mcap", **{"start.from_truth": True})
    assert graphslam.evaluate(result)["joint"]["final"]["max_m"] < 0.1
