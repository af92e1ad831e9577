"""Where chains of returns end, which gaps are bridged, and which ends of walls are real."""

from dataclasses import replace

import numpy as np
import pytest
from line_checks import near, normal_cov, normal_error
from walls import cast, make_scan, scan_of

from graphslam.core.config import FrontEndConfig
from graphslam.core.geometry import rotate_cov, rotation
from graphslam.perception.breaks import Returns
from graphslam.perception.front_ends import FRONT_ENDS
from graphslam.perception.line_fit import LineFits, fit_lines, observations
from graphslam.perception.ordered_scan import Sweep, join_sweeps, make_sweep
from graphslam.perception.segments import (
    STEP_GROWTH,
    Pieces,
    _chain_starts,
    _merge,
    allowed_rms,
    fewest_points,
    find_segments,
    valid_lines,
)

CONFIG = FrontEndConfig()
segments = FRONT_ENDS["segments"]
TURNS = np.radians([0.0, 90.0, 180.0, -60.0])
BEHIND = [[20.0, -60.0], [20.0, 60.0]]


def sweep_of(points):
    """A scan that has these returns (n, 2) on consecutive beams."""
    points = np.asarray(points, float)
    r, angles = np.hypot(*points.T), np.arctan2(points[:, 1], points[:, 0])
    return Sweep(r, angles, np.arange(len(r)), points, 0.01)


def scan_at(walls, turn, step_deg=0.5):
    """The half circle ahead, everything turned by ``turn``."""
    angles = turn - np.pi / 2 + np.radians(step_deg) * np.arange(int(180 / step_deg) + 1)
    walls = np.asarray(walls, float) @ rotation(turn).T
    return make_scan(cast(walls, angles), angles[0], np.radians(step_deg))


def at(walls, turn):
    return np.asarray(walls, float) @ rotation(turn).T


# ---------------------------------------------------------------- chains


def chains(x, y, turn=0.0, *, backwards=False, config=CONFIG):
    """Number of chains of returns, which are turned, or in the other order."""
    points = np.column_stack([x, y]) @ rotation(turn).T
    return len(_chain_starts(sweep_of(points[::-1] if backwards else points), config))


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("turn", TURNS)
def test_a_step_along_a_wall_is_no_gap_if_it_grows_less_than_fourfold(turn, backwards):
    """At 5 m the gap is 0.55 m. On one line with the steps before it a longer one is of the same
    wall at grazing incidence, but not of any length."""
    assert STEP_GROWTH == 4.0
    for before, chains_ in ((0.3, 1), (0.21, 1), (0.19, 2), (0.05, 2)):
        x = 5.0 + np.append([0, before, 2 * before], 2 * before + 0.8)
        assert chains(x, np.ones(4), turn, backwards=backwards) == chains_


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("aside_m, expected", [(0.045, 1), (-0.045, 1), (0.055, 2), (-0.055, 2)])
def test_a_step_is_along_a_wall_if_it_deviates_by_less_than_split_m(
    turn, backwards, aside_m, expected
):
    """Across the line of the shorter step, where the longer one leads; 6 m away, so 0.6 m gap."""
    x, y = np.array([5.0, 5.4, 5.8, 6.6]), np.array([3.0, 3.0, 3.0, 3.0 + aside_m])
    assert chains(x, y, turn, backwards=backwards) == expected
    finer = replace(CONFIG, split_m=0.01)
    assert chains(x, y, turn, backwards=backwards, config=finer) == 2


@pytest.mark.parametrize("turn", TURNS)
def test_a_step_back_along_the_beam_is_a_gap(turn):
    """Collinear, but the other way: a thing before the wall, not the wall."""
    x = np.array([5.0, 5.3, 5.6, 4.8, 5.1])
    assert chains(x, np.ones(5), turn) == 2
    assert chains(x, np.ones(5), turn, backwards=True) == 2


def test_missing_beams_end_a_chain_where_drop_outs_do_not_explain_them():
    """Three may fail; also on a wall whose returns are near each other."""
    for missing, expected in ((3, 1), (4, 2)):
        scan = scan_of([[[3.0, -1.0], [3.0, 1.0]]])
        middle = len(scan.ranges) // 2
        scan.ranges[middle : middle + missing] = np.nan
        assert len(_chain_starts(make_sweep(scan, 30.0), CONFIG)) == expected


