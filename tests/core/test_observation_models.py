"""Observation models: every row of `MODELS` against finite differences and against itself."""

import numpy as np
import pytest
from finite_differences import jacobian

from graphslam.core.geometry import compose, inverse, rotation, rotation3, wrap
from graphslam.core.observation_models import MODELS, LineModel, PointModel, PoseModel, transport
from graphslam.estimation.factors import FACTORS

#: finite differences of functions of size ten, see `finite_differences.STEP`; a wrong entry is 1e-2
DIFFERENCES = 1e-8
ROWS = sorted(MODELS)
OF_ROBOTS = [name for name in ROWS if name.startswith("robot")]


def width(name):
    """Size of a measurement of the row."""
    return 2 if isinstance(MODELS[name], PointModel) else 3


def random_case(name, seed, error=0.1):
    """(z, x, t): observing pose, target, and a measurement that misses by ``error`` (m, rad)."""
    rng = np.random.default_rng(seed)
    x = np.array([*rng.uniform(-5, 5, 2), rng.uniform(-3, 3)])
    t = np.array([*rng.uniform(-5, 5, 2), rng.uniform(-3, 3)])[: MODELS[name].dim]
    z = MODELS[name].predict(x, t) + error * rng.normal(size=width(name))
    return z, x, t


def frozen(name, z, x, t):
    """Residual as a function of (x, t). A line's measurement is moved along its line to face the
    target once, at the given estimate, as its factor does."""
    model = MODELS[name]
    if isinstance(model, LineModel):
        facing = model.facing(z, x, t)
        return lambda a, b: PoseModel().residual(facing, a, b)[..., 1:]
    return lambda a, b: model.residual(z, a, b)


# ------------------------------------------------------------ Jacobians


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", ROWS)
def test_jacobians_inside_a_state_of_two_robots_and_three_landmarks(name, seed):
    """The full H, zeros included, against the derivative of a function of the whole state in
    shuffled order: a swapped block, a sign, or a derivative by the wrong pose breaks it."""
    model, rng = MODELS[name], np.random.default_rng(100 + seed)
    sizes = {"robot a": 3, "robot b": 3, "landmark 0": 2, "landmark 1": 3, "landmark 2": model.dim}
    order = list(rng.permutation(sorted(sizes)))
    ends = np.cumsum([sizes[key] for key in order])
    where = {key: slice(end - sizes[key], end) for key, end in zip(order, ends, strict=True)}
    state = rng.uniform(-3, 3, ends[-1])
    observer, target = "robot b", "robot a" if name in OF_ROBOTS else "landmark 2"
    z, x, t = random_case(name, seed)
    state[where[observer]], state[where[target]] = x, t

    residual = frozen(name, z, x, t)
    numeric = jacobian(lambda s: residual(s[where[observer]], s[where[target]]), state)
    H = np.zeros((model.rows, len(state)))
    H[:, where[observer]], H[:, where[target]] = model.jacobians(z, x, t)
    np.testing.assert_allclose(H, numeric, atol=DIFFERENCES)
    np.testing.assert_allclose(residual(x, t), model.residual(z, x, t), atol=1e-14)


@pytest.mark.parametrize("seed", range(5))
def test_line_jacobians_are_whole_where_the_line_fits(seed):
    """How far the measurement slides depends on the state, too; at zero residual that is second
    order, so the derivative of the full residual (sliding included) agrees."""
    z, x, t = random_case("line", seed, error=0.0)
    z = compose(z, np.array([2.5, 0.0, 0.0]))  # another part of the same wall
    model = MODELS["line"]
    H_x, H_t = model.jacobians(z, x, t)
    numeric_x = jacobian(lambda a: model.residual(z, a, t), x)
    numeric_t = jacobian(lambda b: model.residual(z, x, b), t)
    np.testing.assert_allclose(H_x, numeric_x, atol=DIFFERENCES)
    np.testing.assert_allclose(H_t, numeric_t, atol=DIFFERENCES)


@pytest.mark.parametrize("seed", range(3))
def test_pose_jacobians_are_the_thesis_ones(seed):
    """4.20-4.21 as printed, for z = h, up to the turn into the measured pose's axes."""
    z, x, t = random_case("segment", seed, error=0.0)
    H_x, H_t = MODELS["segment"].jacobians(z, x, t)
    c, s = np.cos(x[2]), np.sin(x[2])
    dx, dy = t[:2] - x[:2]
    printed = [[-c, -s, -s * dx + c * dy], [s, -c, -c * dx - s * dy], [0, 0, -1]]
    np.testing.assert_allclose(rotation3(z[2]) @ H_x, printed, atol=1e-13)
    np.testing.assert_allclose(rotation3(z[2]) @ H_t, rotation3(-x[2]), atol=1e-13)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", ROWS)
