"""Cylinders: what is one, what is none, and whether its covariance is honest."""

from dataclasses import replace

import numpy as np
import pytest
from finite_differences import jacobian
from walls import AROUND, cast, make_scan

from graphslam.core.config import FrontEndConfig
from graphslam.core.geometry import wrap
from graphslam.perception.cylinders import (
    OUTLIER_SIGMAS,
    _line_chi2,
    _residuals,
    cylinders,
    fit_circles,
    free_standing_runs,
)
from graphslam.perception.front_ends import FRONT_ENDS
from graphslam.perception.ordered_scan import make_sweep

CONFIG = FrontEndConfig(cylinders=True, range_sigma_m=0.015)
STEP = np.radians(0.5)
ANGLES = -np.pi / 2 + STEP * np.arange(361)
FAR = [[[12.0, -30.0], [12.0, 30.0]]]


def see(circles=(), walls=FAR, sigma=0.0, seed=0, angles=ANGLES):
    """A scan of circles x, y, R and walls; without walls, beams that meet nothing are missing."""
    r = cast(walls, angles) if len(walls) else np.full(len(angles), np.nan)
    r = np.where(np.isnan(r), np.inf, r)
    for x, y, radius in circles:
        delta, rho = angles - np.arctan2(y, x), np.hypot(x, y)
        under = radius**2 - (rho * np.sin(delta)) ** 2
        on = (under > 0) & (np.cos(delta) > 0)
        near = rho * np.cos(delta) - np.sqrt(np.maximum(under, 0.0))
        r = np.where(on, np.minimum(r, near), r)
    r += sigma * np.random.default_rng(seed).normal(size=len(r))
    return make_scan(np.where(np.isfinite(r), r, np.nan), angles[0], angles[1] - angles[0])


def points(scan, config=CONFIG, name="none-lines"):
    front_end = FRONT_ENDS["segments" if name == "none-lines" else name]
    return [o for o in front_end(scan, config) if o.kind == "point"]


@pytest.mark.parametrize("walls", [FAR, []], ids=["wall behind", "nothing behind"])
@pytest.mark.parametrize("x, y, radius", [(3, 0, 0.1), (4, 2, 0.3), (1.5, -1, 0.05), (1, 4.8, 0.2)])
def test_a_cylinder_without_noise_is_found_where_it_is(x, y, radius, walls):
    scan = see([(x, y, radius)], walls)
    (found,) = points(scan)
    assert found.z.shape == (2,) and found.cov.shape == (2, 2) and found.extent is None
    beam = STEP * np.hypot(x, y)  # the edges are known to half a beam, m
    np.testing.assert_allclose(wrap(found.z[0] - np.arctan2(y, x)), 0.0, atol=STEP / 2)
    np.testing.assert_allclose(found.z[1], np.hypot(x, y), atol=beam)


def test_the_radius_is_estimated_with_its_covariance():
    """NEES of (bearing, range, radius) below 3 + tolerance: edges are uniform, not Gaussian."""
    rng = np.random.default_rng(4)
    nees = []
    for seed in range(300):
        rho, beta, radius = rng.uniform(2, 6), rng.uniform(-1, 1), rng.uniform(0.1, 0.4)
        scan = see([(rho * np.cos(beta), rho * np.sin(beta), radius)], sigma=0.015, seed=seed)
        sweep = make_sweep(scan, 30.0)
        first, last = free_standing_runs(sweep, CONFIG)
        fit = fit_circles(sweep, first, last, CONFIG)
        (i,) = np.flatnonzero(np.abs(fit.state[:, 1] - rho) < 0.5)
        e = fit.state[i] - [beta, rho, radius]
        nees.append(e @ np.linalg.solve(fit.cov[i], e) / 3)
    # an edge's sigma is a beam where a uniform's is 0.29 beams: cautious for mixed pixels
    assert 0.3 < np.mean(nees) < 1.15


