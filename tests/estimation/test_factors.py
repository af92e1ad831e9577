"""GTSAM factors say what our models say; a wall holds nothing along itself."""

import typing
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from backend_cases import run, two_robots
from finite_differences import jacobian

from graphslam.core.config import Config, RobustConfig
from graphslam.core.errors import EstimationError
from graphslam.core.geometry import between, compose, exp, inverse, rotate_cov, rotation3
from graphslam.core.observation_models import MODELS, PointModel
from graphslam.core.records import Association, Closure, Motion, Start, Step
from graphslam.estimation import factors
from graphslam.estimation.backends import BACKENDS
from graphslam.estimation.isam2 import BatchGraph
from graphslam.estimation.recorded_graph import RecordedGraph

PLAIN = RobustConfig(kernel="none")
X, T = factors.state_key(0, 0), factors.state_key(1, 0)
#: a residual of size one after ten roundings; frames or signs confused are 0.1
EXACT = 1e-12


def random_case(name, seed, error=0.1):
    """(association, x, t) with a measurement that misses by ``error`` m or rad."""
    rng, model = np.random.default_rng(seed), MODELS[name]
    x = np.array([*rng.uniform(-5, 5, 2), rng.uniform(-3, 3)])
    t = np.array([*rng.uniform(-5, 5, 2), rng.uniform(-3, 3)])[: model.dim]
    z = model.predict(x, t)
    z = z + error * rng.normal(size=len(z))
    if name == "line":
        z = compose(z, np.array([rng.uniform(-3, 3), 0.0, 0.0]))
    root = 0.1 * rng.normal(size=(len(z), len(z)))
    return Association("r", 0, 0, name, z, root @ root.T + 1e-3 * np.eye(len(z))), x, t


def at(x, t):
    values = gtsam.Values()
    values.insert(X, factors.pose2(x))
    values.insert(T, factors.pose2(t) if len(t) == 3 else t)
    return values


def squared_norm(factor, values):
    return 2 * factor.error(values)


# ------------------------------------------------------------ factor = model


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("name", sorted(MODELS))
def test_factor_error_is_the_models_residual(name, seed):
    """Sign, order and frame of the rows; a line's first row (along the wall) is free."""
    seen, x, t = random_case(name, seed)
    factor = factors.observation_factor(X, T, seen, PLAIN, x, t)
    rows = MODELS[name].rows
    error = factor.unwhitenedError(at(x, t))[-rows:]
    np.testing.assert_allclose(error, MODELS[name].residual(seen.z, x, t), atol=EXACT)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("name", sorted(MODELS))
def test_factor_weighs_its_error_by_the_models_noise(name, seed):
    """Twice the factor's error is rᵀ R⁻¹ r: a covariance left in the wrong frame breaks it."""
    seen, x, t = random_case(name, seed)
    factor = factors.observation_factor(X, T, seen, PLAIN, x, t)
    r = MODELS[name].residual(seen.z, x, t)
    R = MODELS[name].noise(seen.z, seen.cov, x, t)
    expected = r @ np.linalg.solve(R, r)
    # conditioning of R: eigenvalues from 1e-3 to 0.1, once in each inverse
    np.testing.assert_allclose(squared_norm(factor, at(x, t)), expected, rtol=1e-10)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("name", sorted(MODELS))
def test_factor_linearises_like_the_model(name, seed):
    """GTSAM's Jacobians by body-frame errors against ours by world-axis errors, turned: compared as
    information matrix and vector, which do not depend on the choice of a square root."""
    seen, x, t = random_case(name, seed)
    model = MODELS[name]
    linear = factors.observation_factor(X, T, seen, PLAIN, x, t).linearize(at(x, t))
    order = gtsam.Ordering()
    order.push_back(X)
    order.push_back(T)
    graph = gtsam.GaussianFactorGraph()
    graph.push_back(linear)
    A, b = graph.jacobian(order)

    H_x, H_t = model.jacobians(seen.z, x, t)
    turned = H_t @ rotation3(t[2]) if len(t) == 3 else H_t
    H = np.hstack([H_x @ rotation3(x[2]), turned])
    r = model.residual(seen.z, x, t)
    weight = np.linalg.inv(model.noise(seen.z, seen.cov, x, t))
    scale = np.abs(H.T @ weight @ H).max()
    np.testing.assert_allclose(A.T @ A, H.T @ weight @ H, atol=1e-11 * scale)
    np.testing.assert_allclose(A.T @ b, -H.T @ weight @ r, atol=1e-11 * scale)


