"""Gates, distances, assignment, joint compatibility: thesis 3.21-3.25 and section 4.6."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from graphslam.core.config import AssociationConfig
from graphslam.core.geometry import between, compose, rotate_cov, wrap
from graphslam.core.observation_models import MODELS, PointModel
from graphslam.core.records import Observation
from graphslam.mapping import gating

UNDIRECTED = AssociationConfig(directed=False)
DIRECTED = AssociationConfig(directed=True)
POSE = np.array([2.0, -1.0, 0.6])
#: nothing added to the measurements
NO_FLOOR = {name: np.zeros_like(floor) for name, floor in gating.gate_floor(DIRECTED).items()}
POINT_COV = np.diag([1e-4, 1e-4])
LINE_COV = np.diag([1.0, 1e-4, 1e-4])


def see_point(position, pose=POSE, cov=POINT_COV):
    return Observation("point", MODELS["point"].predict(pose, np.asarray(position, float)), cov)


def see_line(line, extent, pose=POSE, kind="line", cov=LINE_COV):
    """The line (x, y, direction) in the world, as seen from ``pose``; ``cov`` along its axes."""
    z = between(pose, np.asarray(line, float))
    return Observation(kind, z, rotate_cov(cov, z[2]), np.asarray(extent, float))


def candidates(seen, means, extents=None, *, points=None, whole=None, config=UNDIRECTED, pose=POSE):
    """`candidate_pairs` as {(observation, landmark): (model, flipped)}."""
    m = len(means)
    means = np.array([(*mean, 0.0)[:3] for mean in means])
    pairs = gating.candidate_pairs(
        seen,
        pose,
        means,
        np.zeros((m, 2)) if extents is None else np.array(extents, float),
        np.zeros(m, bool) if points is None else np.array(points),
        np.zeros(m, bool) if whole is None else np.array(whole),
        config,
    )
    keys = zip(pairs.observation.tolist(), pairs.landmark.tolist(), strict=True)
    values = zip(pairs.model, pairs.flipped.tolist(), strict=True)
    return dict(zip(keys, values, strict=True))


def compared(seen, models, states, P_xx=None, pose=POSE, flipped=False, floor=NO_FLOOR):
    """`compare` of observation k with landmark k, landmarks known exactly."""
    k = len(seen)
    index = np.arange(k)
    pairs = gating.Pairs(index, index, tuple(models), np.full(k, flipped), np.zeros(k))
    padded = np.array([(*s, 0.0)[:3] for s in states])
    P = np.zeros((3, 3)) if P_xx is None else P_xx
    zero = np.zeros((k, 3, 3))
    return gating.compare(
        seen, pairs, pose, padded, np.broadcast_to(P, (k, 3, 3)), zero, zero, floor
    )


# ------------------------------------------------------------ gates without covariance


@pytest.mark.parametrize(("distance", "inside"), [(1.4, True), (1.6, False)])
def test_points_pair_within_the_euclidean_gate(distance, inside):
    """3.23: max_distance_m is 1.5 m, in the world, whatever the robot's pose."""
    for direction in (0.0, 2.0, 4.0):
        place = np.array([5.0, 4.0]) + distance * np.array([np.cos(direction), np.sin(direction)])
        found = candidates([see_point([5.0, 4.0])], [place], points=[True])
        assert found == ({(0, 0): ("point", False)} if inside else {})


@pytest.mark.parametrize(("distance", "inside"), [(1.4, True), (1.6, False)])
def test_lines_pair_by_normal_distance_only(distance, inside):
    """A part seen 6 m along the same wall is still the wall; 1.6 m off to the side is not."""
    seen = [see_line([5.0, 4.0, 0.3], [-1, 1])]
    normal = np.array([-np.sin(0.3), np.cos(0.3)])
    along = np.array([np.cos(0.3), np.sin(0.3)])
    wall = np.array([5.0, 4.0]) + distance * normal - 6.0 * along
    found = candidates(seen, [(*wall, 0.3)], [[-8, 8]])
    assert found == ({(0, 0): ("line", False)} if inside else {})


@pytest.mark.parametrize(("gap", "inside"), [(-3.0, True), (0.25, True), (0.35, False)])
@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("turned", [0.0, np.pi])
def test_lines_pair_only_where_they_overlap_or_nearly(gap, inside, side, turned):
    """overlap_gap_m is 0.3: two walls in one row, a door apart, stay two. Before and behind, and
    described in either direction."""
    wall = np.array([1.0, 2.0, 0.4])
    middle = compose(wall, np.array([side * (5.0 + gap + 1.0), 0.0, turned]))
    found = candidates([see_line(middle, [-1, 1])], [wall], [[-5, 5]])
    assert bool(found) == inside


