"""Planar geometry: group laws, exactness near zero, derivatives."""

from fractions import Fraction
from math import comb, factorial

import numpy as np
import pytest
from finite_differences import jacobian
from hypothesis import given
from hypothesis import strategies as st

from graphslam.core import geometry
from graphslam.core.geometry import (
    adjoint,
    are_positive,
    between,
    chained,
    compose,
    compose_cov,
    compose_jacobians,
    exp,
    exp_jacobian,
    interpolate,
    inverse,
    inverse_cov,
    is_positive,
    log,
    log_jacobian,
    path_length,
    polar_points,
    rotate_cov,
    transform,
    transform_each,
    wrap,
)

#: coordinates reach 1e3 m, where one rounding is 1e-13; three poses in a chain round ten times
CHAIN = 1e-11
#: finite differences of functions of size ten, see `finite_differences.STEP`; a wrong entry is 1e-2
DIFFERENCES = 1e-8
SMALL = [0.0, 1e-300, 1e-20, 1e-12, 1e-9, 1e-6, 1e-3, 0.0999, 0.1001, 0.2999, 0.3001, 1.0]

lengths = st.floats(-1e3, 1e3)
near_lengths = st.floats(-10, 10)
headings = st.floats(-3.14, 3.14)


def triples(length, heading):
    return st.tuples(length, length, heading).map(np.array)


poses = triples(lengths, headings)
near_poses = triples(near_lengths, st.floats(-3.0, 3.0))


def same(a, b, tolerance=CHAIN):
    """Poses agree; headings modulo a turn, since -pi and pi are one direction."""
    a, b = np.asarray(a), np.asarray(b)
    np.testing.assert_allclose(a[..., :2], b[..., :2], atol=tolerance, rtol=0)
    np.testing.assert_allclose(wrap(a[..., 2] - b[..., 2]), 0, atol=tolerance, rtol=0)


# ------------------------------------------------------------ wrap


@given(st.floats(-3.1415926, 3.1415926))
def test_wrap_returns_angles_inside_to_the_digit(angle):
    """Breaks with (a + pi) % 2 pi - pi, which leaves nothing of 1e-17 rad."""
    assert wrap(angle) == angle


@given(st.floats(-1e4, 1e4))
def test_wrap_lands_in_one_turn_and_changes_by_whole_turns(angle):
    rounding = 4 * np.spacing(
        abs(angle) + np.pi
    )  # the turns taken away round like the angle itself
    wrapped = float(wrap(angle))
    assert -np.pi - rounding <= wrapped <= np.pi + rounding
    turns = (angle - wrapped) / (2 * np.pi)
    assert abs(turns - round(turns)) < 1e-11  # 1e4 rad are 1.6e3 turns: 1e-12 of rounding


def test_wrap_of_half_a_turn_is_minus_pi():
    """One name for the direction straight back, whichever way it was reached."""
    np.testing.assert_array_equal(wrap([np.pi, -np.pi]), [-np.pi, -np.pi])


# ------------------------------------------------------------ the group


@given(poses)
def test_inverse_undoes_from_both_sides(a):
    same(compose(a, inverse(a)), np.zeros(3))
    same(compose(inverse(a), a), np.zeros(3))
    same(inverse(inverse(a)), a)


@given(poses, poses)
def test_between_is_what_compose_adds(a, b):
    same(compose(a, between(a, b)), b)
    same(between(a, compose(a, b)), b)


@given(poses)
def test_between_of_equal_poses_is_exactly_zero(a):
    """A standing robot's odometry must read as no motion at all, 1 km from its origin as well;
    compose(inverse(a), a) leaves 1e-13 m."""
    np.testing.assert_array_equal(between(a, a), 0)


@given(poses, poses, poses)
def test_compose_is_associative(a, b, c):
    same(compose(compose(a, b), c), compose(a, compose(b, c)))


@given(poses, poses)
def test_transform_moves_points_as_compose_moves_positions(a, b):
    np.testing.assert_allclose(transform(a, b[None, :2])[0], compose(a, b)[:2], atol=CHAIN)


@pytest.mark.parametrize("shapes", [((4, 1, 3), (5, 3)), ((4, 3), (4, 3)), ((3, 3), (3,))])
@pytest.mark.parametrize("name", ["compose", "between", "inverse", "exp", "log"])
def test_leading_axes_broadcast(name, shapes):
    """A stack gives what its members give one by one, also of three, which is as wide as long."""
    rng = np.random.default_rng(3)
    a, b = (rng.normal(size=shape) for shape in shapes)
    function = getattr(geometry, name)
    arguments = (a, b) if name in ("compose", "between") else (a,)
    together = function(*arguments)
    for index in np.ndindex(together.shape[:-1]):
        parts = [np.broadcast_to(p, together.shape)[index] for p in arguments]
        np.testing.assert_array_equal(together[index], function(*parts))


