"""Poses along the most accurate paths of a graph."""

import numpy as np

from graphslam.core.geometry import between, compose
from graphslam.core.spanning_tree import RelativePoses, spanning_tree_poses


def edges(*rows):
    """From (start, end, delta, variance) of each."""
    start, end, delta, variance = zip(*rows, strict=True)
    return RelativePoses(np.array(start), np.array(end), np.array(delta), np.array(variance))


def test_exact_measurements_give_the_poses_whatever_way_they_are_followed():
    """Edges in both directions, several components; what nothing reaches is NaN."""
    rng = np.random.default_rng(0)
    poses = rng.uniform(-3, 3, (40, 3))
    pairs = [(k, k + 1) if k % 2 else (k + 1, k) for k in range(38) if k != 20]
    pairs += [(int(a), int(b)) for a, b in rng.choice(21, (15, 2))]
    made = edges(*((a, b, between(poses[a], poses[b]), rng.uniform(0.1, 1)) for a, b in pairs))
    found = spanning_tree_poses(40, {0: (poses[0], 0.0), 25: (poses[25], 0.0)}, made)
    off = between(poses[:39], found[:39])
    np.testing.assert_allclose(off, 0.0, atol=1e-9)
    assert np.isnan(found[39]).all()


def test_the_most_accurate_path_is_followed_not_the_one_with_fewest_edges():
    """Three good edges against one bad one; and a start that is known well against one that is
    not."""
    ahead, wrong = np.array([1.0, 0.0, 0.3]), np.array([9.0, 9.0, 1.0])
    made = edges(
        (0, 3, wrong, 10.0), *((k, k + 1, ahead, 1.0) for k in range(3)), (3, 4, ahead, 1.0)
    )
    known = {0: (np.zeros(3), 0.0), 4: (wrong, 100.0)}
    found = spanning_tree_poses(5, known, made)
    expected = np.zeros(3)
    for pose in found:
        np.testing.assert_allclose(pose, expected, atol=1e-12)
        expected = compose(expected, ahead)