@given(st.floats(-3.14, 3.14), st.floats(-0.55, 0.55), st.booleans())
def test_undirected_lines_are_compared_modulo_pi(direction, error, opposite):
    """3.24: the measured direction is turned by pi when that brings it nearer, and then d² is that
    of the small difference, not of the big one."""
    wall = np.array([6.0, 3.0, direction])
    pose = np.array([6.0, 3.5, 0.0])
    turned = float(wrap(direction + error + (np.pi if opposite else 0.0)))
    seen = see_line([6.0, 3.0, turned], [-1, 1], pose)
    found = candidates([seen], [wall], [[-2, 2]], config=UNDIRECTED, pose=pose)
    assert found == {(0, 0): ("line", opposite)}
    result = compared([seen], ["line"], [wall], pose=pose, flipped=opposite)
    np.testing.assert_allclose(result.residuals[0][1], -error, atol=1e-12)


def test_directed_lines_tell_the_two_sides_of_a_wall():
    wall, away = np.array([6.0, 3.0, 0.2]), np.array([6.0, 3.0, 0.2 + np.pi])
    assert candidates([see_line(wall, [-1, 1])], [wall], [[-2, 2]], config=DIRECTED)
    assert not candidates([see_line(away, [-1, 1])], [wall], [[-2, 2]], config=DIRECTED)
    assert candidates([see_line(away, [-1, 1])], [wall], [[-2, 2]], config=UNDIRECTED)


@pytest.mark.parametrize("config", [DIRECTED, UNDIRECTED])
@pytest.mark.parametrize("beyond", [False, True])
def test_lines_of_quite_different_direction_never_pair(config, beyond):
    error = gating.MAX_ANGLE_RAD + (0.01 if beyond else -0.01)
    seen = [see_line([6.0, 3.0, 0.2 + error], [-1, 1])]
    assert bool(candidates(seen, [[6.0, 3.0, 0.2]], [[-2, 2]], config=config)) != beyond


def test_points_and_lines_never_pair():
    seen = [see_point([5, 4]), see_line([5, 4, 0], [-1, 1])]
    means = [[5, 4, 0], [5, 4, 0]]
    found = candidates(seen, means, [[0, 0], [-1, 1]], points=[True, False])
    assert set(found) == {(0, 0), (1, 1)}


def test_a_points_heading_is_ignored_even_undirected():
    """Its third entry is padding; a flip there would ask a point for its extent."""
    seen = [see_point([5, 4])]
    found = candidates(seen, [[5, 4, 3.0]], points=[True], config=UNDIRECTED)
    assert found == {(0, 0): ("point", False)}


@pytest.mark.parametrize(
    ("kind", "whole", "length", "model"),
    [
        ("segment", True, 2.1, "segment"),
        ("segment", True, 2.3, "line"),  # 0.15 m is the tolerance: an end was hidden
        ("segment", False, 2.0, "line"),
        ("line", True, 2.0, "line"),
    ],
)
def test_ends_count_only_where_both_sides_know_them(kind, whole, length, model):
    """A segment holds its landmark along the wall only if both were seen whole and are as long."""
    seen = [see_line([6, 3, 0.2], [-length / 2, length / 2], kind=kind)]
    found = candidates(seen, [[6, 3, 0.2]], [[-1, 1]], whole=[whole])
    assert found == {(0, 0): (model, False)}


@pytest.mark.parametrize("n", [0, 3])
def test_nothing_seen_or_nothing_known_gives_no_pairs(n):
    seen = [see_point([5, 4])] * n
    pairs = gating.candidate_pairs(
        seen,
        POSE,
        np.zeros((0, 3)),
        np.zeros((0, 2)),
        np.zeros(0, bool),
        np.zeros(0, bool),
        DIRECTED,
    )
    assert len(pairs.observation) == len(pairs.model) == 0
    empty = (np.zeros((0, *s)) for s in [(3,), *[(3, 3)] * 3])
    result = gating.compare(seen, pairs, POSE, *empty, NO_FLOOR)
    assert len(result.d2) == 0