@pytest.mark.parametrize("seed", range(3))
def test_line_factor_has_no_information_along_the_line(seed):
    """The landmark slides along its own wall by 100 m without a change, and one direction of its
    information is exactly empty. A big sigma instead of zero breaks it."""
    seen, x, t = random_case("line", seed, error=0.0)
    factor = factors.observation_factor(X, T, seen, PLAIN, x, t)
    for along in (0.0, -1.0, 100.0):
        slid = compose(t, np.array([along, 0.0, 0.0]))
        assert squared_norm(factor, at(x, slid)) < 1e-18
    graph = gtsam.GaussianFactorGraph()
    graph.push_back(factor.linearize(at(x, t)))
    hessian, _ = graph.hessian()
    along_wall = np.zeros(6)
    first = list(factor.keys()).index(T) * 3
    along_wall[first] = 1.0  # body frame: x runs along the wall
    np.testing.assert_allclose(hessian @ along_wall, 0, atol=1e-12 * np.abs(hessian).max())


def test_line_gauge_ties_only_along_the_line():
    """One row of information, of a sigma that says so; across the wall and in direction it is
    free."""
    x, z = np.array([1.0, 2.0, 0.5]), np.array([3.0, 1.0, 0.2])
    seen = Association("r", 0, 0, "line", z, np.eye(3))
    factor = factors.line_gauge_factor(X, T, seen)
    t = compose(x, z)
    for shift, expected in (
        ([0, 5.0, 0], 0.0), ([0, 0, 0.5], 0.0), ([2.0, 0, 0], 4 / factors.LINE_GAUGE_SIGMA_M**2),
    ):  # fmt: skip
        moved = compose(t, np.array(shift, float))
        np.testing.assert_allclose(squared_norm(factor, at(x, moved)), expected, atol=EXACT)


@pytest.mark.parametrize("wide", [True, False])
def test_a_filters_gauge_is_the_narrow_one(wide):
    """`LINE_GAUGE_SIGMA_M` is for what relinearises; exchanged, filters become inconsistent."""
    x, z = np.array([1.0, 2.0, 0.5]), np.array([3.0, 1.0, 0.2])
    seen = Association("r", 0, 0, "line", z, np.eye(3))
    factor = factors.line_gauge_factor(X, T, seen, wide=wide)
    moved = compose(compose(x, z), np.array([0.01, 0, 0]))
    sigma = factors.LINE_GAUGE_SIGMA_M if wide else factors.FILTER_GAUGE_SIGMA_M
    np.testing.assert_allclose(squared_norm(factor, at(x, moved)), (0.01 / sigma) ** 2, rtol=1e-9)
    assert factors.LINE_GAUGE_SIGMA_M > 100 * factors.FILTER_GAUGE_SIGMA_M