def test_points_are_moved_each_by_its_own_pose():
    rng = np.random.default_rng(5)
    poses, points = rng.normal(size=(6, 3)), rng.normal(size=(6, 2))
    expected = [transform(pose, point[None])[0] for pose, point in zip(poses, points, strict=True)]
    np.testing.assert_allclose(transform_each(poses, points), expected, atol=1e-15)


def test_ranges_and_bearings_are_points_counter_clockwise_from_ahead():
    found = polar_points(np.array([2.0, 3.0, 1.0]), np.radians([0.0, 90.0, -135.0]))
    expected = [[2.0, 0.0], [0.0, 3.0], [-np.sqrt(0.5), -np.sqrt(0.5)]]
    np.testing.assert_allclose(found, expected, atol=1e-15)
    bearings = np.arange(6.0).reshape(2, 3)
    stack = polar_points(np.ones((2, 3)), bearings)
    np.testing.assert_array_equal(stack, np.dstack([np.cos(bearings), np.sin(bearings)]))


def test_the_length_of_a_path_is_summed_up_to_each_pose():
    """Of poses the heading is no length."""
    path = np.array([[0.0, 0, 0], [3, 4, 2], [3, 4, -1], [3, 2, 0]])
    for columns in (2, 3):
        np.testing.assert_allclose(path_length(path[:, :columns]), [0, 5, 5, 7], atol=1e-15)


@pytest.mark.parametrize("function", [exp, log])
@pytest.mark.parametrize("turn", [np.nan, np.inf, -np.inf])
def test_a_turn_that_is_not_finite_comes_out_as_nan(function, turn):
    """As for stacks, and not as an exception of `math`: an optimiser that diverged is told apart
    by its values."""
    assert np.isnan(function(np.array([1.0, 2.0, turn]))).all()


# ------------------------------------------------------------ exponential and logarithm


@given(poses)
def test_log_then_exp_is_the_pose(pose):
    same(exp(log(pose)), pose)


@given(triples(lengths, st.floats(-3.1, 3.1)))
def test_exp_then_log_is_the_twist(twist):
    """Up to 3.1 rad: at half a turn the position no longer determines the twist well."""
    np.testing.assert_allclose(log(exp(twist)), twist, atol=CHAIN)


def exact_terms(omega):
    """sin w/w, (1 - cos w)/w and their derivatives as exact sums of 15 terms, |w| <= 1."""
    w, terms = Fraction(omega), range(15)
    sign = [(-1) ** k for k in terms]
    a = sum(sign[k] * w ** (2 * k) / factorial(2 * k + 1) for k in terms)
    b = sum(sign[k] * w ** (2 * k + 1) / factorial(2 * k + 2) for k in terms)
    da = sum(sign[k] * 2 * k * w ** (2 * k - 1) / factorial(2 * k + 1) for k in terms if k)
    db = sum(sign[k] * (2 * k + 1) * w ** (2 * k) / factorial(2 * k + 2) for k in terms)
    return [float(value) for value in (a, b, da, db)]


@pytest.mark.parametrize("omega", [*SMALL, *(-w for w in SMALL)])
def test_exp_is_exact_near_zero_turning(omega):
    """Thesis 2.11-2.12; (1 - cos w)/w as written gives 0 below 1e-8."""
    a, b, _, _ = exact_terms(omega)
    # three roundings of 1.1e-16 and the error of sin, half a unit in the last place
    np.testing.assert_allclose(exp(np.array([1.0, 0.0, omega])), [a, b, omega], rtol=5e-16)
    np.testing.assert_allclose(exp(np.array([0.0, 1.0, omega])), [-b, a, omega], rtol=5e-16)


@pytest.mark.parametrize("omega", [*SMALL, *(-w for w in SMALL)])
def test_exp_jacobian_is_exact_near_zero_and_on_both_sides_of_its_switch(omega):
    """Series below 0.3 rad, closed form above; too few terms or a late switch break it."""
    a, b, da, db = exact_terms(omega)
    expected = [[a, -b, 2 * da - 3 * db], [b, a, 2 * db + 3 * da], [0, 0, 1]]
    # the closed form divides a difference of terms of size w² by w²: 1e-16 / 0.3² at the switch
    np.testing.assert_allclose(
        exp_jacobian(np.array([2.0, 3.0, omega])), expected, rtol=1e-13, atol=1e-14
    )


