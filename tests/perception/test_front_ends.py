"""Front ends: lines from scans of scenes whose walls are known."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from line_checks import ends, near, normal_cov, normal_error
from scipy.stats import chi2
from walls import cast, make_scan, scan_of

from graphslam.core.config import FrontEndConfig
from graphslam.core.errors import EstimationError
from graphslam.core.geometry import compose, rotate_cov, rotation, wrap
from graphslam.perception.breaks import FALSE_BREAK
from graphslam.perception.front_ends import FRONT_ENDS
from graphslam.perception.hough import _borders as run_borders
from graphslam.perception.line_fit import fit_lines, observations
from graphslam.perception.ordered_scan import make_sweep, scan_points
from graphslam.perception.segments import _chain_starts as chain_starts
from graphslam.perception.segments import find_segments
from graphslam.perception.variance_split import split_by_variance

segments = FRONT_ENDS["segments"]
CONFIG = FrontEndConfig()
HONEST = FrontEndConfig(floor_normal_m=0.0, floor_angle_rad=0.0)
FRONT_WALL = [[3.0, -1.0], [3.0, 1.0]]
BACK_WALL = [[8.0, -60.0], [8.0, 60.0]]
ROOM = [[[-1, -2], [4, -2]], [[4, -2], [4, 3]], [[4, 3], [-1, 3]], [[-1, 3], [-1, -2]]]


def fit_line(points, config, fully_visible):
    """One line through points (k, 2), m, laser frame, in the order of the beams."""
    fits = fit_lines(points, np.zeros(1, dtype=np.intp), config)
    return observations(fits, np.array([fully_visible]), config)[0]


# ---------------------------------------------------------------- the table's contract


@pytest.mark.parametrize("name", FRONT_ENDS)
def test_every_front_end_keeps_the_contract_of_observations(name):
    for observation in FRONT_ENDS[name](scan_of(ROOM, sigma=0.02), CONFIG):
        assert observation.kind in ("segment", "line")
        assert observation.z.shape == (3,) and -np.pi <= observation.z[2] < np.pi
        assert observation.cov.shape == (3, 3) and observation.extent.shape == (2,)
        np.testing.assert_allclose(observation.cov, observation.cov.T, rtol=1e-12)
        assert np.linalg.eigvalsh(observation.cov)[0] > 0
        assert observation.extent[0] < 0 < observation.extent[1]


@pytest.mark.parametrize("name", FRONT_ENDS)
@pytest.mark.parametrize("step", [np.pi / 180, -np.pi / 180])
@pytest.mark.parametrize(
    "ranges",
    [[], [2.0], [2.0, 2.0], [np.nan] * 181, [30.0] * 181, [81.8] * 181, [0.0] * 181, [np.inf] * 9],
    ids=["empty", "one beam", "two beams", "NaN", "all max", "beyond max", "zero", "inf"],
)
def test_a_scan_that_shows_nothing_gives_nothing(name, ranges, step):
    # warnings are errors: catches means of nothing and comparisons with NaN
    assert FRONT_ENDS[name](make_scan(ranges, step=step), CONFIG) == ()


# ---------------------------------------------------------------- geometry without noise


@pytest.mark.parametrize("step_deg", [1.0, 0.5])
@pytest.mark.parametrize("turn", np.radians([0.0, 17.0, -50.0]))
def test_a_wall_without_noise_is_found_exactly(step_deg, turn):
    scan = scan_of([np.array(FRONT_WALL) @ rotation(turn).T, np.array(BACK_WALL)], step_deg)
    wall = np.array(FRONT_WALL) @ rotation(turn).T
    (found,) = near(segments(scan, CONFIG), wall, 1e-9)
    points = scan_points(scan, 30.0)
    on_wall = points[np.hypot(*points.T) < 3.2]  # the wall's ends are at 3.16 m
    # rounding only: a shifted middle, a lost end point or an unweighted angle would show
    np.testing.assert_allclose(ends(found), on_wall[[0, -1]], atol=1e-9)
    np.testing.assert_allclose(found.z[:2], on_wall[[0, -1]].mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(wrap(found.z[2] - turn - np.pi / 2), 0.0, atol=1e-9)
    assert found.kind == "segment"


def test_every_wall_of_a_room_is_found_once_and_exactly():
    found = segments(scan_of(ROOM), CONFIG)
    assert len(found) == 3  # the one behind is not in view
    for wall in ROOM[:3]:
        (line,) = near(found, wall, 1e-9)
        np.testing.assert_allclose(normal_error(line, wall), 0.0, atol=1e-9)


def test_the_sensor_is_on_the_left_of_what_it_sees_from_either_side():
    # separates the two sides of a thin wall: a direction modulo pi would make them equal
    (far_side,) = near(segments(scan_of([FRONT_WALL, BACK_WALL]), CONFIG), FRONT_WALL)
    mirrored = np.array([FRONT_WALL, BACK_WALL]) * [-1, 1]
    n = 361
    scan = make_scan(
        cast(mirrored, np.pi / 2 + np.radians(0.5) * np.arange(n)), np.pi / 2, 0.00872665
    )
    (near_side,) = near(segments(scan, CONFIG), mirrored[0], 0.01)
    np.testing.assert_allclose(far_side.z[2], np.pi / 2, atol=1e-9)
    np.testing.assert_allclose(near_side.z[2], -np.pi / 2, atol=1e-3)


@st.composite
def noisy_scans(draw):
    """A room seen from a random place, with things in it, noise and drop-outs."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    walls = np.array(ROOM, float) * rng.uniform(0.7, 3.0)
    middle = rng.uniform([1, -1], [3, 2], (4, 2))
    half = rng.normal(size=(4, 2)) * 0.4
    walls = np.concatenate([walls, np.stack([middle - half, middle + half], axis=1)])
    walls = walls @ rotation(rng.uniform(-3, 3)).T
    ranges = cast(walls, -np.pi / 2 + np.pi / 180 * np.arange(181)) + 0.01 * rng.normal(size=181)
    ranges[rng.random(181) < 0.05] = np.nan
    return make_scan(ranges)