def test_flip_describes_the_same_ends_the_other_way_round():
    seen = see_line([6, 3, 0.2], [-1, 3])
    turned = gating.flip(seen)
    for a, b in ((0, 1), (1, 0)):
        np.testing.assert_allclose(
            compose(turned.z, np.array([turned.extent[a], 0, 0]))[:2],
            compose(seen.z, np.array([seen.extent[b], 0, 0]))[:2],
            atol=1e-15,
        )
    again = gating.flip(turned)
    np.testing.assert_allclose(wrap(again.z[2] - seen.z[2]), 0, atol=1e-15)
    np.testing.assert_array_equal(again.extent, seen.extent)


# ------------------------------------------------------------ distances


def random_joint(rng, dim):
    """Covariance of (pose, target) with strong correlation; sigmas of 3 mm keep it linear."""
    root = 0.003 * rng.normal(size=(3 + dim, 3 + dim))
    return root @ root.T + 1e-6 * np.eye(3 + dim)


@pytest.mark.parametrize("probability", [0.5, 0.99])
@pytest.mark.parametrize("name", sorted(MODELS))
def test_gate_accepts_its_probability_of_true_pairs(name, probability):
    """3.22 and 3.25 on 4000 true pairs with pose, target and measurement drawn from their joint
    covariance: forgetting the cross terms, the lever arm of a line or the frame of R breaks it.
    Tolerance: four sigmas of a binomial share."""
    rng, model, n = np.random.default_rng(42), MODELS[name], 4000
    x = np.array([1.0, 2.0, 0.7])
    t = np.array([4.0, 4.5, -2.0])[: model.dim]
    P = random_joint(rng, model.dim)
    draws = rng.multivariate_normal(np.concatenate([x, t]), P, n)
    width = 2 if isinstance(model, PointModel) else 3
    root = 0.003 * rng.normal(size=(width, width))
    cov = root @ root.T + 1e-6 * np.eye(width)
    exact = model.predict(draws[:, :3], draws[:, 3:])
    if name == "line":  # any part of the wall may be seen
        exact = compose(exact, np.column_stack([rng.uniform(-2, 2, n), np.zeros(n), np.zeros(n)]))
    z = exact + rng.multivariate_normal(np.zeros(width), cov, n)
    seen = [Observation("line", v, cov, np.zeros(2)) for v in z]
    index = np.arange(n)
    pairs = gating.Pairs(index, index, (name,) * n, np.zeros(n, bool), np.zeros(n))
    padded = np.broadcast_to((*t, 0.0)[:3], (n, 3))
    full = np.zeros((6, 6))
    full[: 3 + model.dim, : 3 + model.dim] = P
    blocks = [full[:3, :3], full[:3, 3:], full[3:, 3:]]
    stacked = (np.broadcast_to(b, (n, 3, 3)) for b in blocks)
    result = gating.compare(seen, pairs, x, padded, *stacked, NO_FLOOR)
    assert set(result.dof) == {model.rows}
    share = np.mean(result.d2 < gating.gate_distance(probability, result.dof))
    assert abs(share - probability) < 4 * np.sqrt(probability * (1 - probability) / n)


@pytest.mark.parametrize("away", [0.0, 6.0, -15.0])
@pytest.mark.parametrize("turn", [0.0, 1.2, -2.5])
def test_the_floor_of_a_wall_is_where_it_passes_the_robot(away, turn):
    """A door 0.1 m behind its wall is as far off wherever the landmark has its origin. Added at the
    origin, the floor of the direction hides it from some metres on: at 15 m d² would be 0.5."""
    config = AssociationConfig(floor_m=0.03, floor_rad=0.03)
    wall = compose(POSE, compose(np.array([0.0, 0.0, turn]), np.array([0.0, 2.0, 0.0])))
    line = compose(wall, np.array([away, 0.1, 0.0]))
    seen = [see_line(wall, (-0.4, 0.4), cov=np.diag([0.04, 1e-4, 1e-4]))]
    d2 = compared(seen, ["line"], [line], floor=gating.gate_floor(config)).d2
    assert d2[0] == pytest.approx(0.1**2 / (0.03**2 + 1e-4), rel=1e-6)