@pytest.mark.parametrize("omega", [0.05, 0.15, 0.25, 0.2999, -0.2999])
def test_the_series_of_exp_jacobian_are_exact_to_the_last_digits(omega):
    """Each by itself, in which a coefficient that is a hundredth off shows."""
    _, _, da, db = exact_terms(omega)
    found = exp_jacobian(np.array([1.0, 0.0, omega]))[:2, 2]
    np.testing.assert_allclose(found, [da, db], rtol=5e-16)


def bernoulli(n):
    """The Bernoulli number B_n."""
    known = [Fraction(1)]
    for m in range(1, n + 1):
        known.append(-sum(comb(m + 1, k) * known[k] for k in range(m)) / (m + 1))
    return known[n]


@pytest.mark.parametrize("phi", [0.01, 0.05, 0.0999, 0.1001, 0.2, 0.29, 0.5, 1.0])
def test_log_jacobian_is_exact_on_both_sides_of_its_switch(phi):
    """(phi/2) cot(phi/2) and its derivative: sums over Bernoulli numbers, 20 terms for 1 rad."""
    w = Fraction(phi)
    even = [(k, (-1) ** k * bernoulli(2 * k) / factorial(2 * k)) for k in range(20)]
    c = float(sum(b * w ** (2 * k) for k, b in even))
    dc = float(sum(b * 2 * k * w ** (2 * k - 1) for k, b in even if k))
    found = log_jacobian(np.array([1.0, 0.0, phi]))
    expected = [[c, phi / 2, dc], [-phi / 2, c, -0.5], [0, 0, 1]]
    # the closed form is a difference of numbers of size 1/phi, below that the term left out
    np.testing.assert_allclose(found, expected, rtol=2e-13)
    np.testing.assert_allclose(
        log_jacobian(np.array([0.0, 1.0, phi]))[:2, 2], [0.5, dc], rtol=2e-13
    )


@given(near_poses)
def test_exp_jacobian_equals_finite_differences(twist):
    np.testing.assert_allclose(exp_jacobian(twist), jacobian(exp, twist), atol=DIFFERENCES)


@given(near_poses)
def test_log_jacobian_equals_finite_differences(pose):
    np.testing.assert_allclose(log_jacobian(pose), jacobian(log, pose), atol=DIFFERENCES)