@pytest.mark.parametrize("turn", TURNS)
def test_grazing_walls_are_followed_in_every_direction(turn):
    """On both sides of a corridor, at 1 degree: 12 m ahead the returns are 2 m apart."""
    for side in (1.0, -1.0):
        wall = [[-1.0, side], [12.0, side]]
        (found,) = segments(scan_at([wall], turn, 1.0), CONFIG)
        assert np.diff(found.extent) > 9.0
        np.testing.assert_allclose(normal_error(found, at(wall, turn))[0], 0.0, atol=1e-9)


# ---------------------------------------------------------------- bridges


def wall_with_gap(low_m, gap, high_m, between=None):
    """How many segments a wall at 3 m is, of which returns between two pieces are missing.

    Pieces reach from ``low_m`` to the gap, and from it to ``high_m``; ``between`` is the range of
    one beam in the gap beyond the wall, m.
    """
    scan = scan_of([[[3.0, low_m], [3.0, high_m]]], step_deg=0.25)
    y = scan.ranges * np.sin(scan.angles)
    scan.ranges[(y > gap[0]) & (y < gap[1])] = np.nan
    if between is not None:
        middle = np.argmin(np.abs(scan.angles - np.arctan2(np.mean(gap), 3.0)))
        scan.ranges[middle] = np.hypot(3.0, np.mean(gap)) * (3.0 + between) / 3.0
    return len(segments(scan, CONFIG))


def test_a_gap_without_returns_is_bridged_if_it_is_shorter_than_the_shorter_piece():
    """Of either side; and always up to `gap_m`, 0.3 m."""
    assert wall_with_gap(-2.0, (0.0, 0.8), 1.7) == 1
    assert wall_with_gap(-2.0, (0.0, 0.8), 1.5) == 2
    assert wall_with_gap(-0.9, (0.0, 0.8), 3.0) == 1
    assert wall_with_gap(-0.7, (0.0, 0.8), 3.0) == 2


@pytest.mark.parametrize("gap_m, low_m", [(0.25, -0.2), (0.35, 0.35)])
def test_a_gap_as_in_a_chain_is_bridged_whatever_the_pieces(gap_m, low_m):
    """Up to `gap_m`, 0.3 m: then a piece of 0.2 m is a part of the wall."""
    scan = scan_of([[[3.0, -0.2], [3.0, 2.0]]], step_deg=0.25)
    y = scan.ranges * np.sin(scan.angles)
    scan.ranges[(y > 0) & (y < gap_m)] = np.nan
    (found,) = segments(scan, CONFIG)
    assert 2.0 - np.diff(found.extent)[0] == pytest.approx(low_m, abs=0.03)


@pytest.mark.parametrize("behind_m, pieces", [(0.08, 1), (0.12, 2), (3.0, 2), (-0.5, 1)])
def test_a_beam_through_a_gap_shows_that_it_is_open(behind_m, pieces):
    """Twice `split_m` beyond the wall, 10 cm; what is before it may hide the wall."""
    assert wall_with_gap(-2.0, (-0.35, 0.35), 2.0, behind_m) == pieces


@pytest.mark.parametrize("returns, kept", [(3, 3), (2, 0)])
def test_three_returns_behind_a_gap_are_a_part_of_the_wall(returns, kept):
    """The end of a wall beside a post; two returns are no piece."""
    scan = scan_of([[[3.0, -1.5], [3.0, 1.5]]], step_deg=0.25)
    last = np.flatnonzero(np.isfinite(scan.ranges))[-1]
    scan.ranges[last - returns - 7 : last - returns + 1] = np.nan
    sweep = make_sweep(scan, 30.0)
    found = find_segments(sweep, CONFIG)
    assert len(found.starts) == 1
    assert np.count_nonzero(sweep.beam[found.rows] > last - returns) == kept


@pytest.mark.parametrize("off_m, pieces", [(0.032, 1), (0.034, 2)])
def test_few_returns_may_scatter_more_than_a_segment(off_m, pieces):
    """Sixteen: two sigmas of their own mean square, 1.7 times the allowed one. They zigzag, so that
    neither a bend nor a step keeps the two pieces apart."""
    rows = np.arange(16)
    sign = np.array([1, -1, -1, 1] * 4)
    points = np.column_stack([3.0 + off_m * sign, 0.06 * (rows - 7.5)])
    sweep = sweep_of(points)
    halves = Returns(sweep.moments, 0.02**2).of(np.array([0, 8]), np.array([7, 15]))
    joined = _merge(Pieces(np.array([0, 8]), np.array([7, 15]), halves), sweep, CONFIG)
    assert len(joined.first) == pieces