@pytest.mark.parametrize("ahead", [0.0, 3.0, 8.0])
def test_a_wall_that_is_seen_turned_about_the_robot_is_as_far_off_at_any_distance(ahead):
    """Odometry that turned by 0.06 rad too much: 8 m ahead that is 0.5 m across. Added where the
    wall is seen, the floor of the direction refuses it: d² would be 260."""
    config = AssociationConfig(floor_m=0.03, floor_rad=0.03)
    wall = compose(POSE, np.array([ahead, 1.0, 0.0]))
    turned = compose(POSE, compose(np.array([0.0, 0.0, 0.06]), np.array([ahead, 1.0, 0.0])))
    seen = [see_line(turned, (-0.4, 0.4), cov=np.diag([0.04, 1e-10, 1e-10]))]
    d2 = compared(seen, ["line"], [wall], floor=gating.gate_floor(config)).d2
    # the second order of the turn: 1 m to the side moves by 2 mm
    assert d2[0] == pytest.approx((0.06 / 0.03) ** 2, abs=0.1)


@pytest.mark.parametrize("heading", [0.0, 1.5])
def test_the_floor_of_a_sighted_robot_is_the_same_whichever_way_it_heads(heading):
    """A robot 8 m ahead that is 0.24 m aside and 0.03 rad turned: eight floors and one. The floor
    of a wall would turn it about us if it drove away from us (d² 1), and less if across."""
    config = AssociationConfig(floor_m=0.03, floor_rad=0.03)
    seen = [Observation("robot-pose", np.array([8.0, 0.0, heading]), 1e-10 * np.eye(3))]
    there = compose(POSE, np.array([8.0, 0.24, heading + 0.03]))
    d2 = compared(seen, ["robot-pose"], [there], floor=gating.gate_floor(config)).d2
    # residuals are logarithms: of 0.03 rad a second order of 4e-5 of the whole
    assert d2[0] == pytest.approx(8.0**2 + 1.0, rel=1e-3)


def test_gate_is_the_chi_square_quantile():
    assert gating.gate_distance(0.99, 2) == pytest.approx(9.2103, abs=1e-4)
    np.testing.assert_allclose(
        gating.gate_distance(0.99, np.array([[1, 2], [3, 9]])), chi2.ppf(0.99, [[1, 2], [3, 9]])
    )


def test_compare_of_mixed_models_equals_one_at_a_time():
    """The rows are computed model by model; each result must land at its own pair."""
    seen = [see_point([5, 4]), see_line([6, 3, 0.2], [-1, 1]), see_point([4, 4])]
    models, states = ["point", "line", "point"], [[5.1, 4.0], [6.0, 3.1, 0.25], [4.0, 4.2]]
    P = np.diag([1e-2, 2e-2, 1e-3])
    together = compared(seen, models, states, P)
    for n in range(3):
        alone = compared(seen[n : n + 1], models[n : n + 1], states[n : n + 1], P)
        np.testing.assert_allclose(together.d2[n], alone.d2[0], rtol=1e-13)
        np.testing.assert_array_equal(together.residuals[n], alone.residuals[0])


def test_floor_widens_the_gate_by_its_covariance():
    """A 3 cm miss with 1 cm of noise and a floor of sqrt(8) cm: nine becomes one."""
    pose, floor = np.zeros(3), dict(NO_FLOOR) | {"point": np.diag([0.0, 8e-4])}
    seen = [Observation("point", np.array([0.0, 5.0]), np.diag([1e-6, 1e-4]))]
    for added, expected in ((NO_FLOOR, 9.0), (floor, 1.0)):
        result = compared(seen, ["point"], [[5.03, 0.0]], pose=pose, floor=added)
        np.testing.assert_allclose(result.d2, expected, rtol=1e-12)


# ------------------------------------------------------------ assignment


def figure_3_1():
    """Two objects and two measurements shifted sideways by one common error, as points through the
    whole chain: distances (2, 2) and gates."""
    objects, shift = np.array([[3.0, 0.0], [3.0, 2.0]]), np.array([0.0, 1.1])
    cov = np.diag([1e-6, 1e-6])
    pose = np.zeros(3)
    seen = [see_point(o + shift, pose, cov) for o in objects]
    P = np.diag([0.6**2, 0.6**2, 1e-6])
    config = AssociationConfig(max_distance_m=10.0)
    found = gating.candidate_pairs(
        seen, pose, np.column_stack([objects, [0, 0]]), np.zeros((2, 2)), np.ones(2, bool),
        np.zeros(2, bool), config,
    )  # fmt: skip
    k = len(found.observation)
    states = np.column_stack([objects, [0, 0]])[found.landmark]
    zero = np.zeros((k, 3, 3))
    P_xx = np.broadcast_to(P, (k, 3, 3))
    result = gating.compare(seen, found, pose, states, P_xx, zero, zero, NO_FLOOR)
    cost = np.full((2, 2), np.inf)
    cost[found.observation, found.landmark] = result.d2
    return cost, np.full((2, 2), float(gating.gate_distance(0.99, 2)))