def test_a_held_line_is_held_along_itself_alone():
    x, t = np.array([1.0, 2.0, 0.5]), np.array([3.0, 1.0, 2.2])
    factor = factors.line_held_factor(X, T, x, t)
    for shift, expected in (
        ([0, 0, 0], 0.0), ([0, 5.0, 0], 0.0), ([0, 0, 0.5], 0.0),
        ([2.0, 0, 0], 4 / factors.LINE_HELD_SIGMA_M**2),
    ):  # fmt: skip
        found = squared_norm(factor, at(x, compose(t, np.array(shift, float))))
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize("seed", range(4))
def test_a_sliding_line_does_not_feel_where_its_origin_is(seed):
    """With a residual in the direction GTSAM's normal part changes as the origin slides; that of
    `line_rows` does not, to rounding, and is the normal part itself where the measurement faces the
    origin. A slope of the other sign, or of the other row, breaks one of both."""
    seen, x, t = random_case("line", seed)
    arrays = (np.array([part]) for part in (seen.z, seen.cov, x, t))
    z, cov, xs, ts = arrays
    (plain,) = factors.line_factors([X], [T], z, cov, xs, ts, PLAIN)
    (sliding,) = factors.line_factors([X], [T], z, cov, xs, ts, PLAIN, sliding=True)
    here = squared_norm(sliding, at(x, t))
    np.testing.assert_allclose(here, squared_norm(plain, at(x, t)), rtol=1e-9)
    for along in (-3.0, 0.5, 20.0):
        slid = compose(t, np.array([along, 0.0, 0.0]))
        np.testing.assert_allclose(squared_norm(sliding, at(x, slid)), here, rtol=1e-8)
        assert abs(squared_norm(plain, at(x, slid)) - here) > 1e-3 * here


# ------------------------------------------------------------ many at once


def other_values(x, t):
    """Values at which no residual is zero."""
    return at(compose(x, np.array([0.3, -0.2, 0.1])), t + np.array([0.1, 0.4, -0.2])[: len(t)])


@pytest.mark.parametrize("kernel", [PLAIN, RobustConfig("cauchy", 1.5)], ids=["none", "cauchy"])
@pytest.mark.parametrize("name", ["line", *factors.BEARING_RANGE])
def test_factors_made_together_are_those_made_alone(name, kernel):
    """Breaks with the row of another, or with a noise model that lost its kernel."""
    cases = [random_case(name, seed) for seed in range(4)]
    z, cov = (np.array([getattr(seen, what) for seen, _, _ in cases]) for what in ("z", "cov"))
    x, t = (np.array(part) for part in zip(*((x, t) for _, x, t in cases), strict=True))
    keys, targets = [X] * 4, [T] * 4
    if name == "line":
        many = factors.line_factors(keys, targets, z, cov, x, t, kernel)
    else:
        many = factors.bearing_range_factors(name, keys, targets, z, cov, kernel)
    for n, (seen, _, _) in enumerate(cases):
        one = factors.observation_factor(X, T, seen, kernel, x[n], t[n])
        values = other_values(x[n], t[n])
        assert many[n].error(values) == pytest.approx(one.error(values), rel=1e-9)
        assert list(many[n].keys()) == [X, T]


def test_motions_made_together_are_those_made_alone():
    rng = np.random.default_rng(2)
    delta, roots = rng.normal(size=(3, 3)), 0.3 * rng.normal(size=(3, 3, 3))
    cov = roots @ roots.mT + 0.01 * np.eye(3)
    values = at(np.array([1.0, 2.0, 0.5]), np.array([-1.0, 0.5, 2.0]))
    for n, many in enumerate(factors.motion_factors([(X, T)] * 3, delta, cov)):
        one = factors.motion_factor(X, T, Motion(0, 1, delta[n], cov[n], np.zeros((3, 0)), 1.0))
        assert many.error(values) == pytest.approx(one.error(values), rel=1e-9)
        assert list(many.keys()) == [X, T]


# ------------------------------------------------------------ motion, closure, start


def test_motion_factor_takes_its_covariance_along_the_start_frame():
    """The robot turned left by 90°: an error of e along the start's x axis must weigh e²/σ_x².
    GTSAM wants the end's frame; without the conversion the sigmas would be exchanged."""
    sigma = np.array([0.5, 0.1, 0.02])
    start, delta = np.array([4.0, -2.0, 0.8]), np.array([1.0, 1.0, np.pi / 2])
    motion = Motion(0, 1, delta, np.diag(sigma**2), np.zeros((3, 0)), 1.0)
    factor = factors.motion_factor(X, T, motion)
    for axis in range(2):
        off = delta.copy()
        off[axis] += 0.3
        np.testing.assert_allclose(
            squared_norm(factor, at(start, compose(start, off))),
            (0.3 / sigma[axis]) ** 2,
            rtol=1e-12,
        )


