"""The pose graph of submaps: its optimum, its covariance, and what happens to paths behind it."""

import gtsam
import numpy as np
import pytest

from graphslam.core.errors import EstimationError
from graphslam.core.geometry import between, compose, log, rotate_cov
from graphslam.estimation import factors
from graphslam.mapping.submap_graph import SubmapConstraints, SubmapGraph
from graphslam.scan_smoothing.path_closing import LandmarkUncertainty, move_between_anchors

START = 1e-8 * np.eye(3)[None]
COV = np.diag([0.05, 0.03, 0.02]) ** 2


def ring(n=12, seed=0):
    """A noisy ring: true poses, the chain as measured, and poses composed of it."""
    rng = np.random.default_rng(seed)
    true = [np.zeros(3)]
    for _ in range(n - 1):
        true.append(compose(true[-1], np.array([2.0, 0.0, 2 * np.pi / n])))
    true = np.array(true)
    delta = between(true[:-1], true[1:]) + rng.multivariate_normal(np.zeros(3), COV, n - 1)
    poses = [np.zeros(3)]
    for d in delta:
        poses.append(compose(poses[-1], d))
    begin = np.arange(n - 1)
    chain = SubmapConstraints(begin, begin + 1, delta, np.tile(COV, (n - 1, 1, 1)))
    closure = SubmapConstraints(
        np.array([0]), np.array([n - 1]), between(true[0], true[-1])[None], 0.04 * COV[None]
    )
    return true, chain, np.array(poses), closure


