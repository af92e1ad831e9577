"""When scans contradict a motion, by how much, and what is made of it: at the limits."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from walls import CORRIDOR, L_ROOM, cloud

from graphslam.core.config import ScanMatchingConfig
from graphslam.core.geometry import compose
from graphslam.core.records import Motion, Observation
from graphslam.odometry.scan_odometry import (
    MAX_SIGMA_FLOORS,
    MIN_POINTS,
    USUAL_OVERLAP,
    _corrected,
    check_motions,
    is_suspect,
    match_off_lines,
    points_off_lines,
    scan_submap,
    suspect_motions,
)
from graphslam.perception.scan_matching import make_submap
from graphslam.perception.scan_pairs import fit_pairs

S = 1_000_000_000
CONFIG = ScanMatchingConfig()
STEP = np.array([0.25, 0.01, 0.1])
SURE = 1e-6 * np.eye(3)


def said(delta, cov=SURE):
    """A motion that odometry reports."""
    return Motion(S, 2 * S, np.asarray(delta, float), np.asarray(cov, float), np.ones((3, 2)), 0.25)


# ------------------------------------------------------------ suspicion


def test_a_scan_of_few_points_is_not_matched():
    points = cloud(np.zeros(3), L_ROOM)
    assert scan_submap(points[: MIN_POINTS - 1]) is None
    assert len(scan_submap(points[:MIN_POINTS]).clouds[0]) == MIN_POINTS


def test_a_motion_is_suspect_if_scans_hardly_overlap_or_lie_elsewhere():
    """The step to where they lie best, by the covariance of both: 90 % of chi-square."""
    cov = np.diag([0.04, 0.01, 0.0025])
    edge = np.sqrt(chi2.ppf(0.9, 3)) * np.array([0.2, 0.0, 0.0])
    assert is_suspect(USUAL_OVERLAP - 1e-6, np.zeros(3), cov)
    assert not is_suspect(USUAL_OVERLAP, np.zeros(3), cov)
    assert not is_suspect(1.0, 0.999 * edge, cov) and is_suspect(1.0, 1.001 * edge, cov)
    assert is_suspect(1.0, np.array([0.0, 0.0, 0.2]), cov)


def test_suspicion_of_many_motions_is_that_of_each():
    """By the fit of each pair and by the motion's own covariance; a motion that is off by little
    is suspect only to one who is sure of it."""
    rng = np.random.default_rng(3)
    poses = [np.array([-2.0, 1.0, 0.3])]
    for _ in range(6):
        poses.append(compose(poses[-1], STEP))
    clouds = [cloud(pose, L_ROOM, rng) for pose in poses]
    before, now = np.arange(6), np.arange(1, 7)
    off = np.zeros((6, 3))
    off[1, 0], off[2, 1], off[3, 0], off[4, 2] = 0.1, -0.06, 1.5, 0.04
    loose = np.diag([0.1, 0.1, 0.1]) ** 2
    motions = [said(STEP + e, SURE) for e in off]
    motions[2] = said(STEP + off[2], loose)
    found, _ = suspect_motions(motions, clouds, before, now, CONFIG)
    assert found.tolist() == [False, True, False, True, True, False]
    fit = fit_pairs(clouds, before, now, np.array([m.delta for m in motions]), CONFIG)
    each = [
        is_suspect(float(share), step, motion.cov + cov)
        for share, step, motion, cov in zip(fit.share, fit.step, motions, fit.cov, strict=True)
    ]
    assert found.tolist() == each
    assert suspect_motions([], clouds, before[:0], now[:0], CONFIG)[0].tolist() == []


# ------------------------------------------------------------ contradiction


@pytest.mark.parametrize(
    "off, acts",
    [
        ([0.049, 0, 0], False), ([0.051, 0, 0], True), ([0.04, -0.04, 0], True),
        ([0.03, -0.03, 0], False), ([0, 0, 0.029], False), ([0, 0, -0.031], True),
        ([0.02, 0, -0.029], False), ([0.02, 0.01, 0.04], True),
    ],
)  # fmt: skip
def test_a_small_contradiction_is_left_alone(off, acts):
    """`contradiction_m`, 5 cm in any direction, and `contradiction_rad`, 0.03: what odometry that
    is sure of itself may be off without harm. The other is then taken from the scans, too."""
    motion = said(STEP)
    found = _corrected(motion, STEP + off, 1e-8 * np.eye(3), CONFIG)
    assert (found is not motion) is acts
    if acts:
        np.testing.assert_allclose(found.delta, STEP + off, atol=1e-4)
        assert found.from_scans


@pytest.mark.parametrize("sigmas, acts", [(3.9, False), (4.2, True)])
def test_a_contradiction_within_the_covariance_of_both_is_none(sigmas, acts):
    """99.9 % of chi-square with three degrees of freedom: 4.03 sigma, of odometry and scans."""
    own, of_scans = np.diag([0.06, 0.06, 0.06]) ** 2, np.diag([0.04, 0.04, 0.04]) ** 2
    motion = said(STEP, own)
    off = np.array([0.0, sigmas * np.hypot(0.06, 0.04), 0.0])
    config = replace(CONFIG, floor_m=0.1)  # or sigmas of 4 cm would be too large
    assert (_corrected(motion, STEP + off, of_scans, config) is not motion) is acts


def test_a_contradicted_motion_is_fused_with_its_covariance_inflated_by_the_contradiction():
    """By hand in one dimension: p = s² + off², gain p / (p + r)."""
    s2, r, off = 1e-4, 4e-4, 0.3
    found = _corrected(
        said(STEP, s2 * np.eye(3)), STEP + np.array([off, 0, 0]), r * np.eye(3), CONFIG
    )
    p = s2 + off**2
    assert found.delta[0] == pytest.approx(STEP[0] + off * p / (p + r), abs=1e-12)
    assert found.cov[0, 0] == pytest.approx(p * r / (p + r))
    assert found.cov[1, 1] == pytest.approx(s2 * r / (s2 + r))


@pytest.mark.parametrize("share, is_used", [(0.99, True), (1.01, False)])
def test_directions_that_scans_do_not_determine_stay_as_odometry_has_them(share, is_used):
    """A sigma of `MAX_SIGMA_FLOORS` floors or more is that of the noise of points."""
    turn = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]])
    limit = MAX_SIGMA_FLOORS * CONFIG.floor_m
    cov = turn @ np.diag([(share * limit) ** 2, 1e-6, 1e-6]) @ turn.T
    off = turn @ np.array([1.0, 0.1, 0.0])
    found = _corrected(said(STEP, 1e-4 * np.eye(3)), STEP + off, cov, CONFIG)
    moved = turn.T @ (found.delta - STEP)
    assert moved[1] == pytest.approx(0.1, abs=1e-3)
    assert moved[0] == pytest.approx(1.0 if is_used else 0.0, abs=0.02)
    if not is_used:
        along = (turn.T @ found.cov @ turn)[0, 0]
        assert along == pytest.approx(1e-4, rel=0.02)


def test_a_turn_is_contradicted_the_short_way_round():
    """Scans at +3.13 rad, odometry at -3.13: 0.02 rad apart, not six."""
    motion = said([0.0, 0.0, -3.13])
    assert _corrected(motion, np.array([0.0, 0.0, 3.13]), SURE, CONFIG) is motion


def test_each_motion_of_several_is_corrected_by_its_own_scans():
    """One good, two wrong; breaks when what was found for one is given to another."""
    rng = np.random.default_rng(1)
    at = [np.array([-2.0, 1.0, 0.3]), np.array([1.0, -2.0, 2.0]), np.array([-3.0, 2.0, -1.0])]
    steps = [STEP, np.array([0.3, 0.0, -0.2]), np.array([-0.2, 0.05, 0.3])]
    off = [np.zeros(3), np.array([0.4, 0, 0.05]), np.array([0, 0, -0.25])]
    cov = np.diag([0.01, 0.01, 0.01]) ** 2
    motions = [said(step + e, cov) for step, e in zip(steps, off, strict=True)]
    before = [scan_submap(cloud(pose, L_ROOM, rng)) for pose in at]
    pairs = zip(at, steps, strict=True)
    now = [scan_submap(cloud(compose(pose, step), L_ROOM, rng)) for pose, step in pairs]
    found = check_motions(motions, before, now)
    assert found[0] is motions[0]
    for k in (1, 2):
        error = found[k].delta - steps[k]
        assert found[k].from_scans and np.hypot(*error[:2]) < 0.02 and abs(error[2]) < 0.01


@pytest.mark.parametrize(
    "here, there, is_used",
    [(0.55, 0.59, False), (0.55, 0.61, True), (0.3, 0.49, False), (0.3, 0.51, True)],
)
def test_another_motion_must_put_more_points_on_others(monkeypatch, here, there, is_used):
    """Half of them, and a twentieth more than where odometry has them: in a corridor of equal doors
    the next door is as good as the right one."""
    name = "graphslam.odometry.scan_odometry."
    pose, cov = STEP + np.array([0.9, 0.0, 0.0]), SURE[None]
    monkeypatch.setattr(name + "fits", lambda *_: (np.array([here]), np.zeros((1, 3)), cov))
    monkeypatch.setattr(name + "align_pairs", lambda *_: (pose[None], cov, None))
    monkeypatch.setattr(name + "shares_on_others", lambda ends, *_: np.full(len(ends), there))
    monkeypatch.setattr(name + "match_pairs", lambda ends, *_: [[]] * len(ends))
    scan = scan_submap(cloud(np.zeros(3), L_ROOM))
    (found,) = check_motions([said(STEP)], [scan], [scan])
    assert found.from_scans is is_used


def test_a_lost_motion_is_searched_for_within_twice_itself_and_the_settings(monkeypatch):
    """Half a window in each component: an unsigned counter reports the reverse of a motion."""
    windows = []

    def nothing(ends, _starts, _near, asked):
        windows.extend(asked)
        return [[]] * len(ends)

    monkeypatch.setattr("graphslam.odometry.scan_odometry.match_pairs", nothing)
    before = scan_submap(cloud(np.zeros(3), L_ROOM))
    now = scan_submap(cloud(np.array([20.0, 0.0, 1.0]), CORRIDOR))
    check_motions([said([0.6, -0.1, -0.3])], [before], [now])
    expected = np.array([CONFIG.search_m + 1.2, CONFIG.search_m + 0.2, CONFIG.search_rad + 0.6])
    np.testing.assert_allclose(windows, [expected])


@pytest.mark.parametrize("reach, is_found", [(0.95, True), (3.0, False)])
def test_a_motion_is_searched_for_within_the_window_beyond_twice_the_motion(reach, is_found):
    """`search_m`, 0.5 m, plus twice 0.6 m: an unsigned counter reports the reverse. What is farther
    is not found, and odometry stays."""
    rng = np.random.default_rng(4)
    config = replace(CONFIG, reach_m=0.2)
    at, along = np.array([-2.0, 1.0, 0.0]), 0.6
    motion = said([along, 0.0, 0.0], np.diag([0.02, 0.02, 0.02]) ** 2)
    true = np.array([along - reach * (config.search_m + 2 * along), 0.0, 0.0])
    before, now = (
        scan_submap(cloud(pose, L_ROOM, rng), config) for pose in (at, compose(at, true))
    )
    found = check_motions([motion], [before], [now])[0]
    assert found.from_scans is is_found
    if is_found:
        assert np.hypot(*(found.delta - true)[:2]) < 0.03


# ------------------------------------------------------------ what lies on no line


def test_points_are_on_a_line_up_to_two_cells_from_its_seen_part():
    """Turned, beside it and beyond its ends; a line's ends are where it was seen."""
    margin = 2 * CONFIG.cell_m
    z = np.array([1.0, 2.0, 0.6])
    line = Observation("line", z, np.eye(3), np.array([-1.0, 0.5]))
    along = np.array([-1 - margin, -1 - margin, 0.0, 0.0, 0.0, 0.0, 0.5 + margin, 0.5 + margin])
    across = np.array([0.0, 0.0, margin, margin, -margin, -margin, 0.0, 0.0])
    nudge = 0.01 * np.array([1, -1, 1, -1, 1, -1, -1, 1])
    along = along + nudge * (across == 0)
    across = across + nudge * (across != 0)
    c, s = np.cos(z[2]), np.sin(z[2])
    points = z[:2] + np.column_stack([c * along - s * across, s * along + c * across])
    is_off = np.array([False, True, True, False, False, True, False, True])
    np.testing.assert_array_equal(points_off_lines(points, [line], CONFIG), points[is_off])