def test_closure_factor_is_the_pose_of_the_first_seen_from_the_other():
    delta, cov = np.array([1.0, 2.0, 1.2]), np.diag([0.04, 0.01, 0.0025])
    closure = Closure("a", 5, "b", 0, delta, cov)
    other = np.array([3.0, 1.0, -0.4])
    factor = factors.closure_factor(X, T, closure, PLAIN)
    exact = at(compose(other, delta), other)
    np.testing.assert_allclose(squared_norm(factor, exact), 0, atol=EXACT)
    off = at(compose(other, delta + np.array([0.2, 0, 0])), other)
    np.testing.assert_allclose(squared_norm(factor, off), 1.0, rtol=1e-12)  # 0.2 m, sigma 0.2 m


@pytest.mark.parametrize("images", [4, 15])
def test_a_closure_of_n_images_costs_what_n_of_one_do(images):
    """Breaks if a whole submap gives way to a few observations of one wall as if it were one more
    of them: n rho(r / sqrt n) is what n closures of one image, each off by so much less, cost."""
    closure = Closure("a", 5, "b", 0, np.zeros(3), np.diag([0.01, 0.01, 0.01]), scan_count=images)
    kernel = RobustConfig("cauchy", 2.0)
    for off in (0.3, 30.0):
        one, many = (
            factors.closure_factor(X, T, each, kernel).error(at(np.array([r, 0, 0]), np.zeros(3)))
            for each, r in (
                (replace(closure, scan_count=1), off / np.sqrt(images)),
                (closure, off),
            )
        )
        np.testing.assert_allclose(many, images * one, rtol=1e-12)


@pytest.mark.parametrize("verified", [True, False])
def test_a_closure_gives_way_unless_it_was_verified(verified):
    """100 sigma off: a verified one costs all of it, another a hundredth."""
    closure = Closure("a", 5, "b", 0, np.zeros(3), 1e-4 * np.eye(3), verified=verified)
    factor = factors.closure_factor(X, T, closure, RobustConfig("cauchy", 2.0))
    cost = squared_norm(factor, at(np.array([1.0, 0, 0]), np.zeros(3)))
    assert cost == pytest.approx(1e4) if verified else cost < 100


def test_start_factor_takes_its_covariance_along_world_axes():
    """A robot that starts facing north with x known to 1 cm and y to 1 m."""
    start = Start(np.array([2.0, 3.0, np.pi / 2]), np.diag([1e-4, 1.0, 1e-2]))
    factor = factors.start_factor(X, start)
    values = gtsam.Values()
    values.insert(X, factors.pose2(start.pose + np.array([0.02, 0.0, 0.0])))
    np.testing.assert_allclose(squared_norm(factor, values), 4.0, rtol=1e-12)


@pytest.mark.parametrize("heading", [0.0, 1.0, -2.5])
def test_rotation3_turns_retracted_errors_into_world_axes(heading):
    """Pose2.retract moves in the body frame: its first-order effect on (x, y, phi)."""
    pose, small = np.array([1.0, 2.0, heading]), np.array([2e-6, -1e-6, 3e-6])
    moved = factors.array3(factors.pose2(pose).retract(small))
    expected = rotation3(heading) @ small
    np.testing.assert_allclose(moved - pose, expected, atol=1e-11)  # second order: (1e-6)²


# ------------------------------------------------------------ noise, kernels, keys


def test_indefinite_covariance_is_refused_with_our_error():
    with pytest.raises(EstimationError, match="not positive definite"):
        factors.gaussian(np.diag([1.0, -1.0, 1.0]))