@pytest.mark.parametrize("turn", TURNS)
def test_a_door_is_open_in_every_direction(turn):
    """The same beyond a wall that is not seen face on."""
    oblique = np.radians(35.0)
    left, right = (
        np.array(w) @ rotation(oblique).T for w in ([[3, -2], [3, -0.4]], [[3, 0.4], [3, 2]])
    )
    behind = np.array([[6.0, -9.0], [6.0, 9.0]]) @ rotation(oblique).T
    found = segments(scan_at([left, right, behind], turn), CONFIG)
    parts = near(found, at([left[0], right[1]], turn), 1e-6)
    assert len(parts) == 2
    glass = segments(scan_at([left, right], turn), CONFIG)  # nothing behind: it may be glass
    assert len(near(glass, at([left[0], right[1]], turn), 1e-6)) == 1


# ---------------------------------------------------------------- ends


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_wall_that_goes_on_beyond_its_last_return_has_no_end_there(turn, side):
    """At grazing incidence the next return lies on it, tens of metres on. One that ends is a
    segment if what is behind it is not on its line."""
    walls = [[[2.0, side], [60.0, side]], [[-3.0, 4 * side], [12.0, 4 * side]]]
    (found,) = near(segments(scan_at(walls, turn, 1.0), CONFIG), at(walls[0], turn))
    assert found.kind == "line"
    ended = [[[2.0, side], [8.0, side]], walls[1], BEHIND]
    (found,) = near(segments(scan_at(ended, turn, 1.0), CONFIG), at(ended[0], turn))
    assert found.kind == "segment"


@pytest.mark.parametrize(
    "beyond_m, kind",
    [(0.09, "line"), (-0.09, "line"), (0.11, "segment"), (-0.11, "segment")],
)
@pytest.mark.parametrize("turn", TURNS)
def test_a_wall_goes_on_up_to_twice_the_deviation_beside_its_line(turn, beyond_m, kind):
    """Seen up to 29 m at 2 degrees; the return at 1 degree is so far off its line."""
    walls = [[[2.0, 1.0], [60.0, 1.0]], [[-3.0, 4.0], [12.0, 4.0]], [[200.0, -9.0], [200.0, 0.5]]]
    scan = scan_at(walls, turn, 1.0)
    scan.ranges[91] = (1.0 + beyond_m) / np.sin(np.radians(1.0))
    (found,) = near(segments(scan, CONFIG), at(walls[0], turn))
    assert found.kind == kind


@pytest.mark.parametrize("nearer_m, kind", [(0.14, "segment"), (0.17, "line")])
@pytest.mark.parametrize("side", [1, -1])
def test_an_end_is_hidden_by_what_is_nearer_than_a_corner_would_be(nearer_m, kind, side):
    """`_corner_m` at 3 m and half a degree: twice 5 cm and 2.6 cm. On either side of the wall, on
    the first or the second beam beyond."""
    for beams in (1, 2):
        scan = scan_of([[[3.0, -0.5], [3.0, 0.5]], BEHIND])
        on = np.flatnonzero(scan.ranges < 4.0)
        end = on[-1] if side > 0 else on[0]
        for k in range(1, beams):
            scan.ranges[end + side * k] = scan.ranges[end]
        scan.ranges[end + side * beams] = scan.ranges[end] - nearer_m
        scan.ranges[end + side * (beams + 1)] = 15.0
        (found,) = near(segments(scan, CONFIG), [[3.0, -0.5], [3.0, 0.5]])
        assert found.kind == kind


@pytest.mark.parametrize("missing", [1, 2, 3])
@pytest.mark.parametrize("side", [1, -1])
def test_an_end_is_not_known_where_one_of_two_beams_beyond_is_missing(missing, side):
    """The third one is of no concern; nor is a beam outside of the scan known."""
    wall = [[3.0, -0.5], [3.0, 0.5]]
    scan = scan_of([wall, BEHIND])
    on = np.flatnonzero(scan.ranges < 4.0)
    end = on[-1] if side > 0 else on[0]
    scan.ranges[end + side * missing] = np.nan
    (found,) = near(segments(scan, CONFIG), wall)
    assert found.kind == ("line" if missing <= 2 else "segment")