def test_the_covariance_of_the_centre_is_honest():
    """NIS per degree of freedom between 0.3 and 1.15 over 400 trees, floors at zero.

    Not 1: the edge's sigma covers a lost edge beam (mixed pixels), which this scene has not.
    A range to the near side instead of the centre, or a bearing that leans to one side, is over 5.
    """
    config = FrontEndConfig(cylinders=True, range_sigma_m=0.015, floor_normal_m=0.0)
    rng, nis = np.random.default_rng(2), []
    for seed in range(400):
        rho, beta, radius = rng.uniform(1.5, 8), rng.uniform(-1.2, 1.2), rng.uniform(0.08, 0.4)
        scan = see([(rho * np.cos(beta), rho * np.sin(beta), radius)], [], 0.015, seed)
        for found in points(scan, config):
            e = found.z - [beta, rho]
            nis.append(e @ np.linalg.solve(found.cov, e) / 2)
    assert len(nis) > 330
    assert 0.3 < np.mean(nis) < 1.15


@pytest.mark.parametrize("fewest, found", [(4, 1), (5, 1), (6, 0)])
def test_a_cylinder_needs_as_many_returns_as_the_setting_says(fewest, found):
    """`cylinder_points`; this pole is met by five beams."""
    scan = see([(4.0, 0.0, 0.08)])
    assert np.count_nonzero(scan.ranges < 5) == 5
    assert len(points(scan, replace(CONFIG, cylinder_points=fewest))) == found


def test_a_cylinder_needs_more_space_beside_it_than_the_gap():
    """`gap_m`, 30 cm: 15 cm before a wall a pole is a part of it, 45 cm before it is not."""
    for behind_m, found in ((0.15, 0), (0.45, 1)):
        wall = [[[3.0 + behind_m, -9.0], [3.0 + behind_m, 9.0]]]
        assert len(points(see([(3.0, 0.0, 0.1)], wall))) == found
    near = [[[3.15, -9.0], [3.15, 9.0]]]
    assert len(points(see([(3.0, 0.0, 0.1)], near), replace(CONFIG, gap_m=0.1))) == 1


def test_a_pillar_at_a_wall_and_one_half_hidden_are_not_free_standing():
    assert points(see([(3.0, 0.0, 0.2)], [[[3.1, -9], [3.1, 9]]])) == []
    screen = [[2.0, 0.0], [2.0, 1.0]]
    assert points(see([(4.0, 0.0, 0.3)], [*FAR, screen])) == []


def test_one_at_the_border_of_the_scan_is_not_known():
    assert points(see([(0.05, 4.0, 0.3)])) == []


@pytest.mark.parametrize("turn", np.radians([0.0, 20.0, 45.0]))
@pytest.mark.parametrize("size", [0.4, 0.6])
def test_boxes_and_boards_are_no_cylinders(size, turn):
    """Free-standing as a tree is, and of a tree's width: only the arc tells them apart."""
    c, s = np.cos(turn), np.sin(turn)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * size / 2 @ [[c, s], [-s, c]] + [4, 0]
    box = np.stack((corners, np.roll(corners, -1, axis=0)), axis=1)
    board = corners[[0, 3]]
    wrong = sum(
        len(points(see((), [*FAR, *things], sigma=0.01, seed=seed)))
        for seed in range(20)
        for things in (box, board[None])
    )
    assert wrong <= 2  # of 40


def test_a_wall_with_drop_outs_and_scattered_returns_are_no_cylinders():
    scan = see((), [[[3, -4], [3, 4]]], sigma=0.01)
    scan.ranges[np.random.default_rng(1).random(361) < 0.1] = np.nan
    assert points(scan) == []
    rng = np.random.default_rng(2)
    assert sum(len(points(make_scan(rng.uniform(1, 10, 361), step=STEP))) for _ in range(20)) == 0


@pytest.mark.parametrize("name", ["segments", "hough", "both", "none"])
def test_cylinders_come_with_every_front_end_and_are_no_lines(name):
    scan = see([(2.0, 0.0, 0.45)], sigma=0.005)  # wide enough to pass for a short segment
    found = FRONT_ENDS[name](scan, CONFIG)
    assert [o.kind for o in found].count("point") == (name != "none")
    assert all(o.z[0] > 10 for o in found if o.kind != "point")  # the wall behind only


