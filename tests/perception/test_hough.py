"""Hough lines: the transform, the length that it must find, and which returns become one line."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from line_checks import ends, near, normal_cov, normal_error
from walls import cast, make_scan, scan_of

from graphslam.core.config import FrontEndConfig
from graphslam.core.config_io import load_config
from graphslam.core.geometry import rotation, wrap
from graphslam.logs import open_logs
from graphslam.perception.front_ends import FRONT_ENDS
from graphslam.perception.hough import find_lines
from graphslam.perception.hough_votes import HOUGH_VOTES, OpenCvVotes, ThesisVotes
from graphslam.perception.ordered_scan import make_sweep
from graphslam.perception.segments import find_segments
from graphslam.simulation import load_scenario, simulate
from graphslam.slam.smooth import smooth

CONFIG = FrontEndConfig(name="hough")
hough, both, segments = (FRONT_ENDS[name] for name in ("hough", "both", "segments"))
WALL = [[4.0, -3.0], [4.0, 3.0]]


def everything(scan):
    return make_sweep(scan, CONFIG.max_range_m)


def votes_of(points, config=CONFIG, weights=None, votes=ThesisVotes):
    points = np.asarray(points, float)
    weights = np.ones(len(points)) if weights is None else weights
    return votes(points, weights, np.ones(len(points), bool), config)


both_votes = pytest.mark.parametrize("votes", HOUGH_VOTES.values(), ids=HOUGH_VOTES)


# ---------------------------------------------------------------- the transform


def test_the_accumulator_is_the_sum_of_eq_4_29():
    """Against the double sum as printed, for g = r; a wrong sign of d or γ would move the peak."""
    rng = np.random.default_rng(5)
    r, phi = rng.uniform(1, 6, 60), rng.uniform(-np.pi, np.pi, 60)
    config = FrontEndConfig(hough_d_max_m=5.0)
    points = np.column_stack((r * np.cos(phi), r * np.sin(phi)))
    found = votes_of(points, config, weights=r)
    step, steps = config.hough_delta_d_m, config.hough_gamma_steps
    d, gamma = np.arange(1, 201) * step, np.arange(steps) * 2 * np.pi / steps
    beside = r * np.cos(gamma[:, None, None] - phi) - d[:, None]
    inside = np.abs(beside) <= step / 2
    C = (inside * r).sum(axis=-1)
    C[inside.sum(axis=-1) < 3] = 0.0  # two returns are always on a line: not counted
    ours = found.C.reshape(steps // 2, -1)
    zero = ours.shape[1] // 2
    # γ in the second half turn is a negative distance in the first
    expected = np.concatenate((ours[:, zero + 1 : zero + 201], ours[:, zero - 200 : zero][:, ::-1]))
    np.testing.assert_allclose(expected, C, atol=1e-9)


def test_removed_returns_stop_voting():
    """What remains is what the others alone give, but for cells that had too few already."""
    rng = np.random.default_rng(6)
    points = rng.uniform(-3, 3, (50, 2))
    points[:20, 0] = 2.0
    found = votes_of(points)
    seed = found.peak()
    assert set(range(20)) <= set(seed.tolist())
    found.remove(seed)
    rest = np.setdiff1d(np.arange(50), seed)
    alone = ThesisVotes(points, np.ones(50), np.isin(np.arange(50), rest), CONFIG)
    counted = alone.C > 0
    np.testing.assert_allclose(found.C[counted], alone.C[counted], atol=1e-9)


def test_far_walls_count_as_much_as_near_ones():
    """g = r: a wall face on has its length in C, at whatever distance. ±15 %: beams are counted."""
    for distance in (2.0, 4.0, 8.0, 16.0):
        scan = scan_of([[[distance, -0.5], [distance, 0.5]]], step_deg=0.25)
        sweep = everything(scan)
        votes = votes_of(sweep.points, weights=scan.ranges[sweep.beam] * sweep.step_rad)
        np.testing.assert_allclose(votes.C.max(), 1.0, rtol=0.15)


@both_votes
def test_the_line_with_most_weight_is_found_not_the_one_with_most_returns(votes):
    """g = r: 12 returns on 2 m of a far wall before 40 on half a metre of a near one."""
    near = np.column_stack((np.full(40, 1.0), np.linspace(-0.25, 0.25, 40)))
    far = np.column_stack((np.linspace(-2.5, -0.5, 12), np.full(12, 8.0)))
    points = np.concatenate((near, far))
    weights = np.concatenate((np.full(40, 0.5 / 40), np.full(12, 2.0 / 12)))
    assert set(votes_of(points, weights=weights, votes=votes).peak()) == set(range(40, 52))
    assert set(votes_of(points, votes=votes).peak()) == set(range(40))


@both_votes
def test_returns_that_do_not_vote_are_in_no_peak(votes):
    points = np.column_stack((np.full(30, 2.0), np.linspace(-1, 1, 30)))
    voting = np.arange(30) % 3 == 0
    found = votes(points, np.ones(30), voting, CONFIG)
    assert set(found.peak()) == set(np.flatnonzero(voting))
    found.remove(np.flatnonzero(voting))
    assert not len(found.peak())


@both_votes
def test_lines_beyond_the_largest_distance_are_not_found(votes):
    config = FrontEndConfig(hough_d_max_m=5.0)
    wall = np.column_stack((np.full(30, 6.0), np.linspace(-1, 1, 30)))
    assert not len(votes_of(wall, config, votes=votes).peak())
    assert len(votes_of(wall - [2.0, 0.0], config, votes=votes).peak())


@both_votes
def test_peaks_below_the_threshold_or_of_two_returns_are_none(votes):
    wall = np.column_stack((np.full(10, 2.0), np.linspace(-1, 1, 10)))
    for weight, is_found in ((0.039, False), (0.041, True)):  # threshold 0.4 m
        assert (
            bool(len(votes_of(wall, weights=np.full(10, weight), votes=votes).peak())) == is_found
        )
    assert not len(votes_of(wall[:2], votes=votes).peak())


@pytest.mark.parametrize("count", [100, 200])
def test_opencv_proposes_again_when_its_proposals_are_used_up(count):
    """More walls than are proposed at once: none is lost."""
    rng = np.random.default_rng(4)
    normal, distance = rng.uniform(-np.pi, np.pi, count), rng.uniform(2, 15, count)
    local = np.linspace(-0.15, 0.15, 12)
    walls = [
        np.column_stack((np.full(12, d), local)) @ rotation(angle).T
        for d, angle in zip(distance, normal, strict=True)
    ]
    votes = votes_of(np.concatenate(walls), FrontEndConfig(hough_threshold_m=8), votes=OpenCvVotes)
    found = set()
    while len(rows := votes.peak()):
        found.update((rows // 12).tolist())
        votes.remove(rows)
    assert len(found) == count


def test_opencv_proposals_are_moved_onto_a_wall_that_no_stripe_of_the_grid_holds():
    """4 m of wall between two angles of the grid: at most 3 m in a stripe, all of it once moved."""
    config = FrontEndConfig(hough_threshold_m=3.5)
    along = np.arange(-2, 2, 0.02)
    wall = np.column_stack((np.full(len(along), 5.0), along)) @ rotation(np.radians(1.5)).T
    weights = np.full(len(along), 0.02)
    assert not len(votes_of(wall, config, weights, ThesisVotes).peak())
    assert len(votes_of(wall, config, weights, OpenCvVotes).peak()) == len(along)


@pytest.mark.parametrize("votes", HOUGH_VOTES)
def test_a_far_wall_of_few_returns_is_found(votes):
    """15 returns on 4 m of wall, 15 m away: as much as the threshold asks, by g = r.

    With g = 1 (thesis 4.7.2) it has a fifteenth of the votes, and is lost.
    """
    config = replace(CONFIG, hough_votes=votes, hough_threshold_m=2.0)
    scan = scan_of([[[15.0, -2.0], [15.0, 2.0]]], step_deg=1.0)
    (found,) = hough(scan, config)
    assert np.diff(found.extent) > 3.0


@both_votes
@pytest.mark.parametrize("gamma_steps", [60, 120, 240])
@pytest.mark.parametrize("length", [0.6, 1.5, 5.0])
def test_the_fullest_stripe_holds_the_guaranteed_length(gamma_steps, length, votes):
    """Figure 4-6: min(l/2, 2a / sin(Δγ/2)) of a line of length l, wherever it lies.

    Points 1 mm apart, so 3 mm of rounding. The worst of 400 lines must come near the bound, else
    the bound is not the one of this grid; 1.6 times, for the worst place is rarely drawn.
    """
    config = FrontEndConfig(hough_gamma_steps=gamma_steps)
    bound = min(length / 2, config.hough_delta_d_m / np.sin(np.pi / gamma_steps))
    rng = np.random.default_rng(gamma_steps)
    along = np.arange(-length / 2, length / 2, 1e-3)
    worst = np.inf
    for _ in range(400):
        normal, distance, slide = rng.uniform(-np.pi, np.pi), rng.uniform(1, 8), rng.uniform(-2, 2)
        local = np.column_stack((np.full(len(along), distance), along + slide))
        points = local @ rotation(normal).T
        worst = min(worst, 1e-3 * len(votes_of(points, config, votes=votes).peak()))
    assert bound - 3e-3 <= worst <= 1.6 * bound


# ---------------------------------------------------------------- which returns are one line


@pytest.mark.parametrize("turn", np.radians([0.0, 1.5, 17.0, -50.0]))
def test_a_long_wall_is_found_whole_though_its_peak_holds_a_part(turn):
    wall = np.array(WALL) @ rotation(turn).T
    (found,) = hough(scan_of([wall]), CONFIG)
    assert found.kind == "line"
    np.testing.assert_allclose(normal_error(found, wall), 0.0, atol=1e-9)
    assert np.diff(found.extent) > 0.95 * min(6.0, np.ptp(cast_ends(wall)))


def cast_ends(wall):
    """Where along the wall the first and the last beam of the half circle meet it, m."""
    r = cast([wall], np.radians(np.arange(-90, 90.5, 0.5)))
    angles = np.radians(np.arange(-90, 90.5, 0.5))[~np.isnan(r)]
    r = r[~np.isnan(r)]
    along = (wall[1] - wall[0]) / np.hypot(*(wall[1] - wall[0]))
    return np.column_stack((r * np.cos(angles), r * np.sin(angles)))[[0, -1]] @ along


def test_a_wall_behind_furniture_and_with_a_door_is_one_line():
    left, right = [[4.0, -3.0], [4.0, 0.5]], [[4.0, 1.4], [4.0, 3.0]]
    cupboard = [[2.5, -1.5], [2.5, -0.7]]
    scene = [left, right, cupboard, [[7.0, -9.0], [7.0, 9.0]]]
    pieces = near(segments(scan_of(scene, sigma=0.01), CONFIG), WALL)
    (whole,) = near(hough(scan_of(scene, sigma=0.01), CONFIG), WALL)
    assert len(pieces) >= 3  # what the segments make of it
    np.testing.assert_allclose(np.sort(ends(whole)[:, 1]), [-3.0, 3.0], atol=0.1)


@pytest.mark.parametrize("step_m", [0.06, 0.1, 0.3])
def test_a_cupboard_before_the_wall_does_not_become_a_part_of_it(step_m):
    """Parallel, 6 cm before it: 3 sigma. Merged, the line would be turned and moved by 2 cm."""
    wall, front = [[4.0, 0.5], [4.0, 3.0]], [[4.0 - step_m, -1.5], [4.0 - step_m, 0.5]]
    for seed in range(10):
        found = hough(scan_of([wall, front], sigma=0.01, seed=seed), CONFIG)
        assert len(found) == 2
        for thing in (wall, front):
            best = min(np.abs(normal_error(o, thing)[0]) for o in found)
            assert best < 0.012  # 0.01 / sqrt(50 returns), times 4, and some corner returns


def test_returns_that_another_wall_has_between_do_not_bend_a_line():
    crossing = [[3.0, 1.0], [6.0, 1.0]]  # stands on the wall's line and runs through it
    (found,) = near(hough(scan_of([WALL, crossing], sigma=0.005), CONFIG), WALL)
    np.testing.assert_allclose(normal_error(found, WALL), 0.0, atol=0.01)


def test_no_return_belongs_to_two_lines():
    rng = np.random.default_rng(1)
    for seed in range(20):
        walls = rng.uniform([1, -4], [8, 4], (6, 2, 2))
        sweep = everything(scan_of(walls, sigma=0.01, seed=seed))
        rows, starts = find_lines(sweep, np.ones(len(sweep.beam), bool), CONFIG)
        assert len(rows) == len(set(rows.tolist()))
        assert np.all(np.diff(np.append(starts, len(rows))) >= CONFIG.min_points)


def test_the_covariance_is_honest_on_noisy_walls():
    """NEES of Hough lines within ±15 % of 2: 900 lines have a standard error of 5 %.

    Floors at zero. The width of the stripe, the growing and the tests of runs must neither trim
    the noise nor let returns of the next wall in.
    """
    config = FrontEndConfig(floor_normal_m=0.0, floor_angle_rad=0.0, range_sigma_m=0.01)
    walls = [[[1, -3], [6, -3.2]], [[6.5, -2.7], [6.8, 2.7]], [[6, 3.2], [1, 3]]]  # no corners
    nees = []
    for seed in range(300):
        found = hough(scan_of(walls, sigma=0.01, seed=seed), config)
        for wall in walls:
            for line in near(found, wall, 0.1):
                error = normal_error(line, wall)
                nees.append(error @ np.linalg.solve(normal_cov(line), error))
    # 99.99 % per block: of 20 000 blocks a few are left out and come back as lines of their own
    assert 900 <= len(nees) <= 920
    np.testing.assert_allclose(np.mean(nees), 2.0, rtol=0.15)


def test_scattered_returns_and_trees_are_no_lines():
    rng = np.random.default_rng(3)
    assert sum(len(hough(make_scan(rng.uniform(1.0, 10.0, 181)), CONFIG)) for _ in range(20)) == 0


# ---------------------------------------------------------------- both


def scenes():
    rng = np.random.default_rng(8)
    for seed in range(30):
        room = np.array([[[-1, -3], [7, -3]], [[7, -3], [7, 3]], [[7, 3], [-1, 3]]], float)
        middle, half = rng.uniform([1, -2.5], [6, 2.5], (5, 2)), 0.3 * rng.normal(size=(5, 2))
        things = np.stack((middle - half, middle + half), axis=1)
        yield scan_of(np.concatenate((room, things)), sigma=0.01, seed=seed)


def test_both_keeps_the_whole_segments_and_joins_what_was_cut():
    left, right = [[4.0, -9.0], [4.0, -0.7]], [[4.0, 0.2], [4.0, 9.0]]
    whole, back = [[2.0, 1.2], [2.3, 2.4]], [[9.0, -30.0], [9.0, 30.0]]
    screen = [[2.0, -1.6], [2.0, -1.2]]
    found = both(scan_of([left, right, whole, screen, back], sigma=0.005), CONFIG)
    assert [o.kind for o in near(found, whole)] == ["segment"]
    assert [o.kind for o in near(found, [[4, -9], [4, 9]])] == ["line"]


def test_in_both_no_two_lines_are_of_one_wall():
    """Two observations of one wall in one scan would be one piece of evidence counted twice."""
    repeated = pairs = 0
    for scan in scenes():
        found = both(scan, CONFIG)
        for n, a in enumerate(found):
            for b in found[n + 1 :]:
                pairs += 1
                lateral = (b.z[:2] - a.z[:2]) @ [-np.sin(a.z[2]), np.cos(a.z[2])]
                parallel = abs(wrap(a.z[2] - b.z[2])) < 0.05 and abs(lateral) < 0.05
                a_on = (ends(a) - a.z[:2]) @ [np.cos(a.z[2]), np.sin(a.z[2])]
                b_on = (ends(b) - a.z[:2]) @ [np.cos(a.z[2]), np.sin(a.z[2])]
                shared = min(a_on.max(), b_on.max()) - max(a_on.min(), b_on.min())
                repeated += parallel and shared > 0.1
    assert pairs > 300
    assert repeated == 0


def test_both_sees_at_least_what_each_alone_sees():
    """By walls: every segment of `segments`, every line of `hough` lies along one of `both`."""
    lost = total = 0
    for scan in scenes():
        together = both(scan, CONFIG)
        for o in (*segments(scan, CONFIG), *hough(scan, CONFIG)):
            total += 1
            lost += not any(
                abs(wrap(o.z[2] - b.z[2])) < 0.1
                and abs((o.z[:2] - b.z[:2]) @ [-np.sin(b.z[2]), np.cos(b.z[2])]) < 0.1
                for b in together
            )
    assert lost <= 0.03 * total  # pieces whose returns went to two others


def test_cut_segments_without_a_hough_line_stay():
    config = FrontEndConfig(hough_threshold_m=100.0)
    scan = next(scenes())
    sweep = everything(scan)
    found = find_segments(sweep, config)
    assert len(both(scan, config)) == np.count_nonzero(found.valid)


# ---------------------------------------------------------------- covariance as printed, whole runs


def test_the_thesis_covariance_is_an_option_for_hough_lines():
    """`front_end.covariance = "thesis"`: eq. 4.32 as printed, every return with sigma_r; on a wall
    seen at 45° on average that is more than the incidence angle leaves."""
    scan = scan_of([WALL], sigma=0.0)
    plain = replace(CONFIG, floor_normal_m=0.0, floor_angle_rad=0.0)
    (found,) = hough(scan, replace(plain, covariance="thesis"))
    points = everything(scan).points
    eta = (points - found.z[:2]) @ [np.cos(found.z[2]), np.sin(found.z[2])]
    A = np.column_stack((np.ones(len(eta)), eta))
    expected = CONFIG.range_sigma_m**2 * np.linalg.inv(A.T @ A)
    np.testing.assert_allclose(normal_cov(found), expected, rtol=1e-6, atol=1e-15)
    (other,) = hough(scan, plain)
    assert normal_cov(other)[1, 1] < 0.8 * expected[1, 1]


ROOM = """
[world]
walls = [{ name = "room", points_m = [[0, 0], [10, 0], [10, 7], [0, 7]], closed = true }]
boxes = [
  { name = "cupboard", center_m = [3, 6.2], size_m = [1.0, 0.5] },
  { name = "desk", center_m = [6.5, 5.9], size_m = [1.4, 0.7] },
  { name = "shelf", center_m = [9.2, 2.5], size_m = [0.5, 1.2] },
]
[robots.vehicle]
start_m = [1.5, 1.5]
body = { radius_m = 0.3 }
drive = [{ through_m = [[8, 1.5], [8, 4.5], [2, 4.5], [2, 1.5], [6, 1.5]] }]
encoders = { slip_m = 0.002 }
laser = { mount_m = [0.1, 0], range_max_m = 30 }
"""


@pytest.mark.parametrize("seed", [0, 1])
def test_in_both_a_wall_becomes_one_landmark(tmp_path, seed):
    """The room's four walls, two of them behind furniture that hides now this part and now that:
    one landmark each at the end of a whole run, though now a segment and now a Hough line saw
    them. With two, what is seen of one wall would be split between them."""
    (tmp_path / "room.toml").write_text(ROOM, encoding="utf-8")
    simulate(load_scenario(str(tmp_path / "room.toml")), tmp_path / "room.mcap", seed)
    config = load_config(overrides=["front_end.name=both", "start.from_truth=true"])
    result = smooth(open_logs([tmp_path / "room.mcap"], config), config)
    corners = np.array([[0, 0], [10, 0], [10, 7], [0, 7], [0, 0]], dtype=float)
    for a, b in itertools.pairwise(corners):
        along = (b - a) / np.hypot(*(b - a))
        normal = np.array([-along[1], along[0]])
        on = [
            landmark
            for landmark in result.landmarks
            if landmark.kind != "point" and np.abs((landmark.extent - a) @ normal).max() < 0.1
        ]
        assert len(on) == 1
        assert np.ptp(on[0].extent @ along) > 0.8 * np.hypot(*(b - a))