@pytest.mark.parametrize("kernel", typing.get_args(typing.get_type_hints(RobustConfig)["kernel"]))
def test_every_configurable_kernel_holds_an_outlier_down_and_leaves_an_inlier_alone(kernel):
    """30 sigma count far less than the 450 of a Gaussian; 0.1 sigma count the same to 1 %."""
    noise = factors.robust(factors.gaussian(np.eye(3)), RobustConfig(kernel, 2.0))
    factor = gtsam.PriorFactorPose2(X, gtsam.Pose2(), noise)

    def error(distance):
        values = gtsam.Values()
        values.insert(X, gtsam.Pose2(distance, 0.0, 0.0))
        return factor.error(values)

    assert error(0.1) == pytest.approx(0.005, rel=0.01)
    assert (error(30.0) == pytest.approx(450.0)) == (kernel == "none")
    assert error(30.0) > error(3.0) > error(0.3)


def test_keys_of_robots_states_and_landmarks_never_meet():
    keys = [factors.state_key(r, n) for r in (0, 1, 2**16 - 1) for n in (0, 1, 2**40 - 1)]
    keys += [factors.landmark_key(n) for n in (0, 1, 2**40)]
    assert len(set(keys)) == len(keys)


def test_keys_say_what_they_are_of():
    for n in (0, 5, 2**40 - 1):
        for robot in (0, 3, 2**16 - 1):
            key = factors.state_key(robot, n)
            assert factors.is_state(key) and factors.number_of(key) == (robot, n)
        key = factors.landmark_key(n)
        assert not factors.is_state(key) and factors.number_of(key) == (None, n)


def test_values_come_back_as_they_were_written():
    """Poses and points; `retracted` is GTSAM's own correction of either."""
    pose, point, L = np.array([1.0, -2.0, 0.7]), np.array([3.0, 4.0]), factors.landmark_key(0)
    values = gtsam.Values()
    for key, value in ((X, pose), (L, point)):
        factors.write(values, key, value)
        np.testing.assert_allclose(factors.read(values, key, len(value)), value, atol=1e-15)
        factors.overwrite(values, key, 2 * value)
        np.testing.assert_allclose(factors.read(values, key, len(value)), 2 * value, atol=1e-15)
    delta, z = gtsam.VectorValues(), np.array([0.1, -0.3, 0.4])
    delta.insert(X, z)
    delta.insert(L, z[:2])
    moved = values.retract(delta)
    for key, value in ((X, 2 * pose), (L, 2 * point)):
        n = len(value)
        expected = factors.retracted(value, z[:n])
        np.testing.assert_allclose(factors.read(moved, key, n), expected, atol=1e-14)


def test_a_noise_model_keeps_ten_decades():
    """Wall-like covariances, turned: whitened by it, the covariance is the unit matrix."""
    rng = np.random.default_rng(6)
    for spread in (1.0, 1e-4):
        for _ in range(5):
            q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
            cov = (q * [1.0, spread, spread**2]) @ q.T
            cov = (cov + cov.T) / 2
            R = factors.gaussian(cov).R()
            np.testing.assert_array_equal(np.tril(R, -1), 0.0)
            np.testing.assert_allclose(R @ cov @ R.T, np.eye(3), atol=1e-15 / spread**2)


# ------------------------------------------------------------ the 30 m corridor

STEP_M, KEYFRAMES, ODOMETRY_SIGMA_M = 0.25, 120, 0.02