@pytest.mark.parametrize("off_m, is_used", [(0.02, True), (0.5, False)])
def test_a_second_measurement_that_contradicts_odometry_is_none(off_m, is_used):
    """It is of consecutive states: from the later one, seen from the earlier."""
    rng = np.random.default_rng(0)
    at = np.array([-2.0, 1.0, 0.3])
    before = scan_submap(cloud(at, L_ROOM, rng))
    points = cloud(compose(at, STEP), L_ROOM, rng)
    motion = said(STEP + np.array([off_m, 0, 0]), np.diag([0.05, 0.05, 0.02]) ** 2)
    found = match_off_lines(motion, before, "r", points)
    assert (found is not None) is is_used
    if found is not None:
        assert found.pair == (("r", 2 * S), ("r", S)) and found.robot == "r"
        assert np.abs(found.delta - STEP).max() < 0.02
        tight = said(STEP + np.array([0.3, 0, 0]), SURE)
        assert match_off_lines(tight, before, "r", points) is None


def test_along_a_corridor_only_the_turn_is_corrected():
    rng = np.random.default_rng(0)
    straight = np.array([0.25, 0.0, 0.0])
    before, now = (scan_submap(cloud(p, CORRIDOR, rng)) for p in (np.zeros(3), straight))
    cov = np.diag([0.01, 0.01, 0.01]) ** 2
    found = check_motions([said(straight + np.array([0, 0, 0.15]), cov)], [before], [now])[0]
    assert found.from_scans and abs(found.delta[2]) < 0.01
    assert found.cov[0, 0] == pytest.approx(cov[0, 0], rel=0.1)


@pytest.mark.parametrize("few", [None, 0, 1])
def test_scans_of_few_returns_correct_nothing(monkeypatch, few):
    """A laser of 4 m saw 28 returns at the end of a corridor: at some motion half of them lie on
    another scan, and odometry that was right was turned by a radian for it."""
    name = "graphslam.odometry.scan_odometry."
    pose, cov = STEP + np.array([0.9, 0.0, 0.0]), SURE[None]
    monkeypatch.setattr(name + "fits", lambda *_: (np.array([0.4]), np.zeros((1, 3)), cov))
    monkeypatch.setattr(name + "align_pairs", lambda *_: (pose[None], cov, None))
    monkeypatch.setattr(name + "shares_on_others", lambda ends, *_: np.full(len(ends), 0.7))
    monkeypatch.setattr(name + "match_pairs", lambda ends, *_: [[]] * len(ends))
    points = cloud(np.zeros(3), L_ROOM)
    before, now = (
        make_submap(np.zeros((1, 3)), [points[:28] if k == few else points]) for k in (0, 1)
    )
    (found,) = check_motions([said(STEP)], [before], [now])
    assert found.from_scans is (few is None)