def assert_same(found, expected, tolerance=1e-6):
    assert [o.kind for o in found] == [o.kind for o in expected]
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a.z[:2], b.z[:2], atol=tolerance)
        np.testing.assert_allclose(wrap(a.z[2] - b.z[2]), 0.0, atol=tolerance)
        np.testing.assert_allclose(a.cov, b.cov, atol=tolerance)
        np.testing.assert_allclose(a.extent, b.extent, atol=tolerance)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(noisy_scans(), st.floats(-3.0, 3.0))
def test_turning_the_laser_frame_turns_every_observation(scan, turn):
    # 1e-6: cv2 splits in single precision, but the fit itself is double
    found = segments(make_scan(scan.ranges, scan.angle_min_rad + turn), CONFIG)
    expected = [
        type(o)(o.kind, compose(np.array([0, 0, turn]), o.z), rotate_cov(o.cov, turn), o.extent)
        for o in segments(scan, CONFIG)
    ]
    assert_same(found, expected)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(noisy_scans())
def test_beams_in_clockwise_order_give_the_same(scan):
    backwards = make_scan(scan.ranges[::-1], scan.angles[-1], -scan.angle_step_rad)
    assert_same(segments(backwards, CONFIG), segments(scan, CONFIG), 1e-9)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(noisy_scans())
def test_a_mirrored_scene_gives_mirrored_observations(scan):
    # y -> -y keeps the sensor on the left by turning the direction to pi - phi
    flip = np.diag([1.0, -1.0, -1.0])
    expected = [
        type(o)(o.kind, flip @ o.z + [0, 0, np.pi], flip @ o.cov @ flip, o.extent)
        for o in segments(scan, CONFIG)
    ][::-1]
    assert_same(segments(make_scan(scan.ranges[::-1], -scan.angles[-1]), CONFIG), expected)


def test_a_full_circle_has_no_seam_inside_a_wall():
    angles = np.radians(np.arange(-180, 180))  # the seam points backwards, at the middle of a wall
    walls = [[[-2, 1], [-2, -1]], [[-6, 9], [-6, -9]], BACK_WALL]
    (found,) = near(segments(make_scan(cast(walls, angles), -np.pi), CONFIG), walls[0], 1e-9)
    assert found.kind == "segment"
    assert np.diff(found.extent) > 1.9


# ---------------------------------------------------------------- which ends are real