@pytest.mark.parametrize("beams, kind", [(1, "line"), (2, "segment")])
@pytest.mark.parametrize("side", [1, -1])
def test_an_end_needs_two_beams_of_its_scan_beyond_it(beams, kind, side):
    wall = [[3.0, -0.5], [3.0, 0.5]]
    scan = scan_of([wall, BEHIND])
    on = np.flatnonzero(scan.ranges < 4.0)
    part = slice(0, on[-1] + 1 + beams) if side > 0 else slice(on[0] - beams, None)
    cut = make_scan(scan.ranges[part], scan.angles[part][0], scan.angle_step_rad)
    (found,) = near(segments(cut, CONFIG), wall)
    assert found.kind == kind
    # also where another scan goes on with the same range: each has its own border
    both = join_sweeps([make_sweep(cut, 30.0), make_sweep(scan, 30.0), make_sweep(cut, 30.0)])
    seen = find_segments(both, CONFIG)
    on_wall = np.abs(seen.fits.z[:, 0] - 3.0) < 0.1
    assert seen.whole[on_wall].tolist() == [kind == "segment", True, kind == "segment"]


@pytest.mark.parametrize("bend_deg, kinds", [(35, {"line"}), (45, {"segment"})])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_two_walls_that_meet_at_a_shallow_angle_have_no_corner(bend_deg, kinds, side):
    """0.7 rad, 40 degrees: two chords of one curved thing, cut at an arbitrary place."""
    bend = np.radians(bend_deg) * side
    end = np.array([3.0, 0.0]) + 1.2 * np.array([np.sin(bend), np.cos(bend)])
    walls = [[[3.0, -1.2], [3.0, 0.0]], [[3.0, 0.0], end]]
    found = segments(scan_of([*walls, BEHIND], step_deg=0.25), CONFIG)
    on = [o for o in found if o.z[0] < 5]
    assert len(on) == 2 and {o.kind for o in on} == kinds
    # in each scan of a block as in the first
    scan = scan_of([*walls, BEHIND], step_deg=0.25)
    seen = find_segments(join_sweeps([make_sweep(scan, 30.0)] * 3), CONFIG)
    near_by = seen.fits.z[:, 0] < 5
    assert near_by.sum() == 6 and set(seen.whole[near_by].tolist()) == {kinds == {"segment"}}


def test_walls_at_a_shallow_angle_that_do_not_meet_have_their_ends():
    """A step of 1 m between them, or a gap of three beams: two things."""
    bend = np.radians(20.0)
    for offset in ([1.0, 0.02], [0.0, 0.15]):
        begin = np.array([3.0, 0.0]) + offset
        end = begin + 1.2 * np.array([np.sin(bend), np.cos(bend)])
        walls = [[[3.0, -1.2], [3.0, 0.0]], [begin, end], BEHIND]
        found = [o for o in segments(scan_of(walls), CONFIG) if o.z[0] < 6]
        assert len(found) == 2 and found[0].kind == "segment"


# ---------------------------------------------------------------- scans in order


def test_a_circle_is_full_if_half_a_beam_or_less_is_missing():
    """A seam through a wall is moved to the largest jump in range; of a part of a circle it is no
    seam. Returns that are missing or infinite jump to zero."""
    step = np.radians(1.0)
    for beams, is_full in ((360, True), (359, False)):
        r = np.full(beams, 3.0)
        r[100:200] = 5.0
        r[150] = np.inf
        angles = -np.pi + step * np.arange(beams)
        sweep = make_sweep(make_scan(r, -np.pi, step), 30.0)
        start = 150 if is_full else 0
        if is_full:  # to the infinite one, or from it
            assert np.isnan(sweep.ranges[0]) or np.isnan(sweep.ranges[-1])
            assert sorted(sweep.angles.tolist()) == pytest.approx(angles.tolist())
        else:
            np.testing.assert_allclose(sweep.angles, angles)
            np.testing.assert_array_equal(np.flatnonzero(np.isnan(sweep.ranges)), [start + 150])


@pytest.mark.parametrize("missing", [np.nan, np.inf, -np.inf])
def test_a_missing_return_is_a_jump_to_the_laser(missing):
    """5 m to nothing is more than 5 m to a thing 6 cm before the laser."""
    r = np.full(360, 5.0)
    r[150], r[20:40] = missing, 0.06
    sweep = make_sweep(make_scan(r, -np.pi, np.radians(1.0)), 30.0)
    assert np.isnan(sweep.ranges[0]) or np.isnan(sweep.ranges[-1])


