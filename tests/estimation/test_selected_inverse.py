"""Covariances by selected inversion, and between any poses: those of GTSAM, for any graph."""

import gtsam
import numpy as np
import pytest

from graphslam.estimation.joint_covariances import information_root, pair_covariances
from graphslam.estimation.optimisation import marginals_of
from graphslam.estimation.selected_inverse import covariance_blocks

POSES, POINTS = 60, 15


def mixed_graph(seed):
    """Poses in a chain with closures, two components of them, points, and one vector of four that
    everything in the first component shares: sizes, roots and cliques of all kinds."""
    rng = np.random.default_rng(seed)
    graph = gtsam.GaussianFactorGraph()

    def add(*keys_and_sizes):
        rows = max(size for _, size in keys_and_sizes)
        unit = gtsam.noiseModel.Unit.Create(rows)
        terms = [
            part for key, size in keys_and_sizes for part in (key, rng.normal(size=(rows, size)))
        ]
        graph.add(gtsam.JacobianFactor(*terms, rng.normal(size=rows), unit))

    shared = 5000
    add((0, 3))
    add((POSES // 2, 3))
    add((shared, 4))
    for k in range(1, POSES):
        if k != POSES // 2:
            add((k - 1, 3), (k, 3), *([(shared, 4)] if k < POSES // 2 else []))
    closures = []
    for _ in range(20):
        a, b = sorted(rng.choice(np.arange(POSES // 2), 2, replace=False).tolist())
        closures.append((b, a))
        add((a, 3), (b, 3))
    for k in range(POINTS):
        for pose in rng.choice(POSES, 3, replace=False).tolist():
            add((pose, 3), (1000 + k, 2))
    return graph, closures


@pytest.mark.parametrize("use_qr", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_blocks_are_those_of_the_inverse(seed, use_qr):
    """Of the dense inverse, for every variable, for pairs with a factor in either order, and for
    pairs that need none: one of these is in two components, whose cross covariance is zero. Also
    for pairs together with what all motions share."""
    graph, linked = mixed_graph(seed)
    pairs = [*linked, (3, 17), (POSES - 1, POSES // 2), (59, 0), (4, 5, 5000), (20, 6, 5000)]
    keys = sorted(graph.keyVector())
    size = {key: 3 if key < 1000 else 4 if key == 5000 else 2 for key in keys}
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    P = np.linalg.inv(graph.hessian(ordering)[0])
    starts = dict(zip(keys, np.cumsum([0, *(size[key] for key in keys)]).tolist(), strict=False))
    rows = {key: list(range(starts[key], starts[key] + size[key])) for key in keys}
    found = covariance_blocks(graph, linked, pairs, use_qr=use_qr)
    assert set(found.marginals) == set(keys) and set(found.joint) == set(pairs)
    for key, cov in found.marginals.items():
        np.testing.assert_allclose(cov, P[np.ix_(rows[key], rows[key])], rtol=1e-7, atol=1e-9)
    for pair, cov in found.joint.items():
        which = [row for key in pair for row in rows[key]]
        np.testing.assert_allclose(cov, P[np.ix_(which, which)], rtol=1e-7, atol=1e-9)


def test_an_indeterminate_variable_is_an_error_not_a_number():
    """A pose that nothing fixes but the next one, which nothing fixes either."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.1)
    graph.add(gtsam.BetweenFactorPose2(0, 1, gtsam.Pose2(1, 0, 0), noise))
    for key in (0, 1):
        values.insert(key, gtsam.Pose2(key, 0, 0))
    with pytest.raises(RuntimeError):
        marginals_of(graph, values)
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), noise))
    assert set(marginals_of(graph, values).marginals) == {0, 1}


def root_and_inverse(seed):
    """The root of the mixed graph's poses, numbers of their rows, and its dense inverse."""
    graph, _ = mixed_graph(seed)
    ordering = gtsam.Ordering()
    for key in sorted(graph.keyVector()):
        ordering.push_back(key)
    P = np.linalg.inv(graph.hessian(ordering)[0])
    rows = covariance_blocks(graph, keep_rows=True).rows
    # the poses come first among the keys
    states = {"a": range(POSES // 2), "b": range(POSES // 2, POSES)}
    root = information_root(rows, states, {})
    return root, P[: 3 * POSES, : 3 * POSES].reshape(POSES, 3, POSES, 3).swapaxes(1, 2)


@pytest.mark.parametrize("seed", range(5))
def test_joint_covariances_of_any_poses_are_those_of_the_inverse(seed):
    """Of single poses and of sums of two neighbours, in pairs near and far, equal and repeated, in
    two components that have nothing in common."""
    rng = np.random.default_rng(seed)
    root, P = root_and_inverse(seed)
    first = np.concatenate([root.states["a"], root.states["b"]])
    states = np.column_stack([np.arange(POSES), np.minimum(np.arange(POSES) + 1, POSES - 1)])
    states[POSES // 2 - 1, 1] = POSES // 2 - 1  # the next one is of the other component
    states = states[rng.choice(POSES, 40, replace=False)]
    maps = rng.normal(size=(len(states), 2, 3, 3))
    maps[::3, 1] = 0.0
    pairs = rng.integers(len(states), size=(100, 2))
    pairs[:2] = [[3, 3], [7, 7]]
    own, cross = pair_covariances(root, first[states], maps, pairs)
    near, far = states[:, None, :, None], states[None, :, None, :]
    expected = np.einsum("akij,abkhjl,bhml->abim", maps, P[near, far], maps)
    scale = np.abs(expected).max()
    each = np.arange(len(states))
    np.testing.assert_allclose(own, expected[each, each], atol=1e-9 * scale)
    np.testing.assert_allclose(cross, expected[pairs[:, 0], pairs[:, 1]], atol=1e-9 * scale)


def test_what_no_pose_depends_on_is_left_out():
    """Points that are eliminated first take no part in the covariance of poses."""
    root, _ = root_and_inverse(0)
    assert len(root.own) == len(root.above) == len(root.width)
    assert 3 * POSES <= root.own.sum() < 3 * POSES + 2 * POINTS + 4
    assert len(root.values) == (root.own * (root.own + root.width)).sum()