@pytest.mark.parametrize("radius", [0.02, 0.7])
def test_the_limits_of_the_radius_hold(radius):
    assert points(see([(1.2 + radius, 0.0, radius)])) == []


# ---------------------------------------------------------------- the fit


def fitted(scan, config=CONFIG):
    """The circles of a scan, and the rows where each begins and ends."""
    sweep = make_sweep(scan, 30.0)
    first, last = free_standing_runs(sweep, config)
    return fit_circles(sweep, first, last, config), sweep, first, last


@pytest.mark.parametrize("beta", [0.0, -1.0, 3.1])
@pytest.mark.parametrize("rho, R", [(3.0, 0.1), (2.0, 0.5), (1.2, 1.0)])
def test_residuals_have_their_derivatives(rho, R, beta):
    """Of ranges and of both edges, by bearing, range and radius, across the seam as well: a sign of
    an edge, or the edge of the other side, breaks it."""
    half = np.arcsin(R / rho)
    phi = wrap(beta + 0.7 * half * np.linspace(-1, 1, 9))[None]
    edges = np.array([[beta - half - 0.01, beta + half + 0.02]])
    r, used = np.full((1, 9), rho - R), np.ones((1, 9), dtype=bool)

    def predicted(state):
        return -_residuals(state[None], r, phi, used, edges, 0.02**2, 0.01)[0][0]

    at = np.array([beta, rho, R])
    _, J, w = _residuals(at[None], r, phi, used, edges, 0.02**2, 0.01)
    np.testing.assert_allclose(J[0], jacobian(predicted, at), atol=1e-5)
    np.testing.assert_allclose(w[0], [0.02**-2] * 9 + [0.01**-2] * 2)
    # ranges and edges of the true circle leave nothing
    delta = wrap(phi[0] - beta)
    exact = rho * np.cos(delta) - np.sqrt(R**2 - (rho * np.sin(delta)) ** 2)
    edges = np.array([[beta - half, beta + half]])
    e, _, _ = _residuals(at[None], exact[None], phi, used, edges, 0.02**2, 0.01)
    np.testing.assert_allclose(e, 0.0, atol=1e-12)


def test_beams_that_graze_or_miss_weigh_nothing_and_stay_finite():
    """Also where a step of the fit puts the sensor into the circle; warnings are errors."""
    phi = np.array([[-0.5, 0.0, np.arcsin(0.1 * np.sqrt(1 - 0.19**2)),
                     np.arcsin(0.1 * np.sqrt(1 - 0.21**2)), 0.09]])  # fmt: skip
    used = np.array([[True, True, True, True, False]])
    edges = np.array([[-0.1, 0.1]])
    state = np.array([[0.0, 3.0, 0.3]])
    e, J, w = _residuals(state, np.full((1, 5), 2.7), phi, used, edges, 0.02**2, 0.01)
    np.testing.assert_array_equal(w[0, :-2] > 0, [False, True, False, True, False])
    for R in (0.99, 1.5):
        e, J, w = _residuals(np.array([[0.0, 1.0, R]]), e[:, :-2], phi, used, edges, 0.02**2, 0.01)
        assert np.isfinite(e).all() and np.isfinite(J).all()


