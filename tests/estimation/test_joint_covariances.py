"""Covariances of linear combinations from the root of the information."""

import tracemalloc
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from graphslam.core.information_root import InformationRoot
from graphslam.estimation.joint_covariances import (
    covariance_of,
    information_root,
    joint_covariance,
    pair_covariances,
    solve_root,
    variances_of,
)
from graphslam.estimation.selected_inverse import covariance_blocks


def tree(rng, cliques, reach=3):
    """A root of cliques, each below one of the last ``reach`` before it."""
    own = rng.integers(1, 4, cliques)
    starts = np.concatenate([[0], np.cumsum(own)])
    above, widths, separators, values = [], [], [], []
    for c, n in enumerate(own):
        parent = int(rng.integers(max(0, c - reach), c)) if c else -1
        separator = np.zeros(0, dtype=np.int64)
        if c:
            separator = np.arange(starts[parent], starts[parent + 1])
            if c > 1:  # some of what the parent hangs on
                separator = np.append(separator, separators[parent][:2])
        block = 0.4 * rng.normal(size=(n, n + len(separator)))
        block[:, :n] = np.triu(block[:, :n], 1) + np.diag(rng.uniform(1.0, 2.0, n))
        above.append(parent)
        widths.append(len(separator))
        separators.append(separator)
        values.append(block.ravel())
    return InformationRoot(
        np.array(above),
        own,
        np.array(widths),
        np.concatenate(separators),
        np.concatenate(values),
        {},
    )


def dense(root):
    """The same as one matrix."""
    starts = np.concatenate([[0], np.cumsum(root.own)])
    separators = np.split(root.separators, np.cumsum(root.width)[:-1])
    blocks = np.split(root.values, np.cumsum(root.own * (root.own + root.width))[:-1])
    R = np.zeros((starts[-1], starts[-1]))
    for c, (separator, block) in enumerate(zip(separators, blocks, strict=True)):
        rows = np.arange(starts[c], starts[c + 1])
        R[np.ix_(rows, np.append(rows, separator))] = block.reshape(len(rows), -1)
    return R


@pytest.mark.parametrize("seed", range(5))
def test_covariances_are_those_of_the_inverse_information(seed):
    """To rounding: combinations of rows of any cliques, some rows twice, some not at all."""
    rng = np.random.default_rng(seed)
    root = tree(rng, 40)
    R = dense(root)
    k, n = 25, 120
    rows, columns = rng.integers(0, len(R), n), rng.integers(0, k - 1, n)
    derivatives = rng.normal(size=n)
    E = np.zeros((len(R), k))
    np.add.at(E, (rows, columns), derivatives)
    P = np.linalg.inv(R.T @ R)
    found = covariance_of(root, rows, columns, derivatives, k)
    np.testing.assert_allclose(found, E.T @ P @ E, atol=1e-10 * np.abs(P).max())
    # the shared errors too, of which each combination has its own
    root = replace(root, shared=rng.normal(size=(len(R), 3)))
    found = covariance_of(root, rows, columns, derivatives, k)
    alone = variances_of(root, rows, columns, derivatives, k)
    np.testing.assert_allclose(alone, np.diag(found), rtol=1e-12)
    root = replace(root, shared=np.zeros((0, 0)))
    some = rng.permutation(len(R))[:10]
    np.testing.assert_allclose(
        joint_covariance(root, some), P[np.ix_(some, some)], atol=1e-12 * np.abs(P).max()
    )


def test_right_sides_are_solved_with_the_whole_information():
    rng = np.random.default_rng(8)
    root = tree(rng, 40)
    R, right = dense(root), rng.normal(size=(int(root.own.sum()), 7))
    np.testing.assert_allclose(R.T @ R @ solve_root(root, right), right, atol=1e-9)


CALIBRATION = 1000


