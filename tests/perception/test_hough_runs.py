"""Runs of returns along a Hough line: where they begin and end, and which of them fit the line."""

from dataclasses import replace

import numpy as np
import pytest
from test_chains_and_ends import sweep_of
from walls import scan_of

from graphslam.core.config import FrontEndConfig
from graphslam.perception.hough import (
    BLOCK_POINTS,
    FLATNESS,
    RUN_GATE,
    _blocks,
    _borders,
    _fit,
    _fitting_runs,
    find_lines,
    line_observations,
)
from graphslam.perception.hough_votes import SEED_POINTS, OpenCvVotes, ThesisVotes
from graphslam.perception.line_moments import (
    fitted_line,
    fitted_lines,
    mean_square,
    offset_lines,
    point_moments,
)
from graphslam.perception.ordered_scan import make_sweep
from graphslam.perception.segments import Segments, allowed_rms, find_segments
from graphslam.perception.segments_and_hough import _remaining_segments

CONFIG = FrontEndConfig(range_sigma_m=0.01)
#: the line x = 4, and its direction
WALL, UP = offset_lines(np.array([4.0]), np.array([0.0]))[:, 0], np.pi / 2


def column(low_m, high_m, count, x=4.0):
    """Returns (count, 2) one above the other."""
    return np.column_stack([np.full(count, x), np.linspace(low_m, high_m, count)])


def fitting(*parts, config=CONFIG):
    """Which of the parts' returns near the wall are in runs that fit it: how many of each part."""
    sweep = sweep_of(np.concatenate(parts))
    rows = np.flatnonzero(WALL @ sweep.moments <= 0.05**2)
    kept = _fitting_runs(rows, WALL, UP, sweep, config)
    part = np.repeat(np.arange(len(parts)), [len(p) for p in parts])
    return np.bincount(part[kept], minlength=len(parts)).tolist()


# ---------------------------------------------------------------- lines as moments