def corridor_steps(model, along_sigma_m, seed=0):
    """30 m between two side walls, odometry 5 % short. At each keyframe the laser sees each wall
    from 3 m behind to 5 m ahead, within its ends: overlapping parts of one long wall, each with
    its middle and the direction that has the sensor on the left."""
    rng = np.random.default_rng(seed)
    motion_cov = np.diag([ODOMETRY_SIGMA_M**2, 0.01**2, 0.01**2])
    cov = np.diag([along_sigma_m**2, 0.01**2, 0.005**2])
    steps = [Step(0, starts={"r": Start(np.zeros(3), np.diag([1e-6] * 3))})]
    for k in range(KEYFRAMES + 1):
        true = np.array([k * STEP_M, 0.0, 0.0])
        motions = {}
        if k:
            delta = np.array([0.95 * STEP_M, 0.0, 0.0]) + rng.normal(0, [0, 0.002, 0.002])
            motions = {"r": Motion(k - 1, k, delta, motion_cov, np.zeros((3, 0)), STEP_M)}
        begin, end = max(-5.0, true[0] - 3), min(36.0, true[0] + 5)
        seen = []
        for wall, (y, direction) in enumerate([(1.0, np.pi), (-1.0, 0.0)]):
            z = between(true, np.array([(begin + end) / 2, y, direction]))
            z = compose(z, rng.normal(0, [0, 0.01, 0.005]))
            seen.append(Association("r", k, wall, model, z, rotate_cov(cov, z[2])))
        steps.append(Step(k, motions=motions, associations=tuple(seen)))
    return steps


def drive_corridor(backend, model, along_sigma_m=1.0, kernel="none"):
    """(distance driven, its sigma), m."""
    estimator = BACKENDS[backend](Config(robust=RobustConfig(kernel)))
    for step in corridor_steps(model, along_sigma_m):
        estimator.add(step)
    states = estimator.finish().states["r"]
    return states.poses[-1, 0], np.sqrt(states.covs[-1, 0, 0])


@pytest.mark.parametrize("kernel", ["none", "cauchy"])
@pytest.mark.parametrize("backend", ["isam2", "batch"])
def test_corridor_line_landmarks_keep_what_odometry_says_along_the_walls(backend, kernel):
    """Odometry says 28.5 m; walls cannot correct it, and must neither move it nor make it seem
    certain. Tolerances: over 20 seeds the ends are 28.46 ± 0.05 m with a sigma of 0.214 m for
    odometry's 0.219 m, since the noise of the directions couples into the position in second order;
    so odometry's own sigma for the distance and 6 % for the sigma."""
    odometry_sigma = ODOMETRY_SIGMA_M * np.sqrt(KEYFRAMES)
    distance, sigma = drive_corridor("dead-reckoning", "line")
    assert distance == pytest.approx(28.5, abs=0.03)  # cosines of wrong headings
    assert sigma == pytest.approx(odometry_sigma, rel=0.03)
    distance, sigma = drive_corridor(backend, "line", kernel=kernel)
    assert distance == pytest.approx(28.5, abs=odometry_sigma)
    assert sigma == pytest.approx(odometry_sigma, rel=0.06)


def test_corridor_naive_middles_are_wrong_and_confident():
    """The same walls with their seen middle taken as a point with a large sigma along the wall (1.4
    m): the end comes out metres short with a sigma of 0.2 m. Shows that the test above can fail."""
    distance, sigma = drive_corridor("isam2", "segment", along_sigma_m=1.4)
    assert distance == pytest.approx(19, abs=1.5)
    assert sigma < 0.25
    assert (30 - distance) / sigma > 40


def test_corridor_line_sigma_is_unmoved_by_what_is_claimed_along_the_wall():
    """A line's first row of covariance means nothing: 1 cm there or 100 m is the same result, to
    the optimiser's own tolerance (1e-10 of the error is some 1e-7 of the distance)."""
    results = [drive_corridor("batch", "line", along_sigma_m=s) for s in (0.01, 100.0)]
    np.testing.assert_allclose(results[0], results[1], rtol=1e-6)


def test_point_rows_measure_bearing_and_range():
    """BearingRange factors order their rows bearing, range; so do our measurements."""
    for name in ("point", "robot-point"):
        assert isinstance(MODELS[name], PointModel)
        seen, x, t = random_case(name, 1, error=0.0)
        off = seen.z + np.array([0.01, 0.0])
        moved = Association("r", 0, 0, name, off, np.diag([1e-4, 1e4]))
        factor = factors.observation_factor(X, T, moved, PLAIN, x, t)
        np.testing.assert_allclose(squared_norm(factor, at(x, t)), 1.0, rtol=1e-9)