@given(near_poses)
def test_log_jacobian_inverts_exp_jacobian(twist):
    product = log_jacobian(exp(twist)) @ exp_jacobian(twist)
    # entries reach 10 m times 1/sinc(1.5 rad)² = 2, and sums of three round five times
    np.testing.assert_allclose(product, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("phi", [0.0, 1e-12, 1e-6, 0.0999999, 0.1000001, -0.0999999, -0.1000001])
def test_log_jacobian_has_no_step_where_its_series_ends(phi):
    """Too few terms of the series below 0.1 rad break it (and the lever arm of 1 km shows it)."""
    pose = np.array([1e3, -2e3, phi])
    product = log_jacobian(pose) @ exp_jacobian(log(pose))
    np.testing.assert_allclose(product, np.eye(3), atol=1e-10)  # 1e-14 of the closed form x 2e3 m


# ------------------------------------------------------------ derivatives and covariances


@given(near_poses, near_poses)
def test_compose_jacobians_equal_finite_differences(a, b):
    """Thesis 4.7: a wrong sign of a sine shows here."""

    def unwrapped(a, b):
        """Without the jump of the heading at half a turn."""
        moved = compose(a, b)
        return np.array([moved[0], moved[1], a[2] + b[2]])

    F, W = compose_jacobians(a, b)
    np.testing.assert_allclose(F, jacobian(lambda v: unwrapped(v, b), a), atol=DIFFERENCES)
    np.testing.assert_allclose(W, jacobian(lambda v: unwrapped(a, v), b), atol=DIFFERENCES)


def test_compose_cov_equals_monte_carlo():
    """Frames confused (b's covariance taken along world axes) break it."""
    rng = np.random.default_rng(7)
    a, b = np.array([1.0, 2.0, 2.2]), np.array([3.0, -1.0, 0.4])
    cov_a, cov_b = np.diag([4e-4, 1e-4, 1e-5]), np.diag([9e-4, 1e-6, 4e-5])
    n = 40_000
    ends = compose(rng.multivariate_normal(a, cov_a, n), rng.multivariate_normal(b, cov_b, n))
    cov = compose_cov(a, cov_a, b, cov_b)
    d = np.diag(cov)
    sampling = np.sqrt((np.outer(d, d) + cov**2) / n)  # sigma of a sample covariance's entry
    assert np.all(np.abs(np.cov(ends.T) - cov) < 5 * sampling)


@given(near_poses)
def test_inverse_cov_is_that_of_the_inverse(a):
    """Against finite differences; along the axes of a, not of its parent."""
    root = np.array([[0.3, 0.0, 0.0], [0.1, 0.2, 0.0], [-0.1, 0.3, 0.1]])

    def unwrapped(pose):
        moved = inverse(pose)
        return np.array([moved[0], moved[1], -pose[2]])

    J = jacobian(unwrapped, a)
    np.testing.assert_allclose(
        inverse_cov(a, root @ root.T), J @ root @ root.T @ J.T, atol=100 * DIFFERENCES
    )


@given(near_poses, near_poses)
def test_adjoint_takes_a_twist_from_the_body_to_the_origin(a, twist):
    """exp(Ad(a) xi) a = a exp(xi): one motion, told in two frames."""
    same(compose(exp(adjoint(a) @ twist), a), compose(a, exp(twist)))


@given(st.floats(-7, 7), st.integers(0, 1000))
def test_rotate_cov_turns_back_and_keeps_eigenvalues(angle, seed):
    root = np.random.default_rng(seed).normal(size=(3, 3))
    cov = root @ root.T
    turned = rotate_cov(cov, angle)
    # entries reach 30: ten roundings of 4e-15
    np.testing.assert_allclose(rotate_cov(turned, -angle), cov, atol=1e-12)
    np.testing.assert_allclose(np.linalg.eigvalsh(turned), np.linalg.eigvalsh(cov), atol=1e-12)


@given(near_poses, near_poses, st.floats(0, 1))
def test_interpolate_keeps_one_twist_from_end_to_end(a, b, share):
    same(interpolate(a, b, 0.0), a)
    same(interpolate(a, b, 1.0), b)
    middle = interpolate(a, b, share)
    turn = abs(wrap(b[2] - a[2]))
    if turn < 3.1:  # beyond, the twist is ill-determined (see above)
        twist = log(between(a, b))
        np.testing.assert_allclose(log(between(a, middle)), share * twist, atol=CHAIN)


@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_positive_definite_is_what_eigenvalues_say(size):
    """Spectra of either sign, also near zero but beyond rounding, 1e-9; NaN is not positive."""
    rng = np.random.default_rng(size)
    for _ in range(300):
        q, _ = np.linalg.qr(rng.normal(size=(size, size)))
        values = rng.choice([1.0, 1.0, 1.0, 1e-6, -1e-6, -1.0], size=size) * rng.uniform(
            0.5, 2, size
        )
        cov = (q * values) @ q.T
        assert is_positive((cov + cov.T) / 2) == (values.min() > 0)
    assert not is_positive(np.full((size, size), np.nan))


def test_many_covariances_are_tested_as_each_is():
    rng = np.random.default_rng(7)
    roots = rng.normal(size=(200, 2, 2))
    covs = roots @ roots.mT - 0.5 * rng.uniform(size=(200, 1, 1)) * np.eye(2)
    covs[:4] = [np.diag([np.inf, 1.0]), np.diag([1.0, np.nan]), np.zeros((2, 2)), np.diag([1.0, 0])]
    found = are_positive(covs)
    assert 20 < found.sum() < 190
    assert found[4:].tolist() == [is_positive(cov) for cov in covs[4:]]
    assert not found[:4].any() and not is_positive(covs[2]) and not is_positive(covs[3])


def test_motions_chained_are_those_between_the_poses():
    """Breaks if a motion is along other axes than those of the pose before."""
    rng = np.random.default_rng(1)
    moved = rng.uniform(-1, 1, (50, 3)) * [1.0, 0.5, 3.0]
    poses = chained(moved)
    one = np.zeros(3)
    for motion, pose in zip(moved, poses[1:], strict=True):
        one = compose(one, motion)
        # fifty additions of numbers of about 10 m
        np.testing.assert_allclose(pose[:2], one[:2], atol=1e-12)
        assert abs(wrap(pose[2] - one[2])) < 1e-12
    assert chained(np.zeros((0, 3))).tolist() == [[0.0, 0.0, 0.0]]