def test_returns_at_zero_below_and_at_the_maximum_are_none():
    """A laser says 0 or its maximum for "nothing"; ranges beyond the maximum still tell what is
    free, but no line is fitted to them."""
    sweep = make_sweep(make_scan([-1.0, 0.0, 1.0, 29.9, 30.0, 31.0, np.inf, np.nan]), 30.0)
    np.testing.assert_array_equal(sweep.beam, [2, 3])
    np.testing.assert_array_equal(
        sweep.ranges, [np.nan, np.nan, 1.0, 29.9, 30.0, 31.0, np.nan, np.nan]
    )


def test_scans_that_are_joined_keep_their_beams():
    rng = np.random.default_rng(1)
    scans = [make_scan(rng.uniform(1, 40, n)) for n in (5, 3, 7)]
    sweeps = [make_sweep(scan, 30.0) for scan in scans]
    joined = join_sweeps(sweeps)
    np.testing.assert_array_equal(joined.starts, [0, 5, 8])
    np.testing.assert_array_equal(joined.scan_of_beam, [0] * 5 + [1] * 3 + [2] * 7)
    np.testing.assert_array_equal(joined.ranges[joined.beam], np.hypot(*joined.points.T))
    for k, sweep in enumerate(sweeps):
        np.testing.assert_array_equal(joined.points[joined.scan == k], sweep.points)


# ---------------------------------------------------------------- limits of a line


def fits(length, rms):
    n = len(length)
    return LineFits(
        np.zeros((n, 3)), np.array(length), np.zeros((n, 2, 2)), np.zeros(n), np.array(rms)
    )


def test_a_line_is_valid_up_to_its_limits():
    """`min_length_m`, 0.4 m, and half of `split_m` as root mean square deviation."""
    found = valid_lines(fits([0.39, 0.41, 0.41, 0.41], [0.0, 0.0, 0.024, 0.026]), CONFIG)
    assert found.tolist() == [False, True, True, False]
    assert allowed_rms(CONFIG, 9.0) == 0.025
    assert allowed_rms(replace(CONFIG, split_m=0.0, range_sigma_m=0.0), 9.0) == 5e-5
    assert allowed_rms(replace(CONFIG, range_sigma_m=0.1), 9.0) == pytest.approx(0.125)
    assert [fewest_points(replace(CONFIG, min_points=n)) for n in (1, 4, 9)] == [4, 4, 9]


@pytest.mark.parametrize("covariance", ["incidence", "thesis"])
def test_a_line_is_where_the_middle_of_what_was_seen_is(covariance):
    """Not where most of its returns are, nor the more certain ones."""
    y = np.array([-0.5, -0.4, -0.3, -0.2, -0.1, 0.6, 2.1])
    config = replace(CONFIG, covariance=covariance)
    lines = fit_lines(np.column_stack([np.full(7, 2.0), y]), np.zeros(1, dtype=np.intp), config)
    np.testing.assert_allclose(lines.z[0], [2.0, 0.8, np.pi / 2], atol=1e-12)
    np.testing.assert_allclose(lines.length, 2.6, atol=1e-12)


def test_along_a_line_of_unknown_ends_the_variance_is_that_of_its_length():
    """A uniform distribution over what was seen: finite, and without meaning."""
    y = np.linspace(-1.0, 0.6, 17)
    lines = fit_lines(np.column_stack([np.full(17, 2.0), y]), np.zeros(1, dtype=np.intp), CONFIG)
    (seen,) = observations(lines, np.array([False]), CONFIG)
    assert rotate_cov(seen.cov, -seen.z[2])[0, 0] == pytest.approx(1.6**2 / 12)


@pytest.mark.parametrize("covariance", ["incidence", "thesis"])
def test_a_laser_without_noise_still_has_finite_weights(covariance):
    """0.1 mm: what a setting of zero is taken for."""
    config = replace(
        CONFIG, range_sigma_m=0.0, floor_normal_m=0.0, floor_angle_rad=0.0, covariance=covariance
    )
    y = np.linspace(-1.0, 1.0, 21)
    lines = fit_lines(np.column_stack([np.full(21, 2.0), y]), np.zeros(1, dtype=np.intp), config)
    (seen,) = observations(lines, np.array([True]), config)
    np.testing.assert_allclose(
        normal_cov(seen), 1e-8 * np.diag([1 / 21, 1 / np.sum(y**2)]), rtol=1e-9, atol=1e-20
    )