def by_gtsam(chain, closure, poses):
    """The same graph by GTSAM: poses (n, 3) and marginals (n, 3, 3), errors in body frames."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), gtsam.noiseModel.Isotropic.Sigma(3, 1e-4)))
    every = chain.and_also(closure)
    for i, j, d, c in zip(every.begin, every.end, every.delta, every.cov, strict=True):
        noise = gtsam.noiseModel.Gaussian.Covariance(rotate_cov(c, -d[2]))
        graph.add(gtsam.BetweenFactorPose2(int(i), int(j), factors.pose2(d), noise))
    for k, pose in enumerate(poses):
        values.insert(k, factors.pose2(pose))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    marginals = gtsam.Marginals(graph, solved)
    return (
        np.array([factors.array3(solved.atPose2(k)) for k in range(len(poses))]),
        np.array([marginals.marginalCovariance(k) for k in range(len(poses))]),
    )


def test_the_optimum_is_that_of_gtsam():
    """Poses to 1 mm: its linearisation leaves out the Jacobian of the logarithm, which is second
    order in residuals of 0.02 rad. Covariances to 2 %."""
    _, chain, poses, closure = ring()
    graph = SubmapGraph(poses, chain, [0], START)
    graph.solve(closure)
    expected, covs = by_gtsam(chain, closure, poses)
    np.testing.assert_allclose(graph.poses, expected, atol=1e-3)
    for k in (3, 7, 11):
        np.testing.assert_allclose(
            graph.covariance(np.array([k])), covs[k], rtol=0.02, atol=2e-2 * covs[k].max()
        )


def test_relative_covariances_are_those_of_the_joint():
    """Also where more submaps are asked for than are solved for at once."""
    _, chain, poses, closure = ring(n=130)
    graph = SubmapGraph(poses, chain, [0], START)
    graph.solve(closure)
    i, j = np.array([129, 60, 128]), np.array([3, 59, 1])
    h, cov = graph.relative(i, j)
    np.testing.assert_allclose(h, between(graph.poses[j], graph.poses[i]), atol=1e-12)
    # of neighbours: at most that of the measurement between them
    assert np.all(np.diag(cov[1]) <= np.diag(COV) * 1.001)
    every = np.unique(np.concatenate([i, j]))
    P = graph.covariance(every).reshape(len(every), 3, len(every), 3)
    for k in range(3):
        a, b = np.searchsorted(every, [j[k], i[k]])
        both = np.block([[P[a, :, a], P[a, :, b]], [P[b, :, a], P[b, :, b]]])
        c, s = np.cos(h[k, 2]), np.sin(h[k, 2])
        H = np.array([
            [-1, 0, h[k, 1], c, -s, 0],
            [0, -1, -h[k, 0], s, c, 0],
            [0, 0, -1, 0, 0, 1],
        ])  # fmt: skip
        np.testing.assert_allclose(cov[k], H @ both @ H.T, rtol=1e-6, atol=1e-12)


def test_what_follows_says_nothing_about_the_beginning():
    """Solved up to a closure, poses and covariances are those of the whole graph, and what follows
    is where the chain puts it. Breaks if what hangs behind is forgotten, or put where it was."""
    true, chain, poses, _ = ring(n=20)
    closure = SubmapConstraints(
        np.array([2]), np.array([11]), between(true[2], true[11])[None], 0.04 * COV[None]
    )
    whole, part = (SubmapGraph(poses, chain, [0], START) for _ in range(2))
    whole.solve(closure)
    part.begin_with(np.array([5, 12]))
    part.solve(closure)
    np.testing.assert_allclose(part.poses[:13], whole.poses[:13], atol=1e-5)
    assert not np.allclose(part.poses[13:], whole.poses[13:], atol=0.01)
    which = np.array([3, 11, 12])
    np.testing.assert_allclose(part.covariance(which), whole.covariance(which), rtol=1e-2)
    part.begin_with(None)
    np.testing.assert_allclose(part.poses, whole.poses, atol=1e-4)
    part.solve(closure)
    np.testing.assert_allclose(part.poses, whole.poses, atol=1e-5)


def test_submaps_that_are_not_in_use_are_refused():
    """They have no rows: without a word, those of the last submap in use would be read."""
    _, chain, poses, closure = ring()
    graph = SubmapGraph(poses, chain, [0], START)
    graph.begin_with(np.array([5]))
    graph.solve()
    used, unused = np.array([0, 5]), np.array([5, 7])
    for ask in (
        lambda: graph.covariance(unused),
        lambda: graph.relative(used, unused),
        lambda: graph.relative(unused, used),
        lambda: graph.solve(closure),
    ):
        with pytest.raises(EstimationError, match=r"submaps (7|11): are not in use yet"):
            ask()
    graph.begin_with(None)
    graph.solve(closure)
    assert graph.covariance(unused).shape == (6, 6)


def test_the_beginnings_of_several_paths():
    """A path of which nothing is used yet is its first submap, which its closures do not move."""
    _, chain, poses, _ = ring(n=4)
    two = SubmapConstraints(*(
        np.concatenate([a, a + 4 if k < 2 else a])
        for k, a in enumerate((chain.begin, chain.end, chain.delta, chain.cov))
    ))  # fmt: skip
    graph = SubmapGraph(np.concatenate([poses, poses]), two, [0, 4], np.tile(START, (2, 1, 1)))
    graph.begin_with(np.array([2]))
    assert graph.covariance(np.array([2, 4])).shape == (6, 6)
    graph.begin_with(np.array([2, 5]))
    same = SubmapConstraints(
        np.array([1]), np.array([5]), np.zeros((1, 3)), 0.05**2 * np.eye(3)[None]
    )
    graph.solve(same)
    np.testing.assert_allclose(graph.poses[5], graph.poses[1], atol=1e-3)


def test_a_closure_moves_the_end_and_leaves_the_start():
    true, chain, poses, closure = ring()
    graph = SubmapGraph(poses, chain, [0], START)
    graph.solve(closure)
    np.testing.assert_allclose(graph.poses[0], 0.0, atol=1e-6)
    before, after = (np.hypot(*(p[-1] - true[-1])[:2]) for p in (poses, graph.poses))
    assert after < 0.2 * before


def test_a_path_follows_its_anchors_and_keeps_its_shape_between_them():
    """Anchors are met exactly; where the whole path is moved rigidly, so is everything between."""
    rng = np.random.default_rng(1)
    path = [np.zeros(3)]
    for _ in range(20):
        path.append(compose(path[-1], np.array([0.3, 0.0, rng.normal(0, 0.1)])))
    path, anchors = np.array(path), np.array([0, 7, 15, 20])
    world = np.array([1.0, -2.0, 0.7])
    rigid = compose(world, path)
    np.testing.assert_allclose(
        move_between_anchors(path, anchors, rigid[anchors]), rigid, atol=1e-9
    )
    bent = rigid[anchors] + rng.normal(0, 0.05, (4, 3))
    np.testing.assert_allclose(move_between_anchors(path, anchors, bent)[anchors], bent, atol=1e-9)


def test_a_path_whose_start_is_uncertain_is_placed_by_its_closures():
    """Two paths, the second one started 0.5 m off with a sigma of 0.3 m: one closure of 5 cm
    between them moves all of it, the first path stays."""
    _, chain, poses, _ = ring(n=4)
    two = SubmapConstraints(*(
        np.concatenate([a, a + 4 if k < 2 else a])
        for k, a in enumerate((chain.begin, chain.end, chain.delta, chain.cov))
    ))  # fmt: skip
    off = compose(np.array([0.5, 0.0, 0.0]), poses)
    starts = np.array([1e-8 * np.eye(3), np.diag([0.3, 0.3, 0.1]) ** 2])
    graph = SubmapGraph(np.concatenate([poses, off]), two, [0, 4], starts)
    same = SubmapConstraints(
        np.array([1]), np.array([5]), np.zeros((1, 3)), 0.05**2 * np.eye(3)[None]
    )
    graph.solve(same)
    np.testing.assert_allclose(graph.poses[:4], poses, atol=0.03)
    np.testing.assert_allclose(graph.poses[4:, :2], graph.poses[:4, :2], atol=0.08)


def test_two_visits_of_a_long_wall_are_compared_where_both_were_near():
    """Out along a corridor of 60 m and back, a closure at the start: the wall is known as well as
    the closure says there, though it was first seen at one end on the way out, at the other on the
    way back. From those two submaps, 58 m apart, its relative position is not known to 10 cm."""
    x = np.array([*np.arange(0.0, 60.0, 2.0), *np.arange(58.0, -2.0, -2.0)])
    poses = np.zeros((len(x), 3))
    poses[:, 0], poses[len(x) // 2 :, 2] = x, np.pi
    n = np.arange(len(x) - 1)
    cov = np.tile(np.diag([0.02, 0.005, 0.002]) ** 2, (len(n), 1, 1))
    graph = SubmapGraph(
        poses, SubmapConstraints(n, n + 1, between(poses[:-1], poses[1:]), cov), [0], START
    )
    graph.solve(
        SubmapConstraints(
            np.array([0]), np.array([len(x) - 1]), between(poses[0], poses[-1])[None],
            np.diag([0.01, 0.01, 0.002])[None] ** 2,
        )
    )  # fmt: skip
    out, back, at = np.array([0]), np.array([1]), np.array([[1.0, 1.2]])
    normal = np.array([[0.0, 1.0]])
    way_out, way_back = np.arange(30), np.arange(30, 60)
    ends = LandmarkUncertainty(graph, {0: way_out[:1], 1: way_back[:1]})
    everywhere = LandmarkUncertainty(graph, {0: way_out, 1: way_back})
    assert ends(out, back, at, normal)[0, 0] > 0.1
    assert everywhere(out, back, at, normal)[0, 0] < 0.04


@pytest.mark.parametrize("seed", [1, 3, 5, 9, 10])
def test_closures_that_bend_the_path_far_do_not_throw_it_away(seed):
    """The error becomes smaller; full steps make it 8 to 4000 times larger, for all of these."""
    rng, n, m = np.random.default_rng(seed), 60, 8
    delta = np.column_stack([np.ones(n - 1), np.zeros(n - 1), rng.normal(0, 0.3, n - 1)])
    poses = [np.zeros(3)]
    for step in delta:
        poses.append(compose(poses[-1], step))
    loose, tight = (
        np.diag(np.square(sigmas)) for sigmas in ((0.05, 0.05, 0.5), (0.02, 0.02, 5e-3))
    )
    at = np.arange(n)
    chain = SubmapConstraints(at[:-1], at[1:], delta, np.tile(loose, (n - 1, 1, 1)))
    begin, end = rng.integers(0, 20, m), rng.integers(35, n, m)
    wrong = np.column_stack([rng.normal(0, 1, (m, 2)), rng.uniform(-3, 3, m)])
    closures = SubmapConstraints(begin, end, wrong, np.tile(tight, (m, 1, 1)))
    graph = SubmapGraph(np.array(poses), chain, [0], 1e-4 * np.eye(3)[None])

    def error():
        edges = chain.and_also(closures)
        off = log(between(edges.delta, between(graph.poses[edges.begin], graph.poses[edges.end])))
        return float(np.einsum("ij,ijk,ik", off, np.linalg.inv(edges.cov), off))

    before = error()
    graph.solve(closures)
    assert error() < 0.1 * before
