"""The extended Kalman filter and the algebra under it: every equation as a property."""

from collections import Counter

import backend_cases as cases
import gtsam
import numpy as np
import pytest
from finite_differences import jacobian
from scipy.optimize import least_squares
from scipy.stats import chi2

from graphslam.core.config import Config, EkfConfig, RobustConfig
from graphslam.core.errors import EstimationError
from graphslam.core.gaussian import JointGaussian, move_block, solve, update, whiten
from graphslam.core.geometry import (
    between,
    compose,
    compose_jacobians,
    exp,
    log,
    rotate_cov,
    rotation3,
    wrap,
)
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, Closure, Start, Step
from graphslam.estimation.ekf import ERRORS, EkfBackend
from graphslam.estimation.factor_ekf import FactorEkfBackend
from graphslam.estimation.factors import FILTER_GAUGE_SIGMA_M
from graphslam.estimation.m_estimators import WEIGHTS, robust_weight

FRAMES = ["world", "body"]


def settings(error="world", kernel="none", **ekf):
    return Config(robust=RobustConfig(kernel), ekf=EkfConfig(error=error, **ekf))


def filtered(steps, config):
    backend = EkfBackend(config)
    for step in steps:
        backend.add(step)
    return backend


def random_cov(rng, n):
    A = rng.normal(size=(n, n))
    return A @ A.T + 0.1 * np.eye(n)


@pytest.fixture
def rng():
    return np.random.default_rng(7)


# ------------------------------------------------------------ the linear filter, 3.1-3.8


def test_linear_filter_is_least_squares(rng):
    """Ten steps of a linear system: the filter's last state is that of the normal equations of the
    whole history, in mean and covariance. Rounding of a 44 x 44 inverse: 1e-9."""
    n, k, count = 4, 2, 10
    F, H = rng.normal(size=(n, n)) * 0.4, rng.normal(size=(k, n))
    Q, R, P0, x0 = random_cov(rng, n), random_cov(rng, k), random_cov(rng, n), rng.normal(size=n)
    x, P = x0, P0.copy()
    info, vector = np.zeros((n * (count + 1),) * 2), np.zeros(n * (count + 1))
    info[:n, :n] = np.linalg.inv(P0)
    vector[:n] = info[:n, :n] @ x0
    for step in range(1, count + 1):
        z, u = rng.normal(size=k), rng.normal(size=n)
        x = F @ x + u
        move_block(P, slice(0, n), F, Q)
        x, P, _, _ = update(x, P, H, R, z - H @ x)
        J = np.zeros((n, len(vector)))
        J[:, n * (step - 1) : n * step], J[:, n * step : n * (step + 1)] = -F, np.eye(n)
        info += J.T @ np.linalg.solve(Q, J)
        vector += J.T @ np.linalg.solve(Q, u)
        J = np.zeros((k, len(vector)))
        J[:, n * step : n * (step + 1)] = H
        info += J.T @ np.linalg.solve(R, J)
        vector += J.T @ np.linalg.solve(R, z)
    np.testing.assert_allclose(x, np.linalg.solve(info, vector)[-n:], rtol=1e-9)
    np.testing.assert_allclose(P, np.linalg.inv(info)[-n:, -n:], rtol=1e-9)