def test_walls_between_corners_are_segments_and_walls_cut_by_the_border_are_lines():
    kinds = {i: near(segments(scan_of(ROOM), CONFIG), ROOM[i])[0].kind for i in range(3)}
    assert kinds == {0: "line", 1: "segment", 2: "line"}


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_wall_cut_by_a_nearer_thing_is_a_line(side):
    screen = [[1.5, side * 0.35], [1.5, side * 0.8]]  # hides the end, seen from the origin
    (found,) = near(segments(scan_of([FRONT_WALL, screen, BACK_WALL]), CONFIG), FRONT_WALL)
    assert found.kind == "line"
    assert np.diff(found.extent) < 1.9


@pytest.mark.parametrize("mixed_m", [2.9, 2.2])
def test_a_mixed_pixel_at_the_occluding_edge_does_not_make_the_end_real(mixed_m):
    scan = scan_of([FRONT_WALL, [[1.5, 0.35], [1.5, 0.8]], BACK_WALL])
    edge = np.flatnonzero(scan.ranges < 2.0)[0]
    scan.ranges[edge] = mixed_m
    (found,) = near(segments(scan, CONFIG), FRONT_WALL)
    assert found.kind == "line"


def test_an_end_beside_a_missing_return_is_not_known():
    scan = scan_of([FRONT_WALL, BACK_WALL])
    scan.ranges[np.flatnonzero(scan.ranges < 3.2)[-1] + 1] = np.nan
    (found,) = near(segments(scan, CONFIG), FRONT_WALL)
    assert found.kind == "line"


def test_a_bend_is_not_the_end_of_a_wall():
    # where a round wall is cut into chords depends on the view, so no chord has real ends
    angle = np.radians(np.arange(-60, 61, 2.0))
    arc = np.column_stack([2 + 3 * np.cos(angle), 3 * np.sin(angle)])
    found = segments(scan_of(np.stack([arc[:-1], arc[1:]], axis=1)), CONFIG)
    assert len(found) >= 3
    assert {o.kind for o in found} == {"line"}


# ---------------------------------------------------------------- split and merge


def test_drop_outs_do_not_split_a_wall():
    scan = scan_of([FRONT_WALL, BACK_WALL], sigma=0.01)
    on_wall = np.flatnonzero(scan.ranges < 3.3)
    scan.ranges[on_wall[4:-4:5]] = np.nan  # single ones
    scan.ranges[on_wall[20] : on_wall[30]] = np.nan  # 0.26 m of glass
    (found,) = near(segments(scan, CONFIG), FRONT_WALL, 0.1)
    assert np.diff(found.extent) > 1.9
    assert found.kind == "segment"


def test_a_pole_in_front_does_not_split_a_wall_and_a_door_does():
    pole = [[1.5, -0.03], [1.5, 0.03]]
    (whole,) = near(segments(scan_of([FRONT_WALL, pole, BACK_WALL]), CONFIG), FRONT_WALL, 1e-9)
    assert np.diff(whole.extent) > 1.9
    left, right = [[3, -1], [3, -0.3]], [[3, 0.3], [3, 1]]
    parts = near(segments(scan_of([left, right, BACK_WALL]), CONFIG), FRONT_WALL, 1e-9)
    assert [o.kind for o in parts] == ["segment", "segment"]


def test_noise_does_not_split_a_wall():
    # Of 200 points some deviate by more than split_m = 2.5 sigma from a chord: every wall is cut,
    # on average into 5 pieces. The gate of the merge is 99.9 % but the pieces' ends are extremes.
    wall = [[2.0, -3.0], [2.0, 3.0]]
    parts = [
        len(near(segments(scan_of([wall], sigma=0.02, seed=seed), CONFIG), wall, 0.2))
        for seed in range(60)
    ]
    assert np.mean(parts) < 1.1


@pytest.mark.parametrize("offset_m, parts", [(0.0, 1), (0.1, 2)])
def test_a_recess_in_a_wall_is_its_own_segment(offset_m, parts):
    walls = [[[3.0, -2.0], [3.0, 0.0]], [[3 + offset_m, 0.0], [3 + offset_m, 1.5]]]
    assert len(segments(scan_of(walls, sigma=0.01), CONFIG)) == parts


@pytest.fixture
def split_alone(monkeypatch):
    """Without the test of all returns of a segment (test_breaks.py), which sees less than that."""
    monkeypatch.setattr(
        "graphslam.perception.segments.without_breaks", lambda _, first, last, *noise: (first, last)
    )


