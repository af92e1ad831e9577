"""Covariances of all variables with one of them."""

import gtsam
import numpy as np
import pytest

from graphslam.estimation.covariance_columns import covariance_columns
from graphslam.estimation.selected_inverse import covariance_blocks

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


@pytest.mark.parametrize("key", [CALIBRATION, 0, 13, 102])
def test_columns_are_those_of_the_dense_inverse(key):
    graph = chain(3)
    columns = covariance_columns(covariance_blocks(graph, keep_rows=True).rows, key)
    ordering = gtsam.Ordering()
    for other in sorted(columns):
        ordering.push_back(other)
    P = np.linalg.inv(graph.hessian(ordering)[0])
    dims = [len(columns[other]) for other in sorted(columns)]
    begin = dict(zip(sorted(columns), np.cumsum([0, *dims]), strict=False))
    own = slice(begin[key], begin[key] + len(columns[key]))
    assert len(columns) == 26 + 4 + 1
    for other, found in columns.items():
        rows = slice(begin[other], begin[other] + len(found))
        np.testing.assert_allclose(found, P[rows, own], atol=1e-12)