@pytest.mark.parametrize("side", [0, -1])
def test_a_mixed_pixel_at_an_edge_does_not_move_the_circle(side):
    """Half way to the wall behind: left out, the others fit as before. In the middle of the run it
    is not: that is no circle."""
    scan = see([(3.0, 0.0, 0.2)], [[[3.4, -9.0], [3.4, 9.0]]])
    on = np.flatnonzero(scan.ranges < 3.05)
    (plain,) = points(scan)
    scan.ranges[on[side]] += 0.1
    circles, _, _, _ = fitted(scan)
    (found,) = points(scan)
    assert OUTLIER_SIGMAS * CONFIG.range_sigma_m < 0.1
    np.testing.assert_allclose(found.z, plain.z, atol=2e-3)
    assert circles.chi2[0] < 3 and circles.dof[0] == len(on) - 1 + 2 - 3
    scan.ranges[on[len(on) // 2]] += 0.1
    assert points(scan) == []


def test_the_fit_has_as_many_degrees_of_freedom_as_ranges_and_edges_leave():
    """Less three; at least one. The squares are over sigma² of ranges, and of a beam for edges."""
    scan = see([(3.0, 0.5, 0.3)], sigma=0.015, seed=3)
    circles, sweep, first, last = fitted(scan)
    (i,) = np.flatnonzero(np.abs(circles.state[:, 1] - 3.04) < 0.3)
    rows = np.arange(first[i], last[i] + 1)
    r, phi = sweep.ranges[sweep.beam[rows]], sweep.angles[sweep.beam[rows]]
    beta, rho, R = circles.state[i]
    s = rho * np.sin(phi - beta)
    used = R**2 - s**2 > (0.2 * R) ** 2
    expected = rho * np.cos(phi - beta) - np.sqrt(np.maximum(R**2 - s**2, 0))
    ranges = (((r - expected)[used] / CONFIG.range_sigma_m) ** 2).sum()
    half = np.arcsin(R / rho)
    edges = np.array([phi[0] - STEP / 2, phi[-1] + STEP / 2]) - (beta + half * np.array([-1, 1]))
    assert circles.dof[i] == used.sum() + 2 - 3
    assert circles.range_chi2[i] == pytest.approx(ranges, rel=1e-6)
    assert circles.chi2[i] == pytest.approx(ranges + ((edges / STEP) ** 2).sum(), rel=1e-6)


def test_the_fit_of_a_single_beam_has_one_degree_of_freedom():
    """One range and two edges, for three unknowns: never less than one, a divisor of chi-square."""
    sweep = make_sweep(see([(3.0, 0.0, 0.2)]), 30.0)
    (middle,) = np.flatnonzero(sweep.beam == 180)
    for n, dof in ((0, 1), (1, 2)):
        fit = fit_circles(sweep, np.array([middle - n]), np.array([middle + n]), CONFIG)
        assert fit.dof.tolist() == [dof]


def test_a_line_through_the_same_returns_is_compared_by_the_same_noise():
    """Least squares of each run alone, the first run of a scan and one behind others."""
    scan = see([(3.0, -1.5, 0.3), (4.0, 1.0, 0.4)], sigma=0.01)
    _, sweep, first, last = fitted(scan)
    found = _line_chi2(sweep, np.append(0, first), np.append(6, last), CONFIG)
    for k, (i, j) in enumerate(zip(np.append(0, first), np.append(6, last), strict=True)):
        own = sweep.points[i : j + 1] - sweep.points[i : j + 1].mean(axis=0)
        least = np.linalg.svd(own, compute_uv=False)[1] ** 2
        assert found[k] == pytest.approx(least / CONFIG.range_sigma_m**2, rel=1e-6)


def test_the_floor_is_added_to_range_and_across():
    """`floor_normal_m`, of the material: across the beam it is an angle at that range."""
    scan = see([(4.0, 2.0, 0.3)])
    (found,), (bare,) = (
        points(scan, replace(CONFIG, floor_normal_m=floor)) for floor in (0.1, 0.0)
    )
    np.testing.assert_allclose(
        found.cov - bare.cov, np.diag([0.1**2 / found.z[1] ** 2, 0.1**2]), atol=1e-12
    )


def test_a_cylinder_on_the_seam_of_a_full_circle_is_one():
    """Straight behind, where angles jump by a turn; its edges too are one beam beyond."""
    angles = AROUND
    scan = see([(-3.0, 0.05, 0.4), (2.0, 2.0, 0.4)], angles=angles)
    found = points(scan)
    assert len(found) == 2
    (behind,) = (o for o in found if abs(wrap(o.z[0] - np.pi)) < 0.1)
    np.testing.assert_allclose(wrap(behind.z[0] - np.arctan2(0.05, -3.0)), 0.0, atol=0.01)
    np.testing.assert_allclose(behind.z[1], np.hypot(3, 0.05), atol=0.05)


# ---------------------------------------------------------------- which runs stand free


def runs(ranges, config=CONFIG):
    """First and last beam of each run of a scan with beams a degree apart."""
    sweep = make_sweep(make_scan(ranges), 30.0)
    first, last = free_standing_runs(sweep, config)
    return list(zip(sweep.beam[first].tolist(), sweep.beam[last].tolist(), strict=True))


@pytest.mark.parametrize("missing, is_free", [(3, False), (4, True)])
def test_a_run_beside_missing_returns_stands_free_where_drop_outs_do_not_explain_them(
    missing, is_free
):
    """Three beams may fail; a fourth shows that nothing is there. Both sides, and the border."""
    r = np.full(181, np.nan)
    r[60:66] = 2.0
    assert runs(r) == [(60, 65)]
    nearer = r.copy()
    nearer[60 - missing - 1] = 1.5
    assert runs(nearer) == ([(60, 65)] if is_free else [])
    nearer = r.copy()
    nearer[65 + missing + 1] = 1.5
    assert runs(nearer) == ([(60, 65)] if is_free else [])
    at_border = np.full(181, np.nan)
    at_border[missing : missing + 6] = 2.0
    assert runs(at_border) == ([(missing, missing + 5)] if is_free else [])
    assert runs(at_border[::-1]) == ([(175 - missing, 180 - missing)] if is_free else [])


@pytest.mark.parametrize("behind_m, is_free", [(0.1, False), (0.2, True), (-0.5, False)])
@pytest.mark.parametrize("beam", [56, 69])
def test_a_run_stands_free_if_its_neighbours_are_behind_it(behind_m, is_free, beam):
    """By half of `gap_m` in range, 15 cm, where they are more than the gap away: here 0.35 m, on
    the next beam but two, which is no gap of missing returns."""
    r = np.full(181, np.nan)
    r[60:66], r[beam] = 5.0, 5.0 + behind_m
    assert ((60, 65) in runs(r)) is is_free


@pytest.mark.parametrize("radius, is_wide", [(0.10, True), (0.12, False)])
def test_a_run_wider_than_the_largest_cylinder_is_none(radius, is_wide):
    """Six beams at 2.5 m are 0.22 m apart: `cylinder_max_radius_m` is half of what may be."""
    r = np.full(181, np.nan)
    r[60:66] = 2.5
    config = replace(CONFIG, cylinder_max_radius_m=radius)
    assert runs(r, config) == ([] if is_wide else [(60, 65)])


@pytest.mark.parametrize("gap_m", [0.0, 0.05, 0.3])
def test_a_run_at_the_border_of_a_scan_is_not_free_whatever_the_gap(gap_m):
    """What is beyond is not known."""
    r = np.full(181, np.nan)
    r[:6] = 1.0
    assert runs(r, replace(CONFIG, gap_m=gap_m)) == []
    assert runs(r[::-1], replace(CONFIG, gap_m=gap_m)) == []


def test_no_run_is_free_in_a_scan_of_too_few_returns():
    r = np.full(181, np.nan)
    r[60:63] = 2.0
    assert runs(r) == []
    r[63] = 2.0
    assert runs(r) == [(60, 63)]


def test_the_returns_of_a_cylinder_are_taken_out_and_no_others():
    """Of the points; the ranges stay, since they tell what is hidden."""
    scan = see([(2.0, 0.0, 0.3)], sigma=0.0)
    sweep = make_sweep(scan, 30.0)
    seen, left = cylinders(sweep, CONFIG)
    assert len(seen) == 1
    near = sweep.ranges[sweep.beam] < 3.0
    np.testing.assert_array_equal(left.beam, sweep.beam[~near])
    np.testing.assert_array_equal(left.points, sweep.points[~near])
    np.testing.assert_array_equal(left.ranges, sweep.ranges)