def test_one_measurement_at_a_time_is_all_at_once(rng):
    """What section 4.1 relies on: exact for independent noise in a linear problem."""
    x, P, H = rng.normal(size=6), random_cov(rng, 6), rng.normal(size=(4, 6))
    R1, R2, z = random_cov(rng, 2), random_cov(rng, 2), rng.normal(size=4)
    R = np.block([[R1, np.zeros((2, 2))], [np.zeros((2, 2)), R2]])
    together = update(x, P, H, R, z - H @ x)
    x, P, _, _ = update(x, P, H[:2], R1, z[:2] - H[:2] @ x)
    one = update(x, P, H[2:], R2, z[2:] - H[2:] @ x)
    for a, b in zip(together[:2], one[:2], strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


def joseph(x, P, innovation, H, R):
    """3.5-3.8 with an inverse and Joseph's covariance: the reference, dear and robust."""
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    A = np.eye(len(x)) - K @ H
    return K @ innovation, A @ P @ A.T + K @ R @ K.T, innovation @ np.linalg.inv(S) @ innovation


def test_the_downdate_is_josephs_form(rng):
    x, P, H, R, z = np.zeros(7), random_cov(rng, 7), rng.normal(size=(3, 7)), np.eye(3), np.ones(3)
    moved, cov, d2 = joseph(x, P, z, H, R)
    *found, log_det = update(x, P, H, R, z)
    for a, b in zip(found, (moved, cov, d2), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)
    assert log_det == pytest.approx(np.log(np.linalg.det(H @ P @ H.T + R)), rel=1e-12)
    assert whiten(P @ H.T, H @ P @ H.T + R, z)[2] == pytest.approx(d2, rel=1e-12)


# ------------------------------------------------------------ a Gaussian whose members come and go


def test_small_systems_are_solved_as_numpy_does(rng):
    A, B = rng.normal(size=(4, 4)), rng.normal(size=(4, 2))
    before = A.copy(), B.copy()
    np.testing.assert_allclose(A @ solve(A, B), B, atol=1e-12)
    np.testing.assert_allclose(A @ solve(A, B[:, 0]), B[:, 0], atol=1e-12)
    assert solve(A, B[:, 0]).shape == (4,)
    np.testing.assert_array_equal(A, before[0])
    np.testing.assert_array_equal(B, before[1])
    with pytest.raises(np.linalg.LinAlgError):
        solve(np.ones((2, 2)), np.ones(2))


def members(rng, dims=(3, 2, 3, 3, 2)):
    """A correlated Gaussian of members 0, 1, ... in little room, so that it has to grow."""
    gaussian = JointGaussian(room=4)
    for name, d in enumerate(dims):
        given = {other: rng.normal(size=(d, dims[other])) for other in range(name)}
        gaussian.add(name, rng.normal(size=d), random_cov(rng, d), given)
    return gaussian


def test_augmentation_is_the_covariance_of_the_longer_vector(rng):
    """4.25-4.28: with T = [I; G], the longer vector's covariance is T P Tᵀ plus the fresh noise."""
    gaussian = members(rng)
    P, n = gaussian.P.copy(), len(gaussian)
    G, fresh = {3: rng.normal(size=(2, 3)), 1: rng.normal(size=(2, 2))}, random_cov(rng, 2)
    gaussian.add("new", np.array([1.0, 2.0]), fresh, G)
    T = np.vstack([np.eye(n), np.zeros((2, n))])
    for name, block in G.items():
        T[n:, gaussian.slot(name)] = block
    expected = T @ P @ T.T
    expected[n:, n:] += fresh
    np.testing.assert_allclose(gaussian.P, expected, atol=1e-11)
    np.testing.assert_array_equal(gaussian.x[n:], [1.0, 2.0])


def test_growing_changes_nothing(rng):
    a = members(np.random.default_rng(1))
    x, P = a.x.copy(), a.P.copy()
    for name in range(100, 140):
        a.add(name, np.zeros(3), np.eye(3))
    np.testing.assert_array_equal(a.x[: len(x)], x)
    np.testing.assert_array_equal(a.P[: len(x), : len(x)], P)
    assert len(a) == len(x) + 120
    np.testing.assert_array_equal(a.P[len(x) :, : len(x)], 0.0)


@pytest.mark.parametrize("gone", [0, 1, 2, 4])
def test_removal_leaves_the_joint_marginal_of_the_rest(gone, rng):
    """First, middle, last, small: the others keep means and covariances, wherever they move to."""
    gaussian = members(rng)
    rest = [name for name in gaussian if name != gone][::-1]
    means = [gaussian.x[gaussian.slot(name)].copy() for name in rest]
    expected, points, poses = gaussian.marginal(rest), gaussian.blocks(2), gaussian.blocks(3)
    gaussian.remove(gone)
    assert gone not in gaussian
    np.testing.assert_array_equal(gaussian.marginal(rest), expected)
    for name, mean in zip(rest, means, strict=True):
        np.testing.assert_array_equal(gaussian.x[gaussian.slot(name)], mean)
    assert len(gaussian.blocks(2)) + len(gaussian.blocks(3)) == len(points) + len(poses) - 1
    # the room is used again, by somebody who knows nothing of who was there
    gaussian.add("new", np.zeros(3), np.eye(3))
    np.testing.assert_array_equal(gaussian.P[-3:, :-3], 0.0)


def test_members_that_come_or_go_together_are_those_that_do_so_one_by_one(rng):
    """Each new one from another, two from the same; then first, middle and last go."""
    together, single = (members(np.random.default_rng(4)) for _ in range(2))
    names, sources = ["a", "b", "c"], [3, 2, 3]
    G = rng.normal(size=(3, 3, 3))
    means, covs = rng.normal(size=(3, 3)), np.array([random_cov(rng, 3) for _ in range(3)])
    together.add_each(names, sources, means, covs, G)
    for k, name in enumerate(names):
        single.add(name, means[k], covs[k], {sources[k]: G[k]})
    np.testing.assert_array_equal(together.x, single.x)
    np.testing.assert_allclose(together.P, single.P, atol=1e-12)
    np.testing.assert_array_equal(together.P, together.P.T)
    gone = [0, 4, "c"]
    together.remove(*gone)
    for name in gone:
        single.remove(name)
    assert list(together) == list(single)
    for name in single:
        assert together.slot(name) == single.slot(name)
    np.testing.assert_allclose(together.P, single.P, atol=1e-12)


def test_a_system_update_moves_one_member(rng):
    """3.12 with F and Q that are the identity and zero but for one block."""
    gaussian = members(rng)
    P, own = gaussian.P.copy(), gaussian.slot(2)
    F, Q = rng.normal(size=(3, 3)), random_cov(rng, 3)
    whole, noise = np.eye(len(P)), np.zeros_like(P)
    whole[own, own], noise[own, own] = F, Q
    gaussian.move(2, F, Q)
    np.testing.assert_allclose(gaussian.P, whole @ P @ whole.T + noise, atol=1e-11)
    others = np.delete(np.arange(len(P)), np.r_[own])
    np.testing.assert_array_equal(gaussian.P[np.ix_(others, others)], P[np.ix_(others, others)])
    np.testing.assert_array_equal(gaussian.P, gaussian.P.T)


def test_a_thousand_updates_stay_symmetric_and_are_josephs(rng):
    """Symmetric to the digit, positive definite, and within rounding of the Joseph form, which
    loses nothing: 1e-12 of a variance per update would show as 1e-9."""
    gaussian = members(rng)
    gaussian.P[:] += np.eye(len(gaussian))
    P = gaussian.P.copy()
    for _ in range(1000):
        one, other = rng.permutation(5)[:2]
        H = {int(i): rng.normal(size=(2, 2 if i in (1, 4) else 3)) for i in (one, other)}
        R = 0.1 * random_cov(rng, 2)
        PHt, HPHt = gaussian.project(H, 2)
        B, _, _ = whiten(PHt, HPHt + R, np.zeros(2))
        gaussian.condition(B)
        whole = np.zeros((2, len(P)))
        for name, block in H.items():
            whole[:, gaussian.slot(name)] = block
        P = joseph(np.zeros(len(P)), P, np.zeros(2), whole, R)[1]
    np.testing.assert_array_equal(gaussian.P, gaussian.P.T)
    sigmas = np.sqrt(np.diag(P))
    np.testing.assert_allclose(gaussian.P / np.outer(sigmas, sigmas), P / np.outer(sigmas, sigmas),
                               atol=1e-9)  # fmt: skip
    assert np.linalg.eigvalsh(gaussian.P).min() > 0


# ------------------------------------------------------------ the extended filter, 3.9-3.20, 4


def in_the_middle(error):
    """A filter after four steps of two robots, members in a shuffled order, off the truth."""
    rng = np.random.default_rng(3)
    b, a = np.array([2.0, -1.0, 2.0]), np.array([0.1, 0.2, 0.4])
    cov = np.diag([1e-2, 2e-2, 5e-3])
    seen = [
        cases.see("b", 0, 2, "segment", b, cases.WORLD[2], rng),
        cases.see("b", 0, 0, "point", b, cases.WORLD[0], rng),
    ]
    steps = [
        Step(0, {"b": Start(b, cov)}),
        Step(0, {}, {}, tuple(seen)),
        Step(0, {"a": Start(a, cov)}),
        Step(0, {}, {}, (cases.see("a", 0, 1, "line", a, cases.WORLD[1], rng),)),
    ]
    return filtered(steps, settings(error))


def spied(monkeypatch, method):
    """The last arguments that a method of the Gaussian got."""
    calls, original = [], getattr(JointGaussian, method)

    def call(self, *arguments):
        calls.append(arguments)
        return original(self, *arguments)

    monkeypatch.setattr(JointGaussian, method, call)
    return calls


@pytest.mark.parametrize("error", FRAMES)
@pytest.mark.parametrize(
    ("robot", "target"), [("a", 0), ("b", 1), ("a", 2), ("b", 2), ("a", "b"), ("b", "a")]
)
@pytest.mark.parametrize("point_of", [False, True])
def test_measurement_jacobian_in_the_whole_state(error, robot, target, point_of, monkeypatch):
    """3.19, 4.19-4.21: by central differences over every error of every member, zeros included.
    Rounding of the differences: 1e-9. A line is seen without noise, since how its facing point
    depends on the state is left out where there is a residual (second order)."""
    backend = in_the_middle(error)
    gaussian = backend._gaussian
    assert list(gaussian) == ["b", 2, 0, "a", 1]
    name = cases.MODEL_OF.get(target) or ("robot-point" if point_of else "robot-pose")
    x, t = (gaussian.x[gaussian.slot(member)].copy() for member in (robot, target))
    z = MODELS[name].predict(x, t)
    z = z if name == "line" else z + np.array([0.1, -0.2, 0.15])[: len(z)]
    means = {member: gaussian.x[gaussian.slot(member)].copy() for member in gaussian}
    slots = {member: gaussian.slot(member) for member in gaussian}

    def residual(e):
        where = {
            member: ERRORS[error].retract(means[member], e[slots[member]])
            if len(means[member]) == 3
            else means[member] + e[slots[member]]
            for member in (robot, target)
        }
        return MODELS[name].residual(z, where[robot], where[target])

    calls = spied(monkeypatch, "project")
    backend.add(Step(0, associations=(Association(robot, 0, target, name, z, np.eye(len(z))),)))
    ((blocks, rows),) = calls
    H = np.zeros((rows, len(gaussian)))
    for member, block in blocks.items():
        H[:, slots[member]] = block
    np.testing.assert_allclose(H, jacobian(residual, np.zeros(len(gaussian))), atol=1e-9)


@pytest.mark.parametrize("error", FRAMES)
def test_motion_jacobians(error, monkeypatch):
    """3.13-3.14, 4.7, 4.17: F by central differences of the error after the motion by that before
    it; Q by those of the measured motion. Rounding: 1e-9."""
    backend = in_the_middle(error)
    x, delta = backend.state_mean("b"), np.array([0.7, 0.2, 0.5])
    moved, Q = compose(x, delta), np.array([[3e-2, 1e-3, 0], [1e-3, 1e-2, 2e-3], [0, 2e-3, 4e-3]])

    def difference(pose):
        d = log(between(moved, pose)) if error == "body" else pose - moved
        return np.append(d[:2], wrap(d[2]))

    F = jacobian(lambda e: difference(compose(ERRORS[error].retract(x, e), delta)), np.zeros(3))
    W = jacobian(lambda w: difference(compose(x, delta + w)), np.zeros(3))
    calls = spied(monkeypatch, "move")
    backend.add(Step(1, motions={"b": cases.motion(0, 1, delta, Q)}))
    ((name, found, noise),) = calls
    assert name == "b"
    np.testing.assert_allclose(found, F, atol=1e-9)
    np.testing.assert_allclose(noise, W @ Q @ W.T, atol=1e-9)


@pytest.mark.parametrize("error", FRAMES)
@pytest.mark.parametrize("name", ["point", "segment", "line"])
def test_new_landmark_by_differences(error, name):
    """4.24-4.28: the new landmark's covariance, and with every other member, by the derivative of
    where it comes to lie by errors of the robot and of the measurement."""
    backend = in_the_middle(error)
    before = backend.joint("a", [1, 0, 2], ["b"])
    z = np.array([0.4, 3.0]) if name == "point" else np.array([2.0, 1.0, 0.7])
    R = np.diag([1e-3, 4e-3]) if name == "point" else np.diag([0.2, 3e-4, 1e-4])
    backend.add(Step(0, associations=(Association("a", 0, 9, name, z, R),)))
    after = backend.joint("a", [1, 0, 2, 9], ["b"])
    model = MODELS[name]
    G_x = jacobian(lambda x: model.invert(z, x), before.pose)
    G_z = jacobian(lambda z: model.invert(z, before.pose), z)
    if name == "line":  # along the line the gauge, whatever the front end says
        R = rotate_cov(R, -z[2])
        R[0], R[:, 0] = 0, 0
        R[0, 0] = FILTER_GAUGE_SIGMA_M**2
        R = rotate_cov(R, z[2])
    np.testing.assert_allclose(after.landmarks[-1], model.invert(z, before.pose), atol=1e-15)
    new = after.slices[3]
    expected = G_x @ before.cov[:3, :3] @ G_x.T + G_z @ R @ G_z.T
    np.testing.assert_allclose(after.cov[new, new], expected, atol=1e-9)
    rest = np.delete(np.arange(len(after.cov)), np.r_[new])
    np.testing.assert_allclose(after.cov[new][:, rest], G_x @ before.cov[:3], atol=1e-9)
    np.testing.assert_allclose(after.cov[np.ix_(rest, rest)], before.cov, atol=1e-15)


class Twin:
    """The textbook filter with dense matrices over the whole state and Joseph's form.

    It forgets no past state, ``(robot, time)`` beside ``robot``, but looks at those only that were
    among the last ``past_states``."""

    def __init__(self, error, past_states):
        self.error, self.mean, self.P = error, {}, np.zeros((0, 0))
        self.past_states, self.times = past_states, {}

    def turn(self, mean):
        return rotation3(mean[2]) if len(mean) == 3 and self.error == "body" else np.eye(len(mean))

    def place(self, name):
        ends = dict(zip(self.mean, np.cumsum([len(m) for m in self.mean.values()]), strict=True))
        return slice(ends[name] - len(self.mean[name]), ends[name])

    def enter(self, name, mean, T, noise):
        """A member that is T times the errors so far plus noise, in world axes."""
        self.mean[name] = mean
        turn = self.turn(mean).T
        n = len(self.P)
        A = np.vstack([np.eye(n), turn @ T])
        self.P = A @ self.P @ A.T
        self.P[n:, n:] += turn @ noise @ turn.T

    def step(self, step):
        for robot, start in step.starts.items():
            self.enter(robot, start.pose, np.zeros((3, len(self.P))), start.cov)
            self.times[robot] = [step.time_ns]
        for robot, moved in step.motions.items():
            same = np.eye(len(self.P))[self.place(robot)]
            last = (robot, self.times[robot][-1])
            # the turns of both ends are equal, and `enter` wants world axes
            turn = self.turn(self.mean[robot])
            self.enter(last, self.mean[robot].copy(), turn @ same, np.zeros((3, 3)))
            self.times[robot].append(step.time_ns)
            x, block, A = self.mean[robot], self.place(robot), np.eye(len(self.P))
            F, W = compose_jacobians(x, moved.delta)
            self.mean[robot] = compose(x, moved.delta)
            turn = self.turn(self.mean[robot]).T
            A[block, block] = turn @ F @ self.turn(x)
            self.P = A @ self.P @ A.T
            self.P[block, block] += turn @ W @ moved.cov @ W.T @ turn.T
        for seen in step.associations:
            if not seen.late or self.past_states:
                target = seen.target
                if isinstance(target, str):
                    target = self.state(target, step.time_ns)
                self.observe(seen, self.state(seen.robot, seen.time_ns), target)
        for c in step.closures:
            ends = self.state(c.other, c.other_time_ns), self.state(c.robot, c.time_ns)
            if None not in ends:
                seen = Association(c.other, 0, c.robot, "robot-pose", c.delta, c.cov)
                self.observe(seen, *ends)

    def state(self, robot, time_ns):
        age = self.times[robot][::-1].index(time_ns)
        if age > self.past_states:
            return None
        return (robot, time_ns) if age else robot

    def observe(self, seen, source, target):
        model, x = MODELS[seen.model], self.mean[source]
        if target not in self.mean:
            R = seen.cov
            if seen.model == "line":
                V = rotate_cov(R, -seen.z[2])[1:, 1:]
                R = np.diag([FILTER_GAUGE_SIGMA_M**2, 0, 0])
                R[1:, 1:] = V
                R = rotate_cov(R, seen.z[2])
            G_x, G_z = model.invert_jacobians(seen.z, x)
            T = np.zeros((model.dim, len(self.P)))
            T[:, self.place(source)] = G_x @ self.turn(x)
            self.enter(target, model.invert(seen.z, x), T, G_z @ R @ G_z.T)
            return
        t, H = self.mean[target], np.zeros((model.rows, len(self.P)))
        R = model.noise(seen.z, seen.cov, x, t)
        H_x, H_t = model.jacobians(seen.z, x, t)
        H[:, self.place(source)] = H_x @ self.turn(x)
        H[:, self.place(target)] = H_t @ self.turn(t)
        d, self.P, _ = joseph(H[0], self.P, -model.residual(seen.z, x, t), H, R)
        for name, mean in self.mean.items():
            e = d[self.place(name)]
            whole = len(mean) == 3 and self.error == "body"
            self.mean[name] = compose(mean, exp(e)) if whole else mean + e


@pytest.mark.parametrize("error", FRAMES)
@pytest.mark.parametrize("past_states", [0, 2, 8])
def test_the_filter_is_the_textbooks(error, past_states):
    """Everything at once, all kinds of landmarks and both kinds of meetings: 1e-9 of each sigma.
    With two past states, late evidence counts; with eight, the closure to the first state as well.
    Copies whose place is used again are what a filter that forgets nothing has."""
    steps, _ = cases.two_robots(np.random.default_rng(21))
    backend = EkfBackend(settings(error, past_states=past_states))
    twin = Twin(error, past_states)
    for step in steps:
        backend.add(step)
        twin.step(step)
    joint = backend.joint("a", [1, 0, 2], ["b"])
    index = np.concatenate([np.r_[twin.place(name)] for name in ("a", 1, 0, 2, "b")])
    T = np.zeros_like(twin.P)
    for name, mean in twin.mean.items():
        T[twin.place(name), twin.place(name)] = twin.turn(mean)
    expected = (T @ twin.P @ T.T)[np.ix_(index, index)]
    sigmas = np.sqrt(np.diag(expected))
    miss = np.concatenate([joint.pose, *joint.landmarks, *joint.others])
    miss -= np.concatenate([twin.mean[name] for name in ("a", 1, 0, 2, "b")])
    assert np.all(np.abs(miss) < 1e-9 * sigmas)
    scale = np.outer(sigmas, sigmas)
    np.testing.assert_allclose(joint.cov / scale, expected / scale, atol=1e-9)


@pytest.mark.parametrize("kernel", ["none", "cauchy"])
@pytest.mark.parametrize("seed", range(8))
def test_body_errors_are_the_filter_of_gtsam_factors(seed, kernel):
    """Mean and covariance after every step, in units of sigma. Some seeds leave heading residuals
    below 1e-3 rad, where GTSAM's derivative of the logarithm cancels: it is off by 1.6e-5 at 1e-4
    rad and by 8e-4 at 3e-5, against 1e-8 here."""
    steps, _ = cases.two_robots(np.random.default_rng(seed))
    config = settings("body", kernel)
    ours, theirs, known = EkfBackend(config), FactorEkfBackend(config), set()
    for step in steps:
        ours.add(step)
        theirs.add(step)
        known |= {a.target for a in step.associations if a.target in cases.MODEL_OF}
        a, b = (backend.joint("b", sorted(known), ["a"]) for backend in (ours, theirs))
        sigmas = np.sqrt(np.diag(a.cov))
        for mine, other in zip((a.pose, *a.landmarks, *a.others),
                               (b.pose, *b.landmarks, *b.others), strict=True):  # fmt: skip
            np.testing.assert_allclose(mine, other, atol=1e-6 * sigmas.min())
        scale = np.outer(sigmas, sigmas)
        np.testing.assert_allclose(a.cov / scale, b.cov / scale, atol=1e-6)
    assert known == {0, 1, 2}


@pytest.mark.parametrize("error", FRAMES)
def test_robots_that_never_met_know_nothing_of_each_other(error):
    """To the digit: what b does leaves a where it was."""
    steps, _ = cases.two_robots(np.random.default_rng(2))
    apart = [
        Step(
            s.time_ns,
            s.starts,
            {"b": s.motions["b"]} if s.motions else {},
            tuple(o for o in s.associations if o.robot == "b" and not o.late),
        )
        for s in steps
    ]
    backend = filtered(apart[:1], settings(error))
    before = backend.joint("a", [])
    for step in apart[1:]:
        backend.add(step)
    joint = backend.joint("a", [0, 1, 2], ["b"])
    np.testing.assert_array_equal(joint.pose, before.pose)
    np.testing.assert_array_equal(joint.cov[:3, :3], before.cov)
    np.testing.assert_array_equal(joint.cov[:3, 3:], 0.0)


@pytest.mark.parametrize("error", FRAMES)
def test_deleting_a_landmark_leaves_the_rest(error):
    """4.6: the marginal of the others stays, and the landmark may be seen anew."""
    steps, where = cases.two_robots(np.random.default_rng(21))
    backend = filtered(steps, settings(error))
    before = backend.joint("b", [2, 0], ["a"])
    backend.remove(1)
    after = backend.joint("b", [2, 0], ["a"])
    np.testing.assert_array_equal(after.cov, before.cov)
    np.testing.assert_array_equal(after.pose, before.pose)
    assert set(backend.finish().landmarks) == {0, 2}
    for ask in (lambda: backend.joint("b", [1]), lambda: backend.remove(1)):
        with pytest.raises(EstimationError, match="landmark 1 is not in the filter"):
            ask()
    backend.add(Step(6, associations=(cases.see("a", 6, 1, "line", where["a"], cases.WORLD[1]),)))
    assert set(backend.finish().landmarks) == {0, 1, 2}


def test_final_is_causal():
    """A filter does not revise: what a state was after its own step it is in the end, whatever came
    later, also at the same state."""
    steps, where = cases.two_robots(np.random.default_rng(21))
    backend, causal = EkfBackend(cases.PLAIN), []
    for step in steps:
        backend.add(step)
        causal.append(backend.joint("b", []))
    backend.add(Step(6, associations=(cases.see("b", 6, 0, "point", where["b"], cases.WORLD[0]),)))
    states = backend.finish().states["b"]
    np.testing.assert_array_equal(states.poses, [joint.pose for joint in causal])
    np.testing.assert_array_equal(states.covs, [joint.cov for joint in causal])


def test_error_and_degrees_of_freedom_are_the_smoothers():
    """In a problem that small noise leaves linear, half the squared normalised innovations add up
    to the smoother's error; measured 2e-4 apart. Without lines: the smoother's wide gauge times a
    direction's residual is no smaller than the noise, however small that is."""
    steps = cases.without_lines(cases.drive(np.random.default_rng(5), 1e-2)[0])
    ours, batch = filtered(steps, cases.PLAIN).finish(), cases.run("batch", steps).finish()
    assert ours.error == pytest.approx(batch.error, rel=2e-3)
    with_lines = cases.drive(np.random.default_rng(5), 1e-2)[0]
    assert (
        filtered(with_lines, cases.PLAIN).finish().dof
        == cases.run("batch", with_lines).finish().dof
    )


# ------------------------------------------------------------ consistency


@pytest.mark.parametrize("error", FRAMES)
def test_final_joint_state_is_as_uncertain_as_it_says(error):
    """NEES of both robots, the point, the segment and the line (without its gauge), 13 degrees of
    freedom, over 60 seeds at small noise (1-4 mm, 2 mrad) within both chi-square bounds at 99.9 %:
    0.84 and 1.18 per degree. Too small means noise counted twice, too large information."""
    values = []
    for seed in range(60):
        steps, true = cases.drive(np.random.default_rng(seed), 2e-2)
        joint = filtered(steps, settings(error)).joint("a", [0, 2, 1], ["b"])
        miss = [joint.pose - true["a"], joint.landmarks[0] - cases.WORLD[0]]
        miss += [joint.landmarks[1] - cases.WORLD[2], rotation3(cases.WORLD[1][2]).T @ (
            joint.landmarks[2] - cases.WORLD[1]), joint.others[0] - true["b"]]  # fmt: skip
        e = np.concatenate([wrap(m) if abs(m[-1]) > 3 else m for m in miss])
        line = joint.slices[2]
        T = np.eye(len(e))
        T[line, line] = rotation3(cases.WORLD[1][2]).T
        keep = np.delete(np.arange(len(e)), line.start)
        P = (T @ joint.cov @ T.T)[np.ix_(keep, keep)]
        values.append(e[keep] @ np.linalg.solve(P, e[keep]))
    dof = 13 * len(values)
    low, high = chi2.ppf([0.0005, 0.9995], dof) / dof
    assert (round(low, 2), round(high, 2)) == (0.84, 1.18)
    assert low < np.sum(values) / dof < high


def corridor(**ekf):
    """60 steps of 0.5 m along a wall of which only the part beside the robot is seen."""
    R = np.diag([1.0, 1e-4, 1e-4])
    steps = [Step(0, {"r": Start(np.zeros(3), np.diag([1e-4, 1e-4, 1e-6]))})]
    for k in range(1, 61):
        seen = Association("r", k, 0, "line", np.array([0.0, 1.5, 0.0]), R)
        moved = cases.motion(k - 1, k, [0.5, 0, 0], np.diag([1e-2, 1e-4, 1e-5]))
        steps.append(Step(k, {}, {"r": moved}, (seen,)))
    joint = filtered(steps, settings(**ekf)).joint("r", [])
    return joint.pose, np.sqrt(joint.cov[0, 0])


def test_lines_as_in_the_thesis_hold_a_robot_back():
    """4.33-4.34: the middle of the seen part taken for a place, however uncertain, pulls the robot
    back to where it saw the wall first, and makes it sure of that: by 0.9 m with 10 m along the
    wall, 7 m with 3 m, 20 m with 1 m. The model's two rows leave the way along the wall to
    odometry: 30 m, sigma 0.1 m per step."""
    pose, sigma = corridor()
    np.testing.assert_allclose(pose, [30.0, 0.0, 0.0], atol=1e-6)
    assert sigma == pytest.approx(0.1 * np.sqrt(60), rel=0.01)
    for along, sigmas in ((10.0, 1), (3.0, 10), (1.0, 40)):
        pose, claimed = corridor(lines="thesis", along_sigma_m=along)
        assert claimed < sigma
        assert 30.0 - pose[0] > sigmas * claimed


# ------------------------------------------------------------ robust, iterated


@pytest.mark.parametrize(
    ("kernel", "estimator"),
    [
        ("huber", gtsam.noiseModel.mEstimator.Huber),
        ("cauchy", gtsam.noiseModel.mEstimator.Cauchy),
        ("geman-mcclure", gtsam.noiseModel.mEstimator.GemanMcClure),
    ],
)
def test_weights_are_gtsams(kernel, estimator):
    for d in (0.0, 0.5, 1.9, 2.1, 7.0, 100.0):
        expected = estimator.Create(2.0).weight(d)
        assert WEIGHTS[kernel](d, 2.0) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("kernel", ["huber", "cauchy", "geman-mcclure"])
@pytest.mark.parametrize("size", [0.3, 3.0, 12.0])
def test_the_weight_agrees_with_the_residual_it_leaves(kernel, size, rng):
    """What an M-estimator's solution is. 1e-3: it is called settled at 1e-4 per round."""
    robust, R, HPHt = RobustConfig(kernel, 2.0), random_cov(rng, 3), random_cov(rng, 3)
    innovation = size * rng.normal(size=3)
    w = robust_weight(innovation, HPHt, R, robust)
    left = innovation - HPHt @ np.linalg.solve(HPHt + R / w, innovation)
    d = np.sqrt(left @ np.linalg.solve(R, left))
    assert w == pytest.approx(WEIGHTS[kernel](d, 2.0), rel=1e-3)
    assert robust_weight(innovation, HPHt, R, RobustConfig("none")) == 1.0


def test_a_far_innovation_is_believed_where_the_prediction_is_poor():
    """50 sigmas of the measurement off, but the prediction is that uncertain: a loop closes. A
    weight by the innovation alone would be 1/600."""
    robust = RobustConfig("cauchy", 2.0)
    assert robust_weight(np.array([50.0]), np.array([[2500.0]]), np.eye(1), robust) > 0.99
    assert robust_weight(np.array([50.0]), np.array([[1.0]]), np.eye(1), robust) < 0.002


def test_a_weight_moves_no_more_than_what_it_is_made_of():
    """Breaks if reweighting ends while it still converges: two filters that are the same but for
    rounding would then use weights that differ by a round."""
    robust, R = RobustConfig("cauchy", 2.0), np.eye(2)
    for size in np.linspace(1.0, 30.0, 60):
        innovation, HPHt = size * np.array([1.0, 0.3]), np.diag([4.0, 0.5])
        w, near = (
            robust_weight(x, HPHt, R, robust) for x in (innovation, innovation * (1 + 1e-13))
        )
        assert near == pytest.approx(w, rel=1e-9)


@pytest.mark.parametrize("error", FRAMES)
def test_an_outlier_is_ignored_with_a_kernel_only(error):
    steps, _ = cases.two_robots(np.random.default_rng(21))
    seen = steps[-1].associations[0]
    wrong = Association("a", 6, 0, "point", seen.z + np.array([0.0, 3.0]), seen.cov)

    def moved(kernel):
        backend = filtered(steps, settings(error, kernel))
        before = backend.landmark_means([0])[0]
        backend.add(Step(6, associations=(wrong,)))
        return np.linalg.norm(backend.landmark_means([0])[0] - before)

    assert seen.model == "point"
    assert moved("cauchy") < 0.1 * moved("none")


@pytest.mark.parametrize("error", FRAMES)
def test_the_iterated_filter_is_the_most_probable_state(error):
    """Bell and Cathey 1993: an update converges to the minimum of prior and measurement together,
    found here by a solver that knows no filter. 1e-6 m or rad."""
    start = Start(np.array([1.0, 0.5, 0.4]), np.diag([0.3, 0.3, 0.1]))
    steps = [Step(0, {"r": start})]
    first = Association("r", 0, 0, "point", np.array([0.8, 2.0]), np.diag([1e-2, 1e-2]))
    steps.append(Step(0, associations=(first,)))
    once = filtered(steps, settings(error))
    P = once._gaussian.P
    means = [once.state_mean("r"), once.landmark_means([0])[0]]
    seen = Association("r", 0, 0, "point", np.array([0.6, 2.4]), np.diag([1e-3, 1e-3]))

    def states(e):
        return ERRORS[error].retract(means[0], e[:3]), means[1] + e[3:]

    L, N = np.linalg.cholesky(P), np.linalg.cholesky(seen.cov)

    def cost(e):
        residual = MODELS["point"].residual(seen.z, *states(e))
        return np.concatenate([np.linalg.solve(L, e), np.linalg.solve(N, residual)])

    best = least_squares(cost, np.zeros(5), xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    found = {}
    for iterations in (1, 30):
        backend = filtered(steps, settings(error, iterations=iterations))
        backend.add(Step(0, associations=(seen,)))
        found[iterations] = np.concatenate([backend.state_mean("r"), *backend.landmark_means([0])])
    np.testing.assert_allclose(found[30], np.concatenate(states(best)), atol=1e-6)
    assert np.abs(found[1] - found[30]).max() > 0.01


# ------------------------------------------------------------ what it cannot use, bad input


@pytest.mark.parametrize(
    ("past_states", "skipped"),
    [
        (0, {"late evidence": 3, "closure to a past state": 1}),
        (1, {"observation from a past state": 3, "closure to a past state": 1}),
        (2, {"closure to a past state": 1}),
        (5, {"closure to a past state": 1}),
        (6, {}),
    ],
)
def test_what_belongs_to_a_forgotten_past_is_skipped_and_counted(past_states, skipped):
    """Late evidence is two states old, the closure's other end six."""
    steps, _ = cases.two_robots(np.random.default_rng(21))
    assert filtered(steps, settings(past_states=past_states)).skipped == Counter(skipped)


@pytest.mark.parametrize("past_states", [0, 3])
def test_the_state_stays_bounded(past_states):
    """Twelve states of a robot: the latest, as many copies as were asked for, one landmark, and no
    more, in either filter; else every step would cost more than the one before."""
    config = settings("body", past_states=past_states)
    for backend in (EkfBackend(config), FactorEkfBackend(config)):
        backend.add(Step(0, {"r": Start(np.zeros(3), cases.MOTION_COV)}))
        seen = cases.see("r", 0, 0, "point", np.zeros(3), cases.WORLD[0])
        backend.add(Step(0, associations=(seen,)))
        for k in range(1, 12):
            backend.add(
                Step(k, motions={"r": cases.motion(k - 1, k, [0.1, 0, 0], cases.MOTION_COV)})
            )
        ekf = isinstance(backend, EkfBackend)
        size = len(backend._gaussian) if ekf else len(backend._root.A)
        assert size == 3 * (1 + past_states) + 2


def test_what_is_skipped_changes_nothing():
    steps, where = cases.two_robots(np.random.default_rng(21))
    backend = filtered(steps, settings(past_states=1))
    skipped = backend.skipped["observation from a past state"]
    before = backend.joint("a", [0, 1, 2], ["b"])
    past = cases.see("a", 4, 0, "point", where["a"], cases.WORLD[0])
    backend.add(Step(6, associations=(past,)))
    assert backend.skipped["observation from a past state"] == skipped + 1
    after = backend.joint("a", [0, 1, 2], ["b"])
    np.testing.assert_array_equal(after.pose, before.pose)
    np.testing.assert_array_equal(after.cov, before.cov)


@pytest.mark.parametrize("error", FRAMES)
def test_a_closure_between_states_of_now_is_a_robot_seen(error):
    steps, where = cases.two_robots(np.random.default_rng(21))
    seen = cases.see("a", 6, "b", "robot-pose", where["a"], where["b"])
    closure = Closure("b", 6, "a", 6, seen.z, seen.cov)
    results = []
    for last in (Step(6, associations=(seen,)), Step(6, closures=(closure,))):
        backend = filtered([*steps, last], settings(error))
        results.append(backend.joint("a", [0, 1, 2], ["b"]))
    np.testing.assert_array_equal(results[0].cov, results[1].cov)
    np.testing.assert_array_equal(results[0].others[0], results[1].others[0])


BAD = {
    "nothing known of it": (np.array([0.3, 2.0]), np.diag([np.inf, np.inf])),
    "no covariance": (np.array([0.3, 2.0]), np.diag([1e-2, -1e-2])),
    "not a number": (np.array([0.3, np.nan]), np.diag([1e-2, 1e-2])),
}


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("what", BAD)
def test_an_indeterminate_landmark_is_named_with_its_robot_and_time(what, known):
    """At its first sighting and at a later one, in one line."""
    backend = filtered([Step(0, {"r": Start(np.zeros(3), 1e-4 * np.eye(3))})], cases.PLAIN)
    if known:
        good = Association("r", 0, 7, "point", np.array([0.3, 2.0]), 1e-2 * np.eye(2))
        backend.add(Step(0, associations=(good,)))
    bad = Association("r", 0, 7, "point", *BAD[what])
    with pytest.raises(EstimationError, match="landmark 7, seen from robot r at 0 ns:") as error:
        backend.add(Step(0, associations=(bad,)))
    assert "\n" not in str(error.value)


def test_a_point_at_range_zero_is_indeterminate():
    """It has no bearing: one direction would be known as well as the robot, with no noise."""
    backend = filtered([Step(0, {"r": Start(np.zeros(3), 1e-4 * np.eye(3))})], cases.PLAIN)
    point = Association("r", 0, 7, "point", np.zeros(2), 1e-4 * np.eye(2))
    with pytest.raises(EstimationError, match="indeterminate at landmark 7, seen from robot r"):
        backend.add(Step(0, associations=(point,)))


def test_a_start_or_a_motion_of_infinite_variance_is_named():
    with pytest.raises(EstimationError, match="start of robot r at 0 ns"):
        filtered([Step(0, {"r": Start(np.zeros(3), np.diag([np.inf, 1, 1]))})], cases.PLAIN)
    backend = filtered([Step(0, {"r": Start(np.zeros(3), cases.MOTION_COV)})], cases.PLAIN)
    with pytest.raises(EstimationError, match="motion of robot r to 4 ns"):
        backend.add(Step(4, motions={"r": cases.motion(0, 4, [1, 0, 0], np.diag([np.inf, 1, 1]))}))