@pytest.mark.usefixtures("split_alone")
@pytest.mark.parametrize("bend_m, parts", [(0.05, 1), (0.06, 2)])
def test_a_wall_is_split_where_it_bends_by_more_than_the_setting_says(bend_m, parts):
    """`split_m`, 5 cm: the largest deviation from the chord inside one segment."""
    wall = [[[3, -1.5], [3 - bend_m, 0]], [[3 - bend_m, 0], [3, 1.5]]]
    assert len(segments(scan_of(wall), CONFIG)) == parts


@pytest.mark.usefixtures("split_alone")
@pytest.mark.parametrize("step_m, parts", [(0.09, 1), (0.11, 2)])
def test_two_walls_are_two_if_their_step_exceeds_twice_the_deviation(step_m, parts):
    """One line between them deviates by half the step from either."""
    walls = [[[3, -1.5], [3, 0]], [[3 - step_m, 0], [3 - step_m, 1.5]]]
    assert len(segments(scan_of(walls), CONFIG)) == parts


def test_a_return_farther_than_the_deviation_from_its_segment_is_left_out():
    """A strip 4 cm proud of the wall is a part of the wall, one of 6 cm is not."""
    kept = []
    for proud_m in (0.04, 0.06):
        strip = [[3 - proud_m, 0.2], [3 - proud_m, 0.3]]
        sweep = make_sweep(scan_of([[[3, -1.5], [3, 1.5]], strip], step_deg=1.0), 30.0)
        found = find_segments(sweep, CONFIG)
        kept.append(np.count_nonzero(sweep.points[found.rows, 0] < 2.99))
    assert kept[0] >= 2 and kept[1] == 0


@pytest.mark.parametrize("step_m, chains", [(0.49, 1), (0.51, 2)])
def test_neighbouring_returns_are_one_chain_up_to_a_gap_that_grows_with_range(step_m, chains):
    """`gap_m` + `gap_ratio` times the range: 0.3 + 0.05 * 4 m."""
    walls = [[[4, -1], [4, 0]], [[4 + step_m, 0], [4 + step_m, 1]]]
    assert len(chain_starts(make_sweep(scan_of(walls), 30.0), CONFIG)) == chains


@pytest.mark.parametrize("setting", [{"gap_m": 0.15}, {"gap_ratio": 0.0125}])
def test_a_smaller_gap_cuts_chains_and_lines_of_the_hough_transform(setting):
    """Two collinear boards 40 cm apart, 4 m away, with a thing between them: the gap between runs
    is 0.5 m by default, and smaller with either setting smaller."""
    walls = [[[4, -1.4], [4, -0.2]], [[4, 0.2], [4, 1.4]], [[3, -0.15], [3, 0.15]]]
    sweep = make_sweep(scan_of(walls), 30.0)
    on = np.flatnonzero(np.abs(sweep.points[:, 0] - 4) < 1e-6)
    assert len(run_borders(on, np.pi / 2, sweep, CONFIG)) == 2  # begin and end of one run
    assert len(run_borders(on, np.pi / 2, sweep, replace(CONFIG, **setting))) == 3
    step = [[[4, -1], [4, 0]], [[4.45, 0], [4.45, 1]]]
    behind = make_sweep(scan_of(step), 30.0)
    assert len(chain_starts(behind, CONFIG)) == 1
    assert len(chain_starts(behind, replace(CONFIG, **setting))) == 2


@pytest.mark.parametrize("points, kept", [(12, True), (13, False)])
def test_a_line_needs_as_many_returns_as_the_setting_says(points, kept):
    """`min_points`; the two end returns of a chain count."""
    wall = [[3.0, -0.3], [3.0, 0.3]]
    seen = np.count_nonzero(np.isfinite(scan_of([wall], step_deg=1.0).ranges))
    assert seen == 11 or seen == 12
    config = replace(CONFIG, min_points=points - 12 + seen)
    assert bool(segments(scan_of([wall], step_deg=1.0), config)) == kept


def test_a_grazing_corridor_wall_is_followed_although_its_returns_are_far_apart():
    # 12 m at 1°: the last returns are 2 m apart, more than the range discontinuity of a chain
    wall = [[-1.0, 1.0], [12.0, 1.0]]
    (found,) = segments(scan_of([wall], step_deg=1.0, sigma=0.005), CONFIG)
    assert np.diff(found.extent) > 9.0


def test_a_thin_pole_and_scattered_returns_give_nothing():
    assert segments(scan_of([[[2, -0.05], [2, 0.05]]]), CONFIG) == ()
    scattered = np.random.default_rng(3).uniform(1.0, 10.0, 181)
    assert segments(make_scan(scattered), CONFIG) == ()