def chain(seed):
    """States in a row, points that some of them see, and a variable that all motions depend on."""
    rng, unit = np.random.default_rng(seed), gtsam.noiseModel.Unit.Create
    graph = gtsam.GaussianFactorGraph()
    graph.add(gtsam.JacobianFactor(0, np.eye(3), np.zeros(3), unit(3)))
    graph.add(gtsam.JacobianFactor(CALIBRATION, np.eye(2), np.zeros(2), unit(2)))
    for k in range(25):
        a, b, c = rng.normal(size=(3, 3)), rng.normal(size=(3, 3)), rng.normal(size=(3, 2))
        graph.add(gtsam.JacobianFactor(k, a, k + 1, b, CALIBRATION, c, np.zeros(3), unit(3)))
    for k in range(26):
        a, b = rng.normal(size=(2, 3)), rng.normal(size=(2, 2))
        graph.add(gtsam.JacobianFactor(k, a, 100 + k % 4, b, np.zeros(2), unit(2)))
    return graph


@pytest.mark.parametrize("row", [0, 13])
def test_columns_of_an_eliminated_graph_are_those_of_the_dense_inverse(row):
    """Of a state, and of the variable that all motions depend on, in the last clique."""
    graph = chain(3)
    keys, marks = list(range(26)), {k: 100 + k for k in range(4)}
    root = information_root(
        covariance_blocks(graph, keep_rows=True).rows,
        {"r": keys},
        marks,
        {"r": (CALIBRATION, [0, 1, -1])},
    )
    ordering = gtsam.Ordering()
    for key in (*keys, *marks.values(), CALIBRATION):
        ordering.push_back(key)
    P = np.linalg.inv(graph.hessian(ordering)[0])
    rows = [row + k for row in root.states["r"] for k in range(3)]
    rows += [root.landmarks[k] + d for k in marks for d in range(2)] + root.mounts["r"][:2].tolist()
    unit = np.eye(len(P))[:, [rows[3 * row], root.mounts["r"][1]]]
    found = solve_root(root, unit)[rows]
    np.testing.assert_allclose(found, P[:, [3 * row, -1]], atol=1e-12)


def test_shared_errors_are_in_all_covariances():
    """Breaks if one kind of query leaves them out, or takes rows of other variables."""
    rng = np.random.default_rng(9)
    root = tree(rng, 60)
    size = int(root.own.sum())
    root = replace(root, shared=rng.normal(size=(size, 4)))
    R = dense(root)
    P = np.linalg.inv(R.T @ R) + root.shared @ root.shared.T
    some = rng.permutation(size)[:10]
    tolerance = {"atol": 1e-12 * np.abs(P).max()}
    np.testing.assert_allclose(joint_covariance(root, some), P[np.ix_(some, some)], **tolerance)
    starts = np.concatenate([[0], np.cumsum(root.own)[:-1]])[root.own == 3]
    n = 5
    rows, maps, pairs = starts[:n, None], rng.normal(size=(n, 1, 3, 3)), np.array([[0, 4], [2, 1]])
    E = np.zeros((n, size, 3))
    for q in range(n):
        E[q, rows[q, 0] : rows[q, 0] + 3] = maps[q, 0].T
    own, cross = pair_covariances(root, rows, maps, pairs)
    np.testing.assert_allclose(own, E.mT @ P @ E, atol=1e-10 * np.abs(P).max())
    expected = [E[a].T @ P @ E[b] for a, b in pairs]
    np.testing.assert_allclose(cross, expected, atol=1e-10 * np.abs(P).max())


def test_memory_is_that_of_the_combinations_not_of_the_graph():
    """Peaks (tracemalloc) of 200 combinations of 1000 and of 4000 cliques. Breaks if all rows of
    the root are held for each combination: 3 and 13 MB, and four times as much."""

    def peak(cliques):
        root = tree(np.random.default_rng(1), cliques)
        rows = np.linspace(0, root.own.sum() - 1, 200).astype(np.int64)
        tracemalloc.start()
        joint_covariance(root, rows)
        _, found = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return found

    assert peak(4000) < 1.3 * peak(1000)