def test_figure_3_1_greedy_pairs_wrongly():
    """The thesis' own example of what its fast variant does: z1 takes object 2. What is left for z2
    is object 1, too far away, or accepted where the gate is wide."""
    cost, gate = figure_3_1()
    assert gating.assign(cost, gate, "greedy") == [(0, 1)]
    assert gating.assign(cost, np.full((2, 2), 1e6), "greedy") == [(0, 1), (1, 0)]


def test_figure_3_1_optimal_pairs_rightly():
    cost, gate = figure_3_1()
    assert gating.assign(cost, gate, "optimal") == [(0, 0), (1, 1)]


@st.composite
def tables(draw):
    n, m = draw(st.integers(1, 4)), draw(st.integers(1, 4))
    cell = st.one_of(st.floats(0, 20), st.just(np.inf))
    cost = draw(st.lists(st.lists(cell, min_size=m, max_size=m), min_size=n, max_size=n))
    gate = draw(
        st.lists(st.lists(st.floats(0.1, 15), min_size=m, max_size=m), min_size=n, max_size=n)
    )
    return np.array(cost), np.array(gate)


def total(pairs, cost, gate):
    """Cost of an assignment: a row left alone costs its gate (if it had a choice at all)."""
    alone = [max((g for c, g in zip(*rows, strict=True) if c < g), default=0.0)
             for rows in zip(cost, gate, strict=True)]  # fmt: skip
    rows = dict(pairs)
    return sum(cost[i, rows[i]] if i in rows else alone[i] for i in range(len(cost)))


@given(tables())
def test_optimal_assignment_equals_brute_force(table):
    """All one-to-one assignments of up to 4 x 4, impossible pairs and gates included."""
    cost, gate = table
    n, m = cost.shape
    best = np.inf
    for columns in itertools.product(range(m + 1), repeat=n):
        taken = [(i, j) for i, j in enumerate(columns) if j < m]
        free = len({j for _, j in taken}) == len(taken)
        if free and all(cost[i, j] < gate[i, j] for i, j in taken):
            best = min(best, total(taken, cost, gate))
    pairs = gating.assign(cost, gate, "optimal")
    assert all(cost[i, j] < gate[i, j] for i, j in pairs)
    assert len({i for i, _ in pairs}) == len({j for _, j in pairs}) == len(pairs)
    assert pairs == sorted(pairs)
    # the solver adds numbers of 1e9 for what is impossible: 1e-7 of rounding
    assert total(pairs, cost, gate) == pytest.approx(best, abs=1e-6)


@given(tables())
def test_greedy_assignment_takes_the_smallest_left(table):
    """The thesis' words: pick the smallest element, strike its row and column, repeat."""
    cost, gate = table
    cells = sorted((cost[i, j], i, j) for i, j in np.ndindex(cost.shape) if cost[i, j] < gate[i, j])
    expected, rows, columns = [], set(), set()
    for _, i, j in cells:
        if i not in rows and j not in columns:
            expected.append((i, j))
            rows.add(i)
            columns.add(j)
    assert gating.assign(cost, gate, "greedy") == sorted(expected)


# ------------------------------------------------------------ several pairs together

PLACES = np.array([[5.0, 0.0], [5.0, 3.0], [2.0, 4.0]])


def shifted_triple(shifts):
    """Three points seen from the origin, each moved by its own shift; the pose is known to 1 m."""
    pose = np.zeros(3)
    seen = [see_point(p + s, pose) for p, s in zip(PLACES, np.asarray(shifts, float), strict=True)]
    P = np.diag([1.0, 1.0, 1e-4])
    result = compared(seen, ["point"] * 3, PLACES, P, pose)
    joint = np.zeros((9, 9))
    joint[:3, :3] = P
    slices = [slice(3 + 2 * k, 5 + 2 * k) for k in range(3)]
    return result, joint, slices


def test_individually_compatible_contradicting_triple_is_rejected_jointly():
    """Each could be explained by the pose's uncertainty, but not by one pose: a false closure."""
    result, joint, slices = shifted_triple([[0.8, 0], [-0.8, 0], [0, 0.8]])
    assert np.all(result.d2 < gating.gate_distance(0.99, result.dof))
    assert not gating.jointly_compatible(result, [0, 1, 2], slices, joint, 0.99)
    for one in range(3):
        assert gating.jointly_compatible(result, [one], slices[one : one + 1], joint, 0.99)