def test_invert_jacobians_equal_finite_differences(name, seed):
    """G_x and G_z of 4.25-4.28: they make a new landmark's covariance."""
    model = MODELS[name]
    z, x, _ = random_case(name, seed)
    G_x, G_z = model.invert_jacobians(z, x)

    def unwrapped(z, x):
        """Headings differ from the wrapped ones by whole turns, which a derivative must not see."""
        t = model.invert(z, x)
        if width(name) == 3:
            t[2] = x[2] + z[2]
        return t

    np.testing.assert_allclose(G_x, jacobian(lambda v: unwrapped(z, v), x), atol=DIFFERENCES)
    np.testing.assert_allclose(G_z, jacobian(lambda v: unwrapped(v, x), z), atol=DIFFERENCES)


# ------------------------------------------------------------ consistency of each row


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", ROWS)
def test_invert_and_predict_undo_each_other(name, seed):
    model = MODELS[name]
    z, x, t = random_case(name, seed, error=0.0)
    back = model.invert(z, x)
    np.testing.assert_allclose(back[:2], t[:2], atol=1e-13)  # coordinates of 10 m, a few roundings
    if name == "robot-point":
        assert back[2] == 0.0  # bearing and range say nothing of a heading
    elif model.dim == 3:
        np.testing.assert_allclose(wrap(back[2] - t[2]), 0, atol=1e-13)
    again = model.predict(x, back)
    np.testing.assert_allclose(again, z, atol=1e-13)
    np.testing.assert_allclose(model.residual(z, x, t), 0, atol=1e-13)


@pytest.mark.parametrize("name", ROWS)
def test_residual_is_expected_minus_measured(name):
    """The sign of GTSAM. A robot at the origin; the target is farther (0.2 m), more to the left
    (0.1 m or rad) and turned more (0.05 rad) than measured."""
    model, x = MODELS[name], np.zeros(3)
    if width(name) == 2:
        z, t = np.array([0.3, 2.0]), 2.2 * np.array([np.cos(0.4), np.sin(0.4), 0.0])[: model.dim]
        expected = [0.1, 0.2]
    else:
        z, t = np.array([2.0, 1.0, 0.0]), np.array([2.2, 1.1, 0.05])
        expected = [0.2, 0.1, 0.05][-model.rows :]
    np.testing.assert_allclose(model.residual(z, x, t), expected, atol=6e-3)  # half of 0.05 * 0.2


@pytest.mark.parametrize("name", ["point", "robot-point"])
def test_bearing_residual_is_wrapped(name):
    """A target straight behind: 3.1 measured, -3.1 expected are 0.08 rad apart, not 6.2."""
    t = np.array([np.cos(-3.1), np.sin(-3.1), 0.0])[: MODELS[name].dim]
    residual = MODELS[name].residual(np.array([3.1, 1.0]), np.zeros(3), t)
    np.testing.assert_allclose(residual, [2 * np.pi - 6.2, 0.0], atol=1e-15)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", ROWS)
def test_noise_is_the_measurements_covariance_seen_in_the_residual(name, seed):
    """J R Jᵀ with J the derivative of the residual by z, at z = h (a line: another part of it, so
    that the lever arm of its direction error counts; without it this breaks)."""
    model, rng = MODELS[name], np.random.default_rng(seed)
    z, x, t = random_case(name, seed, error=0.0)
    if name == "line":
        z = compose(z, np.array([rng.uniform(-3, 3), 0.0, 0.0]))
    root = 0.1 * rng.normal(size=(len(z), len(z)))
    cov = root @ root.T
    J = jacobian(lambda v: model.residual(v, x, t), z)
    np.testing.assert_allclose(model.noise(z, cov, x, t), J @ cov @ J.T, atol=1e-9)


@pytest.mark.parametrize("name", ROWS)
def test_rows_broadcast_over_leading_axes(name):
    """The vectorised gates compute a stack; each member must equal its own single computation."""
    model = MODELS[name]
    cases = [random_case(name, seed) for seed in range(5)]
    z, x, t = (np.array(part) for part in zip(*cases, strict=True))
    root = np.random.default_rng(0).normal(size=(5, width(name), width(name)))
    cov = root @ root.mT
    together = [model.residual(z, x, t), model.predict(x, t), model.noise(z, cov, x, t)]
    together += [*model.jacobians(z, x, t), model.invert(z, x), *model.invert_jacobians(z, x)]
    for n in range(5):
        one = [model.residual(z[n], x[n], t[n]), model.predict(x[n], t[n])]
        one += [model.noise(z[n], cov[n], x[n], t[n]), *model.jacobians(z[n], x[n], t[n])]
        one += [model.invert(z[n], x[n]), *model.invert_jacobians(z[n], x[n])]
        for a, b in zip(together, one, strict=True):
            np.testing.assert_allclose(a[n], b, atol=1e-14)