# ---------------------------------------------------------------- covariance


def noisy_walls(incidence_deg, runs=400, count=40, distance=4.0, length=2.0, sigma=0.02):
    """Points (runs, count, 2) of walls, and the true wall (2, 2).

    The wall's middle is seen at ``distance`` m and at this incidence.
    """
    turn = np.pi / 2 + np.radians(incidence_deg)
    along = length * np.array([np.cos(turn), np.sin(turn)])
    wall = np.array([distance, 0.0]) + np.outer([-0.5, 0.5], along)
    bearings = np.linspace(*np.arctan2(wall[:, 1], wall[:, 0]), count)
    ranges = cast([wall + np.outer([-1e-6, 1e-6], along)], bearings)
    noisy = ranges + sigma * np.random.default_rng(7).normal(size=(runs, count))
    return noisy[..., None] * np.column_stack([np.cos(bearings), np.sin(bearings)]), wall


@pytest.mark.parametrize(
    "incidence_deg, distance, length, count",
    [(angle, 4.0, 2.0, 40) for angle in (0, 30, 45, 60, 70, 80)]
    + [(0, 10.0, 0.9, 6), (60, 10.0, 2.0, 6), (75, 10.0, 4.0, 6)],  # six beams, 1° apart
)
def test_the_covariance_of_normal_and_direction_is_honest(incidence_deg, distance, length, count):
    """NEES over 400 fits inside the 99.8 % bounds of chi-square, floors at zero.

    Fails for a normal noise without the cosine, a missing correlation (V's corner), a sign of the
    correlation, a covariance in the wrong frame.
    """
    clouds, wall = noisy_walls(incidence_deg, 400, count, distance, length)
    nees = []
    for points in clouds:
        seen = fit_line(points, HONEST, True)
        error = normal_error(seen, wall)
        nees.append(error @ np.linalg.solve(normal_cov(seen), error))
    low, high = chi2.ppf([0.001, 0.999], 2 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high


@pytest.mark.parametrize("incidence_deg, ratio", [(0, 1.0), (45, 0.70), (70, 0.35), (80, 0.18)])
def test_the_thesis_overstates_the_normal_noise_by_the_cosine(incidence_deg, ratio):
    """Scatter over sigma of eq. 4.32 as printed, the table of equations.md; ±12 %: 400 runs, 2 m.

    The ratio of the two stated covariances is the same: they differ in the weights only.
    """
    clouds, wall = noisy_walls(incidence_deg)
    printed = FrontEndConfig(floor_normal_m=0.0, floor_angle_rad=0.0, covariance="thesis")
    offsets = [normal_error(fit_line(p, printed, True), wall)[0] for p in clouds]
    stated = np.sqrt(normal_cov(fit_line(clouds[0], printed, True))[0, 0])
    np.testing.assert_allclose(np.std(offsets) / stated, ratio, rtol=0.12)
    own = np.sqrt(normal_cov(fit_line(clouds[0], HONEST, True))[0, 0])
    np.testing.assert_allclose(own / stated, ratio, rtol=0.12)


def test_the_whole_front_end_is_honest_on_a_noisy_room():
    """Split, merge and the choice of points leave the NEES of all walls at 2 (99.8 %).

    One in a few dozen is broken by noise: where it fits best, so its parts are off by more.
    """
    config = FrontEndConfig(floor_normal_m=0.0, floor_angle_rad=0.0, range_sigma_m=0.01)
    nees, broken = [], 0
    for seed in range(150):
        found = segments(scan_of(ROOM, sigma=0.01, seed=seed), config)
        for wall in ROOM[:3]:
            lines = near(found, wall, 0.1)
            broken += len(lines) > 1
            for line in lines:
                error = normal_error(line, wall)
                nees.append(error @ np.linalg.solve(normal_cov(line), error))
    # the chance of a break, and three sigmas of how many that makes
    runs = 3 * 150
    assert broken < FALSE_BREAK * runs + 3 * np.sqrt(FALSE_BREAK * runs)
    low, high = chi2.ppf([0.001, 0.999], 2 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high


def test_floors_are_added_once_and_in_the_frame_of_the_line():
    points = noisy_walls(30, runs=1)[0][0]
    config = FrontEndConfig(covariance="thesis", floor_normal_m=0.03, floor_angle_rad=0.02)
    without = FrontEndConfig(covariance="thesis", floor_normal_m=0.0, floor_angle_rad=0.0)
    added = normal_cov(fit_line(points, config, True)) - normal_cov(fit_line(points, without, True))
    np.testing.assert_allclose(added, np.diag([0.03**2, 0.02**2]), atol=1e-15)


def test_along_a_segment_the_variance_is_that_of_its_end_points():
    """Eq. 4.36-4.38 for points 0.1 m apart at one end and 0.3 m at the other, plus end_sigma²."""
    y = np.array([-0.5, -0.4, -0.2, 0.1, 0.4, 0.7])
    seen = fit_line(np.column_stack([np.full(6, 2.0), y]), CONFIG, True)
    expected = (0.1**2 / 12 + 0.3**2 / 12) / 2 + CONFIG.end_sigma_m**2
    np.testing.assert_allclose(rotate_cov(seen.cov, -seen.z[2])[0, 0], expected, rtol=1e-9)
    np.testing.assert_allclose(seen.extent, [-0.6, 0.6], atol=1e-12)


# ---------------------------------------------------------------- the rest


def test_many_lines_at_once_are_each_fitted_as_alone():
    clouds, _ = noisy_walls(50, runs=5, count=20)
    together = fit_lines(clouds.reshape(-1, 2), np.arange(0, 100, 20), CONFIG)
    for i, points in enumerate(clouds):
        alone = fit_line(points, CONFIG, True)
        np.testing.assert_allclose(together.z[i], alone.z, rtol=1e-12)
        np.testing.assert_allclose(together.length[i], np.diff(alone.extent)[0], rtol=1e-12)


def test_points_that_coincide_are_an_error_of_ours():
    with pytest.raises(EstimationError, match="two distinct"):
        fit_line(np.ones((6, 2)), CONFIG, True)


def test_scan_points_go_through_the_mount_and_leave_out_missing_returns():
    scan = make_scan([1.0, np.nan, 2.0, 50.0, np.inf], 0.0, np.pi / 2, (0.5, 0.1, np.pi / 2))
    np.testing.assert_allclose(scan_points(scan, 30.0), [[0.5, 1.1], [0.5, -1.9]], atol=1e-12)


# ---------------------------------------------------------------- as the thesis prints it


def split(points, allowed_m, fewest=3):
    points = np.asarray(points, float)
    return split_by_variance(points, 0, len(points) - 1, allowed_m**2, fewest)


def test_a_scan_is_split_at_the_farthest_return_until_the_variance_is_small():
    """4.7.6: corners of a polyline, and no split where the mean square deviation is allowed even
    though one return is farther (which a split by the largest deviation would cut)."""
    corner = [(x, 0.0) for x in np.linspace(0, 2, 11)] + [(2.0, y) for y in np.linspace(0.2, 2, 10)]
    assert split(corner, 0.01) == [(0, 10), (10, 20)]
    bump = [(x, 0.0) for x in np.linspace(0, 2, 41)]
    bump[20] = (1.0, 0.06)
    assert split(bump, 0.05 / 2) == [(0, 40)]
    assert len(split(bump, 0.005)) > 1
    assert split(corner[:12], 0.01, fewest=4) == [(0, 10)]  # the rest has too few returns


def test_segments_of_which_an_end_may_be_hidden_are_rejected_where_asked_for():
    """4.7.8: a wall behind a box is cut by its edges; only the box remains."""
    box = [[[2.0, -0.5], [2.0, 0.5]]]
    scan = scan_of([*box, BACK_WALL], sigma=0.0)
    kept = segments(scan, CONFIG)
    rejected = segments(scan, replace(CONFIG, hidden_ends="reject"))
    assert {o.kind for o in kept} == {"segment", "line"}
    assert [o.kind for o in rejected] == ["segment"]
    np.testing.assert_allclose(rejected[0].z[:2], [2.0, 0.0], atol=0.02)


def test_both_splits_find_the_walls_of_a_room():
    """Within the noise, from scans of four walls."""
    scan = scan_of(ROOM, sigma=0.005)
    by_variance = segments(scan, replace(CONFIG, split_rule="variance"))
    by_deviation = segments(scan, CONFIG)
    assert len(by_variance) == len(by_deviation)
    for a, b in zip(by_variance, by_deviation, strict=True):
        assert abs(wrap(a.z[2] - b.z[2])) < 0.01