def test_moments_give_the_mean_square_deviation_from_any_line():
    """As the returns themselves do; the fitted line is that of least deviation."""
    rng = np.random.default_rng(3)
    points = rng.normal([2.0, -1.0], [1.0, 0.2], size=(30, 2))
    moments = point_moments(points).sum(axis=1, keepdims=True)
    d, gamma = np.array([0.7]), np.array([2.1])
    off = points @ np.array([np.cos(2.1), np.sin(2.1)]) - 0.7
    found = mean_square(offset_lines(d, gamma), moments)
    np.testing.assert_allclose(found, np.mean(off**2), rtol=1e-12)
    centred = points - points.mean(axis=0)
    least = np.linalg.svd(centred, compute_uv=False)[1] ** 2 / 30
    np.testing.assert_allclose(mean_square(fitted_lines(moments), moments), least, rtol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_one_fitted_line_is_that_of_many(seed):
    """And its direction is that of its returns, modulo half a turn."""
    rng = np.random.default_rng(seed)
    turn = rng.uniform(-np.pi, np.pi)
    along = np.array([np.cos(turn), np.sin(turn)])
    points = rng.normal(size=2) + rng.normal(size=(20, 1)) * along
    moments = point_moments(points).sum(axis=1)
    line, direction = fitted_line(moments)
    np.testing.assert_allclose(line, fitted_lines(moments[:, None])[:, 0], atol=1e-12)
    assert abs(np.sin(direction - turn)) < 1e-9


# ---------------------------------------------------------------- runs and blocks


def test_blocks_divide_runs_evenly():
    """Of at most sixteen returns; a block does not reach into the next run."""
    assert BLOCK_POINTS == 16
    found = _blocks(np.array([0, 5, 21, 38, 102]))
    assert found.tolist() == [0, 5, 21, 29, 38, 54, 70, 86]
    sizes = np.diff(np.append(found, 102))
    assert sizes.max() <= BLOCK_POINTS


@pytest.mark.parametrize("between, expected", [(0, 1), (1, 2)])
def test_a_run_ends_at_a_gap_in_which_other_returns_are(between, expected):
    """0.5 m at 4 m. At grazing incidence the next return of the same wall is as far away."""
    parts = [column(-1.0, 0.0, 20), *[[[2.0, 0.15]]] * between, column(0.55, 1.5, 20)]
    sweep = sweep_of(np.concatenate(parts))
    on = np.flatnonzero(sweep.points[:, 0] == 4.0)
    assert len(_borders(on, UP, sweep, CONFIG)) == expected + 1
    near = sweep_of(np.concatenate([*parts[:-1], column(0.45, 1.5, 20)]))
    assert _borders(on, UP, near, CONFIG).tolist() == [0, 40]


@pytest.mark.parametrize("missing, expected", [(3, 1), (4, 2)])
def test_a_run_ends_at_a_gap_of_missing_returns(missing, expected):
    sweep = sweep_of(np.concatenate([column(-1.0, 0.0, 20), column(0.55, 1.5, 20)]))
    beam = np.arange(40) + missing * (np.arange(40) >= 20)
    r = np.full(40 + missing, np.nan)
    r[beam] = sweep.ranges
    sweep = replace(sweep, beam=beam, ranges=r, angles=np.zeros(40 + missing))
    borders = _borders(np.arange(40), UP, sweep, CONFIG)
    assert borders.tolist() == ([0, 40] if expected == 1 else [0, 20, 40])


def test_parts_fit_a_line_by_their_excess_over_their_own_line():
    """Two divisions of the same returns at once, each part as computed alone: excess of the mean
    square deviation, an allowance, and the noise along the normal of its own beams."""
    rng = np.random.default_rng(2)
    points = np.concatenate([column(-2, 0, 30), column(0, 2, 30, 4.016)])
    points[:, 0] += 0.01 * rng.normal(size=60)
    sweep, rows = sweep_of(points), np.arange(60)
    divisions = [0, 10, 20, 30, 31, 45], [0, 2, 30]
    found = _fit(rows, np.concatenate(divisions), WALL, sweep, CONFIG)
    expected = []
    for starts in divisions:
        for i, j in zip(starts, [*starts[1:], 60], strict=True):
            own = points[i:j]
            deviation = np.mean((own[:, 0] - 4.0) ** 2)
            centred = own - own.mean(axis=0)
            least = max(np.linalg.eigvalsh(centred.T @ centred)[0], 0.0) / len(own)
            noise = np.mean((CONFIG.range_sigma_m * 4.0 / np.hypot(*own.T)) ** 2)
            limit = FLATNESS * allowed_rms(CONFIG, 16.0) ** 2 + RUN_GATE * noise / len(own)
            expected.append(bool(deviation - least <= limit and len(own) >= 3))
    assert found.tolist() == expected
    assert 0 < sum(expected) < len(expected)


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("count", [30, 400])
def test_a_long_run_must_fit_as_a_whole_where_each_of_its_blocks_does(order, count):
    """12 mm off: 64 returns show it, 16 do not. The other run stays, first or last; many returns on
    the line do not make up for a run that is not."""
    wall, post, off = column(-3, -1, count), np.array([[2.0, 0.0]]), column(1, 3, 64, 4.012)

    def kept(*parts):
        if order > 0:
            return fitting(*parts)
        return fitting(*((part * [1, -1])[::-1] for part in parts[::-1]))[::-1]

    assert kept(wall, post, off) == [count, 0, 0]
    assert kept(wall, post, off[::4]) == [count, 0, 16]


def test_of_a_run_of_two_things_the_one_off_the_line_is_left_out():
    """Side by side, without a gap: the blocks of 3 cm off do not fit, the others stay."""
    wall, front = column(-2, 0, 32), column(0.05, 2, 32, 3.97)
    assert fitting(wall, front) == [32, 0]
    assert fitting(front * [1, -1], wall * [1, -1]) == [0, 32]
    assert fitting(wall, column(0.05, 2, 32)) == [32, 32]


def test_one_or_two_returns_beside_a_wall_are_no_run():
    """Where another wall crosses its line."""
    for count, kept in ((2, 0), (3, 3)):
        crossing = column(0.9, 1.1, count)
        parts = column(-3, -1, 30), [[2.0, 0.0]], crossing, [[2.0, 0.9]], column(2, 3, 20)
        assert fitting(*parts) == [30, 0, kept, 0, 20]


# ---------------------------------------------------------------- lines of a scan


@pytest.mark.parametrize("votes", ["opencv", "thesis"])
def test_lines_are_where_they_begin_in_the_rows(votes):
    """Two walls: each one's returns follow each other in the order of the beams."""
    scan = scan_of([[[4.0, -3.0], [4.0, 0.5]], [[6.0, 1.5], [3.0, 4.5]]])
    sweep = make_sweep(scan, 30.0)
    config = replace(CONFIG, hough_votes=votes)
    rows, starts = find_lines(sweep, np.ones(len(sweep.beam), bool), config)
    assert len(starts) == 2 and starts[0] == 0
    for part in np.split(rows, starts[1:]):
        assert (np.diff(part) > 0).all()
        x, y = sweep.points[part].T
        assert np.allclose(x, 4.0) or np.allclose(x + y, 7.5)
    _, used = line_observations(sweep, rows, starts, config)
    assert sorted(used.tolist()) == sorted(rows.tolist())
    # a line that is too short is none, and its returns are not used
    seen, used = line_observations(sweep, rows, starts, replace(config, min_length_m=3.7))
    assert len(seen) == 1 and 0 < len(used) < len(rows)
    none, starts = find_lines(sweep, np.zeros(len(sweep.beam), bool), config)
    assert len(none) == len(starts) == 0


@pytest.mark.parametrize("off_m, is_kept", [(0.045, True), (0.055, False)])
def test_a_return_belongs_to_a_line_up_to_split_m(off_m, is_kept):
    """One of a wall's fifty: what is farther is a thing in front of it."""
    sweep = make_sweep(scan_of([[[4.0, -2.0], [4.0, 2.0]]]), 30.0)
    one = len(sweep.beam) // 2
    sweep.points[one] *= 1 - off_m / sweep.points[one, 0]
    rows, starts = find_lines(sweep, np.ones(len(sweep.beam), bool), CONFIG)
    assert len(starts) == 1 and (one in rows) is is_kept


@pytest.mark.parametrize("points, is_found", [(6, True), (5, False)])
def test_a_hough_line_needs_as_many_returns_as_a_segment(points, is_found):
    """`min_points`, of those that are free."""
    sweep = make_sweep(scan_of([[[4.0, -1.0], [4.0, 1.0]]]), 30.0)
    free = np.zeros(len(sweep.beam), bool)
    free[:points] = True
    config = replace(CONFIG, hough_threshold_m=0.0)
    rows, starts = find_lines(sweep, free, config)
    assert len(starts) == is_found and len(rows) == points * is_found


def test_the_threshold_is_metres_of_wall():
    """Weights are the range times the angle between beams: half as many beams, the same length."""
    for step_deg in (0.5, 1.0):
        sweep = make_sweep(scan_of([[[4.0, -0.5], [4.0, 0.5]]], step_deg=step_deg), 30.0)
        free = np.ones(len(sweep.beam), bool)
        for threshold, lines in ((0.85, 1), (1.15, 0)):
            config = replace(CONFIG, hough_threshold_m=threshold)
            assert len(find_lines(sweep, free, config)[1]) == lines


# ---------------------------------------------------------------- votes


@pytest.mark.parametrize("threshold_m", [0.0, 0.4])
@pytest.mark.parametrize("votes", [OpenCvVotes, ThesisVotes])
def test_votes_that_were_removed_do_not_come_back(votes, threshold_m):
    """Removed twice or once, in a stripe or outside of the table: the rest votes as if alone, and
    without a threshold too there is an end."""
    far = np.column_stack([np.full(20, 30.0), np.linspace(-5, 5, 20)])
    points = np.concatenate([column(-1, 1, 40), column(-1, 1, 30, 6.0), far])
    config = FrontEndConfig(hough_d_max_m=10.0, hough_threshold_m=threshold_m)
    found = votes(points, np.ones(90), np.ones(90, bool), config)
    assert set(found.peak()) == set(range(40))
    found.remove(np.arange(40))
    found.remove(np.concatenate([np.arange(30, 40), np.arange(70, 90)]))
    assert set(found.peak()) == set(range(40, 70))
    found.remove(np.arange(40, 68))
    assert SEED_POINTS == 3
    assert not len(found.peak())


@pytest.mark.parametrize("turn", np.radians([0.0, 45.0, 135.0, 180.0, -90.0]))
def test_a_stripe_of_the_table_is_as_wide_as_the_setting_says(turn):
    """`hough_delta_d_m`, 5 cm here: rows of returns 4 cm apart are in one, those 6 cm apart are
    not; in every direction."""
    config = FrontEndConfig(hough_delta_d_m=0.05)
    c, s = np.cos(turn), np.sin(turn)
    for apart, together in ((0.04, True), (0.06, False)):
        rows = [column(-0.3, 0.3, 40, 3.0 + x) for x in (-apart / 2, apart / 2)]
        points = np.concatenate(rows) @ np.array([[c, s], [-s, c]])
        found = ThesisVotes(points, np.ones(80), np.ones(80, bool), config).peak()
        assert (len(found) == 80) is together


# ---------------------------------------------------------------- segments beside them


def test_a_cut_segment_stays_if_half_of_its_returns_are_left():
    """And enough of them for a line; those that were whole, or no lines, are not asked."""
    rows, starts = np.arange(50), np.array([0, 10, 20, 30, 40])
    free = np.ones(50, bool)
    free[[*range(0, 5), *range(10, 16), *range(20, 22)]] = False
    whole, valid = np.zeros(5, bool), np.ones(5, bool)
    whole[3], valid[4] = True, False
    found = Segments(rows, starts, None, whole, valid)
    left, begin = _remaining_segments(found, free, replace(CONFIG, min_points=5))
    assert left.tolist() == [5, 6, 7, 8, 9, *range(22, 30)]
    assert begin.tolist() == [0, 5]
    left, _ = _remaining_segments(found, free, replace(CONFIG, min_points=6))
    assert left.tolist() == list(range(22, 30))


def test_segments_say_which_returns_are_theirs():
    """Rows from each start, in the order of the beams; all of them near their own line."""
    sweep = make_sweep(scan_of([[[4.0, -3.0], [4.0, 1.0]], [[4.0, 1.0], [2.0, 3.0]]]), 30.0)
    found = find_segments(sweep, CONFIG)
    assert len(found.starts) == 2
    counts = np.diff(np.append(found.starts, len(found.rows)))
    assert counts.min() > 20 and len(set(found.rows.tolist())) == len(found.rows)
    first, second = np.split(found.rows, found.starts[1:])
    np.testing.assert_allclose(sweep.points[first, 0], 4.0, atol=1e-9)
    np.testing.assert_allclose(sweep.points[second].sum(axis=1), 5.0, atol=1e-9)