def test_line_residual_does_not_feel_where_on_the_line_it_was_measured():
    """Sliding z along its own line changes nothing: no information along the wall. Treating the
    middle of a partly seen wall as a point breaks it at once."""
    z, x, t = random_case("line", 3)
    model = MODELS["line"]
    for along in (-7.0, 0.5, 20.0):
        slid = compose(z, np.array([along, 0.0, 0.0]))
        np.testing.assert_allclose(model.residual(slid, x, t), model.residual(z, x, t), atol=1e-13)


def test_line_residual_is_normal_offset_and_direction():
    """A wall along x, seen from 2 m below: the estimate has it 0.3 m too far to the left of its
    direction; exact, whatever part was seen."""
    z, x = np.array([5.0, 2.0, np.pi]), np.zeros(3)
    t = np.array([-4.0, 1.7, np.pi])  # left of direction pi is down
    np.testing.assert_allclose(MODELS["line"].residual(z, x, t), [0.3, 0.0], atol=1e-14)


@pytest.mark.parametrize("name", ROWS)
def test_every_model_has_a_factor(name):
    """Adding a kind of observation means one row in both tables."""
    assert name in FACTORS
    assert set(FACTORS) == set(MODELS)
    assert {MODELS[name].rows, MODELS[name].dim} <= {2, 3}


# ------------------------------------------------------------ transport


MOUNT = np.array([0.3, -0.1, 0.7])
MOUNT_COV = np.diag([4e-4, 1e-4, 9e-5]) + 2e-5


def test_transport_of_a_pose_is_composition():
    """A laser's mount: what it sees at z is at mount∘z for the base, its covariance turned with
    it."""
    z, cov = np.array([2.0, 1.0, 0.4]), np.diag([1e-2, 1e-4, 1e-5])
    moved, moved_cov = transport(z, cov, MOUNT, np.zeros((3, 3)))
    np.testing.assert_allclose(moved, compose(MOUNT, z), atol=1e-15)
    M = rotation3(MOUNT[2])
    np.testing.assert_allclose(moved_cov, M @ cov @ M.T, atol=1e-17)


def test_transport_of_bearing_and_range_keeps_the_point():
    z, cov = np.array([0.5, 3.0]), np.diag([1e-4, 4e-4])
    moved, _ = transport(z, cov, MOUNT, np.zeros((3, 3)))
    point = MOUNT[:2] + rotation(MOUNT[2]) @ (3.0 * np.array([np.cos(0.5), np.sin(0.5)]))
    found = moved[1] * np.array([np.cos(moved[0]), np.sin(moved[0])])
    np.testing.assert_allclose(found, point, atol=1e-15)


@pytest.mark.parametrize("z", [np.array([0.5, 3.0]), np.array([2.0, 1.0, 0.4])])
def test_transport_covariance_equals_finite_differences(z):
    """Of the measurement and of the frame that it is given in, together."""
    cov = np.diag([3e-4, 4e-4, 1e-4])[: len(z), : len(z)] + 1e-5
    _, found = transport(z, cov, MOUNT, MOUNT_COV)
    J_f = jacobian(lambda f: transport(z, cov, f, MOUNT_COV)[0], MOUNT)
    J_z = jacobian(lambda v: transport(v, cov, MOUNT, MOUNT_COV)[0], z)
    np.testing.assert_allclose(found, J_f @ MOUNT_COV @ J_f.T + J_z @ cov @ J_z.T, atol=1e-11)


@pytest.mark.parametrize("z", [np.array([0.5, 3.0]), np.array([2.0, 1.0, 0.4])])
def test_transport_covariance_equals_monte_carlo(z):
    rng, n = np.random.default_rng(17), 20_000
    cov = np.diag([3e-5, 4e-5, 1e-5])[: len(z), : len(z)]
    _, expected = transport(z, cov, MOUNT, 0.1 * MOUNT_COV)
    frames = rng.multivariate_normal(MOUNT, 0.1 * MOUNT_COV, n)
    seen = rng.multivariate_normal(z, cov, n)
    # transport takes one measurement at a time
    samples = np.array(
        [
            transport(v, cov, f, MOUNT_COV)[0]
            for v, f in zip(seen[:4000], frames[:4000], strict=True)
        ]
    )
    d = np.diag(expected)
    sampling = np.sqrt((np.outer(d, d) + expected**2) / len(samples))
    assert np.all(np.abs(np.cov(samples.T) - expected) < 5 * sampling)


@pytest.mark.parametrize("z", [np.array([0.5, 3.0]), np.array([2.0, 1.0, 0.4])])
def test_transport_there_and_back_changes_nothing(z):
    cov, rigid = np.diag([3e-4, 4e-4, 1e-4])[: len(z), : len(z)], np.zeros((3, 3))
    there = transport(z, cov, MOUNT, rigid)
    back = transport(*there, inverse(MOUNT), rigid)
    np.testing.assert_allclose(back[0], z, atol=1e-14)
    np.testing.assert_allclose(back[1], cov, atol=1e-17)
    same = transport(z, cov, np.zeros(3), rigid)
    np.testing.assert_array_equal(same[0], z)
    np.testing.assert_array_equal(same[1], cov)