def test_a_recorded_graph_is_the_one_that_grows_step_by_step():
    """The same error at any values, the same rows, and observations of robots where it says."""
    kernel = RobustConfig()
    steps, _ = two_robots(np.random.default_rng(3))
    estimate = run("batch", steps).finish()
    grown, values = BatchGraph.at_estimate(steps, estimate, kernel)
    recorded, same = RecordedGraph(kernel), gtsam.Values()
    recorded.insert_all(steps, estimate, same)
    for graph, at_values in ((grown, values), (recorded, same)):
        graph.rebuild_lines(at_values)
    assert recorded.rows == grown.rows and recorded.graph.size() == grown.graph.size()
    rng = np.random.default_rng(0)
    for _ in range(5):
        delta = gtsam.VectorValues()
        for key, dim in grown.dims().items():
            delta.insert(key, 0.1 * rng.normal(size=dim))
        expected = grown.graph.error(values.retract(delta))
        assert recorded.graph.error(same.retract(delta)) == pytest.approx(expected, rel=1e-9)
    for index, (key, target, _) in recorded.robot_observations:
        assert set(recorded.graph.at(index).keys()) == {key, target}
    for index, _, last, key in recorded.motions:
        assert list(recorded.graph.at(index).keys()) == [last, key]


def test_a_recorded_observation_without_a_valid_covariance_is_named():
    steps, _ = two_robots()
    estimate = run("batch", steps).finish()
    n, k, step, seen = next(
        (n, k, step, seen)
        for n, step in enumerate(steps)
        for k, seen in enumerate(step.associations)
        if seen.model == "point"
    )
    for cov, why in ((-seen.cov, "not positive definite"), (np.nan * seen.cov, "not finite")):
        wrong = list(step.associations)
        wrong[k] = seen.with_measurement(seen.z, cov)
        spoilt = [*steps[:n], replace(step, associations=tuple(wrong)), *steps[n + 1 :]]
        with pytest.raises(EstimationError, match=f"landmark {seen.target}, seen from.*{why}"):
            RecordedGraph(PLAIN).insert_all(spoilt, estimate, gtsam.Values())


@pytest.mark.parametrize("turn", [1.1e-5, 1e-4, 1e-3, 2.9e-3])
def test_a_filter_linearises_small_turns_with_all_digits(turn):
    """GTSAM's own derivative of the logarithm is off by 2e-16 / turn³ there (0.1 at 1.1e-5 rad):
    the reason for `factors.linearised`, which is not needed any more when the last line fails."""
    x, t = np.array([1.0, 2.0, 0.4]), np.array([4.0, 1.0, 1.1])
    z = compose(between(x, t), inverse(exp(np.array([0.3, -0.2, turn]))))
    cov = np.diag([0.02, 0.03, 0.01])
    factor = factors.relative_pose_factor(1, 2, z, cov, PLAIN)
    values = {1: x, 2: t}
    assert factors.turns_little(factor, values)
    assert factors.turns_little(factor, {1: x, 2: t + np.array([0, 0, 2 * np.pi])})
    assert not factors.turns_little(factor, {1: x, 2: t + np.array([0, 0, 4e-3])})
    assert not factors.turns_little(
        factor, {1: x, 2: t - np.array([0, 0, turn])}
    )  # GTSAM's own case
    A, b = factors.linearised(factor, values)
    here = gtsam.Values()
    for key, value in values.items():
        factors.write(here, key, value)
    np.testing.assert_allclose(b, factor.linearize(here).jacobian()[1], rtol=1e-9)

    def whitened(d):
        moved = compose(x, exp(d[:3])), compose(t, exp(d[3:]))
        return factor.noiseModel().R() @ MODELS["segment"].residual(z, *moved)

    np.testing.assert_allclose(A, jacobian(whitened, np.zeros(6)), atol=1e-6)
    if turn < 1e-4:
        assert np.abs(A - factor.linearize(here).jacobian()[0]).max() > 1e-3
