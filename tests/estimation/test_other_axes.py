"""The root of an information along other axes of its variables' errors."""

import numpy as np

from graphslam.core.geometry import adjoint
from graphslam.core.information_root import InformationRoot
from graphslam.estimation.joint_covariances import in_other_axes, joint_covariance


def test_covariances_are_those_along_the_new_axes():
    """Of two cliques, a turned variable above another one in the first, and of shared errors."""
    rng = np.random.default_rng(0)
    last = np.triu(rng.normal(size=(6, 6))) + 3 * np.eye(6)
    first = np.hstack([np.triu(rng.normal(size=(3, 3))) + 3 * np.eye(3), rng.normal(size=(3, 3))])
    root = InformationRoot(
        above=np.array([-1, 0]),
        own=np.array([6, 3]),
        width=np.array([0, 3]),
        separators=np.array([3, 4, 5]),
        values=np.concatenate([last.ravel(), first.ravel()]),
        states={},
        landmarks={0: 0, 1: 3, 2: 6},
        shared=rng.normal(size=(9, 2)),
    )
    axes = {3: adjoint(np.array([0.3, -0.1, 0.5])), 6: adjoint(np.array([0.1, 0.2, -2.0]))}
    rows = np.arange(9)
    before = joint_covariance(root, rows)
    whole = np.eye(9)
    for k, turn in axes.items():
        whole[k : k + 3, k : k + 3] = np.linalg.inv(turn)
    expected = whole @ before @ whole.T
    found = joint_covariance(in_other_axes(root, axes), rows)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * expected.max())
    np.testing.assert_array_equal(joint_covariance(root, rows), before)  # that is left as it was