def test_triple_that_agrees_on_one_pose_is_accepted_jointly():
    result, joint, slices = shifted_triple([[0.8, 0.3]] * 3)
    assert gating.jointly_compatible(result, [0, 1, 2], slices, joint, 0.99)


def test_joint_gate_accepts_its_probability_of_true_triples():
    """Pose and landmarks drawn from a joint covariance: 1000 triples, four binomial sigmas."""
    rng, n, pose = np.random.default_rng(8), 1000, np.zeros(3)
    root = 0.003 * rng.normal(size=(9, 9))
    P = root @ root.T + 1e-6 * np.eye(9)
    slices = [slice(3 + 2 * k, 5 + 2 * k) for k in range(3)]
    mean = np.concatenate([pose, PLACES.ravel()])
    accepted = 0
    for draw in rng.multivariate_normal(mean, P, n):
        z = MODELS["point"].predict(draw[:3], draw[3:].reshape(3, 2))
        z = z + rng.normal(0, 0.01, size=(3, 2))
        seen = [Observation("point", v, POINT_COV) for v in z]
        result = compared(seen, ["point"] * 3, PLACES, pose=pose)
        accepted += gating.jointly_compatible(result, [0, 1, 2], slices, P, 0.9)
    assert abs(accepted / n - 0.9) < 4 * np.sqrt(0.9 * 0.1 / n)


@pytest.mark.parametrize(
    ("targets", "fixed"),
    [
        ([[6, 3, 0.2], [6, -3, 0.2]], False),  # a corridor
        ([[6, 3, 0.2], [6, -3, 0.2 + np.pi], [0, 5, 0.2]], False),
        ([[6, 3, 0.2], [9, 0, 0.2 + np.pi / 2]], True),
        ([[6, 3, 0.2], [9, 0, 0.2 + np.radians(1)]], False),
        ([[6, 3, 0.2], [9, 0, 0.2 + np.radians(30)]], True),
        ([[5, 4]], False),  # bearing and range of one point: the robot may circle it
        ([[5, 4], [2, 5]], True),
        ([[5, 4], [6, 3, 0.2]], True),
        ([], False),
    ],
)
def test_only_pairs_that_leave_no_direction_free_fix_the_pose(targets, fixed):
    seen = [see_point(t) if len(t) == 2 else see_line(t, [-1, 1]) for t in targets]
    models = ["point" if len(t) == 2 else "line" for t in targets]
    if not targets:
        result = compared([see_point([5, 4])], ["point"], [[5, 4]])
        assert not gating.fixes_pose(result, [])
        return
    result = compared(seen, models, targets)
    assert gating.fixes_pose(result, range(len(targets))) == fixed


def test_where_the_walls_are_seen_does_not_matter_for_fixing_the_pose():
    """The measured middle slides along the wall; two perpendicular walls still fix the pose."""
    for along in (-3.0, 4.0):
        a, b = (compose(np.array(w), np.array([along, 0, 0])) for w in ([6, 3, 0.2], [9, 0, 1.77]))
        seen = [see_line(a, [-1, 1]), see_line(b, [-1, 1])]
        assert gating.fixes_pose(compared(seen, ["line"] * 2, [[6, 3, 0.2], [9, 0, 1.77]]), [0, 1])


def test_as_printed_two_walls_are_near_if_their_middles_are():
    """3.23 with ``nearness = middle``: no distance across, no overlap, no test of the length; so a
    long wall seen in part is another one, and a segment of another length is the same."""
    printed = AssociationConfig(nearness="middle", directed=False, max_distance_m=1.5)
    landmark, extent = (5.0, 2.0, 0.3), (-3.0, 3.0)
    along = compose(np.array(landmark), np.array([2.0, 0.0, 0.0]))
    seen = [see_line(along, (-0.5, 0.5), kind="segment")]
    assert candidates(seen, [landmark], [extent], whole=[True], config=printed) == {}
    assert candidates(seen, [landmark], [extent], whole=[True]) == {(0, 0): ("line", False)}
    beside = compose(np.array(landmark), np.array([1.0, 0.5, 0.9]))  # turned by 0.9 rad
    seen = [see_line(beside, (-0.5, 0.5), kind="segment")]
    found = candidates(seen, [landmark], [extent], whole=[True], config=printed)
    assert found == {(0, 0): ("segment", False)}
    assert candidates(seen, [landmark], [extent], whole=[True]) == {}
